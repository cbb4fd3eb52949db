"""References of the audit for pixels that see paths: changes from few rays, equally many in all windows of a unit."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven import references
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.references import References
from hesim_render.sources.render.change_driven.tuning import TUNING, Gain
from hesim_render.sources.render.change_driven.windows import Windows
from hesim_render.sources.render.scene import surfaces

BALL = Path(__file__).parents[3] / "benchmarks/scenes/floor-ball.yaml"
#: Ends of four windows, the third of which changes are counted from.
ENDS_US, BASE = np.array([21200.0, 46100.0, 400.0, 69300.0]), 2


def source_of(scene=BALL, sensor="davis346"):
    # below the ball and beside it, where its shadow and its light move
    region = (24, 18, 150, 130) if sensor == "davis346" else (24, 18, 40, 30)
    return ChangeDrivenFlux(hr.load_scene(scene), hr.load_sensor(sensor).crop(*region), seed=5)


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


@pytest.mark.slow
def test_changes_are_as_good_as_those_of_levels_from_a_part_of_the_rays(ball, monkeypatch):
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
    # closed forms make levels cheap as well
    assert rays < 0.9 * (source.rays_traced - before)
    monkeypatch.setattr(surfaces, "_MOST_ENTRIES", -1)
    alone = source_of()
    assert not alone._tracer.has_bounced
    alone.reference_changes(pixel, begin, end, np.ones(end.shape, np.bool_), BASE, 0.25)
    before = alone.rays_traced
    alone.reference_flux(*every, 0.25, True)
    assert before < 0.6 * (alone.rays_traced - before)


@pytest.mark.slow
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


@pytest.mark.slow
def test_direct_light_ticks_and_aimed_rays_keep_references_of_the_level():
    """Closed forms and lines know the star's levels for few rays, rays at specks these; much moves in a tick."""
    pixel, begin, end = asked(30)
    needed = np.random.default_rng(4).random(end.shape) < 0.7
    every = np.broadcast_to(pixel, end.shape)[needed], begin[needed], end[needed]
    for source in (source_of("rotating-star"), source_of(sensor="reference-mono")):
        values = source.reference_changes(pixel, begin, end, needed, BASE, 0.25)
        np.testing.assert_array_equal(values[:, needed], source.reference_flux(*every, 0.25, True))
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


def planned(flux, scatter, change, unshadowed, quality=0.25):
    """Rays and repeats of units whose audit pilot sees these tables, [window, unit]; noise is 1 % and 5 e⁻/s."""
    flux, scatter, change, unshadowed = (np.array(each, np.float32) for each in (flux, scatter, change, unshadowed))
    index = np.arange(3, 3 + flux.shape[1], dtype=np.uint32)
    streams = []

    def seen(rows):
        tables = flux[rows].ravel(), scatter[rows].ravel(), change[rows].ravel()
        return SimpleNamespace(
            **dict(zip(("plain", "plain_scatter", "plain_change"), tables, strict=True)),
            # where the other estimator scatters more, it decides nothing
            controlled=2 * tables[0], controlled_scatter=1.5 * tables[1] + 1, controlled_change=3 * tables[2],
            unshadowed=unshadowed[rows].ravel(), bounced_scatter=None,
        )  # fmt: skip

    def pilot_rays(pixel, window, windows, samples, footprint_px, stream):
        streams.append(stream)
        assert samples == 64 and footprint_px == 1.0 and set(windows.end_us[window]) == {ENDS_US[BASE]}
        return seen([BASE]), "kept"

    def pilot(pixel, window, windows, samples, footprint_px, stream, before):
        streams.append(stream)
        assert before[0] == "kept" and before[1].tolist() == np.tile(np.arange(index.size), 4).tolist()
        np.testing.assert_array_equal(windows.end_us[window], np.repeat(ENDS_US, index.size))
        np.testing.assert_array_equal(pixel, np.tile(index, 4))
        return seen(slice(None))

    renderer = SimpleNamespace(
        tracer=SimpleNamespace(pilot_rays=pilot_rays, pilot=pilot), tuning=TUNING, gain=Gain(0.46, 0.56),
        noise=SimpleNamespace(of=lambda role, index: lambda flux: (0.01 * flux + 5) * (role == "events")),
    )  # fmt: skip
    end = np.repeat(ENDS_US[:, None], index.size, axis=1)
    got = References(renderer)._rays_of(index, end - 1, end, BASE, quality)
    assert set(streams) == {Stream.AUDIT_PILOT}
    assert not got[2].any()
    return got[:2].T.tolist()


def test_the_window_that_needs_most_decides_how_many_rays_its_unit_gets():
    """By hand, from ε = 0.25·(0.01·F + 5), with F = 1500 and so ε = 5 unless said. Changes are from the third one."""
    even, none = [1500.0] * 4, [0.0] * 4

    def one(flux, scatter, change, unshadowed, **named):
        return planned(*([[value] for value in each] for each in (flux, scatter, change, unshadowed)), **named)[0]

    # nothing changes and hardly anything scatters
    assert one(even, none, none, none) == [64, 1]
    # (0.95 · 100/5)² = 361, of the last window alone
    assert one(even, none, [0, 0, 0, 100], none) == [512, 1]
    # the last window is twice as bright: ε = 8.75, and rays scatter by 400 in common. 0.95 · 400 · 1500/1500/8.75 =
    # 43.4, squared 1886; the level asks for (0.46 · 400/45)^(1/0.56) = 12 only
    assert one([1500, 1500, 1500, 3000], [400] * 4, none, none) == [2048, 1]
    # the level: (0.46 · 1500/45)^(1/0.56) = 131
    assert one(even, [0, 1500, 0, 0], none, none) == [256, 1]
    # in a dark window, a level by three hundredths asks for (0.46 · 90/3)^(1/0.56) = 108; there ε = 1.5
    assert one([1500, 100, 1500, 1500], [0, 90, 0, 0], none, none) == [128, 1]
    # and in one that is darker still, ε = 1.275 is more than that: (0.46 · 90/1.275)^(1/0.56) = 391
    assert one([1500, 10, 1500, 1500], [0, 90, 0, 0], none, none) == [512, 1]
    # 8000/(2 · 5) = 800 for the weight of a ray
    assert one(even, none, none, [0, 0, 0, 8000]) == [1024, 1]
    # (0.95 · 500/5)² = 9025 takes three times 4096, (0.95 · 900/5)² = 29241 more than four
    assert one(even, none, [500, 0, 0, 0], none) == [4096, 3]
    assert one(even, none, [900, 0, 0, 0], none) == [4096, 4]
    # twice the wanted error, a quarter of the rays
    assert one(even, none, [0, 0, 0, 100], none, quality=0.5) == [128, 1]
    # units have numbers of their own
    every = planned([even[:2]] * 4, np.zeros((4, 2)), [[0, 0], [0, 0], [0, 0], [100, 500]], np.zeros((4, 2)))
    assert every == [[512, 1], [4096, 3]]


def test_a_unit_is_aimed_if_any_of_its_windows_is(monkeypatch):
    count = np.array([[0, 0, 2], [0, 1, 0], [0, 0, 0], [0, 0, 0]])
    zoom, end = object(), np.repeat(ENDS_US[:, None], 3, axis=1)

    def aims_of(given, pixel, cols, windows, window):
        assert given is zoom and cols == 346
        np.testing.assert_array_equal(windows.end_us[window], end.ravel())
        np.testing.assert_array_equal(pixel, np.tile([5, 6, 9], 4))
        return SimpleNamespace(count=count.ravel())

    monkeypatch.setattr(references, "aims_of", aims_of)
    geometry = SimpleNamespace(spec=SimpleNamespace(geometry=SimpleNamespace(cols=346)))
    known = References(SimpleNamespace(zoom=zoom, tracer=SimpleNamespace(sensor=geometry)))
    assert known._is_aimed(np.array([5, 6, 9], np.uint32), end - 1, end).tolist() == [False, True, True]
    monkeypatch.setattr(references, "aims_of", lambda *_: None)
    assert not known._is_aimed(np.array([5, 6, 9], np.uint32), end - 1, end).any()
