"""Test patterns as a pixel grid sees them: slanted edge, star and zone plate, each pixel the mean over its area."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

#: Side of a pattern, px; a multiple of the tiles of 2, 3, 4 and 6 pixels.
SIDE_PX = 192
#: Rows and columns of all patterns side by side.
CHART_PX = SIDE_PX, 3 * SIDE_PX
#: Angle of the edge from the vertical, degrees; spokes of the star; highest frequency of the zone plate, cycles per px.
EDGE_DEG, SPOKES, ZONE_TOP = 5.0, 36, 0.5
#: Points across a pixel.
_FINE = 8


def _sampled(value: Callable[[NDArray, NDArray], NDArray]) -> NDArray[np.float64]:
    """Mean over the area of each pixel of a function of the place from the centre, px."""
    fine = (np.arange(SIDE_PX * _FINE) + 0.5) / _FINE - SIDE_PX / 2
    found = np.empty((SIDE_PX, SIDE_PX))
    for row in range(SIDE_PX):
        y = fine[row * _FINE : (row + 1) * _FINE, None]
        part = value(fine[None, :], y)
        found[row] = part.reshape(_FINE, SIDE_PX, _FINE).mean(axis=(0, 2))
    return found


def slanted_edge() -> NDArray[np.float64]:
    """0 on the left of an edge through the centre, 1 on the right, [row, col]."""
    slope = np.tan(np.radians(EDGE_DEG))
    return _sampled(lambda x, y: (x + slope * y > 0).astype(float))


def star() -> NDArray[np.float64]:
    """A star of sectors, 0 and 1 in turn, [row, col]."""
    return _sampled(lambda x, y: (np.sin(SPOKES * np.arctan2(y, x)) > 0).astype(float))


def zone_plate() -> NDArray[np.float64]:
    """½ (1 + cos) of a phase whose frequency rises with the distance, to `ZONE_TOP` at the sides, [row, col]."""
    rate = np.pi * ZONE_TOP / (SIDE_PX / 2)
    return _sampled(lambda x, y: 0.5 * (1 + np.cos(rate * (x**2 + y**2))))


def chart() -> NDArray[np.float64]:
    """Edge, star and zone plate side by side, [row, col]."""
    return np.concatenate([slanted_edge(), star(), zone_plate()], axis=1)


def distance_px() -> NDArray[np.float64]:
    """Distance of each pixel of a pattern from its centre, [row, col]."""
    place = np.arange(SIDE_PX) + 0.5 - SIDE_PX / 2
    return np.hypot(place[:, None], place[None, :])
