"""The geometry of the lens in one place: float64 both ways, the rays of the renderer, and the formula written out."""

import cv2
import numpy as np
import pytest
import rendering

import hesim_render as hr
from hesim_render.core.backend import jit
from hesim_render.core.host_arrays import from_host
from hesim_render.sources.render.camera import place_camera
from hesim_render.sources.render.primary_rays import RayFactory

SCENE = {
    "objects": [{"name": "wall", "shape": "rectangle", "size_m": [4, 4, 0]}],
    "light": rendering.FURNACE,
    "camera": {"origin_m": [0.3, 0.2, 2.0], "target_m": [0.05, 0, 0]},
}


def whole_view():
    """The largest sensor that ships, all of it, with a short lens."""
    return place_camera(rendering.make_scene(**SCENE).spec, hr.load_sensor("gen2"))


def test_project_and_unproject_are_inverse_to_a_millionth_of_a_pixel():
    projection = whole_view().projection
    place = np.stack(np.meshgrid(np.linspace(-0.5, 3263.5, 41), np.linspace(-0.5, 2447.5, 31)), axis=-1)
    local = projection.unproject(place)
    depth = np.random.default_rng(1).uniform(0.05, 90, place.shape[:-1])[..., None]
    assert np.abs(projection.project(local * depth) - place).max() < 1e-6
    back = projection.unproject(projection.project(local))
    assert np.abs(back - local).max() * projection.focal_px < 1e-6
    assert np.isnan(projection.project([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])).all()  # behind, and beside


def test_a_point_lies_where_similar_triangles_put_it():
    """f = 4 mm focused at the wall, 1.4 µm pixels: x = v X/Z from the chip's middle, whole numbers at pixel centres."""
    view = whole_view()
    away = np.sqrt(0.25**2 + 0.2**2 + 4.0)
    distance_mm = 4.0 * away * 1e3 / (away * 1e3 - 4.0)
    place = view.projection.project([0.1, -0.05, -2.0])
    expected = 0.1 / 2 * distance_mm / 1.4e-3 + 1631.5, 0.05 / 2 * distance_mm / 1.4e-3 + 1223.5
    np.testing.assert_allclose(place, expected, rtol=0, atol=1e-6)


def test_rays_of_the_renderer_leave_through_their_places_to_a_thousandth_of_a_pixel():
    view = whole_view()
    types = jit()
    rng = np.random.default_rng(2)
    row, col = (rng.integers(0, count, 20_000) for count in (2448, 3264))
    aperture = rng.random((2, row.size)).astype(np.float32)
    lanes = [from_host(types.Float, values) for values in (row, col, *aperture)]
    origin, direction = RayFactory(view).rays(lanes[0], lanes[1], (lanes[2], lanes[3]), None)
    local = np.array(direction, np.float64).T @ view.camera_to_world[:3, :3]
    np.testing.assert_allclose(np.array(origin).ravel(), view.camera_to_world[:3, 3], rtol=1e-6)
    place = view.projection.project(local)
    expected = np.stack([col + aperture[0] - 0.5, row + aperture[1] - 0.5], axis=1)
    assert np.abs(place - expected).max() < 1e-3


#: Lenses of GEN2 that see far: 40° to 49° to its corners, and 84° for the fisheye.
DISTORTED = {
    "opencv": (4.0, {"model": "opencv", "k1": -0.25, "k2": 0.05, "p1": 1e-3, "p2": -5e-4}),
    "rational": (3.0, {"model": "opencv", "k1": 0.3, "k2": -0.1, "k3": 0.02, "k4": 0.35, "k5": 0.02, "k6": 0.01}),
    "fisheye": (2.0, {"model": "fisheye", "k1": -0.02, "k2": 0.003}),
}


@pytest.mark.parametrize("name", DISTORTED)
def test_a_lens_with_distortion_is_opencvs_both_ways_and_on_the_device(name):
    focal, model = DISTORTED[name]
    sensor = hr.load_sensor("gen2", {"lens.distortion": model, "lens.focal_length_mm": focal})
    view = place_camera(rendering.make_scene(**SCENE).spec, sensor)
    projection = view.projection
    place = np.stack(np.meshgrid(np.linspace(-0.5, 3263.5, 41), np.linspace(-0.5, 2447.5, 31)), axis=-1)
    local = projection.unproject(place)
    assert np.abs(projection.project(local) - place).max() < 1e-6
    away = np.sqrt(0.25**2 + 0.2**2 + 4.0) * 1e3
    fx = focal * away / (away - focal) / 1.4e-3  # f (1 + |m|)/pitch
    camera = np.array([[fx, 0, 1631.5], [0, fx, 1223.5], [0, 0, 1]])
    project = cv2.fisheye.projectPoints if model["model"] == "fisheye" else cv2.projectPoints
    points = (local * [1, -1, -1]).reshape(-1, 1, 3)
    there, _ = project(points, np.zeros(3), np.zeros(3), camera, np.array(sensor.optics.distortion.coefficients))
    assert np.abs(there.reshape(place.shape) - place).max() < 1e-6
    # rays of the renderer, and back
    types, rng = jit(), np.random.default_rng(2)
    row, col = (rng.integers(0, count, 20_000) for count in (2448, 3264))
    aperture = rng.random((2, row.size)).astype(np.float32)
    lanes = [from_host(types.Float, values) for values in (row, col, *aperture)]
    factory = RayFactory(view)
    origin, direction = factory.rays(lanes[0], lanes[1], (lanes[2], lanes[3]), None)
    way = np.array(direction, np.float64).T @ view.camera_to_world[:3, :3]
    expected = np.stack([col + aperture[0] - 0.5, row + aperture[1] - 0.5], axis=1)
    assert np.abs(projection.project(way) - expected).max() < 1e-3
    seen_col, seen_row, _ = factory.seen(origin + 3 * direction)
    assert np.abs(np.stack([np.array(seen_col), np.array(seen_row)], axis=1) - expected).max() < 0.005
    # beyond the largest tangent of the model, points are seen where they would be at it
    limit, around = projection.distortion.limit, np.radians([10.0, 77.0, 160.0, 250.0, 305.0])
    if limit < 100:
        seen = []
        for radius in (limit, 1.4 * limit, 9 * limit):
            away = np.stack([radius * np.cos(around), radius * np.sin(around), -np.ones(5)], axis=-1)
            points = 2.3 * away @ view.camera_to_world[:3, :3].T + view.camera_to_world[:3, 3]
            point = types.Array3f(*(from_host(types.Float, side) for side in points.T))
            seen.append(np.stack([np.array(place) for place in factory.seen(point)[:2]], axis=-1))
        np.testing.assert_allclose(seen[1:], [seen[0]] * 2, atol=0.05)


def test_a_target_fills_the_picture_of_a_lens_with_distortion_too():
    """A checkerboard of 4:3 in the middle of the field and at its side; the widest part of its rim decides."""
    board = {"type": "checkerboard", "rows": 6, "cols": 8, "width_m": 0.4, "height_m": 0.3}
    scene = rendering.make_scene(target=board, light=rendering.FURNACE, camera={"fit": "target", "fit_margin": 0.9})
    changes = {"lens.distortion": DISTORTED["opencv"][1], "lens.focal_length_mm": 6.0}
    for sensor in (hr.load_sensor("gen2", changes), hr.load_sensor("gen2", changes).crop(800, 600, 2400, 1800)):
        view = place_camera(scene.spec, sensor)
        rim = np.array([[x, y, 0] for x in np.linspace(-0.2, 0.2, 81) for y in np.linspace(-0.15, 0.15, 61)
                        if abs(x) > 0.199 or abs(y) > 0.149])  # fmt: skip
        off = np.abs(view.project(rim) - np.array([sensor.cols, sensor.rows]) / 2) / [sensor.cols / 2, sensor.rows / 2]
        assert abs(off.max() - 0.9) < 1e-3
        np.testing.assert_allclose(view.project(np.zeros((1, 3)))[0], [sensor.cols / 2, sensor.rows / 2], atol=1e-6)
