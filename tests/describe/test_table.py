"""The table of a sensor by hand, for sensors of no equal numbers."""

import math

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.describe import event_curves, figures_of
from hesim_render.describe.table import TABLE_LUX


def values_of(rows):
    return {row.name: (row.value, row.unit) for row in rows}


def test_geometry_and_frames_by_hand():
    changes = {
        "geometry.rows": 300, "geometry.cols": 700, "geometry.pitch_um": 3.5, "geometry.fill_factor": 0.8,
        "aps.full_well_e": 9000.0, "aps.read_noise_e": 4.0, "aps.system_gain_dn_per_e": 0.37,
        "aps.dark_current_e_per_s": 250.0, "aps.exposure_us": 20_000, "aps.frame_rate_hz": 40.0,
    }  # fmt: skip
    figures = figures_of(hr.load_sensor("reference-mono", changes))
    assert values_of(figures["geometry"]) == {
        "columns": (700, "px"), "rows": (300, "px"), "pixel pitch": (3.5, "µm"), "fill factor": (0.8, ""),
        "width": (pytest.approx(2.45), "mm"), "height": (pytest.approx(1.05), "mm"),
    }  # fmt: skip
    frames = values_of(figures["frames"])
    dark_e = math.sqrt(4.0**2 + 250.0 * 0.02)
    assert frames["noise in the dark at the sensor's exposure"] == (pytest.approx(dark_e), "e⁻")
    assert frames["dynamic range"] == (pytest.approx(20 * math.log10(9000 / dark_e)), "dB")
    assert [frames[name][0] for name in ("full well", "system gain", "read noise", "dark current", "exposure")] == [
        9000, 0.37, 4, 250, 20_000
    ]  # fmt: skip
    assert frames["frame rate"] == (40, "Hz") and frames["bit depth"] == (12, "bit")


def test_events_by_hand():
    changes = {
        "evs.contrast_threshold_on": 0.18, "evs.contrast_threshold_off": 0.31, "evs.threshold_mismatch_rel": 0.04,
        "evs.leak_rate_hz": 0.7, "evs.noise_cutoff_hz": 900.0, "evs.refractory_period_us": 130.0,
        "evs.data_sheet": None, "evs.leak": None,
    }  # fmt: skip
    sensor = hr.load_sensor("davis346", changes)
    figures = figures_of(sensor)
    events = values_of(figures["events"])
    on, off = 100 * math.expm1(0.18), 100 * math.expm1(0.31)
    assert events["threshold ON"] == (pytest.approx(on), "%") and events["threshold OFF"] == (pytest.approx(off), "%")
    # the spread of a threshold θ moves the contrast e^θ − 1 by (1 + contrast) times it
    expected = 0.04 * (0.18 + 0.31) / 2 * (100 + (on + off) / 2)
    assert events["threshold mismatch"] == (pytest.approx(expected), "%")
    assert [events[name][0] for name in ("leak", "noise bandwidth", "refractory period")] == [0.7, 900, 130]
    assert (events["event columns"][0], events["event rows"][0]) == (346, 260)
    # four rows an illuminance, in the order of the curves
    curves, rows = event_curves(sensor, TABLE_LUX), figures["events against light"]
    for k, values in enumerate(zip(curves.sigma, curves.on_hz, curves.off_hz, curves.latency_us, strict=True)):
        found = rows[4 * k : 4 * k + 4]
        np.testing.assert_allclose([row.value for row in found], values, rtol=1e-12)
        assert all(f"{TABLE_LUX[k]:g} lx" in row.name for row in found)
        assert [row.name.split(" at ")[0] for row in found] == ["noise of ln x", "ON events", "OFF events", "latency"]
