"""Colour errors over the pixels of a cube, against a calculation of all pixels at once."""

from types import SimpleNamespace

import numpy as np
import pytest
from test_colour_figures import samples_of_tables

import hesim_render as hr
from hesim_render.core.errors import SpecError
from hesim_render.sources.cube import planes
from hesim_render.spectral import spectrum as spectra
from hesim_render.spectral.spectrum import Spectrum
from hesim_render.studies import colour_differences, colour_samples, cube_colour, fit_matrix
from hesim_render.studies.colour_samples import reflectance_set
from hesim_render.targets.cube_file import open_cube

BANDS = np.arange(360.0, 831.0, 5.0)
STUDY = {"schema_version": 1, "name": "cube", "sensors": ["reference-bayer"], "figures": ["colour"]}


def smooth_cube(rows, cols, seed=1):
    """Reflectances of the training set, mixed."""
    table = np.array([each.at(BANDS) for each in reflectance_set("colorchecker").values()])
    weights = np.random.default_rng(seed).dirichlet(np.full(len(table), 0.3), (rows, cols))
    return (weights @ table).astype(np.float32)


def test_a_rendered_cube_has_all_bands_from_the_first_to_the_last(monkeypatch):
    """Also where (400.7 - 400)/0.1 is below 7 in double precision; 5 px wide and 3 high."""
    asked = []

    def render(scene, shape, bands, samples):
        asked.append((scene, shape, bands, samples))
        return None, np.zeros((*shape, bands.size)), None

    monkeypatch.setattr(cube_colour, "render_cube", render)
    monkeypatch.setattr(cube_colour, "load_scene", lambda file: file)
    item = SimpleNamespace(scene="s", beside=lambda name: name, bands_nm=(400.0, 400.7, 0.1), size_px=(5, 3), samples=7)
    cube = cube_colour.open_surfaces(item)
    ((scene, shape, bands, samples),) = asked
    assert (scene, shape, samples) == ("s", (3, 5), 7) and cube.shape == (3, 5, 8)
    np.testing.assert_allclose(bands, 400 + 0.1 * np.arange(8))


def responses():
    return list(hr.load_sensor("reference-bayer").responses.values())


def expected(cube, light, level=1.0):
    chart = list(reflectance_set("colorchecker").values())
    matrix = fit_matrix(colour_samples(responses(), light, chart)).matrix
    grid = np.arange(360.0, 831.0)
    surfaces = [np.interp(grid, BANDS, pixel) for pixel in cube.reshape(-1, BANDS.size)]
    curves = np.column_stack([each.at(grid) for each in responses()])
    functions = np.column_stack([each.at(grid) for each in spectra.colour_matching_functions()])
    samples = samples_of_tables(curves, light.at(grid), np.array(surfaces).T / level, functions)
    return colour_differences(samples, matrix)


def test_a_cube_of_reflectances_in_blocks(tmp_path, monkeypatch):
    cube = smooth_cube(23, 11)
    np.save(tmp_path / "cube.npy", cube)
    surfaces = [{"cube": str(tmp_path / "cube.npy"), "wavelength_nm": BANDS.tolist()}]
    study = {**STUDY, "surfaces": surfaces, "illuminants": ["A"]}
    row = hr.study(study).row(0)
    errors = expected(cube, spectra.illuminant("A"))
    assert row["delta_e_cube_mean"] == pytest.approx(errors.mean(), rel=2e-3)
    assert row["delta_e_cube_p95"] == pytest.approx(np.quantile(errors, 0.95), abs=0.05)
    assert row["delta_e_cube_max"] == pytest.approx(errors.max(), rel=1e-2)
    assert row["cube_pixels"] == 253 and row["surfaces"] == "cube"
    monkeypatch.setattr(planes, "_BLOCK_VALUES", 4 * 11 * BANDS.size)  # four rows at a time
    again = hr.study(study).row(0)
    for key in ("delta_e_cube_mean", "delta_e_cube_p95", "delta_e_cube_max"):
        assert again[key] == pytest.approx(row[key], rel=1e-6)
    monkeypatch.setattr(cube_colour, "_BIN", 0.4)  # the upper end of the bin in which the quantile lies
    coarse = hr.study(study).row(0)["delta_e_cube_p95"]
    assert coarse == pytest.approx(0.4 * np.ceil(np.quantile(errors, 0.95, method="inverted_cdf") / 0.4))


def test_a_cube_of_radiances_has_its_own_light_and_any_unit(tmp_path):
    light = spectra.illuminant("D65")
    cube = smooth_cube(20, 20, 3)
    cube[:2] = 1.0  # white in a tenth of the pixels
    radiance = (cube * light.at(BANDS) * 37.0).astype(np.float32)
    np.save(tmp_path / "radiance.npy", radiance)
    item = {"cube": str(tmp_path / "radiance.npy"), "wavelength_nm": BANDS.tolist(), "quantity": "radiance"}
    row = hr.study({**STUDY, "surfaces": [item]}).row(0)
    assert row["delta_e_cube_mean"] == pytest.approx(expected(cube, light).mean(), rel=0.01)
    item |= {"scale": 1e-3}
    assert hr.study({**STUDY, "surfaces": [item]}).row(0)["delta_e_cube_mean"] == pytest.approx(
        row["delta_e_cube_mean"], rel=3e-3
    )


def test_planes_that_hold_are_constant_beyond_their_wavelengths(tmp_path):
    """Weights sum to the whole integral, and each end has what lies beyond it."""
    np.save(tmp_path / "cube.npy", np.ones((2, 2, 4), np.float32))
    cube = open_cube(tmp_path / "cube.npy", [450, 500, 550, 600])
    triangle = Spectrum(np.array([400.0, 525.0, 650.0]), np.array([0.0, 1.0, 0.0]))
    weights = planes.integration_weights([triangle], cube, hold=True)[:, 0]
    assert weights.sum() == pytest.approx(125, rel=1e-4)
    np.testing.assert_allclose(weights, weights[::-1], rtol=1e-6)
    # below 450 nm lie 0.4·50/2 = 10; from 450 to 500 nm the first plane falls from 1 to 0
    inside = np.trapezoid((0.4 + 0.4 * np.linspace(0, 1, 2001)) * np.linspace(1, 0, 2001), np.linspace(0, 50, 2001))
    assert weights[0] == pytest.approx(10 + inside, rel=1e-3)


def test_bad_cubes_are_one_clear_line(tmp_path):
    np.save(tmp_path / "cube.npy", smooth_cube(3, 3)[..., 20:60])
    item = {"cube": str(tmp_path / "cube.npy"), "wavelength_nm": BANDS[20:60].tolist()}
    with pytest.raises(SpecError, match=r"bands from 460 to 655 nm do not cover .*beyond: hold"):
        hr.study({**STUDY, "surfaces": [item]})
    assert hr.study({**STUDY, "surfaces": [item | {"beyond": "hold"}]}).row(0)["delta_e_cube_mean"] > 0
    np.save(tmp_path / "percent.npy", 100 * smooth_cube(3, 3))
    item = {"cube": str(tmp_path / "percent.npy"), "wavelength_nm": BANDS.tolist()}
    with pytest.raises(SpecError, match=r"reflectances must lie in \[0, 1\]; these run from .* \(see scale"):
        hr.study({**STUDY, "surfaces": [item]})
    assert hr.study({**STUDY, "surfaces": [item | {"scale": 0.01}]}).row(0)["delta_e_cube_mean"] > 0
    with pytest.raises(SpecError, match="no such file"):
        hr.study({**STUDY, "surfaces": [{"cube": str(tmp_path / "none.hdr")}]})


def test_a_scene_is_rendered_into_a_cube(tmp_path):
    """It has the figures of the cube that `render_cube` makes of it."""
    bands, radiance, _ = hr.render_cube(hr.load_scene("colorchecker"), (16, 24), np.arange(380, 781, 40), 16)
    hr.write_spectral_exr(tmp_path / "rendered.exr", radiance, bands)
    scene = {"scene": "colorchecker", "size_px": [24, 16], "bands_nm": [380, 780, 40], "samples": 16, "beyond": "hold"}
    stored = {"cube": str(tmp_path / "rendered.exr"), "quantity": "radiance", "beyond": "hold"}
    rows = hr.study({**STUDY, "surfaces": [scene, stored]})
    with pytest.raises(SpecError, match="holds radiance, as it says"):
        hr.study({**STUDY, "surfaces": [stored | {"quantity": "reflectance"}]})
    assert rows["surfaces"].tolist() == ["colorchecker", "rendered"]
    for key in ("delta_e_cube_mean", "delta_e_cube_p95", "delta_e_cube_max"):
        assert rows[key][0] == pytest.approx(rows[key][1], rel=1e-9) and rows[key][0] > 0.1


def test_a_cube_in_percent_has_the_figures_of_its_reflectances(tmp_path):
    cube = smooth_cube(5, 4)
    np.save(tmp_path / "cube.npy", cube)
    np.save(tmp_path / "percent.npy", 100 * cube)
    item = {"cube": str(tmp_path / "cube.npy"), "wavelength_nm": BANDS.tolist()}
    percent = {**item, "cube": str(tmp_path / "percent.npy"), "scale": 0.01}
    one, other = (hr.study({**STUDY, "surfaces": [each], "illuminants": ["A"]}).row(0) for each in (item, percent))
    for key in ("delta_e_cube_mean", "delta_e_cube_p95", "delta_e_cube_max"):
        assert other[key] == pytest.approx(one[key], rel=1e-4) and one[key] > 0.1
