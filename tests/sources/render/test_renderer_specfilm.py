"""Two estimators that share no rays, wavelengths, random numbers or film agree within their errors."""

import numpy as np
import pytest
from mitsuba_specfilm import reference_flux
from rendering import flux_image, make_scene
from scipy import stats

import hesim_render as hr
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.sources.render import RenderedFlux
from hesim_render.sources.scene import Scene

LIT_ROOM = {
    "target": {"type": "colorchecker"},
    "objects": [
        {
            "name": "ball",
            "shape": "sphere",
            "size_m": (0.08, 0.08, 0.08),
            "position_m": (0.03, -0.02, 0.06),
            "reflectance": {"flat": 0.6},
            "pattern": {"flat": 0.1},
        },
        {"name": "box", "shape": "box", "size_m": (0.05, 0.05, 0.05), "position_m": (-0.08, 0.03, 0.04)},
    ],
    "camera": {"fit": "target", "fit_margin": 0.9},
    "max_depth": 3,
}
DIRECTIONAL = {"type": "directional", "illuminance_lux": 1000, "direction": (0.5, -0.6, -1)}
AREA = {
    "type": "area",
    "illuminance_lux": 1000,
    "position_m": (0.3, 0.4, 0.6),
    "size_m": (0.2, 0.2),
    "illuminant": {"illuminant": "FL11"},
}


def estimates(scene, sensor, samples, seeds):
    """Independent estimates [2 · seeds, row, col] of our own."""
    halves = [flux_image(scene, sensor, samples, seed=seed)[:2] for seed in range(seeds)]
    return np.concatenate([np.stack(pair) for pair in halves])


def assert_agreement(ours, reference):
    """Welch's z per pixel; both standard errors come from about 15 degrees of freedom."""
    theirs, error = reference.mosaic()
    own_error = ours.std(axis=0, ddof=1) / np.sqrt(len(ours))
    both = np.hypot(own_error, error)
    seen = both > 0
    assert seen.mean() > 0.5
    np.testing.assert_array_equal(ours.mean(axis=0)[~seen], theirs[~seen])  # black in both
    z = ((ours.mean(axis=0) - theirs) / np.where(seen, both, 1))[seen]
    assert abs(z.mean()) * np.sqrt(z.size) < 4.4 * 1.1  # false alarm 1e-5; var of t with 15 is 1.15
    # the worst pixel: Student's t with 15 degrees (Welch's has more), Bonferroni, false alarm 1e-4
    assert np.abs(z).max() < stats.t.isf(1e-4 / z.size / 2, 15)
    # the errors are neither too large nor too small: 1 < E z² < 15/13; 5 σ of the mean of squares
    assert abs(np.mean(z**2) - 1.08) < 0.08 + 5 * np.sqrt(3.0 / z.size)
    assert abs(ours.mean() / theirs.mean() - 1) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize(
    "light", [pytest.param(DIRECTIONAL, marks=pytest.mark.slow), AREA], ids=["directional", "area"]
)
def test_lit_objects_with_interreflection(light):
    scene = make_scene(**LIT_ROOM, light=light)
    sensor = hr.load_sensor("reference-bayer").crop(48, 32)
    assert_agreement(estimates(scene, sensor, 64, 8), reference_flux(scene, sensor, 64, repeats=16, seed=100))


@pytest.mark.slow
def test_cornell_box_off_the_axis():
    camera = {"origin_m": (0, 0, 3.9), "target_m": (0, 0, 0), "up": (0, 1, 0), "focal_length_mm": 3.0}
    scene = hr.load_scene("cornell-box", {"max_depth": 4, "camera": camera})
    sensor = hr.load_sensor("reference-bayer").crop(48, 32, 760, 420)
    ours = estimates(scene, sensor, 128, 8)
    assert_agreement(ours, reference_flux(scene, sensor, 128, repeats=16, seed=100))


@pytest.mark.slow
def test_moving_target_and_camera_at_one_instant():
    changes = {
        "motion": [
            {
                "object": "target",
                "keyframes": [{"t_us": 0}, {"t_us": 1000, "rotation_deg": 40, "translation_m": [0.02, 0, 0]}],
            },
            {"object": "camera", "keyframes": [{"t_us": 0}, {"t_us": 1000, "translation_m": [0, 0.02, 0]}]},
        ]
    }
    scene, sensor = hr.load_scene("colorchecker", changes), hr.load_sensor("reference-bayer").crop(48, 32)
    edges = RenderedFlux(scene, sensor, 2).slice_edges_us(0, 1000)
    instant = (edges[10] + edges[11]) / 2  # where the objects of that slice stand
    ours = np.concatenate([np.stack(flux_image(scene, sensor, 64, seed, instant, instant)[:2]) for seed in range(8)])
    assert_agreement(ours, reference_flux(scene, sensor, 64, instant, repeats=16, seed=50))
    still = reference_flux(scene, sensor, 64, 0.0, repeats=2)
    assert np.abs(still.mosaic()[0] / ours.mean(axis=0) - 1).max() > 0.2


def test_reference_runs_in_a_scalar_variant():
    import mitsuba as mi

    scene, sensor = make_scene(**LIT_ROOM, light=DIRECTIONAL), hr.load_sensor("reference-bayer").crop(8, 6)
    ours = estimates(scene, sensor, 256, 8)
    before = mi.variant()
    scalar = reference_flux(scene, sensor, 128, variant="scalar_spectral", repeats=16, seed=9)
    assert mi.variant() == before
    assert_agreement(ours, scalar)


def test_reference_of_darkness_and_bad_arguments():
    sensor = hr.load_sensor("reference-bayer").crop(8, 6)
    flux, error = reference_flux(hr.load_scene("dark"), sensor, 4).mosaic()
    assert np.all(flux == 0) and np.all(error == 0)
    with pytest.raises(RangeError, match="samples"):
        reference_flux(hr.load_scene("dark"), sensor, 0)
    with pytest.raises(RangeError, match="repeats"):
        reference_flux(hr.load_scene("dark"), sensor, 4, repeats=1)
    with pytest.raises(SpecError, match="variant 'scalar_rgb'"):
        reference_flux(hr.load_scene("dark"), sensor, 4, variant="scalar_rgb")
    blurred = hr.load_sensor("reference-bayer", {"lens.psf_fwhm_um": 5}).crop(8, 6)
    with pytest.raises(SpecError, match="psf_fwhm_um"):
        reference_flux(hr.load_scene("flat-field"), blurred, 4)


def test_radiance_scale_is_linear():
    sensor = hr.load_sensor("reference-bayer").crop(16, 12)
    one, three = (
        flux_image(hr.load_scene("cornell-box", {"mitsuba.radiance_scale": scale}), sensor, 8)[0] for scale in (1, 3)
    )
    np.testing.assert_allclose(three, 3 * one, rtol=1e-5)
    assert isinstance(hr.load_scene("cornell-box"), Scene)
