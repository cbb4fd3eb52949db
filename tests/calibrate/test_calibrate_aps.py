"""APS calibration against an independent generator and closed forms."""

import re

import capture_sets
import numpy as np
import pytest

from hesim_render.calibrate import calibrate_aps, read_calibration, read_maps


def polynomial(beta, i, t):
    """The variance polynomial written out: order 1, I, t, I², I t, t²."""
    return beta[0] + beta[1] * i + beta[2] * t + beta[3] * i**2 + beta[4] * i * t + beta[5] * t**2


def curve_errors(folder, section):
    """Per position the median and largest relative error of the curve over its own range, and z of each coefficient."""
    known = capture_sets.truth(folder)
    slope = np.load(folder / "truth_maps.npz")["slope_dn_per_s"]
    middle, worst, z = [], [], []
    for i, j in np.ndindex(4, 4):
        beta, error = (np.array(section[name][i][j]) for name in ("beta", "beta_standard_error"))
        true = np.array(known["beta_a"][i][j])
        errors = []
        for t in np.array(section["range"]["exposures_us"]) * 1e-6:
            light = slope[i::4, j::4] * t
            line = np.linspace(light.min(), min(light.max(), 900.0), 40)
            errors.append(np.abs(polynomial(beta, line, t) / polynomial(true, line, t) - 1))
        middle.append(np.median(errors))
        worst.append(np.max(errors))
        z.append((beta - true) / error)
    return np.array(middle), np.array(worst), np.array(z)


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    folder = capture_sets.generated(1)
    out = tmp_path_factory.mktemp("aps") / "calibration.yaml"
    calibrate_aps(folder, out)
    return folder, read_calibration(out)["aps"], read_maps(out, "aps")


def test_variance_curve_is_at_the_statistical_limit(calibrated):
    folder, section, _ = calibrated
    middle, worst, z = curve_errors(folder, section)
    assert np.median(middle) < 0.004
    assert worst.max() < 0.03
    # 96 z values; |z| > 4.9 has a chance of 1e-6 each, 1e-4 for all.
    assert np.abs(z).max() < 4.9
    # Sum of squares about 96, correlated within a position (6 each): 16 groups, bound far beyond 5 sigma.
    assert 0.5 < np.sqrt(np.mean(z**2)) < 1.5
    chi2 = np.array(section["goodness"]["chi2_per_dof"])
    # 41,000 values a position: std of χ²/dof is sqrt((2 + 12/63)/41000) = 0.0073; 5 sigma.
    assert np.abs(chi2 - 1).max() < 0.037


def test_fixed_maps_in_the_gauge(calibrated):
    folder, section, maps = calibrated
    known = np.load(folder / "truth_maps.npz")
    assert np.sqrt(np.mean((maps["n_row"] - known["n_row"]) ** 2)) < 0.02
    assert abs(maps["n_row"].mean()) < 1e-9
    assert np.abs(maps["n_blc"].mean(axis=1, dtype=np.float64)).max() < 1e-5
    # Black: the mean over 65,536 pixels, each with 0.13 DN of error; 5 sigma.
    assert abs(section["black_dn"] - known["black"]) < 5 * 0.15 / 256
    # N_FP is the mean of 64 frames at five exposures: about 0.13 DN a pixel.
    assert np.std(maps["n_blc"] - known["n_blc"]) < 0.2
    assert np.all(maps["hot_pixels"][known["hot"]])
    assert np.sum(maps["hot_pixels"] & ~known["hot"]) <= 3
    hot = known["hot"]
    assert np.abs(maps["n_dp"][hot] / known["n_dp"][hot] - 1).max() < 0.5
    assert np.std(maps["n_dp"][~hot] - known["n_dp"][~hot]) < 25


def test_a_full_well_that_no_exposure_reaches_has_a_least_value(tmp_path):
    """3200 electrons at most, 864 of 1023 DN."""
    capture_sets.write_frames(tmp_path / "set", size=(40, 56), frames=16)
    calibrate_aps(tmp_path / "set", tmp_path / "c.yaml")
    well = read_calibration(tmp_path / "c.yaml")["aps"]["full_well_e"]
    least = re.search(r"no exposure saturates: it is at least (\d+) e-", well["reason"])
    assert well["value"] is None and int(least[1]) == pytest.approx(3200, rel=0.03)


def test_composite_has_the_error_it_states(calibrated):
    folder, _, maps = calibrated
    slope = np.load(folder / "truth_maps.npz")["slope_dn_per_s"]
    z = (maps["signal_dn_per_s"] - slope) / maps["signal_standard_error_dn_per_s"]
    assert np.isfinite(z).all()
    # 65,536 values: mean within 5/256, std within 5 sqrt(1/2/65536) plus 3 % for the estimate of the variance.
    assert abs(z.mean()) < 0.03
    assert abs(z.std() - 1) < 0.05


def test_photon_transfer_of_a_physical_sensor(tmp_path):
    # K = 0.25 DN/e, read noise 6 e, dark current 2000 e/s, full well 2400 e (600 DN, below full scale).
    capture_sets.write_frames(tmp_path / "set", size=(120, 136), full_well_e=2400.0, dsnu_e=4.0)
    calibrate_aps(tmp_path / "set", tmp_path / "c.yaml")
    section = read_calibration(tmp_path / "c.yaml")["aps"]
    for name, true, relative in (
        ("K", 0.25, 0.005), ("read_noise_e", 6.0, 0.02), ("dark_current_e_per_s", 2000.0, 0.01),
        ("full_well_e", 2400.0, 0.02), ("dsnu_e", 4.0, 0.03),
    ):  # fmt: skip
        assert section[name]["value"] == pytest.approx(true, rel=relative), name
    assert section["full_well_e"]["limited_by"] == "full well"
    # Full well counts photo-electrons and dark ones; the dark 40 e of the longest exposure lie within the 2 %.
    assert section["linearity_error_percent"]["value"] < 0.3
    assert section["prnu_percent"]["value"] is None
    assert "uniform" in section["prnu_percent"]["reason"]
    k, error = section["K"]["value"], section["K"]["standard_error"]
    assert abs(k - 0.25) < 5 * error


def test_flat_field_gives_prnu_and_no_invented_terms(tmp_path):
    capture_sets.write_frames(
        tmp_path / "set", size=(120, 136), prnu=0.01, flat=True, dark_s=(2e-3, 8e-3), lit_s=(2e-3, 8e-3)
    )
    calibrate_aps(tmp_path / "set", tmp_path / "c.yaml")
    section = read_calibration(tmp_path / "c.yaml")["aps"]
    # 16,384 pixels: std of the estimate is 0.01/sqrt(2·16384)·(1 + noise) = 0.6 %; 6 sigma.
    assert section["prnu_percent"]["value"] == pytest.approx(1.0, rel=0.04)
    assert section["K"]["value"] == pytest.approx(0.25, rel=0.01)
    # Two exposures cannot tell t² from 1 and t; one brightness cannot tell I² from I t.
    for row in section["beta"]:
        for beta in row:
            assert beta[5] is None
            assert beta[3] is None or beta[4] is None
            assert beta[1] == pytest.approx(0.25, rel=0.05)
    assert any("do not identify" in note for note in section["notes"])


def test_dark_and_lit_exposures_may_differ(tmp_path):
    capture_sets.write_frames(
        tmp_path / "set",
        tile_rows=1,
        tile_cols=4,
        dark_s=(1e-3, 30e-3, 60e-3),
        lit_s=(3e-3, 7e-3, 11e-3),
        dark_e_per_s=5000.0,
    )
    calibrate_aps(tmp_path / "set", tmp_path / "c.yaml")
    section, maps = read_calibration(tmp_path / "c.yaml")["aps"], read_maps(tmp_path / "c.yaml", "aps")
    rate = 0.25 * 1.6e5 * (0.02 + 0.98 * np.arange(72) / 71)
    z = (maps["signal_dn_per_s"] - rate) / maps["signal_standard_error_dn_per_s"]
    # 4032 pixels share no error but black: mean within 5/64, plus the dark line's shared part.
    assert abs(z.mean()) < 0.1
    for row in section["beta"]:
        for beta, error in zip(row, section["beta_standard_error"][0], strict=True):
            assert beta[1] == pytest.approx(0.25, abs=6 * error[1])


def test_partially_clipped_pixels_do_not_bias_the_curve(tmp_path):
    # A third of the scene reaches full scale at the longest exposure: without care the variance there goes to 0.
    capture_sets.write_frames(tmp_path / "set", brightest_e_per_s=3e5, frames=64)
    calibrate_aps(tmp_path / "set", tmp_path / "c.yaml")
    section, maps = read_calibration(tmp_path / "c.yaml")["aps"], read_maps(tmp_path / "c.yaml", "aps")
    for i, j in np.ndindex(2, 2):
        beta = np.array(section["beta"][i][j])
        top = section["range"]["signal_dn"][i][j][-1][1]
        assert 800 < top < 900
        # Var = K²σ² + K I + K² D t; 2 % at the very end of the range, where 1000 pixel-values weigh in.
        true = 0.0625 * 36 + 0.25 * top + 0.0625 * 2000 * 20e-3
        assert polynomial(beta, top, 20e-3) == pytest.approx(true, rel=0.05)
    assert section["full_well_e"]["limited_by"] == "ADC full scale"
    # The composite still has the bright pixels, from the shorter exposures.
    assert maps["signal_dn_per_s"][:, -1].mean() == pytest.approx(0.25 * 3e5, rel=0.01)


def test_dead_and_flickering_pixels_are_masked(tmp_path):
    capture_sets.write_frames(tmp_path / "set")
    folder = tmp_path / "set"
    rng = np.random.default_rng(0)
    with np.load(folder / "aps_lit.npz") as data:
        lit, exposures = data["frames"].copy(), data["exposures_us"]
    with np.load(folder / "aps_dark.npz") as data:
        dark = data["frames"].copy()
    lit[:, :, 10, 40] = dark[:, :, 10, 40]
    lit[:, :, 20, 21] += (30 * rng.integers(0, 2, lit.shape[:2])).astype(np.uint16)
    lit[:, :, 33, 7], dark[:, :, 33, 7] = 500, 500
    capture_sets.save_frames(folder, "aps_lit", lit, exposures * 1e-6)
    capture_sets.save_frames(folder, "aps_dark", dark, exposures * 1e-6)
    calibrate_aps(folder, tmp_path / "c.yaml")
    bad = read_maps(tmp_path / "c.yaml", "aps")["bad_pixels"]
    assert bad[10, 40] and bad[20, 21] and bad[33, 7]
    assert bad.sum() == 3


def test_event_only_positions_have_no_polynomial_and_are_interpolated(tmp_path):
    # Eiger: event-only pixels at the lower right of each colour cell, each with frame pixels of its filter around it.
    rate = capture_sets.write_frames(tmp_path / "set", sensor="eiger", tile_rows=4, tile_cols=4)
    calibrate_aps(tmp_path / "set", tmp_path / "c.yaml")
    section, maps = read_calibration(tmp_path / "c.yaml")["aps"], read_maps(tmp_path / "c.yaml", "aps")
    assert section["beta"][1][1] == [None] * 6 and section["beta"][3][3] == [None] * 6
    assert section["beta"][0][0][1] == pytest.approx(0.25, rel=0.05)
    signal, true = maps["evs_signal_dn_per_s"], 0.25 * rate[1::2, 1::2]
    assert signal.shape == (28, 36) and np.isfinite(signal).all()
    # The three neighbours of its filter lie up and to the left: on this ramp of 1.6 % a pixel, below 1 pixel's worth.
    assert np.abs(signal - true)[:, 2:-2].max() < 0.016 * 0.25 * 1.6e5
    assert np.mean(signal / true) == pytest.approx(1, abs=0.05)


def test_an_event_filter_without_frame_pixels_has_no_signal_from_frames(tmp_path):
    capture_sets.write_frames(
        tmp_path / "set", size=(24, 40), frames=16, sensor="mipi-hybridevs", tile_rows=4, tile_cols=4
    )
    calibrate_aps(tmp_path / "set", tmp_path / "c.yaml")
    signal = read_maps(tmp_path / "c.yaml", "aps")["evs_signal_dn_per_s"]
    assert signal.shape == (12, 10) and np.isnan(signal).all()


@pytest.mark.slow
def test_ten_seeds_stay_within_the_bounds(tmp_path):
    scores = []
    for seed in range(2, 12):
        folder = capture_sets.generated(seed)
        calibrate_aps(folder, tmp_path / f"{seed}.yaml")
        section = read_calibration(tmp_path / f"{seed}.yaml")["aps"]
        n_row = read_maps(tmp_path / f"{seed}.yaml", "aps")["n_row"]
        middle, worst, z = curve_errors(folder, section)
        scores.append(z)
        assert np.median(middle) < 0.004 and worst.max() < 0.03
        assert np.sqrt(np.mean((n_row - np.load(folder / "truth_maps.npz")["n_row"]) ** 2)) < 0.02
    z = np.concatenate(scores)
    # No bias: the mean of 160 z of a coefficient has std 0.079; six of them, 4.5 sigma (4e-5).
    assert np.abs(z.mean(axis=0)).max() < 0.36
    # Right errors: the mean square of 160 has std 0.11; 4.5 sigma.
    assert np.abs((z**2).mean(axis=0) - 1).max() < 0.5
