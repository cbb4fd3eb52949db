"""Frames of one light and exposure, as captures of EMVA 1288 list them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from hesim_render.core.errors import SpecError


@dataclass(frozen=True)
class Series:
    """Frames of one light and exposure.

    Attributes
    ----------
    lit : whether light fell on the sensor.
    exposure_s : exposure, s.
    photons : mean photons per pixel and exposure; None where it is not stated.
    files : the frames.
    where, line : file and line that state them, for messages.
    """

    lit: bool
    exposure_s: float
    photons: float | None
    files: tuple[Path, ...]
    where: Path
    line: int | None

    def error(self, text: str) -> SpecError:
        """An error of these frames, with file and line."""
        return SpecError(f"{self.label}: {text}", file=self.where, line=self.line)

    @property
    def label(self) -> str:
        light = "dark" if not self.lit else "lit" if self.photons is None else f"{self.photons:g} photons"
        return f"{light}, {self.exposure_s * 1e6:g} µs"
