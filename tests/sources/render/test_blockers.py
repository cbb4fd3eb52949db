"""What shadow rays meet in closed form, against Mitsuba's own search."""

import numpy as np
import pytest
from test_renderer_parts import COUNT, mesh, placed, rays, scene_of

from hesim_render.core.backend import select
from hesim_render.sources.render.scene.mitsuba_version import mitsuba
from hesim_render.sources.render.transport.blockers import _MOST, _MOST_BESIDE, box_of
from hesim_render.sources.render.transport.closed_form import Part

pytestmark = pytest.mark.skipif(select().backend == "cuda", reason="a GPU has units for triangles")

#: Corners of a box that is askew, and its twelve triangles.
SIDES = np.array([[0.4, 0.05, -0.1], [0.1, 0.3, 0.12], [-0.05, 0.11, 0.25]])
UNIT = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)])
QUADS = [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]]
TWELVE = [[quad[k] for k in half] for quad in QUADS for half in ((0, 1, 2), (0, 2, 3))]


def askew(at=(-0.2, -0.3, 0.1), triangles=TWELVE, move=0.0):
    corners = UNIT @ SIDES + at
    corners[5, 1] += move
    return mesh(corners, triangles)


def boxes(count):
    rng = np.random.default_rng(5)
    own = [{"type": "cube", "to_world": placed(k, 0.13, rng.uniform(-0.6, 0.6, 3))} for k in range(count - 1)]
    return [*own[:1], askew(), *own[1:]]


BALLS = [{"type": "sphere", "center": [0.3, -0.2, 0.4 * k], "radius": 0.1 + 0.07 * k} for k in (0, 1)]
RECTANGLES = [{"type": "rectangle", "to_world": placed(20 + k, 0.2, (-0.1, 0.4 * k - 0.3, 0.2))} for k in (0, 1)]
DISK = {"type": "disk", "to_world": placed(31, 0.3, (0.1, 0.0, -0.2))}
#: Shapes, and how many boxes and rectangles are met in closed form.
SCENES = {
    "all in closed form": (lambda: [BALLS[0], *boxes(7), RECTANGLES[0], BALLS[1], RECTANGLES[1]], (7, 2)),
    "boxes beside a disk": (lambda: [DISK, *boxes(_MOST_BESIDE), RECTANGLES[0], BALLS[1]], (_MOST_BESIDE, 0)),
    "too many boxes beside a disk": (lambda: [*boxes(_MOST_BESIDE + 1), DISK], (0, 0)),
    "as many as are met": (lambda: [*boxes(_MOST - 1), RECTANGLES[0]], (_MOST - 1, 1)),
    "too many": (lambda: [*boxes(_MOST - 1), *RECTANGLES], (0, 0)),
    "rectangles beside a disk": (lambda: [*RECTANGLES, DISK, *BALLS], (0, 0)),
    "few faces": (lambda: [askew(), RECTANGLES[1], BALLS[0]], (1, 1)),
}


@pytest.mark.parametrize("apart", [False, True])
@pytest.mark.parametrize("name", SCENES)
def test_shadow_rays_are_blocked_as_by_mitsuba(name, apart):
    mi, (shapes, counts) = mitsuba(), SCENES[name]
    scene = scene_of(*shapes())
    part = Part(mi, scene, apart)
    assert (len(part._blockers._boxes), len(part._blockers._faces)) == counts
    assert (part._blockers._rest is None) == ("disk" not in name and name != "too many")
    ray, asked = rays(), mi.Bool(np.arange(COUNT) % 4 != 1)
    wanted = np.array(scene.ray_test(ray, asked))
    assert 0.05 < wanted.mean() < 0.7
    # a ray that grazes an edge may fall to the other side by rounding
    assert np.mean(np.array(part.blocks(ray, asked)) == wanted) > 0.9999


def test_straight_rays_along_the_axes_of_a_box():
    """No component of the direction but one; from within, from outside, and past it."""
    mi = mitsuba()
    scene = scene_of({"type": "cube", "to_world": mi.ScalarTransform4f().translate([0.5, -1.0, 2.0]).scale(0.25)},
                     {"type": "sphere", "center": [50.0, 0, 0]})  # fmt: skip
    part = Part(mi, scene, apart=False)
    for axis in range(3):
        for way in (-1.0, 1.0):
            # along the ray from the middle of the box, beside it, and whether the ray then meets it, and within 0.6 m
            for along, beside, meets, is_near in (
                (-1.0, 0.0, True, False),
                (-0.7, 0.2, True, True),
                (0.1, 0.0, True, True),
                (0.3, 0.0, False, False),
                (-0.7, 0.3, False, False),
            ):
                start, direction = np.array([0.5, -1.0, 2.0]), np.zeros(3)
                direction[axis] = way
                start[axis] += along * way
                start[(axis + 1) % 3] += beside
                ray = mi.Ray3f(mi.Point3f(start), mi.Vector3f(direction))
                assert np.array(part.blocks(ray, mi.Bool(True))).tolist() == [meets]
                ray.maxt = mi.Float(0.6)
                assert np.array(part.blocks(ray, mi.Bool(True))).tolist() == [is_near]


@pytest.mark.parametrize(
    ("size", "at"), [(0.05, (0.5, 0.2, -0.3)), (1.0, (0.0, 0.0, 0.0)), (80.0, (-300.0, 20.0, 9.0))]
)
def test_a_box_maps_its_corners_to_those_of_a_cube(size, at):
    corners = size * UNIT @ SIDES + at
    to_unit = box_of(mesh(corners, TWELVE))
    assert to_unit.shape == (3, 4)
    places = corners.astype(np.float32) @ to_unit[:, :3].T + to_unit[:, 3]
    np.testing.assert_allclose(places, np.rint(places), atol=1e-4)
    assert {tuple(place) for place in np.rint(places).astype(int)} == {tuple(corner) for corner in UNIT}


def test_a_box_may_bring_corners_of_its_own_for_each_triangle():
    corners = (UNIT @ SIDES)[np.ravel(TWELVE)]
    assert box_of(mesh(corners, np.arange(36).reshape(12, 3))) is not None


OTHERS = {
    "a corner that is off": lambda: askew(move=2e-4),
    "a face twice, another one missing": lambda: askew(triangles=[*TWELVE[:10], *TWELVE[:2]]),
    "halves of a face that overlap": lambda: askew(triangles=[*TWELVE[:1], [0, 1, 2], *TWELVE[2:]]),
    **{
        f"triangle {k} twice": lambda k=k: askew(triangles=[*TWELVE[: k ^ 1], TWELVE[k], *TWELVE[(k ^ 1) + 1 :]])
        for k in range(12)
    },
    "a triangle across": lambda: askew(triangles=[*TWELVE[:11], [0, 3, 7]]),
    "a triangle less": lambda: askew(triangles=TWELVE[:11]),
    "twelve triangles in a plane": lambda: mesh(UNIT @ (SIDES * [[1], [1], [0]]), TWELVE),
    "a ball": lambda: mitsuba().load_dict({"type": "sphere"}),
}


@pytest.mark.parametrize("name", OTHERS)
def test_all_else_is_no_box(name):
    assert box_of(askew()) is not None
    assert box_of(OTHERS[name]()) is None


def test_boxes_beside_instances_are_left_to_mitsuba():
    """It cannot put an instance into a second scene."""
    mi = mitsuba()
    shapes = {"group": {"type": "shapegroup", "disk": {"type": "disk", "to_world": placed(2, 0.2)}}, "box": askew()}
    move = mi.ScalarTransform4f().translate([0.4, 0.1, -0.2])
    shapes["copy"] = {"type": "instance", "to_world": move, "ref": {"type": "ref", "id": "group"}}
    scene = mi.load_dict({"type": "scene", **shapes})
    blockers = Part(mi, scene, apart=False)._blockers
    assert blockers._rest is scene
    assert not blockers._boxes
