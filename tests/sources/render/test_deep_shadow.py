"""Looks with many rays at sites in deep shadow: where, in which windows, and what a run is worth with them."""

from dataclasses import replace
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
from rendering import make_scene
from test_change_driven import fluxes, noisy

import hesim_render as hr
from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven import adaptive
from hesim_render.sources.render.change_driven.adaptive import AdaptiveRenderer
from hesim_render.sources.render.change_driven.deep_shadow import DeepShadow, deep_shadow
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.neighbours import Lattice, Sites
from hesim_render.sources.render.change_driven.pair_flux import PilotFlux
from hesim_render.sources.render.change_driven.pair_tracer import PairTracer
from hesim_render.sources.render.change_driven.pilot import Pilot
from hesim_render.sources.render.change_driven.plan import plan
from hesim_render.sources.render.change_driven.tuning import TUNING, Gain
from hesim_render.sources.render.change_driven.windows import Windows

#: Numbers of the sites on the sensor; windows of a block are numbered from 3 on.
INDEX, FIRST = np.array([12, 17, 40, 41, 88], np.uint32), 3
#: Unshadowed light and that which the pilot sees of it, e⁻/s: less than 1/32.
OPEN, SEEN = 9000.0, 250.0


class Looking:
    """A tracer whose rays see the light [window, site], by the plain estimator."""

    def __init__(self, light):
        self.light, self.traced = light, []

    def pilot(self, index, window, windows, rays, width_px, stream):
        assert (rays, width_px, stream, windows.size) == (256, 1.4, Stream.RENDER_ZOOM, self.light.shape[0] + FIRST)
        pairs = window - FIRST, np.searchsorted(INDEX, index)
        self.traced += zip(*(each.tolist() for each in pairs), strict=True)
        got = PilotFlux.empty(index.size)
        got.plain[:], got.controlled[:] = self.light[pairs], -7
        return got


def wanted_error(flux):
    """An error of 8 e⁻/s, 1024 of which are 8192; more where the pilot saw more."""
    return np.where(flux > 200, 8.0, 4.0).astype(np.float32)


def looked(count=17, near=True, **sites):
    """Deep shadow of five sites, of which `s3=(seen, unshadowed)` are told; all others are too bright. Each may be one
    value per window.
    """
    rng = np.random.default_rng(7)
    light = rng.uniform(0, 400, (count, INDEX.size)).astype(np.float32)
    seen, unshadowed = (np.full(light.shape, OPEN, np.float32) for _ in range(2))
    for name, (some, every) in sites.items():
        seen[:, int(name[1:])], unshadowed[:, int(name[1:])] = some, every
    tracer = Looking(light)
    begin = np.arange(count + FIRST) * 1250.0
    numbers = np.repeat(np.arange(count)[:, None] + FIRST, INDEX.size, axis=1)
    near = np.ones(INDEX.size, np.bool_) & near
    given = Sites.alone(INDEX), numbers, Windows(begin, begin + 1000), (seen, unshadowed), near, wanted_error, 1.4
    return tracer, deep_shadow(tracer, *given, replace(TUNING, deep_looks=9))


@pytest.mark.parametrize(("count", "looks"), [
    (17, [0, 2, 4, 6, 8, 10, 12, 14, 16]), (65, [0, 8, 16, 24, 32, 40, 48, 56, 64]), (3, [0, 1, 2]),
    (9, list(range(9))), (12, [0, 1, 3, 4, 6, 7, 8, 10, 11]),
])  # fmt: skip
def test_light_lies_on_straight_lines_between_looks(count, looks):
    """Nine windows of a block at most, both ends among them."""
    tracer, deep = looked(count, s1=(SEEN, OPEN), s4=(SEEN, OPEN))
    assert sorted(tracer.traced) == [(window, site) for window in looks for site in (1, 4)]
    assert deep.place.tolist() == [1, 4] and deep.flux.shape == (count, 2) and deep.flux.dtype == np.float32
    for which, site in enumerate((1, 4)):
        truth = np.interp(np.arange(count), looks, tracer.light[looks, site])
        np.testing.assert_allclose(deep.flux[:, which], truth, rtol=1e-5)


@pytest.mark.parametrize(("seen", "unshadowed", "is_deep"), [
    (SEEN, OPEN, True), (0.0, OPEN, True), (OPEN / 32 * 0.99, OPEN, True), (OPEN / 32 * 1.01, OPEN, False),
    (SEEN, 8192 * 1.001, True), (SEEN, 8192 * 0.999, False), (SEEN, 8192, True), (OPEN / 32, OPEN, False),
    (100.0, 4096 * 1.001, True), (100.0, 4096 * 0.999, False),
])  # fmt: skip
def test_deep_shadow_is_dark_and_could_be_bright(seen, unshadowed, is_deep):
    """Less than 1/32 of the light is seen, and all of it is 1024 wanted errors of what is seen, or more."""
    tracer, deep = looked(s2=(seen, unshadowed))
    assert (deep is not None) == is_deep == bool(tracer.traced)
    if is_deep:
        assert deep.place.tolist() == [2]


def test_nothing_is_looked_at_where_nothing_may_change():
    near = np.array([True, False, True, False, True])
    _, deep = looked(near=near, s1=(SEEN, OPEN), s2=(SEEN, OPEN), s3=(SEEN, OPEN))
    assert deep.place.tolist() == [2]
    tracer, deep = looked(near=near, s1=(SEEN, OPEN), s3=(SEEN, OPEN))
    assert deep is None and not tracer.traced


def test_one_look_at_deep_shadow_is_enough():
    """In any window of a look, even the first or the last; both criteria in the same window, and in no other."""
    for window, is_deep in ((0, True), (6, True), (16, True), (7, False), (15, False)):
        seen = np.full(17, OPEN)
        seen[window] = SEEN
        tracer, deep = looked(s3=(seen, OPEN))
        assert (deep is not None) == is_deep
        # all looks are taken then
        assert len(tracer.traced) == (9 if is_deep else 0)
    # dark where it cannot be bright, and bright where it can
    dark = np.arange(17) < 8
    assert looked(s3=(np.where(dark, SEEN, OPEN), np.where(dark, 8100, OPEN)))[1] is None
    assert looked(s3=(np.where(dark, SEEN, OPEN), np.where(dark, 8300, OPEN)))[1] is not None
    # by the error that is wanted in this window
    assert looked(s3=(np.where(dark, OPEN, 100), np.where(dark, OPEN, 4200)))[1] is not None


# ---- where it is done ---------------------------------------------------------------------------


@pytest.mark.parametrize(("apart", "windows", "is_looked_at"), [
    (True, 3, True), (True, 17, True), (True, 2, False), (True, 1, False), (False, 17, False),
])  # fmt: skip
def test_pixels_that_lie_apart_are_looked_at_in_a_block(monkeypatch, apart, windows, is_looked_at):
    """Their rays count as those of the pilot; what the steady estimator saw decides."""
    rng = np.random.default_rng(4)
    tables = [rng.uniform(50, 90, (windows, 5)).astype(np.float32) for _ in range(5)]
    tables[2][:], tables[3][:] = 9, 3
    near, tracer = rng.random(5) < 0.5, SimpleNamespace(rays_done=400)
    monkeypatch.setattr(adaptive, "take_pilot", lambda *_: (Pilot(*tables), near))

    def looks(*given):
        tracer.rays_done += 3000
        assert given[0] is tracer and given[1] is band.sites and given[2] is numbers and given[3] is times
        np.testing.assert_array_equal(given[4][0], tables[1])
        np.testing.assert_array_equal(given[4][1], tables[4])
        assert given[5] is near and given[7] == 1.75 and given[8] is TUNING
        np.testing.assert_allclose(given[6](np.float32([100, 40])), [0.6 * 10, 0.6 * 4])
        return "deep"

    monkeypatch.setattr(adaptive, "deep_shadow", looks)
    own = SimpleNamespace(
        tracer=tracer, tuning=TUNING, counts=SimpleNamespace(pilot_rays=70), _footprint_px=lambda band: 1.75,
        zoom=SimpleNamespace(sites=lambda *_: ()), has_ticks=False,
        _sensor=SimpleNamespace(spec=SimpleNamespace(geometry=SimpleNamespace(cols=20))),
    )  # fmt: skip
    band = SimpleNamespace(
        sites=Sites.alone(INDEX),
        apart=apart,
        pilot_rays=32,
        quality=0.6,
        mild=True,
        few_first=False,
        unit=lambda flux: flux / np.float32(10),
    )
    times, numbers = Windows(np.arange(windows) * 4.0, np.arange(windows) * 4.0 + 3), np.zeros((windows, 5), int)
    pilot, got = AdaptiveRenderer.pilot(own, band, times, numbers, None)
    assert got is near and pilot.deep == ("deep" if is_looked_at else None)
    assert own.counts.pilot_rays == 70 + (3000 if is_looked_at else 0)


@pytest.mark.parametrize(("name", "has_ticks"), [("gen2", True), ("davis346", False), ("imx264", True)])
def test_windows_without_a_tick_are_not_all_looked_at(name, has_ticks):
    source = ChangeDrivenFlux(lamp_behind_a_plate(), hr.load_sensor(name).crop(16, 8), seed=4)
    assert source.has_ticks == has_ticks and source._renderer.look_stride == (1 if has_ticks else TUNING.look_stride)


@pytest.mark.parametrize("follows", [True, False])
def test_changes_of_deep_shadow_are_rendered(follows):
    """Of 7×5 sites on a lattice that lie apart, 3×3 are listed; the pilot of all sees no change but in one of them."""
    lattice = Lattice(5, 7, (1, 2), (4, 4), 30)
    row, col = np.indices((3, 3)).reshape(2, 9) + np.array([[1], [2]])
    sites = Sites.around(lattice.index(row, col), lattice)
    assert sites.apart and sites.size == 25
    flux = np.full((9, 25), 300, np.float32)
    site = sites.listed[[2, 7]]
    flux[5:, site[1]] += 20
    # what counts, 0.7 · 3 · 0.5 · 10
    counts = 0.7 * 3 * 0.5 * 10
    deep = np.zeros((9, 2), np.float32)
    deep[3:, 0] = 1.2 * counts
    deep[6, 1] = 1.2 * counts
    deep[:, 1] += 40
    nothing = np.zeros_like(flux)
    pilot = Pilot(flux, flux, nothing, nothing, flux, deep=DeepShadow(site, deep))
    given = sites, lambda each: np.full_like(each, 10), 0.5, Gain(*TUNING.diffuse_gain), TUNING, True, follows
    got = plan(pilot, *given)
    expected = np.zeros((9, 9), np.bool_)
    expected[[0, 8]] = True
    # a sudden step: the window before it too
    expected[2:4, 2] = True
    # the pilot's change as before
    expected[[4, 5, 5, 6, 7], 7] = True
    np.testing.assert_array_equal(got.rendered, expected)
    assert not got.asked.any()
    # errors that differ from site to site: the wanted error of the own one counts
    units = np.where(np.arange(25) == site[0], 13, 10).astype(np.float32)
    got = plan(pilot, given[0], lambda each: units, *given[2:])
    expected[2:4, 2] = False
    np.testing.assert_array_equal(got.rendered, expected)


# ---- a scene ------------------------------------------------------------------------------------


def lamp_behind_a_plate():
    """A plate hides all of a panel but a thin strip, which grows evenly from 0 to 3 % within a block of 16 ticks.

    The camera sees a small part of a wall below the plate; there the strip appears at different times.
    """
    wall = {"name": "wall", "shape": "rectangle", "size_m": [3, 3, 0], "position_m": [0, 0, 0], "reflectance": 0.4}
    plate = {"name": "plate", "shape": "rectangle", "size_m": [1, 1, 0], "position_m": [0, 0, 0.5], "reflectance": 0.1}
    keys = [{"t_us": 0, "translation_m": [0.033, 0, 0]}, {"t_us": 20_000, "translation_m": [0.026, 0, 0]}]
    return make_scene(
        objects=[wall, plate],
        light={"type": "area", "illuminant": "LED-B3", "illuminance_lux": 2000, "position_m": [0.848, 0, 1],
               "size_m": [0.3, 0.3], "plane_point_m": [0, 0, 0], "plane_normal": [0, 0, 1]},
        camera={"origin_m": [0, 0, 0.3], "target_m": [0, 0, 0], "horizontal_fov_deg": 1.2},
        motion=[{"object": "plate", "keyframes": keys}],
    )  # fmt: skip


def run_of(sensor, deep=True, known=False):
    """Flux of all ticks, [tick, pixel], the source, and the calls of the pilot, (rays, stream, pairs); with the plate's
    shadow in closed form, if it is `known`.
    """
    source, calls = ChangeDrivenFlux(lamp_behind_a_plate(), sensor, seed=4), []
    own = source._tracer.pilot

    def pilot(index, window, windows, rays, width_px, stream=Stream.RENDER_PILOT, *given, **more):
        calls.append((rays, stream, index.size))
        return own(index, window, windows, rays, width_px, stream, *given, **more)

    source._tracer.pilot = pilot
    knows = mock.patch.object(PairTracer, "knows_shadows", known)
    with knows, mock.patch.object(adaptive, "deep_shadow", deep_shadow if deep else lambda *_: None):
        return fluxes(source, 0, 20_000).mean(axis=1), source, calls


def deep_looks(calls):
    return sum(pairs for rays, stream, pairs in calls if (rays, stream) == (256, Stream.RENDER_ZOOM))


def test_pixels_in_deep_shadow_follow_their_light():
    """Against 4096 rays in each tick: without the looks a pixel is a straight line, 15 noise units off."""
    sensor = hr.load_sensor("gen2", {"evs.threshold_mismatch_rel": 0.02}).crop(32, 16)
    some, source, calls = run_of(sensor)
    none, other, without = run_of(sensor, deep=False)
    pixels, ends = source.sensor.layout.evs_pixel.ravel(), np.arange(1, 17) * 1250.0
    window, count = np.repeat(np.arange(16), pixels.size), 16 * pixels.size
    index = np.tile(source._renderer.index[pixels], 16)
    rays = np.full(count, 4096), np.zeros(count, np.bool_)
    truth = source._tracer.trace(index, window, Windows(ends - 1000, ends), *rays).mean.reshape(16, -1)
    unit = np.array([source.noise_unit(pixels, each, True) for each in truth])
    off, straight = (some - truth) / unit, (none - truth) / unit
    assert np.abs(straight).max() > 12 and np.sqrt(np.mean(straight**2)) > 3
    assert np.abs(off).max() < 6 and np.sqrt(np.mean(off**2)) < 0.8
    # a shadow in closed form needs no such looks, and fewer rays
    exact, third, calls_then = run_of(sensor, known=True)
    beside = (exact - truth) / unit
    assert np.abs(beside).max() < 2.5 and np.sqrt(np.mean(beside**2)) < 0.65 and deep_looks(calls_then) < 60
    assert third.counts.rays < source.counts.rays / 2
    # the reference of an audit knows the shadow as well
    before, seen = third._tracer.rays_done, np.tile(pixels, 16)
    reference = third.reference_flux(seen, ends[window] - 1000, ends[window], 0.25, True)[0].reshape(16, -1)
    assert np.sqrt(np.mean(((reference - truth) / unit) ** 2)) < 0.65
    assert third._tracer.rays_done - before < 400 * count
    # where it is worst, the block begins in the dark
    dark = np.argmax(np.abs(straight).max(axis=0))
    assert truth[2, dark] == 0 and truth[-1, dark] > 25 * unit[-1, dark]
    np.testing.assert_allclose(none[:14, dark], none[13, dark] * np.arange(1, 15) / 14, rtol=1e-5)
    # 60 sites, 32 of them listed
    deep = (256, Stream.RENDER_ZOOM, TUNING.deep_looks * 60)
    assert calls.count(deep) == 1 and deep not in without
    assert source.counts.pilot_rays > other.counts.pilot_rays + TUNING.deep_looks * 60 * 256 // 2


def test_sensors_without_gaps_take_no_such_looks():
    _, source, calls = run_of(noisy(8, 6))
    assert source.counts.pilot_rays > 0 and {(rays, stream) for rays, stream, _ in calls} <= {
        (16, Stream.RENDER_PILOT), (8, Stream.RENDER_DETECTOR)
    }  # fmt: skip
