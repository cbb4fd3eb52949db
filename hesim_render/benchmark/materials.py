"""Materials of generated scenes: spectra and textures within a scene's range of reflectance, under a coat or none."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from hesim_render.benchmark.draws import log_uniform
from hesim_render.benchmark.textures import texture
from hesim_render.specs.benchmark import ScenesSpec
from hesim_render.spectral.spectrum import colorchecker

#: Samples of reflectances, nm.
_WAVELENGTH_NM = np.arange(360.0, 831.0, 10.0)
#: Smallest mean reflectance of a scene, and largest reflectance of any surface.
_DARKEST, _BRIGHTEST = 0.06, 0.95
_LEAST_ALPHA, _MOST_ALPHA = 0.08, 0.4


def patch_names() -> list[str]:
    """Names of the measured reflectances."""
    return list(colorchecker())


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
            shape = colorchecker()[name].at(np.clip(_WAVELENGTH_NM, *colorchecker()[name].support_nm))
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


def write_picture(source: Any, file: Path) -> None:
    """Write a texture: an array as PNG, or a copy of a file."""
    if isinstance(source, Path):
        file.write_bytes(source.read_bytes())
    else:
        Image.fromarray(np.asarray(source)).save(file, format="PNG")
