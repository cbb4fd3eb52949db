"""Estimates of runs in words, and of runs with several parts of light."""

import pytest

from hesim_render.sources.renderer import Estimate


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.2, "1 s"), (89.4, "89 s"), (90.0, "2 min"), (5399, "90 min"), (5400, "1.5 h")]
)
def test_estimates_are_told_in_seconds_minutes_or_hours(seconds, words):
    told = str(Estimate(seconds, 3.26e9, 7.4e6))
    assert told == f"about {words}, 3.3 GB, 7 million rays"


def test_parts_of_the_light_take_their_times_together_and_hold_what_each_needs():
    every = [Estimate(2.0, 30.0, 5.0, 4.0), Estimate(3.0, 50.0, 7.0, 6.0), Estimate(4.0, 70.0, 9.0, 8.0)]
    assert Estimate.together(every) == Estimate(9.0, 44.0, 21.0, 18.0)
    assert Estimate.together([Estimate(2.0, 3.0, 5.0, audit_rays=70.0)] * 2).audit_rays == 140
    slowest = Estimate.together(
        [Estimate(2.0, 3.0, 5.0, ray_s=7.0, trace_s=3.0), Estimate(2.0, 3.0, 5.0, ray_s=5.0, trace_s=4.0)]
    )
    assert (slowest.ray_s, slowest.trace_s) == (7.0, 4.0)
