"""Wanted error of pixels that are read for frames and for events."""

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.sources.render.change_driven.error_target import Noise

#: Rows and columns, a multiple of the tile.
ROWS, COLS = 6, 10


@pytest.fixture(scope="module")
def sensor():
    """Pixels A have frames, b events, and B both."""
    changes = {
        "geometry.rows": ROWS,
        "geometry.cols": COLS,
        "tile": "A B\nB A\nb A\n",
        "pixels": {
            "A": {"filter": "green", "roles": ["aps"]},
            "B": {"filter": "red", "roles": ["aps", "evs"]},
            "b": {"filter": "blue", "roles": ["evs"]},
        },
        "evs_grid": {"rows_per_tile": 3, "cols_per_tile": 1},
    }
    return hr.load_sensor("eiger", changes)


@pytest.mark.parametrize("flux", [300.0, 9e5])
def test_a_still_value_serves_frames_and_events(sensor, flux):
    """Where nothing moves a pixel is rendered once, for both roles: the error is that of the quieter one."""
    index = np.arange(ROWS * COLS, dtype=np.uint32)
    light = np.full(index.size, flux, np.float32)
    row, col = np.divmod(index, COLS)
    letter = np.array([list("AB"), list("BA"), list("bA")])[row % 3, col % 2]
    events, moving = (Noise(sensor).of(role, index)(light) for role in ("events", "any"))
    still = Noise(sensor, rests=True).of("any", index)(light)
    frame = moving[letter == "A"][0]
    np.testing.assert_array_equal(moving, np.where(letter == "b", events, frame))
    np.testing.assert_array_equal(still, np.where(letter == "B", np.minimum(frame, events), moving))
    # which of both is quieter depends on the light
    assert (events[letter == "B"] < frame).all() == (flux < 1e5)
