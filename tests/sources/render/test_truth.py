"""Geometric truth against closed forms written out here, and against pictures of the exact renderer."""

from types import SimpleNamespace

import numpy as np
import pytest
import rendering
from scipy import optimize
from scipy.spatial.transform import Rotation

import hesim_render as hr
from hesim_render.core.backend import select
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.sources.render.light_level import light_levels
from hesim_render.sources.render.scene.trajectory import Trajectory
from hesim_render.sources.render.truth import imu
from hesim_render.sources.render.truth.flow import _unoccluded
from hesim_render.sources.render.truth.imu import ImuModel
from hesim_render.sources.render.truth.poses import camera_model
from hesim_render.sources.render.truth.raster import Raster
from hesim_render.sources.render.truth.scene_truth import SceneTruth
from hesim_render.specs.motion import TrackSpec
from hesim_render.spectral.waveform import Mains, Pwm, TableWaveform

WHITE, BLACK = {"reflectance": {"flat": 1.0}}, {"reflectance": {"flat": 0.0}}
#: A card that turns and moves sideways, a ball that flies in front of it, and a wall; the camera turns and moves.
ORIGIN, CARD_Z, WALL_Z, RADIUS = np.array([0.0, 0.0, 2.0]), -0.1, -0.5, 0.05
TURN_DEG, SHIFT, BALL, FLIGHT = -6.0, np.array([0.02, -0.01, 0.0]), np.array([-0.05, 0.03, 0.3]), np.array([0.06, 0, 0])
CAMERA_SHIFT, CAMERA_DEG, END_US = np.array([0.01, 0.02, -0.03]), 1.5, 20_000


def scene(camera_moves=True, wall=True):
    ends = [{"t_us": 0}, {"t_us": END_US}]
    card = [{**ends[0]}, {**ends[1], "translation_m": SHIFT.tolist(), "rotation_deg": TURN_DEG}]
    ball = [{**ends[0]}, {**ends[1], "translation_m": FLIGHT.tolist()}]
    camera = [{**ends[0]}, {**ends[1], "translation_m": CAMERA_SHIFT.tolist(), "rotation_axis": [0, 1, 0],
                            "rotation_deg": CAMERA_DEG}]  # fmt: skip
    motion = [{"object": "card", "keyframes": card}, {"object": "ball", "keyframes": ball}]
    if camera_moves:
        motion.append({"object": "camera", "pivot_m": ORIGIN.tolist(), "keyframes": camera})
    objects = [
        {"name": "card", "shape": "rectangle", "size_m": [0.31, 0.21, 0], "position_m": [0, 0, CARD_Z],
         **WHITE},
        {"name": "ball", "shape": "sphere", "size_m": [2 * RADIUS] * 3, "position_m": BALL.tolist(),
         **BLACK},
    ]  # fmt: skip
    if wall:
        objects.append({"name": "wall", "shape": "rectangle", "size_m": [9, 9, 0], "position_m": [0, 0, WALL_Z],
                        **BLACK})  # fmt: skip
    return rendering.make_scene(
        objects=objects,
        light=rendering.FURNACE,
        camera={"origin_m": ORIGIN.tolist(), "target_m": [0, 0, 0], "horizontal_fov_deg": 14},
        motion=motion,
    )


# ---- the same scene, written out again -----------------------------------------------------------------------------


def about(axis, degrees):
    """Rotation by Rodrigues' formula."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(degrees)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def camera_at(t_us, moves=True):
    """Rotation (columns right, up, backward) and position."""
    share = np.clip(t_us / END_US, 0, 1) if moves else 0.0
    return about([0, 1, 0], CAMERA_DEG * share), ORIGIN + CAMERA_SHIFT * share


def seen_at(point, t_us, cols, rows, moves=True):
    """Column and row of a world point; 14° across the region, whole numbers at pixel centres."""
    rotation, position = camera_at(t_us, moves)
    x, y, z = rotation.T @ (point - position)
    f = cols / 2 / np.tan(np.radians(7))
    return np.array([f * x / -z + (cols - 1) / 2, f * -y / -z + (rows - 1) / 2])


def ray_at(col, row, t_us, cols, rows, moves=True):
    rotation, position = camera_at(t_us, moves)
    f = cols / 2 / np.tan(np.radians(7))
    way = rotation @ np.array([(col - (cols - 1) / 2) / f, -(row - (rows - 1) / 2) / f, -1.0])
    return position, way / np.linalg.norm(way)


def card_to_world(point, t_us):
    share = np.clip(t_us / END_US, 0, 1)
    return about([0, 0, 1], TURN_DEG * share) @ point + SHIFT * share


def card_to_rest(point, t_us):
    share = np.clip(t_us / END_US, 0, 1)
    return about([0, 0, 1], TURN_DEG * share).T @ (point - SHIFT * share)


def to_ball(position, way, t_us):
    middle = BALL + FLIGHT * np.clip(t_us / END_US, 0, 1)
    b = way @ (position - middle)
    root = b * b - (position - middle) @ (position - middle) + RADIUS**2
    return -b - np.sqrt(root) if root > 0 else np.inf


def meets(position, way, t_us):
    """Distance and object number of the nearest surface."""
    found = [(np.inf, 0)]
    t = (CARD_Z - position[2]) / way[2]
    x, y, _ = card_to_rest(position + t * way, t_us)
    if abs(x) < 0.155 and abs(y) < 0.105:
        found.append((t, 1))
    found.append((to_ball(position, way, t_us), 2))
    found.append(((WALL_Z - position[2]) / way[2], 3))
    return min(found)


def moved(point, what, t0_us, t1_us):
    if what == 1:
        return card_to_world(card_to_rest(point, t0_us), t1_us)
    return point + FLIGHT * (t1_us - t0_us) / END_US if what == 2 else point


ROWS, COLS = 96, 128


@pytest.fixture(scope="module")
def truth():
    return SceneTruth(scene(), rendering.mono(COLS, ROWS))


def interior(truth, *times):
    """Pixels that lie well inside one surface."""
    found = ~truth.mixed(times[0])
    near = np.zeros_like(found)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            near |= ~np.roll(found, (dy, dx), (0, 1))
    return ~near


def test_depth_distance_position_normals_and_ids_are_those_of_the_closed_form(truth):
    t_us = 7_000.0
    depth, distance, position = truth.depth(t_us), truth.distance(t_us), truth.position(t_us)
    normals, ids = truth.normals(t_us), truth.ids(t_us)
    assert truth.names.objects == ("background", "card", "ball", "wall")
    checked = set()
    for row, col in np.random.default_rng(3).integers(0, (ROWS, COLS), (400, 2)):
        start, way = ray_at(col, row, t_us, COLS, ROWS)
        far, what = meets(start, way, t_us)
        assert ids.object[row, col] == what or not interior(truth, t_us)[row, col]
        if ids.object[row, col] != what:
            continue
        checked.add(what)
        back = camera_at(t_us)[0][:, 2]
        np.testing.assert_allclose(distance[row, col], far, rtol=2e-6)
        np.testing.assert_allclose(depth[row, col], far * -(way @ back), rtol=2e-6)
        np.testing.assert_allclose(position[row, col], start + far * way, atol=1e-5)
        middle = BALL + FLIGHT * t_us / END_US
        normal = (start + far * way - middle) / RADIUS if what == 2 else [0, 0, 1]
        np.testing.assert_allclose(normals[row, col], normal, atol=1e-3)
    assert checked == {1, 2, 3}


@pytest.mark.parametrize("times", [(3_000.0, 15_000.0), (15_000.0, 3_000.0)], ids=["forward", "backward"])
def test_flow_equals_differences_of_projected_points(truth, times):
    flow, ids = truth.flow(*times), truth.ids(times[0])
    worst = 0.0
    for row, col in np.random.default_rng(4).integers(0, (ROWS, COLS), (300, 2)):
        start, way = ray_at(col, row, times[0], COLS, ROWS)
        far, what = meets(start, way, times[0])
        if what == ids.object[row, col]:
            there = seen_at(moved(start + far * way, what, *times), times[1], COLS, ROWS)
            worst = max(worst, np.abs(there - (col, row) - flow.flow_px[row, col]).max())
    assert 0 < worst < 2e-3  # asked for: 0.02 px
    assert np.abs(flow.flow_px).max() > 5


def test_flow_of_a_rolling_shutter_ends_at_the_time_of_the_row_where_it_ends(truth):
    """Each row has its own time; the second time is the root of t = t1(y(t)), found by bisection here."""
    line_us = 60.0
    first, second = 2_000 + line_us * np.arange(ROWS), 11_000 + line_us * np.arange(ROWS)
    flow, ids = truth.flow(first, second), truth.ids(first)
    worst, still = 0.0, truth.flow(2_000.0, 11_000.0).flow_px
    for row, col in np.random.default_rng(5).integers(10, (ROWS - 20, COLS), (150, 2)):
        start, way = ray_at(col, row, first[row], COLS, ROWS)
        far, what = meets(start, way, first[row])
        if what != ids.object[row, col]:
            continue
        point = start + far * way

        def place(t_us, point=point, what=what, t0_us=first[row]):
            return seen_at(moved(point, what, t0_us, t_us), t_us, COLS, ROWS)

        t_us = optimize.brentq(
            lambda t, place=place: t - 11_000 - line_us * np.clip(place(t)[1], 0, ROWS - 1), 5e3, 2e4
        )
        worst = max(worst, np.abs(place(t_us) - (col, row) - flow.flow_px[row, col]).max())
    assert 0 < worst < 2e-3
    assert np.nanmax(np.abs(flow.flow_px - still)) > 0.2  # a global shutter differs


def test_points_are_occluded_where_rays_written_out_meet_something_else_first(truth):
    times = 2_000.0, 18_000.0
    visible, inside = truth.flow(*times).visible, interior(truth, times[0])
    seen = {True: 0, False: 0}
    for row in range(ROWS):
        for col in range(0, COLS, 2):
            if not inside[row, col]:
                continue
            start, way = ray_at(col, row, times[0], COLS, ROWS)
            far, what = meets(start, way, times[0])
            point = moved(start + far * way, what, *times)
            position = camera_at(times[1])[1]
            length = np.linalg.norm(point - position)
            there = seen_at(point, times[1], COLS, ROWS)
            nearest = meets(position, (point - position) / length, times[1])[0]
            if abs(nearest / length - 1) < 2e-4 and nearest < length * (1 - 1e-9):
                continue  # too near to an outline to tell
            edge = np.abs(there - np.clip(there, -0.5, [COLS - 0.5, ROWS - 0.5])).max()
            expected = nearest > length * (1 - 1e-4) and edge == 0
            assert visible[row, col] == expected, (row, col)
            seen[bool(expected)] += 1
    assert seen[True] > 1000 and seen[False] > 100


def test_a_face_that_has_turned_away_is_not_visible():
    card = {"name": "card", "shape": "rectangle", "size_m": [0.2, 0.2, 0], **WHITE}
    half_turn = [
        {"t_us": 0, "rotation_axis": [0, 1, 0]},
        {"t_us": 10_000, "rotation_axis": [0, 1, 0], "rotation_deg": 180},
    ]
    turning = rendering.make_scene(
        objects=[card], light=rendering.FURNACE, motion=[{"object": "card", "keyframes": half_turn}],
        camera={"origin_m": [0, 0, 2], "target_m": [0, 0, 0], "horizontal_fov_deg": 7},
    )  # fmt: skip
    truth = SceneTruth(turning, rendering.mono(32, 32))
    on_card = truth.ids(0).object == 1
    assert on_card.sum() > 300
    assert truth.flow(0, 2_000).visible[on_card].all()
    assert not truth.flow(0, 10_000).visible[on_card].any()


def test_the_sky_moves_with_the_turn_of_the_camera_and_nothing_else():
    truth = SceneTruth(scene(wall=False), rendering.mono(COLS, ROWS))
    times = 0.0, 20_000.0
    sky = np.isinf(truth.depth(times[0]))
    flow = truth.flow(*times)
    assert sky.sum() > 2000
    assert np.isnan(truth.position(times[0])[sky]).all() and (truth.ids(times[0]).object[sky] == 0).all()
    f = COLS / 2 / np.tan(np.radians(7))
    row, col = np.argwhere(sky & flow.visible)[10]
    way = np.array([(col - (COLS - 1) / 2) / f, -(row - (ROWS - 1) / 2) / f, -1.0])
    x, y, z = about([0, 1, 0], CAMERA_DEG).T @ way
    there = f * x / -z + (COLS - 1) / 2, f * y / z + (ROWS - 1) / 2
    np.testing.assert_allclose(flow.flow_px[row, col], np.array(there) - (col, row), atol=2e-3)
    hidden = sky & ~flow.visible & (np.abs(flow.flow_px[..., 0]) < 30)
    assert hidden.any()  # behind card and ball, or out of the picture


def test_mixed_pixels_are_those_that_a_straight_edge_crosses():
    """The card's rim in front of the wall, turned by 6°: a pixel is mixed if its corners lie on both sides."""
    cols, rows = 64, 48
    truth = SceneTruth(scene(camera_moves=False), rendering.mono(cols, rows))
    t_us = float(END_US)
    mixed = truth.mixed(t_us)
    margin, expected = np.full((rows, cols), np.inf), np.zeros((rows, cols), bool)
    offsets = np.array([(dx, dy) for dx in (-0.5, 0, 0.5) for dy in (-0.5, 0, 0.5)])
    for row in range(rows):
        for col in range(cols):
            inside = []
            for dx, dy in offsets:
                start, way = ray_at(col + dx, row + dy, t_us, cols, rows, moves=False)
                x, y, _ = card_to_rest(start + (CARD_Z - start[2]) / way[2] * way, t_us)
                out = max(abs(x) - 0.155, abs(y) - 0.105)
                margin[row, col] = min(margin[row, col], abs(out))
                inside.append(out < 0)
            expected[row, col] = any(inside) and not all(inside)
    # a pixel is 8 mm; the rays lie 1/64 px inside of its border. The ball's outline is left out
    ball = np.zeros((rows, cols), bool)
    left, top, right, bottom = truth.boxes(t_us).whole_px[1]
    ball[max(0, int(top) - 1) : int(bottom) + 2, max(0, int(left) - 1) : int(right) + 2] = True
    clear = (margin > 2.4e-4) & ~ball
    np.testing.assert_array_equal(mixed[clear], expected[clear])
    assert expected[clear].sum() > 50
    assert truth.mixed(t_us)[ball].sum() > 10


def test_an_edge_of_one_object_makes_mixed_pixels_too():
    """A box seen from a corner: its own edges have no other object behind them."""
    box = {"name": "box", "shape": "box", "size_m": [0.4, 0.4, 0.4], "rotation_axis": [0, 1, 0], "rotation_deg": 45}
    cornered = rendering.make_scene(
        objects=[box], light=rendering.FURNACE,
        camera={"origin_m": [0.013, 0, 2], "target_m": [0.013, 0, 0], "horizontal_fov_deg": 4},
    )  # fmt: skip
    mixed = SceneTruth(cornered, rendering.mono(32, 24)).mixed(0)
    assert mixed.any(axis=1).all() and mixed.sum(axis=1).max() <= 2


# ---- against pictures ----------------------------------------------------------------------------------------------


def rim(light):
    """Place where a line of pixels turns bright, from the light of the pixels around it over that beside them."""
    first = int(np.argmax(light > light.max() / 2))
    level = light[first + 3 : first + 6].mean()
    return first + 3 - 0.5 - light[first - 3 : first + 3].sum() / level


def test_pose_depth_and_intrinsics_put_a_corner_where_the_picture_has_it():
    """The card's left top corner in a noise-free picture: lines through the rims of rows and columns."""
    sensor = rendering.mono(COLS, ROWS)
    still = scene(camera_moves=False)
    t_us = 10_000.0
    truth = SceneTruth(still, sensor)
    flux = rendering.traced(rendering.pair_tracer(still, sensor), 4096, t_us, t_us)
    light = ((flux.half_a + flux.half_b) / 2).reshape(ROWS, COLS)
    ids = truth.ids(t_us).object
    # rows and columns through the card alone, away from its corners and the ball
    _, _, right, bottom = truth.boxes(t_us).visible_px[0]
    _, _, ball_right, ball_bottom = truth.boxes(t_us).whole_px[1]
    rows = np.arange(int(ball_bottom) + 3, int(bottom) - 4)
    cols = np.arange(int(ball_right) + 3, int(right) - 4)
    assert rows.size > 8 and cols.size > 8 and (ids[rows[0], cols] == 1).all()
    on_left = np.array([rim(light[row]) for row in rows])
    on_top = np.array([rim(light[:, col]) for col in cols])
    a1, b1 = np.polyfit(rows, on_left, 1)
    a2, b2 = np.polyfit(cols, on_top, 1)
    x = (a1 * b2 + b1) / (1 - a1 * a2)
    y = a2 * x + b2
    # the corner of the file, moved by the pose of the object and seen through K and the pose of the camera
    corner = truth.object_poses(t_us)["card"] @ np.array([-0.155, 0.105, CARD_Z, 1.0])
    local = np.linalg.inv(truth.camera_pose(t_us)) @ corner
    seen = truth.camera().k @ (local[:3] / local[2])
    np.testing.assert_allclose([x, y], seen[:2], rtol=0, atol=0.02)
    np.testing.assert_allclose(truth.project(corner[:3], t_us), seen[:2], atol=1e-9)
    # and back: depth at the pixel beside the corner, along its ray
    depth = truth.depth(t_us)[round(y) + 2, round(x) + 2]
    np.testing.assert_allclose(depth, local[2], rtol=1e-6)


# ---- grids, boxes, cameras -----------------------------------------------------------------------------------------


def test_event_pixels_have_the_values_of_their_mosaic_pixels_and_flow_in_their_own_units():
    sensor = hr.load_sensor("gen2").crop(64, 48)
    truth = SceneTruth(scene(), sensor)
    times = 1_000 + 30.0 * np.arange(48), 9_000 + 30.0 * np.arange(48)
    where = np.divmod(sensor.layout.evs_pixel, 64)
    np.testing.assert_array_equal(truth.depth(times[0], "events"), truth.depth(times[0])[where])
    np.testing.assert_array_equal(truth.ids(times[0], "events").object, truth.ids(times[0]).object[where])
    np.testing.assert_allclose(
        truth.flow(*times, grid="events").flow_px * 4, truth.flow(*times).flow_px[where], atol=1e-5
    )
    point = truth.position(500.0, "events")[7, 5]
    np.testing.assert_allclose(truth.project(point, 500.0, "events"), [5, 7], atol=1e-3)
    k, k_events = truth.camera().k, truth.camera("events").k
    assert truth.camera("events").is_even
    np.testing.assert_allclose(k_events[0, 0] * 4, k[0, 0])
    np.testing.assert_allclose(
        k_events[:2, 2] * 4 + (2, 1), k[:2, 2]
    )  # its event pixel is in column 2, row 1 of a tile


def test_intrinsics_of_a_region_are_those_of_the_sensor_moved():
    spec = {"objects": [{"name": "wall", "shape": "rectangle", "size_m": [4, 4, 0]}], "light": rendering.FURNACE,
            "camera": {"origin_m": [0, 0, 1], "target_m": [0, 0, 0], "focus_distance_m": 1.0}}  # fmt: skip
    sensor = hr.load_sensor("gen2").crop(64, 48, 400, 800)
    camera = SceneTruth(rendering.make_scene(**spec), sensor).camera()
    f = 4.0 * (1 + 4 / (1000 - 4)) / 1.4e-3
    np.testing.assert_allclose(camera.k, [[f, 0, 1631.5 - 400], [0, f, 1223.5 - 800], [0, 0, 1]], rtol=1e-12)
    assert (camera.width, camera.height, camera.distortion_model) == (64, 48, "none")


def test_boxes_of_a_ball_and_a_card(truth):
    t_us = 12_000.0
    boxes = truth.boxes(t_us)
    assert boxes.names == ("card", "ball", "wall")
    ids = truth.ids(t_us).object
    for number, box in enumerate(boxes.visible_px, start=1):
        rows, cols = np.nonzero(ids == number)
        np.testing.assert_array_equal(box, [cols.min() - 0.5, rows.min() - 0.5, cols.max() + 0.5, rows.max() + 0.5])
    # the ball's outline: the extreme directions that touch it, from a dense set of directions
    middle = BALL + FLIGHT * t_us / END_US
    rotation, position = camera_at(t_us)
    local = rotation.T @ (middle - position)
    f = COLS / 2 / np.tan(np.radians(7))

    def extreme(axis, sign):
        """Largest tangent along an axis: (z² − r²) t² − 2 c z t + c² − r² = 0 in the plane of that axis."""
        c, z = local[axis], -local[2]
        roots = np.roots([z * z - RADIUS**2, -2 * c * z, c * c - RADIUS**2])
        return sign * max(sign * roots)

    expected = [extreme(0, -1) * f + (COLS - 1) / 2, -extreme(1, 1) * f + (ROWS - 1) / 2,
                extreme(0, 1) * f + (COLS - 1) / 2, -extreme(1, -1) * f + (ROWS - 1) / 2]  # fmt: skip
    np.testing.assert_allclose(boxes.whole_px[1], expected, atol=2e-3)
    corners = np.array([[x, y, CARD_Z] for x in (-0.155, 0.155) for y in (-0.105, 0.105)])
    places = np.array([seen_at(card_to_world(corner, t_us), t_us, COLS, ROWS) for corner in corners])
    np.testing.assert_allclose(boxes.whole_px[0], [*places.min(axis=0), *places.max(axis=0)], atol=1e-3)
    found = {tuple(np.round(corner, 6)) for corner in boxes.corners_m[0]}
    assert found == {tuple(np.round(card_to_world(corner, t_us), 6)) for corner in corners}


def test_a_scene_of_mitsubas_has_its_own_names():
    truth = SceneTruth(hr.load_scene("cornell-box"), rendering.mono(32, 32))
    assert {"small-box", "large-box", "floor"} <= set(truth.names.objects)
    ids = truth.ids(0)
    # rays along the diagonals run exactly through the seams of its walls, which OptiX does not close
    least = 0.97 if select().backend == "cuda" else 0.98
    assert np.isfinite(truth.depth(0))[2:-2, 2:-2].mean() > least and len(np.unique(ids.object)) >= 6
    assert len(np.unique(ids.material)) >= 3


def test_shapes_without_an_id_have_names_of_their_own(tmp_path):
    """The left and the right half of the picture show two of them; one has what would be the name of the other."""
    left, right = (
        f'<shape type="rectangle"{own}><transform name="to_world"><translate x="{x}"/></transform></shape>'
        for own, x in (("", -1), (' id="shape_2"', 3))
    )
    (tmp_path / "two.xml").write_text(
        f'<scene version="3.0.0">{left}{right}{left.replace("-1", "1.03")}<emitter type="constant"/></scene>'
    )
    (tmp_path / "two.yaml").write_text(
        "schema_version: 1\nname: two\ndescription: ''\nmitsuba: {file: two.xml}\n"
        "camera: {origin_m: [0, 0, 2], target_m: [0, 0, 0], horizontal_fov_deg: 22.62}\n"
    )
    truth = SceneTruth(hr.load_scene(tmp_path / "two.yaml"), rendering.mono(40, 30))
    ids = truth.ids(0)
    names = np.array(truth.names.objects)[ids.object]
    assert list(truth.names.objects) == ["background", "shape_0", "shape_2", "shape_2_"]
    assert (names[:, :19] == "shape_0").all() and (names[:, 23:] == "shape_2_").all()
    assert (np.array(truth.names.instances)[ids.instance] == names).all()


def test_times_and_grids_that_are_none_are_refused(truth):
    with pytest.raises(RangeError, match="one time in µs, one for each of the 96 rows"):
        truth.depth([1.0, 2.0])
    with pytest.raises(RangeError, match="one time in µs"):
        truth.depth(float("nan"))
    with pytest.raises(RangeError, match="'mosaic' or 'events'"):
        truth.depth(0, grid="tile")
    frames_only = hr.load_sensor(
        "reference-mono", {"pixels.M.roles": ["aps"], "evs": None, "evs_grid": None, "sources": {}, "assumptions": {}}
    ).crop(32, 24)
    with pytest.raises(RangeError, match="has no event pixels"):
        SceneTruth(scene(), frames_only).depth(0, grid="events")


def test_light_levels_follow_the_waveform():
    lit = {**rendering.D65_1000_LUX, "waveform": {"type": "mains", "frequency_hz": 50, "depth": 0.4, "phase_deg": 0}}
    flickering = rendering.make_scene(
        objects=[{"name": "wall", "shape": "rectangle", "size_m": [4, 4, 0]}], light=lit,
        camera={"origin_m": [0, 0, 1], "target_m": [0, 0, 0]},
    )  # fmt: skip
    (light,) = SceneTruth(flickering, rendering.mono(8, 8)).light_levels([0.0, 2_500.0, 5_000.0])
    np.testing.assert_allclose(light.level, [1400, 1000, 600], rtol=1e-9)
    assert (light.name, light.unit, light.mean) == ("light", "lx", 1000.0)


def test_levels_of_several_lights_lamps_and_emitters():
    """Each by its law: 1 + d cos(2π 2f t + φ), 1/duty while switched on, a line between samples over its mean."""
    t_us = np.array([[0.0, 1_234.0], [7_300.0, 31_000.0]])
    mains = Mains(frequency_hz=60, depth=0.3, phase_deg=25)
    pwm = Pwm(frequency_hz=400, duty=0.35, phase_deg=50)
    table = TableWaveform(t_us=(0.0, 8_000.0, 40_000.0), value=(3.0, 1.0, 5.0))
    of_mains = 1 + 0.3 * np.cos(2 * np.pi * 120 * t_us * 1e-6 + np.radians(25))
    of_pwm = np.where((400e-6 * t_us + 50 / 360) % 1 < 0.35, 1 / 0.35, 0)
    # its mean is that of two trapezoids
    of_table = np.interp(t_us, [0, 8_000, 40_000], [3, 1, 5]) / ((2 * 8_000 + 3 * 32_000) / 40_000)

    def light(waveform, lux=None, watts=None, kind="uniform"):
        given = None if waveform is None else SimpleNamespace(load=lambda: waveform)
        return SimpleNamespace(type=kind, illuminance_lux=lux, irradiance_w_m2=watts, waveform=given)

    def lamp(waveform, luminance):
        return SimpleNamespace(luminance_cd_m2=luminance, waveform=light(waveform).waveform)

    emitters = SimpleNamespace(waveforms={"tube": light(pwm).waveform})
    lights = [light(mains, lux=730.0), light(None, kind="none"), light(pwm, watts=2.6), light(None, lux=40.0)]
    lamps = [("target", lamp(table, 310.0)), ("objects.led", lamp(None, 90.0))]
    spec = SimpleNamespace(lights=lights, named_lamps=lamps, mitsuba=emitters)
    found = light_levels(SimpleNamespace(spec=spec), t_us)
    wanted = [
        ("lights.0", "lx", 730.0, 730 * of_mains), ("lights.2", "W m^-2", 2.6, 2.6 * of_pwm),
        ("lights.3", "lx", 40.0, np.full((2, 2), 40.0)), ("target", "cd m^-2", 310.0, 310 * of_table),
        ("objects.led", "cd m^-2", 90.0, np.full((2, 2), 90.0)), ("tube", "1", 1.0, of_pwm),
    ]  # fmt: skip
    for one, (name, unit, mean, level) in zip(found, wanted, strict=True):
        assert (one.name, one.unit, one.mean) == (name, unit, mean)
        np.testing.assert_allclose(one.level, level, rtol=1e-9)


# ---- inertial measurements -----------------------------------------------------------------------------------------


def turning_camera(rate_deg_per_s=360.0):
    """The camera turns about a pivot 0.5 m behind it."""
    end = {"t_us": 1_000_000, "rotation_axis": [0, 1, 0], "rotation_deg": rate_deg_per_s}
    track = {"object": "camera", "pivot_m": [0, 0, 2.5], "keyframes": [{"t_us": 0, "rotation_axis": [0, 1, 0]}, end]}
    spec = {"objects": [{"name": "wall", "shape": "rectangle", "size_m": [4, 4, 0]}], "light": rendering.FURNACE,
            "camera": {"origin_m": [0, 0, 2], "target_m": [0, 0, 0]}, "motion": [track]}  # fmt: skip
    return SceneTruth(rendering.make_scene(**spec), rendering.mono(8, 8))


def test_imu_of_a_turn_about_a_pivot_has_its_rate_its_centripetal_force_and_gravity():
    """ω about y (up), which is −y of the unit; r = 0.5 m towards +z of the unit, so that it is pulled along −z."""
    samples = turning_camera().imu(100_000, 500_000)
    omega = 2 * np.pi
    assert samples.t_us.size == 400 and samples.t_us[0] == 101_000
    np.testing.assert_allclose(samples.gyro_ideal_rad_per_s, np.tile([0, -omega, 0], (400, 1)), atol=1e-9)
    expected = [0, -9.80665, -(omega**2) * 0.5]  # at rest the specific force is up, −y of the unit
    # the mean over a sample is short by (ω dt)²/24 of it
    np.testing.assert_allclose(samples.accelerometer_ideal_m_per_s2, np.tile(expected, (400, 1)), rtol=2e-6, atol=1e-9)


@pytest.mark.parametrize("repeat", [False, True])
def test_velocity_of_a_track_that_begins_late_is_that_of_finite_differences(repeat):
    """Three keyframes from 170 ms on, with shift, turn and pivot; one that repeats moves before and after as well."""
    frames = [
        {"t_us": 170_000, "translation_m": [0, 0, 0.1]},
        {"t_us": 410_000, "translation_m": [0.2, -0.1, 0], "rotation_axis": [0, 1, 0.5], "rotation_deg": 70},
        {"t_us": 900_000, "translation_m": [0.1, 0.3, 0.2], "rotation_axis": [0, 1, 0.5], "rotation_deg": 20},
    ]
    spec = {"object": "camera", "pivot_m": [0.1, 0, 2.5], "keyframes": frames, "repeat": repeat}
    track, place = Trajectory(TrackSpec.model_validate(spec)), np.array([0.3, -0.2, 1.0])
    times = np.array([40_000.0, 200_000, 390_000, 430_000, 880_000, 1_300_000])
    found = imu._velocity(track, place, times)
    before, after = (track.matrix(times + side) @ np.append(place, 1) for side in (-50.0, 50.0))
    inside = repeat | ((times > 170_000) & (times < 900_000))
    np.testing.assert_allclose(found, np.where(inside[:, None], (after - before)[:, :3] / 100e-6, 0), atol=1e-5)
    assert np.abs(found[1:5]).min(axis=0).max() > 0.1


def test_imu_samples_sum_up_to_the_motion_over_a_keyframe():
    truth = SceneTruth(scene(), rendering.mono(8, 8))
    samples = truth.imu(-5_000, 30_000, ImuModel(rate_hz=500.0))
    poses = truth.camera_pose(np.concatenate([[-5_000.0], samples.t_us]))
    rotation, velocity, step = poses[0, :3, :3], np.zeros(3), 1 / 500
    gravity = np.array([0, -9.80665, 0])
    for number, (gyro, force) in enumerate(
        zip(samples.gyro_ideal_rad_per_s, samples.accelerometer_ideal_m_per_s2, strict=True), start=1
    ):
        half = Rotation.from_rotvec(gyro * step / 2).as_matrix()
        velocity = velocity + (rotation @ half @ force + gravity) * step
        rotation = rotation @ half @ half
        np.testing.assert_allclose(rotation, poses[number, :3, :3], atol=1e-9)
        if 0 < samples.t_us[number - 1] < END_US:
            np.testing.assert_allclose(velocity, CAMERA_SHIFT / (END_US * 1e-6), atol=2e-2)
    np.testing.assert_allclose(velocity, 0, atol=2e-2)


def test_imu_noise_is_white_with_a_walking_bias():
    """20 000 samples of each axis. Variances by χ²: a relative error of √(2/60000) = 0.6 %, bound 5 σ; false alarm
    1e-6. Means of the white noise: 5 σ."""
    model = ImuModel(1000.0, 2e-3, 5e-4, 3e-2, 4e-3)
    truth = turning_camera(0.0)
    samples = truth.imu(0, 20_000_000, model, seed=11)
    for noisy, ideal, bias, white, walk in (
        (samples.gyro_rad_per_s, samples.gyro_ideal_rad_per_s, samples.gyro_bias_rad_per_s, 2e-3, 5e-4),
        (samples.accelerometer_m_per_s2, samples.accelerometer_ideal_m_per_s2, samples.accelerometer_bias_m_per_s2,
         3e-2, 4e-3),
    ):  # fmt: skip
        own = noisy - ideal - bias
        sigma = white * np.sqrt(1000)
        np.testing.assert_allclose(np.var(own), sigma**2, rtol=5 * 0.006)
        assert np.abs(own.mean(axis=0)).max() < 5 * sigma / np.sqrt(20_000)
        steps = np.diff(bias, axis=0)
        np.testing.assert_allclose(np.var(steps), walk**2 / 1000, rtol=5 * 0.006)
        together = np.corrcoef(np.concatenate([own[1:], steps], axis=1).T)
        assert np.abs(together - np.eye(6)).max() < 5 / np.sqrt(20_000)
    again = truth.imu(0, 5_000_000, model, seed=11)
    np.testing.assert_array_equal(again.gyro_rad_per_s, samples.gyro_rad_per_s[:5000])
    assert not np.array_equal(truth.imu(0, 5_000_000, model, seed=12).gyro_rad_per_s, again.gyro_rad_per_s)


def test_imu_models_that_are_none_are_refused():
    with pytest.raises(RangeError, match="rate_hz"):
        ImuModel(rate_hz=0)
    with pytest.raises(RangeError, match="gyro_random_walk"):
        ImuModel(gyro_random_walk=-1)


# ---- scenes of Mitsuba's ---------------------------------------------------------------------------------------------


def test_what_lies_before_the_near_plane_is_neither_seen_nor_in_the_way():
    inline = {
        "type": "scene",
        "integrator": {"type": "path"},
        "sensor": {"type": "perspective", "fov": 20.0, "near_clip": 1.0,
                   "to_world": [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 2], [0, 0, 0, 1]]},
        "wall": {"type": "rectangle"},
        "near": {"type": "rectangle", "to_world": [[0.05, 0, 0, 0], [0, 0.05, 0, 0], [0, 0, 1, 1.5], [0, 0, 0, 1]]},
        "far": {"type": "rectangle", "to_world": [[0.1, 0, 0, 0.2], [0, 0.1, 0, 0], [0, 0, 1, 0.5], [0, 0, 0, 1]]},
        "light": {"type": "constant"},
    }  # fmt: skip
    truth = SceneTruth(rendering.make_scene(mitsuba={"inline": inline}), rendering.mono(32, 32))
    depth, names = truth.depth(0), truth.names.objects
    ids = truth.ids(0).object
    assert names.index("near") not in ids and (ids == names.index("far")).any()
    np.testing.assert_allclose(depth[ids == names.index("wall")], 2.0, rtol=1e-6)
    np.testing.assert_allclose(depth[ids == names.index("far")], 1.5, rtol=1e-6)
    flow = truth.flow(0, 1_000)
    assert flow.visible.all() and np.abs(flow.flow_px).max() < 1e-4


def test_instances_of_one_shape_are_objects_of_their_own():
    ball = {"type": "shapegroup", "ball": {"type": "sphere", "radius": 0.1}}
    place = [[[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]] for x in (-0.15, 0.15)]
    shapes = {
        "type": "scene", "integrator": {"type": "path"}, "group": ball, "light": {"type": "constant"},
        **{f"copy-{k}": {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": place[k]}
           for k in (0, 1)},
    }  # fmt: skip
    truth = SceneTruth(rendering.mitsuba_scene(shapes), rendering.mono(32, 32))
    ids = truth.ids(0).object
    left, right = (truth.names.objects.index(f"copy-{k}") for k in (0, 1))
    assert set(np.unique(ids)) == {0, left, right}
    assert np.nonzero(ids == left)[1].max() < 16 <= np.nonzero(ids == right)[1].min()
    shapes["wall"] = {"type": "rectangle"}
    track = {"object": "wall", "keyframes": [{"t_us": 0}, {"t_us": 1_000, "translation_m": [0.1, 0, 0]}]}
    with pytest.raises(SpecError, match="moving objects in a scene with instances"):
        SceneTruth(rendering.mitsuba_scene(shapes, [track]), rendering.mono(32, 32))


def test_a_sensor_with_uneven_event_pixels_says_so():
    """Eiger has four event pixels in a tile; the truth of each is that of its own place."""
    sensor = hr.load_sensor("eiger").crop(32, 24)
    truth = SceneTruth(scene(), sensor)
    raster = truth.raster("events")
    np.testing.assert_array_equal(
        raster.row * 3264 + raster.col, sensor.layout.full_index.ravel()[sensor.layout.evs_pixel]
    )
    even = np.ptp(np.diff(raster.col[0])) == 0 and np.ptp(np.diff(raster.row[:, 0])) == 0
    assert truth.camera("events").is_even == even
    where = np.divmod(sensor.layout.evs_pixel, 32)
    np.testing.assert_array_equal(truth.depth(3_000.0, "events"), truth.depth(3_000.0)[where])


def test_a_card_close_to_the_wall_hides_what_it_covers():
    """5 mm before a wall at 2 m, a quarter of a percent: at first beside the middle of the view, then over it."""
    wall = {"name": "wall", "shape": "rectangle", "size_m": [9, 9, 0]}
    card = {"name": "card", "shape": "rectangle", "size_m": [0.2, 0.2, 0], "position_m": [0.3, 0, 0.005]}
    track = [{"t_us": 0}, {"t_us": 10_000, "translation_m": [-0.3, 0, 0]}]
    covering = rendering.make_scene(
        objects=[wall, card], light=rendering.FURNACE, motion=[{"object": "card", "keyframes": track}],
        camera={"origin_m": [0, 0, 2], "target_m": [0, 0, 0], "horizontal_fov_deg": 8},
    )  # fmt: skip
    truth = SceneTruth(covering, rendering.mono(32, 32))
    visible = truth.flow(0, 10_000).visible
    first, second = truth.ids(0).object == 1, truth.ids(10_000).object == 2
    assert first.all() and second.sum() > 300
    np.testing.assert_array_equal(visible, ~second)
    rows = 2_000 + 250.0 * np.arange(32)  # a rolling shutter: the card is somewhere else for each row
    covered = truth.ids(rows).object == 2
    assert covered.sum() > 100 and np.ptp(covered.sum(axis=1)) > 3
    np.testing.assert_array_equal(truth.flow(0, rows).visible, ~covered)


def test_a_step_of_one_mesh_is_mixed_although_its_normals_agree(tmp_path):
    """Two parallel squares in one mesh, 6 cm apart at 2 m: 3 % of the distance, over one column of pixels."""
    corners = [(x, y, z) for z, low, high in ((0.0, -1, 0.003), (0.06, 0.003, 1)) for x in (low, high) for y in (-1, 1)]
    text = "ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\n"
    text += "element face 4\nproperty list uchar int vertex_indices\nend_header\n"
    text += "".join(f"{x} {y} {z}\n" for x, y, z in corners)
    (tmp_path / "step.ply").write_text(text + "3 0 2 1\n3 2 3 1\n3 4 6 5\n3 6 7 5\n")
    (tmp_path / "step.yaml").write_text(
        "schema_version: 1\nname: step\ndescription: two squares\n"
        "objects: [{name: step, shape: mesh, mesh: step.ply, size_m: [2, 2, 0.06]}]\n"
        "light: {type: uniform, illuminance_lux: 100}\n"
        "camera: {origin_m: [0, 0, 2], target_m: [0, 0, 0], horizontal_fov_deg: 8}\n"
    )
    mixed = SceneTruth(hr.load_scene(tmp_path / "step.yaml"), rendering.mono(32, 24)).mixed(0)
    assert mixed.any(axis=1).all() and mixed.sum(axis=1).max() <= 2


@pytest.mark.parametrize(
    ("tile", "step", "even"), [("R e G\nB G R", (3.0, 2.0), True), ("R e G\nB G e", (3.0, 1.0), False)]
)
def test_grids_of_event_pixels_have_steps_of_their_own_down_and_across(tile, step, even):
    """Event pixels of tiles of 2 rows and 3 columns, in a region that begins at column 9 and row 4."""
    grid = {"evs_grid.rows_per_tile": tile.count("e"), "evs_grid.cols_per_tile": 1}
    size = {"geometry.rows": 40, "geometry.cols": 66}
    sensor = hr.load_sensor("mipi-hybridevs", {**size, **grid, "tile": tile}).crop(12, 8, 9, 4)
    raster = Raster.of(sensor, "events")
    places = np.argwhere(np.tile([[c == "e" for c in line.split()] for line in tile.split("\n")], (4, 4)))
    assert raster.step == step and raster.first == (9, 4) and raster.is_even == even
    np.testing.assert_array_equal(raster.row.ravel(), places[:, 0] + 4)
    np.testing.assert_array_equal(raster.col.ravel(), places[:, 1] + 9)
    number = np.indices(raster.shape)
    origin = np.mean([raster.col - step[0] * number[1], raster.row - step[1] * number[0]], axis=(1, 2))
    assert raster.origin_px == pytest.approx(tuple(origin))
    found = raster.to_grid(np.array([[11.0, 17.0], [30.5, 4.0]]))
    np.testing.assert_allclose(found, (np.array([[11.0, 17.0], [30.5, 4.0]]) - origin) / step)
    projection = SimpleNamespace(focal_px=480.0, centre_px=(33.0, 19.0))
    optics = SimpleNamespace(distortion=SimpleNamespace(model="opencv", coefficients=(0.1, 0.2)))
    rays = SimpleNamespace(view=SimpleNamespace(projection=projection), sensor=SimpleNamespace(optics=optics))
    made = camera_model(rays, raster).as_dict()
    centre = (np.array([33.0, 19.0]) - origin) / step
    np.testing.assert_allclose(made["k"], [[160, 0, centre[0]], [0, 480 / step[1], centre[1]], [0, 0, 1]])
    assert (made["width"], made["height"]) == raster.shape[::-1] and made["is_even"] == even
    assert (made["distortion_model"], made["distortion"]) == ("opencv", [0.1, 0.2])


@pytest.mark.parametrize("is_global", [True, False])
def test_what_may_hide_a_point_is_looked_for_from_the_camera_at_the_time_of_its_row(is_global):
    """Between two tabulated poses of camera and object, as far as the row is; points of the sky have none in front."""

    def poses(seed, *shape):
        made = np.broadcast_to(np.eye(4), (*shape, 4, 4)).copy()
        rng = np.random.default_rng(seed)
        made[..., :3, :3] = Rotation.random(int(np.prod(shape)), random_state=seed).as_matrix().reshape(*shape, 3, 3)
        made[..., :3, 3] = rng.normal(size=(*shape, 3))
        return made

    camera, groups = poses(1, 3), poses(2, 2, 3)
    low, share = np.array([0, 1, 1, 0]), np.array([0.25, 0.5, 0.75, 0.4])
    after = SimpleNamespace(
        camera=camera, groups=groups, is_global=is_global, between=lambda rows: (low, low + 1, share),
        times_at=lambda rows: 10 * rows,
    )  # fmt: skip
    before = SimpleNamespace(camera=poses(3, 2), groups=poses(4, 2, 2), index=lambda rows: rows % 2)
    points = np.random.default_rng(5).normal(size=(4, 4))
    points[:, 3] = 1
    seen = []
    rays = SimpleNamespace(
        sensor=SimpleNamespace(layout=SimpleNamespace(row0=7)),
        sees=lambda there, t_us, origin: seen.append((there, t_us, origin)) or [True, False, True],
        sees_sky=lambda there, t_us, origin: seen.append((there, t_us, origin)) or [True],
    )
    asked = []
    surfaces = SimpleNamespace(points=lambda *given: asked.append(given) or points)
    which, row, group = np.array([1, 2, 4, 5]), np.arange(6) + 3, np.array([9, 0, 1, 9, 0, 1])
    distance = np.array([9, 1.0, 2.0, 9, np.inf, 4.0], np.float32)
    corner = np.arange(12.0).reshape(6, 2)
    found = _unoccluded(rays, after, before, surfaces, group, np.arange(6), row, which, corner, distance)
    assert found.tolist() == [True, False, True, True] and asked[0][1].tolist() == (row[which] + 7).tolist()
    part = np.zeros(4) if is_global else share
    for k, (n, own) in enumerate(zip(which, (0, 1, 3, 2), strict=True)):
        g = group[n]
        rest = np.linalg.inv(before.groups[g, row[n] % 2]) @ points[k]
        pose = (1 - part[k]) * groups[g, low[k]] + part[k] * groups[g, low[k] + 1]
        origin = ((1 - part[k]) * camera[low[k]] + part[k] * camera[low[k] + 1])[:3, 3]
        there, t_us, at = (np.concatenate([one[j] for one in seen])[own] for j in range(3))
        np.testing.assert_allclose(there, (pose @ rest)[:3])
        np.testing.assert_allclose(at, origin)
        assert t_us == 10 * corner[n, 1]
