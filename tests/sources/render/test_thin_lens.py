"""Depth of field: light, blur and parallax of a thin lens, against closed forms and Mitsuba's own thin lens."""

import numpy as np
import pytest
import rendering
from mitsuba_reference import WindowReference
from mitsuba_specfilm import reference_flux
from scipy import stats

import hesim_render as hr
from hesim_render.core.backend import jit
from hesim_render.core.errors import SpecError
from hesim_render.core.host_arrays import from_host
from hesim_render.sources.render.camera import place_camera
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.primary_rays import RayFactory

WALL = {"name": "wall", "shape": "rectangle", "size_m": [40, 40, 0], "reflectance": 1.0}
LENS = {"lens__magnification": "focus", "lens__depth_of_field": True}


def furnace(focus_m=1.0):
    return rendering.make_scene(
        objects=[WALL], light=rendering.FURNACE, camera={"origin_m": [0, 0, 1], "focus_distance_m": focus_m}
    )


@pytest.mark.parametrize("f_number", [1.0, 2.8, 8.0])
def test_on_the_axis_and_in_focus_the_light_is_that_of_the_pinhole(f_number):
    """G = π/(1 + 4N²(1 + |m|)²) to 1e-4, against the integral of cos⁴ over the pupil, written out."""
    changes = {"lens__f_number": f_number, "lens__focal_length_mm": 50.0, **LENS}
    fluxes = []
    for thin in (True, False):
        sensor = rendering.mono(4, 4, **{**changes, "lens__depth_of_field": thin})
        a, b, source = rendering.flux_image(furnace(0.3), sensor, 64)
        fluxes.append((a + b).mean() / 2)
    assert abs(fluxes[0] / fluxes[1] - 1) < 1e-4
    lens = source.sensor.lens
    # v = f (1 + m), the pupil has the radius f/2N
    radius, v = 50.0 / (2 * f_number), 50.0 * 300 / 250
    r = np.linspace(0, radius, 20_001)
    solid = np.trapezoid(2 * np.pi * r * (1 + (r / v) ** 2) ** -2, r) / v**2
    assert abs(lens.solid_angle_sr / solid - 1) < 1e-6
    grid = np.arange(400, 700.01, 0.25)
    told = rendering.electrons_per_s(np.ones_like(grid), grid, np.ones_like(grid), 5.0, f_number, lens.magnification)
    assert abs(fluxes[0] / told - 1) < 2e-3  # the edges of the band are those of the file's table


@pytest.mark.parametrize("f_number", [1.4, 4.0])
def test_off_the_axis_each_ray_has_its_own_cosine_law_once(f_number):
    """A disc seen from a parallel patch beside its axis (Foote): E = πL/2 (1 − (1 + t² − a²)/√(t⁴ + 2t²(1 − a²) +
    (1 + a²)²)), t the tangent of the chief ray's angle and a that of half the cone on the axis.
    """
    changes = {"lens__f_number": f_number, "lens__focal_length_mm": 5.0, "lens__relative_illumination": "cos4", **LENS}
    sensor = hr.load_sensor("reference-mono", {key.replace("__", "."): value for key, value in changes.items()})
    corner, middle = sensor.crop(8, 8, 1016, 1016), sensor.crop(8, 8, 508, 508)
    flux = [np.mean(rendering.flux_image(furnace(), part, 256)[:2]) for part in (corner, middle)]
    v = 5.0 * 1000 / 995
    t, a = np.hypot(508, 508) * 5e-3 / v, 5.0 / (2 * f_number) / v
    exact = 0.5 * (1 - (1 + t**2 - a**2) / np.sqrt(t**4 + 2 * t**2 * (1 - a**2) + (1 + a**2) ** 2))
    on_axis = a**2 / (1 + a**2)
    assert abs(flux[0] / flux[1] / (exact / on_axis) - 1) < 1.5e-3
    chief = (1 + t**2) ** -2
    if f_number < 2:
        assert abs(exact / on_axis / chief - 1) > 0.01  # the chief ray's own law would be seen to be another


def test_a_table_of_relative_illumination_takes_the_place_of_cos4():
    table = {"image_height_mm": [0, 2.0], "illumination_rel": [1.0, 0.4]}
    sensor = hr.load_sensor("reference-mono", {
        "lens.f_number": 1.4, "lens.focal_length_mm": 5.0, "lens.magnification": "focus",
        "lens.depth_of_field": True, "lens.relative_illumination": table})  # fmt: skip
    corner, middle = sensor.crop(8, 8, 696, 508), sensor.crop(8, 8, 508, 508)
    flux = [np.mean(rendering.flux_image(furnace(), part, 64)[:2]) for part in (corner, middle)]
    y, x = np.mgrid[:8, :8] - 3.5
    mean = [np.mean(1 - 0.3 * np.hypot(x + away, y) * 5e-3) for away in (188, 0)]
    assert abs(flux[0] / flux[1] - mean[0] / mean[1]) < 1e-4


@pytest.mark.parametrize(("focus_m", "depth_m", "f_number"), [
    (0.6, 1.0, 4.0), pytest.param(2.0, 1.0, 2.8, marks=pytest.mark.slow),
    pytest.param(1e6, 1.0, 5.6, marks=pytest.mark.slow)])  # fmt: skip
def test_the_blur_circle_has_its_width_to_one_per_cent(focus_m, depth_m, f_number):
    """fx (f/N) |1/z − 1/d| from the second moments of the image of a small bright card."""
    size_m = 1e-3
    scene = rendering.make_scene(
        objects=[{"name": "dot", "shape": "rectangle", "size_m": [size_m, size_m, 0],
                  "position_m": [0, 0, 1 - depth_m], "reflectance": 1.0}],
        light={**rendering.FURNACE, "type": "directional", "direction": [0, 0, -1]},
        camera={"origin_m": [0, 0, 1], "focus_distance_m": focus_m},
    )  # fmt: skip
    a, b, _ = rendering.flux_image(scene, rendering.mono(64, 64, lens__f_number=f_number, **LENS), 4096)
    image, place = a + b, np.arange(64) - 31.5
    image_mm = 16.0 * focus_m / (focus_m - 0.016)
    fx = image_mm / 5e-3
    diameter = fx * 0.016 / f_number * abs(1 / depth_m - 1 / focus_m)
    assert 3 < diameter < 60
    own = (fx * size_m / depth_m) ** 2 / 12 + 1 / 12
    for axis in (0, 1):
        profile = image.sum(axis=axis) / image.sum()
        moment = profile @ place**2 - (profile @ place) ** 2
        # a uniform disc has the variance D²/16 along each axis; cos⁴ makes it smaller by a third of sin² of the cone
        found = 4 * np.sqrt((moment - own) / (1 - 1 / (4 * f_number**2 + 1) / 3))
        assert abs(found / diameter - 1) < 0.01


def room(move=True):
    """Things in front of, in and behind the plane in focus; two of them move."""
    things = [("near", [0.03, 0.02, 0.3], 0.05), ("middle", [-0.05, 0.01, 0.0], 0.08), ("far", [0.1, -0.05, -0.8], 0.2)]
    objects = [{"name": name, "shape": "box", "size_m": [size] * 3, "position_m": place,
                "reflectance": 0.9} for name, place, size in things]  # fmt: skip
    objects.append({**WALL, "reflectance": 0.05, "position_m": [0, 0, -1.5]})
    # at a keyframe, objects of the exact mode stand exactly where they are
    track = [{"t_us": 0}, {"t_us": 4_000, "translation_m": [0.008, -0.004, 0.0], "rotation_deg": 8},
             {"t_us": 10_000, "translation_m": [0.02, -0.01, 0.0], "rotation_deg": 20}]  # fmt: skip
    motion = [{"object": name, "keyframes": track} for name in ("near", "far")] if move else []
    return rendering.make_scene(
        objects=objects, light={"type": "directional", "illuminance_lux": 1000, "direction": (0.2, -0.3, -1)},
        camera={"origin_m": [0, 0, 1], "focus_distance_m": 1.0}, motion=motion, max_depth=2,
    )  # fmt: skip


def slow_lens(**changes):
    """50 mm at f/16 on large pixels: at the rim of this cone cos⁴ is 0.998, which Mitsuba's thin lens does not have; it
    changes a blur by a thousandth.
    """
    return rendering.mono(48, 36, **{"geometry__pitch_um": 60.0, "lens__focal_length_mm": 50.0, "lens__f_number": 16.0,
                                     "lens__relative_illumination": "none", **LENS, **changes})  # fmt: skip


def assert_same(ours, errors, reference, name):
    """z of each pixel, with Bonferroni's correction, false alarm 1e-4; and of their mean."""
    theirs, error = reference.mosaic()
    both = np.hypot(errors, error)
    seen = both > 0
    z = ((ours - theirs) / np.where(seen, both, 1))[seen]
    assert np.abs(z).max() < stats.t.isf(1e-4 / z.size / 2, 7), name
    assert abs(z.mean()) * np.sqrt(z.size) < 4.4 * 1.2, name
    assert 0.7 < np.mean(z**2) < 1.6, name


@pytest.mark.slow
def test_both_modes_agree_with_mitsubas_thin_lens():
    sensor, t_us = slow_lens(), 4_000.0
    reference = reference_flux(room(), sensor, 256, t_us, repeats=8, seed=50)
    plain = reference_flux(room(), slow_lens(lens__depth_of_field=False), 256, t_us, repeats=8)
    assert np.abs(reference.mosaic()[0] / plain.mosaic()[0] - 1).max() > 0.3  # the blur is seen
    exact = [rendering.flux_image(room(), sensor, 64, seed, t_us, t_us)[:2] for seed in range(8)]
    exact = np.concatenate([np.stack(pair) for pair in exact])
    assert_same(exact.mean(axis=0), exact.std(axis=0, ddof=1) / 4, reference, "exact")
    default = []
    for seed in range(8):
        pair = rendering.traced(rendering.pair_tracer(room(), sensor, seed), 64, t_us, t_us)
        default += [half.reshape(36, 48).astype(np.float64) for half in (pair.half_a, pair.half_b)]
    default = np.stack(default)
    assert_same(default.mean(axis=0), default.std(axis=0, ddof=1) / 4, reference, "default")


@pytest.mark.slow
def test_events_of_the_default_mode_have_the_error_that_they_state():
    """Random pairs of a pixel and a tick against Mitsuba's thin lens over the same windows: errors in noise units, as
    large as stated, and without a bias (false alarm 1e-5)."""
    sensor = slow_lens()
    flux = ChangeDrivenFlux(room(), sensor, 0.5, seed=4)
    block = next(iter(flux.sample_blocks(1000, 0, 10_000)))
    pixels = np.arange(48 * 36, dtype=np.uint32)
    windows = np.stack([block.begin_us, block.end_us], axis=1).astype(np.float64)
    found = [(np.array(s.half_a) + np.array(s.half_b)) / 2 for s in flux.flux_of_blocks(pixels, [block])]
    chosen = np.random.default_rng(2).choice(pixels.size, 150, replace=False)
    wanted = np.flatnonzero(block.wanted)
    unit = flux.noise_unit(chosen.astype(np.uint32), np.array(found)[:, chosen], True)
    told = WindowReference(room(), sensor).flux(windows[wanted], chosen, 0.1 * unit, seed=3)
    off = (np.array(found)[:, chosen] - told.flux) / unit
    assert np.sqrt(np.mean(off**2)) < 0.5
    by_pixel = off.mean(axis=0)
    assert abs(by_pixel.mean()) < 4.4 * by_pixel.std() / np.sqrt(by_pixel.size)


def test_what_moves_far_out_of_focus_changes_every_pixel_of_its_blur():
    """A spark of a hundredth of the blur circle, which few rays of a pixel meet, crosses the picture."""
    ends = [{"t_us": 0}, {"t_us": 10_000, "translation_m": [0.02, 0, 0]}]
    scene = rendering.make_scene(
        objects=[{**WALL, "reflectance": 0.02},
                 {"name": "spark", "shape": "sphere", "size_m": [0.0012] * 3, "position_m": [-0.01, 0, 0.5],
                  "reflectance": 1.0}],
        light={"type": "directional", "illuminance_lux": 50_000, "direction": (0, 0, -1)},
        motion=[{"object": "spark", "keyframes": ends}], camera={"origin_m": [0, 0, 1], "focus_distance_m": 1.0},
    )  # fmt: skip
    sensor = rendering.mono(48, 36, geometry__pitch_um=20.0, lens__f_number=1.0, **LENS)
    flux = ChangeDrivenFlux(scene, sensor, 0.5, seed=1)
    assert not flux.still_pixels(np.arange(48 * 36)).any()
    times = 1_000.0, 8_000.0
    pixels = np.arange(48 * 36, dtype=np.uint32)
    change, wanted = [], []
    for t_us in times:
        change.append(sum(np.array(half) for half in flux.mean_flux(pixels, t_us, t_us + 10)) / 2)
        a, b, _ = rendering.flux_image(scene, sensor, 1024, 9, t_us, t_us + 10)
        wanted.append(((a + b) / 2).ravel())
    found, expected = change[1] - change[0], wanted[1] - wanted[0]
    blurred = np.abs(expected) > 0.3 * np.abs(expected).max()
    assert blurred.sum() > 100
    assert np.corrcoef(found[blurred], expected[blurred])[0, 1] > 0.9
    assert abs(np.sum(found * np.sign(expected)) / np.sum(np.abs(expected)) - 1) < 0.1


def test_a_fixed_magnification_and_a_focus_distance_contradict_each_other():
    with pytest.raises(SpecError, match=r"reference-mono\.yaml:\d+: lens\.magnification: .* fixed magnification of 0,"):
        rendering.flux_image(furnace(), rendering.mono(4, 4, lens__depth_of_field=True), 4)


class Given:
    """A sampler with known numbers."""

    def __init__(self, u, v):
        self._pair = from_host(jit().Float, u), from_host(jit().Float, v)

    def next_2d(self):
        return self._pair


def test_rays_leave_the_pupil_through_the_plane_in_focus_with_the_cosine_of_their_angle_at_the_chip():
    """Positions in space, written out: the chip is a mirrored picture behind the lens."""
    sensor = hr.load_sensor("reference-mono", {
        "lens.f_number": 1.4, "lens.focal_length_mm": 6.0, "lens.magnification": "focus", "lens.depth_of_field": True,
        "lens.relative_illumination": "cos4"})  # fmt: skip
    view = place_camera(furnace(0.2).spec, sensor)
    rng = np.random.default_rng(4)
    u, v, col, row = rng.random(500), rng.random(500), rng.uniform(0, 1023, 500), rng.uniform(0, 1023, 500)
    lanes = [from_host(jit().Float, values) for values in (col, row)]
    zero = jit().Float(0)
    origin, direction, weight = RayFactory(view).through_lens(
        tuple(lanes), (zero, zero), Given(u.astype(np.float32), v.astype(np.float32))
    )
    start, way = np.array(origin, np.float64).T - [0, 0, 1], np.array(direction, np.float64).T
    image_m = 6e-3 * 200 / 194
    assert np.all(np.hypot(*start[:, :2].T) <= 3e-3 / 1.4 * (1 + 1e-5)) and np.abs(start[:, 2]).max() < 1e-6
    # uniform in sin² of the angle at the middle of the chip
    sine2 = (start[:, :2] ** 2).sum(axis=1)
    sine2 /= sine2 + image_m**2
    edge2 = (3e-3 / 1.4 / image_m) ** 2
    np.testing.assert_allclose(sine2 / (edge2 / (1 + edge2)), u, atol=1e-4)
    np.testing.assert_allclose(np.mod(np.arctan2(-start[:, 1], start[:, 0]) / (2 * np.pi), 1), v, atol=1e-4)
    shown = np.column_stack([(col - 511.5) * 5e-6, -(row - 511.5) * 5e-6]) / image_m
    met = start[:, :2] + way[:, :2] * (-0.2 / way[:, 2])[:, None]
    np.testing.assert_allclose(met, 0.2 * shown, atol=1e-6)
    # cos⁴ of the ray over that of the chief ray, and over that of the same pupil point from the middle
    chip = np.column_stack([-shown * image_m, np.full(500, image_m)])
    cosine = image_m / np.linalg.norm(start - chip, axis=1)
    chief = image_m / np.linalg.norm(chip, axis=1)
    middle = image_m / np.linalg.norm(start - [0, 0, image_m], axis=1)
    np.testing.assert_allclose(np.array(weight), (cosine / chief / middle) ** 4, rtol=2e-4)
    assert np.ptp(np.array(weight)) > 0.3


def test_the_blur_of_points_out_of_focus_grows_with_the_difference_of_their_inverse_depths():
    """A radius of f/2N · v |1/z − 1/d| in the picture, with v = f (1 + m); none with the lens of a point."""
    changes = {"lens__f_number": 2.8, "lens__focal_length_mm": 50.0, **LENS}
    scene = rendering.make_scene(
        objects=[WALL], light=rendering.FURNACE, camera={"origin_m": [0, 0, 1], "focus_distance_m": 0.3}
    )
    view = place_camera(scene.spec, rendering.mono(4, 4, **changes))
    points = np.array([[[0.01, 0.0, 0.5], [0.0, 0.02, -0.25]]])
    places, px_per_m = view.project_on_sensor(points, view.camera_to_world[None])
    focal_px = 50.0 * 300 / 250 / 5e-3
    np.testing.assert_allclose(px_per_m, [[focal_px / 0.5, focal_px / 1.25]])
    np.testing.assert_allclose(places[0], [[512 + 0.01 * focal_px / 0.5, 512], [512, 512 - 0.02 * focal_px / 1.25]])
    pupil_m = 0.05 / 2 / 2.8
    for number, depth in enumerate((0.5, 1.25)):
        radius = view.defocus_px(px_per_m[:, number : number + 1])
        assert radius == pytest.approx(pupil_m * focal_px * abs(1 / depth - 1 / 0.3))
    assert view.defocus_px(px_per_m) == pytest.approx(pupil_m * focal_px * (1 / 0.3 - 1 / 1.25))
    sharp = place_camera(scene.spec, rendering.mono(4, 4, **{**changes, "lens__depth_of_field": False}))
    assert sharp.defocus_px(px_per_m) == 0
