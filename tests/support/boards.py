"""Pictures of boards in many poses, and what OpenCV finds in them."""

import cv2
import numpy as np
from rendering import flux_image, make_scene, mono

from hesim_render.targets import target_points
from hesim_render.targets.boards import charuco_board

FOV_DEG = 45.0
LIGHT = {"type": "uniform", "illuminance_lux": 1000}
CHECKERBOARD = {"type": "checkerboard", "rows": 6, "cols": 9, "width_m": 0.36, "height_m": 0.24}
#: As many corners as the checkerboard. Markers of half a square leave room around the corners, and bits of a small
#: dictionary are large.
CHARUCO = {"type": "charuco", "rows": 6, "cols": 9, "square_m": 0.04, "marker_m": 0.02, "dictionary": "DICT_4X4_50"}
#: Standard deviation of the Gaussian that smooths a picture before OpenCV refines the corners of ChArUco boards, px.
#: Sharp pixels mislead `cornerSubPix`: in a search window of 9x9 px, corners scatter by 0.05 px without it and by 0.03
#: px with it. Board, smoothing and window were chosen on seeds 100 to 109, the tests judge others.
SMOOTHING_PX = 1.0


def board_scene(target):
    """The board before a camera at z = 1 m that sees `FOV_DEG` across."""
    return make_scene(target=target, light=LIGHT, camera={"origin_m": [0, 0, 1], "horizontal_fov_deg": FOV_DEG})


def focal_px(cols):
    return cols / 2 / np.tan(np.radians(FOV_DEG / 2))


def poses(target, count, seed, cols, rows, fill=0.75):
    """The target tilted by 15° to 40° about any axis, at 1 to 1.5 times the distance at which it fills the picture."""
    generator = np.random.default_rng(seed)
    spec = board_scene(target).spec.target
    half = np.tan(np.radians(FOV_DEG / 2))
    for _ in range(count):
        around = generator.uniform(0, 2 * np.pi)
        tilt = generator.uniform(15, 40)
        axis = [np.cos(around), np.sin(around), generator.uniform(-0.4, 0.4)]
        near = max(spec.width_m / (2 * half), spec.height_m / (2 * half) * cols / rows) / fill
        away = near * generator.uniform(1, 1.5)
        x, y = generator.uniform(-0.2, 0.2, 2) * 2 * half * away * np.array([1, rows / cols])
        place = {
            "rotation_axis": axis,
            "rotation_deg": float(tilt),
            "position_m": [float(x), float(y), float(1 - away)],
        }
        yield {**target, **place}


def picture_of(target, cols, rows, samples, seed=0):
    """Noise-free mono flux, float32, largest 255."""
    a, b, _ = flux_image(board_scene(target), mono(cols, rows), samples, seed=seed)
    image = a + b
    return (image / image.max() * 255).astype(np.float32)


def projected(points, target, cols, rows):
    """Column and row of board points, 0 at the centre of the first pixel: a pinhole, written out."""
    axis, angle = np.array(target["rotation_axis"]), np.radians(target["rotation_deg"])
    k = axis / np.linalg.norm(axis)
    turned = (
        points * np.cos(angle)
        + np.cross(k, points) * np.sin(angle)
        + np.outer(points @ k, k) * (1 - np.cos(angle))
    )  # fmt: skip
    x, y, z = (turned + target["position_m"]).T
    depth = 1 - z
    f = focal_px(cols)
    return np.column_stack([(cols - 1) / 2 + f * x / depth, (rows - 1) / 2 - f * y / depth])


def found_corners(target, image, window=4):
    """Object points (OpenCV's axes, m) and image points of a board; None where it is not found."""
    spec, grey = board_scene(target).spec.target, image.astype(np.uint8)
    points = target_points(spec)
    if target["type"] == "checkerboard":
        ok, corners = cv2.findChessboardCorners(grey, (target["cols"] - 1, target["rows"] - 1), None)
        if not ok:
            return None
    else:
        corners, ids, _, _ = cv2.aruco.CharucoDetector(charuco_board(spec)).detectBoard(grey)
        if ids is None or len(ids) < 8:
            return None
        points = points[ids.ravel()]
        image = cv2.GaussianBlur(image, (0, 0), SMOOTHING_PX)
    stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-5)
    corners = cv2.cornerSubPix(image, corners, (window, window), (-1, -1), stop)
    return (points * [1, -1, -1]).astype(np.float32), corners.reshape(-1, 2).astype(np.float32)


def calibrated(target, count, seed, cols, rows, samples, window, flags=0):
    """OpenCV's camera from many poses: relative errors of fx and fy, errors of cx and cy over the width, boards."""
    views = []
    for number, placed in enumerate(poses(target, count, seed, cols, rows)):
        views.append(found_corners(placed, picture_of(placed, cols, rows, samples, 100 * seed + number), window))
    views = [view for view in views if view is not None]
    objects, images = zip(*views, strict=True)
    _, matrix, _, _, _ = cv2.calibrateCamera(objects, images, (cols, rows), None, None, flags=flags)
    focal = np.array([matrix[0, 0], matrix[1, 1]]) / focal_px(cols) - 1
    middle = (np.array([matrix[0, 2], matrix[1, 2]]) - [(cols - 1) / 2, (rows - 1) / 2]) / cols
    return focal, middle, len(views)
