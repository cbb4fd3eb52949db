"""The lens of a sensor file: aperture, focal length, transmittance, and each of its aberrations."""

from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, SerializerFunctionWrapHandler, ValidationInfo, model_serializer, model_validator

from hesim_render.core.errors import SpecError
from hesim_render.core.npz import read_array
from hesim_render.specs.files import Strict
from hesim_render.specs.spectrum import SpectrumSpec

#: Values of one kernel of a measured PSF, and of all kernels together, at most.
_MOST_ACROSS, _MOST_VALUES = 257, 1 << 18
#: Largest deviation of the sum of a kernel from 1.
_SUM_TOLERANCE = 1e-3


def _rising(name: str, values: list[float], partner: str, others: list[Any]) -> None:
    """Check the places of a table, and that it has as many values."""
    if len(values) != len(others):
        raise ValueError(f"{partner}: {len(others)} values for the {len(values)} of {name}; they must be equally many")
    if any(b <= a for a, b in pairwise(values)) or values[0] < 0:
        raise ValueError(f"{name} must start at 0 or above and increase strictly")


class IlluminationTable(Strict):
    """Relative illumination against image height, linear between points, constant beyond the last."""

    image_height_mm: list[float] = Field(min_length=2)
    illumination_rel: list[float] = Field(min_length=2)

    @model_validator(mode="after")
    def _check(self) -> "IlluminationTable":
        _rising("image_height_mm", self.image_height_mm, "illumination_rel", self.illumination_rel)
        if any(not 0 <= value <= 1 for value in self.illumination_rel):
            raise ValueError("relative illumination must lie in [0, 1]")
        return self


_Coefficient = Annotated[float, Field(ge=-1e3, le=1e3)]


class OpenCvDistortion(Strict):
    """OpenCV's model of the tangents x, y of the angles to the axis, with r² = x² + y²:
    x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶)/(1 + k4 r² + k5 r⁴ + k6 r⁶) + 2 p1 x y + p2 (r² + 2 x²), and y' alike.
    """

    model: Literal["opencv"]
    k1: _Coefficient = 0.0
    k2: _Coefficient = 0.0
    p1: _Coefficient = 0.0
    p2: _Coefficient = 0.0
    k3: _Coefficient = 0.0
    k4: _Coefficient = 0.0
    k5: _Coefficient = 0.0
    k6: _Coefficient = 0.0

    @property
    def coefficients(self) -> tuple[float, ...]:
        """In OpenCV's order: k1, k2, p1, p2, k3, and where one of them is not 0, k4, k5, k6."""
        first = self.k1, self.k2, self.p1, self.p2, self.k3
        rational = self.k4, self.k5, self.k6
        return first + rational if any(rational) else first


class FisheyeDistortion(Strict):
    """OpenCV's fisheye model: a direction at the angle θ to the axis lies at the image height
    θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸), in units of the image distance.
    """

    model: Literal["fisheye"]
    k1: _Coefficient = 0.0
    k2: _Coefficient = 0.0
    k3: _Coefficient = 0.0
    k4: _Coefficient = 0.0

    @property
    def coefficients(self) -> tuple[float, ...]:
        """k1, k2, k3, k4."""
        return self.k1, self.k2, self.k3, self.k4


class GaussianPsf(Strict):
    """A Gaussian whose width depends on the image height, linear between points, constant beyond the last."""

    type: Literal["gaussian"]
    image_height_mm: list[float] = Field(min_length=1)
    fwhm_um: list[Annotated[float, Field(ge=0, le=1e4)]] = Field(min_length=1)

    @model_validator(mode="after")
    def _check(self) -> "GaussianPsf":
        _rising("image_height_mm", self.image_height_mm, "fwhm_um", self.fwhm_um)
        return self


class MeasuredPsf(Strict):
    """Measured kernels at some image heights, linear between them, constant beyond the last.

    A kernel is an array of an odd number of rows and columns whose middle is the chief ray. One at an image height
    above 0 is given as it looks to the right of the axis; elsewhere it is turned about the axis.
    """

    type: Literal["measured"]
    file: str | None = Field(None, description=".npy, [row, col] or [height, row, col], relative to this file")
    kernels: list[list[list[float]]] | None = Field(None, description="the same as numbers [height][row][col]")
    sample_um: float = Field(gt=0, le=1e4, description="distance of two values on the sensor")
    image_height_mm: list[float] = Field([0.0], min_length=1)

    @model_validator(mode="before")
    @classmethod
    def _read(cls, data: Any, info: ValidationInfo) -> Any:
        if not isinstance(data, dict) or not isinstance(data.get("file"), str):
            return data
        if data.get("kernels") is not None:
            raise ValueError("kernels: give file or kernels, not both")
        file = Path((info.context or {}).get("folder", "")) / data["file"]
        try:
            array = read_array(file)
        except (SpecError, OSError) as error:
            raise ValueError(f"file: {error}") from None
        if array.ndim not in (2, 3) or array.size > _MOST_VALUES or array.dtype.kind not in "fiu":
            raise ValueError(
                f"file: {data['file']} holds {array.dtype} of shape {array.shape}; expected real numbers [row, col] or "
                f"[height, row, col], {_MOST_VALUES} of them at most"
            )
        kernels = array.astype(np.float64).reshape(-1, *array.shape[-2:])
        return {**data, "kernels": kernels.tolist()}

    @model_validator(mode="after")
    def _check(self) -> "MeasuredPsf":
        if self.kernels is None:
            raise ValueError("file is required, or kernels")
        where = "kernels" if self.file is None else "file"
        shapes = {(len(kernel), len(row)) for kernel in self.kernels for row in kernel}
        if len(shapes) != 1 or any(n % 2 == 0 or n > _MOST_ACROSS for n in next(iter(shapes))):
            raise ValueError(f"{where}: a kernel must have an odd number of rows and of columns, up to {_MOST_ACROSS}")
        _rising("image_height_mm", self.image_height_mm, where, self.kernels)
        for number, kernel in enumerate(np.array(self.kernels)):
            if not kernel.min() >= 0:
                raise ValueError(f"{where}: kernel {number} has a value of {kernel.min():g}; a PSF is nowhere below 0")
            if not abs(kernel.sum() - 1) <= _SUM_TOLERANCE:
                raise ValueError(
                    f"{where}: kernel {number} sums to {kernel.sum():.6g}; a PSF must sum to 1 (within "
                    f"{_SUM_TOLERANCE:g}): divide it by its sum"
                )
        return self

    @model_serializer(mode="wrap")
    def _self_contained(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """A dump (and so a hash) holds the numbers of the file, not its name."""
        return {**handler(self), "file": None}


class LateralChromatic(Strict):
    """Lateral chromatic aberration: the image at a wavelength has 1 + magnification_rel times its
    nominal size. Linear between the wavelengths, constant beyond them.
    """

    wavelength_nm: list[float] = Field(min_length=2)
    magnification_rel: list[Annotated[float, Field(ge=-0.1, le=0.1)]] = Field(min_length=2)

    @model_validator(mode="after")
    def _check(self) -> "LateralChromatic":
        _rising("wavelength_nm", self.wavelength_nm, "magnification_rel", self.magnification_rel)
        return self


#: Effects of a lens by the name of their key: what each is if it is switched off.
EFFECTS: dict[str, Any] = {
    "distortion": None,
    "depth_of_field": False,
    "diffraction": False,
    "psf": None,
    "lateral_chromatic": None,
    "relative_illumination": "none",
    "veiling_glare": 0.0,
}
#: Names by which they are switched off.
LENS_TERMS = tuple(f"lens.{name}" for name in EFFECTS)


class LensSpec(Strict):
    """Solid angle of the cone at the sensor: G = π / (1 + 4 N² (1 + |m|)²) sr."""

    f_number: float = Field(ge=0.1, le=1000)
    focal_length_mm: float = Field(ge=0.01, le=1e5)
    transmittance: SpectrumSpec = SpectrumSpec(flat=1.0)
    magnification: Annotated[float, Field(ge=-100, le=100)] | Literal["focus"] = Field(
        "focus", description="m; 'focus' derives it from focal length and the scene's focus distance"
    )
    relative_illumination: Literal["cos4", "none"] | IlluminationTable = "cos4"
    psf_fwhm_um: float = Field(0.0, ge=0, le=1e4, description="Gaussian point-spread function on the sensor")
    psf: Annotated[GaussianPsf | MeasuredPsf, Field(discriminator="type")] | None = Field(
        None, description="a PSF that depends on the place in the image, instead of psf_fwhm_um"
    )
    distortion: Annotated[OpenCvDistortion | FisheyeDistortion, Field(discriminator="model")] | None = None
    depth_of_field: bool = Field(False, description="thin lens of diameter f/N: what is out of focus is blurred")
    diffraction: bool = Field(False, description="Airy pattern of a round aperture at N (1 + |m|)")
    lateral_chromatic: LateralChromatic | None = None
    veiling_glare: float = Field(0.0, ge=0, lt=1, description="part of the light that is spread evenly over the sensor")

    @model_validator(mode="after")
    def _check(self) -> "LensSpec":
        if self.psf is not None and self.psf_fwhm_um > 0:
            raise ValueError("psf: give psf or psf_fwhm_um, not both")
        return self

    def without(self, effects: Iterable[str]) -> "LensSpec":
        """The lens with some effects (keys of `EFFECTS`) switched off."""
        neutral = {name: EFFECTS[name] for name in effects}
        if "psf" in neutral:
            neutral["psf_fwhm_um"] = 0.0
        return self.model_copy(update=neutral) if neutral else self

    def used_effects(self) -> dict[str, Any]:
        """Effects that are on, by name, as plain values; kernels are not listed."""
        given = self.model_dump(mode="json", include=set(EFFECTS), exclude_none=True)
        result = {name: given[name] for name, neutral in EFFECTS.items() if name in given and given[name] != neutral}
        if self.psf_fwhm_um > 0:
            result["psf"] = {"type": "gaussian", "image_height_mm": [0.0], "fwhm_um": [self.psf_fwhm_um]}
        if isinstance(result.get("psf"), dict):
            result["psf"].pop("kernels", None)
        return result
