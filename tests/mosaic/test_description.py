"""Colour description of mosaics of one, two and three colours, by its own conditions."""

import json

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.mosaic.description import _colour_matrices, describe
from hesim_render.recording import manifest
from hesim_render.spectral import spectrum as spectra
from hesim_render.spectral.colorimetry import responses_to, tristimulus, xyz_to_linear_srgb

PATCHES = list(spectra.colorchecker_reflectances().values())


@pytest.mark.parametrize("channels", [("green", "red"), ("red", "green", "blue")])
@pytest.mark.parametrize("light", [None, "A"])
def test_matrices_of_several_colours_are_those_of_least_squares(channels, light):
    responses = [hr.load_sensor("reference-bayer").responses[name] for name in channels]
    light = spectra.illuminant(light) if light else None
    neutral, to_srgb, from_xyz = map(np.array, _colour_matrices(responses, light))
    light, daylight, white = light or spectra.illuminant("D65"), spectra.illuminant("D65"), [spectra.constant(1.0)]
    grey = responses_to(light, white, responses)[0]
    np.testing.assert_allclose(neutral, grey / grey.max(), rtol=1e-12)
    # white stays white, and no change that keeps it so makes the squared differences smaller
    np.testing.assert_allclose(to_srgb.sum(axis=1), 1.0, rtol=1e-12)
    camera = responses_to(light, PATCHES, responses) / grey
    rest = camera @ to_srgb.T - xyz_to_linear_srgb(tristimulus(light, PATCHES), tristimulus(light, white)[0])
    np.testing.assert_allclose((camera[:, 1:] - camera[:, :1]).T @ rest, 0, atol=1e-9)
    xyz = tristimulus(daylight, PATCHES) / tristimulus(daylight, white)[0, 1]
    camera = responses_to(daylight, PATCHES, responses)
    np.testing.assert_allclose(xyz.T @ (xyz @ from_xyz.T - camera / camera.max()), 0, atol=1e-9)


def test_a_sensor_of_one_colour_is_grey():
    neutral, to_srgb, from_xyz = _colour_matrices(list(hr.load_sensor("reference-mono").responses.values()), None)
    assert neutral == [1.0] and to_srgb == [[1.0]] * 3
    white = tristimulus(spectra.illuminant("D65"), [spectra.constant(1.0)])[0]
    # the white of D65 has the response 1, whichever of X, Y and Z a light has it by
    assert np.shape(from_xyz) == (1, 3) and np.ptp(from_xyz) == 0 and np.array(from_xyz)[0] @ white == pytest.approx(1)


@pytest.mark.parametrize("name", ["reference-mono", "reference-bayer", "gen2", "davis346"])
def test_files_do_not_depend_on_the_last_digits_of_a_fit(name, monkeypatch):
    """Builds of NumPy for other Pythons bring other builds of LAPACK; DNG files and manifests have the same bytes."""
    sensor = hr.load_sensor(name)

    def described():
        made = manifest.build(sensor, scene=None, seed=5, duration_us=3000, settings={})["mosaic"]
        return json.dumps(made), len(made["channels"])

    exact, calls = np.linalg.lstsq, []

    def other_build(*given, **options):
        solution, *rest = exact(*given, **options)
        calls.append(solution.shape)
        wobble = np.resize([3, -2, 5, -7], solution.shape) * np.finfo(np.float64).eps
        return solution * (1 + wobble), *rest

    before = described()
    monkeypatch.setattr(np.linalg, "lstsq", other_build)
    assert described() == before
    assert len(calls) == (3 if before[1] > 1 else 1)  # matrices of colours, and the noise of frames


def test_a_sensor_without_frames_has_levels_that_need_no_care():
    made = describe(hr.load_sensor("dvs128"))
    found = made.bit_depth, made.black_level_dn, made.white_level_dn, made.system_gain_dn_per_e
    assert found == (1, 0.0, 1, 1.0)
