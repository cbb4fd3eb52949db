"""The script that makes the table of noise events: it repeats the entries of the table that the package ships."""

import runpy
from pathlib import Path

import numpy as np
import pytest

from hesim_render.pixels.evs.noise_rates import RateTable, rate_table

AXES = RateTable._fields[:4]


@pytest.mark.slow
def test_the_script_repeats_entries_of_the_table(monkeypatch, tmp_path):
    """A part of the table in a fraction of the time: at least 2000 events an entry, a standard error of 4 % or less."""
    script = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "event_noise.py"))
    names = script["main"].__globals__
    for name, value in {"LOWER": (1.5, 2.0, 3.0), "DIFFERENCE": (0.0, 0.5, 1.8), "DEAD_PERIODS": (0.1, 0.3),
                        "PERIODS": 150}.items():  # fmt: skip
        monkeypatch.setitem(names, name, value)
    script["main"](tmp_path / "table.npz")
    with np.load(tmp_path / "table.npz") as arrays:
        made = RateTable(*(arrays[name] for name in RateTable._fields))
    table = rate_table()
    places = [np.searchsorted(getattr(table, name), getattr(made, name)) for name in AXES]
    np.testing.assert_allclose(made.log_events, table.log_events[np.ix_(*places)], atol=80)
    np.testing.assert_allclose(
        made.log_events_no_dead_time, table.log_events_no_dead_time[np.ix_(*places[:2])], atol=80
    )


def test_the_table_rises_with_noise_and_is_whole():
    table = rate_table()
    shape = len(table.lower), len(table.difference)
    assert table.log_events_no_dead_time.shape == shape
    assert table.log_events.shape == (*shape, len(table.dead_periods), len(table.leak_periods))
    assert all(np.all(np.diff(getattr(table, name)) > 0) for name in AXES)
    # higher thresholds, fewer events
    assert np.all(np.diff(table.log_events_no_dead_time.astype(int), axis=0) < 0)
