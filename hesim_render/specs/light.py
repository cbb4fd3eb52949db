"""A light of a scene file: its place, its spectrum, its level and its waveform.

The waveform of a flickering light in a scene file.
"""

from collections.abc import Iterable
from itertools import pairwise
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from hesim_render.specs.files import InFolder, Strict
from hesim_render.specs.geometry import Direction, Size, Vector
from hesim_render.specs.spectrum import SpectrumSpec
from hesim_render.spectral import waveform
from hesim_render.spectral.spectrum import Spectrum, scale_to_irradiance, scale_to_lux, summed

#: Times are whole µs in the sensor, where a faster light would be steady.
_Frequency = Annotated[float, Field(gt=0, le=100_000)]


class MainsSpec(Strict):
    """w(t) = 1 + depth · cos(2π · 2 · frequency_hz · t + phase): power at twice the mains frequency."""

    type: Literal["mains"]
    frequency_hz: _Frequency = Field(description="of the mains, 50 or 60; the light has twice that")
    depth: float = Field(ge=0, le=1, description="(max − min)/(max + min) of the light")
    phase_deg: float = 0.0

    def load(self) -> waveform.Waveform:
        return waveform.Mains(self.frequency_hz, self.depth, self.phase_deg)


class PwmSpec(Strict):
    """On (1/duty of the mean) while frac(frequency_hz · t + phase/360°) < duty, else off."""

    type: Literal["pwm"]
    frequency_hz: _Frequency
    duty: float = Field(gt=0, le=1, description="part of each period in which the light is on")
    phase_deg: float = Field(0.0, description="0: switched on at t = 0")

    def load(self) -> waveform.Waveform:
        return waveform.Pwm(self.frequency_hz, self.duty, self.phase_deg)


class TableWaveformSpec(Strict):
    """Measured power, linear between its samples; its unit does not matter."""

    type: Literal["table"]
    t_us: tuple[float, ...] = Field(min_length=2, description="times of `value`, µs, increasing")
    value: tuple[Annotated[float, Field(ge=0)], ...] = Field(description="power, 0 or more")
    repeat: bool = Field(False, description="start over after the last sample; else the end values hold")

    @model_validator(mode="after")
    def _check(self) -> "TableWaveformSpec":
        if len(self.value) != len(self.t_us):
            raise ValueError(f"value: {len(self.value)} values for {len(self.t_us)} times")
        for earlier, later in pairwise(self.t_us):
            if later - earlier < 1e-3:
                raise ValueError(f"t_us: times must increase by 0.001 µs or more: {later:g} µs follows {earlier:g} µs")
        if not any(self.value):
            raise ValueError("value: a light that is always off has no waveform; its level is given in lux or watts")
        return self

    def load(self) -> waveform.Waveform:
        return waveform.TableWaveform(self.t_us, self.value, self.repeat)


WaveformSpec = Annotated[MainsSpec | PwmSpec | TableWaveformSpec, Field(discriminator="type")]


def _not_negative(spec: SpectrumSpec) -> SpectrumSpec:
    if spec.load().values.min() < 0:
        raise ValueError("a light's spectrum must not be negative")
    return spec


class LightSpec(InFolder):
    """Place and spectrum of a light, and its level on a stated plane.

    Exactly one of `illuminance_lux` and `irradiance_w_m2` gives the level on the plane through
    `plane_point_m` with normal `plane_normal` (default: that of the target), without shadows and from
    this light alone. For a light with a waveform the level is the time mean.
    """

    type: Literal["uniform", "point", "area", "directional", "environment", "none"]
    illuminant: Annotated[SpectrumSpec, AfterValidator(_not_negative)] = SpectrumSpec(illuminant="D65")
    illuminance_lux: float | None = Field(None, ge=0, le=1e9)
    irradiance_w_m2: float | None = Field(None, ge=0, le=1e7, description="integrated over the illuminant's table")
    position_m: Vector | None = Field(None, description="point and area lights")
    size_m: tuple[Size, Size] | None = Field(None, description="area light: width, height")
    direction: Direction | None = Field(None, description="directional light: the way the light travels")
    file: str | None = Field(
        None, description="environment: equirectangular map (EXR, HDR, PNG), linear sRGB times D65"
    )
    rotation_deg: float = Field(0.0, ge=-1e9, le=1e9, description="environment: turn about y")
    plane_point_m: Vector = (0.0, 0.0, 0.0)
    plane_normal: Direction = (0.0, 0.0, 1.0)
    waveform: WaveformSpec | None = Field(None, description="flicker; default steady")

    @model_validator(mode="after")
    def _check(self) -> "LightSpec":
        levels = [v for v in (self.illuminance_lux, self.irradiance_w_m2) if v is not None]
        if len(levels) != (self.type != "none"):
            raise ValueError(
                "a light of type 'none' has no level"
                if self.type == "none"
                else "a light needs exactly one of illuminance_lux and irradiance_w_m2"
            )
        needs = {"point": ["position_m"], "area": ["position_m", "size_m"], "directional": ["direction"]}
        needs["environment"] = ["file"]
        for name in ("position_m", "size_m", "direction", "file"):
            needed = name in needs.get(self.type, [])
            if needed != (getattr(self, name) is not None):
                raise ValueError(f"a light of type '{self.type}' {'needs' if needed else 'has no'} {name}")
        if self.file is not None and not (self.folder / self.file).is_file():
            raise ValueError(f"no such file: {self.folder / self.file}")
        if self.type == "environment" and self.illuminant != SpectrumSpec(illuminant="D65"):
            raise ValueError("a light of type 'environment' has the colours of its file, times D65, and no illuminant")
        if self.type != "environment" and self.rotation_deg != 0:
            raise ValueError(f"a light of type '{self.type}' has no rotation_deg")
        if self.type == "none" and self.waveform is not None:
            raise ValueError("a light of type 'none' has no waveform")
        return self

    @property
    def is_on(self) -> bool:
        """False in darkness: type 'none', or a level of zero."""
        return self.type != "none" and bool(self.illuminance_lux or self.irradiance_w_m2)

    def switched_off(self) -> "LightSpec":
        """The same light switched off; its geometry stays."""
        off = {"waveform": None, "illuminance_lux": 0.0, "irradiance_w_m2": None}
        return self if self.type == "none" else self.model_copy(update=off)


class LampSpec(Strict):
    """Light that a target emits itself: a spectrum, a luminance and a waveform."""

    illuminant: Annotated[SpectrumSpec, AfterValidator(_not_negative)] = SpectrumSpec(illuminant="D65")
    luminance_cd_m2: float = Field(ge=0, le=1e9, description="time mean")
    waveform: WaveformSpec | None = Field(None, description="flicker; default steady")

    @property
    def is_on(self) -> bool:
        """False where the luminance is zero."""
        return self.luminance_cd_m2 > 0

    def switched_off(self) -> "LampSpec":
        """The same target switched off; its geometry stays."""
        return self.model_copy(update={"waveform": None, "luminance_cd_m2": 0.0})

    def radiance(self) -> Spectrum:
        """L(λ) in W m⁻² sr⁻¹ nm⁻¹, time mean: 683.002 lm/W · ∫ L V dλ is the luminance."""
        return scale_to_lux(self.illuminant.load(), self.luminance_cd_m2)


def irradiance(light: LightSpec) -> Spectrum | None:
    """E(λ) on the light's plane, W m⁻² nm⁻¹, time mean; None in darkness."""
    if not light.is_on:
        return None
    shape = light.illuminant.load()
    if light.illuminance_lux is not None:
        return scale_to_lux(shape, light.illuminance_lux)
    assert light.irradiance_w_m2 is not None
    return scale_to_irradiance(shape, light.irradiance_w_m2)


def mixed_light(lights: Iterable[LightSpec]) -> Spectrum | None:
    """Spectrum of all lights together, each as on its own plane; its shape defines white. None in darkness."""
    given = list(lights)
    if len(given) == 1 and given[0].type != "none":
        return given[0].illuminant.load()
    result = [level for level in map(irradiance, given) if level is not None]
    return summed(*result) if result else None
