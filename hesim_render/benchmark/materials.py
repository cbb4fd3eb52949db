"""Materials of generated scenes: spectra and textures within a scene's range of reflectance, under a coat or none.

Textures by seed: pictures of reflectance between two values.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hesim_render.benchmark.draws import log_uniform
from hesim_render.specs.benchmark import ScenesSpec
from hesim_render.spectral.spectrum import colorchecker_reflectances
from hesim_render.spectral.transfer import encode_exactly
from hesim_render.targets.resolution import leaves_picture

#: Side of a texture, texels.
SIDE = 256
_CELLS = (12, 160)


def _grid() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    y, x = np.mgrid[:SIDE, :SIDE] / SIDE
    return x, y


def _leaves(rng: np.random.Generator) -> NDArray[np.float64]:
    """Discs that cover each other, as in natural pictures [cao2010]."""
    return leaves_picture(SIDE, SIDE, 3.0, 90.0, (0.0, 1.0), int(rng.integers(2**31))).astype(np.float64)


def _noise(rng: np.random.Generator) -> NDArray[np.float64]:
    """Noise whose amplitude falls as a power of the frequency."""
    frequency = np.hypot(np.fft.fftfreq(SIDE)[:, None], np.fft.fftfreq(SIDE)[None, :]) * SIDE
    frequency[0, 0] = 1.0
    amplitude = frequency ** -rng.uniform(0.6, 2.0)
    field = np.fft.ifft2(np.fft.fft2(rng.normal(size=(SIDE, SIDE))) * amplitude).real
    low, high = np.percentile(field, [1, 99])
    return np.clip((field - low) / (high - low), 0, 1)


def _stripes(rng: np.random.Generator) -> NDArray[np.float64]:
    """A grating of whole periods, from soft to hard."""
    x, y = _grid()
    periods = rng.integers(-24, 25, 2)
    if not periods.any():
        periods = np.array([8, 0])
    wave = np.sin(2 * np.pi * (periods[0] * x + periods[1] * y + rng.random()))
    return 0.5 + 0.5 * np.tanh(wave * 10 ** rng.uniform(-0.3, 1)) / np.tanh(10.0)


def _checks(rng: np.random.Generator) -> NDArray[np.float64]:
    """Squares of two values."""
    x, y = _grid()
    count = rng.integers(2, 24, 2)
    return ((np.floor(x * count[0]) + np.floor(y * count[1])) % 2).astype(np.float64)


def _cells(rng: np.random.Generator) -> NDArray[np.float64]:
    """Voronoi cells of random values, periodic."""
    from scipy.spatial import cKDTree

    points = rng.random((int(rng.integers(*_CELLS)), 2))
    x, y = _grid()
    _, nearest = cKDTree(points, boxsize=1.0).query(np.stack([x.ravel(), y.ravel()], axis=-1))
    return rng.random(len(points))[nearest].reshape(SIDE, SIDE)


KINDS: dict[str, Callable[[np.random.Generator], NDArray[np.float64]]] = {
    "leaves": _leaves,
    "noise": _noise,
    "stripes": _stripes,
    "checks": _checks,
    "cells": _cells,
}


def texture(rng: np.random.Generator, low: float, high: float) -> NDArray[np.uint8]:
    """A picture of a random kind.

    Parameters
    ----------
    rng : random numbers.
    low, high : its smallest and largest reflectance.

    Returns
    -------
    [row, col, 3], sRGB. The two ends of its scale have slightly different colours, the more the larger their ratio.
    """
    kind = list(KINDS)[int(rng.integers(len(KINDS)))]
    value = KINDS[kind](rng)
    contrast = (high - low) / (high + low)
    ends = np.array([low, high])[:, None] * (1 + 0.5 * contrast * rng.uniform(-1, 1, (2, 3)))
    linear = ends[0] + value[..., None] * (ends[1] - ends[0])
    return np.rint(255 * encode_exactly(np.clip(linear, 0, 0.98))).astype(np.uint8)


#: Samples of reflectances, nm.
_WAVELENGTH_NM = np.arange(360.0, 831.0, 10.0)
#: Smallest mean reflectance of a scene, and largest reflectance of any surface.
_DARKEST, _BRIGHTEST = 0.06, 0.95
_LEAST_ALPHA, _MOST_ALPHA = 0.08, 0.4


def patch_names() -> list[str]:
    """Names of the measured reflectances."""
    return list(colorchecker_reflectances())


class Palette:
    """The reflectances of one scene: its mean, its contrast, and the parts that its split may use.

    Parameters
    ----------
    rng : random numbers of the scene.
    spec : ranges.
    patches, pictures : measured reflectances and the user's textures of the scene's split.
    """

    def __init__(
        self, rng: np.random.Generator, spec: ScenesSpec, patches: Sequence[str], pictures: Sequence[Path]
    ) -> None:
        self._rng, self._spec, self._patches, self._pictures = rng, spec, list(patches), list(pictures)
        self.contrast = log_uniform(rng, spec.contrast)
        mean = log_uniform(rng, (_DARKEST, _BRIGHTEST / (1 + self.contrast)))
        self.low, self.high = mean * (1 - self.contrast), mean * (1 + self.contrast)
        #: Pictures to write beside the scene file, by name: arrays [row, col, 3] of sRGB, or files to copy.
        self.files: dict[str, Any] = {}
        #: Measured reflectances that were used.
        self.measured: set[str] = set()

    def _level(self) -> float:
        return float(self._rng.uniform(self.low, self.high))

    def _spectrum(self) -> dict[str, Any]:
        """A reflectance: measured, or smooth; the lower the scene's contrast, the greyer."""
        level = self._level()
        if self._patches and self._rng.random() < 0.6:
            name = self._patches[int(self._rng.integers(len(self._patches)))]
            patch = colorchecker_reflectances()[name]
            shape = patch.at(np.clip(_WAVELENGTH_NM, *patch.support_nm))
            self.measured.add(name)
        else:
            place = (_WAVELENGTH_NM - 360) / 470
            waves = self._rng.uniform(-0.4, 0.4, 3)[:, None] * np.cos(np.pi * np.arange(1, 4)[:, None] * place)
            shape = 1 + waves.sum(axis=0)
        values = np.clip(level * (1 + self.contrast * (shape / shape.mean() - 1)), 0, _BRIGHTEST)
        return {
            "type": "irregular",
            "wavelengths": _WAVELENGTH_NM.tolist(),
            "values": values.round(6).tolist(),
        }

    def _picture(self, name: str) -> dict[str, Any]:
        """A texture as a bitmap, repeated some times over the surface."""
        if self._pictures and self._rng.random() < 0.5:
            given = self._pictures[int(self._rng.integers(len(self._pictures)))]
            file = f"{name}{given.suffix.lower()}"
            self.files[file] = given
        else:
            file = f"{name}.png"
            self.files[file] = texture(self._rng, self.low, self.high)
        repeats = np.diag([float(self._rng.integers(1, 5)), float(self._rng.integers(1, 5)), 1.0, 1.0])
        return {"type": "bitmap", "filename": file, "to_uv": repeats.tolist()}

    def material(self, name: str, solid: bool = True) -> dict[str, Any]:
        """A material as Mitsuba has it.

        Parameters
        ----------
        name : of the surface, for its files.
        solid : False for a surface without an inside, which is never glass.
        """
        frequency = self._spec.materials.shares
        if not solid:
            frequency = {**frequency, "glass": 0.0}
        weights = np.array(list(frequency.values()))
        kind = "diffuse"
        if weights.sum() > 0:
            kind = str(self._rng.choice(list(frequency), p=weights / weights.sum()))
        if kind == "glass":
            return {"type": "dielectric"}
        alpha = log_uniform(self._rng, (_LEAST_ALPHA, _MOST_ALPHA))
        if kind == "metal":
            inner: dict[str, Any] = {"type": "roughconductor", "material": "none", "alpha": alpha}
            inner["specular_reflectance"] = self._spectrum()
            return {"type": "twosided", "material": inner}
        colour = self._picture(name) if self._rng.random() < self._spec.textured else self._spectrum()
        if kind == "diffuse":
            inner = {"type": "diffuse", "reflectance": colour}
        elif kind == "plastic":
            inner = {"type": "plastic", "diffuse_reflectance": colour}
        else:
            inner = {"type": "roughplastic", "diffuse_reflectance": colour, "alpha": alpha}
        return {"type": "twosided", "material": inner}


def write_texture(source: Any, file: Path) -> None:
    """Write a texture: an array as PNG, or a copy of a file."""
    if isinstance(source, Path):
        file.write_bytes(source.read_bytes())
    else:
        Image.fromarray(np.asarray(source)).save(file, format="PNG")
