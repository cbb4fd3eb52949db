"""Flat outlines that hide a part of a uniform sky: closed forms against rays that are intersected in NumPy."""

import tracemalloc

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.windows import Windows
from hesim_render.sources.render.scene.mitsuba_version import mitsuba
from hesim_render.sources.render.transport import outlines
from hesim_render.sources.render.transport.outlines import BallOutline, Outline, Screen, largest, outlines_of

#: A skew quadrilateral in a tilted plane.
QUAD = np.array([[-0.7, -0.2, 0.1], [0.5, -0.4, 0.3], [0.9, 0.6, 0.52], [-0.3, 0.8, 0.28]])
QUAD[:, 2] = 0.2 * QUAD[:, 0] - 0.1 * QUAD[:, 1] + 0.4


def directions(normal, count, rng):
    """Cosine-distributed directions about a normal."""
    radius, angle = np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    side = np.cross(normal, [0.3, 0.5, -0.8])
    side /= np.linalg.norm(side)
    other = np.cross(normal, side)
    return (
        (radius * np.cos(angle))[:, None] * side
        + (radius * np.sin(angle))[:, None] * other
        + np.sqrt(1 - radius**2)[:, None] * normal
    )


def meets_polygon(corners, point, along):
    """Which rays meet a convex polygon: by its plane, and by the sides of its edges in that plane."""
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    t = ((corners[0] - point) @ normal) / (along @ normal)
    at = point + t[:, None] * along
    turns = [
        np.cross(following - corner, at - corner) @ normal
        for corner, following in zip(corners, np.roll(corners, -1, axis=0), strict=True)
    ]
    return (t > 0) & np.all(np.array(turns) >= 0, axis=0)


def hides(outlines, points, normals, along):
    """`Screen.hides` of one point, normal and direction for each lane."""
    mi = mitsuba()
    vectors = [mi.Vector3f(np.ascontiguousarray(v.T, np.float32)) for v in (points, normals, along)]
    share, count = Screen(mi, outlines).hides(mi.Point3f(vectors[0]), vectors[1], vectors[2])
    return np.array(share), np.array(count)


@pytest.mark.parametrize("point", [
    (0.1, 0.2, -0.35), (0.3, -0.1, 1.1), (1.4, 0.2, 0.45), (-2.0, 1.3, 0.9), (0.15, 0.1, 0.37),
])  # fmt: skip
@pytest.mark.parametrize("normal", [(0.2, -0.1, 0.97), (-0.6, 0.3, -0.74), (0.9, 0.35, 0.26)])
def test_the_share_is_that_of_rays(point, normal):
    point, normal = np.array(point), np.array(normal) / np.linalg.norm(normal)
    along = directions(normal, 60_000, np.random.default_rng(5))
    outline = Outline(QUAD, one_sided=False)
    share, count = hides([outline], np.tile(point, (60_000, 1)), np.tile(normal, (60_000, 1)), along)
    expected = meets_polygon(QUAD, point, along)
    assert np.mean(count != expected) < 2e-4  # rounding at edges
    assert share[0] == pytest.approx(expected.mean(), abs=float(4 * np.sqrt(share[0] * (1 - share[0]) / 60_000) + 1e-5))


@pytest.mark.parametrize("height", [0.97, 0.55, 0.32, -0.02, -0.25, -0.44, -0.9])
@pytest.mark.parametrize("radius_m", [0.3, 0.033])
def test_the_share_of_a_ball_is_that_of_rays(height, radius_m):
    """At various heights over the horizon, as cosines; the larger ball has an angular radius of 27 degrees."""
    along_middle, point = np.array([0.3, -0.5, 0.3]), np.array([0.2, 0.1, -0.3])
    towards = along_middle / np.linalg.norm(along_middle)
    across = np.cross(towards, [0.6, 0.1, 0.2])
    normal = height * towards + np.sqrt(1 - height**2) * across / np.linalg.norm(across)
    along = directions(normal, 100_000, np.random.default_rng(8))
    ball = BallOutline(point + along_middle, radius_m)
    share, count = hides([ball], np.tile(point, (100_000, 1)), np.tile(normal, (100_000, 1)), along)
    nearest = along @ along_middle
    expected = (nearest > 0) & (along_middle @ along_middle - nearest**2 < radius_m**2)
    assert np.mean(count != expected) < 2e-4
    square = radius_m**2 / (along_middle @ along_middle)
    assert share[0] == pytest.approx(expected.mean(), abs=float(4 * np.sqrt(share[0] * (1 - share[0]) / 1e5) + 3e-6))
    if height > np.sqrt(square):
        assert share[0] == pytest.approx(height * square, rel=1e-4, abs=1e-6)
    assert (share[0] > 1e-6) == (height > -np.sqrt(square))


def test_a_ball_hides_nothing_from_itself_and_most_from_where_it_touches():
    ball, up = BallOutline(np.array([0.1, 0.2, 0.5]), 0.2), np.array([[0.0, 0.0, 1.0]] * 4)
    out = np.array([0.3, 0.6, 0.742])
    own = [
        ball.middle + 0.2 * out / np.linalg.norm(out),
        ball.middle + np.array([0.05, 0.02, 0.1]),
        ball.middle - np.array([0, 0, 0.2]),
    ]
    points = np.array([*own, ball.middle - np.array([0, 0, 0.21])])
    share, count = hides([ball], points, up, up)
    np.testing.assert_array_equal(share[:3], 0)
    np.testing.assert_array_equal(count, [0, 0, 0, 1])
    assert share[3] == pytest.approx((0.2 / 0.21) ** 2, rel=1e-4)


def test_a_closed_body_hides_its_silhouette_once():
    low, high = np.array([-0.4, -0.3, 0.2]), np.array([0.5, 0.1, 0.9])
    body = mitsuba().load_dict({"type": "cube", "to_world": box_transform(low, high)})
    faces = outlines_of(mitsuba().load_dict({"type": "scene", "body": body}))
    assert len(faces) == 6 and all(face.one_sided for face in faces)
    rng = np.random.default_rng(3)
    for point, normal in (((1.1, 0.4, -0.2), (-0.6, 0.2, 0.77)), ((0.1, -0.9, 0.6), (0.3, 0.9, 0.31))):
        point, normal = np.array(point), np.array(normal) / np.linalg.norm(normal)
        along = directions(normal, 40_000, rng)
        t = np.sort(np.stack([(low - point) / along, (high - point) / along]), axis=0)
        inside = (t[0].max(axis=1) <= t[1].min(axis=1)) & (t[1].min(axis=1) > 0)
        share, count = hides(faces, np.tile(point, (40_000, 1)), np.tile(normal, (40_000, 1)), along)
        assert np.mean(count != inside) < 3e-4
        assert inside.mean() > 0.02 and share[0] == pytest.approx(inside.mean(), abs=0.01)
    # from its own faces, and from within, it hides nothing
    own = np.array([[0.05, -0.1, 0.9], [0.5, 0.02, 0.44], [0.1, -0.1, 0.5]])
    up = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    share, count = hides(faces, own, up, up)
    np.testing.assert_allclose(share, 0, atol=1e-5)
    np.testing.assert_array_equal(count, 0)


def box_transform(low, high):
    mi = mitsuba()
    middle, half = (low + high) / 2, (high - low) / 2
    return mi.ScalarTransform4f().translate(middle.tolist()).scale(half.tolist())


def mesh(corners, faces):
    """A Mitsuba scene of one mesh."""
    mi = mitsuba()
    made = mi.Mesh("made", vertex_count=len(corners), face_count=len(faces))
    parameters = mi.traverse(made)
    parameters["vertex_positions"] = np.asarray(corners, np.float32).ravel()
    parameters["faces"] = np.asarray(faces, np.uint32).ravel()
    parameters.update()
    return mi.load_dict({"type": "scene", "made": made})


def test_only_flat_and_filled_shapes_have_an_outline():
    grid = np.array([[0.3 * x, 0.2 * y, 0.7] for y in range(4) for x in range(5)])
    cell = [(5 * y + x, 5 * y + x + 1, 5 * y + x + 6, 5 * y + x + 5) for y in range(3) for x in range(4)]
    triangles = [t for a, b, c, d in cell for t in ((a, b, c), (a, c, d))]
    (outline,) = outlines_of(mesh(grid, triangles))
    assert len(outline.corners) == 4 and not outline.one_sided
    assert outline.area_m2 == pytest.approx(1.2 * 0.6)
    assert abs(outline.normal[2]) == pytest.approx(1)
    # a hole, a bend
    assert outlines_of(mesh(grid, triangles[:8] + triangles[10:])) == []
    bent = grid + np.where(grid[:, :1] > 0.7, [0, 0, 0.02], [0, 0, 0.0])
    assert outlines_of(mesh(bent, triangles)) == []
    # five faces of a box: it is open
    mi = mitsuba()
    cube = mi.load_dict({"type": "cube"})
    corners = np.array(cube.vertex_positions_buffer()).reshape(-1, 3)
    faces = np.array(cube.faces_buffer()).reshape(-1, 3)
    assert len(outlines_of(mesh(corners, faces))) == 6
    assert outlines_of(mesh(corners, faces[2:])) == []
    # its corners the other way round: from outside, every face is a back
    assert outlines_of(mesh(corners, faces[:, ::-1])) == []
    ball = {"type": "sphere", "center": [0.2, -0.1, 0.4], "radius": 0.3}
    (known,) = outlines_of(mi.load_dict({"type": "scene", "ball": ball}))
    assert known.middle == pytest.approx([0.2, -0.1, 0.4]) and known.radius_m == pytest.approx(0.3)
    # of a part with other forms, its balls
    among = {"type": "scene", "ball": ball, "plate": {"type": "rectangle"}, "tube": {"type": "cylinder"}}
    assert [type(each) for each in outlines_of(mi.load_dict(among))] == [BallOutline]


def test_the_largest_outlines_count():
    squares = [Outline(size * QUAD, one_sided=False) for size in np.linspace(0.5, 2.7, 12)]
    kept = largest([squares[::2], squares[1::2]])
    areas = [sorted(each.area_m2 for each in part) for part in kept]
    assert areas == [[each.area_m2 for each in squares[4::2]], [each.area_m2 for each in squares[5::2]]]
    # of equal ones there are no more
    alike = [Outline(0.7 * QUAD + 0.1 * number, one_sided=False) for number in range(11)]
    assert largest([alike[:3], alike[3:]]) == [alike[:3], alike[3:8]]


def test_meshes_of_many_triangles_take_little_memory(monkeypatch):
    """A bumpy surface of 20,000 vertices, whose square matrix would take 3 GB; and a limit for larger ones."""
    x, y = np.meshgrid(np.linspace(-0.7, 1.3, 200), np.linspace(0.2, 1.1, 100))
    corners = np.stack([x.ravel(), y.ravel(), 0.1 * np.sin(9 * x * y).ravel()], axis=1)
    first = (np.arange(99)[:, None] * 200 + np.arange(199)).ravel()
    faces = np.concatenate(
        [np.stack([first, first + 1, first + 201], 1), np.stack([first, first + 201, first + 200], 1)]
    )
    tracemalloc.start()
    assert outlines_of(mesh(corners, faces)) == []
    assert tracemalloc.get_traced_memory()[1] < 100e6
    tracemalloc.stop()
    flat = mesh(corners * [1, 1, 0], faces)
    assert len(outlines_of(flat)) == 1
    monkeypatch.setattr(outlines, "_MOST_TRIANGLES", len(faces) - 1)
    assert outlines_of(flat) == []


def test_light_beside_a_moving_target_has_no_bias_and_little_noise():
    """A turning plate hides a part of the sky from a wall: both estimators have one mean, one has little scatter."""
    sensor = hr.load_sensor("davis346").crop(90, 40, 190, 205)
    source = ChangeDrivenFlux(hr.load_scene("rotating-star"), sensor, seed=3)
    tracer, index = source._tracer, source._index
    window, first = Windows(np.array([3700.0]), np.array([4100.0])), np.zeros(index.size, np.int64)
    controlled, plain = (
        tracer.trace(index, first, window, np.full(index.size, 256), np.full(index.size, by), Stream.AUDIT).mean
        for by in (True, False)
    )
    pilot = tracer.pilot(index, first, window, 64, 1.0)
    shadowed = (pilot.plain < 0.97 * pilot.unshadowed) & (pilot.plain_scatter > 0.1 * pilot.unshadowed)
    assert np.count_nonzero(shadowed) > 500
    difference = (controlled - plain)[shadowed] / pilot.unshadowed[shadowed]
    assert abs(difference.mean()) < 4 * difference.std() / np.sqrt(difference.size)
    calm = shadowed & (pilot.controlled_scatter < 0.05 * pilot.plain_scatter)
    assert np.count_nonzero(calm) > 0.6 * np.count_nonzero(shadowed)
