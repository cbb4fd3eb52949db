"""Calibrate a simulated camera with OpenCV, as one would calibrate a real one, and compare with the truth.

A checkerboard is shown in twenty poses; each RAW frame, with all noise, is searched for its corners.

Run: python examples/calibrate_with_opencv.py [poses]      (needs hesim_render[targets])
"""

import sys

import cv2
import numpy as np

import hesim_render as hr
from hesim_render.targets import target_points

POSES = int(sys.argv[1]) if len(sys.argv) > 1 else 20
sensor = hr.load_sensor("reference-mono").crop(512, 384)
rng = np.random.default_rng(5)
objects, images, truth = [], [], None
for number in range(POSES):
    tilt = {
        "target.rotation_axis": [*rng.normal(size=2).round(3).tolist(), 0.2],
        "target.rotation_deg": float(rng.uniform(15, 40)),
        "target.position_m": [*rng.uniform(-0.04, 0.04, 2).round(3).tolist(), float(rng.uniform(-0.1, 0.1))],
        "camera.fit_margin": 0.6,
        "camera.focal_length_mm": 4,
        "objects.0.position_m": [0, 0, -0.4],  # the wall, out of the way of tilted boards
        "objects.0.reflectance": 0.5,
        "light.illuminance_lux": 300,
    }
    scene = hr.load_scene("checkerboard", tilt)
    rec = hr.simulate(scene, sensor, duration_s=0.02, seed=number, quality=2)
    board, raw = scene.spec.target, rec.frames[0].raw.astype(np.float32)
    grey = np.clip(raw / np.percentile(raw, 99.5) * 255, 0, 255)
    found, corners = cv2.findChessboardCorners(grey.astype(np.uint8), (board.cols - 1, board.rows - 1), None)
    if not found:
        print(f"pose {number}: the board was not found")
        continue
    stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-5)
    corners = cv2.cornerSubPix(grey, corners, (4, 4), (-1, -1), stop)
    # OpenCV's boards have y downwards
    objects.append((target_points(board) * [1, -1, -1]).astype(np.float32))
    images.append(corners.reshape(-1, 2).astype(np.float32))
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
