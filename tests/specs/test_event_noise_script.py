"""The script that makes the table of noise events: its output is a module that repeats the entries of the table."""

import runpy
from pathlib import Path

import numpy as np
import pytest

from hesim_render.specs import event_noise_table as table

AXES = ("LOWER", "DIFFERENCE", "DEAD_PERIODS", "LEAK_PERIODS")


@pytest.mark.slow
def test_the_script_repeats_entries_of_the_table(monkeypatch, capsys):
    """A part of the table in a fraction of the time: at least 2000 events an entry, a standard error of 4 % or less."""
    script = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "event_noise.py"))
    names = script["main"].__globals__
    for name, value in {"LOWER": (1.5, 2.0, 3.0), "DIFFERENCE": (0.0, 0.5, 1.8), "DEAD_PERIODS": (0.1, 0.3),
                        "PERIODS": 150}.items():  # fmt: skip
        monkeypatch.setitem(names, name, value)
    script["main"]()
    made = {}
    exec(compile(capsys.readouterr().out, "table", "exec"), made)
    places = [[getattr(table, name).index(value) for value in made[name]] for name in AXES]
    axes = [len(getattr(table, name)) for name in AXES]
    wanted = np.reshape(table.LOG_EVENTS, axes)[np.ix_(*places)]
    np.testing.assert_allclose(np.reshape(made["LOG_EVENTS"], wanted.shape), wanted, atol=80)
    np.testing.assert_allclose(
        made["LOG_EVENTS_NO_DEAD_TIME"], np.array(table.LOG_EVENTS_NO_DEAD_TIME)[np.ix_(*places[:2])], atol=80
    )
