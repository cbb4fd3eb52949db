"""Rays aimed at objects smaller than a pixel: the same flux as that of uniform rays, with a much smaller error."""

from types import SimpleNamespace

import hidden_scenes
import numpy as np
import pytest
from rendering import mono, pair_tracer
from scipy import stats

from hesim_render.core.backend import jit
from hesim_render.core.host_arrays import from_host
from hesim_render.core.rng import Stream
from hesim_render.sources.render.camera import place_camera
from hesim_render.sources.render.change_driven import retrace
from hesim_render.sources.render.change_driven.aim import Aims, PairAims, ball_around, in_blocks
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.small_objects import Zoom
from hesim_render.sources.render.change_driven.tuning import TUNING, Gain
from hesim_render.sources.render.change_driven.windows import Windows
from hesim_render.sources.render.primary_rays import RayFactory

COLS, ROWS = 16, 12
TIMES = Windows(np.array([2000.0, 4000.0]), np.array([3000.0, 5000.0]))


def motes(*, camera_moves=False):
    """Small bright things of several shapes; one is behind the camera, one is larger than a pixel, one turns."""
    rng, objects, motion = np.random.default_rng(6), [], []
    for k in range(14):
        size = float(rng.uniform(0.003, 0.03))
        place = rng.uniform([-0.35, -0.25, 0], [0.35, 0.25, 0.2])
        shape = ("sphere", "box", "rectangle")[k % 3]
        sizes = [size, size, 0.0] if shape == "rectangle" else [size] * 3
        if k == 0:
            place = [0.1, 0.1, 2.5]
        if k == 1:
            sizes = [0.12, 0.06, 0.1]
        objects.append({"name": f"mote{k}", "shape": shape, "size_m": sizes, "position_m": list(place),
                        "reflectance": 0.9})  # fmt: skip
        way = (rng.normal(size=3) * [0.15, 0.15, 0.02]).tolist()
        keys = [{"t_us": 0}, {"t_us": 6000, "translation_m": way, "rotation_axis": [0, 1, 0], "rotation_deg": 90}]
        motion.append({"object": f"mote{k}", "repeat": k == 2, "keyframes": keys})
    if camera_moves:
        keys = [{"t_us": 0}, {"t_us": 6000, "translation_m": [0.05, 0.02, 0.1], "rotation_axis": [0, 1, 0],
                              "rotation_deg": 2}]  # fmt: skip
        motion.append({"object": "camera", "pivot_m": [0, 0, 2], "keyframes": keys})
    dark = {**hidden_scenes.WALL, "name": "dark", "position_m": [0, 0, -0.29], "reflectance": 0.03}
    return hidden_scenes.scene([dark, *objects], motion)


def pairs():
    """Every pixel in both windows: pixel, window."""
    index = mono(COLS, ROWS).layout.full_index.ravel()
    return np.tile(index, TIMES.size), np.repeat(np.arange(TIMES.size), index.size)


#: A strong barrel and a Gaussian that grows towards the border, for the few pixels in the middle that are seen here.
CURVED = {"lens__distortion": {"model": "opencv", "k1": -3.0, "k2": 20.0},
          "lens__psf": {"type": "gaussian", "image_height_mm": [0, 0.05], "fwhm_um": [1, 8]}}  # fmt: skip


@pytest.mark.parametrize(
    "changes",
    [
        pytest.param({}, marks=pytest.mark.slow),
        {"camera_moves": True, "lens__psf_fwhm_um": 4.0},
        pytest.param(CURVED, marks=pytest.mark.slow),
    ],
)
def test_the_flux_is_that_of_uniform_rays(changes):
    """Sums over the picture: Student's t over ten runs of each kind, false alarm 1e-4; and pair by pair."""
    sensor = mono(COLS, ROWS, **{key: value for key, value in changes.items() if "__" in key})
    tracer = pair_tracer(motes(camera_moves="camera_moves" in changes), sensor)
    pixel, window = pairs()
    groups = np.arange(len(tracer.parts.groups), dtype=np.uint32)
    # every object in the list of every pair: most are elsewhere, or behind the camera
    every = PairAims(np.zeros(pixel.size, np.uint32), np.full(pixel.size, groups.size, np.uint32), groups)
    controlled = np.ones(pixel.size, np.bool_)

    def runs(rays, aims, first):
        count = np.full(pixel.size, rays)
        parts = [tracer.trace(pixel, window, TIMES, count, controlled, repeat=first + k, aims=aims) for k in range(10)]
        return np.array([part.mean for part in parts], np.float64)

    aimed, uniform = runs(512, every, 1), runs(2048, None, 11)
    assert stats.ttest_ind(aimed.sum(axis=1), uniform.sum(axis=1), equal_var=False).pvalue > 1e-4
    assert aimed.sum(axis=1).std() < 0.01 * aimed.sum(axis=1).mean()
    # one uniform ray more or less that meets a small thing makes a long tail: half a percent of the flux on top
    error = np.sqrt((aimed.var(axis=0, ddof=1) + uniform.var(axis=0, ddof=1)) / 10) + 0.005 * aimed.mean(axis=0)
    score = (aimed.mean(axis=0) - uniform.mean(axis=0)) / error
    assert np.abs(score).max() < 5 and 0.3 < np.sqrt(np.mean(score[np.abs(score) > 0.01] ** 2)) < 1.2


def source_and_aims():
    source = ChangeDrivenFlux(hidden_scenes.sparks(60), mono(COLS, ROWS), seed=2)
    index = source.sensor.layout.full_index.ravel()
    row, col = np.divmod(index.astype(np.int64), source.sensor.spec.geometry.cols)
    numbers = np.repeat(np.arange(TIMES.size)[:, None], index.size, axis=1)
    looks = source._renderer.zoom.sites(row, col, TIMES, numbers)
    aims = Aims.of([(k, *look.aims) for k, each in enumerate(looks) for look in each if look.aims], index.size)
    return source, aims.at(numbers.ravel(), np.tile(np.arange(index.size), TIMES.size))


def test_the_error_is_much_smaller_and_as_expected():
    """Of the pairs that sparks cross: a fifth of the error of as many uniform rays, hence a 25th of the rays."""
    source, aims = source_and_aims()
    tracer = source._tracer
    pixel, window = (values[aims.count > 0] for values in pairs())
    aims = aims.part(aims.count > 0)
    assert pixel.size > 100
    controlled = np.ones(pixel.size, np.bool_)

    def error(own):
        count = np.full(pixel.size, 256)
        parts = [tracer.trace(pixel, window, TIMES, count, controlled, repeat=k, aims=own) for k in range(6)]
        return np.std([part.mean for part in parts], axis=0, ddof=1)

    aimed, uniform = error(aims), error(None)
    assert np.sqrt(np.mean(aimed**2)) < 0.2 * np.sqrt(np.mean(uniform**2))
    pilot = tracer.pilot(pixel, window, TIMES, 32, 1.0, Stream.RENDER_ZOOM, aims=aims)
    expected = Gain(*TUNING.diffuse_gain).error(pilot.controlled_scatter, np.full(pixel.size, 256))
    assert 0.7 < np.sqrt(np.mean(expected**2)) / np.sqrt(np.mean(aimed**2)) < 1.6
    # the pilot sees the flux itself with little error: 16 uniform rays are off by a factor of two
    flux = tracer.trace(pixel, window, TIMES, np.full(pixel.size, 1024), controlled, aims=aims).mean
    assert np.sqrt(np.mean((pilot.controlled / flux - 1) ** 2)) < 0.2


def test_pairs_without_small_objects_keep_their_bits():
    source, aims = source_and_aims()
    tracer, (pixel, window) = source._tracer, pairs()
    count, controlled = np.full(pixel.size, 32), np.ones(pixel.size, np.bool_)
    alone = tracer.trace(pixel, window, TIMES, count, controlled)
    together = tracer.trace(pixel, window, TIMES, count, controlled, aims=aims)
    plain = aims.count == 0
    assert 20 < plain.sum() < plain.size
    np.testing.assert_array_equal(together.half_a[plain], alone.half_a[plain])
    assert np.mean(together.half_a[~plain] != alone.half_a[~plain]) > 0.5


def test_an_audit_of_the_same_pair_twice_gives_the_same_value():
    source, aims = source_and_aims()
    crossed = np.flatnonzero(aims.count.reshape(2, -1).min(axis=0))
    pixel = crossed[[0, 1, 0, 2, 1]].astype(np.uint32)
    begin = np.array([2000.0, 2000.0, 2000.0, 4000.0, 4000.0])
    twice = source.reference_flux(pixel, begin, begin + 1000, 0.5, True)[0]
    fresh = source_and_aims()[0]
    alone = fresh.reference_flux(pixel[1:4], begin[1:4], begin[1:4] + 1000, 0.5, True)[0]
    np.testing.assert_array_equal(twice[1:4], alone)
    assert twice[0] == twice[2] and twice[1] != twice[4]
    # what is known takes no more rays, and only for the same error
    done = source.rays_traced
    again = source.reference_flux(pixel[::-1], begin[::-1], begin[::-1] + 1000, 0.5, True)[0]
    np.testing.assert_array_equal(again[::-1], twice)
    assert source.rays_traced == done
    finer = source.reference_flux(pixel[:1], begin[:1], begin[:1] + 1000, 0.02, True)[0]
    assert source.rays_traced > done and finer[0] != twice[0]


@pytest.mark.parametrize(("alike", "room"), [(False, 1 << 18), (True, 1 << 18), (False, 20)])
def test_known_pairs_are_those_that_were_traced(monkeypatch, alike, room):
    """Also where two pairs have the same hash, and where there is no room for all."""
    monkeypatch.setattr(retrace, "_MOST_KNOWN", room)
    if alike:
        monkeypatch.setattr(retrace, "_hash", lambda pairs: (pairs[0] % 2).astype(np.uint64))
    known, rng, asked = retrace.KnownPairs(), np.random.default_rng(3), []

    def value(index, begin, end):
        return np.stack([index + 10 * begin + 100 * end, -begin])

    for _ in range(6):
        index, begin = rng.integers(0, 5, 12).astype(np.uint32), rng.integers(0, 4, 12).astype(float)
        end = begin + rng.integers(1, 3, 12)

        def traced(which, given=(index, begin, end)):
            asked.extend(zip(*(values[which].tolist() for values in given), strict=True))
            return value(*(values[which].astype(float) for values in given))

        np.testing.assert_array_equal(
            known.values(np.stack([index.astype(float), begin, end]), traced), value(index.astype(float), begin, end)
        )
    if not alike and room > 40:  # a pair that is listed twice in one call is traced by one of them
        assert len(asked) < 1.5 * len(set(asked)) and len(set(asked)) > 25


def test_lists_of_objects():
    aims = Aims.of([(1, np.array([4, 2, 4]), np.array([7, 5, 1])), (0, np.array([2]), np.array([9]))], 6)
    found = aims.at(np.array([1, 1, 0, 0, 5]), np.array([4, 2, 2, 4, 0]))
    lists = [found.group[first : first + count].tolist() for first, count in zip(found.first, found.count, strict=True)]
    assert lists == [[1, 7], [5], [9], [], []]
    assert Aims.of([], 6) is None


def test_blocks_hold_each_pair_once_and_either_kind_alone():
    packets = np.array([4, 1, 8, 2, 16, 1])
    aims = PairAims(np.zeros(6, np.uint32), np.array([0, 2, 0, 1, 0, 0], np.uint32), np.zeros(3, np.uint32))
    blocks = list(in_blocks(packets, 12, aims, None))
    assert sorted(np.concatenate([part for part, *_ in blocks])) == list(range(6))
    for part, own, shadows in blocks:
        assert packets[part].sum() <= 12 or part.size == 1
        assert np.all(aims.count[part] > 0) if own is not None else np.all(aims.count[part] == 0)
        assert shadows is None
    slices = [slice(0, 2), slice(2, 4), slice(4, 5), slice(5, 6)]
    assert [part for part, *_ in in_blocks(packets, 12, None, None)] == slices
    # pairs with known shadows, with and without aims; without any, blocks are the same
    codes = np.array([0, 9, 0, 0, 259, 7], np.uint32)
    blocks = list(in_blocks(packets, 12, aims, None, codes))
    assert [part.tolist() for part, *_ in blocks] == [[0, 2], [4], [5], [3], [1]]
    assert [own is not None for _, own, _ in blocks] == [False, False, False, True, True]
    assert [None if own is None else own.tolist() for *_, own in blocks] == [None, [259], [7], None, [9]]
    assert [part for part, *_ in in_blocks(packets, 12, None, None, 0 * codes)] == slices


@pytest.mark.parametrize("psf_um", [0.0, 3.0])
def test_the_density_of_places_in_a_pixel(psf_um):
    """Shares of a million places against the integral of the density, cell by cell; five standard errors."""
    types = jit()
    rays = RayFactory(place_camera(motes().spec, mono(COLS, ROWS, lens__psf_fwhm_um=psf_um)))
    count, edges = 1_000_000, np.linspace(-1.25, 1.25, 11)
    aperture, blur = np.random.default_rng(3).random((2, 2, count)).astype(np.float32)
    spread = tuple(map(types.Float, blur)) if rays.has_psf else None
    x, y = (np.array(v) for v in rays.offset(tuple(map(types.Float, aperture)), spread))
    shares = np.histogram2d(x, y, bins=(edges, edges))[0] / count
    fine = np.linspace(-1.25, 1.25, 1001)
    middle = 0.5 * (fine[1:] + fine[:-1]).astype(np.float32)
    grid = (from_host(types.Float, values) for values in np.meshgrid(middle, middle, indexing="ij"))
    density = np.array(rays.density(*grid), np.float64).reshape(10, 100, 10, 100).mean(axis=(1, 3)) / 16
    assert np.all(np.abs(shares - density) < 5 * np.sqrt(density / count) + 2e-5)
    assert density.sum() == pytest.approx(1, abs=0.02)


def test_a_point_is_seen_where_its_ray_comes_from():
    types = jit()
    view = place_camera(motes().spec, mono(COLS, ROWS))
    rays = RayFactory(view)
    rng = np.random.default_rng(8)
    geometry = view.sensor.spec.geometry
    row, col = (rng.uniform(n / 2 - 40, n / 2 + 40, 50).astype(np.float32) for n in (geometry.rows, geometry.cols))
    aside = [from_host(types.Float, rng.uniform(-0.5, 0.5, 50)) for _ in range(2)]
    origin, direction = rays.towards(from_host(types.Float, row), from_host(types.Float, col), *aside)
    point = origin + direction * from_host(types.Float, rng.uniform(0.5, 4, 50))
    found_col, found_row, scale = rays.seen(point)
    np.testing.assert_allclose(found_col, col + np.array(aside[0]), atol=1e-3)
    np.testing.assert_allclose(found_row, row + np.array(aside[1]), atol=1e-3)
    assert np.all(np.array(scale) > 0)
    assert np.all(np.array(rays.seen(origin - direction)[2]) == 0)


@pytest.mark.parametrize("kind", ["corners", "one ball", "a ball and faces"])
def test_the_ball_around_an_object_touches_its_corners(kind):
    """Half of the diagonal of its box; of one ball alone half of the largest side."""
    corners = np.array([[0.1, 0.2, -1.0], [0.5, -0.4, 0.7], [0.3, 0.8, 0.2]])
    forms = {
        "corners": None, "one ball": SimpleNamespace(balls=[1], faces=[]),
        "a ball and faces": SimpleNamespace(balls=[1], faces=[2]),
    }  # fmt: skip
    found = ball_around(SimpleNamespace(corners=corners, part=SimpleNamespace(form=forms[kind])))
    radius = 1.7 / 2 if kind == "one ball" else np.sqrt(0.4**2 + 1.2**2 + 1.7**2) / 2
    assert found == pytest.approx((0.3, 0.2, -0.15, radius))


def test_windows_of_looks_are_rounded_outwards_to_eighths_of_their_length():
    """Rows of a rolling shutter then share looks; a window shorter than 8 µs is rounded to whole µs."""
    asked = []

    def outlines(begin_us, end_us):
        asked.append((begin_us, end_us))
        return []

    windows = Windows(np.array([1010.0, 1090.0, 1110.0, 7.4]), np.array([1810.0, 1890.0, 1910.0, 9.5]))
    zoom = SimpleNamespace(_outlines=outlines)
    Zoom._sites_of(zoom, np.arange(4), np.zeros(4, np.int64), (20, 30), (4, 1), windows, np.arange(4))
    assert sorted(asked) == [(7.0, 10.0), (1000.0, 1900.0), (1100.0, 2000.0)]


def test_each_pixel_takes_one_look_at_small_objects():
    """Inside of an outline that is not aimed at, the rays of that look; under an aimed one alone, those of aimed rays.

    A grid of 4 by 6 pixels that begins at row 20 and column 30, of which one was not asked about.
    """
    places = np.arange(24).reshape(4, 6)
    places[0, 0] = -1

    def outline(target, rows, cols):
        return SimpleNamespace(target=target, rows=rows, cols=cols)

    def image(one, top, left, shape, margin):
        assert (top, left, shape) == (20, 30, (4, 6))
        wider = slice(one.cols.start, one.cols.stop + (margin == 1.5))  # by a column to the right
        return np.ones((one.rows.stop - one.rows.start, wider.stop - wider.start), bool), (one.rows, wider)

    zoom = SimpleNamespace(
        _image=image, _aim_margin_px=1.5, _tuning=SimpleNamespace(zoom_margin_px=0.5, aim_rays=16)
    )  # fmt: skip
    outlines = [
        outline(None, slice(0, 2), slice(0, 3)), outline(7, slice(1, 3), slice(2, 4)),
        outline(9, slice(2, 4), slice(3, 5)),
    ]  # fmt: skip
    found = list(Zoom._looks(zoom, outlines, 64, True, places, 20, 30))
    seen = {}
    for look in found:
        for place in look.place.tolist():
            assert place not in seen and look.is_small is True
            seen[place] = look.rays
    # the outline that is not aimed at, without the pixel that was not asked about, and what is left of the others
    assert seen == dict.fromkeys((1, 2, 6, 7, 8), 64) | dict.fromkeys((9, 14, 15, 16, 21, 22), 16)
    # what each is aimed at, by the wider outlines
    aims = {pair for look in found if look.aims for pair in zip(*(each.tolist() for each in look.aims), strict=True)}
    wide = {(place, 7) for place in (8, 9, 10, 14, 15, 16)} | {(place, 9) for place in (15, 16, 17, 21, 22, 23)}
    assert aims == {(place, target) for place, target in wide if place in seen}
