"""References of the audit for pixels that see paths: changes from few rays, equally many in all windows of a unit."""

from pathlib import Path

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.windows import Windows

BALL = Path(__file__).parents[3] / "benchmarks/scenes/floor-ball.yaml"
#: Ends of four windows, the third of which changes are counted from.
ENDS_US, BASE = np.array([21200.0, 46100.0, 400.0, 69300.0]), 2


def source_of(scene=BALL, seed=5):
    # below the ball and beside it, where its shadow and its light move
    return ChangeDrivenFlux(hr.load_scene(scene), hr.load_sensor("davis346").crop(24, 18, 150, 130), seed=seed)


def asked(count, seed=2):
    pixel = np.random.default_rng(seed).integers(0, 24 * 18, count).astype(np.uint32)
    end = np.repeat(ENDS_US[:, None], count, axis=1)
    return pixel, end - 1, end


@pytest.fixture(scope="module")
def ball():
    source = source_of()
    pixel, begin, end = asked(90)
    done = source.rays_traced
    changes = source.reference_changes(pixel, begin, end, np.ones(end.shape, np.bool_), BASE, 0.25)
    return source, changes, source.rays_traced - done


def test_changes_are_as_good_as_those_of_levels_from_a_part_of_the_rays(ball):
    """Against 6 × 4096 rays of the run's own stream. Asked for is a quarter of a noise unit."""
    source, changes, rays = ball
    pixel, begin, end = asked(90)
    windows, count = Windows(ENDS_US - 1, ENDS_US), pixel.size
    truth = np.zeros((6, 4, count))
    for repeat in range(6):
        for window in range(4):
            got = source._tracer.trace(
                *(source._index[pixel], np.full(count, window), windows),
                *(np.full(count, 4096), np.zeros(count, np.bool_)),
                repeat=repeat + 3,
            )
            truth[repeat, window] = 0.5 * (got.half_a + got.half_b)

    def since_base(flux):
        return np.log(flux) - np.log(flux[BASE])

    mean = truth.mean(axis=0)
    noise = source.noise_unit(pixel, mean, True) / mean
    own = np.std([since_base(each) for each in truth], axis=0, ddof=1) / 6**0.5 / noise
    off = (since_base(changes[0]) - since_base(mean)) / noise
    others = np.arange(4) != BASE
    assert np.sum(np.abs(since_base(mean)[others]) > 3 * noise[others]) > 20, "nothing changes: this shows nothing"
    square = np.mean(off[others] ** 2) - np.mean(own[others] ** 2)
    assert square < 0.3**2
    # half the difference of the halves is as large as the error of the level, which may be larger
    level = np.log(changes[0] / mean)
    assert np.sqrt(np.mean(level**2)) < 0.03
    stated = np.sqrt(np.mean((changes[1] / changes[0]) ** 2))
    assert 0.5 < np.sqrt(np.mean(level**2)) / stated < 1.6
    before = source.rays_traced
    every = np.tile(pixel, 4), begin.ravel(), end.ravel()
    source.reference_flux(*every, 0.25, True)
    assert rays < 0.6 * (source.rays_traced - before)


def test_all_windows_of_a_unit_have_one_number_of_rays(monkeypatch):
    source, traced = source_of(), []
    trace = source._tracer.trace

    def noted(pixel, window, windows, samples, *others, **named):
        traced.extend(zip(pixel.tolist(), windows.end_us[window].tolist(), samples.tolist(), strict=True))
        return trace(pixel, window, windows, samples, *others, **named)

    monkeypatch.setattr(source._tracer, "trace", noted)
    pixel, begin, end = asked(40)
    needed = np.random.default_rng(4).random(end.shape) < 0.7
    values = source.reference_changes(pixel, begin, end, needed, BASE, 0.25)
    rays = {}
    for index, when, samples in traced:
        rays.setdefault(index, set()).add(samples)
        assert when in ENDS_US
    assert all(len(each) == 1 for each in rays.values())
    assert len({samples for each in rays.values() for samples in each}) > 2
    # what is not needed is not traced
    assert not values[:, ~needed].any() and np.all(values[0][needed] > 0)
    # drawn once more, nothing is
    traced.clear()
    pilot = source.rays_traced
    again = source.reference_changes(pixel[::-1], begin, end, needed[:, ::-1], BASE, 0.25)
    np.testing.assert_array_equal(again, values[..., ::-1])
    assert not traced and source.rays_traced == pilot
    # a unit alone has the value that it has among others
    fresh = source_of()
    alone = fresh.reference_changes(pixel[6:7], begin[:, 6:7], end[:, 6:7], needed[:, 6:7], BASE, 0.25)
    np.testing.assert_array_equal(alone, values[..., 6:7])


def test_a_better_quality_takes_more_rays(ball):
    _, _, rays = ball
    source = source_of()
    pixel, begin, end = asked(90)
    source.reference_changes(pixel, begin, end, np.ones(end.shape, np.bool_), BASE, 0.05)
    assert source.rays_traced > 1.5 * rays


def test_direct_light_and_aimed_rays_keep_references_of_the_level():
    """Both know levels well for few rays: the star by closed forms and lines, specks by rays at them."""
    star = source_of("rotating-star")
    pixel, begin, end = asked(30)
    needed = np.random.default_rng(4).random(end.shape) < 0.7
    values = star.reference_changes(pixel, begin, end, needed, BASE, 0.25)
    every = np.broadcast_to(pixel, end.shape)[needed], begin[needed], end[needed]
    np.testing.assert_array_equal(values[:, needed], star.reference_flux(*every, 0.25, True))
    assert not values[:, ~needed].any()
    ball = source_of()
    ball._references._is_aimed = lambda index, begin, end: index % 3 == 1
    aimed = np.asarray(ball._index[pixel] % 3 == 1)
    mixed = ball.reference_changes(pixel, begin, end, needed, BASE, 0.25)
    level = ball.reference_flux(*every, 0.25, True)
    is_aimed = np.broadcast_to(aimed, end.shape)[needed]
    np.testing.assert_array_equal(mixed[:, needed][:, is_aimed], level[:, is_aimed])
    # some take as many rays of the same stream, all the same
    assert np.mean(mixed[0][needed][~is_aimed] == level[0][~is_aimed]) < 0.6
