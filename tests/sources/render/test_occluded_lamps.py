"""Parts of lamps that boxes, parallelograms and balls hide: closed forms against sums over the lamp in NumPy."""

from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
from rendering import make_scene, mono, pair_tracer

import hesim_render as hr
from hesim_render.core.device import dr
from hesim_render.core.host_arrays import from_host
from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven import decision_rays
from hesim_render.sources.render.change_driven.known_shadows import with_known_shadows
from hesim_render.sources.render.change_driven.pair_flux import PilotFlux
from hesim_render.sources.render.change_driven.windows import Windows
from hesim_render.sources.render.scene.mitsuba_version import mitsuba
from hesim_render.sources.render.transport import occluded_lamps
from hesim_render.sources.render.transport.irradiance import RectangleLight
from hesim_render.sources.render.transport.occluded_lamps import LampShadows, most_frequent

#: A skew box, a parallelogram and a ball: corner and sides, corner and sides, centre and radius, m.
BOX = np.array([[-0.1, -0.2, 0.7], [0.52, 0.1, 0.06], [-0.05, 0.31, 0.1], [0.07, -0.04, 0.4]])
PLATE = np.array([[-0.3, 0.4, 0.9], [0.5, 0.1, 0.2], [-0.1, -0.6, 0.15]])
BALL, RADIUS = np.array([0.15, -0.1, 1.05]), 0.37
#: Numbers of the three in order of their size, from 1.
PLATE_CODE, BALL_CODE, BOX_CODE = 1, 3, 2


def frame():
    """A tilted lamp above, 1.2 m × 0.7 m, that shines downwards."""
    normal = np.array([0.2, -0.1, -1.0])
    normal /= np.linalg.norm(normal)
    width = np.cross([0.0, 1.0, 0.0], normal)
    width /= np.linalg.norm(width)
    out = np.eye(4)
    out[:3] = np.stack([0.6 * width, 0.35 * np.cross(normal, width), normal, [0.1, 0.3, 2.4]], axis=1)
    return out


def mesh(mi, corners, faces):
    made = mi.Mesh("made", vertex_count=len(corners), face_count=len(faces))
    parameters = mi.traverse(made)
    parameters["vertex_positions"] = np.asarray(corners, np.float32).ravel()
    parameters["faces"] = np.asarray(faces, np.uint32).ravel()
    parameters.update()
    return made


def box_mesh(mi, box):
    corner, *sides = box
    places = np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)])
    quads = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]
    return mesh(mi, corner + places @ np.array(sides), [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def shadows():
    mi = mitsuba()
    corner, a, b = PLATE
    plate = mesh(mi, [corner, corner + a, corner + a + b, corner + b], [(0, 1, 2), (0, 2, 3)])
    ball = {"type": "sphere", "center": BALL.tolist(), "radius": RADIUS}
    others = {"disk": {"type": "disk"}, "cylinder": {"type": "cylinder"}}
    static = mi.load_dict({"type": "scene", "box": box_mesh(mi, BOX), "plate": plate, "ball": ball, **others})
    return LampShadows(SimpleNamespace(mi=mi, static=static, groups=[]))


def meets(code, point, along):
    """Which segments from a point, point + t·along for t from 0 to 1, meet a shape."""
    if code == BALL_CODE:
        square = (along**2).sum(-1)
        half, rest = along @ (point - BALL), ((point - BALL) ** 2).sum() - RADIUS**2
        root = np.sqrt(np.maximum(half**2 - square * rest, 0))
        return (half**2 >= square * rest) & (-half + root >= 0) & (-half - root <= square)
    if code == PLATE_CODE:
        corner, a, b = PLATE
        t = np.cross(a, b) @ (corner - point) / (along @ np.cross(a, b))
        u, v = np.linalg.lstsq(np.stack([a, b], axis=1), (point + t[:, None] * along - corner).T, rcond=None)[0]
        return (t >= 0) & (t <= 1) & (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
    to_places = np.linalg.inv(BOX[1:].T)
    origin, speed = to_places @ (point - BOX[0]), along @ to_places.T
    one, other = -origin / speed, (1 - origin) / speed
    enter, leave = np.minimum(one, other).max(axis=-1), np.maximum(one, other).min(axis=-1)
    return (enter <= leave) & (leave >= 0) & (enter <= 1)


def hidden_part(code, point, normal, cells=400):
    """∫ cos θ dω over the hidden part of the lamp, by its cells."""
    lamp = frame()
    place = (np.arange(cells) + 0.5) / cells * 2 - 1
    along = (lamp[:3, 3] - point + place[:, None, None] * lamp[:3, 0] + place[None, :, None] * lamp[:3, 1]).reshape(
        -1, 3
    )
    area = 4 * np.linalg.norm(lamp[:3, 0]) * np.linalg.norm(lamp[:3, 1]) / cells**2
    weight = np.maximum(along @ normal, 0) * np.maximum(-(along @ lamp[:3, 2]), 0) / (along**2).sum(-1) ** 2 * area
    return weight[meets(code, point, along)].sum(), weight.sum()


def before(code, points, normals, seed=4):
    """`LampShadows.before` of points, with a shadow ray of each; and the share of that ray."""
    mi, lamp = mitsuba(), RectangleLight(mitsuba(), frame())
    point, normal = (np.ascontiguousarray(v.T, np.float32) for v in (points, normals))
    point, normal = mi.Point3f(point), mi.Vector3f(normal)
    place = mi.Point2f(np.random.default_rng(seed).random((2, len(points))).astype(np.float32))
    drawn, share = lamp.sample(point, normal, place)
    ray = mi.Ray3f(point, dr.normalize(drawn - point))
    ray.maxt = dr.norm(drawn - point) * (1 - 1e-4)
    hidden, count = shadows().before(
        lamp, normal, ray, None, from_host(mi.UInt32, np.full(len(points), code, np.uint32))
    )
    return np.array(hidden), np.array(count), np.array(share)


@pytest.mark.parametrize("code", [PLATE_CODE, BOX_CODE, BALL_CODE])
def test_the_hidden_part_is_a_sum_over_the_lamp(code):
    """28 points around the shapes, from light to shadow: within what the cells at the rim of a shadow miss."""
    rng = np.random.default_rng(11)
    points = rng.uniform([-1, -1, -0.5], [1, 1, 0.4], (28, 3))
    normals = rng.normal(size=(28, 3)) * 0.35 + [0, 0, 1]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    hidden, *_ = before(code, points, normals)
    parts = np.array([hidden_part(code, *pair) for pair in zip(points, normals, strict=True)])
    np.testing.assert_allclose(hidden, parts[:, 0], atol=2e-3 * parts[:, 1].max())
    shares = parts[:, 0] / parts[:, 1]
    assert shares.max() > 0.7 and shares.min() < 0.01 and np.count_nonzero((shares > 0.1) & (shares < 0.9)) > 8


@pytest.mark.parametrize("code", [PLATE_CODE, BOX_CODE, BALL_CODE, PLATE_CODE + 256 * BALL_CODE + (BOX_CODE << 16)])
def test_shadow_rays_meet_what_is_hidden(code):
    """The mean of the control variate that rays correct is the closed form: z of 12 points, 40,000 rays each."""
    rng = np.random.default_rng(12)
    for point in rng.uniform([-0.7, -0.7, -0.5], [0.7, 0.7, 0.3], (12, 3)):
        normal = np.array([0.1, -0.2, 1.0]) / 1.05**0.5
        hidden, count, share = before(code, np.tile(point, (40_000, 1)), np.tile(normal, (40_000, 1)))
        met = share * count
        assert np.ptp(hidden) == 0 and abs(met.mean() - hidden[0]) <= 4.5 * met.std() / 200 + 1e-6


def test_what_stands_within_or_behind_hides_nothing():
    """A point in a box or a ball, in the plane of the plate, one whose horizon cuts the lamp, and one behind it."""
    lamp = frame()
    inside_box, inside_ball = BOX[0] + BOX[1:].sum(axis=0) * [0.4, 0.5, 0.3], BALL + np.array([0.2, 0.1, -0.25])
    in_plane, on_plate = (PLATE[0] + u * PLATE[1] + v * PLATE[2] for u, v in ((1.7, -0.4), (0.3, 0.6)))
    behind = lamp[:3, 3] - 0.2 * lamp[:3, 2] + [0.4, 0.1, 0]
    up, level = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.05]) / 1.00125**0.5
    for code, point, normal in (
        (BOX_CODE, inside_box, up), (BALL_CODE, inside_ball, up), (PLATE_CODE, in_plane, up),
        (PLATE_CODE, on_plate + 1e-6 * up, up), (PLATE_CODE, on_plate - 1e-6 * up, up),
        (BOX_CODE, np.array([0.0, 0.1, 0.2]), level), (BALL_CODE, behind, -up),
    ):  # fmt: skip
        hidden, count, _ = before(code, np.tile(point, (512, 1)), np.tile(normal, (512, 1)))
        assert not hidden.any() and not count.any(), (code, point)
    # a ball or a box that reaches behind the lamp is not counted
    for code, shape in ((BALL_CODE, {"BALL": lamp[:3, 3] + 0.3 * lamp[:3, 2]}), (BOX_CODE, {"BOX": BOX.copy()})):
        if "BOX" in shape:
            shape["BOX"][0] = lamp[:3, 3] + 0.15 * lamp[:3, 2]
        with mock.patch.dict(globals(), shape):
            hidden, count, _ = before(code, np.tile([0.0, 0.1, 0.2], (512, 1)), np.tile(up, (512, 1)))
        assert not hidden.any() and not count.any()


def test_a_small_far_lamp_counts_as_a_point_and_nothing_is_known_of_it():
    lamp = frame()
    lamp[:3, :2] *= 0.004
    with mock.patch.dict(globals(), frame=lambda: lamp):
        hidden, *_ = before(BALL_CODE, np.tile([0.1, 0.0, 0.2], (64, 1)), np.tile([0.0, 0.0, 1.0], (64, 1)))
    assert not hidden.any()


def test_rays_name_the_shapes_that_they_meet():
    """Each ray the first of the list; of a pair the four that are met most often, of equal ones the lower number."""
    known, mi = shadows(), mitsuba()
    assert known.is_known
    points = np.array([[0.15, -0.1, 0.3], [0.2, 0.2, 0.1], [-0.9, -0.9, 1.3], [-0.25, 0.2, 0.3]])
    along = np.array([0.05, 0.1, 2.0])
    length = np.linalg.norm(along)
    ray = mi.Ray3f(mi.Point3f(np.float32(points.T)), mi.Vector3f(np.float32(along / length)))
    ray.maxt = float(length)
    hits = np.array([[meets(code, point, along[None])[0] for code in (1, 2, 3)] for point in points])
    first = np.where(hits.any(axis=1), np.argmax(hits, axis=1) + 1, 0)
    assert len(set(first.tolist())) == 4
    np.testing.assert_array_equal(np.array(known.first_met(ray, None, mi.Bool(True))), first)
    np.testing.assert_array_equal(
        np.array(known.first_met(ray, None, mi.Bool([True, False, True, False]))), first * [1, 0, 1, 0]
    )
    ray.maxt = 0.05
    assert not np.array(known.first_met(ray, None, mi.Bool(True))).any()
    # two lamps: eight bits of each ray are for the second one
    met = np.array(
        [[0, 7, 7, 9, 9, 2, 3, 4, 9, 4], [0] * 10, [5 + (5 << 8), 64 << 8, 64, 0, 0, 0, 0, 0, 0, 64]], np.uint32
    )
    assert most_frequent(met).tolist() == [9 + (4 << 8) + (7 << 16) + (2 << 24), 0, 64 + (5 << 8)]


def test_only_the_largest_shapes_are_known():
    with mock.patch.object(occluded_lamps, "_MOST", 2):
        known = shadows()
    rows = np.array(known._rows).reshape(-1, 16)
    # a parallelogram has no height, and neither is a ball
    assert rows.shape == (2, 16) and rows[:, 7].tolist() == [0, 1] and not rows[:, 11].any()


def thing(name, shape, size, position, reflectance, **more):
    placed = {"name": name, "shape": shape, "size_m": size, "position_m": position, "reflectance": reflectance}
    return {**placed, **{"rotation_axis": [1, 0, 0.2], **more}}


def room(ball_m=(0.35, 0.2, 0.1), ball_moves=()):
    """A floor seen from its back, with a box that turns about a skew axis, a ball, and a post with a plate on it, below
    two panels.
    """
    turn = {"rotation_axis": [0.2, 1, 0.3], "rotation_deg": 50, "translation_m": [0.05, 0.1, 0]}
    panel = {"type": "area", "illuminant": "LED-B3", "plane_point_m": [0, 0, 0], "plane_normal": [0, 1, 0]}
    one = {"illuminance_lux": 900, "position_m": [0.4, 1.6, 0.5], "size_m": [0.6, 0.4]}
    other = {"illuminance_lux": 300, "position_m": [-0.9, 1.3, 0.2], "size_m": [0.3, 0.5]}
    beam = {"type": "directional", "illuminant": "LED-B3", "direction": [0.3, -1, -0.4], "illuminance_lux": 200}
    return make_scene(
        objects=[
            thing("floor", "rectangle", [3, 3, 0], [0, 0, 0], 0.55, rotation_deg=90, rotation_axis=[1, 0, 0]),
            thing("box", "box", [0.3, 0.22, 0.4], [-0.3, 0.35, 0], 0.4),
            thing("ball", "sphere", [0.34] * 3, list(ball_m), 0.7),
            thing("post", "box", [0.06, 0.5, 0.06], [0.05, 0.25, -0.3], 0.3),
            thing("plate", "rectangle", [0.3, 0.2, 0], [0.05, 0.52, -0.3], 0.6, rotation_deg=-70),
        ],
        light=[{**panel, **one}, {**panel, **other}, beam],
        camera={"origin_m": [0.1, 1.1, 1.5], "target_m": [0, 0.15, -0.05], "horizontal_fov_deg": 42},
        motion=[{"object": "box", "keyframes": [{"t_us": 0}, {"t_us": 40_000, **turn}]}, *ball_moves],
    )


def test_flux_with_known_shadows_is_that_without():
    """Two lamps and a beam, shapes that move and shapes behind each other: z of 600 pairs, and a fifth of the noise."""
    tracer = pair_tracer(room(), mono(96, 72), seed=5)
    assert tracer.knows_shadows
    rng = np.random.default_rng(6)
    windows = Windows(np.array([3e3, 21e3, 37e3]), np.array([3.5e3, 22e3, 39e3]))
    pixel, window = rng.permutation(tracer.sensor.layout.full_index.ravel())[:4000], rng.integers(0, 3, 4000)
    codes = tracer.shadows(pixel, window, windows, 1.3)
    some = np.flatnonzero(codes)[:600]
    assert some.size == 600 and np.count_nonzero(codes[some] > 255) > 60
    repeat, each = np.repeat(np.arange(12), 600), np.tile(some, 12)
    plain, known = (
        tracer.trace(
            *(pixel[each], window[each], windows, np.full(each.size, 128), np.ones(each.size, bool)),
            repeat=repeat + 20 * (shadows is None), signed=True, shadows=shadows,
        ).mean.reshape(12, 600).astype(np.float64)
        for shadows in (None, codes[each])
    )  # fmt: skip
    difference = known.mean(axis=0) - plain.mean(axis=0)
    error = np.sqrt((known.var(axis=0, ddof=1) + plain.var(axis=0, ddof=1)) / 12)
    assert np.sqrt(np.mean((difference / error) ** 2)) < 1.25
    assert abs(difference.sum()) < 3.5 * np.sqrt((error**2).sum())
    assert known.var(axis=0).sum() < plain.var(axis=0).sum() / 4
    # a few rays of the decision are enough to see that nothing is left to see
    seen, blind = (
        tracer.pilot(pixel[some], window[some], windows, 32, 1.3, shadows=shadows) for shadows in (codes[some], None)
    )
    assert np.median(seen.controlled_scatter) < 0.3 * np.median(blind.controlled_scatter)
    np.testing.assert_array_equal(seen.controlled, seen.plain)
    alone = codes[some] < 256
    assert np.median(seen.unshadowed[alone] / blind.unshadowed[alone]) < 0.95 and np.all(
        seen.unshadowed <= blind.unshadowed * 1.0001
    )
    np.testing.assert_allclose(seen.unshadowed[~alone], blind.unshadowed[~alone], rtol=1e-5)


def test_a_scene_without_lamps_or_shapes_knows_none():
    assert not pair_tracer(hr.load_scene("rotating-star"), mono(32, 24), seed=2).knows_shadows
    # an object whose light has no closed form shines
    assert not pair_tracer(hr.load_scene("led-grid"), mono(32, 24), seed=2).knows_shadows


def test_things_that_move_cast_the_shadows_of_things_at_rest_there():
    """A ball that comes to a place, against one that is there; eight bits for each of two lamps."""
    there = {"translation_m": [0.25, 0.05, 0.35]}
    keys = [{"t_us": 0}, {"t_us": 30_000, **there}, {"t_us": 60_000, **there}]
    comes = room(ball_moves=[{"object": "ball", "keyframes": keys}])
    is_there = room(ball_m=(0.6, 0.25, 0.45))
    window, counts, met = Windows(np.array([41e3]), np.array([43e3])), [], []

    def recorded(values):
        met.append(values)
        return most_frequent(values)

    for scene in (comes, is_there):
        tracer = pair_tracer(scene, mono(96, 72), seed=5)
        rows = np.array(tracer._integrator._shadows._rows).reshape(-1, 16)
        ball = 1 + int(np.flatnonzero(rows[:, 11])[0])
        pixel = tracer.sensor.layout.full_index.ravel()
        with mock.patch.object(decision_rays, "most_frequent", recorded):
            codes = tracer.shadows(pixel, np.zeros(pixel.size, int), window, 1.3)
        counts.append((codes[:, None] >> np.arange(0, 32, 8, dtype=np.uint32) & 255 == ball).any(axis=1))
    assert counts[1].sum() > 200 and np.count_nonzero(counts[0] != counts[1]) <= 5
    # eight bits for each lamp; five things, and the lamps themselves
    for values in met:
        one, other = values & 255, values >> 8
        assert one.any() and other.any() and max(one.max(), other.max()) <= 7


class Shaded:
    """A tracer that knows the shadows `codes`, with which pairs scatter by `scatter` and let `light` through."""

    knows_shadows = True

    def __init__(self, codes, scatter, light):
        self.codes, self.scatter, self.light, self.asked = codes, scatter, light, []

    def shadows(self, pixel, window, windows, width_px, stream):
        self.asked.append((pixel.tolist(), window.tolist(), width_px, stream))
        return self.codes[pixel]

    def pilot(self, pixel, window, windows, rays, width_px, stream, mild, shadows):
        assert np.all(shadows == self.codes[pixel]) and (rays, width_px, mild) == (32, 1.3, True)
        out = PilotFlux.empty(pixel.size)
        out.controlled[:], out.plain[:], out.controlled_change[:] = 91, 91, 77
        out.controlled_scatter[:] = out.plain_scatter[:] = self.scatter[pixel]
        out.unshadowed[:] = self.light[pixel]
        return out


def test_shadows_are_known_where_they_save_rays():
    """Wanted error 2: light above 8 is hidden, 64 rays are asked for by scatter or light, and half are saved."""
    # 0: penumbra. 1: scatters as before. 2: 7 of light hidden. 3: few rays. 4: full shadow. 5: not asked. 6: no shape
    scatter = np.array([120, 120, 120, 5, 0, 120, 120], np.float32)
    flux = np.array([150, 150, 393, 150, 0, 150, 150], np.float32)
    open_flux = np.array([400, 400, 400, 160, 900, 400, 400], np.float32)
    codes = np.array([7, 7, 7, 7, 9, 7, 0], np.uint32)
    light = np.array([92, 400, 90, 80, 0, 90, 90], np.float32)
    tracer = Shaded(codes, np.array([4, 119, 4, 1, 0, 4, 4], np.float32), light)
    seen = PilotFlux.empty(7)
    seen.controlled[:], seen.plain[:], seen.unshadowed[:] = flux + 1, flux, open_flux
    seen.controlled_scatter[:], seen.plain_scatter[:], seen.controlled_change[:] = 500, scatter, 33
    pairs = np.arange(7, dtype=np.uint32), np.arange(7) + 3, None
    given = tracer, pairs, seen, 32, 1.3, lambda flux: np.full(flux.shape, 2, np.float32), True
    out, known = with_known_shadows(*given, stream=Stream.AUDIT_PILOT, among=np.arange(7) != 5)
    assert tracer.asked == [([0, 1, 4, 6], [3, 4, 7, 9], 1.3, Stream.AUDIT_PILOT)]
    assert known.tolist() == [7, 0, 0, 0, 9, 0, 0]
    np.testing.assert_array_equal(out.controlled, np.where(known > 0, 91, flux + 1))
    np.testing.assert_array_equal(out.unshadowed[[0, 1, 4]], [92, 400, 0])
    assert np.all(out.controlled_change == 33)
    # by the light of a ray alone: 100 rays, of which 40 or 60 are left
    for left, expected in ((160, 7), (240, 0)):
        tracer.scatter[0], tracer.light[0], seen.plain_scatter[0] = 1, left, 1
        assert with_known_shadows(*given)[1][0] == expected
    assert not with_known_shadows(*given[:5], None, True)[1].any()
    tracer.knows_shadows = False
    assert not with_known_shadows(*given)[1].any()
