"""How a sensor file names a calibration (``noise: calibration.yaml``)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import Field, PositiveFloat, SerializerFunctionWrapHandler, model_serializer, model_validator

from hesim_render.specs.files import Strict


class NoiseFile(Strict):
    """The calibration that a sensor file points at. A dump holds the SHA-256 of it and its maps, not their folder."""

    file: str
    sha256: str | None = Field(None, description="of the calibration and its maps; they are refused if they differ")
    tick_us: PositiveFloat | None = Field(
        None, description="of the captures, where the calibration does not state it; default evs.tick_us of the file"
    )
    frame_rate_hz: PositiveFloat | None = Field(None, description="the same of frames; default aps.frame_rate_hz")
    folder: Path = Field(Path(), exclude=True)

    @model_validator(mode="before")
    @classmethod
    def _shorthand(cls, data: Any) -> Any:
        return {"file": data} if isinstance(data, str) else data

    @model_serializer(mode="wrap")
    def _as_stated(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {key: value for key, value in handler(self).items() if value is not None}

    @property
    def path(self) -> Path:
        return self.folder / self.file


class NoisePart(Strict):
    """The part of a sensor file that is read before the rest."""

    noise: NoiseFile
