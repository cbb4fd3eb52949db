"""Exposures: few rays of the pilot say at which pixels it takes all of its rays."""

import hidden_scenes
import numpy as np
import pytest

import hesim_render as hr
from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven.change_detector import DETECTOR_RAYS, seen_with_few_or_all
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.neighbours import Lattice, Sites
from hesim_render.sources.render.change_driven.pair_flux import PilotFlux
from hesim_render.sources.render.change_driven.tuning import TUNING
from hesim_render.sources.render.change_driven.windows import Windows

ROWS, COLS = 31, 43
WINDOWS = Windows(np.array([3.0, 5.0]), np.array([9.0, 12.0]))


class Traced:
    """Scatter and what comes near by the number of the pixel; fluxes say how many rays were traced."""

    def __init__(self, scatter, near):
        self.scatter, self.near, self.calls = scatter, near, []

    def pilot(self, pixel, window, windows, samples, width_px, span_us=None):
        assert windows is WINDOWS and width_px == 1.3
        self.calls.append((samples, pixel, window, span_us))
        out = PilotFlux.empty(pixel.size)
        out.controlled[:], out.plain[:] = 1000 + samples, 7.0
        # the estimator of less scatter counts
        out.controlled_scatter[:], out.plain_scatter[:] = self.scatter[pixel], 1e9
        out.met[:] = self.near[pixel]
        return out


def listed(rows, cols):
    return (rows[:, None] * COLS + cols).ravel().astype(np.uint32)


@pytest.mark.parametrize("span_us", [None, (-4.0, 70.0)])
def test_all_rays_look_where_few_differ_or_nothing_comes_near(span_us):
    scatter, near = np.full(ROWS * COLS, 5.9, np.float32), np.ones(ROWS * COLS, np.bool_)
    # wanted error 1.1 below 1010 and 1.7 above, so that 6 times as much is 6.6 by the few rays
    scatter[12 * COLS + 17] = 6.7
    near.reshape(ROWS, COLS)[16:22, 20:27] = False
    tracer = Traced(scatter, near)
    sites = Sites.around(listed(np.arange(9, 22), np.arange(11, 30)), Lattice.whole(ROWS, COLS), 1)
    # windows of their own for even rows
    window = (sites.index // COLS % 2).astype(np.int64)
    seen = seen_with_few_or_all(
        tracer, sites, window, WINDOWS, 64, 1.3, span_us, lambda flux: np.where(flux < 1010, 1.1, 1.7)
    )
    (first, index, own, span), (many, asked, others, span_again) = tracer.calls
    assert (first, many, span, span_again) == (DETECTOR_RAYS, 64, span_us, span_us)
    np.testing.assert_array_equal(index, sites.index)
    np.testing.assert_array_equal(own, window)
    np.testing.assert_array_equal(others, asked // COLS % 2)
    expected = np.zeros((ROWS, COLS), np.bool_)
    expected[11:14, 16:19] = True
    if span_us is not None:
        # nothing comes near to them or to those beside them
        expected[17:21, 21:26] = True
    np.testing.assert_array_equal(asked, np.flatnonzero(expected))
    all_rays = expected.ravel()[sites.index]
    np.testing.assert_array_equal(seen.controlled, np.where(all_rays, 1064, 1000 + DETECTOR_RAYS))


def test_even_sites_alone_are_asked_once():
    tracer = Traced(np.zeros(ROWS * COLS, np.float32), np.ones(ROWS * COLS, np.bool_))
    sites = Sites.around(listed(np.arange(5, 9), np.arange(4, 7)), Lattice.whole(ROWS, COLS), 1)
    seen_with_few_or_all(tracer, sites, 0 * sites.listed, WINDOWS, 64, 1.3, (0.0, 1.0), lambda flux: flux)
    assert [call[0] for call in tracer.calls] == [DETECTOR_RAYS]


def source_of(scene, region, **more):
    return ChangeDrivenFlux(hr.load_scene(scene), hr.load_sensor("eiger").crop(*region), seed=3, **more)


def test_exposures_of_some_pixels_have_the_bits_of_all():
    """The sites beside a pixel decide; one more ring of them is looked at for that."""
    region = (56, 40, 1500, 1100)
    pixels = np.arange(region[0] * region[1], dtype=np.uint32)
    source = source_of("rotating-star", region)
    whole = np.array([np.array(half) for half in source.mean_flux(pixels, 20_000, 29_000)])
    # both kinds of sites are there
    least, most = DETECTOR_RAYS * pixels.size, (DETECTOR_RAYS + TUNING.frame_pilot_rays) * pixels.size
    assert 1.3 * least < source.counts.pilot_rays < 0.7 * most
    for row, col in ((7, 9), (21, 33), (30, 12)):
        some = (np.arange(row, row + 5)[:, None] * region[0] + np.arange(col, col + 7)).ravel().astype(np.uint32)
        part = source_of("rotating-star", region).mean_flux(some, 20_000, 29_000)
        np.testing.assert_array_equal(np.array([np.array(half) for half in part]), whole[:, some])


@pytest.mark.parametrize(
    ("scene", "sensor", "few"),
    [
        ("rotating-star", "eiger", True),
        ("rotating-star", "davis346", True),
        ("rotating-star", "reference-bayer", True),
        ("glass-and-metal", "eiger", False),
    ],
)
def test_exposures_of_diffuse_scenes_ask_few_rays_first(scene, sensor, few):
    """Decisions look three pixels away, and what is shown there follows from one pixel more."""
    source = ChangeDrivenFlux(hr.load_scene(scene), hr.load_sensor(sensor).crop(16, 12, 60, 52))
    (band,) = source._renderer.bands(np.array([7 * 16 + 9], np.uint32), "any")
    assert band.few_first == few and band.pilot_rays == TUNING.frame_pilot_rays
    assert band.sites.size == (81 if few else 49)
    if source.sensor.layout.evs_pixel.size:
        events = source._renderer.bands(source.sensor.layout.evs_pixel.ravel().astype(np.uint32), "events")
        assert not any(each.few_first for each in events)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pop-in plates", pytest.param("fan", marks=pytest.mark.slow)])
def test_what_is_there_for_a_part_of_an_exposure_is_not_missed(name):
    """Against 8192 rays of other random numbers: in plates that are there for 0.7 of 10 ms, and between blades."""
    sensor = hr.load_sensor("eiger").crop(48, 36, 1600, 1200)
    pixels, window = np.arange(48 * 36, dtype=np.uint32), Windows(np.array([8e3]), np.array([18e3]))
    off, stated = [], []
    for seed in range(2):
        source = ChangeDrivenFlux(hidden_scenes.SCENES[name](), sensor, 0.5, seed=seed)
        a, b = (np.array(half, np.float64) for half in source.mean_flux(pixels, 8e3, 18e3))
        if seed == 0:
            tracer, each = source._renderer.tracer, np.zeros(pixels.size, np.int64)
            given = source._index[pixels], each, window, each + 4096, each > 0, Stream.AUDIT
            truth = np.mean([tracer.trace(*given, repeat=k).mean.astype(np.float64) for k in range(2)], axis=0)
            unit = source.noise_unit(pixels, truth, False)
        # of the pixels and of four around
        assert source.counts.pilot_rays < 0.8 * TUNING.frame_pilot_rays * 56 * 44
        off.append((0.5 * (a + b) - truth) / unit)
        stated.append(0.5 * (a - b) / unit)
    rms, told = (np.sqrt(np.mean(np.square(values))) for values in (off, stated))
    assert 0.03 < rms < 0.5 / TUNING.frame_margin and told == pytest.approx(rms, rel=0.2)
    assert np.mean(np.abs(off) > 3 * 0.5) < 0.005
