"""Captures of a simulated sensor: recordings of its event pixels and EMVA 1288 captures of its frame pixels."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from hesim_render.core.errors import RangeError
from hesim_render.report.simulated import Instrument
from hesim_render.report.simulated_frames import FrameInstrument
from hesim_render.sensor.sensor import Sensor, load_sensor


def simulate_captures(
    sensor: str | Path,
    events: Path,
    frames: Path,
    size: tuple[int, int],
    seed: int,
    progress: Callable[[str, float], None],
) -> tuple[Path | None, Path | None, str]:
    """Make all captures that a report reads.

    Parameters
    ----------
    sensor : name or file.
    events, frames : folders to make.
    size : rows and columns of the pixels of each kind.
    seed : of all noise.
    progress : called with what is being done, and the part that is done.

    Returns
    -------
    Folders of events and of frames, None for a kind of pixel that the sensor does not have; its name.

    Raises
    ------
    SpecError
        If there is no such sensor, or its file is wrong.
    RangeError
        If the region is no part of the sensor.
    """
    whole = load_sensor(sensor)
    has_events, has_frames = whole.spec.evs is not None, whole.spec.aps is not None
    if not (has_events or has_frames):
        raise RangeError("sensor", whole.name, "a sensor with frame or event pixels")
    made: list[Path | None] = [None, None]
    if has_events:
        grid = whole.spec.evs_grid
        assert grid is not None
        region = _region(whole, size, (grid.rows_per_tile, grid.cols_per_tile))
        events.mkdir()
        part = 0.9 if has_frames else 1.0
        made[0] = Instrument(region, events, seed, lambda what, done: progress(what, part * done)).record()
    if has_frames:
        frames.mkdir()
        begin = 0.9 if has_events else 0.0
        made[1] = FrameInstrument(
            _region(whole, size, (1, 1)), frames, seed, lambda what, done: progress(what, begin + (1 - begin) * done)
        ).record()
    return made[0], made[1], whole.name


def _region(sensor: Sensor, size: tuple[int, int], per_tile: tuple[int, int]) -> Sensor:
    """The part of a sensor with `size` pixels of a kind of which a tile has `per_tile`, or all where it has fewer."""
    tiles = sensor.layout.tile_shape
    sides = [
        min(-(-side // each) * tile, whole // tile * tile)
        for side, each, tile, whole in zip(size, per_tile, tiles, sensor.layout.shape, strict=True)
    ]
    return sensor.crop(sides[1], sides[0])
