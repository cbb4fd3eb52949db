"""The sensor file: geometry, tile, filters, lens, APS and EVS parameters.

Units are in the key names. ``sources`` and ``assumptions`` say, for every figure, where it comes
from or why it was assumed. A calibration is named by ``noise: calibration.yaml``.
"""

from pathlib import Path
from typing import Any, Literal

from pydantic import (
    Field,
    PositiveFloat,
    PositiveInt,
    SerializerFunctionWrapHandler,
    field_validator,
    model_serializer,
    model_validator,
)

from hesim_render.specs.event_pixels import EvsSpec, SheetEvsSpec
from hesim_render.specs.files import NamedSpec, Strict, text_means
from hesim_render.specs.frame_pixels import ApsSpec
from hesim_render.specs.lens import LensSpec
from hesim_render.specs.sensor_checks import sensor_problems
from hesim_render.specs.spectrum import SpectrumSpec
from hesim_render.spectral.spectrum import Spectrum, product

Role = Literal["aps", "evs"]


class NoiseFile(Strict):
    """The calibration that a sensor file points at. A dump holds the SHA-256 of it and its maps, not their folder."""

    file: str
    sha256: str | None = Field(None, description="of the calibration and its maps; they are refused if they differ")
    tick_us: PositiveFloat | None = Field(
        None, description="of the captures, where the calibration does not state it; default evs.tick_us of the file"
    )
    frame_rate_hz: PositiveFloat | None = Field(None, description="the same of frames; default aps.frame_rate_hz")
    folder: Path = Field(Path(), exclude=True)

    _shorthand = text_means("file")

    @model_serializer(mode="wrap")
    def _as_stated(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {key: value for key, value in handler(self).items() if value is not None}

    @property
    def path(self) -> Path:
        return self.folder / self.file


class NoisePart(Strict):
    """The part of a sensor file that is read before the rest."""

    noise: NoiseFile


class GeometrySpec(Strict):
    rows: int = Field(ge=1, le=65_535)
    cols: int = Field(ge=1, le=65_535)
    pitch_um: float = Field(ge=0.1, le=1e5)
    fill_factor: float = Field(1.0, ge=1e-6, le=1)
    crosstalk: float = Field(0.0, ge=0, le=0.5, description="part of a pixel's electrons its 4 neighbours collect")


class PixelSpec(Strict):
    """One letter of the tile."""

    filter: str
    roles: list[Role] = Field(min_length=1)


class EvsGridSpec(Strict):
    """How event pixels are numbered: each tile holds rows × cols of them, taken in reading order.

    The k-th event pixel of tile (i, j) has event coordinates y = i·rows_per_tile + k // cols_per_tile
    and x = j·cols_per_tile + k % cols_per_tile.
    """

    rows_per_tile: PositiveInt
    cols_per_tile: PositiveInt


def tile_text(value: Any) -> str:
    """The drawing of a tile: one line of letters per row, without blanks.

    Raises
    ------
    ValueError
        If it is no text, or its rows differ in length.
    """
    if not isinstance(value, str):
        raise ValueError("the tile is drawn as text, one letter a pixel, one line a row")
    rows = ["".join(line.split()) for line in value.strip().splitlines()]
    if not rows or not rows[0] or len({len(row) for row in rows}) != 1:
        raise ValueError("every line of the tile must hold the same number of letters")
    return "\n".join(rows)


class SensorSpec(NamedSpec):
    """A whole sensor file."""

    device_seed: int = Field(ge=0, lt=2**64)
    geometry: GeometrySpec
    tile: str
    pixels: dict[str, PixelSpec] = Field(min_length=1)
    evs_grid: EvsGridSpec | None = None
    filters: dict[str, SpectrumSpec] = Field(min_length=1, description="C_f(λ), transmittance")
    quantum_efficiency: SpectrumSpec = Field(description="η(λ), electrons per photon")
    lens: LensSpec
    aps: ApsSpec | None = None
    evs: EvsSpec | None = None
    noise: NoiseFile | None = Field(None, description="a calibration.yaml whose values replace the file's own")
    sources: dict[str, str] = {}
    assumptions: dict[str, str] = {}

    @field_validator("tile", mode="before")
    @classmethod
    def _tile_shape(cls, value: Any) -> str:
        return tile_text(value)

    @property
    def tile_rows(self) -> list[str]:
        """The tile, one string of letters per row."""
        return self.tile.split("\n")

    def positions(self, role: Role) -> list[tuple[int, int]]:
        """Tile positions that have `role`, in reading order."""
        return [
            (i, j)
            for i, row in enumerate(self.tile_rows)
            for j, letter in enumerate(row)
            if role in self.pixels[letter].roles
        ]

    def filter_response(self, name: str) -> Spectrum:
        """τ_lens · C_f · η of a filter: electrons per photon that reaches the lens."""
        return product(self.filters[name].load(), self.quantum_efficiency.load(), self.lens.transmittance.load())

    @model_validator(mode="after")
    def _check(self) -> "SensorSpec":
        if problems := list(sensor_problems(self)):
            raise ValueError("\n".join(problems))
        return self


class SheetSensorSpec(SensorSpec):
    """A file with a data sheet, before the values of its event pixels follow; checks that need them come later."""

    evs: SheetEvsSpec  # type: ignore[assignment]
