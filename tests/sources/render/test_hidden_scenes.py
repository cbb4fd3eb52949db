"""What is small, thin, fast, or there for a moment only: found in the default mode, and its audit right about it.

What one ray may weigh and the margin of exposures were chosen when some of these scenes had shown the need, no other
constant was. The truth is every pair of a pixel and a tick, traced with many
rays of other random numbers; the tracer itself is judged in `test_renderer_pairs` and `test_renderer_reference`.
"""

import hidden_scenes
import numpy as np
import pytest
from hidden_checks import (
    COLS,
    MOST_EXTRA,
    MOST_MISSED,
    QUALITY,
    ROWS,
    WINDOW_US,
    flips,
    judge,
    not_held,
    record_of,
    run_of,
    sensor,
    truth,
)  # fmt: skip

import hesim_render as hr
from hesim_render.capture.loop import Capture
from hesim_render.capture.run_settings import noise_models
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.renderer import flickering
from hesim_render.sources.scene import Scene
from hesim_render.specs.scene import SceneSpec

FAST = ["specks, camera pans", "pop-in plates", "fan"]


@pytest.mark.parametrize(
    "name", [FAST[1], *(pytest.param(name, marks=pytest.mark.slow) for name in (FAST[0], FAST[2]))]
)
def test_nothing_goes_by_unseen(name):
    total, told, missed, extra = judge(name, 1)
    assert total["true"] > 50
    assert missed <= MOST_MISSED and extra <= MOST_EXTRA
    assert missed <= told["missed_at_most"] and extra <= told["extra_at_most"]


@pytest.mark.slow
@pytest.mark.parametrize("name", hidden_scenes.SCENES)
def test_in_95_of_100_seeds_no_more_is_wrong_than_the_audit_says(name):
    """Ten seeds a scene: a bound of 99 % fails one of ten by a chance of 10 %, twice 0.4 %. No run may have more wrong
    than a run should, by more than two events: those of one value that is off for a tick.

    A run that has more has to say so. Runs of `specks, camera pans` have 88 to 96 events, and about one of eight has
    two too many, however rays are drawn.
    """
    runs = [record_of(name, seed) for seed in range(10)]
    assert not not_held(runs)
    for one in runs:
        assert one["missed"][0] * one["true"] <= max(MOST_MISSED * one["true"], 2.001)
        assert one["extra"][0] * one["in_run"] <= max(MOST_EXTRA * one["in_run"], 2.001)


@pytest.mark.slow
def test_flips_are_those_that_the_stated_error_causes():
    """Events near the threshold, in 32 runs: within 20 % in each scene that has many, within 10 % in all together.

    Eight other seeds of each scene gave 0.87 to 1.02 times as many as the stated error causes.
    """
    each = [np.sum([flips(name, seed) for seed in range(8)], axis=0) for name in ("thin rod", "vibration", "crossing")]
    for found, expected in each:
        assert found > 200 and found == pytest.approx(expected, rel=0.2)
    found, expected = np.sum([*each, *(flips("fan", seed) for seed in range(8))], axis=0)
    assert found == pytest.approx(expected, rel=0.1)


def made(missed=0.0, extra=0.0, told=0.03, **verdict):
    return {"true": 1000.0, "in_run": 1000.0, "missed": [missed, told], "extra": [extra, told], **verdict}


def test_what_does_not_hold_is_named():
    good = [made(0.01, 0.005) for _ in range(95)]
    assert not not_held(good)
    assert not not_held([*good, made(0.025, 0.015, verdict="not met")])
    for verdict in ({}, {"verdict": "met"}, {"verdict": "not shown"}):
        assert not_held([*good, made(0.025, **verdict)]) == ["1 of 96 runs have more than 2 % missed and do not say so"]
        assert not_held([*good, made(0, 0.015, **verdict)]) == [
            "1 of 96 runs have more than 1 % extra and do not say so"
        ]
    assert not_held([*good, *(made(0.01, told=0.009) for _ in range(6))]) == [
        "6 of 101 runs have more wrong than their audits say"
    ]
    # few runs with much wrong
    many = [made(0.9, 0.9, 1.0, verdict="not met") for _ in range(3)]
    assert not_held([*good, *many]) == ["3.72 % missed", "3.24 % extra"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_the_stated_error_of_event_samples_is_the_true_one(seed):
    """Blades all over the picture, so that rays make the error; its estimate has a spread of 2 %, the truth's is 0.06.

    A bin of the quantiles is 4.7 % wide. A value's error is known from two halves only, which widens the tail. Half of
    the values have less error than the truth, so their median is that of the truth.
    """
    shape, wanted = sensor(), truth("fan", 1024)
    rec, samples = run_of("fan", seed)
    told = rec.manifest["settings"]["render"]["error_noise"]["events"]
    seen = samples[:2].mean(axis=0)
    window_s, position = WINDOW_US * 1e-6, shape.evs.layout.evs_position.ravel()
    unit = np.stack([shape.evs.noise_equivalent_e(flux * window_s, position) for flux in seen]) / window_s
    off = np.abs(seen - wanted) / unit
    assert told["rms"] == pytest.approx(np.sqrt(np.mean(off**2)), rel=0.1)
    assert told["median"] < 1.1 * np.median(off) < 0.1
    assert told["p95"] == pytest.approx(np.quantile(off, 0.95), rel=0.2)
    assert told["p99"] == pytest.approx(np.quantile(off, 0.99), rel=0.25)
    assert told["share_above_wanted"] == pytest.approx(np.mean(off > QUALITY), rel=0.4)


@pytest.mark.slow
def test_the_stated_error_of_frames_is_that_of_all_lights_together():
    """Scatter between runs of other seeds. Three lights, each with a render of its own, before moving objects."""
    lights = [
        {**hidden_scenes.SKY, "waveform": {"type": "pwm", "frequency_hz": 250, "duty": 0.5}},
        {**hidden_scenes.LAMP, "waveform": {"type": "pwm", "frequency_hz": 400, "duty": 0.3}},
        {**hidden_scenes.LAMP, "position_m": [-0.8, 1.2, 1.6]},
    ]
    steady = hidden_scenes.crossing().spec.model_dump(exclude_unset=True)
    scene = Scene(SceneSpec.model_validate({**steady, "light": lights}))
    shape = hr.load_sensor("reference-mono", {"aps.exposure_us": 3000}).crop(COLS, ROWS)
    told, electrons = [], []
    for seed in range(5):

        def make(part, light, seed=seed):
            return ChangeDrivenFlux(part, shape, QUALITY, seed=seed, light=light)

        flux = flickering(scene, make, WINDOW_US)
        capture = Capture(flux, shape, noise_models(shape, clean=True)[0], None, 4000, seed)
        frame = next(iter(capture.run()))
        told.append(capture.errors["frames"].as_dict()["rms"])
        electrons.append(frame.electrons_mean.astype(np.float64))
        assert len(flux.sources) == 3
    unit = shape.aps.noise_equivalent_e(np.mean(electrons, axis=0), 3000)
    true = np.sqrt(np.mean(np.var(electrons, axis=0, ddof=1) / unit**2))
    assert true > 0.03 and np.sqrt(np.mean(np.square(told))) == pytest.approx(true, rel=0.1)
