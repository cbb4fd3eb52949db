"""Pairs that keep the flux of an earlier window, against levels and lines whose light is known in closed form."""

from dataclasses import fields
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
from rendering import make_scene

import hesim_render as hr
from hesim_render.core.backend import jit
from hesim_render.core.host_arrays import from_host
from hesim_render.core.rng import Stream
from hesim_render.mosaic.schedule import Block
from hesim_render.sources.render.change_driven import adaptive, event_blocks
from hesim_render.sources.render.change_driven.adaptive import AdaptiveRenderer
from hesim_render.sources.render.change_driven.differences import Differences
from hesim_render.sources.render.change_driven.edge_courses import Courses
from hesim_render.sources.render.change_driven.edge_rays import about_edges
from hesim_render.sources.render.change_driven.edges import EdgeFit
from hesim_render.sources.render.change_driven.estimates import Flux
from hesim_render.sources.render.change_driven.event_blocks import Blocks
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.held_pairs import HeldPairs, held_pairs
from hesim_render.sources.render.change_driven.neighbours import Lattice, Sites
from hesim_render.sources.render.change_driven.pilot import Pilot, Refinement
from hesim_render.sources.render.change_driven.plan import Plan, plan
from hesim_render.sources.render.change_driven.tuning import TUNING, Gain
from hesim_render.sources.render.change_driven.windows import Windows

#: Wanted error, e⁻/s, and the contrast, wanted errors, below which levels alone are compared.
WANTED, LOW_CONTRAST = 9.0, 3.5
#: Direction of lines, rad; a line through the middle has this chord, px, which is how its light goes with its offset.
ANGLE = 0.3
CHORD = 1 / np.cos(ANGLE)


def even(low, high, scatter=0.0):
    """A pair without a line."""
    return {"gap": -0.3, "low": low, "high": high, "scatter": scatter, "normal_x": 1.0, "fewer": 5}


def line(offset, gap=0.01, low=110.0, high=510.0, scatter=0.0, angle=ANGLE):
    """A pair with a line; `offset` is positive where the middle of the pixel lies on the high side."""
    normal = {"normal_x": np.cos(angle), "normal_y": np.sin(angle)}
    return {"gap": gap, "offset": offset, "low": low, "high": high, "scatter": scatter, "fewer": 20, **normal}


def fit_of(pairs):
    fit = EdgeFit(*(np.zeros(len(pairs), np.float32) for _ in fields(EdgeFit)))
    fit.rays[:] = 128
    for number, pair in enumerate(pairs):
        for name, value in pair.items():
            getattr(fit, name)[number] = value
    return fit


def sources(held):
    keys = zip(held.window.tolist(), held.pixel.tolist(), strict=True)
    return dict(zip(keys, held.source.tolist(), strict=True))


def held(pairs, own=(), left=(), wanted=None, windows=None, pixels=7):
    """Held pairs, {(window, pixel): source}, of fits {(window, pixel): fit}, all of which are asked.

    `own` pairs change by themselves, `left` ones are not even rendered.
    """
    keys = sorted(pairs)
    windows = max(w for w, _ in keys) + 3 if windows is None else windows
    asked = np.zeros((windows, pixels), np.bool_)
    for key in keys:
        asked[key] = True
    rendered = asked.copy()
    for key in (*own, *left):
        asked[key], rendered[key] = False, key in own
    error = np.array([WANTED if wanted is None else wanted[key] for key in keys], np.float32)
    window, pixel = (np.array(each, np.int64) for each in zip(*keys, strict=True))
    got = held_pairs(window, pixel, fit_of([pairs[key] for key in keys]), error, LOW_CONTRAST, rendered, asked)
    return sources(got)


def two(first, second, own=((0, 3),), **given):
    """True if the second of two windows of a pixel is held."""
    return (4, 3) in held({(0, 3): first, (4, 3): second}, own=own, **given)


def test_an_even_pixel_keeps_the_flux_of_the_window_that_was_rendered():
    """Levels drift by 8 wanted errors in all: each time they have gone by more than one since the source, it ends."""
    drift = [0.0, 4.0, 8.5, 9.5, 12.0, 18.0, 19.0]
    got = held({(2 * w + 1, 5): even(310 + by, 325 + by) for w, by in enumerate(drift)}, own=[(1, 5)])
    # 9.5 from the first one; 18 is 8.5 from that one, and so is held; 19 is 9.5 from it
    assert got == {(3, 5): 1, (5, 5): 1, (9, 5): 7, (11, 5): 7}


@pytest.mark.parametrize(("low", "high", "is_held"), [
    (310 + 8.9, 335 + 8.9, True), (310 - 8.9, 335 - 8.9, True), (310 + 9.1, 335, False), (310 - 9.1, 335 - 4, False),
    (310, 335 + 9.1, False), (310 + 4, 335 - 9.1, False), (310 - 3, 335 + 3, True), (310 - 4, 335 + 3, False),
])  # fmt: skip
def test_levels_that_differ_little_are_the_same_up_to_one_wanted_error(low, high, is_held):
    """Contrasts below 3.5 · 9 = 31.5: a contrast of 32 is not little."""
    assert two(even(310, 335), even(low, high)) == is_held
    assert two(even(low, high), even(310, 335)) == is_held


def test_even_light_is_held_whatever_counts_as_little_contrast():
    """Both intervals together are no wider than a wanted error, or there is contrast, and it counts."""
    assert two(even(310, 314), even(312, 318.9))
    assert two(even(310, 335), even(310, 335)) and not two(even(310, 342), even(310, 342))
    assert not two(even(310, 335), even(311, 343)) and not two(even(311, 343), even(310, 335))


def test_a_line_outside_of_the_pixel_is_held_however_it_moves():
    """Beyond (cos 0.3 + sin 0.3)/2 = 0.625 px it does not meet the pixel: one level fills it."""
    for sign in (1, -1):
        assert two(line(sign * 0.68), line(sign * 0.74)) and two(line(sign * 0.74), line(sign * 0.68))
        # nor if the level that is not there is another
        dim, bright = (110, 700) if sign < 0 else (40, 510)
        assert two(line(sign * 0.68), line(sign * 0.74, low=dim, high=bright))
        dim, bright = (120, 510) if sign < 0 else (110, 520)
        assert not two(line(sign * 0.68), line(sign * 0.74, low=dim, high=bright))
        assert not two(line(sign * 0.68), line(sign * 0.5)) and not two(line(sign * 0.5), line(sign * 0.68))
    assert not two(line(0.74), line(-0.74))


def test_a_line_is_held_where_it_rests_and_not_where_it_moves():
    """Light 400 · chord · offset: with gaps of 0.01, 0.021 px of the way are within 9 e⁻/s, and 0.022 px are not."""
    most = WANTED / (400 * CHORD) - 0.01
    for by in (0.95 * most, -0.95 * most):
        assert two(line(0.07), line(0.07 + by))
    for by in (1.05 * most, -1.05 * most, 0.3):
        assert not two(line(0.07), line(0.07 + by))
    # the same line with its sides exchanged, and a line on the other side of the middle that lets in as much light
    assert not two(line(0.07), line(-0.07, angle=ANGLE + np.pi)) and two(line(0.07), line(0.07, angle=ANGLE + np.pi))
    # a line that turns about a point off the middle moves
    assert not two(line(0.2), line(0.2, angle=-0.45))


def test_an_oblique_line_across_a_corner_has_little_light():
    """Share of the corner beyond a line at distance d from it: d²/(2·cos·sin); 400 · share is 9 at d = 0.1127 px."""
    corner = 0.5 * (np.cos(ANGLE) + np.sin(ANGLE))
    reach = np.sqrt(2 * np.cos(ANGLE) * np.sin(ANGLE) * WANTED / 400)
    for sign in (1, -1):
        assert two(line(sign * 0.7), line(sign * (corner - 0.96 * reach), gap=1e-4))
        assert not two(line(sign * 0.7), line(sign * (corner - 1.04 * reach), gap=1e-4))
        assert two(line(sign * 0.7, angle=ANGLE + 1.1), line(sign * (corner - 0.96 * reach), gap=1e-4))


def test_gaps_and_scatter_widen_the_interval():
    """Gap 0.021 px: 400 · chord · 0.021 = 8.8 e⁻/s; gaps of 0.022 px, or 0.2 e⁻/s either way, are too much."""
    wide = WANTED / (400 * CHORD)
    for gap, scatter, is_held in ((0.97 * wide, 0, True), (1.03 * wide, 0, False), (0.97 * wide, 0.1, True),
                                  (0.97 * wide, 0.2, False), (1e-4, 4.0, True), (1e-4, 4.6, False)):  # fmt: skip
        changed = {"gap": gap, "scatter": scatter}
        assert two(line(0.07, **changed), line(0.07, **changed)) == is_held, changed
        # of either window
        assert two(line(0.07, **changed), line(0.07)) == two(line(0.07), line(0.07, **changed)) == is_held, changed
    # a side of one ray only is no level: anything between both is possible
    assert not two(line(0.74) | {"fewer": 1}, line(0.74)) and not two(line(0.74), line(0.74) | {"fewer": 1})


def test_the_levels_of_a_line_are_compared_with_nothing():
    """Contrast 25, below 31.5, on the same levels: the line itself is half a pixel away."""
    near, far = line(-0.3, low=310, high=335), line(0.3, low=310, high=335)
    assert not two(near, far)
    # nor with levels of an even pixel
    assert not two(near, even(310, 335)) and not two(even(310, 335), near)
    # nor with intervals of 6 e⁻/s that meet: together they are 12 wide, though each end is within 9 of the other's
    below, above = (line(offset, gap=6 / (30 * CHORD), low=310, high=340) for offset in (-0.1, -0.1 + 6 / (30 * CHORD)))
    middle = 325 - 0.1 * 30 * CHORD
    for other in (above, even(middle + 3, middle + 9)):
        assert not two(below, other) and not two(other, below)
    assert two(even(middle - 3, middle + 3), even(middle + 3, middle + 9))
    # a side of one ray is no edge
    single = line(-0.3, low=312, high=337) | {"fewer": 1}
    assert two(single, even(310, 335)) and two(even(310, 335), single)
    # levels hold all the same, where all of it is within a wanted error
    dim = line(-0.3, low=310, high=318)
    assert two(dim, even(311, 317)) and two(even(311, 317), dim)


def test_pixels_whose_rays_all_see_the_same_have_one_level():
    """The side above the middle is empty, and its level of 0 is no flux: even pixels are compared by what all see."""
    types = jit()
    levels = np.repeat([800.0, 805.0, 300.0, 0.0], 4).astype(np.float32)
    x, y = np.random.default_rng(2).uniform(-0.7, 0.7, (2, levels.size)).astype(np.float32)
    fit = EdgeFit.empty(4)
    fit.put(slice(0, 4), [*(from_host(types.Float, each) for each in (x, y, 0 * x, levels))], 4)
    flat = [{each.name: getattr(fit, each.name)[number] for each in fields(EdgeFit)} for number in range(4)]
    assert two(flat[0], flat[1]) and two(flat[1], flat[0]) and two(flat[3], flat[3])
    for first, second in ((0, 2), (2, 0), (0, 3), (3, 0)):
        assert not two(flat[first], flat[second])
    # an edge that comes in takes part of the light away, or brings some
    for offset, is_held in ((0.74, True), (0.3, False), (-0.74, False)):
        edge = line(offset, low=200, high=803)
        assert two(flat[0], edge) == two(edge, flat[0]) == is_held
    for offset, is_held in ((0.74, False), (-0.3, False), (-0.74, True)):
        edge = line(offset, low=797, high=1600)
        assert two(flat[0], edge) == two(edge, flat[0]) == is_held
    assert two(flat[0], even(795, 803)) and not two(flat[0], even(787, 803)) and not two(even(795, 810), flat[0])
    # little contrast, both levels of which are near
    assert two(even(793, 808), flat[0]) and not two(even(790, 808), flat[0]) and not two(even(793, 812), flat[0])


def test_own_changes_begin_anew():
    """What shows a change by itself is never held; later windows are compared with it, or with nothing."""
    fits = dict.fromkeys([(w, 2) for w in (0, 1, 2, 4, 5, 6)], even(310, 312))
    assert held(fits, own=[(0, 2)]) == {(w, 2): 0 for w in (1, 2, 4, 5, 6)}
    assert held(fits, own=[(0, 2), (2, 2)]) == {(1, 2): 0, (4, 2): 2, (5, 2): 2, (6, 2): 2}
    # without a fit
    assert held(fits, own=[(0, 2), (3, 2)]) == {(1, 2): 0, (2, 2): 0, (5, 2): 4, (6, 2): 4}
    # a pair that is not rendered says nothing
    assert held(fits, own=[(0, 2)], left=[(3, 2)]) == held(fits, own=[(0, 2)])


def test_nothing_is_held_without_a_window_before():
    """Not even a dark pixel, whose levels are those of nothing."""
    assert held({(0, 1): even(0, 0), (1, 1): even(0, 0), (3, 4): even(0, 0)}) == {(1, 1): 0}
    assert held({(2, 1): even(0, 0)}) == {}


def test_nothing_is_held_where_nobody_asks():
    fits = {(w, p): even(310, 312) for w in range(4) for p in (1, 5)}
    assert held(fits, own=list(fits)) == {} and held(fits, left=list(fits)) == {}
    assert held(fits, own=[key for key in fits if key[1] == 5]) == {(w, 1): 0 for w in (1, 2, 3)}
    got = HeldPairs.none()
    assert got.window.size == got.pixel.size == got.source.size == 0


def test_pixels_are_held_each_by_itself_with_its_own_wanted_error():
    """Three pixels, of which not all have a fit in all windows; the error is that of the later window."""
    fits = {(0, 4): even(500, 501), (1, 0): even(200, 201), (1, 4): even(503, 504), (1, 6): even(900, 901),
            (2, 0): even(205, 206), (2, 6): even(905, 906), (3, 4): even(505, 506), (3, 6): even(900, 901)}  # fmt: skip
    wanted = dict.fromkeys(fits, 4.5) | {(2, 0): 6.0, (2, 6): 4.0}
    got = held(fits, own=[(0, 4), (1, 0), (1, 6)], wanted=wanted)
    # 6 of 4: rendered itself, and 5 of it are too much for what comes next
    assert got == {(1, 4): 0, (2, 0): 1}
    wanted |= {(2, 6): 5.5, (3, 4): 6.5}
    got = held(fits, own=[(0, 4), (1, 0), (1, 6)], wanted=wanted)
    assert got == {(1, 4): 0, (2, 0): 1, (2, 6): 1, (3, 4): 0, (3, 6): 1}


def test_held_pairs_take_all_of_the_flux_of_their_source():
    rng = np.random.default_rng(3)
    values = Flux(*(rng.uniform(20, 900, (5, 4)).astype(np.float32) for _ in range(3)))
    before = [each.copy() for each in values.arrays]
    HeldPairs(*(np.array(each) for each in ([2, 3, 4], [1, 1, 2], [0, 0, 3]))).fill(values)
    for each, own in zip(values.arrays, before, strict=True):
        own[2:4, 1], own[4, 2] = own[0, 1], own[3, 2]
        np.testing.assert_array_equal(each, own)


# ---- which pairs are asked about ----------------------------------------------------------------


def asked_by(flux, follows=True, **more):
    """Plan of 9×9 sites at a flux [window, site]."""
    flux = np.asarray(flux, np.float32)
    nothing = np.zeros_like(flux)
    sites = Sites.around(np.arange(81, dtype=np.uint32), Lattice.whole(9, 9))
    pilot = Pilot(flux, flux, nothing, nothing, flux, **more)
    gain = Gain(*TUNING.diffuse_gain)
    return plan(pilot, sites, lambda each: np.full_like(each, 10), 0.5, gain, TUNING, True, follows)


def test_neighbours_of_a_change_are_asked_about():
    """A change of 20 (large) and of 200 times what counts, 0.7 · 3 · 0.5 · 10, in window 4; site 41 changes by itself,
    site 31 is looked at more closely in window 3.
    """
    counts = 0.7 * 3 * 0.5 * 10
    row, col = np.indices((9, 9)).reshape(2, 81)
    away = np.maximum(abs(row - 4), abs(col - 4))
    for step, reach in ((20, 1), (200, 2)):
        flux = np.full((9, 81), 1e5)
        flux[4:, 40] += step * counts
        flux[4:, 41] += 2 * counts
        expected = np.zeros((9, 81), np.bool_)
        # the step is sudden, so windows 3 and 4; one more on either side of an extreme one
        expected[2 if reach == 2 else 3 : 6 if reach == 2 else 5] = away <= reach
        expected[3:5, [40, 41]] = False
        got = asked_by(flux)
        np.testing.assert_array_equal(got.asked, expected)
        assert got.rendered[got.asked].all()
        # none from one tick to the next
        ticks = asked_by(flux, follows=False)
        assert not ticks.asked.any() and np.array_equal(ticks.rendered, got.rendered)
        empty = Refinement(*(np.empty(0, kind) for kind in (int, int, np.float32, np.float32)))
        looks = [empty] * 9
        looks[2] = Refinement(np.array([31]), np.array([256]), *(np.zeros(1, np.float32) for _ in range(2)))
        expected[1:4, 31] = False
        barred = asked_by(flux, refined=looks)
        np.testing.assert_array_equal(barred.asked, expected)
        assert barred.rendered[1:4, 31].all()
    # of the first window alone
    assert got.first().asked.shape == (1, 81) and not got.first().asked.any()


# ---- what is done with them ----------------------------------------------------------------------

INDEX = np.array([40, 7, 93], np.uint32)
#: Light of these pixels over that on the axis, and their wanted errors.
FACTOR, ERROR = np.array([0.5, 0.25, 0.4], np.float32), np.array([9.0, 4.0, 6.0], np.float32)
COUNT = 7


class Deciding:
    """A tracer of decision rays with fits {(window, pixel): fit}, 64 rays each."""

    def __init__(self, table):
        self.table, self.rays_done, self.calls = table, 500, []

    def axis_factor(self, index):
        return FACTOR[[INDEX.tolist().index(one) for one in index.tolist()]]

    def moves_within(self, windows):
        return False

    def edges(self, index, window, windows, rays, width_px, controlled, little, stream=Stream.RENDER_EDGE, moves=False,
              shadows=None):  # fmt: skip
        keys = [(w - 2, INDEX.tolist().index(i)) for w, i in zip(window.tolist(), index.tolist(), strict=True)]
        assert (rays, width_px, stream, moves) == (64, 1.5, Stream.RENDER_EDGE, False)
        wanted = [4 * ERROR[p] / FACTOR[p] for _, p in keys]
        np.testing.assert_allclose(little, wanted, rtol=1e-6)
        np.testing.assert_array_equal(controlled, [(w + p) % 3 == 0 for w, p in keys])
        np.testing.assert_array_equal(shadows, [7 * w + p for w, p in keys])
        self.calls.append(keys)
        self.rays_done += 64 * len(keys)
        return fit_of([self.table[key] for key in keys])


def followed(fitted, asked, table, floor=(), difference=(), pilot=200.0):
    """What `follow` makes of a plan of seven windows, which are numbered from 2 on."""
    shape = COUNT, 3
    ends = [(window, pixel) for window in (0, COUNT - 1) for pixel in range(3)]
    masks = [np.zeros(shape, np.bool_) for _ in range(4)]
    for mask, keys in zip(masks, (fitted, asked, [*fitted, *asked, *ends], ()), strict=True):
        for key in keys:
            mask[key] = True
    window, pixel = np.indices(shape)
    floors, differences = np.full(shape, 64, np.int16), Differences.none(*shape)
    for key in floor:
        floors[key] = 65
    for key in difference:
        differences.rays[key] = 128
    what = Plan(
        masks[2], np.full(shape, 512, np.int16), (window + pixel) % 3 == 0, np.ones(shape, np.float32),
        np.tile(ERROR, (COUNT, 1)), floors, differences, masks[0], masks[3], masks[1],
        np.broadcast_to(np.float32(pilot), shape), shadows=(7 * window + pixel).astype(np.uint32),
    )  # fmt: skip
    tracer = Deciding(table)
    own = SimpleNamespace(tracer=tracer, tuning=TUNING, counts=SimpleNamespace(rays=30), _footprint_px=lambda band: 1.0)
    own._decided = lambda *given: AdaptiveRenderer._decided(own, *given)
    begin = np.arange(COUNT + 2) * 130.0
    numbers = np.repeat(np.arange(COUNT)[:, None] + 2, 3, axis=1)
    given = SimpleNamespace(index=INDEX), Windows(begin, begin + 100), numbers, what
    return what, tracer, own, AdaptiveRenderer.follow(own, *given)


def test_pairs_that_only_neighbours_ask_for_take_decision_rays_and_are_held():
    """Fluxes of fits are those on the axis, twice the light of pixel 0: a drift of 12 there is one of 6. Pixel 1 has
    hidden light in window 2, and is a difference in window 5. A contrast of 100 is little: less than 16 · 9.
    """
    table = {(w, 0): even(620 + by, 820 + by) for w, by in enumerate((0, 12, -12, 20, 17))}
    table |= {(w, 1): even(300, 301) for w in range(7)}
    fitted = [(0, 0), (1, 0), (0, 1)]
    asked = [(1, 0), (2, 0), (3, 0), (4, 0), *((w, 1) for w in range(1, 6))]
    what, tracer, own, (out, fit, courses, held) = followed(fitted, asked, table, floor=[(2, 1)], difference=[(5, 1)])
    assert courses.window.size == 0
    got = sources(held)
    # beyond hidden light, and after a difference, nothing before counts
    assert got == {(1, 0): 0, (2, 0): 0, (4, 0): 3, (1, 1): 0, (4, 1): 3}
    expected = what.rendered.copy()
    expected[tuple(np.array(list(got)).T)] = False
    np.testing.assert_array_equal(out.rendered, expected)
    # fits that were there are not made again; all are in order of the window, with the fluxes on the axis
    more = sorted(set(asked) - set(fitted) - {(2, 1), (5, 1)})
    assert tracer.calls == [sorted(fitted), more] and own.counts.rays == 30 + 64 * len([*fitted, *more])
    every = sorted([*fitted, *more])
    assert np.argwhere(out.fitted).tolist() == [list(key) for key in every]
    for name in ("low", "high", "gap"):
        np.testing.assert_allclose(getattr(fit, name), [table[key][name] for key in every])
    assert not what.fitted[3, 0]


def test_windows_that_an_edge_is_followed_through_are_not_asked_about():
    """A line moves through pixel 2 between windows 1 and 4, and rests in window 5. Its light has the chord's slope."""
    at = {1: -0.25, 2: -0.1, 3: 0.05, 4: 0.2, 5: 0.2}
    table = {(w, 2): line(at[w], gap=0.004, low=100, high=700) for w in (1, 4, 5)}
    asked = [(w, 2) for w in range(2, 6)]
    pilot = np.full((COUNT, 3), 0.4 * 400)
    for w, offset in at.items():
        pilot[w, 2] = 0.4 * (400 + 600 * CHORD * offset)
    what, tracer, own, (out, fit, courses, held) = followed([(1, 2), (4, 2)], asked, table, pilot=pilot)
    assert sorted(zip(courses.window.tolist(), courses.pixel.tolist(), strict=True)) == [(2, 2), (3, 2)]
    # by the line, 0.4 of the light on the axis
    assert tracer.calls == [[(1, 2), (4, 2)], [(5, 2)]] and own.counts.rays == 30 + 64 * 3
    assert sources(held) == {(5, 2): 4}
    expected = what.rendered.copy()
    expected[[2, 3, 5], 2] = False
    np.testing.assert_array_equal(out.rendered, expected)
    assert np.argwhere(out.fitted).tolist() == [[1, 2], [4, 2], [5, 2]] and fit.offset.size == 3
    # where the pilot saw another line, all are asked about
    table |= {(w, 2): line(at[w], gap=0.004, low=100, high=700) for w in (2, 3)}
    _, tracer, _, (_, _, courses, held) = followed([(1, 2), (4, 2)], asked, table)
    assert courses.window.size == 0 and sources(held) == {(5, 2): 4} and len(tracer.calls[1]) == 3


def test_pairs_are_held_without_any_edge_and_edges_followed_without_any_pair():
    table = {(w, p): even(100, 102) for w in range(COUNT) for p in range(3)}
    what, tracer, _, (out, fit, courses, held) = followed([], [(2, 1), (3, 1)], table)
    assert sources(held) == {(3, 1): 2} and tracer.calls == [[], [(2, 1), (3, 1)]] and fit.low.size == 2
    what, tracer, _, (out, fit, courses, held) = followed([(2, 1), (3, 1)], [], table)
    assert sources(held) == {} and fit.low.size == 2 and np.array_equal(out.rendered, what.rendered)
    what, tracer, _, (out, fit, courses, held) = followed([], [], table)
    assert out is what and fit is None and not tracer.calls and courses.window.size == held.window.size == 0


def test_decision_rays_that_are_there_count_however_few_rays_the_law_gives():
    """Pairs of 128 rays take no decision rays, and those of 512 do."""
    tracer = Deciding({(3, 0): even(500, 500), (3, 1): even(500, 500), (3, 2): line(0.1)})
    pixel, window = INDEX[[2, 0, 1, 2]], np.array([5, 5, 5, 3])
    tracer.edges = lambda index, *_: (tracer.calls.append(index.tolist()), fit_of([line(0.1)] * index.size))[1]
    rays = np.array([128, 128, 512, 128], np.int16)
    given = (
        rays,
        np.ones(4, np.bool_),
        np.full(4, WANTED, np.float32),
        np.full(4, 8),
        Gain(*TUNING.diffuse_gain),
        TUNING,
    )
    known = np.array([False, True, False, True]), fit_of([line(0.2), line(-0.3)])
    out, edges = about_edges(tracer, (pixel, window, Windows(np.zeros(6), np.ones(6))), *given, known=known)
    assert tracer.calls == [[int(INDEX[1])]] and out.tolist() == [128, 64, 64, 64]
    np.testing.assert_allclose(edges.offset, np.float32([0, 0.2, 0.1, -0.3]))
    assert edges.is_there.tolist() == [False, True, True, True]
    # without any that are known, those of few rays take none
    out, edges = about_edges(tracer, (pixel, window, Windows(np.zeros(6), np.ones(6))), *given)
    assert tracer.calls[1:] == [[int(INDEX[1])]] and out.tolist() == [128, 128, 64, 128]


def test_held_windows_are_knots_and_the_ends_of_courses():
    """Pixel 0: an edge is followed from window 3, which is held of window 1, to window 6. Pixel 1: window 4 is held of
    window 2. Everything else lies on straight lines.
    """
    centre = 220_000 + 70 * np.array([50.0, 90, 150, 180, 260, 300, 390, 450])
    block = Block(centre - 3, centre + 3, np.arange(8) > 0)
    rendered = np.zeros((8, 2), np.bool_)
    rendered[[0, -1]] = rendered[[1, 6], 0] = rendered[[2, 6], 1] = True
    flux = Flux(*(np.random.default_rng(5).uniform(200, 900, (8, 2)).astype(np.float32) for _ in range(3)))
    for values in flux.arrays:
        values[~rendered] = 0
    before = Flux(*(values.copy() for values in flux.arrays))
    model = np.array([30.0, -20.0], np.float32)
    of_edge = Courses(*(np.array(each) for each in ([4, 5], [0, 0], [3, 3], [6, 6])), model)
    held = HeldPairs(*(np.array(each) for each in ([3, 4], [0, 1], [1, 2])))
    what = SimpleNamespace(rendered=rendered)
    renderer = SimpleNamespace(
        has_ticks=False, look_stride=4, kept_rays=0,
        pilot=lambda *_, ending, begun, is_kept: (SimpleNamespace(ended=None), None),
        plan=lambda *_, is_knot, windows, shares, until: what, follow=lambda *_: (what, None, of_edge, held),
        render=lambda *_, first, fit, link: (flux, None),
    )  # fmt: skip
    blocks = Blocks.__new__(Blocks)
    blocks._next = None
    blocks._renderer = renderer
    blocks._bands = [SimpleNamespace(place=np.arange(2), sites=SimpleNamespace(size=2))]
    # compared with the last multiple of 64 ms, though the block is longer than 16 ms
    span_us = 191_994.0, 192_000.0
    anchor = SimpleNamespace(span_us=span_us, pilot=None, shares=None, render=lambda *_: None, link=lambda *_: None)
    blocks._anchors = [anchor]
    blocks._time, blocks._last, blocks._ended = (centre[0] - 3, centre[0] + 3), Flux.zeros(1, 2), [None]
    got = blocks.take(block)
    for number, values in enumerate(before.arrays):
        ends = values[1, 0] + (centre - centre[3]) / (centre[6] - centre[3]) * (values[6, 0] - values[1, 0])
        by = model if number < 2 else np.zeros(2)
        knots = {0: values[0, 0], 1: values[1, 0], 3: values[1, 0], 4: ends[4] + by[0], 5: ends[5] + by[1],
                 6: values[6, 0], 7: values[7, 0]}  # fmt: skip
        first = np.interp(centre, centre[list(knots)], list(knots.values()))
        knots = {0: values[0, 1], 2: values[2, 1], 4: values[2, 1], 6: values[6, 1], 7: values[7, 1]}
        second = np.interp(centre, centre[list(knots)], list(knots.values()))
        seen = np.array([got.at(window).arrays[number][0] for window in range(8)])
        np.testing.assert_allclose(seen, np.stack([first, second], axis=1), rtol=1e-5)


@pytest.mark.parametrize(("has_ticks", "end_us"), [(False, 192_000), (True, 128_000)])
def test_a_run_begins_with_the_anchor_of_its_first_block(monkeypatch, has_ticks, end_us):
    """At a multiple of 64 ms, or of four blocks of 32 ms where these are of ticks."""
    times = 220_000 + np.linspace(0, 32_000, 5)
    seen = []
    renderer = SimpleNamespace(
        has_ticks=has_ticks, counts=SimpleNamespace(values=0),
        still=lambda role: SimpleNamespace(known=np.ones(9, np.bool_)),
    )  # fmt: skip

    def render(renderer, pixel, begin, end, *_, keep):
        seen.append((begin, end, keep))
        return []

    monkeypatch.setattr(event_blocks, "render_one_window", render)
    blocks = Blocks(renderer, np.array([2, 5], np.uint32), Block(times - 70, times, np.ones(5, np.bool_)))
    [(begin, end, keep)] = seen
    assert blocks.alive.size == 0 and keep == (219_930, 252_000)
    assert begin.tolist() == [end_us - 70] * 2 and end.tolist() == [end_us] * 2


# ---- runs ----------------------------------------------------------------------------------------


def plate_before_a_wall(**lens):
    """A bright plate that drifts and turns before a dark wall, in light from the side: its shadow is sharp."""
    wall = {"name": "wall", "shape": "rectangle", "size_m": [3, 3, 0], "position_m": [0, 0, -0.02], "reflectance": 0.12}
    plate = {"name": "plate", "shape": "rectangle", "size_m": [0.16, 0.05, 0], "position_m": [0, 0, 0],
             "reflectance": 0.83}  # fmt: skip
    keys = [{"t_us": 0, "translation_m": [-0.03, 0.004, 0], "rotation_deg": 17},
            {"t_us": 200_000, "translation_m": [0.05, -0.03, 0], "rotation_deg": 33}]  # fmt: skip
    return make_scene(
        objects=[wall, plate],
        light={"type": "directional", "direction": [0.2, 0.1, -1], "illuminance_lux": 1000},
        camera={"origin_m": [0, 0, 0.6], "target_m": [0, 0, 0], **(lens or {"horizontal_fov_deg": 24})},
        motion=[{"object": "plate", "keyframes": keys}],
    )


def flux_of(sensor, end_us, **lens):
    """Flux of event pixels, [window, half, pixel], the run's source, and for each block what `follow` gave: its
    windows, the place of its pixels, the plan, the fits, and held pairs.
    """
    source = ChangeDrivenFlux(plate_before_a_wall(**lens), sensor, seed=4)
    pixels, blocks, own = source.sensor.layout.evs_pixel.ravel(), [], AdaptiveRenderer.follow

    def noted(self, band, windows, numbers, what):
        what, fit, edge_courses, held = own(self, band, windows, numbers, what)
        if windows.size > 1:
            place = np.searchsorted(self.index[pixels], band.index)
            blocks.append(SimpleNamespace(windows=windows, place=place, what=what, fit=fit, held=held))
        return what, fit, edge_courses, held

    with mock.patch.object(AdaptiveRenderer, "follow", noted):
        given = source.flux_of_blocks(pixels, source.sample_blocks(1, 0, end_us))
        flux = np.array([(np.array(one.half_a), np.array(one.half_b)) for one in given])
    return flux, source, blocks


def held_by_time(block, end_us):
    """Held pairs of a block up to a time, {(end of the window, place): end of the source}."""
    ends = block.windows.end_us
    pairs = sources(block.held)
    return {(ends[w], block.place[p]): ends[v] for (w, p), v in pairs.items() if ends[w] <= end_us}


@pytest.fixture(scope="module")
def sensor():
    return hr.load_sensor("davis346", {"evs.threshold_mismatch_rel": 0.02}).crop(28, 20)


@pytest.fixture(scope="module")
def whole(sensor):
    """A block of 65 windows from 0 on; a run begins with the second, 1 µs later, and this one ends before the last."""
    flux, source, [block] = flux_of(sensor, 31_000)
    assert block.windows.size == 65 and block.windows.end_us[:3].tolist() == [0, 1, 500] and len(flux) == 63
    return flux, source, block


def test_held_pairs_of_a_run_have_the_flux_of_their_source(whole):
    flux, _, block = whole
    what, held = block.what, block.held
    seen = (held.source > 1) & (held.window < 64)
    window, source, place = held.window[seen] - 1, held.source[seen] - 1, block.place[held.pixel[seen]]
    assert window.size > 1000 and np.all(source < window) and np.unique(window - source).size > 5
    np.testing.assert_array_equal(flux[window, :, place], flux[source, :, place])
    assert not what.rendered[held.window, held.pixel].any() and what.rendered[held.source, held.pixel].all()
    assert block.fit.low.size == np.count_nonzero(what.fitted) and what.fitted[held.window, held.pixel].all()


@pytest.mark.parametrize("end_us", [5500, 14_000, 21_500])
def test_the_end_of_a_run_within_a_block_changes_no_bit(whole, sensor, end_us):
    """Though what lies behind it is neither rendered nor held there."""
    flux, _, block = whole
    part, _, [ended] = flux_of(sensor, end_us)
    assert len(part) == end_us // 500 + 1
    np.testing.assert_array_equal(part, flux[: len(part)])
    pairs = held_by_time(ended, end_us)
    assert len(pairs) > 50 and pairs == held_by_time(block, end_us)
    assert ended.held.window.size < block.held.window.size


def test_crops_hold_the_same_pairs(sensor):
    every, _, [block] = flux_of(sensor, 8000, focal_length_mm=2.5)
    some, _, [part] = flux_of(sensor.crop(13, 8, 5, 11), 8000, focal_length_mm=2.5)
    inner = np.zeros((20, 28), np.bool_)
    inner[11:19, 5:18] = True
    np.testing.assert_array_equal(every[..., inner.ravel()], some)
    place = np.flatnonzero(inner)
    pairs = {(end, place[p]): v for (end, p), v in held_by_time(part, 8000).items()}
    assert len(pairs) > 200
    assert pairs == {key: v for key, v in held_by_time(block, 8000).items() if inner.ravel()[key[1]]}


def test_held_pairs_are_as_right_as_rendered_ones(monkeypatch, whole, sensor):
    """Against 4096 rays of single windows, and against a run in which nothing is held; in wanted errors."""
    flux, source, block = whole
    monkeypatch.setattr(adaptive, "held_pairs", lambda *_: HeldPairs.none())
    own, other, [plain] = flux_of(sensor, 31_000)
    assert source.counts.rays < 0.9 * other.counts.rays and source.counts.pairs < 0.7 * other.counts.pairs
    seen = (block.held.window > 0) & (block.held.window < 64)
    window, pixel = block.held.window[seen], block.held.pixel[seen]
    assert plain.what.rendered[window, pixel].all()
    wanted, place = block.what.wanted[window, pixel], block.place[pixel]
    value, alone = (each.mean(axis=1)[window - 1, place] for each in (flux, own))
    index = source._renderer.index[source.sensor.layout.evs_pixel.ravel()[place]]
    rays, controlled = np.full(window.size, 4096), np.zeros(window.size, np.bool_)
    truth = source._tracer.trace(index, window, block.windows, rays, controlled).mean
    for off in ((value - alone) / wanted, (value - truth) / wanted):
        assert np.sqrt(np.mean(off**2)) < 0.2 and abs(off).max() < 1.3 and abs(off.mean()) < 0.02
    # all other rendered pairs are the same to the bit
    window, pixel = np.nonzero(block.what.rendered[1:64])
    np.testing.assert_array_equal(flux[window, :, block.place[pixel]], own[window, :, block.place[pixel]])


def test_decision_rays_of_a_plan_know_its_shadows():
    shape, calls = (COUNT, 3), []
    window, pixel = np.indices(shape)
    todo = (window + 2 * pixel) % 3 == 1
    what = SimpleNamespace(
        rays=np.full(shape, 512),
        controlled=todo,
        wanted=1.5 + pixel,
        floor=0 * pixel,
        shadows=7 * window + pixel,
        bounces=None,
    )
    own = SimpleNamespace(tracer=SimpleNamespace(rays=SimpleNamespace(is_box=True)), gain=None, tuning=TUNING)
    with mock.patch.object(adaptive, "about_edges", lambda *given, **more: calls.append(more)):
        AdaptiveRenderer.rays_of(own, None, what, todo, None)
        what.shadows = None
        AdaptiveRenderer.rays_of(own, None, what, todo, None)
    np.testing.assert_array_equal(calls[0]["shadows"], (7 * window + pixel)[todo])
    assert calls[1]["shadows"] is None and calls[0]["tried"] is None
