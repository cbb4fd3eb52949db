"""Frames of a twin on the bench of its captures: the same lights and exposures, one frame at a time."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.aps.long_series import Long, long_of
from hesim_render.calibrate.aps.noise_spectrum import noise_spectrum
from hesim_render.calibrate.aps.pair_levels import Levels, levels, pair_statistics
from hesim_render.calibrate.aps.pairs import PairCalibration
from hesim_render.calibrate.moments import Progress, measure
from hesim_render.recording.pair_set import PairSet, Series
from hesim_render.sensor.sensor import Sensor


class TwinBench:
    """The twin before the light of the captures.

    Parameters
    ----------
    sensor : the twin.
    result : the calibration that it has, with the light's offset and responsivity.
    light_rel : [row, col], shading of the light.
    seed : of all temporal noise.
    """

    def __init__(self, sensor: Sensor, result: PairCalibration, light_rel: NDArray, seed: int) -> None:
        self._sensor, self._result, self._seed = sensor, result, seed
        self._shading = light_rel.astype(np.float64)
        self._frame = 0

    def electrons(self, light: float) -> NDArray[np.float64]:
        """Mean photo-electrons of each pixel, [row, col]; `light` as in the captures, 0 in the dark."""
        if light == 0:
            return np.zeros(self._shading.shape)
        per_light = self._result.responsivity.slope / self._result.gain.slope
        return per_light * max(light + self._result.curve.offset, 0.0) * self._shading

    def frames(self, light: float, exposure_s: float, count: int) -> Iterator[NDArray[np.uint16]]:
        """Frames of one light and exposure; no two frames of a bench have the same noise."""
        electrons = self.electrons(light)
        for _ in range(count):
            self._frame += 1
            yield self._sensor.aps.sample(electrons, exposure_s * 1e6, self._seed, self._frame)

    def pairs(self, like: PairSet, lit: bool, progress: Progress | None = None) -> Levels:
        """Pairs like those of a set."""
        series = like.lit if lit else like.dark
        different = list(dict.fromkeys(series))
        result = {}
        for number, entry in enumerate(different):
            first, second = self.frames(_light(like, entry), entry.exposure_s, 2)
            result[entry] = pair_statistics(first, second, like.spec.full_scale_dn)
            if progress is not None:
                progress("simulating pairs", (number + 1) / len(different))
        photons = [entry.photons or 0.0 for entry in series]
        return levels([entry.exposure_s for entry in series], photons, [result[entry] for entry in series])

    def long(self, like: PairSet, lit: bool) -> Long:
        """A long series like that of a set."""
        entry = like.spatial_lit if lit else like.spatial_dark
        first = self._frame
        stack = _SimulatedStack(self, _light(like, entry), entry, like.shape)
        moments = measure(stack, np.ones(like.shape, bool), like.spec.full_scale_dn)
        self._frame = first  # the same frames once more
        spectrum = None if lit else noise_spectrum(stack, moments.mean[0].astype(np.float64))
        self._frame = first + len(entry.files)
        return long_of(moments, spectrum)


def _light(like: PairSet, entry: Series) -> float:
    if not entry.lit:
        return 0.0
    return float(entry.photons or 0.0) if like.has_photons else entry.exposure_s


class _SimulatedStack:
    """Frames of a long series in the form that `measure` reads."""

    def __init__(self, bench: TwinBench, light: float, entry: Series, shape: tuple[int, int]) -> None:
        self._bench, self._light, self._entry = bench, light, entry
        self.file: Path = entry.where
        self.shape: tuple[int, int, int, int] = (1, len(entry.files), *shape)
        self.exposures_us = np.array([round(entry.exposure_s * 1e6)], np.int64)

    def __iter__(self) -> Iterator[NDArray]:
        return self._bench.frames(self._light, self._entry.exposure_s, self.shape[1])
