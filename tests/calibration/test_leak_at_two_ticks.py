"""The leak of a calibrated sensor at two ticks, with public names alone, so that old versions can run it.

Version 510ebd8 divided the chance of a comparison by the simulated tick: 0.304 Hz at 1 ms, 0.076 Hz at 4 ms.
"""

from pathlib import Path

import capture_sets
import pytest

import hesim_render as hr
from hesim_render.calibrate import calibrate_evs


def test_the_leak_of_a_calibration_does_not_follow_the_simulated_tick(tmp_path):
    """Captures at the 1 ms of the sensor file, with a chance of 3e-4 each; 5 standard errors of 6.5e7 comparisons."""
    counts = capture_sets.write_events(
        tmp_path / "set", size=32, trials=64_000, a=200.0, c=0.1, leak=3e-4, tile_rows=1, tile_cols=1,
        signal_reference="{k: 0.2, t_ref_us: 10000}",
    )  # fmt: skip
    calibrate_evs(tmp_path / "set", tmp_path / "c.yaml")
    text = (Path(hr.__file__).parents[1] / "sensors" / "reference-mono.yaml").read_text()
    rows, cols = counts["n_on"].shape
    text = text.replace("rows: 1024", f"rows: {rows}").replace("cols: 1024", f"cols: {cols}")
    (tmp_path / "s.yaml").write_text(text + "\nnoise: c.yaml\n")
    for tick_us in (1000, 4000):
        sensor = hr.load_sensor(tmp_path / "s.yaml", {"evs.tick_us": tick_us})
        assert sensor.spec.evs.leak_rate_hz == pytest.approx(0.3, abs=0.011)
