"""Values and errors that calibrations write, each from numbers given by hand: sums of squares, quotients, densities."""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm

from hesim_render.calibrate.aps import light_curve, long_series, pair_levels, pairs_output
from hesim_render.calibrate.aps import output as frames_output
from hesim_render.calibrate.aps.common_mode import Shared
from hesim_render.calibrate.aps.pairs_findings import findings, missing_codes
from hesim_render.calibrate.aps.spatial import SpatialVariance, Temporal
from hesim_render.calibrate.asynchronous import likelihood
from hesim_render.calibrate.asynchronous import output as trials_output
from hesim_render.calibrate.asynchronous.trials import Trials
from hesim_render.calibration import sensor_values
from hesim_render.calibration.spec import Defect
from hesim_render.core.errors import SpecError

#: Half of an interval of 95 % of a normal law, errors.
Z = 1.959964
#: Gain, DN/e⁻, and its relative error.
K, RELATIVE = 0.37, 0.021


def lit_pairs(**changed):
    """Variances of pairs in the light, DN², and the part of pixels at the end of the ADC's range."""
    given = {"variance": [2.3, 6.1, 19.0, 18.9], "row": [0.1, 0.2, 0.3, -0.4], "error": [0.2, 0.3, 0.5, 0.6],
             "high": [0.0, 0.0, 0.004, 0.2], "exposure_s": [0.1, 0.2, 0.3, 0.3]}  # fmt: skip
    arrays = {name: np.array(values) for name, values in {**given, **changed}.items()}
    return SimpleNamespace(**arrays, missing=())


def calibration(**changed):
    """A calibration of EMVA 1288 captures with unlike numbers everywhere."""
    spatial_dark = SpatialVariance(0.31, 0.12, 1.7, (0.011, 0.017, 0.13), (13, 21, 273))
    spatial_lit = SpatialVariance(0.9, 2.4, 6.1, (0.05, 0.07, 0.9), (13, 21, 273))
    mean = np.full((14, 22), 40.0)
    dark_noise, lit_noise = Temporal(9.4, 0.12, 0.05, 0.02, 0.0, 0.0), Temporal(31.0, 0.33, 0.21, 0.11, 0.0, 0.0)
    given = {
        "pairs": SimpleNamespace(has_photons=True, shape=(14, 22), is_dark_once=False, long=[0],
                                 spatial_lit=SimpleNamespace(photons=250.0), spec=SimpleNamespace(full_scale_dn=255)),
        "dark_noise_is_rounded_off": False,
        "gain": SimpleNamespace(slope=K, error=K * RELATIVE, groups=9),
        "responsivity": SimpleNamespace(slope=0.22, error=0.0031, groups=9),
        "noise": SimpleNamespace(value=8.9, error=0.23, slope=61.0, groups=7),
        "black": SimpleNamespace(value=40.0, slope=17.0, slope_error=0.7, groups=5, rms=0.002),
        "lines_dn2": 0.7, "row": (0.62, 0.05), "col": (0.04, 0.03),
        "light": np.array([100.0, 300.0, 900.0, 1500.0]), "saturation": 2, "signal": np.array([22.0, 66, 190, 200]),
        "clear": np.array([1, 1, 0, 0], bool), "lit": lit_pairs(), "brightest_dn": 207.0,
        "dark": SimpleNamespace(
            exposure_s=np.array([0.1, 0.2, 0.3, 0.3]), change=np.array([0.3, -0.3, 0.2, 0.2]), missing=()
        ),
        "fit": SimpleNamespace(beta=np.array([0.4, 0.05, 0.0, 0.0, 0.0, 0.0])),
        "long_dark": SimpleNamespace(spatial=spatial_dark, mean=mean, temporal=dark_noise),
        "long_lit": SimpleNamespace(spatial=spatial_lit, mean=mean + 120, temporal=lit_noise, frames=16),
        "linearity": (np.array([1, 0, 1, 1], bool), np.array([-0.4, 0.1, 0.9])),
        "curve": SimpleNamespace(at=lambda x: 0.22 * (x + 2) * 1.0021, terms=np.array([0.22, 0, 0]), offset=2.0,
                                 offset_error=0.51, bends=True, light_rms=4e-4, error=lambda x: 1.2e-4 * x),
        "level_rms": 0.0019, "level_chance": 1e-9, "level_chi2": 3.2,
        "noise_spectrum": SimpleNamespace(lines=[], correlated=False, correlation=-0.013, correlation_error=0.02),
    }  # fmt: skip
    return SimpleNamespace(**{**given, **changed})


def check(entry, value, error, unit, half=None):
    assert entry["value"] == pytest.approx(value) and entry["standard_error"] == pytest.approx(error)
    assert entry["unit"] == unit
    if half is not None:
        assert entry["interval_95"] == pytest.approx([value - half * error, value + half * error], rel=1e-5)


def test_noise_of_emva_captures_in_electrons_with_its_error():
    """Read noise is the dark variance less interference and 1/12; the standard's has rows and columns besides."""
    variance = 8.9 - 0.7 - 1 / 12
    noise = np.sqrt(variance) / K
    found = pairs_output._read_noise(calibration(), K, RELATIVE)
    check(found, noise, noise * np.hypot(0.23 / (2 * variance), RELATIVE), "e-", 2.446912)  # Student's, 6 degrees
    assert found["value_dn"] == pytest.approx(np.sqrt(variance))
    variance = 8.9 - 1 / 12 + 0.62 + 0.04
    noise = np.sqrt(variance) / K
    error = np.sqrt(0.23**2 + 0.05**2 + 0.03**2) / (2 * variance)
    check(pairs_output._dark_noise(calibration(), K, RELATIVE), noise, noise * np.hypot(error, RELATIVE), "e-", Z)
    less = pairs_output._dark_noise(calibration(row=(-0.3, 0.05), col=(-0.2, 0.03)), K, RELATIVE)
    assert less["value"] == pytest.approx(np.sqrt(8.9 - 1 / 12) / K)


def test_noise_below_a_grey_value_is_that_of_the_long_series_less_what_else_it_holds():
    """In squares: rows, columns and lines for the pixels' own noise, and the dark current of 13 ms for both."""
    pairs = SimpleNamespace(spatial_dark=SimpleNamespace(exposure_s=0.013))
    given = {"dark_noise_is_rounded_off": True, "pairs": pairs, "row": (0.011, 0.002), "col": (-0.004, 0.001),
             "lines_dn2": 0.007}  # fmt: skip
    series = SimpleNamespace(low=0.36, value=0.39, high=0.43)
    current = 17.0 * K * 0.013
    for tell, other in ((pairs_output._read_noise, 0.011 + 0.007 + current), (pairs_output._dark_noise, current)):
        found = tell(calibration(rounded_noise=series, **given), K, RELATIVE)
        low, value, high = (np.sqrt(v**2 - other) for v in (0.36, 0.39, 0.43))
        error = (high - low) / (2 * Z)
        check(found, value / K, value / K * np.hypot(error / value, RELATIVE), "e-")
        expected = low / K * (1 - Z * RELATIVE), high / K * (1 + Z * RELATIVE)
        assert found["interval_95"] == pytest.approx(expected, rel=1e-6) and found["value_dn"] == pytest.approx(value)
    # known to a quarter; hidden by the rest, uncertain by more than a quarter, or never seen
    for noise, limit in (((0.33, 0.43), None), ((0.29, 0.43), 0.43), ((0.35, 0.6), 0.49), (None, 0.49)):
        series = None if noise is None else SimpleNamespace(low=noise[0], value=0.39, high=noise[1])
        found = pairs_output._read_noise(calibration(rounded_noise=series, **given), K, RELATIVE)
        assert (found["value"] is None) == (limit is not None)
        if limit is not None:
            assert found["upper_limit"] == pytest.approx(limit / K) and f"at most {limit:.2g} DN" in found["reason"]


@pytest.mark.parametrize("is_rounded", [False, True])
def test_maps_of_emva_captures_are_their_patterns_without_rows_and_shading(monkeypatch, is_rounded):
    """Pixels that are white or black are moved by the whole range; the figure's points have neither rounding nor
    lines, and those that are not clear have no light.
    """
    rng, shape = np.random.default_rng(3), (4, 5)
    row, col, pixel = rng.normal(2, 1, 4), rng.normal(0.7, 0.3, 5), rng.normal(0, 3, shape)
    shade, whole = rng.uniform(-0.2, 0.2, shape), rng.uniform(-0.3, 0.3, shape)
    whole[3, 3] = -1.4
    white, black = np.zeros((2, *shape), bool)
    white[1, 2] = black[0, 4] = True
    levels, t = rng.normal(9, 1, shape), np.array([0.01, 0.013, 0.05])
    monkeypatch.setattr(pairs_output, "stuck_pixels", lambda full, *_: (white, black) if full == 1023 else None)
    monkeypatch.setattr(pairs_output, "levels_of", lambda mean, good, spread: levels * spread * mean * good)
    monkeypatch.setattr(pairs_output, "_histogram", lambda result, series, signal: (series.name, signal))
    monkeypatch.setattr(pairs_output, "_FIGURE_PX", 2)
    lit = SimpleNamespace(mean=np.array([40.0, 90, 300]), variance=np.array([5.0, 8, 19]), exposure_s=t)
    dark = SimpleNamespace(mean=np.array([10.0, 11, 12]), variance=np.array([3.0, 3.2, 3.4]), exposure_s=t)
    result = SimpleNamespace(
        pairs=SimpleNamespace(
            shape=shape, spec=SimpleNamespace(full_scale_dn=1023), spatial_lit=SimpleNamespace(exposure_s=0.02)
        ),
        light_pattern=SimpleNamespace(shading=lambda: shade, whole=whole),
        dark_pattern=SimpleNamespace(row=row, col=col, pixel=pixel),
        rounded_noise=SimpleNamespace(spread=0.3) if is_rounded else None, defects=np.zeros(shape, bool),
        long_dark=SimpleNamespace(name="dark", mean=np.full(shape, 1.7)), lit=lit, dark=dark, lines_dn2=0.4,
        long_lit=SimpleNamespace(name="lit", mean=np.full(shape, 150.0), variance=rng.random(shape)),
        clear=np.array([True, True, False]), signal=lit.mean - dark.mean, black=SimpleNamespace(slope=7.0, value=9.5),
    )  # fmt: skip
    found = pairs_output.maps(result)
    offset = levels * 0.3 * 1.7 - row[:, None] if is_rounded else col + pixel
    offset[1, 2], offset[0, 4] = offset[1, 2] + 1023, offset[0, 4] - 1023
    response = (1 + whole) / (1 + shade)
    response[0, 4] = response[3, 3] = 0
    np.testing.assert_allclose(found["n_blc"], offset, rtol=1e-5)
    np.testing.assert_allclose(found["response"], response, rtol=1e-6)
    np.testing.assert_allclose(found["light_rel"], 1 + shade, rtol=1e-6)
    assert (found["n_dp"] == 7).all() and found["n_row"] is row
    assert found["figure_variance_map"].tolist() == result.long_lit.variance[::3, ::3].tolist()
    assert found["figure_variance_exposure_us"] == pytest.approx(20_000)
    assert (found["figure_noise_dark"], found["figure_noise_lit"]) == (("dark", 0.0), ("lit", 140.5))
    known = [(0, 3.0), (0, 3.2), (0, 3.4), (30, 5.0), (79, 8.0)]
    points = [(0, 0, 0.013, k > 2, x, v - 1 / 12 - 0.4, 20) for k, (x, v) in enumerate(known)]
    np.testing.assert_allclose(found["figure_variance_points"], points)
    result.black.slope = -2.0
    assert not pairs_output.maps(result)["n_dp"].any()


def test_efficiency_dark_current_and_full_well_of_emva_captures():
    value = 0.22 / K
    found = pairs_output._quantum_efficiency(calibration(), RELATIVE)
    check(found, value, value * np.hypot(RELATIVE, 0.0031 / 0.22), "e-/photon", 2.306004)  # 8 degrees
    found = pairs_output._dark_current(calibration(), K, RELATIVE)
    check(found, 17 / K, np.hypot(0.7 / K, 17 / K * RELATIVE), "e-/s", 2.776445)  # 4 degrees
    assert found["from_variance"] == pytest.approx(61 / K**2) and found["value_dn_per_s"] == 17
    per_photon = 0.22 / K

    def full_well(saturation=2, full_scale_dn=255, **lit):
        given = calibration(saturation=saturation, lit=lit_pairs(**lit))
        given.pairs.spec.full_scale_dn = full_scale_dn
        return pairs_output._full_well(given, K, RELATIVE)

    # from the level below to the one above the last that is as large but for its error
    found = full_well()
    ends = per_photon * 300 * (1 - Z * RELATIVE), per_photon * 1500 * (1 + Z * RELATIVE)
    assert found["value"] == pytest.approx(per_photon * 900) and found["interval_95"] == pytest.approx(ends)
    assert found["standard_error"] == pytest.approx((ends[1] - ends[0]) / (2 * Z))
    assert found["limited_by"] == "ADC full scale" and found["photons"] == 900
    # the variance falls behind the largest, but the signal goes on to 200 DN, or to the end of the ADC's range
    few = {"high": [0.5, 0.5, 0.01, 0.009]}
    found = full_well(1, variance=[2.3, 19.0, 6.1, 18.9], **few)
    assert found["limited_by"] == "ADC full scale"
    found = full_well(1, variance=[2.3, 19.0, 6.1, 18.9], high=[0.5, 0.01, 0.01, 0.009])
    assert found["limited_by"] == "full well" and found["cut_off_e"] == pytest.approx(207 / K)
    assert found["interval_95"] == pytest.approx([per_photon * 100 * (1 - Z * RELATIVE), 200 / K * (1 + Z * RELATIVE)])
    found = full_well(1, variance=[2.3, 19.0, 18.4, 6.1], full_scale_dn=300)
    assert found["interval_95"][1] == pytest.approx(per_photon * 1500 * (1 + Z * RELATIVE))
    found = full_well(1, variance=[2.3, 19.0, 17.0, 18.9], row=[0, 0, 0, 0], full_scale_dn=100)
    assert found["interval_95"][1] == pytest.approx(per_photon * 900 * (1 + Z * RELATIVE))
    assert full_well(full_scale_dn=1023)["interval_95"][1] == pytest.approx((1023 - 40) / K * (1 + Z * RELATIVE))
    none = pairs_output._full_well(calibration(saturation=4), K, RELATIVE)
    assert none["value"] is None and f"at least {200 / K:.0f} e-" in none["reason"]


def test_spread_over_pixels_of_emva_captures():
    """In the dark, and in the light less that of the dark; errors are those of a device drawn from its law."""
    errors = [calibration().long_dark.spatial.errors(fixed=False), calibration().long_lit.spatial.errors(fixed=False)]
    total = 0.31 + 0.12 + 1.7
    found = pairs_output._dsnu(calibration(), K, RELATIVE)
    relative = errors[0][3] / (2 * total)
    check(found, np.sqrt(total) / K, np.sqrt(total) / K * np.hypot(relative, RELATIVE), "e-", Z)
    parts = [found[f"{name}_e"] for name in ("row", "column", "pixel")]
    assert parts == pytest.approx(np.sqrt([0.31, 0.12, 1.7]) / K)
    faint = SpatialVariance(-0.02, 0.001, 0.1, (0.1, 0.2, 0.9), (13, 21, 273))
    found = pairs_output._dsnu(calibration(long_dark=SimpleNamespace(spatial=faint)), K, RELATIVE)
    limit = np.sqrt(0.081 + Z * faint.errors(fixed=False)[3]) / K
    assert found["value"] == 0 and found["upper_limit"] == pytest.approx(limit, rel=1e-5) and found["row_e"] == 0
    found = pairs_output._prnu(calibration())
    variance = 0.9 + 2.4 + 6.1 - total
    error = np.hypot(errors[0][3], errors[1][3]) / (2 * np.sqrt(variance))
    check(found, 100 * np.sqrt(variance) / 120, 100 * error / 120, "%", Z)
    parts = [found[f"{name}_percent"] for name in ("row", "column", "pixel")]
    assert parts == pytest.approx(100 * np.sqrt([0.59, 2.28, 4.4]) / 120)


def test_errors_of_spatial_variances_have_what_pixels_add_to_rows_and_columns():
    """Of a given device 4 v n + 2 n², of its law 2 (v + n)², per degree of freedom; a row has v of its pixels/cols."""
    spatial = SpatialVariance(0.31, -0.12, 1.7, (0.011, 0.017, 0.13), (13, 21, 273))
    v = np.array([0.31 + 1.7 / 22, 0.0 + 1.7 / 14, 1.7])
    n, freedom = np.array([0.011, 0.017, 0.13]), np.array([13, 21, 273])
    for fixed, scatter in ((True, 4 * v * n + 2 * n**2), (False, 2 * (v + n) ** 2)):
        each = np.sqrt(scatter / freedom)
        np.testing.assert_allclose(spatial.errors(fixed), [*each, np.sqrt(np.sum(each**2))], rtol=1e-12)


def test_what_is_not_significant_has_a_limit():
    """Shared noise counts from 3.9 errors on, correlation where the spectrum says so."""
    found = pairs_output._shared(0.62, 0.05, np.sqrt(0.62))
    check(found, np.sqrt(0.62), 0.05 / (2 * np.sqrt(0.62)), "DN", Z)
    found = pairs_output._shared(0.19, 0.05, np.sqrt(0.19))
    assert found["value"] == 0 and found["upper_limit"] == pytest.approx(np.sqrt(0.19 + Z * 0.05), rel=1e-6)
    assert pairs_output._shared(-0.19, 0.05, 0.0)["upper_limit"] == pytest.approx(np.sqrt(Z * 0.05), rel=1e-6)
    assert pairs_output._correlation(calibration())["upper_limit"] == pytest.approx(0.013 + Z * 0.02, rel=1e-6)
    found = pairs_output._linearity(calibration(clear=np.ones(4, bool)))
    assert (found["value"], found["largest"], found["levels"]) == (pytest.approx(1.4 / 3), 0.9, 3)
    curve = 0.22 * (np.array([100, 900, 1500]) + 2) * 1.0021
    assert f"by {100 * np.mean(np.abs([22, 190, 200] / curve - 1)):.2g} % about" in found["note"]
    rows = SimpleNamespace(rows=Shared(0.62, 0.05, 3.0, 1e-9))
    check(frames_output._row_noise(rows), np.sqrt(0.62), 0.05 / (2 * np.sqrt(0.62)), "DN", Z)
    rows = SimpleNamespace(rows=Shared(0.07, 0.05, 1.2, 0.02))
    assert frames_output._row_noise(rows)["upper_limit"] == pytest.approx(np.sqrt(0.07 + 2 * 0.05))


def test_findings_of_emva_captures_begin_at_their_limits():
    """Each one just above, and just below, the size that docs/calibration.md gives."""

    def named(**changed):
        return {finding.check for finding in findings(calibration(**changed))}

    curve = vars(calibration().curve)
    assert "linearity" in named()  # 0.21 %
    assert "linearity" not in named(curve=SimpleNamespace(**{**curve, "at": lambda x: 0.22 * (x + 2) * 1.0019}))
    assert "linearity" in named(curve=SimpleNamespace(**{**curve, "at": lambda x: 0.22 * (x + 2) * 0.9979}))
    assert "light offset" not in named()  # 2.0 of 0.51
    assert "light offset" in named(curve=SimpleNamespace(**{**curve, "offset": -2.05}))
    assert "light" not in named() and "light" in named(curve=SimpleNamespace(**{**curve, "light_rms": 5.1e-4}))
    assert "variance" not in named() and "variance" in named(level_rms=0.0021)
    assert "variance" not in named(level_rms=0.0021, level_chance=1.1e-4)
    assert {"row noise", "column noise"} & named() == {"row noise"}
    assert {"row noise", "column noise"} & named(row=(0.19, 0.05), col=(0.12, 0.03)) == {"column noise"}
    # columns, DN², whose error on this device is √((4 (c + 1.7/14) 0.017 + 2 · 0.017²)/21): 0.0284 and 0.0273
    for columns, is_seen in ((0.12, True), (0.10, False)):
        some = SpatialVariance(0.31, columns, 1.7, (0.011, 0.017, 0.13), (13, 21, 273))
        dark = SimpleNamespace(**{**vars(calibration().long_dark), "spatial": some})
        assert ("column pattern" in named(long_dark=dark)) is is_seen
    # levels of two frames, four degrees of freedom: χ² has a chance of 1e-4 above 23.51
    limit = np.sqrt((9.4 / (14 * 22) + 0.62 / 14 + 0.04 / 22) / 2 * 23.5127 / 4)
    black = vars(calibration().black)
    for factor in (0.999, 1.001):
        changed = SimpleNamespace(**{**black, "rms": factor * limit})
        assert ("black level" in named(black=changed)) is (factor > 1)
    # signal of the long series at 250 photons: errors of dark levels, curve, light, and of what 16 frames share
    expected = 0.22 * 252 * 1.0021
    shared = (0.12 + 0.33) / 14 + (0.05 + 0.21) / 22 + 0.02 + 0.11
    level = np.sqrt(2 * 0.002**2 + 0.03**2 + shared / 16)
    limit = 3.9 * np.hypot(level / expected, 4e-4)
    lit = vars(calibration().long_lit)
    for more in (0.99, 1.01, -0.99, -1.01):
        changed = SimpleNamespace(**{**lit, "mean": np.full((14, 22), 40 + expected * (1 + more * limit))})
        assert ("light of the long series" in named(long_lit=changed)) is (abs(more) > 1)
    # three dark pairs of different exposures, 1 DN apart, whose mean is 3.9 of its errors
    for most, is_seen in ((3.9, False), (3.9 * 1.01, True)):
        change = np.array([-1.0, 0.0, 1.0, 9.0]) + most / np.sqrt(3)
        dark = SimpleNamespace(exposure_s=np.array([0.1, 0.2, 0.3, 0.3]), change=change, missing=())
        assert ("image lag" in named(dark=dark)) is is_seen
    for size in (0.049, 0.051):
        dark = SimpleNamespace(exposure_s=np.arange(16.0), change=size + 0.04 * (-1) ** np.arange(16), missing=())
        assert ("image lag" in named(dark=dark)) is (size > 0.05)
    assert "stuck pixels" not in named()
    mean = calibration().long_lit.mean.copy()
    mean[3, 5] = 0.4
    assert "stuck pixels" in named(long_lit=SimpleNamespace(**{**lit, "mean": mean}))
    other = SimpleNamespace(**{**vars(calibration().pairs), "spatial_lit": SimpleNamespace(photons=301.0)})
    assert "light of the long series" not in named(pairs=other)  # beyond the brightest clear level


@pytest.mark.parametrize(("offset", "is_rounded", "cause"), [
    (9.0, False, "has 9 photons more than stated: an exposure that is longer"),
    (-9.0, False, "has 9 photons less than stated: an exposure that is shorter"),
    (2.2, True, "has 2.2 photons more than stated, +0.48 DN: rounding moves a dark level"),
    (-2.2, True, "has 2.2 photons less than stated, -0.48 DN: rounding moves a dark level"),
    (2.4, True, "has 2.4 photons more than stated: an exposure that is longer"),
])  # fmt: skip
def test_an_offset_of_the_light_is_told_from_a_dark_level_that_is_rounded(offset, is_rounded, cause):
    """By 0.22 DN a photon: up to half a step of the ADC, where rounding hides the dark noise."""
    curve = SimpleNamespace(**{**vars(calibration().curve), "offset": offset})
    curve.terms, curve.offset_error = np.array([0.22, 0.0, 0.0]), 0.1
    dark = SimpleNamespace(**vars(calibration().dark), least_variance=0.05)
    found = findings(calibration(curve=curve, dark=dark, dark_noise_is_rounded_off=is_rounded))
    (text,) = [one.text for one in found if one.check == "light offset"]
    assert cause in text


def test_levels_that_are_off_to_one_side_lie_on_another_curve():
    """Deviations of ten levels with one change of sign, against the same ones with nine."""
    light = np.linspace(100, 900, 10)
    signal, clear = 0.22 * (light + 2) * 1.0021, np.ones(10, bool)
    smooth = np.array([0.9, 1.3, 1.1, 0.8, 0.4, -0.5, -0.9, -1.2, -1.0, -0.9])
    curve = SimpleNamespace(**{**vars(calibration().curve), "light_rms": 6e-4})
    for away, is_alike in ((smooth, True), (np.abs(smooth) * (-1) ** np.arange(10), False)):
        variance = 0.4 + 0.05 * signal + 1 / 12 + 0.2 * away  # β₀ + β₁ I and the ADC's
        lit = lit_pairs(variance=variance, error=np.full(10, 0.2), row=np.zeros(10), high=np.zeros(10),
                        exposure_s=np.ones(10))  # fmt: skip
        found = findings(calibration(light=light, signal=signal * (1 + 6e-4 * away), clear=clear, lit=lit, curve=curve,
                                     level_rms=0.031))  # fmt: skip
        texts = {one.check: one.text for one in found}
        assert ("another curve than the polynomial of the model, 3.1 % off" in texts["variance"]) is is_alike
        assert ("scatter by 3.1 %" in texts["variance"]) is not is_alike
        assert ("0.06 % off the curve of three terms" in texts["light"]) is is_alike
        assert ("the light scatters by 0.06 %" in texts["light"]) is not is_alike


def test_missing_codes_are_listed_once_each():
    lit = lit_pairs()
    assert missing_codes(lit, lit) == []
    lit.missing = (19, 77)
    ((check_, text),) = missing_codes(lit, SimpleNamespace(missing=(3, 19)))
    assert check_ == "missing code" and text.startswith("no frame has the grey value 3, 19, 77, though")
    assert "missing code" in {one.check for one in findings(calibration(lit=lit))}
    ((_, text),) = missing_codes(SimpleNamespace(missing=tuple(range(11, 40, 4))))
    assert "11, 15, 19, 23, 27, 31 and others, though" in text


def test_findings_of_emva_captures_have_their_figures_in_their_units():
    """Each number of each text, from those given: per cent, DN, electrons."""
    given = calibration()
    curve = SimpleNamespace(
        **{**vars(given.curve), "light_rms": 0.0123, "offset": 3.0, "at": lambda x: 0.22 * (x + 2) * 1.013}
    )
    line = SimpleNamespace(cycles_per_row=0.125, cycles_per_col=0.25, rms_dn=0.37)
    spectrum = SimpleNamespace(lines=[line] * 4, correlated=True, correlation=0.045)
    lag = SimpleNamespace(exposure_s=np.arange(16.0), change=np.full(16, 0.62), least_variance=0.213, missing=())
    black = SimpleNamespace(**{**vars(given.black), "rms": 0.61})
    mean = np.full((14, 22), 112.0)
    mean[3, 5] = 0.4
    lit, dark = (SimpleNamespace(**vars(one)) for one in (given.long_lit, given.long_dark))
    lit.mean, dark.mean = mean, given.long_dark.mean.copy()
    dark.mean[1, 2:4] = 255.0
    once = SimpleNamespace(exposure_s=0.0025)
    pairs = SimpleNamespace(**{**vars(given.pairs), "is_dark_once": True, "dark": [once], "long": [0, 1, 2]})
    pairs.spatial_lit = SimpleNamespace(photons=250.0, label="250 photons")
    texts = {
        finding.check: finding.text
        for finding in findings(
            calibration(curve=curve, noise_spectrum=spectrum, dark=lag, black=black, col=(0.49, 0.03), level_rms=0.0231,
                        pairs=pairs, long_lit=lit, long_dark=dark, dark_noise_is_rounded_off=True)
        )
    }  # fmt: skip
    more = (mean.mean() - dark.mean.mean()) / (0.22 * 252 * 1.013) - 1
    noise = (9.4 / (14 * 22) + 0.62 / 14 + 0.49 / 22) / 2
    for check_, figures in {
        "linearity": f"the mean bends: {100 * (302 * 1.013 / 303 - 1):+.2g} %",
        "light offset": "has 3 photons more",
        "light": "scatters by 1.2 % from",
        "variance": "scatter by 2.3 % about the polynomial, more than chance (χ²/dof 3.2)",
        "row noise": f"rows change together from frame to frame by {np.sqrt(0.62):.3f} DN ({np.sqrt(0.62) / K:.1f} e-)",
        "column noise": f"columns change together from frame to frame by 0.7 DN ({0.7 / K:.1f} e-)",
        "interference": "0.125 periods a row and 0.25 a column has a new phase in each frame, 0.37 DN rms",
        "read noise": "a correlation of +0.045",
        "column pattern": "0.35 DN rms",
        "black level": f"changes by {np.sqrt(0.61**2 - noise):.2g} DN",
        "image lag": "is 0.62 DN brighter",
        "light of the long series": f"has {100 * more:.2g} % more light",
        "stuck pixels": "2 pixels are at full scale in the dark, 1 at 0 DN",
        "dark noise": "down to 0.213 DN²",
        "dark frames": "one exposure, 2500 µs",
        "long series": "of 3 long series in the light, that of 250 photons",
    }.items():
        assert figures in texts[check_], texts[check_]
    below = findings(calibration(long_lit=SimpleNamespace(**{**vars(given.long_lit), "mean": np.full((14, 22), 90.0)})))
    less = 100 * (1 - 50 / (0.22 * 252 * 1.0021))
    assert (
        f"has {less:.2g} % less light" in {finding.check: finding.text for finding in below}["light of the long series"]
    )


def test_histograms_of_noise_are_densities_beside_that_of_their_law():
    """20,000 values about the mean of 5 frames; their law is normal with the polynomial's variance, 1/12 and rows."""
    rng = np.random.default_rng(6)
    beta = np.array([5.0, 0.4, 30.0, 0.001, 0.0, 0.0])
    signal, t = 70.0, 0.02
    sigma = np.sqrt(beta @ [1, signal, t, signal**2, signal * t, t**2] + 1 / 12 + 0.6)
    stack = 200 + sigma * rng.standard_normal((5, 100, 200))
    series = SimpleNamespace(first=stack[0], mean=stack.mean(axis=0), frames=5)
    result = SimpleNamespace(
        fit=SimpleNamespace(beta=beta), row=(0.6, 0.1),
        pairs=SimpleNamespace(spatial_lit=SimpleNamespace(exposure_s=t)),
    )  # fmt: skip
    of_pairs = pairs_output._histogram(result, series, signal)
    moments = SimpleNamespace(frames=5, first=stack[:1], mean=stack.mean(axis=0)[None], exposures_s=[t])
    mask = np.ones((100, 200), bool)
    shared = Shared(0.6, 0.1, 9.0, 1e-9)
    of_frames = frames_output._noise_histogram(
        moments, 0, np.full(mask.shape, signal), mask, np.broadcast_to(beta, (1, 1, 6)), shared
    )
    for found in (of_pairs, of_frames):
        place, counted, predicted = found.T
        width = place[1] - place[0]
        assert place[0] - width / 2 == pytest.approx(-5 * sigma) and place.size == 2 * max(12, int(5 * sigma))
        np.testing.assert_allclose(place, -place[::-1], atol=1e-9)
        exact = (norm.cdf((place + width / 2) / sigma) - norm.cdf((place - width / 2) / sigma)) / width
        np.testing.assert_allclose(predicted, exact, rtol=1e-6, atol=1e-12)
        # a value deviates less from a mean that it is in; of the law there are 4.5 binomial errors of each bin
        edges = np.append(place - width / 2, place[-1] + width / 2)
        own = np.histogram((stack[0] - stack.mean(axis=0)) * np.sqrt(5 / 4), edges)[0] / (20_000 * width)
        np.testing.assert_allclose(counted, own, atol=2.1 / (20_000 * width))
        np.testing.assert_allclose(counted, exact, atol=4.5 * np.sqrt(exact.max() / width / 20_000))
        assert counted.sum() * width == pytest.approx(1, abs=2e-4)


@pytest.mark.parametrize(("law", "power"), [("sqrt", 1), ("linear", 2)])
def test_beta_and_noise_of_trials_have_errors_of_the_delta_method(law, power):
    """σ² = (s Iᵖ + d)/(1 + r I)² with s = β3², d = β4²; derivatives by hand."""
    names, of = trials_output.NAMES, trials_output
    covariance = np.random.default_rng(8).standard_normal((len(names), len(names)))
    covariance = covariance.T @ covariance * 1e-6
    r, s, d = 0.07, 0.0013, 0.0009
    values = np.zeros(len(names))
    values[[*likelihood.THETA, of.RESPONSE, of.SHOT, of.DARK]] = 0.21, 0.29, r, s, d
    fit = SimpleNamespace(
        values=values, covariance=covariance, law=law, free=np.ones(len(names), bool),
        value=lambda name: values[names.index(name)],
    )  # fmt: skip
    beta, error = of._beta(fit)
    sizes = np.sqrt(np.diag(covariance))
    assert beta == pytest.approx([0.25, r, 1.0, np.sqrt(s), np.sqrt(d), 0.0])
    both = np.sqrt(covariance[0, 0] + covariance[1, 1] + 2 * covariance[0, 1]) / 2
    shot, dark = sizes[of.SHOT] / (2 * np.sqrt(s)), sizes[of.DARK] / (2 * np.sqrt(d))
    assert error[:5] == pytest.approx([both, sizes[of.RESPONSE], 0.0, shot, dark]) and error[5] is None
    light = 31.0
    sigma = np.sqrt(s * light**power + d) / (1 + r * light)
    slope = np.zeros(len(names))
    slope[of.RESPONSE] = -sigma * light / (1 + r * light)
    slope[of.SHOT] = light**power / (2 * sigma * (1 + r * light) ** 2)
    slope[of.DARK] = 1 / (2 * sigma * (1 + r * light) ** 2)
    found = of._noise(fit, light)
    assert found["value"] == pytest.approx(sigma, rel=1e-4)  # with the least noise, a thousandth of θ
    assert found["standard_error"] == pytest.approx(np.sqrt(slope @ covariance @ slope), rel=1e-3)
    fit.free = np.isin(np.arange(len(names)), (of.SHOT, 0))
    assert of._noise(fit, light)["standard_error"] == pytest.approx(sizes[of.SHOT] * slope[of.SHOT], rel=1e-3)
    assert of._beta(fit)[0][4] == 0.0 and of._beta(fit)[1][4] is None


def test_figures_of_trials_are_sums_over_pixels_beside_the_mean_chance(monkeypatch):
    """Three kinds of steps, two up and one down, with two time bins; chances differ by kind, bin and threshold."""
    rng, sizes = np.random.default_rng(9), (3, 2, 5)
    steps = Trials(
        np.array([40.0, 70.0, 40.0]), np.array([0.3, 0.2, -0.4]), 1e-3, np.array([0.0, 2e-3, 7e-3]),
        rng.integers(60, 90, (3, 5)), rng.integers(0, 9, sizes), rng.integers(0, 9, sizes), (1, 5),
    )  # fmt: skip
    steady = Trials(
        np.array([11.0, 80.0]), np.zeros(2), 1e-3, np.array([0.0, 0.013]), rng.integers(60, 90, (2, 5)),
        rng.integers(0, 9, (2, 1, 5)), rng.integers(0, 9, (2, 1, 5)), (1, 5),
    )  # fmt: skip
    laws = {1: np.array([0.2, 0.5, 0.3]), -1: np.array([0.1, 0.2, 0.7])}

    def chance(signal, contrast, bin_, polarity, threshold):
        return 1e-3 * (signal + 20 * abs(contrast)) * (1 + 2 * bin_) * threshold * (1.5 if polarity < 0 else 1)

    def chances(values, there, polarity, grid, law):
        assert (values, law) == ("values", "sqrt")
        bins = range(there.edges_s.size - 1)
        return np.array([[[chance(s, c, j, polarity, v) for v in grid] for j in bins]
                         for s, c in zip(there.signal_dn, there.contrast, strict=True)])  # fmt: skip

    monkeypatch.setattr(trials_output, "chances", chances)
    monkeypatch.setattr(trials_output, "step_of", lambda values, there: 0.9 * there.contrast)
    grids = np.array([1.0, 2.0, 4.0]), np.array([1.5, 2.5, 3.0])
    fit = SimpleNamespace(
        values="values", law="sqrt", likelihood=SimpleNamespace(grids=grids),
        law_of_thresholds=lambda k: laws[1 - 2 * k],
    )  # fmt: skip
    figures = trials_output._figures(fit, steady, steps)
    wanted = []
    for polarity, kinds, grid in ((1, (0, 1), grids[0]), (-1, (2,), grids[1])):
        for j in range(2):
            for kind in kinds:
                signal, contrast = steps.signal_dn[kind], steps.contrast[kind]
                events = (steps.on if polarity > 0 else steps.off)[kind, : j + 1].sum()
                mean = sum(
                    w * chance(signal, contrast, b, polarity, v)
                    for b in range(j + 1)
                    for v, w in zip(grid, laws[polarity], strict=True)
                )
                wanted.append([polarity, signal, 0.9 * contrast, j, events, steps.calm[kind].sum(), mean])
    np.testing.assert_allclose(figures["figure_s_curves"], wanted)
    rates = [
        [signal, steady.on[k].sum(), steady.off[k].sum(), steady.calm[k].sum() * 0.013,
         *(chance(signal, 0, 0, p, grid) @ laws[p] / 0.013 for p, grid in zip((1, -1), grids, strict=True))]
        for k, signal in enumerate(steady.signal_dn)
    ]  # fmt: skip
    np.testing.assert_allclose(figures["figure_noise_rate"], rates)


def test_the_section_of_trials_has_the_mean_threshold_and_the_chances_of_its_families(monkeypatch):
    """Thresholds are correlated; maps of ON and OFF are those of their polarity."""
    names = trials_output.NAMES
    values, covariance = 0.1 + 0.03 * np.arange(9), np.diag(np.arange(1.0, 10) ** 2 * 1e-6)
    covariance[0, 1] = covariance[1, 0] = 0.7e-6
    free = np.arange(9) != likelihood.LEAK
    fit = SimpleNamespace(
        values=values, covariance=covariance, law="sqrt", free=free, value=lambda name: values[names.index(name)],
        error=lambda name: np.sqrt(covariance[names.index(name), names.index(name)]),
    )  # fmt: skip
    families = {"steps": 0.31, "times": 0.42, "steady": 0.53}
    goodness = {name: SimpleNamespace(chi2=50.0, dof=10, p_value=p) for name, p in families.items()}
    goodness["all"] = SimpleNamespace(chi2=90.0, dof=36, p_value=0.07)
    light, shape = SimpleNamespace(signal_dn=np.array([30.0, 7.0]), shape=(2, 3), of=lambda good: good), (2, 3)
    ones = np.arange(6.0)
    result = SimpleNamespace(
        fit=fit, advantage=5.1, goodness=goodness, findings=[], mismatch=SimpleNamespace(described=dict), steady=light,
        steps=light, fitted=np.arange(5), relative=(ones, ones + 10), noise=(ones + 20, ones + 30),
        defects=SimpleNamespace(
            bad=ones == 2, kind=np.where(ones == 2, Defect.HOT, 0).astype(np.uint8), on_hz=ones, off_hz=ones,
            firing_share=ones, change_hz=ones,
        ),
    )  # fmt: skip
    found = trials_output.content(result)
    check(found["theta"], 0.115, np.sqrt(1e-6 + 4e-6 + 1.4e-6) / 2, "ln")
    check(found["theta_off"], 0.13, 2e-3, "ln")
    assert (
        found["shot_law_decisive"]
        and not trials_output.content(SimpleNamespace(**{**vars(result), "advantage": -4.9}))["shot_law_decisive"]
    )
    assert found["leak_rate_hz"]["value"] == 0 and [each["signal_dn"] for each in found["noise"]] == [7, 30]
    chances = {f"{name}_p_value": p for name, p in families.items()}
    assert found["goodness"] == {"chi2_per_dof": 2.5, "dof": 36, "p_value": 0.07, **chances}
    assert (found["fitted_pixels"], found["bad_pixels"], found["defects"]["hot"]) == (5, 1, 1)
    monkeypatch.setattr(trials_output, "_figures", lambda fit, steady, steps: {"good": steady & steps})
    maps = trials_output.maps(result)
    assert maps.pop("good").tolist() == (ones != 2).tolist()
    wanted = {"threshold_on_rel": 0, "threshold_off_rel": 10, "threshold_on_noise": 20, "threshold_off_noise": 30}
    for name, offset in wanted.items():
        np.testing.assert_array_equal(maps[name], (ones + offset).reshape(shape))
    assert maps["bad_pixels"].shape == shape and maps["bad_pixels"][0, 2] and maps["bad_pixels"].sum() == 1


ENTRY = SimpleNamespace(error=SpecError)


def refused(act, text):
    """Whether it raises; the error has the text."""
    try:
        act()
    except SpecError as error:
        assert text in str(error), str(error)
        return True
    return False


@pytest.mark.parametrize(("part", "is_refused"), [(0.99, False), (1.01, True)])
def test_captures_are_refused_from_their_limits_on(part, is_refused):
    """Clipped dark pixels from 1 % on, a well from half of the variance on, tiles 8 % apart, light 2 % off."""
    pairs = SimpleNamespace(dark=[ENTRY] * 2, spatial_dark=ENTRY, spatial_lit=ENTRY, lit=[ENTRY] * 5)
    long = SimpleNamespace(temporal=SimpleNamespace(pixel=0.3))
    dark = SimpleNamespace(low=np.array([0.0, 0.01 * part]))
    act = partial(long_series.require_dark_noise, pairs, dark, long)
    assert refused(act, "1.01 % of the dark pixels are 0 DN") is is_refused
    # saturated: as bright as the level of the largest variance, 19 DN², with less than half of it
    lit = SimpleNamespace(mean=np.array([60.0, 140.0, 190.0]), variance=np.array([6.0, 19.0, 3.0]))
    long = SimpleNamespace(mean=np.full((4, 6), 141.0), temporal=SimpleNamespace(pixel=9.5 / part))
    act = partial(long_series.require_series_below_well, pairs, long, lit, 1)
    assert refused(act, "saturated, at 141 DN") is is_refused
    long = SimpleNamespace(mean=np.full((4, 6), 139.0 + part), temporal=SimpleNamespace(pixel=2.0))
    assert refused(partial(long_series.require_series_below_well, pairs, long, lit, 1), "at 140 DN") is is_refused
    long_series.require_series_below_well(pairs, long, lit, 3)  # no level is saturated
    # two places of a tile that differ by 8 % of the mean of all four, 5 rows and 7 columns: the last count nowhere
    high = np.array([[100.0, 100.0], [100.0, 100 + 8.16 * part]])  # 8 % of 102.04
    signal = np.full((5, 7), 500.0)
    signal[:4, :6] = np.tile(high, (2, 3))
    act = partial(pair_levels.require_one_colour, ENTRY, signal)
    assert refused(act, "92, 92, 92, 100 %") is is_refused
    # with a spread of a third of that and more within each place, the pixels have no colour
    pair_levels.require_one_colour(ENTRY, signal + np.random.default_rng(1).normal(0, 9.0, signal.shape))
    curve = SimpleNamespace(at=lambda light: 2.0 * light)
    light = np.array([1.0, 40.0, 60.0, 80.0, 100.0])
    off = np.array(
        [1.4, 1.0, 1 - 0.02 * part, 1.0, 1.5]
    )  # the first has 2 % of the light at most, the last is not clear
    off[0] *= 0.99
    act = partial(
        light_curve.require_steady_light, pairs, curve, light, 2 * light * off, np.array([1, 1, 1, 1, 0], bool)
    )
    assert refused(act, "this pair is 2 % off") is is_refused


def test_the_asymmetry_is_that_of_static_counts_or_of_steps_whichever_is_better_known():
    """The error of (θ₋ − θ₊)/(θ₋ + θ₊) by central differences in both thresholds."""

    def of(value, error=None):
        return SimpleNamespace(value=value, error=error)

    def ratio(on, off):
        return (off - on) / (off + on)

    on, off = of(0.2, 0.004), of(0.27, 0.011)
    h = 1e-6
    slopes = [(ratio(0.2 + a, 0.27 + b) - ratio(0.2 - a, 0.27 - b)) / (2 * h) for a, b in ((h, 0), (0, h))]
    error = np.hypot(slopes[0] * 0.004, slopes[1] * 0.011)
    for part, expected in ((0.98, 0.11), (1.02, ratio(0.2, 0.27))):
        given = SimpleNamespace(asymmetry=of(0.11, part * error), theta_on=on, theta_off=off)
        assert sensor_values._asymmetry(given) == pytest.approx(expected)
    unknown = SimpleNamespace(asymmetry=of(None), theta_on=on, theta_off=off)
    assert sensor_values._asymmetry(unknown) == pytest.approx(ratio(0.2, 0.27))
    for static, expected in ((of(0.11, 9.0), 0.11), (of(None), 0.0)):
        assert sensor_values._asymmetry(SimpleNamespace(asymmetry=static, theta_on=of(None), theta_off=off)) == expected
