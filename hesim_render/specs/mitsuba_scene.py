"""The ``mitsuba`` section of a scene file: a scene in Mitsuba's own formats."""

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_serializer, model_validator

from hesim_render.specs.files import Strict
from hesim_render.specs.geometry import Direction, Vector
from hesim_render.specs.light import WaveformSpec


class MitsubaSpec(Strict):
    """A scene in Mitsuba's own formats: exactly one of an XML file, a built-in scene, or an inline dictionary.

    In an inline dictionary a 4×4 list of rows is a transform. Radiance is taken as
    W m⁻² sr⁻¹ nm⁻¹ times `radiance_scale`. Alternatively it is scaled so that the plane through `plane_point_m`
    with normal `plane_normal` gets `illuminance_lux` or `irradiance_w_m2` from all light of the scene
    together, interreflections included, at t = 0, with flickering lights at their time means. The
    first sensor is the camera unless the scene file has a `camera` section. Emitters are named by the
    id of their shape, or by their own.
    """

    file: str | None = None
    builtin: Literal["cornell_box"] | None = None
    inline: Mapping[str, Any] | None = None
    radiance_scale: float = Field(1.0, ge=1e-30, le=1e9)
    illuminance_lux: float | None = Field(None, ge=1e-9, le=1e9)
    irradiance_w_m2: float | None = Field(None, ge=1e-12, le=1e7, description="integrated over 360 to 830 nm")
    plane_point_m: Vector | None = Field(None, description="where the level holds")
    plane_normal: Direction | None = Field(None, description="of the plane there, to the side that is lit")
    waveforms: dict[str, WaveformSpec] = Field({}, description="flicker of emitters; their radiance is the time mean")
    lit: tuple[str, ...] | None = Field(None, description="these emitters alone give light; default all")
    unlit: tuple[str, ...] = Field((), description="these emitters give none")

    @model_validator(mode="after")
    def _check(self) -> "MitsubaSpec":
        if sum(value is not None for value in (self.file, self.builtin, self.inline)) != 1:
            raise ValueError("give exactly one of file, builtin and inline")
        if self.lit is not None and self.unlit:
            raise ValueError("give lit or unlit, not both")
        if self.illuminance_lux is not None and self.irradiance_w_m2 is not None:
            raise ValueError("give illuminance_lux or irradiance_w_m2, not both")
        if self.has_level and self.radiance_scale != 1:
            raise ValueError("radiance_scale: a level in lux or W m^-2 takes its place; give one of them")
        for key in ("plane_point_m", "plane_normal"):
            if (getattr(self, key) is not None) != self.has_level:
                needs = (
                    "is required beside a level" if self.has_level else "goes with illuminance_lux or irradiance_w_m2"
                )
                raise ValueError(f"{key} {needs}")
        return self

    @property
    def has_level(self) -> bool:
        """True if a level on a plane sets the light."""
        return self.illuminance_lux is not None or self.irradiance_w_m2 is not None

    def may_shine(self, emitter: str) -> bool:
        """True if an emitter with this name is left on."""
        return emitter not in self.unlit and (self.lit is None or emitter in self.lit)

    @field_serializer("inline", when_used="json")
    def _inline_as_text(self, inline: Mapping[str, Any] | None) -> Any:
        return None if inline is None else _plain(inline)


def _plain(node: Any) -> Any:
    """An inline scene as JSON can hold it: matrices as lists, objects of Mitsuba as their own text."""
    if isinstance(node, Mapping):
        return {str(key): _plain(value) for key, value in node.items()}
    if isinstance(node, list | tuple):
        return [_plain(value) for value in node]
    if node is None or isinstance(node, bool | int | float | str):
        return node
    if hasattr(node, "matrix"):
        return np.array(node.matrix, dtype=np.float64).round(9).tolist()
    return node.tolist() if isinstance(node, np.ndarray) else str(node)
