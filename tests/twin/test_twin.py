"""A twin against held-out captures: of a camera of NumPy, and, where they are at hand, real ones."""

import json
import os
import warnings
from types import SimpleNamespace
from xml.etree import ElementTree

import emva_camera
import numpy as np
import pytest
from scipy.stats import kstest
from typer.testing import CliRunner

from hesim_render.calibrate import calibrate_aps, read_calibration
from hesim_render.calibrate.aps.pairs import evaluate
from hesim_render.cli.commands import app
from hesim_render.core.errors import OutputError, SpecError
from hesim_render.recording.pair_set import read_pair_set
from hesim_render.twin import figures, make_twin
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

    changes, expected = WRONG[name]
    monkeypatch.setattr(run, "load_sensor", lambda file: load_sensor(file, changes))
    twin = make_twin(captures, tmp_path / "out", seed=3)
    assert expected <= {check.name for check in twin.checks if not check.passed}


def test_the_command_tells_each_check_and_its_status(captures, tmp_path):
    out = tmp_path / "out"
    result = CliRunner().invoke(
        app, ["calibrate", "twin", str(captures), "--out", str(out), "--seed", "3", "--json", "--quiet"]
    )
    assert result.exit_code == 0, result.output
    facts = json.loads(result.stdout)
    assert facts["passed"] and len(facts["checks"]) == 20
    with pytest.raises(OutputError, match="exists"):
        make_twin(captures, out)


def test_a_series_too_short_for_two_halves_is_refused(tmp_path):
    folder = CAMERA.but(rows=24, cols=30, long_frames=6).write(tmp_path / "short", 1)
    with pytest.raises(SpecError, match="a series of fewer than 8 frames has no two halves"):
        make_twin(folder, tmp_path / "out")
    assert not (tmp_path / "out").exists() and [p.name for p in tmp_path.iterdir()] == ["short"]


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


def test_errors_of_a_spectrum_are_those_of_its_noise():
    """A fixed pattern and 400 noises: the scatter of each band over its stated error follows χ."""
    rng = np.random.default_rng(5)
    rows, cols, pixel, shared = 40, 96, 1.7, 0.013
    pattern = 0.8 * rng.standard_normal((rows, cols)) + 0.3 * rng.standard_normal(cols)
    found = []
    for _ in range(400):
        noise = np.sqrt(pixel) * rng.standard_normal((rows, cols)) + np.sqrt(shared) * rng.standard_normal(cols)
        found.append(spectrum(pattern + noise, pixel, shared, 1))
    power, error = np.array([f.power for f in found]), np.array([f.error for f in found])
    ratio = power.std(axis=0, ddof=1) / np.sqrt(np.mean(error**2, axis=0))
    # 400 draws: 3.5 % of a standard deviation each, more where the law is exponential
    assert np.all(np.abs(ratio - 1) < 0.25) and abs(ratio.mean() - 1) < 0.05


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
