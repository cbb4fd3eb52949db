"""The exact mode says whether a run is good enough, in the words and with the status of the default mode."""

import numpy as np
import pytest

from hesim_render.capture.error_meter import ErrorMeter, EventFlux, stated_verdict
from hesim_render.capture.lab_trials import TrialPlan
from hesim_render.capture.scene_run import require_short
from hesim_render.core.backend import jit
from hesim_render.core.errors import TooLongError
from hesim_render.core.host_arrays import from_host
from hesim_render.sources.renderer import Estimate


def meter(scatter, outliers=0.0, count=20_000, seed=3):
    """A meter that has seen normal errors of `scatter` noise units, a share of them ten times as large."""
    types, rng, found = jit(), np.random.default_rng(seed), ErrorMeter()
    error = rng.normal(size=count) * scatter * np.where(rng.random(count) < outliers, 10, 1)
    level, noise = 300.0, 7.0
    found.add(
        from_host(types.Float, level + error * noise),
        from_host(types.Float, level - error * noise),
        lambda e, _: np.full(e.size, noise),
    )
    return found


def test_an_error_is_in_units_of_the_noise_at_the_mean_of_both_halves():
    """Half of their difference: 4 at a level of 16, whose noise is 8."""
    found = ErrorMeter()
    found.add(
        *(from_host(jit().Float, np.full(50, half, np.float32)) for half in (12.0, 20.0)),
        lambda level, _: 2 * np.sqrt(level),
    )
    assert found.as_dict()["rms"] == pytest.approx(0.5)


def test_each_value_counts_once_and_in_large_pictures_a_fixed_part_of_them():
    """Values of 1, 2, 5 units: √10 by hand. Of 40 000 values, 32 768 different ones, the same in the next picture."""
    found, places = ErrorMeter(), []

    def noise(level, place):
        places.append(place)
        return np.full(level.size, 3.0)

    halves = np.array([[103.0, 94.0, 85.0], [97.0, 106.0, 115.0]], np.float32)
    found.add(*map(jit().Float, halves), noise)
    assert found.values == 3 and found.as_dict()["rms"] == pytest.approx(np.sqrt((1 + 4 + 25) / 3), rel=1e-6)
    large = [from_host(jit().Float, np.full(40_000, value, np.float32)) for value in (7.0, 9.0)]
    found.add(*large, noise)
    found.add(*large, noise)
    assert found.values == 3 + 2 * 32_768 and np.array_equal(places[1], places[2])
    assert np.unique(places[1]).size == 32_768 and places[1].min() < 10 and places[1].max() > 39_990
    # centre of a bin: at most 2.4 % from 1/3
    assert found.quantile(0.5) == pytest.approx(1 / 3, rel=0.024)


def test_event_truth_is_the_mean_of_both_halves_and_half_of_their_difference():
    flux = EventFlux(2)
    for a, b in (([3.0, 8.0], [5.0, 7.0]), ([4.0, 2.0], [9.0, 3.0]), ([2.0, 5.0], [1.0, 11.0])):
        flux.add(*(from_host(jit().Float, half) for half in (a, b)))
    assert flux.mean_e_per_s() == pytest.approx([4, 6]) and flux.stderr_e_per_s() == pytest.approx([1, 1])


def test_a_run_is_too_long_beyond_its_limit_in_minutes():
    estimate = Estimate(seconds=150.0, peak_bytes=2e8, rays=3e6)
    require_short(estimate, 2.5, "less")
    with pytest.raises(TooLongError, match=r"more than 2.49 min must be allowed: .*, or ask for less: fewer pixels"):
        require_short(estimate, 2.49, "fewer pixels")


@pytest.mark.parametrize(
    ("scatter", "outliers", "verdict"),
    [
        (0.62, 0.0, "met"),  # |N(0, 1)| exceeds 1.5/0.62 in 1.6 of 100
        (0.68, 0.0, "not met"),  # 2.7 of 100
        (0.2, 0.05, "not met"),  # 5 % of N(0, 2): 2.3 of 100
        (0.2, 0.03, "met"),  # 1.4 of 100
    ],
)
def test_two_of_a_hundred_values_may_be_off_by_three_wanted_errors(scatter, outliers, verdict):
    found = stated_verdict({"frames": meter(0.1), "events": meter(scatter, outliers)}, 48, 0.5)
    assert found["verdict"] == verdict and found["tolerance_noise"] == 1.5 and found["frames_off"] == 0
    assert (found["samples_needed"] is None) == (verdict == "met")


def test_the_number_that_would_do_follows_the_root_of_the_rays():
    """The 98 % quantile of |N(0, 2.9)| is 2.326 · 2.9 = 6.75 units; 1.5 takes 20.2 times the rays, 243 of 12."""
    assert stated_verdict({"frames": meter(2.9), "events": meter(0.1)}, 12, 0.5)["samples_needed"] == 256
    nothing = stated_verdict({"frames": ErrorMeter()}, 12, 0.5)
    assert nothing["verdict"] == "met" and nothing["samples_needed"] is None and "frames_off" not in nothing


def test_the_time_of_trials_is_from_each_reset_to_the_end_of_the_last_bin():
    """17 trials of 900 µs and 2600 µs after them."""
    plan = TrialPlan(np.ones(2), np.zeros(2), 900, np.array([0, 40, 2600]), np.array([12, 5]))
    assert plan.trial_us == 3500 and plan.duration_s == pytest.approx(17 * 3500e-6)
