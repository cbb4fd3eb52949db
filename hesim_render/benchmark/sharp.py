"""Sharp images of a clip: noise-free flux of the frame pixels in short windows, and the RAW of a still scene of it.

Full-colour truth of a clip: the light of every pixel through every filter of the frame pixels, rendered.

A sensor reads one filter at each pixel, and none at a pixel for events alone. The truth is no interpolation: the scene
is rendered once for each filter, by the same sensor with that filter on all pixels.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.capture.run_settings import noise_models
from hesim_render.capture.scene_renderer import scene_renderer
from hesim_render.core.backend import jit
from hesim_render.core.hdf5 import COMPRESSION, new_file, read_dataset
from hesim_render.core.host_arrays import from_host
from hesim_render.core.units import S_PER_US
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.protocol import FluxSource
from hesim_render.sources.render.light_level import in_absolute_light
from hesim_render.sources.scene import Scene
from hesim_render.specs.benchmark import SharpSpec
from hesim_render.specs.sensor import PixelSpec

SHARP_FILE = "sharp.h5"


def _row_offset_us(sensor: Sensor, spec: SharpSpec) -> NDArray[np.float64]:
    aps = sensor.spec.aps
    assert aps is not None
    rolling = spec.shutter == "sensor" and aps.shutter == "rolling"
    return np.arange(sensor.rows, dtype=np.float64) * (aps.line_time_us if rolling else 0.0)


def windows(sensor: Sensor, spec: SharpSpec, duration_us: int) -> Iterator[tuple[float, NDArray[np.float64]]]:
    """Middle of row 0's window and begin of each row's window, [row], of every sharp image, µs."""
    offset = _row_offset_us(sensor, spec)
    for middle in spec.middles_us(duration_us, float(offset[-1])):
        yield middle, middle - spec.window_us / 2 + offset


def sharp_flux(
    source: FluxSource, sensor: Sensor, spec: SharpSpec, begin_us: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Both halves of the flux of a sharp image, [frame pixel], e⁻/s.

    Parameters
    ----------
    source, sensor, spec : see `write_sharp`.
    begin_us : begin of each row's window, [row], from `windows`.
    """
    pixel = sensor.layout.aps_pixel
    first = begin_us[pixel // sensor.cols]
    half_a, half_b = source.mean_flux(pixel, first, first + spec.window_us)
    return np.array(half_a, dtype=np.float32), np.array(half_b, dtype=np.float32)


def write_sharp(
    path: Path, source: FluxSource, sensor: Sensor, spec: SharpSpec, duration_us: int, seed: int, quality: float
) -> int:
    """Write the sharp images of a clip; returns their number.

    Parameters
    ----------
    path : the HDF5 file: ``time_us`` [time] (middle of row 0's window), ``row_offset_us`` [row], ``flux_e_per_s`` and
        ``stderr_e_per_s`` [time, row, col] (NaN where there is no frame value), and ``raw_dn`` [time, row, col], what
        the sensor without noise would read of a still scene of that flux in its own exposure.
    source, sensor : of the clip: the light with the lens and the crosstalk that its frames have.
    spec : times and windows.
    duration_us, seed, quality : of the clip. The error of a flux is that part of the noise of a whole exposure.
    """
    aps = sensor.spec.aps
    assert aps is not None
    times = list(windows(sensor, spec, duration_us))
    types = jit()
    clean, _ = noise_models(sensor, clean=True)
    assert clean is not None
    pixel = sensor.layout.aps_pixel
    shape, exposure_s = (len(times), sensor.rows, sensor.cols), aps.exposure_us * S_PER_US
    with new_file(path) as file:
        file.attrs.update({
            "flux": "e-/s of each pixel through its own filter, mean over its window", "window_us": spec.window_us,
            "exposure_us": aps.exposure_us, "shutter": spec.shutter, "quality": quality,
        })  # fmt: skip
        file["time_us"] = np.array([middle for middle, _ in times], dtype=np.float64)
        file["row_offset_us"] = _row_offset_us(sensor, spec)
        for name, kind in (("flux_e_per_s", "f4"), ("stderr_e_per_s", "f4"), ("raw_dn", "u2")):
            file.create_dataset(name, shape, kind, chunks=(1, *shape[1:]), compression=COMPRESSION)
        for number, (_, begin) in enumerate(times):
            a, b = sharp_flux(source, sensor, spec, begin)
            image = np.full((2, sensor.rows * sensor.cols), np.nan, np.float32)
            image[0, pixel], image[1, pixel] = 0.5 * (a + b), np.abs(a - b) * 0.5
            electrons = np.nan_to_num(image[0], nan=0.0) * np.float32(exposure_s)
            raw = clean.sample_dn(from_host(types.Float, electrons), aps.exposure_us, seed).numpy()
            raw = np.where(sensor.layout.aps_mask, raw.reshape(shape[1:]), 0)
            for name, values in (
                ("flux_e_per_s", image[0]), ("stderr_e_per_s", image[1]), ("raw_dn", raw.astype(np.uint16)),
            ):  # fmt: skip
                stored = file[name]
                stored[number] = values.reshape(shape[1:])
                stored.flush()  # so that its chunks have their place now, see `new_file`
    return len(times)


@dataclass(frozen=True)
class StoredFlux:
    """Fluxes of several times on disk; each is read when it is asked for.

    Parameters
    ----------
    path : the file that `write_sharp` or `write_colours` wrote.
    """

    path: Path

    def _read(self, name: str, number: int | None = None) -> NDArray:
        return read_dataset(self.path, "as images of a clip", name, number, kinds="fuiSO")

    @property
    def time_us(self) -> NDArray[np.float64]:
        """Middles of row 0's windows, [time], µs."""
        return self._read("time_us")

    def flux_e_per_s(self, number: int) -> NDArray[np.float32]:
        """Flux of one time, [row, col], e⁻/s, NaN where there is no frame value; of colours [row, col, channel]."""
        return self._read("flux_e_per_s", number)

    def stderr_e_per_s(self, number: int) -> NDArray[np.float32]:
        """Standard error of the flux of one time, in the same shape, e⁻/s."""
        return self._read("stderr_e_per_s", number)


class SharpImages(StoredFlux):
    """Sharp images of a clip on disk."""

    @property
    def row_offset_us(self) -> NDArray[np.float64]:
        """Delay of each row, [row], µs."""
        return self._read("row_offset_us")

    def raw_dn(self, number: int) -> NDArray[np.uint16]:
        """Noise-free RAW of one time, [row, col], DN."""
        return self._read("raw_dn", number)

    def nearest(self, t_us: float) -> int:
        """Number of the image whose time of row 0 is nearest."""
        return int(np.abs(self.time_us - t_us).argmin())


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
    """Write the full-colour truth of a clip; returns the number of images.

    Parameters
    ----------
    path : the HDF5 file: ``time_us`` [time], ``channel`` [channel] (names of filters), ``flux_e_per_s`` and
        ``stderr_e_per_s`` [time, row, col, channel]. Crosstalk between pixels is not in it.
    scene, sensor : of the clip.
    spec : times and windows, those of the sharp images.
    duration_us, seed, quality : of the clip. Each filter has random numbers of its own.
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
            absolute, one = in_absolute_light(scene)[0], through_one_filter(sensor, seen_by)
            source = scene_renderer(absolute, one, seed + 1 + channel, quality)
            for number, (_, begin) in enumerate(times):
                first = begin[every // sensor.cols]
                a, b = (np.array(half) for half in source.mean_flux(every, first, first + spec.window_us))
                for name, values in (("flux_e_per_s", 0.5 * (a + b)), ("stderr_e_per_s", 0.5 * np.abs(a - b))):
                    file[name][number, ..., channel] = values.reshape(shape[1:3])
                    file[name].flush()
    return len(times)


class ColourTruth(StoredFlux):
    """Full-colour truth of a clip on disk."""

    @property
    def channels(self) -> list[str]:
        """Names of the filters."""
        return [name.decode() if isinstance(name, bytes) else str(name) for name in self._read("channel")]
