"""Lines through pixels and rays about them: mean of the model, fit of the line, and that no model moves an estimate."""

from dataclasses import replace
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
from rendering import D65_1000_LUX, make_scene, pair_tracer
from scipy import stats

import hesim_render as hr
from hesim_render.core.backend import jit
from hesim_render.core.host_arrays import from_host
from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven import adaptive
from hesim_render.sources.render.change_driven.edge_rays import about_edges
from hesim_render.sources.render.change_driven.edge_share import halfplane_share, moving_share
from hesim_render.sources.render.change_driven.edges import EdgeFit, LaneEdges, PairEdges
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.tuning import TUNING, Gain
from hesim_render.sources.render.change_driven.windows import Windows


def lines(rng, count):
    """Normals in all directions, and offsets up to beyond the corner of a pixel."""
    angle = rng.uniform(0, 2 * np.pi, count)
    angle[:4] = 0, np.pi / 2, np.pi, np.pi / 4
    return np.cos(angle), np.sin(angle), rng.uniform(-0.8, 0.8, count)


def test_the_share_of_a_pixel_beside_a_line():
    """Against the share of half a million points; 1e-3 is 14 standard errors of a half."""
    rng = np.random.default_rng(3)
    x, y, offset = lines(rng, 60)
    points = rng.random((2, 500_000)) - 0.5
    counted = [np.mean(a * points[0] + b * points[1] + c > 0) for a, b, c in zip(x, y, offset, strict=True)]
    np.testing.assert_allclose(halfplane_share(x, y, offset), counted, atol=4e-3)
    np.testing.assert_allclose(halfplane_share(x, y, offset) + halfplane_share(-x, -y, -offset), 1, atol=1e-6)


def fitted(x, y, flux):
    """A fit to rays [pair, ray]."""
    types, found = jit(), EdgeFit.empty(len(x))
    values = x, y, np.zeros(x.shape), flux
    found.put(slice(None), [from_host(types.Float, v) for v in values], x.shape[1])
    return found


def test_rays_that_differ_by_rounding_have_no_scatter():
    """It was infinite: deviations were divided by the difference of two sides of which one had no ray."""
    rng = np.random.default_rng(5)
    flux = 37_000 * (1 + 1e-7 * rng.integers(-1, 2, (20, 64)))
    found = fitted(*(rng.random((2, 20, 64)) - 0.5), flux)
    assert np.all(found.scatter < 1e-6 * 37_000) and not found.is_edge.any()


def test_one_ray_on_a_side_is_a_line_to_look_closer_at_and_no_edge():
    rng = np.random.default_rng(6)
    x, y = rng.random((2, 30, 64)) - 0.5
    rank = np.argsort(np.argsort(0.8 * x + 0.6 * y, axis=1), axis=1)
    for high, is_edge in ((63, False), (62, True)):
        found = fitted(x, y, np.where(rank >= high, 900.0, 350.0))
        assert found.is_line.all() and np.all(found.is_edge == is_edge)


def test_the_line_is_the_one_with_the_largest_distance_from_all_rays():
    """In all directions. A search in steps misses the widest gap now and then: at most 1 of 200 lines is not found, and
    1 of 100 has a gap that is smaller than the one about the true line.
    """
    rng, rays = np.random.default_rng(4), 64
    a, b, c = lines(rng, 300)
    c = 0.5 * c  # both sides have rays
    x, y = rng.random((2, 300, rays)) - 0.5
    distance = a[:, None] * x + b[:, None] * y + c[:, None]
    low, high = np.sort(rng.uniform(2, 900, (2, 300)), axis=0)
    high += 3
    found = fitted(x, y, np.where(distance > 0, high[:, None], low[:, None]))
    is_found = found.is_edge
    own = found.normal_x[:, None] * x + found.normal_y[:, None] * y + found.offset[:, None]
    assert is_found.mean() > 0.995 and ((own > 0) == (distance > 0))[is_found].all()
    np.testing.assert_allclose(np.hypot(found.normal_x, found.normal_y), 1, rtol=1e-5)
    room = np.where(distance > 0, distance, np.inf).min(axis=1) + np.where(distance < 0, -distance, np.inf).min(axis=1)
    assert (found.gap > 0.98 * room).mean() > 0.99
    np.testing.assert_allclose(np.abs(own).min(axis=1)[is_found], found.gap[is_found] / 2, atol=1e-4)
    np.testing.assert_allclose([found.low, found.high], [low, high], rtol=1e-5)
    np.testing.assert_array_equal(found.fewer, np.minimum((distance > 0).sum(axis=1), (distance < 0).sum(axis=1)))


def test_the_line_is_found_among_rays_about_it():
    """Half of the rays start in a narrow strip about the line, which leaves out the middle of the pixel; more than four
    of five have one side.
    """
    rng, count = np.random.default_rng(14), 300
    a, b, _ = lines(rng, count)
    c = rng.uniform(0.3, 0.5, count)
    x, y = rng.uniform(-0.75, 0.75, (2, count, 128))
    along, off = rng.uniform(-0.4, 0.4, (count, 64)), rng.uniform(-0.02, 0.02, (count, 64))
    # most of the strip on one side of the line
    across = np.where(rng.random((count, 64)) < 0.8, np.abs(off), off) - c[:, None]
    x[:, 64:] = a[:, None] * across - b[:, None] * along
    y[:, 64:] = b[:, None] * across + a[:, None] * along
    distance = a[:, None] * x + b[:, None] * y + c[:, None]
    found = fitted(x, y, np.where(distance > 0, 410.0, 95.0))
    own = found.normal_x[:, None] * x + found.normal_y[:, None] * y + found.offset[:, None]
    assert found.is_edge.mean() > 0.98 and ((own > 0) == (distance > 0))[found.is_edge].all()


def test_what_is_no_line_is_not_taken_for_one():
    rng = np.random.default_rng(5)
    x, y = rng.random((2, 4, 64)) - 0.5
    flux = np.stack([
        np.where((x[0] > 0.02) & (y[0] > -0.03), 700.0, 40.0),  # a corner
        np.where(np.abs(x[1] + 0.2 * y[1]) < 0.1, 700.0, 40.0),  # a wire
        np.where(x[2] > 0.1, 700.0, 40.0) + np.where(y[2] > 0.1, 90.0, 0.0),  # three levels
        np.where(rng.random(64) < 0.3, 700.0, 40.0),  # a penumbra
    ])  # fmt: skip
    assert not fitted(x, y, flux).is_edge.any()


def plates():
    """Plates of all directions and a ball that cross the picture before a wall, with the shadows of a beam."""
    item = {"shape": "rectangle", "position_m": [0.01, 0.02, 0.3], "reflectance": 0.7}
    objects = [
        {"name": "wall", "shape": "rectangle", "size_m": [5.0, 5.0, 0], "reflectance": 0.1},
        {**item, "name": "plate", "size_m": [0.3, 0.2, 0], "rotation_deg": 17},
        {**item, "name": "other", "size_m": [0.13, 0.1, 0], "rotation_deg": -38, "position_m": [-0.16, -0.1, 0.35]},
        {"name": "ball", "shape": "sphere", "size_m": [0.12] * 3, "position_m": [0.17, -0.09, 0.2], "reflectance": 0.4},
    ]
    keys = [{"t_us": 0}, {"t_us": 30_000, "translation_m": [0.05, -0.03, 0]}]
    return make_scene(
        objects=objects, light={"type": "directional", "direction": [0.3, 0.2, -1], "illuminance_lux": 900},
        camera={"origin_m": [0, 0, 2], "horizontal_fov_deg": 16},
        motion=[{"object": name, "keyframes": keys} for name in ("plate", "other", "ball")],
    )  # fmt: skip


@pytest.fixture(scope="module")
def edges():
    """Pairs of pixels and windows with edges, and their flux by 8 x 4096 rays of another stream."""
    tracer = pair_tracer(plates(), hr.load_sensor("davis346").crop(30, 22))
    pixel = np.tile(tracer.sensor.layout.full_index.ravel(), 2)
    window = np.repeat(np.arange(2), pixel.size // 2)
    begin = np.array([1300.0, 21_000.0])
    windows = Windows(begin, begin + 7)
    controlled = np.ones(pixel.size, np.bool_)
    busy = tracer.edges(pixel, window, windows, 64, 1.5, controlled, np.zeros(pixel.size, np.float32))
    here = np.flatnonzero(busy.high > 1.02 * busy.low)
    pairs, controlled = (pixel[here], window[here], windows), controlled[here]
    traced = [tracer.trace(*pairs, np.full(here.size, 4096), controlled, Stream.AUDIT, repeat=k).mean for k in range(8)]
    return tracer, pairs, controlled, np.stack(traced).astype(np.float64)


@pytest.mark.parametrize("speed", [0.0, 2.3])
def test_no_model_moves_the_mean(edges, speed):
    """Wrong lines, at rest or moving, wrong levels and strips of any width: 96 estimates agree with plain rays.

    One χ² over all pairs, to which one extreme z of the pairs is added; false alarms: 1e-4 each.
    """
    tracer, pairs, controlled, plain = edges
    rng, count, times = np.random.default_rng(6), controlled.size, 96
    x, y, offset = lines(rng, count)
    level = plain.mean(axis=0) / tracer.axis_factor(pairs[0])
    low, high = level * rng.uniform(0.3, 0.9, count), level * rng.uniform(1.1, 2, count)
    wrong = x, y, offset, rng.uniform(0.01, 0.4, count), low, high, speed * rng.uniform(-1, 1, count)
    models = PairEdges(*(values.astype(np.float32) for values in wrong))
    rays = rng.choice([64, 256], count)
    found = np.stack([tracer.trace(*pairs, rays, controlled, repeat=k, edges=models).mean for k in range(times)])
    error2 = found.var(axis=0, ddof=1) / times + plain.var(axis=0, ddof=1) / 8
    busy = error2 > (1e-6 * plain.mean(axis=0)) ** 2  # in the others all rays have the same value
    z = (found.mean(axis=0) - plain.mean(axis=0))[busy] / np.sqrt(error2[busy])
    assert busy.sum() > 0.9 * count
    # the variance of either mean is itself an estimate: t with at least 7 degrees of freedom has χ² 7/5 as large
    assert (z**2).sum() < 1.4 * stats.chi2.isf(1e-4, z.size) and abs(z.mean()) < 4 * 1.2 / np.sqrt(z.size)


def test_few_rays_about_a_line_do_the_work_of_many(edges):
    """64 rays about fitted lines against plain ones, in a scene that nothing was fitted on.

    Half of the pairs have a smaller error than with 1024 plain rays. Where the decision rays missed a corner, single
    rays weigh more, so the rms error is below that of 256.
    """
    tracer, pairs, controlled, plain = edges
    fit = tracer.edges(*pairs, 64, 1.5, controlled, np.zeros(controlled.size, np.float32))
    lines_ = np.flatnonzero(fit.is_edge)
    chosen = pairs[0][lines_], pairs[1][lines_], pairs[2]
    truth, few = plain.mean(axis=0)[lines_], np.full(lines_.size, 64)
    assert lines_.size > 0.3 * controlled.size
    by_line = tracer.trace(*chosen, few, controlled[lines_], edges=fit.models(lines_)).mean - truth
    plainly = {times: tracer.trace(*chosen, times * few, controlled[lines_]).mean - truth for times in (4, 16)}
    assert np.sqrt(np.mean(by_line**2)) < np.sqrt(np.mean(plainly[4] ** 2))
    assert np.median(np.abs(by_line)) < np.median(np.abs(plainly[16]))


def test_a_line_depends_on_its_pair_alone(edges):
    tracer, pairs, controlled, plain = edges
    little = 0.6 * plain.mean(axis=0).astype(np.float32) / tracer.axis_factor(pairs[0])
    every = tracer.edges(*pairs, 64, 1.5, controlled, little)
    some = np.arange(5, controlled.size, 7)[::-1]
    alone = tracer.edges(pairs[0][some], pairs[1][some], pairs[2], 64, 1.5, controlled[some], little[some])
    for name in vars(every):
        np.testing.assert_array_equal(getattr(alone, name), getattr(every, name)[some])
    models = every.models(np.arange(controlled.size))
    rays = np.full(controlled.size, 64)
    whole = tracer.trace(*pairs, rays, controlled, edges=models)
    part = tracer.trace(pairs[0][some], pairs[1][some], pairs[2], rays[some], controlled[some], edges=models.part(some))
    np.testing.assert_array_equal(part.half_a, whole.half_a[some])


def test_pairs_of_little_contrast_take_half_of_the_decision_rays(edges):
    """32 rays where these show too little; 64 where they show more, and 128 where there is a line."""
    tracer, pairs, controlled, _ = edges
    every = tracer.edges(*pairs, 64, 1.5, controlled, np.zeros(controlled.size, np.float32))
    assert set(every.rays.tolist()) == {64, 128} and every.is_edge[every.rays == 64].sum() == 0
    contrast = every.high - every.low
    least = np.where(np.arange(controlled.size) % 3 == 0, 1.5, 0.2).astype(np.float32) * contrast
    done = tracer.rays_done
    some = tracer.edges(*pairs, 64, 1.5, controlled, least)
    halved = some.rays == 32
    assert tracer.rays_done - done == some.rays.sum()
    # the levels of 32 rays differ from those of 128
    assert halved[::3].mean() > 0.8 and halved[1::3].mean() < 0.2 and halved[2::3].mean() < 0.2
    assert np.all((some.high - some.low)[halved] < least[halved])
    for name in vars(every):
        np.testing.assert_array_equal(getattr(some, name)[~halved], getattr(every, name)[~halved])
    # the second half are other rays than the first
    both = halved & (every.rays == 64) & (every.scatter > 0)
    assert both.sum() > 20 and np.mean((some.low != every.low)[both]) > 0.3


def test_a_run_takes_lines_where_there_are_some():
    """In the default mode: at most 0.7 times the rays, pilots included, and the same flux within the wanted error."""
    sensor, found, rays = hr.load_sensor("davis346").crop(30, 22), {}, {}
    pixel, alone = np.arange(30 * 22, dtype=np.uint32), replace(TUNING, difference_gain=1e9)  # which save on their own
    for least in (256, 1 << 14):
        source = ChangeDrivenFlux(plates(), sensor, seed=3, tuning=replace(alone, edge_least_rays=least))
        blocks = source.sample_blocks(1, 0, 4000)
        samples = list(source.flux_of_blocks(pixel, blocks))
        found[least] = np.array([0.5 * (np.array(s.half_a, np.float64) + np.array(s.half_b)) for s in samples])
        rays[least] = source.rays_traced
    unit = source.noise_unit(pixel, found[256], True)
    assert rays[256] < 0.7 * rays[1 << 14]
    assert np.sqrt(np.mean(((found[256] - found[1 << 14]) / unit) ** 2)) < 0.5


@pytest.mark.parametrize("seed", [3, pytest.param(4, marks=pytest.mark.slow), pytest.param(5, marks=pytest.mark.slow)])
def test_a_corner_beside_a_line_is_worth_two_wanted_errors_where_pixels_rest(seed):
    """Decision rays that miss the corner of a square find a line without it, and each ray of the picture that meets the
    corner then weighs the more, the fewer rays there are. Of resting pixels, whose flux counts for long.
    """
    speck = {"name": "speck", "shape": "sphere", "size_m": [0.04] * 3, "position_m": [-0.21, 0.13, 0.1]}
    scene = make_scene(
        target={"type": "checkerboard", "width_m": 0.5, "height_m": 0.4, "rows": 12, "cols": 13, "light": 0.8,
                "dark": 0.05},
        objects=[{**speck, "reflectance": 0.3}], light=D65_1000_LUX,
        camera={"origin_m": [0.013, 0.007, 2], "target_m": [0.013, 0.007, 0], "horizontal_fov_deg": 16},
        motion=[{"object": "speck", "keyframes": [{"t_us": 0}, {"t_us": 50_000, "translation_m": [0.01, 0.003, 0]}]}],
    )  # fmt: skip
    sensor = hr.load_sensor("davis346").crop(48, 36)
    source = ChangeDrivenFlux(scene, sensor, seed=seed)
    pixel = np.arange(48 * 36, dtype=np.uint32)
    first = next(iter(source.flux_of_blocks(pixel, source.sample_blocks(1, 0, 1000))))
    found = 0.5 * (np.array(first.half_a, np.float64) + np.array(first.half_b))
    tracer = pair_tracer(scene, sensor, 71)
    given = sensor.layout.full_index.ravel(), np.zeros(pixel.size, np.int64), Windows(np.zeros(1), np.ones(1))
    many = *given, np.full(pixel.size, 4096), np.ones(pixel.size, np.bool_), Stream.AUDIT
    truth = np.mean([tracer.trace(*many, repeat=k).mean.astype(np.float64) for k in range(6)], axis=0)
    off = np.abs(found - truth) / source.noise_unit(pixel, truth, True)
    # by what lines alone ask for, 0.24 to 0.28, and five pixels or more are off by more than two
    assert np.sqrt(np.mean(off**2)) < 0.19 and np.count_nonzero(off > 2) < 3


def test_lines_in_anchors_are_those_with_more_rays():
    """The first anchor, where a run begins, and the one after 64 ms."""
    source, asked = ChangeDrivenFlux(plates(), hr.load_sensor("davis346").crop(20, 14), seed=3), {}
    given = adaptive.about_edges

    def noted(tracer, pairs, *rest, contrast_rays, **more):
        used = np.unique(pairs[1])
        asked.setdefault(contrast_rays, set()).update(pairs[2].end_us[used].tolist())
        return given(tracer, pairs, *rest, contrast_rays=contrast_rays, **more)

    with mock.patch.object(adaptive, "about_edges", noted):
        pixels = np.arange(20 * 14, dtype=np.uint32)
        for _ in source.flux_of_blocks(pixels, source.sample_blocks(1, 0, 65_000)):
            pass
        # at a weight of a ray of two wanted errors
        assert asked.keys() == {0.0, 1.0} and asked[1.0] == {0.0, 64_000.0}
        assert min(asked[0.0]) < 1000 and max(asked[0.0]) > 64_000
        # a forecast counts as many
        asked.clear()
        source.foresight.block(pixels, np.array([63_999.0]), np.array([64_000.0]), "events", is_anchor=True)
        assert asked.keys() == {1.0}
        # exposures are not compared with
        asked.clear()
        source.mean_flux(pixels, 500.0, 1500.0)
        assert asked.keys() == {0.0}


def test_rays_follow_from_what_the_decision_rays_saw():
    """Fits as given, of pairs 0.8 as bright as the axis; the wanted error is 2 e⁻/s, which is 2.5 on the axis."""
    contrast = np.array([250.0, 2500.0, 1.5, 1.5, 250.0, 250.0, 250.0, 250.0])  # 100, 1000, 0.6 wanted errors, …
    scatter = np.array([0, 0, 0, 0, 0, 0, 40.0, 0])  # the last but one has no even levels
    gap = np.array([0.01, 0.02, -1, 0.03, -1, 0.01, 0.01, 0.01])
    fit = EdgeFit(*(v.astype(np.float32) for v in (
        np.ones(8), np.zeros(8), np.zeros(8), np.zeros(8), gap, np.full(8, 7.0), 7 + contrast, scatter,
        np.full(8, 20.0), np.full(8, 128.0),
    )))  # fmt: skip
    tried, shown = [], []

    class Tracer:
        moves = False

        def moves_within(self, windows):
            return self.moves

        def edges(self, pixel, window, windows, samples, footprint_px, controlled, least, stream, moves, shadows):
            assert moves == self.moves
            shown.append(None if shadows is None else shadows.tolist())
            tried.append((pixel.tolist(), samples, footprint_px, stream))
            np.testing.assert_allclose(least, 4 * 2.5)  # wanted errors on the axis
            return EdgeFit(*(getattr(fit, name)[pixel] for name in vars(fit)))

        def axis_factor(self, pixel):
            return np.full(pixel.size, 0.8, np.float32)

    pixel, law = np.arange(8, dtype=np.uint32), np.array([2048, 4096, 2048, 256, 1024, 1024, 1024, 128])
    floor, controlled, wanted = np.array([0, 0, 0, 0, 0, 300, 0, 0]), np.ones(8, bool), np.full(8, 2.0, np.float32)
    given = law, controlled, wanted, floor, Gain(*TUNING.diffuse_gain), TUNING
    rays, edges = about_edges(Tracer(), (pixel, 0 * pixel, None), *given)
    # 0.2 rays for each wanted error of contrast, 64 at least; an eighth of the law where there is no
    # contrast, also if rounding makes a line of it, 32 at least; a corner as by the law; the floor;
    # three levels as by the law; and a pair of few rays is not looked at
    assert rays.tolist() == [64, 256, 256, 32, 1024, 512, 1024, 128]
    assert edges.is_there.tolist() == [True, True, False, False, False, True, False, False]
    assert tried == [(list(range(7)), 64, 1.5, Stream.RENDER_EDGE)]
    np.testing.assert_allclose(edges.half_width[:2], [0.009, 0.014], rtol=1e-5)
    rays, edges = about_edges(Tracer(), (pixel, 0 * pixel, None), *given, tried=pixel == 2, flat_part=0.5,
                              shadows=7 + pixel, stream=Stream.AUDIT_EDGE)  # fmt: skip
    assert rays.tolist() == [2048, 4096, 1024, *law[3:]] and edges is None and shown == [None, [9]]
    assert tried[1][0] == [2] and tried[1][3] == Stream.AUDIT_EDGE
    # a line that may move takes half a ray for each wanted error of contrast; a pair without a line those of its own
    # scatter, an eighth of the law at least: 22 of 132 rays scatter by √5/6 of a contrast of 100, (0.68·37.3)^(1/0.7) =
    # 101, and three levels by 16 more, (0.68·53.3)^(1/0.7) = 169
    moving = Tracer()
    moving.moves = True
    assert about_edges(moving, (pixel, 0 * pixel, None), *given)[0].tolist() == [64, 512, 256, 32, 128, 512, 256, 128]
    # a caller may ask for more of lines alone, 0.9 and 0.3: 90 and 900, and no fewer than a moving line takes
    more = {"contrast_rays": 0.9}
    assert about_edges(Tracer(), (pixel, 0 * pixel, None), *given, **more)[0][:4].tolist() == [128, 1024, 256, 32]
    more = {"contrast_rays": 0.3}
    assert about_edges(moving, (pixel, 0 * pixel, None), *given, **more)[0][:4].tolist() == [64, 512, 256, 32]


def without_lines(contrast, scatter, fewer, law, moves):
    """Rays and edges of pairs that no line parts, by fits of 64 rays as given, all in wanted errors of 0.7 e⁻/s."""
    size, unit = len(contrast), 0.7
    fit = EdgeFit(*(np.asarray(v, np.float32) for v in (
        np.ones(size), *np.zeros((3, size)), np.full(size, -0.4), np.full(size, 90.0), 90 + unit * np.array(contrast),
        unit * np.array(scatter), fewer, np.full(size, 64.0),
    )))  # fmt: skip
    tracer = SimpleNamespace(
        edges=lambda pixel, *_: fit.at(pixel), axis_factor=lambda pixel: np.ones(pixel.size, np.float32),
        moves_within=lambda windows: moves,
    )  # fmt: skip
    pixel, wanted = np.arange(size), np.full(size, unit, np.float32)
    given = np.full(size, law), np.ones(size, np.bool_), wanted, np.zeros(size), Gain(0.68, 0.7), TUNING
    return about_edges(tracer, (pixel, 0 * pixel, None), *given)


def test_pairs_of_low_contrast_take_the_rays_of_their_own_scatter():
    """Contrasts of 15 and 17 wanted errors, with 22 of 68 rays on one side: (0.68·(0.47·15 + 1))^(1/0.7) = 11 rays,
    but an eighth of the law at least, which gives 17 its rays.
    """
    contrast, scatter = np.array([15.0, 17.0, 15.0]), np.array([1.0, 1.0, 30.0])
    rays, edges = without_lines(contrast, scatter, np.full(3, 20.0), law=512, moves=False)
    # 0.68·37.0 = 25.2 is 100.4 rays
    assert rays.tolist() == [64, 512, 128] and edges is None


def test_the_scatter_of_two_levels_is_that_of_the_share_of_rays_on_either_side():
    """Of 64 rays 1 or 32 see another level: 3 and 34 of 68 scatter by 0.205 and 0.5 of the contrast. A scatter of 71.3
    wanted errors takes 256 rays, (0.68·71.3)^(1/0.7).
    """
    contrast, fewer = np.array([345.5, 349.0, 142.0, 143.5]), np.array([1, 1, 32, 32])
    rays, _ = without_lines(contrast, np.zeros(4), fewer, law=1024, moves=True)
    assert rays.tolist() == [256, 512, 256, 512]


def planes(rng, count):
    """Lines that move, up to 3 px per window, and rest, along axes and askew."""
    x, y, offset = lines(rng, count)
    speed = rng.uniform(-3, 3, count)
    speed[:6] = 0, 2e-4, -1.7, 1e-3, 0.37, -1e-3
    return x, y, offset, speed


def test_the_share_of_a_pixel_and_a_window_beside_a_moving_line():
    """The mean of the share at rest over 4000 times, by the rule of the middle, and that of half a million points."""
    rng = np.random.default_rng(8)
    x, y, offset, speed = planes(rng, 80)
    # almost along a side of the pixel, and almost at rest
    angle = np.array([0.004, np.pi / 2 - 0.003, np.pi + 0.006, 0.7, 0.005])
    x, y = np.r_[x, np.cos(angle)], np.r_[y, np.sin(angle)]
    offset, speed = np.r_[offset, 0.493, -0.48, 0.2, 0.11, 0.503], np.r_[speed, 0.71, -0.004, 2.3, 0.003, 0.006]
    share = moving_share(x, y, offset, speed)
    times = (np.arange(4000) + 0.5) / 4000 - 0.5
    mean = [halfplane_share(np.full(4000, a), np.full(4000, b), c + v * times).mean()
            for a, b, c, v in zip(x, y, offset, speed, strict=True)]  # fmt: skip
    np.testing.assert_allclose(share, mean, atol=3e-5)
    points = rng.random((3, 500_000)) - 0.5
    counted = [np.mean(a * points[0] + b * points[1] + c + v * points[2] > 0)
               for a, b, c, v in zip(x[:20], y[:20], offset[:20], speed[:20], strict=True)]  # fmt: skip
    np.testing.assert_allclose(share[:20], counted, atol=4e-3)
    assert share[0] == halfplane_share(x, y, offset)[0]


def test_the_moving_line_is_found():
    """Rays beside planes in place and time: 95 of 100 are found, and no ray is on the wrong side."""
    rng, rays = np.random.default_rng(9), 64
    a, b, c, v = planes(rng, 300)
    x, y, time = rng.random((3, 300, rays)) - 0.5
    distance = a[:, None] * x + b[:, None] * y + 0.4 * c[:, None] + v[:, None] * time
    found = EdgeFit.empty(300)
    flux, types = np.where(distance > 0, 830.0, 270.0), jit()
    values = [from_host(types.Float, each) for each in (x, y, time, flux)]
    found.put(slice(None), values, rays, moves=True)
    own = (found.normal_x[:, None] * x + found.normal_y[:, None] * y + found.offset[:, None]
           + found.speed[:, None] * time)  # fmt: skip
    is_found = found.is_edge
    assert is_found.mean() > 0.95 and ((own > 0) == (distance > 0))[is_found].all()
    np.testing.assert_allclose(np.abs(own).min(axis=1)[is_found], found.gap[is_found] / 2, atol=2e-4)
    np.testing.assert_allclose(np.hypot(found.normal_x, found.normal_y), 1, rtol=1e-4)
    # the widest gap is at least as wide as that about the true plane, but for the steps of the search
    scale = np.sqrt((1 + found.speed**2) / (1 + v**2))
    room = np.where(distance > 0, distance, np.inf).min(axis=1) + np.where(distance < 0, -distance, np.inf).min(axis=1)
    assert np.mean((found.gap > 0.9 * room * scale)[is_found]) > 0.95


def test_a_flash_is_seldom_a_line():
    """Light that is switched on within the window parts the rays by time alone; no line is faster than 8 px."""
    rng = np.random.default_rng(10)
    x, y, time = rng.random((3, 20, 64)) - 0.5
    found, types = EdgeFit.empty(20), jit()
    flux = np.where(time > 0.1 + 0.02 * x, 830.0, 270.0)
    found.put(slice(None), [from_host(types.Float, v) for v in (x, y, time, flux)], 64, moves=True)
    assert found.is_line.mean() < 0.4 and np.abs(found.speed[found.is_line]).max(initial=0) <= 8


@pytest.mark.parametrize("speed", [0.0, 0.37, -1.7])
def test_rays_of_a_strip_have_their_density(speed):
    """Of places and times all over, those in the strip have weights 2/(1 + q), and q has the integral 1; rays that are
    drawn lie in it, with the same weight at their place, in the times in which the line meets the pixel.
    """
    import drjit as dr

    types, count = jit(), 1 << 18
    rng = np.random.default_rng(11)
    model = dict(normal_x=0.8, normal_y=-0.6, offset=0.27, half_width=0.09, low=40.0, high=130.0, speed=speed)

    def placed(is_strip):
        filled = {name: dr.full(types.Float, value, count) for name, value in model.items()}
        given = [from_host(types.Float, v) for v in rng.random((5, count))]
        lanes = LaneEdges(**filled, is_strip=dr.full(types.Bool, is_strip, count))
        out = lanes.place((given[0] - 0.5, given[1] - 0.5), (given[2], given[3]), given[4])
        return [np.array(v, np.float64) for v in out], np.array(given[4])

    (x, y, share, weight, flux), drawn = placed(False)
    distance = 0.8 * x - 0.6 * y + 0.27 + speed * (share - 0.5)
    np.testing.assert_array_equal(share, drawn)
    np.testing.assert_array_equal(flux, np.where(distance > 0, 130, 40))
    density = 2 / weight - 1
    assert np.all((density > 0) == ((abs(distance) <= 0.09) & (density > 0)))
    times = np.clip(sorted((np.array([-0.7, 0.7]) - 0.27) / speed) if speed else [-0.5, 0.5], -0.5, 0.5)
    at = share - 0.5
    is_in = (abs(distance) < 0.0899) & (at > times[0] + 1e-4) & (at < times[1] - 1e-4)
    assert np.all(density[is_in] > 0) and np.all(density[(at < times[0] - 1e-4) | (at > times[1] + 1e-4)] == 0)
    # some drawn rays find no point of the pixel at their distance, and count for nothing
    (x, y, share, weight, _), _ = placed(True)
    met = weight > 0
    assert density.mean() == pytest.approx(met.mean(), abs=0.02) and met.mean() > 0.85
    distance = 0.8 * x - 0.6 * y + 0.27 + speed * (share - 0.5)
    assert np.all(abs(distance[met]) <= 0.0901) and np.all(np.maximum(abs(x), abs(y))[met] <= 0.5001)
    assert np.all((share[met] - 0.5 >= times[0] - 1e-4) & (share[met] - 0.5 <= times[1] + 1e-4))
    # the mean of anything over the strip by its own rays, over their density
    value = 1 + 2 * x - 0.7 * y + 3 * share**2
    own = (value / (2 / np.where(met, weight, 1) - 1))[met].sum() / met.size
    (x, y, share, weight, _), _ = placed(False)
    value = 1 + 2 * x - 0.7 * y + 3 * share**2
    assert own == pytest.approx(np.mean(value * (weight < 2)), rel=0.02)


def test_few_rays_about_a_moving_line_do_the_work_of_many():
    """Windows of 2 ms, in which the plates move by a third of a pixel: 64 rays against 256 and 1024 plain ones."""
    tracer = pair_tracer(plates(), hr.load_sensor("davis346").crop(60, 44))
    pixel = np.tile(tracer.sensor.layout.full_index.ravel(), 2)
    window, begin = np.repeat(np.arange(2), pixel.size // 2), np.array([1300.0, 21_000.0])
    windows, controlled = Windows(begin, begin + 2000), np.ones(pixel.size, np.bool_)
    fit = tracer.edges(pixel, window, windows, 64, 1.5, controlled, np.zeros(pixel.size, np.float32), moves=True)
    here = np.flatnonzero(fit.is_edge & (np.abs(fit.speed) > 0.05) & (fit.high > 1.02 * fit.low))
    assert here.size > 150 and tracer.moves_within(windows) and not tracer.moves_within(Windows(begin, begin + 99))
    pairs, few = (pixel[here], window[here], windows), np.full(here.size, 64)
    truth = np.mean(
        [tracer.trace(*pairs, 64 * few, controlled[here], Stream.AUDIT, repeat=k).mean for k in range(4)], axis=0
    )
    by_line = tracer.trace(*pairs, few, controlled[here], edges=fit.models(here)).mean - truth
    plainly = {times: tracer.trace(*pairs, times * few, controlled[here]).mean - truth for times in (4, 16)}
    assert np.sqrt(np.mean(by_line**2)) < np.sqrt(np.mean(plainly[4] ** 2))
    assert np.median(np.abs(by_line)) < np.median(np.abs(plainly[16]))
