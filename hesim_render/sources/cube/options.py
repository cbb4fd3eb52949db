"""How a cube is lit, framed and moved."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from pydantic import Field, ValidationError, model_validator

from hesim_render.core.errors import ConflictError, RangeError
from hesim_render.specs.files import Strict
from hesim_render.specs.spectrum import SpectrumSpec


class CubeOptions(Strict):
    """Light, framing and motion of a cube in front of a sensor.

    Parameters
    ----------
    quantity : ``reflectance`` (0 to 1, lit by `illuminant`) or ``radiance``.
    wavelength_nm : of the bands, where the file does not say.
    beyond : outside the wavelengths of the cube: ``refuse``, or ``hold`` its first and last plane.
    scale : multiplies the values; makes radiance W m⁻² sr⁻¹ nm⁻¹. A radiance whose file does not say its unit needs
        it, or `mean_luminance_cd_m2`.
    illuminant : light on reflectances, and the white of colour views.
    illuminance_lux : of reflectances, lx.
    mean_luminance_cd_m2 : of a cube of radiance in unknown units, in place of `scale`.
    fit : ``cover`` (the cube fills the read-out region), ``stretch`` or ``pixel`` (a texel is a pixel).
    pan_px_per_s : velocity of the image to the right and downwards, px/s.
    zoom_per_s : factor by which the image grows in a second; 1 for none.
    rotation_deg_per_s : of the image about the centre of the region, clockwise as seen, degrees per second.
    """

    quantity: Literal["reflectance", "radiance"] = "reflectance"
    wavelength_nm: list[float] | None = Field(None, min_length=2)
    beyond: Literal["refuse", "hold"] = "refuse"
    scale: float | None = Field(None, gt=0, le=1e12)
    illuminant: SpectrumSpec = SpectrumSpec(illuminant="D65")
    illuminance_lux: float | None = Field(None, gt=0, le=1e9)
    mean_luminance_cd_m2: float | None = Field(None, gt=0, le=1e9)
    fit: Literal["cover", "stretch", "pixel"] = "cover"
    pan_px_per_s: tuple[float, float] = (0.0, 0.0)
    zoom_per_s: float = Field(1.0, ge=0.01, le=100)
    rotation_deg_per_s: float = Field(0.0, ge=-1e5, le=1e5)

    @model_validator(mode="after")
    def _check(self) -> CubeOptions:
        if self.quantity == "reflectance":
            if self.mean_luminance_cd_m2 is not None:
                raise ValueError("mean_luminance_cd_m2 is for radiance; give reflectances illuminance_lux")
            if self.illuminance_lux is None:
                raise ValueError("reflectances need illuminance_lux")
        elif self.illuminance_lux is not None:
            raise ValueError("illuminance_lux is for reflectances; a radiance has its own light")
        if any(abs(speed) > 1e7 for speed in self.pan_px_per_s):
            raise ValueError("pan_px_per_s: expected at most 1e7 px/s")
        return self

    @classmethod
    def of(cls, given: Mapping[str, object]) -> CubeOptions:
        """Options from keywords.

        Raises
        ------
        RangeError
            For an unknown name or a value out of range; the message has the name.
        """
        try:
            return cls.model_validate(given)
        except ValidationError as error:
            problem = error.errors(include_url=False)[0]
            name, text = ".".join(map(str, problem["loc"])), problem["msg"].removeprefix("Value error, ")
            if not name:  # of several options together
                raise ConflictError("options", None, text) from None
            raise RangeError(name, problem.get("input"), text) from None

    @property
    def is_moving(self) -> bool:
        """True if the image changes with time."""
        return self.pan_px_per_s != (0.0, 0.0) or self.zoom_per_s != 1 or self.rotation_deg_per_s != 0
