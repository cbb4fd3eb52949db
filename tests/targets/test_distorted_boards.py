"""Boards seen through lenses with distortion: OpenCV finds camera and distortion again."""

import cv2
import numpy as np
import pytest
from boards import CHARUCO, CHECKERBOARD, LIGHT, found_corners
from rendering import flux_image, make_scene, mono

COLS, ROWS = 512, 384
RADIAL = {"model": "opencv", "k1": -0.25, "k2": 0.06, "p1": 8e-4, "p2": -5e-4}
FISHEYE = {"model": "fisheye", "k1": -0.03, "k2": 0.004}
#: Field of view; tilt; part of the picture that the nearest board would fill without them; half width of the search for
#: a corner, px.
SETUP = {"opencv": (60, (20, 45), 0.9, 8), "fisheye": (110, (15, 40), 0.7, 5)}
#: OpenCV 4 has these in `cv2.fisheye`.
OF_FISHEYE = cv2.fisheye if hasattr(cv2.fisheye, "CALIB_FIX_SKEW") else cv2
FLAGS = sum(getattr(OF_FISHEYE, f"CALIB_{name}") for name in ("RECOMPUTE_EXTRINSIC", "FIX_SKEW", "USE_INTRINSIC_GUESS"))


def board_scene(target, fov_deg):
    return make_scene(target=target, light=LIGHT, camera={"origin_m": [0, 0, 1], "horizontal_fov_deg": fov_deg})


def poses(target, count, seed, fov_deg, tilts_deg, fill):
    """The board tilted about any axis near the image plane, all over the picture, at up to 1.5 times the least
    distance."""
    generator = np.random.default_rng(seed)
    spec, half = board_scene(target, fov_deg).spec.target, np.tan(np.radians(fov_deg / 2))
    for _ in range(count):
        around = generator.uniform(0, 2 * np.pi)
        tilt, third = generator.uniform(*tilts_deg), generator.uniform(-0.4, 0.4)
        near = max(spec.width_m / (2 * half), spec.height_m / (2 * half) * COLS / ROWS) / fill
        away = near * generator.uniform(1, 1.5)
        x, y = generator.uniform(-0.15, 0.15, 2) * 2 * half * away * np.array([1, ROWS / COLS])
        yield {**target, "rotation_axis": [np.cos(around), np.sin(around), third], "rotation_deg": float(tilt),
               "position_m": [float(x), float(y), float(1 - away)]}  # fmt: skip


def calibrated(target, model, count, seed, window=None):
    """Errors of OpenCV's camera: of fx and fy, relative; of cx and cy, over the width; largest error of the
    displacement over the field, over the largest displacement; and the number of boards that were found."""
    fov_deg, tilts_deg, fill, usual = SETUP[model["model"]]
    window = window or usual
    sensor, views = mono(COLS, ROWS, lens__distortion=model), []
    for number, placed in enumerate(poses(target, count, seed, fov_deg, tilts_deg, fill)):
        a, b, source = flux_image(board_scene(placed, fov_deg), sensor, 32, seed=100 * seed + number)
        views.append(found_corners(placed, ((a + b) / (a + b).max() * 255).astype(np.float32), window))
    views = [view for view in views if view is not None]
    objects, images = zip(*views, strict=True)
    # the camera as it is: from the field of view, by OpenCV's own function
    half, middle = np.tan(np.radians(fov_deg / 2)), np.array([(COLS - 1) / 2, (ROWS - 1) / 2])
    true = np.array(sensor.optics.distortion.coefficients)
    is_fisheye = model["model"] == "fisheye"

    def place(tangent, k, coefficients):
        points = np.column_stack([tangent, np.ones(len(tangent))]).reshape(-1, 1, 3)
        project = cv2.fisheye.projectPoints if is_fisheye else cv2.projectPoints
        return project(points, np.zeros(3), np.zeros(3), np.diag([*k, 1.0]), coefficients)[0].reshape(-1, 2)

    focal = COLS / 2 / place(np.array([[half, 0.0]]), (1.0, 1.0), true)[0, 0]
    assert abs(source.view.projection.focal_px / focal - 1) < 0.005  # p2 shifts the edge of the field
    focal = source.view.projection.focal_px
    if is_fisheye:
        start = np.array([[focal * 1.1, 0, middle[0]], [0, focal * 1.1, middle[1]], [0, 0, 1.0]])
        _, k, found, _, _ = cv2.fisheye.calibrate(
            [points.reshape(1, -1, 3).astype(np.float64) for points in objects],
            [points.reshape(1, -1, 2).astype(np.float64) for points in images],
            (COLS, ROWS), start, np.zeros((4, 1)), flags=FLAGS,
        )  # fmt: skip
    else:
        _, k, found, _, _ = cv2.calibrateCamera(objects, images, (COLS, ROWS), None, None, flags=cv2.CALIB_FIX_K3)
    x, y = np.meshgrid(np.linspace(-0.5, COLS - 0.5, 40), np.linspace(-0.5, ROWS - 0.5, 30))
    seen = np.column_stack([x.ravel(), y.ravel()]) - middle
    tangent = source.view.projection.undistorted(seen / focal)
    np.testing.assert_allclose(place(tangent, (focal, focal), true), seen, atol=1e-6)
    displacement = seen - tangent * focal
    own = np.array([k[0, 0], k[1, 1]])
    off = place(tangent, own, found) - tangent * own - displacement
    centre = np.abs(k[:2, 2] - middle).max() / COLS
    return np.abs(own / focal - 1).max(), centre, np.abs(off).max() / np.abs(displacement).max(), len(views)


@pytest.mark.parametrize(
    "model",
    [
        pytest.param(RADIAL, id="opencv", marks=pytest.mark.slow),
        pytest.param(FISHEYE, id="fisheye", marks=pytest.mark.slow),
    ],
)
def test_opencv_finds_camera_and_distortion_from_a_few_checkerboards(model):
    focal, centre, distortion, count = calibrated(CHECKERBOARD, model, 9, 1)
    # bounds of 20 boards are 0.001, 0.001 and 0.02; errors of 9 are 1.5 times as large
    assert count >= 4 and focal < 2e-3 and centre < 2e-3 and distortion < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("model", [RADIAL, FISHEYE], ids=["opencv", "fisheye"])
def test_opencv_finds_camera_and_distortion_in_19_of_20_seeds(model):
    found = np.array([calibrated(CHECKERBOARD, model, 20, seed)[:3] for seed in range(20)])
    assert np.sum(found[:, 2] < 0.02) >= 19, found
    assert np.sum((found[:, 0] < 1e-3) & (found[:, 1] < 1e-3)) >= 19, found


@pytest.mark.slow
def test_opencv_finds_camera_and_distortion_from_charuco_boards_in_19_of_20_seeds():
    """A search window of 4 px sees no marker beside a corner."""
    found = np.array([calibrated(CHARUCO, RADIAL, 20, seed, window=4) for seed in range(20)])
    assert found[:, 3].min() >= 15
    assert np.sum((found[:, :2].max(axis=1) < 1e-3) & (found[:, 2] < 0.02)) >= 19, found
