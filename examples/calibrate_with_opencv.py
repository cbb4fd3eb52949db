"""Calibrate a simulated camera with OpenCV, as one would calibrate a real one, and compare with the truth.

A board is shown in twenty poses; each RAW frame, with all noise, is searched for its corners.

Run: python examples/calibrate_with_opencv.py [poses] [checkerboard|charuco]      (needs hesim_render[targets])
"""

import sys

import cv2
import numpy as np

import hesim_render as hr
from hesim_render.targets import target_points
from hesim_render.targets.boards import charuco_board

POSES = int(sys.argv[1]) if len(sys.argv) > 1 else 20
BOARD = sys.argv[2] if len(sys.argv) > 2 else "checkerboard"
# large bits, and room between markers and corners
KEYS = {"rows": 6, "cols": 9, "square_m": 0.04, "marker_m": 0.02, "dictionary": "DICT_4X4_50"}
CHANGES = {f"target.{key}": value for key, value in KEYS.items()} if BOARD == "charuco" else {}
sensor = hr.load_sensor("reference-mono").crop(512, 384)


def corners_of(board, grey):
    """Corners of the board in a picture (0 to 255, float32), and their points on the board, m; none if not found."""
    points, picture = target_points(board), grey.astype(np.uint8)
    if BOARD == "charuco":  # parts of the board are enough; each corner has a number
        corners, ids, _, _ = cv2.aruco.CharucoDetector(charuco_board(board)).detectBoard(picture)
        if ids is None or len(ids) < 8:
            return None
        points, grey = points[ids.ravel()], cv2.GaussianBlur(grey, (0, 0), 1.0)  # sharp pixels mislead cornerSubPix
    else:
        found, corners = cv2.findChessboardCorners(picture, (board.cols - 1, board.rows - 1), None)
        if not found:
            return None
    stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-5)
    corners = cv2.cornerSubPix(grey, corners, (4, 4), (-1, -1), stop)
    return corners.reshape(-1, 2).astype(np.float32), points


rng = np.random.default_rng(5)
objects, images, truth = [], [], None
for number in range(POSES):
    tilt = CHANGES | {
        "target.rotation_axis": [*rng.normal(size=2).round(3).tolist(), 0.2],
        "target.rotation_deg": float(rng.uniform(15, 40)),
        "target.position_m": [*rng.uniform(-0.04, 0.04, 2).round(3).tolist(), float(rng.uniform(-0.1, 0.1))],
        "camera.fit_margin": 0.6,
        "camera.focal_length_mm": 4,
        "objects.0.position_m": [0, 0, -0.4],  # the wall, out of the way of tilted boards
        "objects.0.reflectance": 0.5,
        "light.illuminance_lux": 300,
    }
    scene = hr.load_scene(BOARD, tilt)
    rec = hr.simulate(scene, sensor, duration_s=0.02, seed=number, quality=2)
    raw = rec.frames[0].raw.astype(np.float32)
    found = corners_of(scene.spec.target, np.clip(raw / np.percentile(raw, 99.5) * 255, 0, 255))
    if found is None:
        print(f"pose {number}: the board was not found")
        continue
    images.append(found[0])
    objects.append((found[1] * [1, -1, -1]).astype(np.float32))  # OpenCV's boards have y downwards
    truth = rec.truth.camera().k

flags = cv2.CALIB_FIX_K1 + cv2.CALIB_FIX_K2 + cv2.CALIB_FIX_K3 + cv2.CALIB_ZERO_TANGENT_DIST
rms_px, matrix, *_ = cv2.calibrateCamera(objects, images, (sensor.cols, sensor.rows), None, None, flags=flags)
print(f"{len(objects)} boards, reprojection error {rms_px:.3f} px rms")
print(f"{'':<4}{'OpenCV':>10}{'truth':>10}{'difference':>12}")
for name, at, whole in (
    ("fx", (0, 0), None),
    ("fy", (1, 1), None),
    ("cx", (0, 2), sensor.cols),
    ("cy", (1, 2), sensor.cols),
):
    difference = (matrix[at] - truth[at]) / (truth[at] if whole is None else whole)
    print(f"{name:<4}{matrix[at]:10.2f}{truth[at]:10.2f}{difference:12.3%}")
