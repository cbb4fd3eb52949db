"""Wanted error of pixels that are read for frames and for events."""

import numpy as np
import pytest
from rendering import make_scene

import hesim_render as hr
from hesim_render.sources.render.change_driven.error_target import Noise
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux

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


@pytest.mark.parametrize("moves", [False, True])
def test_a_scene_in_which_something_moves_renders_frames_for_themselves(sensor, moves):
    card = {"name": "card", "shape": "rectangle", "size_m": [2, 2, 0], "reflectance": 0.5}
    track = [{"t_us": 0}, {"t_us": 1000, "translation_m": [0.1, 0, 0]}]
    scene = make_scene(
        objects=[card], light={"type": "uniform", "illuminance_lux": 100},
        camera={"origin_m": [0, 0, 2], "target_m": [0, 0, 0]},
        motion=[{"object": "card", "keyframes": track}] if moves else [],
    )  # fmt: skip
    source = ChangeDrivenFlux(scene, sensor)
    both, light = np.array([1], np.uint32), np.full(1, 300, np.float32)
    role = "any" if moves else "events"  # at this light events are the quieter ones
    np.testing.assert_array_equal(source._renderer.noise.of("any", both)(light), Noise(sensor).of(role, both)(light))
