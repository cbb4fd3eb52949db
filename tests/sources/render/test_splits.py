"""A run that begins where another one stopped has the same values to the bit, whatever anchors lie between."""

import numpy as np
import pytest
from test_change_driven import noisy
from test_differences import no_outlines, shadow_scene  # noqa: F401  (a fixture of every test here)

import hesim_render as hr
from hesim_render.mosaic.schedule import tick_blocks
from hesim_render.sources.render.change_driven.anchor import Anchor
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.pair_tracer import PairTracer

#: The plate turns slowly, so that most pixels that change do so by little.
KEYS = [{"t_us": 0, "rotation_deg": 7}, {"t_us": 120_000, "rotation_deg": 9.5}]


def run(sensor, begin_us, end_us):
    """Ends of the windows after one time and up to another, µs, and their flux, half a and half b, [window, 2, pixel];
    of a source that has seen nothing before. Pixels of ticks are differences as well.
    """
    source = ChangeDrivenFlux(shadow_scene(KEYS), sensor, 0.2, seed=4)
    spec = source.sensor.spec.evs
    # the window in which a run of an asynchronous sensor begins belongs to that run alone
    own = 1 if spec.tick_us is None else 0
    if spec.tick_us is None:
        blocks = list(source.sample_blocks(int(spec.window_us), begin_us, end_us))
    else:
        blocks = list(tick_blocks(spec, begin_us, end_us))
    ends_us = np.concatenate([block.end_us[block.wanted] for block in blocks])
    samples = source.flux_of_blocks(source.sensor.layout.evs_pixel.ravel(), blocks)
    flux = np.array([(np.array(one.half_a), np.array(one.half_b)) for one in samples])
    return ends_us[own:], flux[own:]


@pytest.mark.parametrize(
    ("tick_us", "begin_us", "split_us", "end_us"),
    [
        # a block ends where the anchor of the next one lies
        pytest.param(None, 61_000, 64_000, 67_000, id="asynchronous"),
        (1250, 77_000, 80_000, 84_000),
        # an anchor at 64 ms, within a block of 4.8 ms that ends at 67.2 ms
        (300, 62_000, 67_200, 69_000),
    ],
)
def test_values_are_the_same_whichever_side_of_an_anchor_a_run_begins(tick_us, begin_us, split_us, end_us):
    if tick_us is None:
        sensor = hr.load_sensor("davis346", {"evs.threshold_mismatch_rel": 0.02}).crop(26, 18, 5, 3)
    else:
        mono = noisy(64, 48).spec.evs
        changes = {"evs.tick_us": tick_us, "evs.window_us": tick_us * mono.window_us // mono.tick_us}
        sensor = hr.load_sensor("reference-mono", changes).crop(26, 18, 5, 3)
    ends_us, whole = run(sensor, begin_us, end_us)
    later_us, later = run(sensor, split_us, end_us)
    assert np.ptp(whole, axis=0).max() > 0.005 * whole.max()
    np.testing.assert_array_equal(later, whole[ends_us > split_us])
    np.testing.assert_array_equal(later_us, ends_us[ends_us > split_us])
    sooner_us, sooner = run(sensor, begin_us, split_us)
    np.testing.assert_array_equal(sooner, whole[np.isin(ends_us, sooner_us)])


@pytest.mark.parametrize("tick_us", [1250, None])
def test_each_anchor_is_made_once(tick_us, monkeypatch):
    """Anchors of the two blocks about 64 ms, or about 80 ms of ticks of 1.25 ms: their pilots, and that of the first
    window of the run; the second block begins in its anchor.
    """
    sensor = noisy(26, 18) if tick_us else hr.load_sensor("davis346").crop(26, 18, 5, 3)
    spans_us, pilots, made, traced = [], [], Anchor.__init__, PairTracer.pilot_rays

    def noted(self, renderer, band, span_us, *others, **more):
        spans_us.append(span_us)
        made(self, renderer, band, span_us, *others, **more)

    def counted(self, *given, **more):
        pilots.append(given[0].size)
        return traced(self, *given, **more)

    monkeypatch.setattr(Anchor, "__init__", noted)
    monkeypatch.setattr(PairTracer, "pilot_rays", counted)
    at_us = 80_000 if tick_us else 64_000
    run(sensor, at_us - 2500, at_us + 2500)
    length_us = spans_us[0][1] - spans_us[0][0]
    assert spans_us == [(-length_us, 0), (at_us - length_us, at_us)]
    assert len(pilots) == (3 if tick_us else 4)
