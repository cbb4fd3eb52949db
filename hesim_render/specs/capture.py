"""``capture.yaml``: a person's description of the captures of a sensor."""

from typing import Literal

from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from hesim_render.specs.files import Strict
from hesim_render.specs.geometry import Region


class SignalReference(Strict):
    """Unit of the EVS signal: I = k · Φ · t_ref, in DN of this exposure seen through `filter`."""

    k: PositiveFloat
    t_ref_us: PositiveFloat
    filter: str = "own"


class CaptureSpec(Strict):
    """``capture.yaml``."""

    bit_depth: int = Field(ge=1, le=16)
    tile_rows: PositiveInt
    tile_cols: PositiveInt
    notes: str = ""
    sensor: str | None = None
    tile_position: tuple[int, int] | None = Field(
        None, description="row and column, from 0, of the colour of the tile that EMVA 1288 captures are evaluated for"
    )
    exposure_unit: Literal["ns", "us", "ms", "s"] | None = Field(
        None, description="of exposures in a list of EMVA 1288 pictures; default ns, the standard's"
    )
    roi: Region | None = Field(None, description="the whole sensor where it is left out")
    theta_hardware_v: PositiveFloat | None = None
    signal_reference: SignalReference | None = None
    illuminant: str | None = Field(None, description="light on a neutral scene: tells filters that frames lack")
    contrast_of: Literal["signal", "voltage"] = "signal"
    tick_us: PositiveFloat | None = Field(
        None, description="period of the fixed comparisons, µs; default that of the sensor"
    )
    frame_rate_hz: PositiveFloat | None = Field(
        None, description="frames per second within an exposure; default that of the sensor"
    )
    evs_tile_rows: PositiveInt | None = Field(
        None, description="event pixels of a tile, where they are not one a pixel"
    )
    evs_tile_cols: PositiveInt | None = None
    truth: dict[Literal["aps", "evs"], dict[str, float]] | None = Field(
        None, description="of simulated captures: the sensor's own values, by the names that calibrations give them"
    )

    @model_validator(mode="after")
    def _check(self) -> "CaptureSpec":
        if (self.evs_tile_rows is None) != (self.evs_tile_cols is None):
            raise ValueError("evs_tile_rows and evs_tile_cols are given together or not at all")
        if self.tile_position is not None:
            for value, count in zip(self.tile_position, (self.tile_rows, self.tile_cols), strict=True):
                if not 0 <= value < count:
                    raise ValueError(f"tile_position {list(self.tile_position)} lies outside of the tile")
        return self

    @property
    def full_scale_dn(self) -> int:
        return 2**self.bit_depth - 1
