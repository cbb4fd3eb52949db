"""Few rays that tell in which ticks pixels without neighbours show anything new, and pilots that are used again."""

from types import SimpleNamespace

import numpy as np
import pytest
from test_change_driven import fluxes
from test_differences import shadow_scene

import hesim_render as hr
from hesim_render.core.backend import jit
from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven import pilot as pilots
from hesim_render.sources.render.change_driven.adaptive import AdaptiveRenderer
from hesim_render.sources.render.change_driven.change_detector import FirstLook, windows_with_changes
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.neighbours import Sites
from hesim_render.sources.render.change_driven.pair_flux import PilotFlux, PilotRays
from hesim_render.sources.render.change_driven.pilot import Anchored, take_pilot
from hesim_render.sources.render.change_driven.windows import Windows

#: Wanted error, e⁻/s; a pixel is even up to twice this scatter, and a fifth of it is a change.
WANTED = 30.0
COUNT, SITES = 10, 7


class Detected:
    """A tracer of pixels with the flux `light` [window, site]: the plain estimator is brighter by 5, and the set of
    rays with number 1 does not see what changes in site 4.
    """

    camera = None

    def __init__(self, light, scatter=(40.0, 70.0), near=True):
        self.light, self.scatter, self.near, self.traced = light, scatter, near, []
        self.rays, self.parts = SimpleNamespace(spreads=False), SimpleNamespace(groups=[])

    def pilot(self, index, window, windows, rays, width_px, stream=Stream.RENDER_PILOT, span_us=None, before=None,
              repeat=0):  # fmt: skip
        pairs = zip(window.tolist(), index.tolist(), strict=True)
        self.traced += [(int(stream), rays, width_px, repeat, *pair) for pair in pairs]
        found = PilotFlux.empty(index.size)
        light = self.light[window, index]
        if repeat == 1:
            light = np.where(index == 4, self.light[0, index], light)
        found.controlled[:], found.plain[:] = light, light + 5
        found.controlled_scatter[:], found.plain_scatter[:] = self.scatter
        found.met[:] = self.near
        return found

    def looked(self, rays):
        return sorted((window, index) for *_, count, _, _, window, index in self.traced if count == rays)


def light_of(**changes):
    """Flux of all sites in all windows; `s3=(5, 12.0)` changes site 3 in window 5 by 12."""
    light = np.full((COUNT, SITES), 800.0, np.float32)
    for name, (window, by) in changes.items():
        light[window, int(name[1:])] += by
    return light


def found_by(light, even=True, controlled=True):
    tracer, every = Detected(light), np.ones(SITES, bool)
    first = FirstLook(every & controlled, every & even, np.full(SITES, 6.0, np.float32))
    numbers = np.repeat(np.arange(COUNT)[:, None], SITES, axis=1)
    windows = Windows(np.arange(COUNT) * 4.0, np.arange(COUNT) * 4.0 + 3)
    window, place = windows_with_changes(tracer, np.arange(SITES, dtype=np.uint32), numbers, windows, first, 1.6)
    return tracer, sorted(zip(window.tolist(), place.tolist(), strict=True))


def test_windows_beside_a_change_are_looked_at():
    """A change of 7 counts and one of 5 does not; the first and the last window are no part of this."""
    _, found = found_by(light_of(s3=(5, -7.0), s1=(4, 5.0), s2=(1, 90.0), s6=(9, 90.0)))
    assert found == [(1, 2), (2, 2), (4, 3), (5, 3), (6, 3)]


def test_windows_take_turns_between_two_sets_of_rays():
    """Sites of even windows are seen by the second set, which misses a change of site 4; eight rays each, once in the
    first window.
    """
    tracer, found = found_by(light_of(s4=(6, 90.0), s5=(6, 90.0)))
    assert found == [(5, 5), (6, 5), (7, 5)]
    _, found = found_by(light_of(s4=(5, 90.0)))
    assert found == [(4, 4), (5, 4), (6, 4)]
    sets = {(repeat, window) for _, _, _, repeat, window, _ in tracer.traced}
    assert sets == {(0, w) for w in (0, 1, 3, 5, 7)} | {(1, w) for w in (0, 2, 4, 6, 8)}
    assert len(tracer.traced) == len(sets) * SITES
    assert {each[:3] for each in tracer.traced} == {(int(Stream.RENDER_DETECTOR), 8, 1.6)}


def test_pixels_whose_rays_differ_are_looked_at_in_all_windows():
    even = np.arange(SITES) != 3
    tracer, found = found_by(light_of(s1=(2, 50.0)), even=even)
    assert found == sorted([(1, 1), (2, 1), (3, 1), *((window, 3) for window in range(1, COUNT - 1))])
    assert 3 not in {index for *_, index in tracer.traced}


def test_a_first_look_takes_the_estimator_of_less_scatter():
    """Even up to a scatter of 60; a fifth of the wanted error counts as a change, or what rounding explains if more."""
    first = PilotFlux.empty(4)
    first.controlled_scatter[:], first.plain_scatter[:] = (59, 61, 90, 90), (70, 70, 61, 59)
    flux = np.array([800, 800, 800, 4e6], np.float32)
    seen = FirstLook.of(flux, first, lambda value: np.full(value.shape, WANTED, np.float32))
    assert seen.controlled.tolist() == [True, True, False, False] and seen.even.tolist() == [True, False, False, True]
    np.testing.assert_allclose(seen.least, [6, 6, 6, 40], rtol=1e-6)
    some = seen.at(np.array([3, 1]))
    assert some.even.tolist() == [True, False] and some.least[0] == pytest.approx(40)


def pilot_by(tracer, rays, anchored=None, known=None, span_us=None, stride=1):
    sites = Sites.alone(np.arange(SITES, dtype=np.uint32))
    numbers = np.repeat(np.arange(COUNT)[:, None], SITES, axis=1)
    windows = Windows(np.arange(COUNT) * 4.0, np.arange(COUNT) * 4.0 + 3)
    given = sites, windows, numbers, rays, 1.6, span_us

    def wanted(flux):
        return np.full(flux.shape, WANTED, np.float32)

    return take_pilot(tracer, *given, anchored=anchored, known=known, stride=stride, wanted=wanted)[0]


def test_a_pilot_of_many_rays_looks_where_few_see_a_change_and_at_the_end():
    light = light_of(s3=(5, 44.0), s6=(9, 71.0))
    tracer = Detected(light)
    pilot = pilot_by(tracer, 32)
    np.testing.assert_array_equal(pilot.controlled, light)
    ends = [(window, site) for window in (0, 9) for site in range(SITES)]
    assert tracer.looked(32) == sorted([*ends, (4, 3), (5, 3), (6, 3)]) and tracer.looked(8)
    # as many rays as the detector has would not be worth its rays; nor does it look at a sensor without a tick
    for rays, stride in ((16, 1), (32, 3)):
        tracer = Detected(light)
        pilot_by(tracer, rays, stride=stride)
        assert not tracer.looked(8)


def test_a_block_that_begins_with_its_anchor_takes_its_pilot():
    """Of another window, or where the pilot did not look at the whole time, the first window is traced."""
    zeros, first = jit().Float(np.zeros(16 * SITES, np.float32)), PilotFlux.empty(SITES)
    first.controlled[:], first.plain[:], first.met[:] = 640.0, 655.0, True
    first.plain_scatter[:] = 9.0
    rays = PilotRays(zeros, zeros, 16, (0.0, 3.0))
    for window_us, near_us, is_known in (
        ((0.0, 3.0), (0.0, 39.0), True), ((0.0, 3.0), (-np.inf, np.inf), True), ((0.0, 2.0), (0.0, 39.0), False),
        ((0.0, 3.0), (0.0, 38.0), False), ((0.0, 3.0), (1.0, 39.0), False), ((0.0, 3.0), None, False),
    ):  # fmt: skip
        tracer = Detected(light_of())
        tracer.pilot_rays = lambda *given, span_us=None, before=None, tracer=tracer: (tracer.pilot(*given), rays)
        anchored = Anchored(first, rays, window_us, near_us)
        pilot = pilot_by(tracer, 16, anchored=anchored, span_us=(0.0, 39.0))
        assert pilot.controlled[0, 2] == (640 if is_known else 800), (window_us, near_us)
        assert any(window == 0 for *_, window, _ in tracer.traced) != is_known
        assert np.all(pilot.change.controlled[0] == pilot.controlled[0] - 640)


def test_a_known_first_window_is_not_traced():
    tracer, known = Detected(light_of(), near=False), PilotFlux.empty(SITES)
    known.controlled[:], known.met[:] = 533.0, False
    assert np.all(pilot_by(tracer, 16, known=known).controlled == 533) and not tracer.traced


def test_ticks_of_lone_pixels_keep_their_flux_with_a_detector(monkeypatch):
    """A shadow moves over pixels that lie apart: the same flux to the bit but in a few pairs, for fewer pilot rays."""
    sensor = hr.load_sensor("gen2", {"evs.threshold_mismatch_rel": 0.02}).crop(72, 48, 16, 8)
    found = []
    for worth in (4, 1000):
        monkeypatch.setattr(pilots, "WORTH", worth)
        source = ChangeDrivenFlux(shadow_scene(), sensor, seed=4)
        found.append((fluxes(source, 0, 25_000), source.counts.pilot_rays, source))
    (some, fewer, _), (every, most, source) = found
    # [tick, half, pixel]
    assert np.ptp(every, axis=0).max() > 0.2 * every.max() and fewer < 0.85 * most
    unit = source.noise_unit(source.sensor.layout.evs_pixel.ravel(), every.mean(axis=1), True)
    assert np.mean(every != some) < 0.1
    assert np.sqrt(np.mean(((every - some).mean(axis=1) / unit) ** 2)) < 0.05


def test_rays_of_constant_pixels_count_as_those_of_pilots():
    """28 before, 40 more of this band: manifest and estimate have the sum."""
    tracer = SimpleNamespace(rays_done=1000)

    def traced(index, window, windows, rays, width_px, near_us):
        assert (rays, width_px, near_us) == (8, 1.5, (3.0, 9.0)) and window.tolist() == [0] * 5
        tracer.rays_done += rays * index.size
        return None, None

    tracer.pilot_rays = traced
    own = SimpleNamespace(tracer=tracer, counts=SimpleNamespace(pilot_rays=28), _footprint_px=lambda band: 1.5)
    band = SimpleNamespace(sites=SimpleNamespace(size=5, index=np.arange(5)), pilot_rays=8)
    AdaptiveRenderer.pilot_rays(own, band, SimpleNamespace(span_us=(0.0, 10.0)), (3.0, 9.0))
    assert own.counts.pilot_rays == 68


def test_a_run_begins_with_the_flux_of_its_anchor():
    """The first window is the anchor, which all pixels are rendered in: it takes no ray more, and all rays of a pilot
    there are cast once.
    """
    sensor = hr.load_sensor("gen2").crop(72, 48, 16, 8)
    source = ChangeDrivenFlux(shadow_scene(), sensor, seed=4)
    pixels, traced = source.sensor.layout.evs_pixel.ravel(), []
    blocks = source.sample_blocks(sensor.spec.evs.tick_us, 0, 4 * sensor.spec.evs.tick_us)
    tracer = source._tracer
    for name in ("trace", "pilot"):
        own = getattr(tracer, name)

        def noted(pixel, window, windows, *given, own=own, name=name, **more):
            first = windows.begin_us[window] == -float(sensor.spec.evs.tick_us)
            if name == "trace" or Stream.RENDER_DETECTOR not in given:
                traced.extend((name, int(p)) for p in np.asarray(pixel)[first])
            return own(pixel, window, windows, *given, **more)

        setattr(tracer, name, noted)
    for _ in source.flux_of_blocks(pixels, blocks):
        pass
    assert len(traced) == len(set(traced)) == 2 * pixels.size
