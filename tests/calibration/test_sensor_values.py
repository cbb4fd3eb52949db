"""Each value of a calibration reaches its own key of the sensor, in the sensor's unit: hand-written numbers."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from hesim_render.calibration.sensor_values import _aps_values, _asynchronous_values, _evs_values

FILE = Path("c.yaml")
CAPTURE = SimpleNamespace(capture=SimpleNamespace(bit_depth=10))


def item(value, error=0.01):
    return SimpleNamespace(value=value, error=error, reason="")


def frames(**changes):
    usual = {
        "K": item(0.31), "black_dn": 41.5, "n_row_std_dn": 0.7, "row_noise_dn": item(0.6), "beta": [[[0.1, None, 3.0]]],
        "column_noise_dn": None, "read_noise_correlation": None, "column_offset_std_dn": None, "nonlinearity": None,
        "interference": None, "full_well_e": SimpleNamespace(limited_by="ADC", value=9000.0), "read_noise_e": item(2.5),
        "dark_current_e_per_s": item(12.0), "dsnu_e": item(3.5), "prnu_percent": item(1.4),
    }  # fmt: skip
    return SimpleNamespace(**usual | changes)


def test_values_of_frames():
    plain = {
        "system_gain_dn_per_e": 0.31, "black_level_dn": 41.5, "row_offset_std_dn": 0.7, "row_noise_dn": 0.6,
        "beta": [[[0.1, 0.0, 3.0]]], "read_noise_e": 2.5, "dark_current_e_per_s": 12.0, "dsnu_e": 3.5,
        "prnu_rel": pytest.approx(0.014),
    }  # fmt: skip
    assert _aps_values({"bit_depth": 10}, CAPTURE, frames(), FILE) == plain
    # what was not measured is not there, or 0 where the sensor's own value would count twice
    lacking = frames(row_noise_dn=None, column_noise_dn=item(None), dsnu_e=item(None), read_noise_e=item(-0.2))
    changes = {"row_noise_dn": 0.0, "column_noise_dn": 0.0, "read_noise_e": 0.0}
    assert _aps_values({"bit_depth": 10}, CAPTURE, lacking, FILE) == {
        key: value for key, value in (plain | changes).items() if key != "dsnu_e"
    }
    assert _aps_values({"bit_depth": 10}, CAPTURE, frames(row_noise_dn=item(None)), FILE)["row_noise_dn"] == 0.0
    more = {"column_noise_dn": 0.4, "read_noise_correlation": 0.15, "column_offset_std_dn": 0.8}
    given = frames(
        column_noise_dn=item(0.4), read_noise_correlation=item(0.15), column_offset_std_dn=0.8,
        full_well_e=SimpleNamespace(limited_by="full well", value=8700.0, cut_off_e=9000.0),
    )  # fmt: skip
    assert _aps_values({"bit_depth": 10}, CAPTURE, given, FILE) == plain | more | {"full_well_e": 9000.0}


def position(a, b, c, d):
    return SimpleNamespace(A=item(a), B=item(b), C=item(c), D=item(d))


@pytest.mark.parametrize(("hardware", "volts"), [(0.004, 0.004), (None, 1.0)])
@pytest.mark.parametrize(("measured", "theta"), [(0.24, 0.24), (None, 0.25)])
def test_values_of_fixed_comparisons(hardware, volts, measured, theta):
    """β2 is 1 V: β4 = θ/(θ_V·B), β1 = A/B, β3 = C·β4; a position that lacks one takes all of all positions."""
    sensor = {
        "evs": {"reference": "previous_sample", "contrast_threshold_on": 0.2, "contrast_threshold_off": 0.3},
        "evs_grid": {"rows_per_tile": 1, "cols_per_tile": 2},
    }
    evs = SimpleNamespace(
        theta_hardware_v=hardware, theta=item(measured), theta_on=item(None), theta_off=item(None), asymmetry=item(0.1),
        positions=[position(200.0, 8.0, 0.3, 0.05), position(100.0, 4.0, None, 0.02)], A=item(180.0), B=item(5.0),
        C=item(None), D=item(None), threshold_mismatch_rel=item(0.06), shot_law="sqrt", leak_rate_hz=item(0.35),
    )  # fmt: skip
    found = _evs_values(sensor, evs, SimpleNamespace(path=FILE))
    first, second = theta / volts / 8, theta / volts / 5
    assert found.pop("coefficients") == [
        pytest.approx({"beta1": 25.0, "beta2": 1.0, "beta3": 0.3 * first, "beta4": first, "beta5": 0.05}),
        pytest.approx({"beta1": 36.0, "beta2": 1.0, "beta3": 0.0, "beta4": second, "beta5": 0.0}),
    ]
    thresholds = {"contrast_threshold_on": 0.9 * theta, "contrast_threshold_off": 1.1 * theta}
    rest = {"threshold_mismatch_rel": 0.06, "shot_law": "sqrt", "leak_rate_hz": 0.35}
    assert found.pop("shot_law") == rest.pop("shot_law")
    assert found == pytest.approx(thresholds | rest | ({} if hardware is None else {"threshold_hardware_v": hardware}))


def test_what_a_calibration_of_events_does_not_know_is_left_out():
    """Mismatch, leak and asymmetry that have no value are 0; the polarities' thresholds are equal then."""
    sensor = {
        "evs": {"reference": "previous_sample", "contrast_threshold_on": 0.2, "contrast_threshold_off": 0.3},
        "evs_grid": {"rows_per_tile": 1, "cols_per_tile": 1},
    }
    evs = SimpleNamespace(
        theta_hardware_v=None, theta=item(0.24), theta_on=item(None), theta_off=item(0.3), asymmetry=item(None),
        positions=[position(200.0, 8.0, 0.3, 0.05)], A=item(180.0), B=item(5.0), C=item(0.1), D=item(0.1),
        threshold_mismatch_rel=item(None), shot_law="sqrt", leak_rate_hz=item(None),
    )  # fmt: skip
    for leak in ({}, {"leak_rate_hz": None, "leak_per_trial": item(None)}, {"leak_rate_hz": item(-0.1)}):
        found = _evs_values(sensor, SimpleNamespace(**{**vars(evs), **leak}), SimpleNamespace(path=FILE))
        assert found["contrast_threshold_on"] == found["contrast_threshold_off"] == 0.24
        assert found["threshold_mismatch_rel"] == found["leak_rate_hz"] == 0.0


def test_values_of_asynchronous_pixels():
    evs = SimpleNamespace(
        beta=[[9.0, 1.5, 1.0, 0.3, 0.02, 0.4]], theta_on=item(0.21), theta_off=item(0.27),
        threshold_mismatch_rel=item(0.05), shot_law="linear", leak_rate_hz=item(-0.01),
        noise_cutoff_hz=item(310.0),
    )  # fmt: skip
    assert _asynchronous_values({"evs": {"reference": "last_event"}}, evs, FILE) == {
        "contrast_threshold_on": 0.21, "contrast_threshold_off": 0.27, "threshold_mismatch_rel": 0.05,
        "coefficients": [{"beta1": 1.5, "beta2": 1.0, "beta3": 0.3, "beta4": 0.02, "beta5": 0.4}],
        "shot_law": "linear", "leak_rate_hz": 0.0, "noise_cutoff_hz": 310.0,
    }  # fmt: skip
