"""Full-colour truth of a clip: the light of every pixel through every filter of the frame pixels, rendered.

A sensor reads one filter at each pixel, and none at a pixel for events alone. The truth is no interpolation: the scene
is rendered once for each filter, by the same sensor with that filter on all pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.benchmark.sharp import windows
from hesim_render.capture.scene_renderer import scene_renderer
from hesim_render.core.hdf5 import COMPRESSION, new_file, read_dataset
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.render.light_level import in_absolute_light
from hesim_render.sources.scene import Scene
from hesim_render.specs.benchmark import SharpSpec
from hesim_render.specs.sensor import PixelSpec

COLOURS_FILE = "colours.h5"


def frame_filters(sensor: Sensor) -> list[str]:
    """Names of the filters of the frame pixels, in the order of the tile."""
    spec = sensor.spec
    letters = [letter for row in spec.tile_rows for letter in row if "aps" in spec.pixels[letter].roles]
    return list(dict.fromkeys(spec.pixels[letter].filter for letter in letters))


def through_one_filter(sensor: Sensor, name: str) -> Sensor:
    """The same sensor, region and lens, in which every pixel reads frames through one filter."""
    spec, layout = sensor.spec, sensor.layout
    rows = ["".join("F" for _ in row) for row in spec.tile_rows]
    pixel = PixelSpec.model_validate({"filter": name, "roles": ["aps"]})
    changes = {"tile": "\n".join(rows), "pixels": {"F": pixel}, "evs": None, "evs_grid": None}
    same = replace(layout, spec=spec.model_copy(update=changes))
    return replace(sensor, layout=same)


def write_colours(
    path: Path, scene: Scene, sensor: Sensor, spec: SharpSpec, duration_us: int, seed: int, quality: float
) -> int:
    """Write the full-colour truth of a clip.

    Parameters
    ----------
    path : the HDF5 file: ``time_us`` [time], ``channel`` [channel] (names of filters), ``flux_e_per_s`` and
        ``stderr_e_per_s`` [time, row, col, channel]. Crosstalk between pixels is not in it.
    scene, sensor : of the clip.
    spec : times and windows, those of the sharp images.
    duration_us, seed, quality : of the clip. Each filter has random numbers of its own.

    Returns
    -------
    The number of images.
    """
    names, times = frame_filters(sensor), list(windows(sensor, spec, duration_us))
    every = np.arange(sensor.rows * sensor.cols, dtype=np.uint32)
    shape = (len(times), sensor.rows, sensor.cols, len(names))
    with new_file(path) as file:
        file.attrs.update({"flux": "e-/s through each filter, mean over the window", "window_us": spec.window_us})
        file["time_us"] = np.array([middle for middle, _ in times])
        file["channel"] = names
        for name in ("flux_e_per_s", "stderr_e_per_s"):
            file.create_dataset(name, shape, "f4", chunks=(1, *shape[1:3], 1), compression=COMPRESSION)
        for channel, seen_by in enumerate(names):
            lit, one = in_absolute_light(scene)[0], through_one_filter(sensor, seen_by)
            source = scene_renderer(lit, one, seed + 1 + channel, quality)
            for number, (_, begin) in enumerate(times):
                first = begin[every // sensor.cols]
                a, b = (np.array(half) for half in source.mean_flux(every, first, first + spec.window_us))
                for name, values in (("flux_e_per_s", 0.5 * (a + b)), ("stderr_e_per_s", 0.5 * np.abs(a - b))):
                    file[name][number, ..., channel] = values.reshape(shape[1:3])
                    file[name].flush()
    return len(times)


@dataclass(frozen=True)
class ColourTruth:
    """Full-colour truth of a clip on disk; each image is read when it is asked for.

    Parameters
    ----------
    path : the file that `write_colours` wrote.
    """

    path: Path

    def _read(self, name: str, number: int | None = None) -> NDArray:
        return read_dataset(self.path, "as full-colour images", name, number, kinds="fuiSO")

    @property
    def time_us(self) -> NDArray[np.float64]:
        """Middles of row 0's windows, [time], µs."""
        return self._read("time_us")

    @property
    def channels(self) -> list[str]:
        """Names of the filters."""
        return [name.decode() if isinstance(name, bytes) else str(name) for name in self._read("channel")]

    def flux_e_per_s(self, number: int) -> NDArray[np.float32]:
        """Flux of one time through every filter, [row, col, channel], e⁻/s."""
        return self._read("flux_e_per_s", number)

    def stderr_e_per_s(self, number: int) -> NDArray[np.float32]:
        """Its standard error, [row, col, channel], e⁻/s."""
        return self._read("stderr_e_per_s", number)
