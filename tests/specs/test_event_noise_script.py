"""The script that makes the table of noise events: its output is a module that repeats the entries of the table."""

import runpy
from pathlib import Path

import numpy as np
import pytest

from hesim_render.specs import event_noise_table as table


@pytest.mark.slow
def test_the_script_repeats_entries_of_the_table(monkeypatch, capsys):
    """Two rows in a tenth of the time: at least 2000 events an entry, whose standard error is 2 % or less."""
    script = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "event_noise.py"))
    names = script["main"].__globals__
    for name, value in {"SPAN": (300, 700), "SPAN_NO_DEAD_TIME": (100, 1000), "ENOUGH": 2000, "MOST_PIXELS": 1024,
                        "MEAN": (1.5, 2.0), "DEAD_PERIODS": (0.1, 0.3)}.items():  # fmt: skip
        monkeypatch.setitem(names, name, value)
    script["main"]()
    made = {}
    exec(compile(capsys.readouterr().out, "table", "exec"), made)
    means, dead = ([getattr(table, name).index(v) for v in made[name]] for name in ("MEAN", "DEAD_PERIODS"))
    wanted = np.array(table.EVENTS)[np.ix_(means, range(len(table.DIFFERENCE)), dead)]
    np.testing.assert_allclose(made["EVENTS"], wanted, rtol=0.06)
    np.testing.assert_allclose(made["EVENTS_NO_DEAD_TIME"], np.array(table.EVENTS_NO_DEAD_TIME)[means], rtol=0.06)
