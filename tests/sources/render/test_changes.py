"""What a block is rendered of, and what is filled in; numbers of rays."""

import inspect
import re
from dataclasses import FrozenInstanceError, asdict, fields, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.sources.render.change_driven import forecast
from hesim_render.sources.render.change_driven.allocation import allocate
from hesim_render.sources.render.change_driven.differences import Differences
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.neighbours import REACH, Lattice, Sites
from hesim_render.sources.render.change_driven.pilot import Pilot, Refinement
from hesim_render.sources.render.change_driven.plan import Plan, changes, longer, plan
from hesim_render.sources.render.change_driven.tuning import TUNING, Gain, Tuning


def marks(flux, least=1.0):
    flux = np.array(flux, np.float32)[:, None]
    return changes(flux, np.full(flux.shape, least, np.float32))[:, 0].astype(int).tolist()


def test_windows_are_marked_where_the_flux_leaves_the_last_mark():
    assert marks([0, 0, 0, 0]) == [0, 0, 0, 0]
    # slowly: where it has gone by the bound, and the step itself was small
    assert marks([0, 0.4, 0.8, 1.2, 1.6, 2.0, 2.4]) == [0, 0, 0, 1, 0, 0, 1]
    # at once: both windows
    assert marks([0, 0, 5, 5, 5]) == [0, 1, 1, 0, 0]
    # for one window only
    assert marks([0, 0, 5, 0, 0]) == [0, 1, 1, 1, 0]


def test_the_window_before_a_change_is_marked_where_most_of_it_came_in_one_step():
    """More than half of the change that counts, 4 here: steps of 2.5 and of 1.9 after it."""
    assert marks([0, 0, 2.5, 5, 5], 4.0) == [0, 0, 1, 1, 0]
    assert marks([0, 1.5, 3.0, 4.9, 4.9], 4.0) == [0, 0, 0, 1, 0]


@pytest.mark.parametrize(("step", "reach"), [(0.9, -1), (1.1, 0), (15.0, 0), (17.0, 1), (120.0, 1), (136.0, 2)])
def test_what_is_rendered_around_a_change(step, reach):
    """A change of `step` times what counts, 0.7 · 3 · quality · unit, is rendered so many pixels away; -1 is nowhere.

    Of a change in window 4 that stays, the windows 3 and 4 are rendered; beyond a pixel away one more on either side.
    """
    quality, unit, windows = 0.5, 10.0, 9
    sites = Sites.around(np.arange(9 * 9, dtype=np.uint32), Lattice.whole(9, 9))
    flux = np.full((windows, 81), 1e5, np.float32)
    flux[4:, 4 * 9 + 4] += step * 0.7 * 3 * quality * unit
    nothing = np.zeros_like(flux)
    found = plan(
        Pilot(flux, flux, nothing, nothing, flux), sites, lambda told: np.full_like(told, unit), quality,
        Gain(*TUNING.diffuse_gain), TUNING, True,
    ).rendered.reshape(windows, 9, 9)  # fmt: skip
    row, col = np.indices((9, 9))
    away = np.maximum(abs(row - 4), abs(col - 4))
    assert found[0].all() and found[-1].all()
    for window in range(1, windows - 1):
        beyond = 2 if window in (2, 3, 4, 5) and reach == 2 else -1
        near = max(reach if reach < 2 else 1, 0) if window in (3, 4) and reach >= 0 else -1
        np.testing.assert_array_equal(found[window], away <= max(near, beyond))


def test_longer_marks_reach_no_further():
    marked = np.zeros((7, 1), np.bool_)
    marked[3] = True
    assert longer(marked, 1)[:, 0].astype(int).tolist() == [0, 0, 1, 1, 1, 0, 0]


def test_neighbours_of_a_crop_are_those_of_the_full_sensor():
    rng, rows, cols = np.random.default_rng(1), 40, 50
    image = rng.random(rows * cols).astype(np.float32)
    every = Sites.around(np.arange(rows * cols, dtype=np.uint32), Lattice.whole(rows, cols))
    row, col = np.meshgrid(np.arange(12, 20), np.arange(15, 30), indexing="ij")
    listed = (row * cols + col).ravel().astype(np.uint32)
    some = Sites.around(rng.permutation(listed), Lattice.whole(rows, cols))
    order = some.index[some.listed]
    np.testing.assert_array_equal(np.sort(order), np.sort(listed))
    np.testing.assert_array_equal(some.mean(image[some.index]), every.mean(image)[order])
    for radius in range(1, REACH + 1):
        np.testing.assert_array_equal(some.most(image[some.index], radius), every.most(image, radius)[order])
    plane = image.reshape(rows, cols)
    where = (order == 13 * cols + 20).argmax()
    assert some.most(image[some.index], 2)[where] == plane[11:16, 18:23].max()
    assert some.mean(image[some.index])[where] == pytest.approx(plane[12:15, 19:22].mean(), rel=1e-6)


def test_some_of_the_listed_pixels_have_the_neighbours_of_all():
    """Among them corners and rims, where there are fewer than nine."""
    rng, rows, cols = np.random.default_rng(12), 7, 9
    listed = rng.permutation(rows * cols).astype(np.uint32)
    values = rng.normal(3, 2, rows * cols).astype(np.float32)
    some = rng.permutation(63)[:40]
    # the sums over neighbours as they are first asked for, of some or of all
    for is_first in (True, False):
        sites = Sites.around(listed, Lattice.whole(rows, cols))
        if not is_first:
            sites.mean(values)
        own = sites.only(some)
        np.testing.assert_array_equal(own.index[own.listed], listed[some])
        np.testing.assert_array_equal(own.mean(values), sites.mean(values)[some])
        np.testing.assert_array_equal(own.most(values, 2), sites.most(values, 2)[some])


def test_rays_of_rendered_pairs_do_not_depend_on_the_others():
    """A plan has the rays, estimators, errors and floors that all pairs of each window would have."""
    rng, shape, quality = np.random.default_rng(4), (6, 9 * 9), 0.4
    sites = Sites.around(rng.permutation(81).astype(np.uint32), Lattice.whole(9, 9))
    flux = np.repeat(rng.uniform(300, 500, (1, 81)), 6, axis=0).astype(np.float32)
    flux[2:, 30:34] += 190
    controlled, plain = rng.uniform(0, 40, (2, *shape)).astype(np.float32)
    pilot = Pilot(flux, flux, controlled, plain, flux * rng.uniform(1, 3, shape).astype(np.float32))
    gain = Gain(*TUNING.diffuse_gain)
    what = plan(pilot, sites, lambda told: 7.0 + 0 * told, quality, gain, TUNING, is_knot=True)
    assert 0 < what.rendered[1:-1].mean() < 0.5
    units = np.full(shape, 7.0, np.float32)
    for window, rendered in enumerate(what.rendered):
        part = allocate(pilot, window, sites, units, quality, gain, TUNING, window in (0, 5))
        for table, all_of_window in zip((what.rays, what.controlled, what.error, what.floor), part[:4], strict=True):
            np.testing.assert_array_equal(table[window, rendered], all_of_window[rendered])
        assert len(set(part[3].tolist())) > 1


def pilot_of(flux, scatter, unshadowed=None, refined=()):
    tables = [np.array(values, np.float32)[None] for values in (flux, scatter)]
    open_ = tables[0] if unshadowed is None else np.array(unshadowed, np.float32)[None]
    return Pilot(tables[0], tables[0], tables[1], tables[1], open_, list(refined))


def rays_of(pilot, quality=0.5, unit=0.03):
    """Rays, choice of the estimator, and expected error."""
    return allocated(pilot, quality, unit)[:3]


def allocated(pilot, quality=0.5, unit=0.03):
    count = pilot.controlled.shape[1]
    sites = Sites.around(np.arange(count, dtype=np.uint32), Lattice.whole(1, count))
    units = unit * np.ones(pilot.controlled.shape, np.float32)
    return allocate(pilot, 0, sites, units, quality, Gain(*TUNING.diffuse_gain), TUNING, False)


def test_rays_follow_scatter_quality_and_what_is_near_by():
    calm = np.ones(9)
    rays, controlled, error = rays_of(pilot_of(calm, np.zeros(9)))
    # one ray may bring two wanted errors at most: 1 / (2 · 0.5 · 0.03) = 33
    assert rays.tolist() == [32] * 9 and controlled.all() and np.all(error == 0)
    scatter = np.zeros(9)
    scatter[4] = 1.5
    rays, _, error = rays_of(pilot_of(calm, scatter))
    assert rays[4] > rays[3] > rays[1] and rays[4] >= 128
    # half of the mean over neighbours counts, so that the wish is met with something to spare for rounding
    assert error[4] < 1.3 * 0.5 * 0.03
    finer, _, _ = rays_of(pilot_of(calm, scatter), quality=0.1)
    assert finer[4] > 4 * rays[4]
    bright = np.ones(9)
    bright[6] = 30.0
    rays, _, _ = rays_of(pilot_of(bright, np.zeros(9)))
    assert rays[4] > 128 and rays[2] == 32  # two pixels off the edge of something bright; four off
    seen_refined = Refinement(np.array([4]), np.array([8]), np.array([2.0], np.float32), np.array([2.0], np.float32))
    rays, _, _ = rays_of(pilot_of(calm, np.zeros(9), refined=[seen_refined]))
    assert rays[4] > 256 and rays[2] == 32
    # what 256 rays did not meet, as many are looked for with
    nothing = np.zeros(1, np.float32)
    rays, _, _ = rays_of(
        pilot_of(calm, np.zeros(9), refined=[Refinement(np.array([4]), np.array([256]), nothing, nothing)])
    )
    assert rays[4] == 256 and rays[3] == 32


def test_the_estimate_of_less_scatter_is_taken_but_hidden_light_is_added_up():
    flux = np.ones((1, 1), np.float32)
    half = Pilot(flux, flux, 0.1 * flux, 0.2 * flux, flux)
    assert rays_of(half)[1].all()
    assert not rays_of(Pilot(flux, flux, 0.2 * flux, 0.1 * flux, flux))[1].any()
    # what is hidden for the most part is the sum of what is seen, not the whole less what is hidden
    assert not rays_of(Pilot(flux, flux, 0.1 * flux, 0.2 * flux, 3 * flux))[1].any()


def test_knowledge_of_an_edge_leaves_the_rays_for_what_stays_unseen():
    """Light hidden from all pilot rays: (4.5 − 1.5)/(2 · 0.5 · 0.03) = 100 rays bring two wanted errors each; and as
    many as a closer look had.
    """
    hidden, flux = np.full(9, 1.5), np.full(9, 1.5)
    hidden[3] = 4.5
    nothing = np.zeros(1, np.float32)
    looks = [Refinement(np.array([7]), np.array([256]), nothing, nothing)]
    floor = allocated(pilot_of(flux, np.zeros(9), hidden, looks))[3]
    np.testing.assert_allclose(floor, [0, 0, 0, 100, 0, 0, 0, 256, 0], atol=1)


def test_a_plan_ends_at_the_first_window_after_the_run():
    """Two pixels; windows after the second are beyond the end."""
    rendered = np.array([[1, 1], [0, 1], [0, 0], [1, 0], [0, 1], [1, 1]], bool)
    shape = rendered.shape
    fitted = np.zeros(shape, bool)
    one = Plan(rendered, np.ones(shape, np.int16), rendered, *(np.ones(shape, np.float32) for _ in range(2)),
               np.ones(shape, np.int16), Differences.none(*shape), fitted, ~rendered, ~rendered,
               np.ones(shape, np.float32))  # fmt: skip
    cut = np.array([[1, 1], [0, 1], [0, 0], [1, 0], [0, 1], [0, 0]], bool)
    np.testing.assert_array_equal(one.until(2).rendered, cut)
    np.testing.assert_array_equal(one.until(5).rendered, rendered)
    # the first window with a fit after the end is rendered as well
    fitted[[3, 4, 5], [1, 1, 1]] = True
    rendered[3, 1] = rendered[4, 0] = True
    cut[[3, 4], [1, 1]] = True, False
    np.testing.assert_array_equal(one.until(2).rendered, cut)
    assert np.argwhere(one.until(2).fitted).tolist() == [[3, 1]]
    fitted[3, 1] = False
    cut[4, 1] = True
    np.testing.assert_array_equal(one.until(2).rendered, cut)
    without = one.without(np.array([3, 4]), np.array([0, 1])).rendered
    assert not without[3, 0] and not without[4, 1] and without.sum() == rendered.sum() - 2


def test_every_tuning_constant_says_its_unit_its_origin_and_what_it_is_for():
    text = inspect.getdoc(Tuning).partition("Parameters\n----------\n")[2]
    entries = re.findall(r"^(\w[\w, ]*) : ((?:.*)(?:\n    .*)*)", text, re.MULTILINE)
    told = {name: entry for names, entry in entries for name in names.split(", ")}
    assert set(told) == {field.name for field in fields(Tuning)}
    for name, entry in told.items():
        assert re.match(r"[^.]+, [FHC]\. ", entry), name  # unit, origin
        assert re.search("Without|Half as many|Larger", entry), name
    with pytest.raises(FrozenInstanceError):
        TUNING.change = 1.0


def test_the_documented_constants_are_those_of_the_code():
    page = Path(__file__).parents[3] / "docs" / "change-driven-rendering.md"
    table = re.findall(r"^\| `(\w+)` \| ([^|]+) \|", page.read_text(encoding="utf-8"), re.MULTILINE)
    assert dict(table) == {name: str(value) for name, value in asdict(TUNING).items()}


@pytest.mark.parametrize(
    ("quality", "most"),
    [(2.0, 4096), (0.5, 4096), (0.45, 8192), (0.36, 8192), (0.3, 16384), (0.25, 16384), (0.03, 16384)],
)
def test_a_better_quality_moves_the_largest_number_of_rays(quality, most):
    assert TUNING.at(quality) == replace(TUNING, most_rays=most)
    sensor = hr.load_sensor("davis346").crop(7, 5)
    source = ChangeDrivenFlux(hr.load_scene("flat-field"), sensor, quality, 3)
    assert source._renderer.tuning.most_rays == most
    own = replace(TUNING, most_rays=40_000)
    assert own.at(quality).most_rays == 40_000  # never fewer than given


@pytest.mark.parametrize("share", [1, 9])
def test_a_forecast_looks_at_small_squares_of_as_many_pixels_whatever_their_density(share):
    """Sides of 4 px where all pixels count, and of 12 px where one in nine does, around one pixel of each of 192 parts
    of the list; single pixels where these have no neighbours.
    """
    rows, cols = 190, 220
    pixel = np.sort(np.random.default_rng(1).permutation(rows * cols)[: rows * cols // share]).astype(np.uint32)
    source = SimpleNamespace(sensor=SimpleNamespace(rows=rows, cols=cols), is_apart=lambda role: role == "any")
    found = forecast._sample(pixel, source, "events", np.random.default_rng(2))
    reach, row, col = 2 * np.sqrt(share), pixel.astype(int) // cols, pixel.astype(int) % cols
    wanted = np.zeros(pixel.size, bool)
    for number, part in enumerate(np.random.default_rng(2).random(192)):
        at = int((number + part) * pixel.size / 192)
        wanted |= (abs(row - row[at]) <= reach) & (abs(col - col[at]) <= reach)
    assert found.tolist() == pixel[wanted].tolist()
    single = forecast._sample(pixel, source, "any", np.random.default_rng(2))
    place = np.searchsorted(pixel, single)
    assert 0.85 * 4096 < single.size <= 4096 and (pixel[place] == single).all()
    # no part of the list is left out, and none is taken twice
    assert (np.diff(place) > 0).all() and np.diff(place).max() < 2 * pixel.size / 4096 + 1


@pytest.mark.parametrize(
    ("scene", "sensor", "rays"),
    [("cornell-box", "davis346", 32), ("cornell-box", "reference-mono", 16), ("rotating-star", "davis346", 16)],
)
def test_asynchronous_pixels_that_see_paths_have_more_pilot_rays(scene, sensor, rays):
    source = ChangeDrivenFlux(hr.load_scene(scene), hr.load_sensor(sensor).crop(7, 5), 0.4, 3)
    assert source._renderer.tuning.pilot_rays == rays
    (band,) = source._renderer.bands(np.arange(7, 19, dtype=np.uint32), "events")
    assert band.pilot_rays == rays
