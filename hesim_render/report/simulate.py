"""Captures of a simulated sensor: recordings of its event pixels and EMVA 1288 captures of its frame pixels."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from ruamel.yaml import YAML

from hesim_render.core.errors import RangeError
from hesim_render.core.units import US_PER_S
from hesim_render.report.simulated import Instrument
from hesim_render.sensor.sensor import Sensor, load_sensor
from hesim_render.sources.crosstalk import mixed
from hesim_render.spectral.spectrum import product

#: Levels from dark to saturation, and the signal of the last one over saturation.
_LEVELS, _TOP = 24, 1.1
#: Longest exposure, µs.
_LONGEST_US = 20_000
#: Frames of a long series.
_SERIES = 32


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


class FrameInstrument:
    """An instrument that takes the captures of EMVA 1288 with a simulated sensor: even light of one wavelength.

    Parameters
    ----------
    sensor : with frame pixels, cropped to what is captured.
    folder : for the frames.
    seed : of all noise.
    progress : called with what is being captured, and the part that is done.
    """

    def __init__(self, sensor: Sensor, folder: Path, seed: int, progress: Callable[[str, float], None]) -> None:
        self._sensor, self._folder, self._seed, self._progress = sensor, folder, seed, progress
        spec, self._noise = sensor.spec, sensor.aps
        efficiency = spec.quantum_efficiency.load()
        responses = {name: product(filter_.load(), efficiency) for name, filter_ in spec.filters.items()}
        places = spec.positions("aps")
        names = [spec.pixels[spec.tile_rows[row][col]].filter for row, col in places]
        self.filter = max(sorted(set(names)), key=names.count)
        peak = responses[self.filter]
        self.wavelength_nm = float(peak.wavelength_nm[np.argmax(peak.values)])
        self._place = places[names.index(self.filter)]
        tile = np.array([
            [responses[spec.pixels[letter].filter].at(self.wavelength_nm) for letter in row] for row in spec.tile_rows
        ])  # fmt: skip
        electrons = mixed(sensor.layout.tiled(tile), self._noise.crosstalk) * spec.geometry.fill_factor
        self._per_photon = np.asarray(electrons, np.float64)
        self._frame = 0

    def record(self) -> Path:
        """Capture pairs at all levels, and both series."""
        aps = self._noise.spec
        full_scale = self._noise.full_scale_dn
        saturation_e = min(aps.full_well_e, (full_scale - aps.black_level_dn) / aps.system_gain_dn_per_e)
        row, col = self._place
        per_us = _TOP * saturation_e / float(self._per_photon[row, col]) / _LONGEST_US
        exposures = [round(_LONGEST_US * (k + 1) / _LEVELS) for k in range(_LEVELS)]
        for k, exposure_us in enumerate(exposures):
            self._progress("frames", k / (_LEVELS + 4))
            self._shoot(exposure_us, per_us * exposure_us, 2)
            self._shoot(exposure_us, 0.0, 2)
        middle_us = exposures[_LEVELS // 2 - 1] + 1
        self._progress("series of frames", _LEVELS / (_LEVELS + 4))
        self._shoot(middle_us, per_us * middle_us, _SERIES)
        self._shoot(middle_us, 0.0, _SERIES)
        notes = (
            f"simulated; pixels of filter {self.filter} in even light of {self.wavelength_nm:g} nm, at most "
            f"{per_us * US_PER_S:.4g} photons per s and pixel"
        )
        with (self._folder / "capture.yaml").open("w", encoding="utf-8") as file:
            YAML().dump(
                {
                    "bit_depth": aps.bit_depth,
                    "tile_rows": 1,
                    "tile_cols": 1,
                    "sensor": self._sensor.name,
                    "notes": notes,
                },
                file,
            )
        return self._folder

    def _shoot(self, exposure_us: int, photons: float, count: int) -> None:
        from PIL import Image

        light = f"lit_{exposure_us}us_{photons:.2f}ph" if photons else f"dark_{exposure_us}us"
        for number in range(count):
            Image.fromarray(self._one(exposure_us, photons)).save(self._folder / f"{light}_{number + 1:02d}.png")

    def _one(self, exposure_us: int, photons: float) -> NDArray[np.uint16]:
        self._frame += 1
        frame = self._noise.sample(photons * self._per_photon, exposure_us, self._seed, self._frame)
        rows, cols = self._sensor.layout.tile_shape
        return np.ascontiguousarray(frame[self._place[0] :: rows, self._place[1] :: cols])
