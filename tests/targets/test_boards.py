"""Boards, rendered, as OpenCV and a detector of another hand see them."""

import cv2
import numpy as np
import pytest
from boards import (
    CHARUCO,
    CHECKERBOARD,
    board_scene,
    calibrated,
    found_corners,
    picture_of,
    projected,
)

import hesim_render as hr
from hesim_render.core.errors import SpecError
from hesim_render.targets import target_points
from hesim_render.targets.boards import charuco_board
from hesim_render.targets.build import build_target

NO_DISTORTION = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
TILTED = {"rotation_axis": [1, 0.5, 0.2], "rotation_deg": 25.0, "position_m": [0.02, -0.01, 0.4]}


@pytest.mark.parametrize("board", [CHECKERBOARD, CHARUCO], ids=["checkerboard", "charuco"])
def test_opencv_finds_every_corner_where_it_is(board):
    placed = {**board, **TILTED}
    image = picture_of(placed, 384, 288, 64)
    points, corners = found_corners(placed, image)
    assert len(points) == (board["rows"] - 1) * (board["cols"] - 1)
    expected = projected(points * [1, -1, -1], placed, 384, 288)
    # OpenCV may begin at the other end of a checkerboard, which looks the same turned by 180°
    off = min((order - expected for order in (corners, corners[::-1])), key=lambda off: np.abs(off).max())
    # OpenCV's corners scatter by the noise of 64 rays per pixel; their mean is that of the board
    assert np.sqrt(np.mean(off**2)) < 0.08 and np.abs(off.mean(axis=0)).max() < 0.03


@pytest.mark.slow  # its corners are checked by the test before
def test_opencv_calibrates_the_camera_from_checkerboards():
    focal, middle, count = calibrated(CHECKERBOARD, 12, 0, 384, 288, 64, 6, NO_DISTORTION)
    assert count == 12
    assert np.abs(focal).max() < 1e-3 and np.abs(middle).max() < 1e-3


@pytest.mark.slow
def test_opencv_calibrates_the_camera_in_19_of_20_seeds():
    good = 0
    for seed in range(20):
        focal, middle, count = calibrated(CHECKERBOARD, 20, seed, 512, 384, 64, 5, NO_DISTORTION)
        good += count >= 15 and np.abs(focal).max() < 1e-3 and np.abs(middle).max() < 1e-3
    assert good >= 19


@pytest.mark.slow
def test_opencv_calibrates_the_camera_from_charuco_boards():
    for seed in range(3):
        focal, middle, count = calibrated(CHARUCO, 20, seed, 512, 384, 64, 4, NO_DISTORTION)
        assert count == 20 and np.abs(focal).max() < 1e-3 and np.abs(middle).max() < 1e-3


@pytest.mark.parametrize("first_id", [0, 40])
def test_an_aprilgrid_is_read_by_a_detector_of_another_hand(first_id):
    from pupil_apriltags import Detector

    grid = {"type": "aprilgrid", "rows": 4, "cols": 5, "tag_m": 0.04, "spacing": 0.3, "first_id": first_id,
            **TILTED, "rotation_deg": 15.0, "position_m": [0.02, -0.01, 0.55]}  # fmt: skip
    image = picture_of(grid, 512, 384, 32)
    found = {tag.tag_id: tag for tag in Detector(families="tag36h11").detect(image.astype(np.uint8))}
    # the dark squares touch the tags at their corners, which can hide a tag from this detector
    assert len(found) >= 18 and set(found) <= set(range(first_id, first_id + 20))
    # its corners are in the same order, from the bottom left one counter-clockwise, and pixel centres at halves
    points = target_points(board_scene(grid).spec.target).reshape(20, 4, 3)
    for number, tag in found.items():
        assert tag.hamming == 0
        off = tag.corners - 0.5 - projected(points[number - first_id], grid, 512, 384)
        assert np.abs(off).max() < 0.5, (number, off)


def test_opencv_finds_the_centres_of_circles_and_dots():
    grids = [
        ({"type": "circle-grid", "rows": 5, "cols": 7, "pitch_m": 0.04, "diameter_m": 0.024},
         cv2.CALIB_CB_SYMMETRIC_GRID),
        ({"type": "circle-grid", "rows": 9, "cols": 4, "pitch_m": 0.025, "diameter_m": 0.018, "asymmetric": True},
         cv2.CALIB_CB_ASYMMETRIC_GRID),
        ({"type": "dot-grid", "rows": 7, "cols": 9, "pitch_m": 0.03, "diameter_m": 0.014}, cv2.CALIB_CB_SYMMETRIC_GRID),
    ]  # fmt: skip
    for grid, kind in grids:
        placed = {**grid, "rotation_axis": [1, 0.5, 0], "rotation_deg": 4.0, "position_m": [0, 0, 0.4]}
        image = picture_of(placed, 384, 288, 32).astype(np.uint8)
        ok, centres = cv2.findCirclesGrid(image, (grid["cols"], grid["rows"]), flags=kind)
        assert ok, grid
        expected = projected(target_points(board_scene(grid).spec.target), placed, 384, 288)
        found = centres.reshape(-1, 2)
        # OpenCV may begin at the other end of the board
        off = min(np.abs(order - expected).max() for order in (found, found[::-1]))
        assert off < 0.3, (grid, off)


@pytest.mark.slow
def test_lamps_that_blink_are_found_in_the_events():
    """Centres of the events of each lamp against the projected ones; without noise and with it."""
    target = {"type": "led-grid", "rows": 4, "cols": 6, "pitch_m": 0.05, "diameter_m": 0.03, "luminance_cd_m2": 300,
              "waveform": {"type": "pwm", "frequency_hz": 100, "duty": 0.5, "phase_deg": 90},
              "rotation_axis": [1, 0.6, 0], "rotation_deg": 15.0, "position_m": [0, 0, 0.4]}  # fmt: skip
    scene = board_scene(target)
    sensor = hr.load_sensor("davis346").crop(128, 96)
    events = hr.simulate(scene, sensor, duration_s=0.02, seed=3, quality=2).events
    counts = np.zeros((96, 128))
    np.add.at(counts, (events["y"], events["x"]), 1)
    grey = np.clip(counts / np.percentile(counts, 98) * 255, 0, 255).astype(np.uint8)
    big = cv2.resize(255 - grey, None, fx=4, fy=4, interpolation=cv2.INTER_LINEAR)
    ok, centres = cv2.findCirclesGrid(big, (6, 4), flags=cv2.CALIB_CB_SYMMETRIC_GRID)
    assert ok
    found = (centres.reshape(-1, 2) + 0.5) / 4 - 0.5
    expected = projected(target_points(scene.spec.target), target, 128, 96)
    off = min((order - expected for order in (found, found[::-1])), key=lambda off: np.abs(off).max())
    assert np.abs(off).max() < 0.35 and np.sqrt(np.mean(off**2)) < 0.15


def test_points_are_those_of_the_drawn_boards():
    board = board_scene(CHARUCO).spec.target
    dark = np.concatenate([p.vertices_m for p in build_target(board) if p.name == "dark"])
    # each inner corner of the chessboard is a corner of a dark polygon
    for point in target_points(board):
        assert np.linalg.norm(dark - point, axis=1).min() < 1e-12
    of_opencv = np.array(charuco_board(board).getChessboardCorners(), dtype=float)
    w, h = board.pattern_m
    expected = of_opencv * [1, -1, 1] + [-w / 2, h / 2, 0]
    np.testing.assert_allclose(target_points(board), expected, atol=1e-7)  # OpenCV has float32
    grid = board_scene({"type": "aprilgrid", "rows": 2, "cols": 3, "tag_m": 0.05, "spacing": 0.2}).spec.target
    corners = target_points(grid).reshape(6, 4, 3)
    # the middle tag of the upper row is centred, 1.2 tags right of the first one; counter-clockwise from the lower left
    for number, (x, y) in {0: (-0.085, -0.055), 4: (-0.025, 0.005)}.items():
        expected = [[x, y, 0], [x + 0.05, y, 0], [x + 0.05, y + 0.05, 0], [x, y + 0.05, 0]]
        np.testing.assert_allclose(corners[number], expected, atol=1e-12)
    with pytest.raises(SpecError, match="a target of type 'flat' has no calibration points"):
        target_points(hr.load_scene("flat-field").spec.target)


def test_boards_that_cannot_be_drawn_are_refused(monkeypatch):
    for wrong, told in (
        ({"dictionary": "DICT_5X5_999"}, "OpenCV has no dictionary 'DICT_5X5_999' (did you mean 'DICT_5X5_"),
        ({"first_id": 40}, "DICT_4X4_50 has 50 markers, and this board needs number 66"),
    ):
        with pytest.raises(SpecError) as caught:
            build_target(board_scene({**CHARUCO, **wrong}).spec.target)
        assert told in str(caught.value)
    # 587 tags of the family: a grid of 2 × 3 ends with its last one, or one beyond; so does a board of 17 markers
    grid = {"type": "aprilgrid", "rows": 2, "cols": 3, "tag_m": 0.05}
    for board, last in ((grid, 581), ({"type": "charuco", "rows": 5, "cols": 7, "dictionary": "DICT_4X4_50"}, 33)):
        build_target(board_scene({**board, "first_id": last}).spec.target)
        with pytest.raises(SpecError, match=r"has \d+ markers, and this board needs number \d+"):
            build_target(board_scene({**board, "first_id": last + 1}).spec.target)
    import sys

    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(SpecError, match=r"pip install 'opencv-python-headless[<>]"):
        build_target(board_scene(CHARUCO).spec.target)
