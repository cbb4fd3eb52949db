"""The geometry of the lens in one place: float64 both ways, the rays of the renderer, and the formula written out."""

import numpy as np
import rendering

import hesim_render as hr
from hesim_render.core.backend import jit
from hesim_render.sources.render.camera import RayFactory, place_camera

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
    lanes = [types.Float(values.astype(np.float32)) for values in (row, col, *aperture)]
    origin, direction = RayFactory(view).rays(lanes[0], lanes[1], (lanes[2], lanes[3]), None)
    local = np.array(direction, np.float64).T @ view.camera_to_world[:3, :3]
    np.testing.assert_allclose(np.array(origin).ravel(), view.camera_to_world[:3, 3], rtol=1e-6)
    place = view.projection.project(local)
    expected = np.stack([col + aperture[0] - 0.5, row + aperture[1] - 0.5], axis=1)
    assert np.abs(place - expected).max() < 1e-3
