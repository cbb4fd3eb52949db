"""Windows between which the flux of a pixel that sees paths is a straight line are not rendered."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven import adaptive
from hesim_render.sources.render.change_driven.bends import polyline, straightened
from hesim_render.sources.render.change_driven.differences import Differences
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.plan import Plan
from hesim_render.sources.render.change_driven.tuning import TUNING
from hesim_render.sources.render.change_driven.windows import Windows

KNOT = Path(__file__).parents[3] / "benchmarks/scenes/sky-knot.yaml"


def one_by_one(time, flux, known, most, until=None):
    """The same for one pixel: from each needed window as far as a line passes all between, by trying all of them."""
    numbers, needed = np.flatnonzero(known).tolist(), [0]

    def is_straight(first, last):
        line = np.interp(time, time[[first, last]], flux[[first, last]])
        return all(abs(flux[k] - line[k]) <= most[k] for k in numbers if first < k < last)

    while needed[-1] != numbers[-1] and (until is None or needed[-1] < until):
        needed.append(max(k for k in numbers if k > needed[-1] and is_straight(needed[-1], k)))
    return needed + [k for k in numbers if k > needed[-1]]


class Seen:
    """Looks at given fluxes [window, pixel], which remember what was looked at."""

    def __init__(self, flux):
        self.flux, self.asked = flux, []

    def __call__(self, window, pixel):
        self.asked += zip(pixel.tolist(), window.tolist(), strict=True)
        return self.flux[window, pixel]


def random_courses():
    rng = np.random.default_rng(3)
    time = np.cumsum(rng.uniform(20, 300, 40))
    flux = np.cumsum(rng.normal(0, 40, (40, 60)), axis=0).astype(np.float32) + 900
    most = rng.uniform(30, 150, (40, 60)) * np.linspace(0.5, 6, 60)
    known = rng.random((40, 60)) < 0.6
    known[[0, -1]] = True
    return time, flux, known, most.astype(np.float32)


def test_a_polyline_goes_as_far_as_a_line_passes_all_between():
    time, flux, known, most = random_courses()
    look = Seen(flux)
    needed = polyline(look, known, time, most, 39)
    sizes = set()
    for pixel in range(60):
        expected = one_by_one(time, *(values[:, pixel] for values in (flux, known, most)))
        assert np.flatnonzero(needed[:, pixel]).tolist() == expected
        sizes.add(len(expected))
    assert min(sizes) == 2 and max(sizes) > 7
    # each window that can be looked at is, once
    assert sorted(look.asked) == [tuple(pair) for pair in np.argwhere(known.T).tolist()]
    # a window exactly at its bound is on the line, and a window just beyond it is not
    flat, bound = np.array([[8.0], [8.5], [8.0]], np.float32), np.full((3, 1), 0.5, np.float32)
    every = np.ones((3, 1), np.bool_)
    assert polyline(Seen(flat), every, np.array([3.0, 5, 7]), bound, 2)[:, 0].tolist() == [True, False, True]
    assert polyline(Seen(flat), every, np.array([3.0, 5, 7]), bound - 0.01, 2).all()


def test_nothing_is_looked_at_that_no_value_of_the_run_needs():
    time, flux, known, most = random_courses()
    whole = polyline(Seen(flux), known, time, most, 39)
    few = 0
    for until in (5, 13, 30):
        look = Seen(flux)
        needed = polyline(look, known, time, most, until)
        behind = [max((w for p, w in look.asked if p == pixel), default=0) for pixel in range(60)]
        for pixel in range(60):
            expected = one_by_one(time, *(values[:, pixel] for values in (flux, known, most)), until)
            assert np.flatnonzero(needed[:, pixel]).tolist() == expected
            # the same as for a longer run, up to the first needed window from the end on
            first = np.flatnonzero(whole[:, pixel])[np.searchsorted(np.flatnonzero(whole[:, pixel]), until)]
            assert np.array_equal(needed[: first + 1, pixel], whole[: first + 1, pixel])
        few += sum(window < 39 for window in behind)
    assert few > 30


def plan_of(count, pixels):
    rays = np.full((count, pixels), 4096, np.int16)
    rendered, none = np.ones((count, pixels), np.bool_), np.zeros((count, pixels), np.bool_)
    values = np.full((count, pixels), 3.0, np.float32)
    return Plan(
        *(rendered, rays, none.copy(), values, values, 0 * rays, Differences.none(count, pixels)),
        *(none.copy(), none.copy(), none.copy(), values),
    )


class Looks:
    """A tracer whose looks see given fluxes [window, pixel], by either estimator."""

    def __init__(self, controlled, plain):
        self.tables, self.asked = (controlled, plain), []

    def pilot(self, pixel, window, windows, samples, footprint_px, stream, repeat):
        assert (samples, footprint_px, stream) == (TUNING.bend_rays, 1.0, Stream.RENDER_EDGE) and repeat > 2
        self.asked += list(zip(window.tolist(), pixel.tolist(), strict=True))
        return SimpleNamespace(controlled=self.tables[0][window, pixel - 7], plain=self.tables[1][window, pixel - 7])


def test_what_is_left_out_and_what_is_not():
    """Nine windows. The flux of pixels 0 to 4 bends in window 5 alone, by the controlled estimator."""
    count, pixels = 9, 6
    ends = np.cumsum([100.0, 30, 70, 80, 40, 60, 90, 20, 50])
    windows = Windows(ends - 1, ends)
    line = np.interp(ends, ends[[0, 5, 8]], [500.0, 600.0, 580.0])
    bent = np.repeat(line[:, None], pixels, axis=1).astype(np.float32)
    tracer = Looks(bent, np.full_like(bent, 500))
    what = plan_of(count, pixels)
    what.controlled[:, :5] = True
    # a difference and a small object stay as they are, and take no look; of window 7 nothing was marked
    what.differences.rays[3, 1] = 64
    what.barred[4, 1] = True
    what.rendered[7, :2] = False
    what.fitted[[2, 5, 2], [0, 0, 3]] = what.asked[[6, 5, 4], [0, 2, 3]] = True
    # seven windows of 3072 rays together are not worth 1.5 times nine looks of 256; two of 4096 are worth four
    what.rays[:, 3] = 512
    what.rays[1:3, 3] = 256
    what.rendered[2:5, 4] = what.rendered[6:8, 4] = False
    new = straightened(tracer, np.arange(7, 13, dtype=np.uint32), windows, what, TUNING)
    rows = [np.flatnonzero(new.rendered[:, pixel]).tolist() for pixel in range(pixels)]
    assert rows == [[0, 5, 8], [0, 3, 4, 5, 8], [0, 5, 8], list(range(9)), [0, 5, 8], [0, 8]]
    # pixels that were looked at are not followed by lines as well
    assert np.argwhere(new.fitted).tolist() == [[2, 3]] and np.argwhere(new.asked).tolist() == [[4, 3]]
    looked = {pixel: sorted(window for window, other in tracer.asked if other == 7 + pixel) for pixel in range(pixels)}
    assert looked[0] == [0, 1, 2, 3, 4, 5, 6, 8] and looked[1] == [0, 1, 2, 5, 6, 8]
    assert looked[3] == [] and looked[4] == [0, 1, 5, 8]
    # one window alone is rendered
    what.rendered[1:-1] = False
    what.rendered[5] = True
    assert np.all(straightened(tracer, np.arange(7, 13, dtype=np.uint32), windows, what, TUNING).rendered[5])


def test_a_plan_knows_the_end_of_the_run(monkeypatch):
    """Thirty windows between which the flux goes up and down by 70, of which the run asks for the first four: a look
    behind these tells that the fourth is needed.
    """
    count, flux = 30, np.tile([[530.0], [460.0]], (15, 2)).astype(np.float32)
    ends = 70.0 * np.arange(2, count + 2)
    windows, tracer = Windows(ends - 3, ends), Looks(flux, flux)
    tracer.is_diffuse, tracer.rays_done, tracer.rays = False, 40, SimpleNamespace(is_box=True)
    monkeypatch.setattr(adaptive, "plan", lambda *_: plan_of(count, 2))
    own = SimpleNamespace(
        tracer=tracer, has_ticks=False, look_stride=16, tuning=TUNING, gain=None, counts=SimpleNamespace(rays=9)
    )
    band = SimpleNamespace(sites=None, unit=None, quality=0.5, index=np.array([7, 8], np.uint32))
    short = adaptive.AdaptiveRenderer.plan(own, None, band, True, windows, until=3)
    assert max(window for window, _ in tracer.asked) == 3 + 1
    assert np.flatnonzero(short.rendered[:, 1]).tolist() == [0, 1, 2, 3]
    whole = adaptive.AdaptiveRenderer.plan(own, None, band, True, windows)
    assert max(window for window, _ in tracer.asked) == count - 1 and whole.rendered.all()


def values_of(seconds, cols, rows, tuning=TUNING):
    sensor = hr.load_sensor("davis346").crop(cols, rows, 162, 118)
    source = ChangeDrivenFlux(hr.load_scene(KNOT), sensor, tuning=tuning)
    spec, pixel = source.sensor.spec.evs, source.sensor.layout.evs_pixel.ravel()
    blocks = list(source.sample_blocks(int(spec.window_us), 0.0, 1e6 * seconds))
    wins = np.concatenate([np.stack([b.begin_us[b.wanted], b.end_us[b.wanted]], axis=1) for b in blocks])
    flux = [0.5 * (np.array(s.half_a) + np.array(s.half_b)) for s in source.flux_of_blocks(pixel, blocks)]
    return source, wins, np.array(flux, np.float64)


@pytest.mark.slow
def test_no_value_depends_on_the_end_of_the_run_and_a_third_of_the_rays_is_saved():
    source, _, flux = values_of(0.012, 7, 5)
    for seconds in (0.007, 0.002):
        early, _, short = values_of(seconds, 7, 5)
        np.testing.assert_array_equal(short, flux[: len(short)])
    # few looks lie behind the end: 0.79 with all of the block
    assert early.counts.rays < 0.75 * source.counts.rays
    every, _, _ = values_of(0.012, 7, 5, replace(TUNING, bend_gain=1e9))
    assert source.counts.rays < 0.7 * every.counts.rays
    # looks count as rays of the picture
    assert source.counts.rays + source.counts.pilot_rays == source.rays_traced


@pytest.mark.slow
def test_a_turning_mesh_takes_fewer_rays_for_the_same_errors():
    """Against 6 × 4096 rays of other numbers."""
    every, wins, dense = values_of(0.02, 14, 10, replace(TUNING, bend_gain=1e9))
    source, _, flux = values_of(0.02, 14, 10)
    assert source.counts.rays < 0.7 * every.counts.rays
    rng = np.random.default_rng(4)
    window, place = rng.integers(1, len(wins), 300), rng.integers(0, flux.shape[1], 300)
    windows, pixel = Windows(wins[:, 0], wins[:, 1]), source._index[source.sensor.layout.evs_pixel.ravel()[place]]
    truth = np.zeros(300)
    for repeat in range(6):
        got = source._tracer.trace(
            *(pixel, window, windows, np.full(300, 4096), np.zeros(300, np.bool_)), repeat=repeat + 5
        )
        truth += 0.5 * (got.half_a + got.half_b) / 6
    unit = source.noise_unit(source.sensor.layout.evs_pixel.ravel()[place], truth, True)
    rms = [np.sqrt(np.mean(((values[window, place] - truth) / unit) ** 2)) for values in (flux, dense)]
    assert rms[0] < 1.1 * rms[1] + 0.02 and rms[1] < 1.0


@pytest.mark.parametrize("scene", ["rotating-star"])
def test_direct_light_keeps_its_windows(monkeypatch, scene):
    monkeypatch.setattr(adaptive, "straightened", lambda *_: pytest.fail("lines know edges better"))
    source = ChangeDrivenFlux(hr.load_scene(scene), hr.load_sensor("davis346").crop(8, 6, 160, 120))
    blocks = list(source.sample_blocks(1, 0.0, 2000.0))
    assert len(list(source.flux_of_blocks(source.sensor.layout.evs_pixel.ravel(), blocks))) > 1


@pytest.mark.slow
def test_the_estimate_of_a_block_knows_of_bends_and_that_of_a_window_does_not(monkeypatch):
    source = ChangeDrivenFlux(hr.load_scene(KNOT), hr.load_sensor("davis346").crop(5, 4, 162, 118))
    pixel = source.sensor.layout.evs_pixel.ravel()
    (block, *_) = (b for b in source.sample_blocks(1, 0.0, 12_000.0) if b.wanted.size > 2)
    rays = source.foresight.block(pixel, block.begin_us, block.end_us, "events").rays[0]
    asked = []
    monkeypatch.setattr(adaptive, "straightened", lambda tracer, index, windows, what, *_: (asked.append(1), what)[1])
    assert rays < 0.7 * source.foresight.block(pixel, block.begin_us, block.end_us, "events").rays[0] and asked
    asked.clear()
    source.foresight.block(pixel, block.begin_us[:1], block.end_us[:1], "events")
    source.foresight.block(pixel, block.begin_us[:1], block.end_us[:1], "any")
    assert not asked
