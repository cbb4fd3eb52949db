"""Light that a flat mirror throws on diffuse surfaces: closed form, Mitsuba's own paths, and what it saves."""

import numpy as np
import pytest
from rendering import flux_image, mitsuba_scene, mono, pair_tracer
from rendering import traced as traced_pairs

from hesim_render.core.host_arrays import from_host
from hesim_render.sources.render.scene.mitsuba_version import mitsuba
from hesim_render.sources.render.transport import paths
from hesim_render.sources.render.transport.mirrored_lamps import Cones, LampImages

COLS, ROWS = 32, 24
GREY = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.5}}
BLACK = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.0}}
MIRROR = {"type": "conductor", "material": "none"}
#: A lamp of 0.3 m × 0.3 m at x = -0.7 m, z = 0.8 m that shines along +x and -z, as columns: half width, half height,
#: normal, centre.
LAMP = np.array([[0, 0.15, 0], [0.15 * 2**-0.5, 0, 0.15 * 2**-0.5], [2**-0.5, 0, -(2**-0.5)], [-0.7, 0, 0.8]]).T
WALL_X = 0.6


def placed(columns):
    matrix = np.eye(4)
    matrix[:3] = columns
    return matrix.tolist()


def mirror(bsdf=MIRROR, x=WALL_X, side=-1.0):
    """A flat wall at x of 4 m × 4 m that faces -x, or +x with side 1."""
    columns = np.array([[0, 2, 0], [0, 0, 2 * side], [side, 0, 0], [x, 0, 0]]).T
    return {"type": "rectangle", "to_world": placed(columns), "bsdf": bsdf}


def room(bsdf=GREY, depth=3, **shapes):
    lamp = {
        "type": "rectangle",
        "to_world": placed(LAMP),
        "bsdf": BLACK,
        "emitter": {"type": "area", "radiance": {"type": "uniform", "value": 1.0}},
    }
    floor = {"type": "rectangle", "to_world": placed(np.diag([1, 1, 1, 0])[:3]), "bsdf": bsdf}
    return mitsuba_scene({"floor": floor, "lamp": lamp, "wall": mirror(), **shapes}, depth=depth)


def traced(scene, rays, seed=3):
    """Both halves of the flux of every pixel, [2, n]."""
    result = traced_pairs(pair_tracer(scene, mono(COLS, ROWS), seed), rays)
    return np.stack([result.half_a, result.half_b]).astype(np.float64)


def irradiance(points, lamp):
    """∫ cos θ cos θ' / d² dA over a lamp's 200 × 200 middle points, at points of the floor [n, 3]."""
    steps = (np.arange(200) + 0.5) / 100 - 1
    u, v = np.meshgrid(steps, steps)
    half_width, half_height, normal, centre = lamp.T
    there = centre + u.reshape(-1, 1) * half_width + v.reshape(-1, 1) * half_height
    area = 4 * np.linalg.norm(np.cross(half_width, half_height)) / there.shape[0]
    total = []
    for point in points:
        to = there - point
        far = np.linalg.norm(to, axis=1)
        total.append(np.sum(to[:, 2] * np.maximum(-to @ normal, 0) / far**4) * area)
    return np.array(total)


@pytest.mark.slow
def test_light_by_way_of_a_mirror_is_that_of_the_image():
    """A lamp and its image, both integrated numerically: the light of three segments over that of two.

    Five standard errors, from the halves of all pixels: false alarm below 1e-6.
    """
    image = LAMP * np.array([[-1], [1], [1]]) + np.array([[0, 0, 0, 2 * WALL_X], [0] * 4, [0] * 4])
    x, y = np.meshgrid(((np.arange(COLS) + 0.5) / COLS - 0.5) * 0.8, ((np.arange(ROWS) + 0.5) / ROWS - 0.5) * 0.6)
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    direct, mirrored = irradiance(points, LAMP), irradiance(points, image)
    expected = mirrored.sum() / direct.sum()
    assert 0.05 < expected < 0.5
    flux, errors = [], []
    for depth in (2, 3):
        halves = traced(room(depth=depth), 1024)
        flux.append(halves.mean(axis=0).sum())
        errors.append(np.sqrt(np.sum((halves[0] - halves[1]) ** 2)) / 2)
    error = np.hypot(errors[1], errors[0] * flux[1] / flux[0]) / flux[0]
    assert error < 0.01 * expected
    # the flux of a pixel is not quite that of its middle: 1e-4 of it
    assert abs(flux[1] / flux[0] - 1 - expected) < 5 * error + 1e-4 * expected


@pytest.mark.slow
def test_it_takes_fewer_rays(monkeypatch):
    def square_error():
        halves = traced(room(), 64)
        return np.mean((halves[0] - halves[1]) ** 2)

    seen = square_error()
    monkeypatch.setattr(paths.LampImages, "of", classmethod(lambda cls, mi, scene: cls(mi, [])))
    assert seen < square_error() / 5


@pytest.mark.parametrize(
    "bsdf",
    [
        pytest.param(GREY, marks=pytest.mark.slow),  # as in `test_diffuse`
        {"type": "plastic", "diffuse_reflectance": {"type": "uniform", "value": 0.4}},
        {"type": "roughplastic", "diffuse_reflectance": {"type": "uniform", "value": 0.4}, "alpha": 0.2},
        pytest.param({"type": "twosided", "nested": GREY}, marks=pytest.mark.slow),
    ],
    ids=["diffuse", "plastic", "rough plastic", "both sides"],
)
def test_flux_is_that_of_mitsuba(bsdf):
    """Two mirrors that face each other, a glass ball, a sky, five segments; the exact mode has Mitsuba's own paths.

    Differences over their standard errors, of 48 groups of pixels, four times: beyond 4.5 in one run of 1000.
    """
    glass = {"type": "sphere", "center": [0.1, 0.1, 0.15], "radius": 0.1, "bsdf": {"type": "dielectric"}}
    # most light comes from a sky: what is not drawn from the images has to make up for what is
    sky = {"type": "constant", "radiance": {"type": "uniform", "value": 0.05}}
    scene = room(bsdf, 5, glass=glass, other=mirror(x=-1.0, side=1.0), sky=sky)

    def grouped(halves):
        groups = halves.reshape(2, ROWS // 4, 4, COLS // 4, 4).mean(axis=(2, 4))
        # of all groups alike: a group's own two halves say too little
        return groups.mean(axis=0), np.mean((groups[0] - groups[1]) ** 2 / groups.mean(axis=0)) / 4

    ours, our_noise = grouped(traced(scene, 1024))
    theirs, their_noise = grouped(np.stack(flux_image(scene, mono(COLS, ROWS), 1024)[:2]))
    off = (ours - theirs) / np.sqrt((our_noise + their_noise) * theirs)
    assert np.abs(off).max() < 4.5
    assert abs(off.mean()) * off.size**0.5 < 4.5


def test_directions_are_drawn_with_their_density():
    """Two cones that overlap; each of the checks fails in fewer than one of 10^6 other seeds."""
    mi = mitsuba()
    count = 1 << 20
    tilt = np.array([np.sin(0.3), 0, np.cos(0.3)])
    widths, chances = (0.1, 0.05), (0.2, 0.1)
    axes = (np.array([0.0, 0, 1]), tilt)
    cones = Cones(
        mi,
        [
            (mi.Vector3f(a), from_host(mi.Float, w), from_host(mi.Float, c))
            for a, w, c in zip(axes, widths, chances, strict=True)
        ],
    )
    rng = np.random.default_rng(4)
    uniform = from_host(mi.Float, rng.random(count, np.float32))
    direction, drawn = cones.sample(uniform, mi.Point2f(rng.random((2, count), np.float32)))
    drawn, direction = np.array(drawn), np.array(direction).T
    choice = np.array(uniform)
    np.testing.assert_array_equal(drawn, choice < np.float32(0.3))
    for axis, width, own in ((axes[0], 0.1, choice < 0.2), (axes[1], 0.05, (choice >= 0.2) & drawn)):
        below = 1 - direction[own] @ axis
        assert below.min() > -1e-6
        assert below.max() < width + 1e-6
        assert abs(below.mean() - width / 2) < 5 * width / (12 * own.sum()) ** 0.5
        # all around the axis: sin² is 2 · below, half of it in each direction across
        across = direction[own] - (direction[own] @ axis)[:, None] * axis
        assert np.abs(across.mean(axis=0)).max() < 5 * (width / 2 / own.sum()) ** 0.5
    # over the whole sphere the density makes up the chance of being drawn
    z, turn = rng.uniform(-1, 1, count), rng.uniform(0, 2 * np.pi, count)
    around = np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z])
    density = 4 * np.pi * np.array(cones.density(mi.Vector3f(around.astype(np.float32))), dtype=np.float64)
    assert abs(density.mean() - 0.3) < 5 * density.std() / count**0.5


@pytest.mark.parametrize(
    ("walls", "images"),
    [
        ([mirror()], 1),
        ([mirror(), mirror(x=-1.0, side=1.0)], 2),
        ([mirror({"type": "twosided", "nested": MIRROR})], 1),
        ([mirror(side=1.0)], 0),  # its back
        ([mirror({"type": "dielectric"})], 0),
        ([mirror({"type": "roughconductor", "alpha": 0.1})], 0),
        ([mirror(GREY)], 0),
        ([{"type": "sphere", "bsdf": MIRROR}], 0),
        ([{"type": "cube", "bsdf": MIRROR}], 0),
    ],
)
def test_what_counts_as_a_mirror(walls, images):
    mi = mitsuba()
    lamp = {"type": "rectangle", "to_world": mi.ScalarTransform4f(placed(LAMP)), "emitter": {"type": "area"}}
    shapes = {}
    for number, wall in enumerate(walls):
        wall = dict(wall)
        if "to_world" in wall:
            wall["to_world"] = mi.ScalarTransform4f(wall["to_world"])
        shapes[f"wall{number}"] = wall
    scene = mi.load_dict({"type": "scene", "lamp": lamp, **shapes}, optimize=False)
    assert len(LampImages.of(mi, scene)) == images


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_mirror_of_two_sides_reflects_on_that_of_the_lamp(side):
    """However it is turned: points on the lamp's side see the image, points behind the mirror do not."""
    mi = mitsuba()
    wall = mirror({"type": "twosided", "nested": MIRROR}, side=side)
    wall["to_world"] = mi.ScalarTransform4f(wall["to_world"])
    lamp = {"type": "rectangle", "to_world": mi.ScalarTransform4f(placed(LAMP)), "emitter": {"type": "area"}}
    images = LampImages.of(mi, mi.load_dict({"type": "scene", "lamp": lamp, "wall": wall}, optimize=False))
    points = mi.Point3f(np.array([[WALL_X - 0.3, 0.1, 0.0], [WALL_X + 0.3, 0.1, 0.0]]).T.astype(np.float32))
    cones = images.seen_from(points, mi.Vector3f(0, 0, 1), mi.Mask(True))
    assert np.array(cones.chance)[0] > 0 == np.array(cones.chance)[1]
