"""A twin against held-out captures: of a camera of NumPy, and, where they are at hand, real ones."""

import json
import os
import re
import warnings
from types import SimpleNamespace
from xml.etree import ElementTree

import emva_camera
import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.stats import kstest
from typer.testing import CliRunner

from hesim_render.calibrate import calibrate_aps, read_calibration
from hesim_render.calibrate.aps.long_series import Long
from hesim_render.calibrate.aps.pairs import evaluate
from hesim_render.calibrate.aps.spatial import Temporal
from hesim_render.cli.commands import app
from hesim_render.core.drawing import logarithmic
from hesim_render.core.errors import OutputError, SpecError
from hesim_render.recording.pair_set import read_pair_set
from hesim_render.twin import comparison, figures, make_twin, page
from hesim_render.twin.comparison import Check
from hesim_render.twin.figures import bin_edges, counts_in, spectrum
from hesim_render.twin.simulated import TwinBench

REAL = os.environ.get("HESIM_EMVA1288_CCD")
#: All that the twin's model has, at once.
CAMERA = emva_camera.Camera(
    rows=72, cols=104, bend=-0.05, late_us=23.0, column_noise=0.9, correlation=0.12, hum=0.9, light_scatter=4e-4,
    long_frames=16, exposures_us=tuple(float(t) for t in np.linspace(400, 24_000, 14).round()),
)  # fmt: skip


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    return CAMERA.write(tmp_path_factory.mktemp("twin") / "captures", 8)


@pytest.fixture(scope="module")
def found(captures, tmp_path_factory):
    return make_twin(captures, tmp_path_factory.mktemp("twin") / "out", seed=3)


def test_a_twin_passes_on_what_it_was_not_fitted_on(found):
    assert found.passed, [(c.name, c.worst, c.limit) for c in found.checks if not c.passed]
    names = {check.name for check in found.checks}
    assert {"mean, lit", "temporal variance, lit", "spectrum of rows, dark", "defects, histogram, lit"} <= names
    assert {f"spatial variance, {part}, lit" for part in ("row", "column", "pixel", "total")} <= names
    assert len(names) == 20


def test_z_scores_are_not_far_too_small_either(found):
    """Errors that are twice the true ones would halve all z: of several values, their rms is 0.5 at least."""
    many = [check for check in found.checks if check.z.size >= 6 and not check.name.startswith("defects")]
    assert np.median([check.rms for check in many]) > 0.6


def test_the_files_hold_what_was_found(found):
    assert {f.name for f in found.folder.iterdir()} >= {"calibration.yaml", "sensor.yaml", "twin.json", "twin.html"}
    data = json.loads((found.folder / "twin.json").read_text(encoding="utf-8"))
    assert data["passed"] and [c["name"] for c in data["checks"]] == [c.name for c in found.checks]
    page = (found.folder / "twin.html").read_text(encoding="utf-8")
    assert page.count("<svg") == sum(check.z.size > 1 for check in found.checks)
    for text in page.split("<svg")[1:]:
        ElementTree.fromstring("<svg" + text.split("</svg>")[0].replace("xlink:", "") + "</svg>")
    assert read_calibration(found.folder / "calibration.yaml")["aps"]["K"]["value"] == pytest.approx(0.37, rel=0.1)


#: What a wrong twin has, and the checks that must tell.
WRONG = {
    "gain": ({"aps.system_gain_dn_per_e": 0.45}, {"mean, lit"}),
    "read noise": ({"aps.beta": [[[16.0, 0.36, 0.0, 0.0, 0.0, 0.0]]]}, {"temporal variance, dark"}),
    "rows": ({"aps.row_noise_dn": 0.2}, {"temporal row variance, dark"}),
    "columns": ({"aps.column_noise_dn": 0.1}, {"temporal column variance, dark"}),
    "curve": ({"aps.nonlinearity": [0.0, -0.2, 0.0]}, {"mean, lit"}),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name == "gain" else pytest.mark.slow) for name in WRONG]
)
def test_a_wrong_twin_fails_where_it_is_wrong(captures, tmp_path, monkeypatch, name):
    from hesim_render.sensor.sensor import load_sensor
    from hesim_render.twin import run

    monkeypatch.setattr(run, "page", lambda checks, texts: "")  # its drawings take most of the time
    changes, expected = WRONG[name]
    monkeypatch.setattr(run, "load_sensor", lambda file: load_sensor(file, changes))
    twin = make_twin(captures, tmp_path / "out", seed=3)
    assert expected <= {check.name for check in twin.checks if not check.passed}
    assert not twin.passed and json.loads((twin.folder / "twin.json").read_text(encoding="utf-8"))["passed"] is False


def test_the_command_tells_each_check_and_its_status(captures, tmp_path):
    out = tmp_path / "out"
    result = CliRunner().invoke(
        app, ["calibrate", "twin", str(captures), "--out", str(out), "--seed", "3", "--json", "--quiet"]
    )
    assert result.exit_code == 0, result.output
    facts = json.loads(result.stdout)
    assert facts["passed"] and len(facts["checks"]) == 20
    assert {"linearity", "interference"} <= {finding["check"] for finding in facts["findings"]}
    with pytest.raises(OutputError, match="exists"):
        make_twin(captures, out)


def test_a_series_too_short_for_two_halves_is_refused(tmp_path):
    folder = CAMERA.but(rows=24, cols=30, long_frames=6).write(tmp_path / "short", 1)
    with pytest.raises(SpecError, match="a series of fewer than 8 frames has no two halves"):
        make_twin(folder, tmp_path / "out")
    assert not (tmp_path / "out").exists() and [p.name for p in tmp_path.iterdir()] == ["short"]


def test_too_few_pairs_for_two_halves_are_refused(tmp_path):
    """Nine are the fewest; of more, every second one may saturate where all of them are enough."""
    few = CAMERA.but(rows=24, cols=30, exposures_us=tuple(np.linspace(500.0, 4000, 8))).write(tmp_path / "few", 1)
    with pytest.raises(SpecError, match="8 lit pairs; a twin is fitted to every second one, and 9 are the fewest"):
        make_twin(few, tmp_path / "out")
    bright = CAMERA.but(rows=24, cols=30, exposures_us=tuple(np.linspace(3000.0, 30_000, 12))).write(tmp_path / "b", 1)
    evaluate(read_pair_set(bright))
    with pytest.raises(SpecError, match="only 4 of 6 lit exposures, of every second one, are clear of saturation, and"):
        make_twin(bright, tmp_path / "out")


@pytest.mark.slow
def test_the_limit_is_exceeded_as_often_as_it_says():
    """One of a thousand right checks fails, whatever its number of values: of 20,000, 20 ± 4.5."""
    rng = np.random.default_rng(2)
    for size in (1, 25):
        zero = np.zeros(size)
        failed = sum(
            not Check("x", "", "", zero, zero, rng.standard_normal(size), np.ones(size)).passed for _ in range(20_000)
        )
        assert abs(failed - 20) < 5 * np.sqrt(20)


def test_many_small_deviations_fail_together():
    """25 values that are all 1.6 errors off: none is beyond its limit, but their rms is."""
    zero = np.zeros(25)
    check = Check("x", "", "", zero, zero, zero + 1.6, np.ones(25))
    assert np.all(np.abs(check.z) < check.limit) and not check.passed
    assert Check("x", "", "", zero, zero, zero + 1.6, np.ones(25), 2).passed  # errors that are hardly known


def test_the_bench_has_the_light_of_the_captures(captures):
    """Electrons: quantum efficiency times photons, with those of the longer exposure; none in the dark."""
    result = evaluate(read_pair_set(captures))
    assert result.curve.offset == pytest.approx(CAMERA.photons(CAMERA.late_us), rel=0.6)
    bench = TwinBench(None, result, np.array([[1.0, 0.9]]), 1)
    per_photon = result.responsivity.slope / result.gain.slope
    expected = per_photon * (700.0 + result.curve.offset) * np.array([[1.0, 0.9]])
    np.testing.assert_allclose(bench.electrons(700.0), expected, rtol=1e-12)
    assert not bench.electrons(0.0).any()


@pytest.mark.parametrize(("pixel", "shared"), [(1.7, 0.013), (0.09, 0.021)])
def test_errors_of_a_spectrum_are_those_of_its_noise(pixel, shared):
    """A fixed pattern and 400 noises, mostly of pixels or of what rows share: the scatter of each band over its stated
    error follows χ."""
    rng = np.random.default_rng(5)
    rows, cols = 40, 96
    pattern = 0.8 * rng.standard_normal((rows, cols)) + 0.3 * rng.standard_normal(cols)
    found = []
    for _ in range(400):
        noise = np.sqrt(pixel) * rng.standard_normal((rows, cols)) + np.sqrt(shared) * rng.standard_normal(cols)
        found.append(spectrum(pattern + noise, pixel, shared, 1))
    power, error = np.array([f.power for f in found]), np.array([f.error for f in found])
    ratio = power.std(axis=0, ddof=1) / np.sqrt(np.mean(error**2, axis=0))
    # 400 draws: 3.5 % of a standard deviation each, more where the law is exponential
    assert np.all(np.abs(ratio - 1) < 0.25) and abs(ratio.mean() - 1) < 0.05


def test_a_hot_pixel_is_taken_out_of_spectra_with_its_noise():
    """Its value becomes that of its row and column, and the others' noise is that of the mean."""
    rng = np.random.default_rng(7)
    rows, cols = rng.standard_normal((12, 1)), rng.standard_normal(20)
    variance = np.full((12, 20), 2.5, np.float32)
    hot = np.zeros((12, 20), bool)
    hot[3, 4] = hot[7, 4] = True
    series = Long(
        mean=5.0 + rows + cols + 60 * hot, variance=variance + 300 * hot, first=None, frames=10, levels=None,
        temporal=Temporal(5.0, 0.3, 0.2, 0.0, 0.1, 0.1), spatial=None, spectrum=None,
    )  # fmt: skip
    found = figures.without_defects(series, hot)
    good = ~hot
    np.testing.assert_array_equal(found.mean[good], series.mean[good])
    # a row that lacks one column has the others' mean
    np.testing.assert_allclose(found.mean[hot], (5.0 + rows + cols)[hot], atol=0.4)
    assert found.spatial.noise[2] == pytest.approx((5.0 - 2 * 300 / 240) / 10)
    assert figures.without_defects(series, np.zeros((12, 20), bool)) is series


def test_bins_of_deviations_tell_common_pixels_apart_where_a_few_are_hot():
    """A hundred pixels reach a hundred times as far as all others, which still have many bins of equal width."""
    a, b = np.abs(np.random.default_rng(1).standard_normal((2, 80, 90)))
    a[3], b[3] = np.linspace(5, 400, 90), np.linspace(5, 400, 90)
    edges = bin_edges(a, b)
    assert np.sum(edges < 3) > 10 and np.sum(edges > 20) >= 2
    assert (counts_in(a, edges) + counts_in(b, edges)).min() >= 32


def test_bins_of_deviations_are_not_empty_and_hold_every_pixel():
    rng = np.random.default_rng(1)
    a, b = np.abs(rng.standard_normal((80, 90))), np.abs(rng.standard_normal((80, 90)))
    a[3, 4] = 40.0  # a defect of one image alone
    edges = bin_edges(a, b)
    counts = counts_in(a, edges) + counts_in(b, edges)
    assert counts.sum() == a.size + b.size and counts.min() >= 32 and np.isinf(edges[-1])


@pytest.mark.skipif(REAL is None, reason="HESIM_EMVA1288_CCD names no folder of the reference set 001")
@pytest.mark.slow
def test_the_twin_of_a_real_ccd_passes(tmp_path):
    """On exposures and frames it was not fitted on; the z of its lit means and variances are those of a normal law."""
    twin = make_twin(REAL, tmp_path / "twin")
    assert twin.passed, [(c.name, c.worst, c.limit) for c in twin.checks if not c.passed]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for check in twin.checks[:4]:
            assert kstest(check.z, "norm").pvalue > 1e-3
    calibrate_aps(REAL, tmp_path / "calibration.yaml")


def test_spectra_have_their_frequencies_and_the_noise_of_the_other_direction(monkeypatch):
    """Bands of 16 columns are those of 1/16 to 8/16 periods; what columns share is less than it was by the pixels'."""
    image = np.random.default_rng(1).standard_normal((10, 16))
    assert spectrum(image, 0.3, 0.1, 1).cycles == pytest.approx(np.arange(1, 9) / 16)
    given = []
    monkeypatch.setattr(figures, "spectrum", lambda *values: given.append(values[1:]))
    series = SimpleNamespace(spatial=SimpleNamespace(noise=(0.08, 0.06, 0.48)), mean=image)
    figures.spectra(series, 2.0)
    assert [axis for *_, axis in given] == [1, 0]
    assert np.ravel([noise for *noise, _ in given]) == pytest.approx([0.12, 0.015 - 0.12 / 10, 0.12, 0.02 - 0.12 / 16])


def test_errors_of_lit_and_dark_checks_are_sums_of_squares_by_hand():
    """Unlike numbers in every part: bench, fit, and noise of captures and of twin; of five levels three are compared,
    as the twin saturates in one and one is brighter than the fitted light by more than 5 %."""
    t = np.array([0.002, 0.007, 0.002, 0.011, 0.005])
    levels = lambda **given: SimpleNamespace(exposure_s=t, **given)  # noqa: E731
    light = np.array([100.0, 250.0, 820.0, 850.0, 400.0])
    real = SimpleNamespace(
        lit=levels(photons=light, clear=np.ones(5, bool), mean=np.array([54.0, 130.0, 409.0, 1, 1]),
                   variance=np.array([21.0, 53.0, 160.0, 1, 1]), error=np.array([0.3, 0.5, 1.1, 1, 1])),
        dark=levels(mean=np.array([40.0, 41, 40, 43, 42]), variance=np.array([9.0, 9.5, 9.0, 9.9, 9.2]),
                    error=np.array([0.10, 0.13, 0.10, 0.19, 0.11])),
    )  # fmt: skip
    twin = SimpleNamespace(
        lit=levels(photons=light, clear=np.array([1, 1, 1, 1, 0], bool), mean=np.array([53.0, 128.0, 413.0, 2, 2]),
                   variance=np.array([22.0, 50.0, 166.0, 2, 2]), error=np.array([0.2, 0.7, 0.9, 2, 2])),
        dark=levels(mean=np.array([40.5, 41.2, 40, 43.4, 41]), variance=np.array([9.1, 9.2, 9.0, 9.5, 9.6]),
                    error=np.array([0.07, 0.09, 0.07, 0.23, 0.17])),
    )  # fmt: skip
    root = np.random.default_rng(4).standard_normal((6, 6)) * np.array([1, 0.1, 30, 0.01, 2, 500])
    beta = np.array([8.7, 0.37, 60.0, 1e-4, 0.9, 800.0])
    result = SimpleNamespace(
        light=np.array([90.0, 150, 200, 260, 300, 500, 800, 999]), clear=np.arange(8) < 7, row=(0.6, 0.05),
        curve=SimpleNamespace(at=lambda x: 0.5 * x + 3, error=lambda x: 1e-3 * x, light_rms=0.004,
                              covariance=np.diag([0.1, 0.2, 0.0])),
        black=SimpleNamespace(rms=0.21, error_at=lambda s: 0.03 + 4 * s, groups=4), level_rms=0.013,
        noise=SimpleNamespace(rms=0.08, error_at=lambda s: 0.02 + 3 * s),
        fit=SimpleNamespace(covariance=root.T @ root, beta=beta, identified=np.array([1, 1, 1, 1, 0, 0], bool)),
    )  # fmt: skip
    held = SimpleNamespace(shape=(6, 10), has_photons=True)
    found = {check.name: check for check in comparison._temporal(result, held, real, twin)}

    use, s = slice(0, 3), t[:3]
    x = 0.5 * light[use] + 3
    lit = found["mean, lit"]
    np.testing.assert_array_equal(lit.places, light[use])
    own = real.lit.variance[use] / 60 + 0.6 / 6
    wanted = np.sqrt((0.004 * x) ** 2 + 0.21**2 + (1e-3 * light[use]) ** 2 + (0.03 + 4 * s) ** 2 + own)
    np.testing.assert_allclose(lit.error, wanted, rtol=1e-12)
    np.testing.assert_allclose(lit.z, (twin.lit.mean - real.lit.mean)[use] / wanted, rtol=1e-12)
    design = [np.ones(3), x, s, x**2, x * s, s**2]  # 1, I, t, I², I t, t²
    slope = np.stack(design, axis=1)
    of_fit = np.diag(slope @ result.fit.covariance @ slope.T)
    wanted = np.sqrt(
        real.lit.error[use] ** 2 + twin.lit.error[use] ** 2 + of_fit + (0.013 * (slope @ beta)) ** 2 + 2 * 0.08**2
    )
    np.testing.assert_allclose(found["temporal variance, lit"].error, wanted, rtol=1e-10)
    # seven clear levels less two terms of the curve, or three of the polynomial beyond the constant
    assert found["mean, lit"].freedom == found["temporal variance, lit"].freedom == 4

    once = [0, 4, 1, 3]  # each exposure, in their order
    np.testing.assert_allclose(found["mean, dark"].places, [2, 5, 7, 11])
    wanted = np.sqrt(2 * 0.21**2 + (0.03 + 4 * t[once]) ** 2)
    np.testing.assert_allclose(found["mean, dark"].error, wanted, rtol=1e-12)
    wanted = np.sqrt(real.dark.error[once] ** 2 + twin.dark.error[once] ** 2 + 2 * 0.08**2 + (0.02 + 3 * t[once]) ** 2)
    dark = found["temporal variance, dark"]
    np.testing.assert_allclose(dark.error, wanted, rtol=1e-12)
    np.testing.assert_array_equal(dark.twin - dark.real, (twin.dark.variance - real.dark.variance)[once])
    assert dark.freedom == found["mean, dark"].freedom == 3


def test_what_rows_and_columns_share_is_compared_by_means_over_the_exposures():
    """Errors of both means and of the fit: by the scatter of three exposures, but no less than each pair's own, which
    is all that two exposures tell.
    """
    t = np.array([0.001, 0.004, 0.004, 0.009])
    row, col = (
        np.array([[1.0, 2.0, 7.0, 1.6], [1.5, 2.5, 9.0, 2.9]]),
        np.array([[0.1, 0.7, 3, 0.3], [0.2, 0.4, 5, 0.9]]),
    )
    own = np.array([0.7, 0.2, 9.0, 0.4])
    real, twin = (
        SimpleNamespace(dark=SimpleNamespace(exposure_s=t, row=row[k], col=col[k], row_error=own, col_error=1.3 * own))
        for k in (0, 1)
    )
    result = SimpleNamespace(row=(0.0, 0.11), col=(0.0, 0.23))
    mean = (0.49 + 0.04 + 0.16) / 3
    for check, values, fitted, each in zip(
        comparison._shared(result, real, twin), (row, col), (0.11, 0.23), (mean, 1.69 * mean), strict=True
    ):
        some = values[:, [0, 1, 3]]
        wanted = np.sqrt(np.sum(np.maximum(some.var(axis=1, ddof=1), each) / 3) + fitted**2)
        assert check.error == pytest.approx(wanted) and check.freedom == np.inf and check.places.shape == (1,)
        assert (check.real[0], check.twin[0]) == pytest.approx(tuple(some.mean(axis=1)))
    real.dark.exposure_s = twin.dark.exposure_s = np.array([0.001, 0.004, 0.004, 0.004])
    two = (0.49 + 0.04) / 2  # of the mean of two pairs, for captures and twin
    wanted = [np.sqrt(two + 0.11**2), np.sqrt(1.69 * two + 0.23**2)]
    assert [check.error[0] for check in comparison._shared(result, real, twin)] == pytest.approx(wanted)


def test_spatial_checks_are_relative_to_each_ones_own_signal(monkeypatch):
    """Variances of lit series are divided by the square of the signal, and so are their errors; all three add up."""
    rng = np.random.default_rng(3)
    errors = {name: rng.uniform(1, 2, 4) for name in ("real", "twin", "own")}

    def half(name, dark, lit):
        def series(level, parts):
            spatial = SimpleNamespace(
                parts=parts, total=sum(parts), errors=lambda fixed: errors[name] if fixed else None
            )
            return SimpleNamespace(spatial=spatial, mean=level + rng.standard_normal((20, 30)))

        return comparison.Half(None, None, series(dark, (0.3, 0.2, 1.1)), series(lit, (0.7, 0.4, 2.3)))

    real, twin, own = half("real", 30, 130), half("twin", 40, 240), half("own", 20, 170)
    powers = []

    def spectra(series, scale):
        powers.append(scale)
        some = figures.SpatialSpectrum(np.array([0.1, 0.2]), np.array([1.0, 2.0]), np.array([3.0, 4.0]) * len(powers))
        return {"rows": some, "columns": some}

    monkeypatch.setattr(comparison, "without_lines", lambda series, _: series)
    monkeypatch.setattr(comparison, "without_defects", lambda series, defects: series)
    monkeypatch.setattr(comparison, "spectra", spectra)
    result = SimpleNamespace(
        lit=None, dark=None, long_dark=own.long_dark, long_lit=own.long_lit, noise_spectrum=None, defects=None,
        pairs=SimpleNamespace(spec=SimpleNamespace(full_scale_dn=4095)),
    )  # fmt: skip
    found = {check.name: check for check in comparison._spatial(result, real, twin)}
    signal = [h.long_lit.mean.mean() - h.long_dark.mean.mean() for h in (real, twin, own)]
    assert powers == pytest.approx([1, 1, 1, *signal])
    for k, (part, value) in enumerate((("row", 0.7), ("column", 0.4), ("pixel", 2.3), ("total", 3.4))):
        check = found[f"spatial variance, {part}, lit"]
        assert (check.real[0], check.twin[0]) == pytest.approx((value / signal[0] ** 2, value / signal[1] ** 2))
        each = [errors[name][k] / f**2 for name, f in zip(("real", "twin", "own"), signal, strict=True)]
        assert check.error[0] == pytest.approx(np.sqrt(np.sum(np.square(each))))
        dark = found[f"spatial variance, {part}, dark"]
        assert dark.error[0] == pytest.approx(np.sqrt(sum(values[k] ** 2 for values in errors.values())))
    np.testing.assert_allclose(found["spectrum of rows, dark"].error, np.sqrt(1 + 4 + 9) * np.array([3, 4]))
    counts = found["defects, histogram, lit"]
    assert counts.real.sum() == counts.twin.sum() == 600
    np.testing.assert_allclose(counts.error, np.sqrt(np.maximum(counts.real + counts.twin, 1)))


def test_interference_is_taken_out_of_image_and_noise():
    """A wave of 3 and 5 periods in a picture of 12 by 20, and one of half a period a column: nothing else is lost."""
    rng = np.random.default_rng(6)
    row, col = np.mgrid[:12, :20]
    rest = np.fft.rfft2(rng.standard_normal((12, 20)))
    rest[3, 5] = rest[2, 10] = rest[-2, 10] = 0
    rest = np.fft.irfft2(rest, (12, 20))
    waves = 0.7 * np.cos(2 * np.pi * (3 * row / 12 + 5 * col / 20) + 0.4)
    waves += 0.5 * np.cos(2 * np.pi * 2 * row / 12 + 0.2) * (-1.0) ** col
    lines = [
        SimpleNamespace(cycles_per_row=3 / 12, cycles_per_col=5 / 20, rms_dn=0.9),
        SimpleNamespace(cycles_per_row=2 / 12, cycles_per_col=0.5, rms_dn=0.6),
    ]
    temporal = Temporal(4.0, 0.3, 0.2, 0.0, 0.1, 0.1)
    series = Long(
        mean=rest + waves,
        spatial=None,
        temporal=temporal,
        variance=np.full((12, 20), 4.5),
        first=None,
        frames=14,
        levels=None,
        spectrum=None,
    )
    found = figures.without_lines(series, SimpleNamespace(lines=lines))
    np.testing.assert_allclose(found.mean, rest, atol=1e-12)
    assert found.temporal.pixel == pytest.approx(4.0 - 0.9**2 - 0.6**2) and series.temporal.pixel == 4.0
    assert found.spatial.noise[2] == pytest.approx((4.0 - 0.9**2 - 0.6**2) / 14)


def test_deviations_are_from_rows_columns_and_surroundings():
    """Rows, columns and a slope leave nothing; one bright pixel deviates by itself, less its part of row and column."""
    row, col = np.mgrid[:40, :50]
    image = 0.3 * (row % 7) + 0.2 * (col % 3) + 11.0
    np.testing.assert_allclose(figures.deviations(image), 0, atol=1e-12)
    noise = 0.01 * np.random.default_rng(2).standard_normal(image.shape)
    plain, image = image + noise, image + noise
    image[17, 23] += 6.0
    found = figures.deviations(image)
    # clipped at five deviations it adds 5 · 0.01/225 to its own surroundings
    assert found[17, 23] == pytest.approx(6.0 * (1 - 1 / 40 - 1 / 50 + 1 / 2000), abs=0.05)
    assert np.median(found) == pytest.approx(0.6745 * 0.01, rel=0.1)
    far = np.abs(row - 17) + np.abs(col - 23) > 60
    np.testing.assert_allclose(found[far & (row != 17)], figures.deviations(plain)[far & (row != 17)], atol=0.02)


def test_no_two_frames_of_a_bench_have_the_same_noise():
    """Numbers of frames go on over pairs and series; a dark series is read twice, for its spectrum."""
    drawn = []

    def sample(electrons, exposure_us, seed, frame):
        drawn.append((exposure_us, seed, frame))
        return np.random.default_rng(frame).integers(40, 60, electrons.shape).astype(np.uint16)

    result = SimpleNamespace(
        responsivity=SimpleNamespace(slope=0.2), gain=SimpleNamespace(slope=0.5), curve=SimpleNamespace(offset=0.0)
    )
    bench = TwinBench(SimpleNamespace(aps=SimpleNamespace(sample=sample)), result, np.ones((12, 16)), 5)
    series = lambda lit, count, s: SimpleNamespace(  # noqa: E731
        lit=lit, files=[None] * count, exposure_s=s, photons=300.0 if lit else None, where=None
    )
    like = SimpleNamespace(
        spatial_dark=series(False, 9, 0.004), spatial_lit=series(True, 11, 0.007), shape=(12, 16), has_photons=True,
        spec=SimpleNamespace(full_scale_dn=1023),
    )  # fmt: skip
    list(bench.frames(0.0, 0.001, 2))
    bench.long(like, False)
    bench.long(like, True)
    list(bench.frames(0.0, 0.001, 2))
    own = [(0.001, 2), (0.004, 9), (0.004, 9), (0.007, 11), (0.001, 2)]
    assert [t for t, *_ in drawn] == pytest.approx([1e6 * t for t, count in own for _ in range(count)])
    numbers = [frame for *_, frame in drawn]
    assert numbers == [1, 2, *range(3, 12), *range(3, 12), *range(12, 23), 23, 24]
    assert {seed for _, seed, _ in drawn} == {5}


def test_the_page_counts_the_statistics_that_pass():
    """Two of three; each has a row, and a drawing if it has more than one value."""
    places = np.array([3.0, 5.0, 9.0])

    def check(name, z, count=3):
        made = SimpleNamespace(
            name=name, unit="DN", place="exposure, s", places=places[:count], real=4 + places[:count],
            twin=4.1 + places[:count], z=np.array(z), worst=max(z, key=abs), limit=3.1, rms=1.2, most_rms=1.9,
            passed=abs(max(z, key=abs)) < 3.1,
        )  # fmt: skip
        return made

    checks = [check("mean, lit", [0.4, -2.2, 1.0]), check("spread", [1.3], 1), check("mean, dark", [0.1, 4.4, -0.3])]
    text = page.page(checks, ["a bend"])
    assert re.search(r"\b2\s+of\s+3\s+statistics\s+pass", text) and text.count("<svg") == 2 and "a bend" in text
    assert [page.check_line(one)[:4] for one in checks] == ["pass", "pass", "FAIL"]
    assert ", at exposure 5 s; rms" in page.check_line(checks[0])
    checks[0].place = "photons per pixel"
    assert ", at 5 photons per pixel; rms" in page.check_line(checks[0])


def test_a_logarithmic_axis_of_equal_values_has_numbers_that_differ():
    figure = Figure()
    axes = figure.subplots()
    axes.plot([0.3, 1000.0], [1239.4, 1239.6])
    logarithmic(axes, "x", "y")
    figure.canvas.draw()
    low, high = axes.get_ylim()
    assert (low, high) == pytest.approx((619.8, 2479), rel=1e-3)
    labels = axes.yaxis.get_ticklabels() + axes.yaxis.get_ticklabels(minor=True)
    texts = sorted((one.get_position()[1], one.get_text()) for one in labels if low < one.get_position()[1] < high)
    assert [text for _, text in texts] == ["700", "1000", "2000"]
    assert axes.get_xlim()[0] < 0.3 and axes.get_xlim()[1] < 3000


def test_a_logarithmic_axis_of_a_spectrum_has_numbers_that_can_be_read():
    """A spectrum from 1.3e-5 to 2.1e-4 has one power of ten in it, and one number tells nothing."""
    places = np.linspace(0.013, 0.49, 7)
    values = np.array([2.1e-4, 1.7e-5, 1.5e-5, 1.4e-5, 1.3e-5, 1.4e-5, 1.35e-5])
    check = comparison.Check("columns", "relative²", "periods per pixel", places, values, 1.02 * values, 0.1 * values)
    drawn = page.page([check], [])
    assert {">2e-5<", ">5e-5<", ">1e-4<", ">2e-4<"} <= set(re.findall(r">[1-9]e-[45]<", drawn))


def test_bins_of_deviations_reach_seven_medians_evenly_and_the_largest_in_equal_ratios():
    image = np.concatenate([np.linspace(0, 12, 4001), np.geomspace(14, 3000, 4000)])
    middle = float(np.median(image))
    edges = bin_edges(image[:5000], image[5000:])
    even, ratios = edges[edges < 7.0001 * middle], edges[edges > 6.9999 * middle][:-1]
    np.testing.assert_allclose(np.diff(even), 7 * middle / 18)
    np.testing.assert_allclose(ratios[1:] / ratios[:-1], (3000 / (7 * middle)) ** (1 / 8))
    assert even.size == 19 and ratios.size == 8 and np.isinf(edges[-1])
    # thin bins are joined with the next: 16 pixels of each image on average
    thin = np.concatenate([np.full(500, 0.5), np.full(31, 1.5), np.full(40, 3.2), [3.5]])
    edges = bin_edges(thin)
    assert (counts_in(thin, edges) >= 32).all() and edges.size == 3
