"""Share of a pixel, or of a pixel in a window, on one side of a straight line."""

import numpy as np
from numpy.typing import NDArray

#: Lines that move by less, px per window, count as resting ones, which moves the share by less than that.
LEAST_SPEED = 1e-4
#: Narrowest boxes of a resting and of a moving line, px.
_NARROW, _NARROW_MOVING = 1e-6, 1e-5


def halfplane_share(
    normal_x: NDArray[np.floating], normal_y: NDArray[np.floating], offset: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Share of the square [-½, ½]² in which normal · place + offset > 0, for unit normals.

    The square is the convolution of two boxes of widths |n_x| and |n_y| along the normal, so the share is the second
    integral of four steps. A narrow box counts as one of 1e-6 px, which moves the share by less than that.
    """
    wide, narrow = (np.maximum(np.abs(side.astype(np.float64)), _NARROW) for side in (normal_x, normal_y))
    far, near = (wide + narrow) / 2, (wide - narrow) / 2
    ramps = [np.square(np.maximum(offset + at, 0)) / 2 for at in (far, near, -near, -far)]
    return np.clip((ramps[0] - ramps[1] - ramps[2] + ramps[3]) / (wide * narrow), 0, 1)


def moving_share(
    normal_x: NDArray[np.floating],
    normal_y: NDArray[np.floating],
    offset: NDArray[np.floating],
    speed: NDArray[np.floating],
) -> NDArray[np.float64]:
    """Share of the cube [-½, ½]³ of places and times in which normal · place + offset + speed · time > 0.

    As for a line that rests, with a third box of width |speed|: the third integral of eight steps.

    Parameters
    ----------
    normal_x, normal_y, offset : unit normals, and offsets in the middle of the window, px.
    speed : px per window.
    """
    share = halfplane_share(normal_x, normal_y, offset)
    moves = np.flatnonzero(np.abs(speed) > LEAST_SPEED)
    if moves.size == 0:
        return share
    of = (values[moves].astype(np.float64) for values in (normal_x, normal_y, speed))
    wide, narrow, path = (np.maximum(np.abs(side), _NARROW_MOVING) for side in of)
    total, middle = np.zeros(moves.size), offset[moves].astype(np.float64)
    for number in range(8):
        # each box begins with a step up and ends with a step down
        signs = [1 - 2 * (number >> bit & 1) for bit in range(3)]
        at = middle + 0.5 * (signs[0] * wide + signs[1] * narrow + signs[2] * path)
        total += np.prod(signs) * np.maximum(at, 0) ** 3 / 6
    share[moves] = np.clip(total / (wide * narrow * path), 0, 1)
    return share
