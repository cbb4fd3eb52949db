"""All options of a video: one validated model, which goes into the manifest as it is."""

from typing import Literal

from pydantic import Field, ValidationError, model_validator

from hesim_render.mosaic.colour_profile import Camera
from hesim_render.sources.video.colours import Primaries, Range, YuvMatrix
from hesim_render.sources.video.geometry import Fit
from hesim_render.sources.video.inversion import LUMA
from hesim_render.specs.files import Strict
from hesim_render.specs.problems import spec_error
from hesim_render.spectral.transfer import InputTransfer

#: Default illuminance on a perfect diffuser of value 1: a bright studio.
WHITE_LUX = 1000.0


class VideoOptions(Strict):
    """How a video represents a scene in front of the sensor.

    Parameters
    ----------
    fps : pictures per second of the video's clock. Required for folders and arrays; for files it replaces their own
        time stamps.
    slow_motion : ratio of the speed of the scene to that of the video's clock (3200 pictures/s stored at 25: 128).
    duty : part of the picture period in which the shutter was open.
    interpolation : between pictures: ``none`` holds each picture, ``linear`` interpolates linearly from middle to
        middle, ``motion`` does so after inserting `motion_factor` - 1 motion-compensated pictures between every two.
    motion_factor : see `interpolation`.
    transfer, gamma, primaries, matrix, range : colour tags, where they are missing or wrong (`ColourTags`).
    bit_depth : bits of integer values in arrays and TIFF; default: all bits of their type.
    mode : ``matrix`` or ``spectral``, see `hesim_render.sources.video.inversion`.
    others, luma : model of filters that are not a colour of the camera, in mode ``matrix``.
    camera : camera whose matrix and white balance mode ``matrix`` inverts; default: the sensor's own under the
        illuminant.
    illuminant : light on the perfect diffuser.
    white_lux : illuminance on a perfect diffuser of linear value 1, lx.
    white_e_per_s, white_filter : alternatively, its photo-electron rate behind a filter, e⁻/s.
    fit : how the picture fills the region, see `hesim_render.sources.video.geometry.mapping`.
    lens_shading : apply the sensor's relative illumination; the video then is the scene, not the image.
    """

    fps: float | None = Field(None, ge=1e-4, le=1e9)
    slow_motion: float = Field(1.0, ge=1e-6, le=1e9)
    duty: float = Field(1.0, ge=1e-6, le=1)
    interpolation: Literal["none", "linear", "motion"] = "none"
    motion_factor: int = Field(4, ge=2, le=64)
    transfer: InputTransfer | None = None
    gamma: float | None = Field(None, ge=0.1, le=10)
    primaries: Primaries | None = None
    matrix: YuvMatrix | None = None
    range: Range | None = None
    bit_depth: int | None = Field(None, ge=1, le=16)
    mode: Literal["matrix", "spectral"] = "matrix"
    others: Literal["luma", "spectral"] = "luma"
    luma: tuple[float, float, float] = LUMA
    camera: Camera | None = None
    illuminant: str = "D65"
    white_lux: float | None = Field(None, ge=1e-6, le=1e9)
    white_e_per_s: float | None = Field(None, ge=1e-6, le=1e15)
    white_filter: str | None = None
    fit: Fit = "cover"
    lens_shading: bool = False

    @model_validator(mode="after")
    def _consistent(self) -> "VideoOptions":
        if self.white_lux is not None and self.white_e_per_s is not None:
            raise ValueError("white_lux and white_e_per_s: give one of them")
        if (self.white_e_per_s is None) != (self.white_filter is None):
            raise ValueError("white_e_per_s needs white_filter, and white_filter needs white_e_per_s")
        if self.gamma is not None and self.transfer not in (None, "gamma"):
            raise ValueError(f"gamma belongs to transfer 'gamma', not {self.transfer!r}")
        if self.mode == "spectral" and self.camera is not None:
            raise ValueError("camera belongs to mode 'matrix'")
        return self

    @classmethod
    def of(cls, **given: object) -> "VideoOptions":
        """Options from keywords; those that are None count as not given.

        Raises
        ------
        SpecError
            For an unknown name or a value out of range; the message has the name.
        """
        wanted = {name: value for name, value in given.items() if value is not None}
        try:
            return cls.model_validate(wanted)
        except ValidationError as error:
            raise spec_error(error, cls, wanted) from None
