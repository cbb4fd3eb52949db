"""Boards for geometric calibration: squares, tags, discs and lamps."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError, did_you_mean, how_to_install
from hesim_render.specs.boards import (
    AprilGridTarget,
    CharucoTarget,
    CheckerboardTarget,
    CircleGridTarget,
    LedGridTarget,
)
from hesim_render.targets.piece import TargetPiece, around, box, cells, disc, patch_boxes, polygons_piece

#: Bits of a tag of the family 36h11 without its border, along a side.
_TAG_BITS = 6


def opencv_module() -> Any:
    """The module ``cv2``.

    Raises
    ------
    SpecError
        If OpenCV is not installed.
    """
    try:
        import cv2
    except ImportError:
        raise SpecError(
            f"this target is drawn by OpenCV, which is not installed: {how_to_install('targets')}", key="target"
        ) from None
    return cv2


def checkerboard(target: CheckerboardTarget) -> list[TargetPiece]:
    """Squares of two reflectances; the top-left one is light."""
    boxes = patch_boxes(target.rows, target.cols, target.width_m, target.height_m, 1.0)
    is_light = np.add.outer(np.arange(target.rows), np.arange(target.cols)).ravel() % 2 == 0
    pieces = [polygons_piece("light", target.light.load(), [box(*b) for b in boxes[is_light]])]
    if not is_light.all():
        pieces.append(polygons_piece("dark", target.dark.load(), [box(*b) for b in boxes[~is_light]]))
    return pieces


def charuco(target: CharucoTarget) -> list[TargetPiece]:
    """A ChArUco board: OpenCV says where markers are and what is in them.

    Raises
    ------
    SpecError
        If OpenCV is not installed, has no such dictionary, or the dictionary has too few markers.
    """
    aruco = opencv_module().aruco
    dictionary = _dictionary(aruco, target.dictionary)
    board = charuco_board(target)
    bits = dictionary.markerSize + 2
    # the same limits in all squares: of the square, of the marker and of each of its bits
    margin = (target.square_m - target.marker_m) / 2
    inner = margin + np.arange(bits + 1) * target.marker_m / bits
    one = np.concatenate([[0.0], inner])
    x = np.concatenate([*(k * target.square_m + one for k in range(target.cols)), [target.cols * target.square_m]])
    y = np.concatenate([*(k * target.square_m + one for k in range(target.rows)), [target.rows * target.square_m]])
    per = bits + 2
    dark = np.repeat(np.repeat(np.ones((target.rows, target.cols), dtype=bool), per, axis=0), per, axis=1)
    for number, corners in zip(board.getIds().ravel(), board.getObjPoints(), strict=True):
        col, row = (int(np.floor(c / target.square_m)) for c in np.mean(corners, axis=0)[:2])
        square = dark[row * per : (row + 1) * per, col * per : (col + 1) * per]
        square[:] = False
        square[1 : 1 + bits, 1 : 1 + bits] = aruco.generateImageMarker(dictionary, int(number), bits) < 128
    return _board(target, dark, x, y)


def charuco_board(target: CharucoTarget) -> Any:
    """OpenCV's own description of the board, ``cv2.aruco.CharucoBoard``.

    Its origin is the top left corner of the pattern, with y downwards.

    Raises
    ------
    SpecError
        As `charuco`.
    """
    aruco = opencv_module().aruco
    dictionary = _dictionary(aruco, target.dictionary)
    needed = target.rows * target.cols // 2
    _require_ids(target.first_id + needed, len(dictionary.bytesList), target.dictionary)
    ids = np.arange(target.first_id, target.first_id + needed, dtype=np.int32)
    return aruco.CharucoBoard((target.cols, target.rows), target.square_m, target.marker_m, dictionary, ids)


def aprilgrid(target: AprilGridTarget) -> list[TargetPiece]:
    """A grid of AprilTags whose bits are those of OpenCV's dictionary of the family 36h11.

    Raises
    ------
    SpecError
        If OpenCV is not installed, or the family has too few tags.
    """
    aruco = opencv_module().aruco
    dictionary = aruco.getPredefinedDictionary(aruco.DICT_APRILTAG_36h11)
    _require_ids(target.first_id + target.rows * target.cols, len(dictionary.bytesList), "36h11")
    bits = _TAG_BITS + 2 * target.border_bits
    gap, pitch = target.spacing * target.tag_m, (1 + target.spacing) * target.tag_m
    one = np.concatenate([[0.0], gap + np.arange(bits) * target.tag_m / bits])
    x = np.concatenate([*(k * pitch + one for k in range(target.cols)), np.array([0.0, gap]) + target.cols * pitch])
    y = np.concatenate([*(k * pitch + one for k in range(target.rows)), np.array([0.0, gap]) + target.rows * pitch])
    per = bits + 1
    dark = np.zeros((target.rows * per + 1, target.cols * per + 1), dtype=bool)
    dark[::per, ::per] = True
    for row in range(target.rows):
        for col in range(target.cols):
            number = target.first_id + (target.rows - 1 - row) * target.cols + col
            drawn = aruco.generateImageMarker(dictionary, number, bits, borderBits=target.border_bits)
            # OpenCV's tags are upside down against those of AprilTag
            dark[row * per + 1 : (row + 1) * per, col * per + 1 : (col + 1) * per] = drawn[::-1, ::-1] < 128
    return _board(target, dark, x, y)


def _board(
    target: CharucoTarget | AprilGridTarget,
    dark: NDArray[np.bool_],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
) -> list[TargetPiece]:
    """A board from its cells; x and y from the top left corner of the pattern, m."""
    w, h = target.pattern_m
    light_boxes, dark_boxes = cells(dark, x - w / 2, h / 2 - y)
    light_boxes += _margin(w / 2, h / 2, target.margin_m)
    return [
        polygons_piece("light", target.light.load(), light_boxes),
        polygons_piece("dark", target.dark.load(), dark_boxes),
    ]


def _margin(half_width: float, half_height: float, margin: float) -> list[list[tuple[float, float]]]:
    """Boxes of a frame around a rectangle."""
    w, h, m = half_width, half_height, margin
    if m == 0:
        return []
    return [
        box(-w - m, w + m, -h - m, -h),
        box(-w - m, w + m, h, h + m),
        box(-w - m, -w, -h, h),
        box(w, w + m, -h, h),
    ]


def disc_centres(target: CircleGridTarget | LedGridTarget) -> NDArray[np.float64]:
    """Centres of discs or lamps, [rows · cols, 2], m, row by row from the top left."""
    row, col = (index.ravel().astype(float) for index in np.mgrid[: target.rows, : target.cols])
    w, h = target.pattern_m
    if isinstance(target, CircleGridTarget) and target.asymmetric:
        x = (2 * col + row % 2 + 1) * target.pitch_m - w / 2
    else:
        x = (col + 0.5) * target.pitch_m - w / 2
    return np.column_stack([x, h / 2 - (row + 0.5) * target.pitch_m])


def disc_grid(target: CircleGridTarget | LedGridTarget) -> list[TargetPiece]:
    """Dark discs on a light board, or lamps on a dark one."""
    centres, rim = disc_centres(target), disc(target.diameter_m / 2)
    asymmetric = isinstance(target, CircleGridTarget) and target.asymmetric
    half_x, half_y = target.pitch_m * (1.0 if asymmetric else 0.5), target.pitch_m / 2
    ring = [np.asarray(polygon) for polygon in around(rim, -half_x, half_x, -half_y, half_y)]
    w, h = target.pattern_m
    rest = _margin(w / 2, h / 2, target.margin_m)
    if asymmetric and target.rows > 1:  # the shift leaves half a cell free at one end of each row
        for row in range(target.rows):
            top = h / 2 - row * target.pitch_m
            x0 = w / 2 - target.pitch_m if row % 2 == 0 else -w / 2
            rest.append(box(x0, x0 + target.pitch_m, top - target.pitch_m, top))
    board = [*(polygon + centre for centre in centres for polygon in ring), *rest]
    discs = [rim + centre for centre in centres]
    if isinstance(target, LedGridTarget):
        radiance = target.radiance() if target.is_on else None
        lamps = polygons_piece("lamps", target.dark.load(), discs, radiance)
        return [polygons_piece("board", target.light.load(), board), lamps]
    return [
        polygons_piece("light", target.light.load(), board),
        polygons_piece("dark", target.dark.load(), discs),
    ]


def _dictionary(aruco: Any, name: str) -> Any:
    known = [key for key in dir(aruco) if key.startswith("DICT_")]
    if name not in known:
        raise SpecError(f"OpenCV has no dictionary {name!r}{did_you_mean(name, known)}", key="target.dictionary")
    return aruco.getPredefinedDictionary(getattr(aruco, name))


def _require_ids(needed: int, there: int, name: str) -> None:
    if needed > there:
        raise SpecError(f"{name} has {there} markers, and this board needs number {needed - 1}", key="target.first_id")
