"""Calibrate the camera of an event sensor from a board of blinking lamps, with all noise, and compare with the truth.

The board is shown in some poses. The events of a pixel at a rise and a fall of the light say by how much the logarithm
of its light has changed, in steps of the threshold; its exponential less 1 is the part of the pixel that a lamp covers,
so that the centre of mass of these parts is the centre of a lamp.

Run: python examples/calibrate_from_events.py [poses]      (needs hesim_render[targets])
"""

import sys

import cv2
import numpy as np

import hesim_render as hr
from hesim_render.targets import target_points

#: Lamps: off for 10 ms, then on for 10 ms, and again, with about ten times the light of the board around them.
BOARD = {"type": "led-grid", "rows": 6, "cols": 9, "pitch_m": 0.04, "diameter_m": 0.02, "luminance_cd_m2": 100,
         "light": 0.1, "dark": 0.1,
         "waveform": {"type": "pwm", "frequency_hz": 50, "duty": 0.5, "phase_deg": 180}}  # fmt: skip
AMBIENT_LUX = 630
FOV_DEG = 55.0
LENS = {"model": "opencv", "k1": -0.25, "k2": 0.06}


def sensor_with_distortion(cols=346, rows=260):
    """The sensor that is calibrated."""
    return hr.load_sensor("davis346", {"lens.distortion": LENS}).crop(cols, rows)


def poses(count, seed):
    """Keys of the board, tilted by 20° to 45° about any axis near the image plane, all over the picture."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        around, away = rng.uniform(0, 2 * np.pi), rng.uniform(0.42, 0.58)
        x, y = rng.uniform(-0.1, 0.1, 2) * 2 * np.tan(np.radians(FOV_DEG / 2)) * away * np.array([1, 0.75])
        yield {"rotation_axis": [float(np.cos(around)), float(np.sin(around)), float(rng.uniform(-0.4, 0.4))],
               "rotation_deg": float(rng.uniform(20, 45)),
               "position_m": [float(x), float(y), float(1 - away)]}  # fmt: skip


def scene_with(place):
    """The board at a place before the camera."""
    changes = {f"target.{key}": value for key, value in {**BOARD, **place}.items()}
    camera = {"origin_m": [0, 0, 1], "target_m": [0, 0, 0], "horizontal_fov_deg": FOV_DEG}
    light = {"type": "uniform", "illuminant": "D65", "illuminance_lux": AMBIENT_LUX}
    return hr.load_scene("led-grid", {**changes, "camera": camera, "light": light, "objects": []})


def contrast_of(events, evs, shape, changes):
    """ln of the lamps' light over that without them, of each pixel, from the events at a number of rises and falls."""
    on, off = (np.zeros(shape) for _ in range(2))
    for counts, polarity in ((on, 1), (off, -1)):
        own = events[events["polarity"] == polarity]
        np.add.at(counts, (own["y"], own["x"]), 1)
    return (on * evs.contrast_threshold_on + off * evs.contrast_threshold_off) / changes


def lamp_centres(contrast):
    """Column and row of the lamps, [n, 2], row by row from one end of the board; None if not all are found."""
    lit = np.percentile(contrast, 97)
    even = cv2.GaussianBlur(contrast, (0, 0), 1.0)  # thresholds differ from pixel to pixel
    grey = np.clip(255 - 255 * even / lit, 0, 255).astype(np.uint8)
    for scale in (4, 3, 2):  # the detector of OpenCV wants blobs of some hundred to some thousand pixels
        large = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR)
        found, places = cv2.findCirclesGrid(large, (BOARD["cols"], BOARD["rows"]), flags=cv2.CALIB_CB_SYMMETRIC_GRID)
        if found:
            break
    else:
        return None
    places = (places.reshape(-1, 2) + 0.5) / scale - 0.5
    light = np.expm1(np.maximum(contrast, 0))
    light = np.minimum(light, np.median(light[contrast > 0.8 * lit]))  # the whole pixel is lit
    row, col = np.indices(contrast.shape)
    centres = []
    for place in places:
        for _ in range(3):
            reach = 0.5 * np.partition(np.linalg.norm(places - place, axis=1), 1)[1]  # half way to the next lamp
            weight = light * (np.hypot(col - place[0], row - place[1]) < reach)
            place = np.array([np.sum(weight * col), np.sum(weight * row)]) / np.sum(weight)
        centres.append(place)
    return np.array(centres)


def calibrated(views, size):
    """OpenCV's camera matrix and distortion from views of the board: `lamp_centres` of each."""
    board = scene_with({}).spec.target
    points = (target_points(board) * [1, -1, -1]).astype(np.float32)  # OpenCV's boards have y downwards
    images = [view.astype(np.float32) for view in views]
    flags = cv2.CALIB_FIX_K3 + cv2.CALIB_ZERO_TANGENT_DIST
    rms_px, matrix, distortion, *_ = cv2.calibrateCamera([points] * len(images), images, size, None, None, flags=flags)
    return rms_px, matrix, distortion


def main():
    sensor, views, truth = sensor_with_distortion(), [], None
    for number, place in enumerate(poses(int(sys.argv[1]) if len(sys.argv) > 1 else 20, 5)):
        rec = hr.simulate(scene_with(place), sensor, duration_s=0.035, seed=number, samples=16)
        centres = lamp_centres(contrast_of(rec.events, sensor.spec.evs, rec.event_shape, 3))
        print(f"pose {number}: {rec.events.size} events", "" if centres is not None else "- the lamps were not found")
        views += [] if centres is None else [centres]
        truth = rec.truth.camera("events")
    rms_px, matrix, distortion = calibrated(views, (sensor.cols, sensor.rows))
    print(f"{len(views)} boards, reprojection error {rms_px:.3f} px rms")
    print(f"{'':<4}{'OpenCV':>10}{'truth':>10}{'difference':>12}")
    for name, at, whole in (("fx", (0, 0), None), ("fy", (1, 1), None), ("cx", (0, 2), sensor.cols),
                            ("cy", (1, 2), sensor.cols)):  # fmt: skip
        difference = (matrix[at] - truth.k[at]) / (truth.k[at] if whole is None else whole)
        print(f"{name:<4}{matrix[at]:10.2f}{truth.k[at]:10.2f}{difference:12.3%}")
    print(f"k1, k2: {distortion.ravel()[:2].round(4).tolist()}; truth {list(truth.distortion[:2])}")


if __name__ == "__main__":
    main()
