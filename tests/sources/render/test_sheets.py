"""Triangles in one plane that are found through a grid, against Mitsuba's own search."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial import Delaunay

from hesim_render.core.backend import select
from hesim_render.sources.render.scene.mitsuba_version import mitsuba
from hesim_render.sources.render.transport import moving_scene, sheets
from hesim_render.sources.render.transport.closed_form import Part, surface_of
from hesim_render.sources.render.transport.moving_scene import MovingScene
from hesim_render.sources.render.transport.sheets import sheets_of

COUNT = 60_000
HALVES = [[0, 1, 2], [0, 2, 3]]

pytestmark = pytest.mark.skipif(select().backend == "cuda", reason="a GPU has units for triangles")


@pytest.fixture(autouse=True)
def however_they_lie(monkeypatch):
    """A grid is used even if a tree of boxes were as fast."""
    monkeypatch.setattr(sheets, "_LEAST_CROWDED", 0.0)


def mesh(vertices, triangles):
    mi = mitsuba()
    made = mi.Mesh("mesh", len(vertices), len(triangles))
    changed = mi.traverse(made)
    changed["vertex_positions"] = np.ravel(vertices).astype(np.float32)
    changed["faces"] = np.ravel(triangles).astype(np.uint32)
    changed.update()
    return made


def scene_of(*shapes):
    return mitsuba().load_dict({"type": "scene", **{f"shape_{k}": shape for k, shape in enumerate(shapes)}})


def turned(seed):
    """Axes of a plane, and its normal."""
    return np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]


def patches(seed=3, size=(0.31, 0.17), axes=None, at=(0.05, -0.04, 0.3)):
    """Two meshes, each with some triangles of one plane and without others: there are holes. A few are thin."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (260, 2))
    points[200:] = points[:60] + rng.normal(0, 1e-3, (60, 2))
    triangles = Delaunay(points).simplices
    kind = rng.integers(0, 3, len(triangles))
    axes = turned(seed) if axes is None else axes
    corners = (points * size) @ axes[:, :2].T + at
    return [mesh(corners, triangles[kind == number]) for number in range(2)]


def rays(towards=0.25, seed=1):
    mi, rng = mitsuba(), np.random.default_rng(seed)
    origin = rng.normal(size=(3, COUNT)) * rng.choice([0.2, 1.0], COUNT)
    direction = rng.normal(size=(3, COUNT)) * towards + np.array([[0.05], [-0.04], [0.3]]) - origin
    direction /= np.linalg.norm(direction, axis=0)
    ray = mi.Ray3f(mi.Point3f(origin.astype(np.float32)), mi.Vector3f(direction.astype(np.float32)))
    ray.maxt = mi.Float(rng.choice([np.inf, 0.7], COUNT).astype(np.float32))
    return ray


def wall(axes, at):
    """A rectangle of two triangles in another plane."""
    corners = np.array([[-0.6, -0.7], [0.8, -0.7], [0.8, 0.5], [-0.6, 0.5]]) @ axes[:, :2].T + at
    return mesh(corners, [[0, 1, 2], [0, 2, 3]])


SCENES = {
    "one plane": lambda: patches(),
    "a wall behind": lambda: [*patches(), wall(turned(3), np.array([0.05, -0.04, 0.3]) - 0.07 * turned(3)[:, 2])],
    "two that cross": lambda: [*patches(), *patches(5)],
    # as of a target that is read from a file: two decals 20 µm above one another
    "almost one plane": lambda: [
        *patches(axes=np.eye(3)),
        *patches(6, (0.21, 0.09), np.eye(3), (0.02, -0.03, 0.30002)),
    ],
}


@pytest.mark.parametrize("name", SCENES)
def test_hits_are_those_of_mitsuba(name):
    import drjit as dr

    mi = mitsuba()
    scene = scene_of(*SCENES[name]())
    part = Part(mi, scene, apart=False)
    ray, everywhere = rays(), mi.Bool(True)
    assert part._scene is None
    theirs = scene.ray_intersect(ray)
    hit, face = part.nearest(ray, False, everywhere)
    ours = surface_of([part], hit, face, ray, mi.RayFlags.All, everywhere)

    met, wanted = np.array(hit.is_valid()), np.array(theirs.is_valid())
    assert 0.05 < wanted.mean() < 0.9
    # a ray that grazes an edge may fall to the other side by rounding
    assert np.mean(met == wanted) > 0.9998
    assert np.all(np.isinf(np.array(hit.t)[~met]))
    both = met & wanted
    off = np.full(COUNT, np.inf)
    off[both] = np.abs(np.array(hit.t)[both] - np.array(theirs.t)[both])
    assert np.mean(off[both] < 3e-6) > 0.9998
    for field in ("shape", "prim_index"):
        told, known = getattr(ours, field), getattr(theirs, field)
        if field == "shape":
            told, known = (dr.reinterpret_array(mi.UInt32, pointer) for pointer in (told, known))
        assert np.mean(np.array(told)[both] == np.array(known)[both]) > 0.9995, field
    same = both & (np.array(ours.prim_index) == np.array(theirs.prim_index)) & (off < 3e-6)
    for field, told, known in [("p", ours.p, theirs.p), ("n", ours.n, theirs.n), ("wi", ours.wi, theirs.wi)]:
        assert np.mean(np.abs(np.array(told) - np.array(known))[:, same].max(axis=0) < 2e-5) > 0.999, field

    blocked = np.array(part.blocks(ray, everywhere))
    np.testing.assert_array_equal(blocked, met)
    asked = mi.Bool(np.arange(COUNT) % 3 == 0)
    hit, _ = part.nearest(ray, False, asked)
    for some in (hit.is_valid(), part.blocks(ray, asked)):
        np.testing.assert_array_equal(np.array(some), met & np.array(asked))


def fan(count):
    """Points of a circle, and triangles between these, from 1 on, and its middle, 0."""
    angle, each = np.linspace(0, 2 * np.pi, count, endpoint=False), np.arange(count)
    rim = np.stack([0.13 * np.cos(angle), 0.13 * np.sin(angle)], axis=1)
    return rim, np.stack([np.zeros(count, int), each + 1, (each + 1) % count + 1], axis=1)


def test_a_grid_only_serves_triangles_whose_boxes_overlap_much(monkeypatch):
    """In the axes of its first side, boxes of a fan of n triangles have n/4π times the area of the box around all."""
    monkeypatch.undo()  # of `however_they_lie`
    for count, is_served in ((200, False), (400, True)):
        rim, triangles = fan(count)
        corners = np.append(np.concatenate([[[0, 0]], rim]), np.full((count + 1, 1), 0.2), axis=1)
        assert bool(sheets_of([mesh(corners, triangles)])) == is_served
    # one plane of them is enough
    assert len(sheets_of([mesh(corners, triangles), wall(np.eye(3), (0.1, 0.2, -0.1))])) == 2
    assert sheets_of(patches()) == []


def test_moving_sheets_are_tested_one_by_one(monkeypatch):
    """A loop over many objects knows faces and balls."""
    forms = [SimpleNamespace(sheets=[1] if k in (1, 3, 6) else []) for k in range(7)]
    groups = [SimpleNamespace(part=SimpleNamespace(form=form), trajectory=None) for form in (*forms, None)]
    scene, made = MovingScene.__new__(MovingScene), []
    scene.mi, scene.groups, scene._resting = None, groups, None
    monkeypatch.setattr(moving_scene, "Tracks", lambda trajectories: None)
    monkeypatch.setattr(moving_scene, "Fleet", lambda mi, own, numbers, *others: made.append((own, numbers)))
    scene._sort_groups()
    assert scene._single == [1, 3, 6, 7]
    assert made == [([forms[k] for k in (0, 2, 4, 5)], [0, 2, 4, 5])]


def test_there_is_no_gap_between_two_triangles_and_nothing_beyond_the_rim():
    """Rays through all sides and corners of a fan of thin triangles, as in the middle of a Siemens star."""
    mi, rng = mitsuba(), np.random.default_rng(8)
    axes, at = turned(11), np.array([0.4, -1.3, 0.2])
    rim, triangles = fan(400)
    corners = np.concatenate([[[0, 0]], rim]) @ axes[:, :2].T + at
    part = Part(mi, scene_of(mesh(corners, triangles[::2]), mesh(corners, triangles[1::2])), apart=False)
    assert part._scene is None

    def met(place):
        target = place @ axes[:, :2].T + at
        origin = at + 0.9 * axes[:, 2] + rng.normal(0, 0.1, (*place.shape[:1], 3))
        direction = target - origin
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        ray = mi.Ray3f(mi.Point3f(origin.T.astype(np.float32)), mi.Vector3f(direction.T.astype(np.float32)))
        found = np.array(part.nearest(ray, False, mi.Bool(True))[0].is_valid())
        np.testing.assert_array_equal(np.array(part.blocks(ray, mi.Bool(True))), found)
        return found

    on_sides = rim[rng.integers(0, 400, 40_000)] * rng.uniform(0, 0.999, (40_000, 1))
    assert met(on_sides).all()
    middle = 0.5 * (rim + np.roll(rim, -1, axis=0))
    assert met(middle * (1 - 2e-5)).all()
    assert not met(middle * (1 + 2e-5)).any()


def test_the_rim_belongs_to_the_sheet():
    """Straight rays at a square of 5 by 5 smaller ones, on its corners and sides, in numbers that nothing rounds."""
    mi = mitsuba()
    at = np.arange(6) * 0.125 - 0.25
    points = np.array([[x, y, -0.5] for y in at for x in at])
    first = np.array([6 * row + col for row in range(5) for col in range(5)])[:, None]
    part = Part(
        mi, scene_of(mesh(points, np.concatenate([np.add(first, [0, 1, 6]), np.add(first, [7, 6, 1])]))), apart=False
    )
    assert part._sheets
    rim = points[(np.abs(points[:, :2] - 0.0625) > 0.3).any(axis=1)]
    assert len(rim) == 20
    ray = mi.Ray3f(mi.Point3f(np.add(rim, [0, 0, 0.75]).T.astype(np.float32)), mi.Vector3f(0, 0, -1))
    hit, _ = part.nearest(ray, False, mi.Bool(True))
    assert np.array(hit.t).tolist() == [0.75] * 20
    assert np.array(part.blocks(ray, mi.Bool(True))).all()


def test_a_ray_leaves_the_sheet_it_starts_from():
    mi, rng = mitsuba(), np.random.default_rng(4)
    part = Part(mi, scene_of(*patches()), apart=False)
    ray = rays(0.1)
    hit, face = part.nearest(ray, False, mi.Bool(True))
    si = surface_of([part], hit, face, ray, mi.RayFlags.All, mi.Bool(True))
    direction = rng.normal(size=(3, COUNT))
    direction /= np.linalg.norm(direction, axis=0)
    onwards = si.spawn_ray(mi.Vector3f(direction.astype(np.float32)))
    start = np.array(hit.is_valid())
    assert start.any()
    assert not np.array(part.blocks(onwards, mi.Bool(True)))[start].any()


def lifted(height, seed=3):
    """The same plane, with one corner lifted by some of its size."""
    rng = np.random.default_rng(seed)
    points = np.concatenate([rng.uniform(-1, 1, (40, 2)), np.zeros((40, 1))], axis=1)
    points[7, 2] = height
    return [mesh(points, Delaunay(points[:, :2]).simplices)]


def test_planes_are_told_apart():
    assert [len(sheet.corners) for sheet in sheets_of(patches())] == [sum(one.face_count() for one in patches())]
    assert len(sheets_of(lifted(0))) == 1
    assert sheets_of(lifted(1e-4)) == []
    sizes = [len(sheet.corners) for sheet in sheets_of(SCENES["almost one plane"]())]
    assert sizes == [sum(m.face_count() for m in patches()), sum(m.face_count() for m in patches(6))]
    three = [wall(np.eye(3), (0, 0, 0.1 * k)) for k in range(4)]
    assert len(sheets_of(three[:3])) == 3
    assert sheets_of(three) == []
    # a triangle without an area belongs to no plane, nor one that is smaller than what its corners are rounded by
    corners = np.array([[0, 0, 5], [1, 0, 5], [0, 1, 5], [0, 0, 2], [0, 0, 3], [0, 0, 1], [1e-6, 0, 1], [0, 1e-6, 1]])
    (sheet,) = sheets_of([mesh(corners, [[0, 1, 2], [3, 4, 5], [5, 6, 7]])])
    assert sheet.owner.tolist() == [[0, 0]]


@pytest.mark.parametrize(("away", "above", "beside"), [(100.0, 1e-4, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.5)])
def test_triangles_that_overlap_are_left_to_mitsuba(away, above, beside):
    """A decal on a wall: far away, 0.1 mm are less than what coordinates of its plane are rounded by here. The same
    twice; and squares that only touch do not overlap.
    """
    mi, axes = mitsuba(), np.eye(3)
    at = np.array([away, 0.3 * away, -away])
    back = wall(axes, at)
    decal = np.array([[0.1, 0.1], [0.3, 0.1], [0.3, 0.2], [0.1, 0.2]])
    decal[:, 0] += 1.4 * beside
    front = mesh(decal @ axes[:, :2].T + at + [0, 0, above], [[0, 1, 2], [0, 2, 3]])
    small = [mesh(corners, [[0, 1, 2]]) for corners in np.array([[[5, 5, 0], [5, 6, 0], [6, 5, 0]]] * 20) * 1.0
             + np.arange(20)[:, None, None] * [2.0, 0, 0] + at]  # fmt: skip
    form = Part(mi, scene_of(back, front, *small), apart=False).form
    assert (form is None) == (beside == 0)


def test_what_is_in_no_plane_is_left_to_mitsuba():
    mi = mitsuba()
    for shapes in (lifted(0.1), [*patches(), {"type": "sphere", "radius": 0.1}], [*patches(), {"type": "disk"}]):
        part = Part(mi, scene_of(*shapes), apart=False)
        assert part.form is None
        assert not part._sheets


def test_parts_of_triangles_within_a_square():
    """Against many places: sides that stand upright or lie along the square, corners in and out of it."""
    rng = np.random.default_rng(2)
    triangles = rng.uniform(-1, 2, (70, 3, 2))
    triangles[:20, 1, 0] = triangles[:20, 0, 0]
    triangles[20:40, 2, 1] = triangles[20:40, 1, 1] = 0.3
    triangles[40:50] = triangles[40:50] * 0.2 + 0.4
    places = rng.random((20_000, 2))
    before, after = triangles[:, [1, 2, 0]], triangles[:, [2, 0, 1]]
    along, to = after - before, places[:, None, None] - before
    sides = along[..., 0] * to[..., 1] - along[..., 1] * to[..., 0]
    inside = np.all(sides > 0, axis=2) | np.all(sides < 0, axis=2)
    np.testing.assert_allclose(sheets._parts(triangles), inside.mean(axis=0), atol=0.015)
    whole = np.array(
        [
            [[-3, -3], [5, -3], [-3, 5]],
            [[0, 0], [1, 0], [0, 1]],
            [[0.25, 0], [0.75, 0], [0.25, 2]],
            [[1, 0], [2, 1], [1, 1]],
        ]
    )
    np.testing.assert_allclose(sheets._parts(whole), [1, 0.5, 0.375, 0], rtol=0, atol=1e-12)  # fmt: skip


def test_cells_within_a_triangle_and_cells_that_triangles_cover():
    """A fan of unequal triangles, of which one is left out."""
    angle = np.sort(np.random.default_rng(7).uniform(0, 2 * np.pi, 23))
    points = np.append([[0.1, -0.2]], 0.7 * np.stack([np.cos(angle), 1.3 * np.sin(angle)], axis=1), axis=0)
    each = np.arange(1, 24)
    triangles = np.stack([np.zeros(23, int), each, each % 23 + 1], axis=1)[np.arange(23) != 5]
    (sheet,) = sheets_of([mesh(np.append(points, np.full((24, 1), 0.4), axis=1), triangles)])
    side, (first, _) = 2**sheet.halvings, sheet.cells
    begin, end = sheet.cell_rows.astype(int).T
    covered, is_one = end % 2 == 1, begin == end // 2
    # places in each cell, up to its rim, and the triangles that hold them
    at = np.linspace(0.001, 0.999, 17)
    row, col = np.divmod(np.arange(side**2), side)
    places = np.stack(
        np.broadcast_arrays((col[:, None, None] + at) / side, (row[:, None, None] + at[:, None]) / side), -1
    )
    inside = np.all(
        np.einsum("nsk,cijk->cijns", sheet.distances[0][..., :2], places) + sheet.distances[0][..., 2] > 0, -1
    )
    in_all = inside.all(axis=(1, 2))
    np.testing.assert_array_equal(is_one & covered, in_all.any(axis=1))
    assert (sheet.cells[1][begin[is_one & covered]] == in_all.argmax(axis=1)[is_one & covered]).all()
    np.testing.assert_array_equal(covered, inside.any(axis=3).all(axis=(1, 2)))
    # all other cells keep their rows
    others = ~(is_one & covered)
    np.testing.assert_array_equal(begin[others], first[:-1][others])
    np.testing.assert_array_equal(end[others] // 2, first[1:][others])
    assert min(np.sum(is_one & covered), np.sum(covered & ~is_one), np.sum(~covered & (end // 2 > begin))) > 10


def test_where_triangles_overlap_only_cells_within_one_count_as_covered():
    """A square twice: the sum of its parts of a cell might hide a hole. Another square beside it does not overlap."""
    square = np.array([[0, 0, 0], [2, 0, 0], [2, 3, 0], [0, 3, 0]])[HALVES] / 3
    beside = square + np.array([2 / 3, 0, 0])
    sheet = sheets.Sheet(np.concatenate([square, square, beside]), np.zeros((6, 2), np.uint32))
    side = 2**sheet.halvings
    # the first side of the square, along which cells lie, takes half of them, so that its diagonal rises by two of them
    expected = np.ones((side, side), int)
    expected[np.arange(side), np.arange(side) // 2] = 0
    np.testing.assert_array_equal(sheet.cell_rows[:, 1].reshape(side, side) % 2, expected)
