"""Boxes, outlines and speeds of moving objects hold at every instant, keyframes or not."""

import time
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hesim_render.sources.render.change_driven.neighbours import turns
from hesim_render.sources.render.change_driven.small_objects import Zoom
from hesim_render.sources.render.scene.trajectory import Trajectory
from hesim_render.sources.render.timeline import Timeline
from hesim_render.sources.render.transport.motion_bounds import (
    _speed_and_turn,
    fastest_m_per_s,
    places,
    places_seen,
    stays_in,
)
from hesim_render.sources.render.truth.boxes import _outline
from hesim_render.specs.motion import TrackSpec

CORNERS = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (0.2, 0.4) for z in (-0.3, 0.0)])


def track(*keyframes, **options):
    return Trajectory(TrackSpec.model_validate({"object": "x", "keyframes": list(keyframes), **options}))


def random_track(rng):
    """Shifts, turns about changing axes, jumps of a microsecond, held and repeated."""
    times = np.cumsum(rng.choice([1, 200, 700, 3000], rng.integers(2, 7)))
    one_axis = rng.random() < 0.5
    axis = rng.normal(size=3).tolist()
    keys = [
        {
            "t_us": int(t),
            "translation_m": rng.normal(size=3).tolist(),
            "rotation_axis": axis if one_axis else rng.normal(size=3).tolist(),
            "rotation_deg": float(rng.uniform(-1000, 1000) if one_axis else rng.uniform(-170, 170)),
        }
        for t in times
    ]
    repeat = bool(rng.random() < 0.5)
    if repeat:
        keys.append({**keys[0], "t_us": int(times[-1]) + 500})
    return track(*keys, pivot_m=rng.normal(size=3).tolist(), repeat=repeat)


def seen(trajectory, begin, end):
    """Corners at instants crowded about the ends and everywhere else, [k, 8, 3]."""
    knots = trajectory.knots_us.astype(float)
    period = knots[-1] - knots[0]
    turns = np.arange(np.floor(begin / period) - 1, np.ceil(end / period) + 1) if trajectory.repeat else [0.0]
    at_knots = (knots[None] + np.array(turns)[:, None] * period).ravel()
    times = np.concatenate([np.linspace(begin, end, 1500), at_knots, at_knots + 0.5, at_knots - 0.5])
    poses = trajectory.matrix(times[(times >= begin) & (times <= end)])
    return CORNERS @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]


@pytest.mark.parametrize("seed", range(60))
def test_an_object_never_leaves_its_box(seed):
    rng = np.random.default_rng(seed)
    trajectory = random_track(rng)
    spans = []
    for length in (1.0, 300.0, 2500.0, 20_000.0):
        begin = float(rng.uniform(0, 8000))
        spans.append((begin, begin + length))
    for (begin, end), (low, high) in zip(spans, stays_in(CORNERS, trajectory, spans), strict=True):
        points = seen(trajectory, begin, end)
        assert np.all(points >= low - 1e-9) and np.all(points <= high + 1e-9)
        # and the box is not much larger than what it holds, where the object turns little
        size = np.ptp(points.reshape(-1, 3), axis=0)
        assert np.all(high - low < 1.6 * size + 0.05)


def test_what_comes_for_a_moment_is_in_the_box():
    there = track({"t_us": 0}, {"t_us": 3010}, {"t_us": 3011, "translation_m": [0, 5, 0]},
                  {"t_us": 3710, "translation_m": [0, 5, 0]}, {"t_us": 3711})  # fmt: skip
    (low, high), (_, before) = stays_in(CORNERS, there, [(2000.0, 4000.0), (2000.0, 3010.0)])
    assert high[1] == pytest.approx(5.4) and low[1] == pytest.approx(0.2)
    assert before[1] == pytest.approx(0.4)


def test_straight_lines_between_places_are_within_their_margin():
    turning = track({"t_us": 0}, {"t_us": 10_000, "rotation_axis": [0, 0.2, 1], "rotation_deg": 700})
    ((points, margin),) = places(CORNERS, turning, 1000.0, 3000.0)
    # from 70° to 210° in the sense of a right-handed screw
    axis = np.array([0, 0.2, 1]) / np.sqrt(1.04)
    for k, angle_deg in ((0, 70), (-1, 210)):
        wanted = Rotation.from_rotvec(np.radians(angle_deg) * axis).apply(CORNERS)
        np.testing.assert_allclose(points[k], wanted, atol=1e-9)
    share = np.linspace(0, 1, 40)[:, None, None, None]
    lines = points[:-1] + share * np.diff(points, axis=0)
    poses = turning.matrix(np.linspace(1000.0, 3000.0, 400))
    true = CORNERS @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
    for corner in range(8):
        every = lines[:, :, corner].reshape(-1, 3)
        far = np.linalg.norm(true[:, None, corner] - every, axis=2).min(axis=1)
        assert far.max() < margin + 2e-3


@pytest.mark.parametrize("seed", range(16))
def test_nothing_leaves_its_outline_before_a_camera_that_moves(seed):
    """In the camera's frame: dense instants, those about all keyframes too, against the hulls and their margins."""
    rng = np.random.default_rng(200 + seed)
    trajectory, camera = random_track(rng), random_track(rng)
    begin = float(rng.uniform(0, 6000))
    end = begin + float(rng.choice([3.0, 900.0, 5000.0]))
    times = np.concatenate([np.linspace(begin, end, 1000), *(np.add.outer(t.ends_us(begin, end), [-0.01, 0, 0.01])
                            .ravel() for t in (trajectory, camera))])  # fmt: skip
    times = times[(times >= begin) & (times <= end)]
    poses, views = trajectory.matrix(times), camera.matrix(times)
    points = CORNERS @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
    local = np.einsum("kji,knj->kni", views[:, :3, :3], points - views[:, None, :3, 3])
    found = places_seen(CORNERS, trajectory, camera, begin, end)
    for corner in range(8):
        far = np.full(times.size, np.inf)
        for there, margin in found:
            a, b = there[:-1, corner], there[1:, corner]
            way = b - a
            share = np.einsum("kni,ni->kn", local[:, None, corner] - a, way) / np.maximum(np.sum(way**2, axis=1), 1e-30)
            off = local[:, None, corner] - a - np.clip(share, 0, 1)[..., None] * way
            far = np.minimum(far, np.linalg.norm(off, axis=2).min(axis=1) - margin)
        assert far.max() < 1e-9
    # and the margins are not what does it: of a tenth of the way at most
    ways = max(float(np.ptp(there, axis=0).max()) for there, _ in found)
    assert max(margin for _, margin in found) < 0.05 * ways + 0.02


def test_a_keyframe_ends_a_stretch_of_time():
    once = track({"t_us": 100}, {"t_us": 300}, {"t_us": 301, "translation_m": [1, 0, 0]})
    assert once.ends_us(0, 1000).tolist() == [100, 300, 301]
    assert once.ends_us(100, 301).tolist() == [300]
    again = track({"t_us": 100}, {"t_us": 300, "translation_m": [1, 0, 0]}, {"t_us": 350}, repeat=True)
    assert again.ends_us(0, 500).tolist() == [50, 100, 300, 350]
    assert again.ends_us(400, 900).tolist() == [550, 600, 800, 850]


def test_no_point_is_faster_than_the_fastest():
    for seed in range(20):
        trajectory = random_track(np.random.default_rng(100 + seed))
        begin, end = 500.0, 4500.0
        times = np.linspace(begin, end, 8001)
        poses = trajectory.matrix(times)
        points = CORNERS @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
        speed = np.linalg.norm(np.diff(points, axis=0), axis=2).max() / 0.5e-6
        assert speed <= fastest_m_per_s(CORNERS, trajectory, begin, end) * (1 + 1e-6)


def test_edges_of_boxes_are_followed_at_every_eighth_where_the_lens_bends_them():
    """28 lines between the 8 corners of each box, in order of the first corner, with 7 points each."""
    corners = np.random.default_rng(4).normal(size=(3, 16, 3))
    bent = SimpleNamespace(_view=SimpleNamespace(projection=SimpleNamespace(distortion="brown")))
    found = Zoom._along_edges(bent, corners).reshape(3, 2, 8 + 7 * 28, 3)
    boxes = corners.reshape(3, 2, 8, 3)
    np.testing.assert_array_equal(found[:, :, :8], boxes)
    lines = [(i, j) for i in range(8) for j in range(i + 1, 8)]
    for k in range(7):
        share = (k + 1) / 8
        for number, (i, j) in enumerate(lines):
            expected = (1 - share) * boxes[:, :, i] + share * boxes[:, :, j]
            np.testing.assert_allclose(found[:, :, 8 + 28 * k + number], expected)
    assert Zoom._along_edges(bent, corners[:, :9]).shape == (3, 9, 3)  # no boxes
    straight = SimpleNamespace(_view=SimpleNamespace(projection=SimpleNamespace(distortion=None)))
    assert Zoom._along_edges(straight, corners) is corners


def test_a_sphere_is_outlined_by_the_rays_that_touch_it():
    """Each point lies on the sphere, and its ray is at right angles to the radius; none from within the sphere."""
    middle, radius = np.array([0.3, -0.7, -2.0]), 0.6
    points = _outline(middle, radius)
    np.testing.assert_allclose(np.linalg.norm(points - middle, axis=1), radius)
    np.testing.assert_allclose(np.sum(points * (points - middle), axis=1), 0, atol=1e-12)
    circle = points - points.mean(axis=0)
    turned = np.sum(circle * np.roll(circle, 1, axis=0), axis=1) / np.sum(circle**2, axis=1)
    np.testing.assert_allclose(turned, np.cos(2 * np.pi / len(points)))  # evenly, all the way round
    assert np.isnan(_outline(np.array([0.1, 0.0, 0.2]), 0.3)).all() and np.isnan(_outline(np.zeros(3), 0.1)).all()


def test_slices_of_what_does_not_move_are_never_cut():
    still = Timeline(None, None, {}, {}, np.zeros((8, 3)))
    assert still.camera_motion_px(0, 1000) == 0 and still.pose_time_us(200, 500) == 350
    assert still.edges_us(0, 1000).size == 0


def test_pairs_know_how_many_windows_of_their_row_come_first():
    row, window = np.array([4, 2, 4, 2, 2, 4, 4]), np.array([9, 5, 3, 1, 7, 9, 30])
    assert turns(row, window).tolist() == [1, 1, 0, 0, 2, 1, 2]
    assert turns(row[:0], window[:0]).size == 0


@pytest.mark.parametrize(
    ("begin_us", "end_us", "speed", "turn"),
    [
        (600, 900, 0, 0),  # held before the first keyframe
        (1000, 1300, 0.05 / 2e-3, np.radians(20) / 2e-3),
        (3000, 5000, 0.12 / 4e-3, np.radians(30) / 4e-3),
        (6600, 7000, 0.12 / 4e-3, np.radians(30) / 4e-3),
        (7000, 7400, 0, 0),
    ],
)
def test_speed_and_turn_of_a_piece_by_hand(begin_us, end_us, speed, turn):
    """5 cm and 20° in 2 ms, 12 cm and 30° in 4 ms; the same again where the track repeats, 6 ms later."""
    keys = [
        {"t_us": 1000},
        {"t_us": 3000, "translation_m": [0.03, 0.04, 0], "rotation_axis": [0, 0, 1], "rotation_deg": 20},
        {"t_us": 7000, "translation_m": [0.03, 0.04, 0.12], "rotation_axis": [0, 0, 1], "rotation_deg": -10},
    ]  # fmt: skip
    assert _speed_and_turn(track(*keys), begin_us, end_us) == pytest.approx((speed, turn))
    keys[-1] = {"t_us": 7000}
    again = _speed_and_turn(track(*keys, repeat=True), begin_us + 6000, end_us + 6000)
    first = (0.05 / 2e-3, np.radians(20) / 2e-3)
    back = (0.05 / 4e-3, np.radians(20) / 4e-3)
    assert again == pytest.approx(first if 1000 <= begin_us < 3000 or begin_us >= 7000 else back)


@pytest.mark.parametrize("flat", [False, True])
def test_a_swept_outline_is_as_much_wider_as_its_object_may_stray(flat):
    """40 × 20 px, 1 cm of stray at 100 px/m and 0.3 px of defocus: 1.3 px on all sides; a line has a box alone."""
    corners = np.array([[0.1, 0.2, 0], [0.5, 0.2, 0], [0.5, 0.4, 0], [0.1, 0.4, 0]])
    if flat:
        corners[:, 1] = 0.2
    places_ = [(corners[None], 0.002), (corners[None], 0.01)]
    view = SimpleNamespace(
        camera_to_world=np.eye(4), defocus_px=lambda scale: 0.3,
        project_on_sensor=lambda points, rest: (100 * points[..., :2], np.full(points.shape[:2], 100.0)),
    )  # fmt: skip
    zoom = SimpleNamespace(
        _places=lambda *given: places_, _view=view, _along_edges=lambda points: points, _low=np.zeros(2),
        _high=np.array([200.0, 100.0]), _tuning=SimpleNamespace(small_px=19.9), _aim_px=41,
    )  # fmt: skip
    found = Zoom._outline(zoom, 7, None, 0.0, 1.0)
    np.testing.assert_allclose([found.low, found.high], [[8.7, 18.7], [51.3, 21.3 if flat else 41.3]])
    assert (len(found.sides) == 0) is flat and found.is_small is flat
    zoom._aim_px = 39
    assert found.target == 7 and Zoom._outline(zoom, 7, None, 0.0, 1.0).target is None
    for beyond in (1.25, 1.35) if not flat else ():
        for x, y in ((10 - beyond, 30), (50 + beyond, 30), (30, 20 - beyond), (30, 40 + beyond)):
            assert np.all(found.sides @ [x, y, 1] <= 0) == (beyond < 1.3)
    for low, high in (([51.4, 0], [200, 100]), ([0, 0], [8.6, 100]), ([0, 41.4], [200, 100]), ([0, 0], [200, 18.6])):
        zoom._low, zoom._high = np.array(low, float), np.array(high, float)
        assert Zoom._outline(zoom, 7, None, 0.0, 1.0) is None


def _many_keys(count, repeat=False):
    """A track of uneven steps, as a motion-capture file has them, µs and m."""
    rng = np.random.default_rng(count)
    times = 130 + np.append(0, np.cumsum(rng.integers(3, 90, count - 1)))
    return track(
        *({"t_us": int(t), "translation_m": [0.001 * k, 0.2, -0.003 * k]} for k, t in enumerate(times)), repeat=repeat
    )


@pytest.mark.parametrize("repeat", [False, True])
def test_pieces_are_all_segments_that_an_interval_meets(repeat):
    """Each segment was compared with the interval; at keyframes, both that meet there count."""
    path = _many_keys(40, repeat)
    knots = path.knots_us
    rng, period = np.random.default_rng(3), path.period_us
    intervals = [(knots[7], knots[9]), (knots[7], knots[7]), (knots[0] - 50.0, knots[0]), (knots[-1], knots[-1] + 9.0)]
    intervals += [tuple(np.sort(rng.uniform(knots[0] - 40, knots[-1] + 60, 2))) for _ in range(50)]
    for begin, end in intervals:
        spans = [tuple(np.clip([begin, end], knots[0], knots[-1]) - knots[0])]
        if repeat:
            first = (begin - knots[0]) % period
            last = first + end - begin
            spans = [(first, last)] if last <= period else [(first, period), (0.0, last - period)]
            if end - begin >= period:
                spans = [(0.0, period)]
        local = knots - knots[0]
        expected = [
            (k, max(low, local[k]), min(high, local[k + 1]))
            for low, high in spans for k in range(39) if max(low, local[k]) <= min(high, local[k + 1])
        ]  # fmt: skip
        got = path.pieces(begin, end)
        assert [piece.segment for piece in got] == [k for k, _, _ in expected]
        for piece, (k, a, b) in zip(got, expected, strict=True):
            length = local[k + 1] - local[k]
            np.testing.assert_allclose(
                (piece.first, piece.last, piece.length_us), ((a - local[k]) / length, (b - local[k]) / length, b - a),
                atol=1e-12,
            )  # fmt: skip


def test_short_intervals_of_long_tracks_take_no_longer():
    """Tens of thousands of keyframes: each call went through all of them, most of the time of an audit of `fan`."""
    path = _many_keys(30_000)
    begin = time.process_time()
    for k in range(300):
        assert path.pieces(1000.0 + k, 1000.5 + k)
    assert time.process_time() - begin < 1.5  # it took 3 s and more
