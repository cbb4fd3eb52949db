"""Pairs of a pixel and a window: the same paths as Mitsuba's, whatever else is asked for at the same time."""

import gc

import numpy as np
import pytest
import rendering
from rendering import mono, pair_tracer, traced

import hesim_render as hr
from hesim_render.core.backend import jit
from hesim_render.core.host_arrays import from_host
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.pair_flux import PilotFlux, PilotRays
from hesim_render.sources.render.change_driven.windows import Windows
from hesim_render.sources.render.exact import RenderedFlux
from hesim_render.sources.render.sampling.sampler import sampler_class
from hesim_render.sources.render.scene import surfaces
from hesim_render.sources.render.scene.mitsuba_version import mitsuba
from hesim_render.sources.render.transport import moving_scene as moving
from hesim_render.sources.render.transport.intersections import meets_ball
from hesim_render.sources.scene import Scene

DIFFUSE = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.5}}
LAMP = {
    "type": "rectangle",
    "to_world": [[0.15, 0, 0, 0.8], [0, 0, -0.15, 1.6], [0, 0.15, 0, 1.2], [0, 0, 0, 1]],
    "emitter": {"type": "area", "radiance": {"type": "uniform", "value": 0.2}},
}
SKY = {"type": "constant", "radiance": {"type": "uniform", "value": 0.003}}


def sphere(position, radius, reflectance):
    columns = [[radius, 0, 0, position[0]], [0, radius, 0, position[1]], [0, 0, radius, position[2]], [0, 0, 0, 1]]
    bsdf = {"type": "diffuse", "reflectance": {"type": "uniform", "value": reflectance}}
    return {"type": "sphere", "to_world": columns, "bsdf": bsdf}


def plane(bsdf, z=0.0, half=1.0):
    placing = [[half, 0, 0, 0], [0, half, 0, 0], [0, 0, 1, z], [0, 0, 0, 1]]
    return {"type": "rectangle", "to_world": placing, "bsdf": bsdf}


@pytest.fixture
def draws_of_mitsuba(monkeypatch):
    """Random numbers in the order in which Mitsuba's path tracer takes them, and skies sampled as it does."""

    def next_vertex(self, is_first):
        light, lobe, place = self.next_2d(), self.next_1d(), self.next_2d()
        return place, lobe, light, self.next_1d()

    monkeypatch.setattr(sampler_class(mitsuba().variant()), "next_vertex", next_vertex)
    monkeypatch.setattr(moving, "spare_even_skies", lambda mi, emitters: None)


def test_balls_rule_out_no_ray_that_meets_what_is_in_them():
    """Against the roots of the quadratic in double precision; with ends before, inside and beyond the ball."""
    mi, rng, count = mitsuba(), np.random.default_rng(1), 100_000
    middle, radius = np.array([0.3, -0.2, 1.1]), 0.25
    origin = middle + rng.normal(size=(count, 3)) * rng.choice([0.1, 0.5], (count, 1))
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    length = rng.exponential(0.5, count)
    to = origin - middle
    along, rest = np.sum(to * direction, axis=1), np.sum(to**2, axis=1) - radius**2
    root = np.sqrt(np.maximum(along**2 - rest, 0))
    meets = (along**2 > rest) & (-along - root < length) & (-along + root > 0)
    ray = mi.Ray3f(mi.Point3f(*origin.T), mi.Vector3f(*direction.T))
    ball = mi.Point3f(middle), from_host(mi.Float, (1.0001 * radius) ** 2)
    found = np.array(meets_ball(ray, from_host(mi.Float, length), ball))
    assert 0.1 < meets.mean() < 0.6
    assert not np.any(meets & ~found)
    assert np.mean(found & ~meets) < 0.05  # rays that end within a radius before it


def lamps(count):
    """Small tilted lamps in a row above the wall."""
    turn = [[-0.05, 0, 0], [0, 0.04, -0.03], [0, -0.03, -0.04]]
    return {
        f"lamp{k}": {
            "type": "rectangle",
            "to_world": [[*turn[0], 0.25 * (k - count / 2)], [*turn[1], 0.2], [*turn[2], 0.9], [0, 0, 0, 1]],
            "bsdf": DIFFUSE,
            "emitter": {"type": "area", "radiance": {"type": "uniform", "value": 0.2}},
        }
        for k in range(count)
    }


LIGHTS = {"sky": {"sky": SKY}, "lamp and sky": {"lamp": LAMP, "sky": SKY}, "3 lamps": lamps(3), "12 lamps": lamps(12)}
#: Longest path in segments, and first segment with roulette.
DEPTHS = ((2, 16), (4, 16), (12, 16), (12, 3))
FAST = (("lamp and sky", (12, 3)), ("12 lamps", (2, 16)))


@pytest.mark.parametrize(
    ("light", "depth", "roulette"),
    [
        pytest.param(LIGHTS[name], *depths, id=f"{name}-{depths[0]}-{depths[1]}", marks=marks)
        for name in LIGHTS
        for depths in DEPTHS
        for marks in [() if (name, depths) in FAST else pytest.mark.slow]
    ],
)
def test_paths_are_those_of_mitsuba(light, depth, roulette, draws_of_mitsuba, monkeypatch):
    """However long they are, and whatever their last segment may run into: the same rays to the same value.

    With the roulette of a scene's own path tracer too. Nothing is seen in closed form.
    """
    monkeypatch.setattr(surfaces, "_MOST_ENTRIES", -1)
    glossy = {"type": "roughconductor", "material": "none", "alpha": 0.2}
    shapes = {"ball": sphere((0, 0, 0.3), 0.2, 0.9), "wall": plane(DIFFUSE), "mirror": plane(glossy, z=0.1, half=0.3)}
    own = {"integrator": {"type": "path", "max_depth": depth, "rr_depth": roulette}}
    scene = rendering.mitsuba_scene({**own, **shapes, **light}, [], None)
    sensor = mono(32, 24)
    exact = RenderedFlux(scene, sensor, samples=16, seed=3)
    wanted = np.array(exact.mean_flux(np.arange(32 * 24, dtype=np.uint32), 0, 0)[0])
    got = traced(pair_tracer(scene, sensor), 16, 0.0, 0.0).half_a
    assert wanted.max() > 0
    # a ray that grazes an edge may fall to the other side by rounding
    assert np.isclose(got, wanted, rtol=1e-4).mean() > 0.995
    assert np.sum(got) == pytest.approx(np.sum(wanted), rel=1e-3)


@pytest.mark.parametrize("name", ["rotating-star", pytest.param("camera-sweep", marks=pytest.mark.slow)])
def test_diffuse_surfaces_have_the_flux_of_the_exact_mode(name):
    """Both estimates against Mitsuba's own paths, in a window so short that nothing moves.

    Sums over 8×6 pixels, differences over their standard errors from both halves: beyond 5 in one of 10^5 runs; the
    light itself is in closed form here, so that edges are all that has noise.
    """
    scene, sensor = hr.load_scene(name), mono()
    exact = RenderedFlux(scene, sensor, samples=512, seed=3, max_motion_px=0.002)
    pixels = np.arange(64 * 48, dtype=np.uint32)

    def groups(half_a, half_b):
        a, b = (np.array(half, np.float64).reshape(8, 6, 8, 8).mean(axis=(1, 3)) for half in (half_a, half_b))
        return (a + b) / 2, (a - b) / 2

    tracer = pair_tracer(scene, sensor)
    for t_us in (1000.0, 777_000.0):
        wanted, their_error = groups(*exact.mean_flux(pixels, t_us, t_us))
        for controlled in (True, False):
            told = traced(tracer, 512, t_us, t_us, controlled)
            found, error = groups(told.half_a, told.half_b)
            spread = np.sqrt(np.mean(error**2) + np.mean(their_error**2))
            assert spread < 0.01 * wanted.mean()
            assert abs(np.mean(found - wanted)) < 5 * spread / found.size**0.5
            assert np.abs(found - wanted).max() < 12 * spread  # groups at edges have more noise than others


def test_a_surface_that_turns_its_back_to_the_camera_is_lit_from_the_side_that_is_seen():
    """A lamp before a sheet and a brighter one behind it: the sheet is seen in the light of the first."""
    camera = {"origin_m": [0, 0, 2], "target_m": [0, 0, 0], "horizontal_fov_deg": 22}
    lights = [
        {
            "type": "point",
            "illuminant": "D65",
            "illuminance_lux": lux,
            "position_m": [0.3, -0.2, z],
            "plane_normal": [0, 0, z],
        }
        for lux, z in ((200, 1.5), (900, -1.5))
    ]
    sheet = {"name": "sheet", "shape": "rectangle", "size_m": [2, 3, 0], "reflectance": 0.4, "rotation_axis": [0, 1, 0]}
    seen = [
        traced(pair_tracer(rendering.make_scene(objects=[{**sheet, "rotation_deg": turn}], light=on, camera=camera),
                           mono(8, 6)), 64).half_a
        for turn, on in ((0, lights[:1]), (0, lights), (180, lights))
    ]  # fmt: skip
    assert seen[0].min() > 0
    np.testing.assert_allclose(seen[1], seen[0], rtol=1e-4)
    np.testing.assert_allclose(seen[2], seen[0], rtol=2e-3)  # its rays have other places on the sheet


@pytest.mark.parametrize("mild", [False, True])
@pytest.mark.parametrize("power", [-70, 60])
def test_the_scatter_of_a_pilot_has_no_range(power, mild):
    """The mean fourth power over the mean square, or its root, by NumPy, of fluxes whose fourth powers leave float32.

    Two pairs of 32 rays: one of two kinds of 16 rays each, with means of their own, and one of a single bright ray.
    """
    types, rng = jit(), np.random.default_rng(3)
    two_kinds, one_bright = np.repeat([5.0, 3.0], 16) + rng.normal(size=32), np.where(np.arange(32) == 7, 900.0, 0.25)
    rays = np.stack([two_kinds, one_bright])
    flux = from_host(types.Float, np.ldexp(rays, power))
    met = from_host(types.UInt32, np.arange(64) == 53)  # a single ray of the second pair
    out = PilotFlux.empty(2)
    with np.errstate(all="raise"):
        out.put(slice(0, 2), flux, 2 * flux, 3 * flux, met, 32, 16, mild=mild)
    assert out.met.tolist() == [False, True]
    np.testing.assert_allclose(np.ldexp(out.unshadowed.astype(np.float64), -power), 3 * rays.mean(axis=1), rtol=1e-5)
    deviation = rays.reshape(2, 2, 16) - rays.reshape(2, 2, 16).mean(axis=2, keepdims=True)
    expected = np.sqrt((deviation**4).sum(axis=(1, 2)) / (deviation**2).sum(axis=(1, 2)) * 16 / 15)
    if mild:
        expected = np.sqrt(np.sqrt((deviation**4).mean(axis=(1, 2))) * 16 / 15)
    np.testing.assert_allclose(np.ldexp(out.controlled_scatter.astype(np.float64), -power), expected, rtol=1e-5)
    np.testing.assert_allclose(np.ldexp(out.plain_scatter.astype(np.float64), -power), 2 * expected, rtol=1e-5)
    np.testing.assert_allclose(np.ldexp(out.controlled.astype(np.float64), -power), rays.mean(axis=1), rtol=1e-5)


def test_a_pilot_says_how_much_single_rays_change():
    """Standard deviation of the differences to the same rays in another window, by NumPy, for both estimators."""
    types, rng = jit(), np.random.default_rng(4)
    now, before = 7e4 + 900 * rng.normal(size=(2, 3, 16))
    before[1] = now[1] - 350  # all rays alike: the mean changes, and nothing scatters
    fluxes = [from_host(types.Float, values) for values in (now, 0.5 * now, before, 0.3 * before)]
    rays, out = PilotRays(fluxes[2], fluxes[3], 16, (0.0, 1.0)), PilotFlux.empty(2)
    pairs = np.array([2, 0])
    some = [from_host(types.Float, np.array(values).reshape(3, 16)[pairs]) for values in fluxes[:2]]
    met = from_host(types.UInt32, np.zeros(32, np.uint32))
    out.put(slice(0, 2), *some, some[0], met, 16, 16, (rays, pairs))
    for found, difference in ((out.controlled_change, now - before), (out.plain_change, 0.5 * now - 0.3 * before)):
        np.testing.assert_allclose(found, difference[pairs].std(axis=1, ddof=1), rtol=1e-4)
    every = PilotFlux.empty(3)
    every.put(
        slice(0, 3),
        *fluxes[:2],
        fluxes[0],
        from_host(types.UInt32, np.zeros(48, np.uint32)),
        16,
        16,
        (rays, np.arange(3)),
    )
    assert every.controlled_change[1] < 0.05 and every.controlled_change[0] > 500


@pytest.mark.slow
def test_a_scene_in_units_of_its_own_is_planned_as_in_ours():
    """The same light with radiance in other units and the factor that takes them back: the same values to the bit."""

    def values(power):
        lamp = {**LAMP, "emitter": {"type": "area", "radiance": {"type": "uniform", "value": 3.0 * 2.0**power}}}
        ball = sphere([0, 0, 0.15], 0.15, 0.4) | {"bsdf": {"type": "conductor"}}
        keys = [{"t_us": 0}, {"t_us": 1000, "translation_m": [0.05, 0.01, 0]}]
        shapes = {"floor": plane(DIFFUSE), "lamp": lamp, "ball": ball}
        scene = rendering.mitsuba_scene(shapes, [{"object": "ball", "keyframes": keys}]).spec
        scaled = scene.mitsuba.model_copy(update={"radiance_scale": 2.0**-power})
        source = ChangeDrivenFlux(Scene(scene.model_copy(update={"mitsuba": scaled})), mono(16, 12), seed=3)
        pixel = np.arange(16 * 12, dtype=np.uint32)
        return np.stack([np.array(half) for half in source.mean_flux(pixel, 0.0, 700.0)])

    np.testing.assert_array_equal(values(50), values(0))


def test_a_pair_does_not_depend_on_its_company():
    tracer, rng = pair_tracer(hr.load_scene("camera-sweep"), mono()), np.random.default_rng(0)
    pixel = tracer.sensor.layout.full_index.ravel()[rng.permutation(64 * 48)]
    begin = rng.uniform(0, 5e5, pixel.size)
    samples, controlled = 2 ** rng.integers(3, 8, pixel.size), rng.random(pixel.size) < 0.5
    number = np.arange(pixel.size)
    together = tracer.trace(pixel, number, Windows(begin, begin + 1000), samples, controlled)
    some = rng.choice(pixel.size, 40, replace=False)
    alone = tracer.trace(
        pixel[some], np.arange(40), Windows(begin[some], begin[some] + 1000), samples[some], controlled[some]
    )
    for field in ("half_a", "half_b", "met"):
        np.testing.assert_array_equal(getattr(together, field)[some], getattr(alone, field))
    pilot = tracer.pilot(pixel, number, Windows(begin, begin + 1000), 16, 1.25)
    alone = tracer.pilot(pixel[some], np.arange(40), Windows(begin[some], begin[some] + 1000), 16, 1.25)
    for field in ("controlled", "plain", "unshadowed", "controlled_scatter", "plain_scatter"):
        np.testing.assert_array_equal(getattr(pilot, field)[some], getattr(alone, field))


@pytest.mark.parametrize("depth", [2, 4])
def test_one_kernel_serves_lists_of_any_length_and_alignment(depth):
    """From two pairs on."""
    import drjit as dr

    scene = hr.load_scene("rotating-star", {"max_depth": depth})
    tracer = pair_tracer(scene, mono(), 1)
    every = tracer.sensor.layout.full_index.ravel()

    def run(count, first, windows):
        pixel = every[first : first + count]
        begin = 1250.0 * np.arange(windows)
        number = np.arange(count) % windows
        span = Windows(begin, begin + 1000.0)
        tracer.trace(pixel, number, span, np.full(count, 8), np.full(count, True))
        tracer.pilot(pixel, number, span, 16, 1.25)

    def kernels(*lists):
        dr.kernel_history_clear()
        for count, first, windows in lists:
            run(count, first, windows)
        return {entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])}

    gc.collect()  # kernels list the surfaces of all scenes that are still about, those of other tests too
    run(2000, 0, 3)  # what is made once for a scene
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    try:
        known = kernels((128, 0, 2))
        assert len(known) >= 3
        assert kernels((2, 0, 1), (3, 1, 2), (77, 3, 16), (1000, 4, 100), (2500, 5, 1)) <= known
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, False)
