"""Events over a picture, for display."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hesim_render.recording.colour_view import Picture

if TYPE_CHECKING:
    from hesim_render.recording.recorded import Recorded

ON_COLOUR = np.array([255, 150, 20], dtype=np.float32)
OFF_COLOUR = np.array([30, 160, 255], dtype=np.float32)


def events_picture(background: Picture, events: NDArray, event_shape: tuple[int, int]) -> Picture:
    """Events over a dimmed grey frame: ON orange, OFF blue, stronger for more events.

    Parameters
    ----------
    background : the frame, any size.
    events : structured array of the window to show.
    event_shape : rows and columns of the event grid.
    """
    size = background.shape[:2]
    grey = background.astype(np.float32) @ np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)
    canvas = np.repeat((18 + 0.3 * grey)[..., None], 3, axis=2)
    rows, cols = event_shape
    if rows == 0 or cols == 0:
        return canvas.astype(np.uint8)
    # an event grid finer than the picture is summed over the picture's pixels, so that no event is lost
    height, width = min(rows, size[0]), min(cols, size[1])
    cell = events["y"].astype(np.int64) * height // rows * width + events["x"].astype(np.int64) * width // cols
    on = np.bincount(cell[events["polarity"] > 0], minlength=height * width).reshape(height, width)
    off = np.bincount(cell[events["polarity"] < 0], minlength=height * width).reshape(height, width)
    total = on + off
    share = (on / np.maximum(total, 1)).astype(np.float32)[..., None]
    colour = share * ON_COLOUR + (1 - share) * OFF_COLOUR
    opacity = (1 - np.exp(-2.0 * total)).astype(np.float32)[..., None]
    y, x = np.arange(size[0]) * height // size[0], np.arange(size[1]) * width // size[1]
    opacity, colour = opacity[y][:, x], colour[y][:, x]
    return (canvas * (1 - opacity) + colour * opacity).astype(np.uint8)


def black_picture(recording: Recorded, widest_px: int = 1024) -> Picture:
    """A black picture of the shape of a recording, at most about so wide: a background where there are no frames."""
    roi = recording.manifest["roi"]
    shrink = max(1, -(-roi["width_px"] // widest_px))
    return np.zeros((max(2, roi["height_px"] // shrink), max(2, roi["width_px"] // shrink), 3), dtype=np.uint8)
