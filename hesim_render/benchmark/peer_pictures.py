"""The light of a scene as pictures that other simulators take: numbered PNG files with their time stamps."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.capture.scene_renderer import scene_renderer
from hesim_render.core.units import US_PER_S
from hesim_render.mosaic.schedule import BLOCK_INTERVALS, Block
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.crosstalk import with_crosstalk
from hesim_render.sources.render.light_level import in_absolute_light
from hesim_render.sources.scene import Scene
from hesim_render.spectral.transfer import encode_exactly

TIMES_FILE, SETTINGS_FILE = "timestamps.txt", "settings.json"
#: The brightest half percent of the first picture becomes this part of full scale.
_PERCENTILE, _WHITE = 99.5, 0.95


def exposures_us(duration_us: int, fps: float, shutter: float) -> NDArray[np.float64]:
    """Begin and end of each picture's exposure, [picture, 2], µs; all lie within the run.

    Parameters
    ----------
    duration_us : of the run, µs.
    fps : pictures per second.
    shutter : share of a picture's period that it is exposed.
    """
    period = US_PER_S / fps
    begin = np.arange(int(np.floor(duration_us / period + 1e-9))) * period
    return np.column_stack([begin, begin + shutter * period])


def pictures(
    scene: Scene, sensor: Sensor, times_us: NDArray[np.float64], seed: int, quality: float
) -> Iterator[NDArray[np.float32]]:
    """Mean flux of the event pixels in each exposure, [y, x], e⁻/s.

    Parameters
    ----------
    scene, sensor, seed, quality : as of the run of the sensor itself, which sees the same light.
    times_us : begin and end of the exposures, [picture, 2], µs.
    """
    layout = sensor.layout
    flux = scene_renderer(in_absolute_light(scene)[0], sensor, seed, quality)
    source = with_crosstalk(flux, layout.shape, sensor.evs.crosstalk)
    for sample in source.flux_of_blocks(layout.evs_pixel.ravel(), _blocks(times_us)):
        mean = 0.5 * (np.array(sample.half_a, dtype=np.float32) + np.array(sample.half_b, dtype=np.float32))
        yield mean.reshape(layout.evs_shape)


def _blocks(times_us: NDArray[np.float64]) -> Iterator[Block]:
    """The exposures as windows of a source; a block begins with the last window of the block before."""
    yield Block(times_us[:1, 0], times_us[:1, 1], np.ones(1, np.bool_))
    for first in range(0, len(times_us) - 1, BLOCK_INTERVALS):
        part = times_us[first : first + BLOCK_INTERVALS + 1]
        wanted = np.ones(len(part), np.bool_)
        wanted[0] = False
        yield Block(part[:, 0], part[:, 1], wanted)


def encoded(picture: NDArray[np.float32], white: float, encoding: str, bits: int) -> NDArray[Any]:
    """Codes of a picture, uint8 or uint16, rounded.

    Parameters
    ----------
    picture : [y, x], e⁻/s.
    white : flux of full scale; brighter pixels are clipped.
    encoding : ``linear`` or ``srgb``.
    bits : 8 or 16.
    """
    values = np.clip(picture.astype(np.float64) / white, 0, 1)
    if encoding == "srgb":
        values = encode_exactly(values)
    return np.rint(values * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)


def write_pictures(
    folder: Path,
    given: Iterator[NDArray[np.float32]],
    times_us: NDArray[np.float64],
    kinds: Sequence[tuple[str, int]],
) -> dict[tuple[str, int], Path]:
    """Write pictures once for every kind of encoding, as they come.

    Each folder has ``000000.png``, … (grey) and ``timestamps.txt`` (the middle of each exposure, µs, one a line).

    Parameters
    ----------
    folder : holds a folder for each kind.
    given : [y, x] each, e⁻/s.
    times_us : begin and end of each exposure, [picture, 2], µs.
    kinds : encodings and numbers of bits.
    """
    from PIL import Image

    folders = {kind: folder / f"{kind[0]}{kind[1]}" for kind in dict.fromkeys(kinds)}
    for path in folders.values():
        path.mkdir(parents=True)
    white = 1.0
    for number, picture in enumerate(given):
        if number == 0:
            white = max(float(np.percentile(picture, _PERCENTILE)) / _WHITE, 1e-30)
        for kind, path in folders.items():
            Image.fromarray(encoded(picture, white, *kind)).save(path / f"{number:06d}.png")
    middles = "".join(f"{t:.3f}\n" for t in times_us.mean(axis=1))
    for path in folders.values():
        (path / TIMES_FILE).write_text(middles, encoding="utf-8")
    return folders


def write_settings(folder: Path, settings: dict[str, Any]) -> None:
    """Write ``settings.json`` beside pictures: the settings of the next program."""
    (folder / SETTINGS_FILE).write_text(json.dumps(settings, indent=1) + "\n", encoding="utf-8")
