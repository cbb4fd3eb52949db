"""Filter sets and palettes: what a study puts in front of the pixels of a sensor.

A filter set is a tile with the filter and the roles of each letter. A palette has the spectra of filters by name, and
may replace the quantum efficiency, so that all sets of one palette stand before the same silicon.
"""

from pathlib import Path
from typing import Any

from pydantic import Field, field_validator, model_validator

from hesim_render.core.errors import did_you_mean
from hesim_render.specs.files import NamedSpec, read_spec
from hesim_render.specs.sensor import EvsGridSpec, PixelSpec, tile_text
from hesim_render.specs.spectrum import SpectrumSpec

#: Folders of the shipped files.
SETS, PALETTES = "filter_sets", "palettes"


class PaletteSpec(NamedSpec):
    """Filters by name."""

    quantum_efficiency: SpectrumSpec | None = Field(None, description="replaces that of the sensor")
    filters: dict[str, SpectrumSpec] = Field(min_length=1, description="transmittance of each filter")
    sources: dict[str, str] = {}
    assumptions: dict[str, str] = {}

    @model_validator(mode="after")
    def _check(self) -> "PaletteSpec":
        parts = [(f"filters.{name}", spec) for name, spec in self.filters.items()]
        if self.quantum_efficiency is not None:
            parts.append(("quantum_efficiency", self.quantum_efficiency))
        problems = []
        for key, spec in parts:
            values = spec.load().values
            if values.min() < 0 or values.max() > 1 + 1e-9:
                problems.append(f"{key}: must lie in [0, 1]; it runs from {values.min():g} to {values.max():g}")
        if problems:
            raise ValueError("\n".join(problems))
        return self


class FilterSetSpec(NamedSpec):
    """A tile, and what its letters mean."""

    tile: str
    pixels: dict[str, PixelSpec] = Field(min_length=1)
    evs_grid: EvsGridSpec | None = None
    filters: dict[str, SpectrumSpec] = Field({}, description="filters of its own, before those of the palette")

    @field_validator("tile", mode="before")
    @classmethod
    def _tile_shape(cls, value: Any) -> str:
        return tile_text(value)

    @model_validator(mode="after")
    def _check(self) -> "FilterSetSpec":
        drawn = set("".join(self.tile.split()))
        problems = [f"tile: the letter {letter!r} is not defined under 'pixels'" for letter in drawn - set(self.pixels)]
        problems += [
            f"pixels.{letter}: no pixel of the tile has this letter; draw it there, or remove it here"
            for letter in self.pixels
            if letter not in drawn
        ]
        used = {pixel.filter for pixel in self.pixels.values()}
        problems += [
            f"filters.{name}: no pixel has this filter; give it to one under 'pixels', or remove it here"
            for name in self.filters
            if name not in used
        ]
        if problems:
            raise ValueError("\n".join(problems))
        return self

    def spectra(self, palette: PaletteSpec) -> dict[str, SpectrumSpec]:
        """The spectrum of each filter, in the order of the letters.

        Raises
        ------
        ValueError
            If neither the set nor the palette has a filter.
        """
        result: dict[str, SpectrumSpec] = {}
        for letter, pixel in self.pixels.items():
            known = {**palette.filters, **self.filters}
            if pixel.filter not in known:
                raise ValueError(
                    f"pixels.{letter}.filter: the palette {palette.name!r} has no filter {pixel.filter!r}"
                    f"{did_you_mean(pixel.filter, known)}; it has {', '.join(palette.filters)}"
                )
            result[pixel.filter] = known[pixel.filter]
        return result


def read_filter_set(name_or_path: str | Path) -> FilterSetSpec:
    """A filter set, by shipped name or path."""
    return read_spec(FilterSetSpec, name_or_path, SETS)


def read_palette(name_or_path: str | Path) -> PaletteSpec:
    """A palette, by shipped name or path."""
    return read_spec(PaletteSpec, name_or_path, PALETTES)
