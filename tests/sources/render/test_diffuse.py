"""Direct light on diffuse surfaces: closed forms against quadrature, both estimates against each other and Mitsuba."""

import numpy as np
import pytest
from rendering import flux_image, make_scene, mono, pair_tracer, traced

from hesim_render.sources.render.scene.mitsuba_version import mitsuba
from hesim_render.sources.render.transport.irradiance import RectangleLight

CAMERA = {"origin_m": [0, 0, 2], "target_m": [0, 0, 0], "horizontal_fov_deg": 22.62}
SHAPES = [
    {"name": "wall", "shape": "rectangle", "size_m": [4, 4, 0], "position_m": [0, 0, -0.3], "reflectance": 0.3,
     "pattern": 0.7, "pattern_count": [25, 25]},
    {"name": "ball", "shape": "sphere", "size_m": [0.2] * 3, "position_m": [0.1, 0.05, 0.1], "reflectance": 0.9},
    {"name": "box", "shape": "box", "size_m": [0.15, 0.1, 0.3], "position_m": [-0.2, 0, 0], "rotation_axis": [1, 1, 0],
     "rotation_deg": 40, "reflectance": 0.5},
    {"name": "plate", "shape": "rectangle", "size_m": [0.2, 0.1, 0], "position_m": [0, -0.2, 0.2],
     "rotation_axis": [1, 0, 0], "rotation_deg": 60, "reflectance": 0.8},
]  # fmt: skip
LAMP = {"type": "area", "illuminance_lux": 900, "position_m": [0.5, 0.9, 1.0], "size_m": [0.5, 0.3]}
LIGHTS = {
    "lamp": LAMP,
    "near lamp seen in the picture": {**LAMP, "position_m": [0.25, 0.1, 0.3], "size_m": [0.2, 0.1]},
    "sky": {"type": "uniform", "illuminance_lux": 400},
    "point": {"type": "point", "illuminance_lux": 500, "position_m": [-0.5, 0.5, 1.5]},
    "sun": {"type": "directional", "illuminance_lux": 500, "direction": [0.5, -0.3, -1]},
}


def frame(rng):
    """Half width, half height, normal and middle of a rectangle, as columns."""
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    if np.linalg.det(turn) < 0:
        turn[:, 0] *= -1
    matrix = np.eye(4)
    matrix[:3, :3] = turn * [rng.uniform(0.05, 0.6), rng.uniform(0.05, 0.6), 1.0]
    matrix[:3, 3] = rng.normal(size=3) * 0.7
    return matrix


def quadrature(matrix, points, normals, steps=600):
    """∫ cos θ cos θ' / d² dA over middle points of a fine grid, what is behind or below cut off."""
    grid = (np.arange(steps) + 0.5) / steps * 2 - 1
    u, v = (values.reshape(-1, 1) for values in np.meshgrid(grid, grid))
    there = matrix[:3, 3] + u * matrix[:3, 0] + v * matrix[:3, 1]
    area = 4 * np.linalg.norm(np.cross(matrix[:3, 0], matrix[:3, 1])) / there.shape[0]
    total = []
    for point, normal in zip(points, normals, strict=True):
        to = there - point
        square = np.sum(to**2, axis=1)
        total.append(np.sum(np.maximum(to @ normal, 0) * np.maximum(-to @ matrix[:3, 2], 0) / square**2) * area)
    return np.array(total)


@pytest.mark.parametrize("seed", [0, 1, 2, *(pytest.param(k, marks=pytest.mark.slow) for k in range(3, 12))])
def test_irradiance_of_a_rectangle_is_that_of_quadrature(seed):
    """Points before, behind and beside it, with the horizon through it for many."""
    mi, rng = mitsuba(), np.random.default_rng(seed)
    matrix = frame(rng)
    points = rng.normal(size=(40, 3))
    points = points[np.linalg.norm(points - matrix[:3, 3], axis=1) > 0.4]
    normals = rng.normal(size=points.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    light = RectangleLight(mi, matrix)
    found = np.array(
        light.irradiance(mi.Point3f(*points.T.astype(np.float32)), mi.Vector3f(*normals.T.astype(np.float32)))
    )
    expected = quadrature(matrix, points, normals)
    assert np.count_nonzero(expected) > 3 or seed not in (0, 1, 2)
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=2e-4 * max(expected.max(), 1e-3))


def test_far_and_small_rectangles_keep_their_digits():
    mi = mitsuba()
    matrix = np.eye(4)
    for size, far in ((1e-3, 1.0), (0.1, 300.0), (1e-4, 50.0)):
        matrix[:3, :3] = np.diag([size, size, -1.0])
        matrix[:3, 3] = [0, 0, far]
        light = RectangleLight(mi, matrix)
        found = np.array(light.irradiance(mi.Point3f(0, 0, 0), mi.Vector3f(0, 0, 1)))[0]
        assert found == pytest.approx(4 * size**2 / far**2, rel=1e-3)


@pytest.mark.parametrize("name", LIGHTS)
def test_flux_is_that_of_mitsubas_paths(name):
    """Sums over 8×6 pixels by both estimates; differences over standard errors from halves, 5 is 1e-5 of all."""
    scene = make_scene(objects=SHAPES, light=LIGHTS[name], camera=CAMERA)
    sensor = mono(48, 36)
    tracer = pair_tracer(scene, sensor)
    assert tracer.is_diffuse

    def groups(half_a, half_b):
        a, b = (np.array(half, np.float64).reshape(6, 6, 6, 8).mean(axis=(1, 3)) for half in (half_a, half_b))
        return (a + b) / 2, (a - b) ** 2 / 4

    a, b, _ = flux_image(scene, sensor, 1024, begin_us=0.0, end_us=0.0)
    wanted, their_square = groups(a, b)
    for controlled in (True, False):
        told = traced(tracer, 1024, 0.0, 0.0, controlled)
        found, square = groups(told.half_a, told.half_b)
        spread = np.sqrt(np.mean(square + their_square))
        assert spread < 0.01 * wanted.mean()
        assert abs(np.mean(found - wanted)) < 5 * spread / found.size**0.5
        assert np.abs(found - wanted).max() < 12 * spread + 1e-5 * wanted.max()


def test_what_nothing_shades_is_exact():
    """A bare wall: parallel light has no noise at all; of a lamp there is what it changes across a pixel."""
    wall = {key: value for key, value in SHAPES[0].items() if not key.startswith("pattern")}

    def seen(light, rays, controlled, seed=1):
        tracer = pair_tracer(make_scene(objects=[wall], light=light, camera=CAMERA), mono(32, 24), seed)
        return traced(tracer, rays, 0.0, 0.0, controlled=controlled).mean

    np.testing.assert_allclose(seen(LIGHTS["sun"], 8, True), seen(LIGHTS["sun"], 4096, True, seed=2), rtol=1e-6)
    many = seen(LAMP, 4096, True)
    off = [np.sqrt(np.mean((seen(LAMP, 64, controlled) / many - 1) ** 2)) for controlled in (True, False)]
    assert off[0] < 1e-3 and off[1] > 3 * off[0]


def test_flux_is_never_negative():
    """At the dark side of a penumbra the lit estimate is a difference of two nearly equal numbers."""
    scene = make_scene(objects=SHAPES, light=LIGHTS["near lamp seen in the picture"], camera=CAMERA)
    for seed in range(3):
        told = traced(pair_tracer(scene, mono(48, 36), seed), 8, 0.0, 0.0, controlled=True)
        assert told.mean.min() >= 0 and min(told.half_a.min(), told.half_b.min()) < 0
