"""The file of a filter design: what is varied, for which lights and levels, at what cost, and how it is judged."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from hesim_render.specs.files import Strict
from hesim_render.specs.study import NamedLight, NamesFiles, SetUseSpec, SurfacesSpec, TaskFile

_Lux = Annotated[float, Field(gt=0, le=1e9)]
_Side = Annotated[int, Field(ge=1, le=12)]
_Depth = Annotated[float, Field(gt=0, le=1000)]


class CostSpec(Strict):
    """Weights of the cost."""

    colour: float = Field(1.0, ge=0, description="of the rms colour difference without noise")
    noise: float = Field(0.5, ge=0, description="of the rms colour difference with noise, the mean over levels")
    events: float = Field(0.0, ge=0, description="of the relative contrast that gives an event on a grey card")

    @model_validator(mode="after")
    def _some(self) -> "CostSpec":
        if self.colour + self.noise + self.events == 0:
            raise ValueError("at least one weight must be above 0")
        return self


class DesignLightsSpec(NamesFiles):
    """Reflectances under lights."""

    reflectances: str
    illuminants: list[NamedLight] = Field(min_length=1)

    def surfaces(self) -> SurfacesSpec:
        """The same as surfaces of a study."""
        return SurfacesSpec.model_validate({"reflectances": self.reflectances}, context={"folder": self.folder})


class DesignSpec(TaskFile):
    """A filter design."""

    sensor: str
    filter_set: SetUseSpec
    palette: str = Field("dyes", description="filters to start from, filters that are not varied, quantum efficiency")
    vary: list[str] = Field([], description="names of the filters that are varied; none: all of the set")
    tile_px: tuple[_Side, _Side] | None = Field(
        None, description="rows and columns of a tile in which the shares of the frame filters are varied"
    )
    share_min: float = Field(0.05, gt=0, le=0.5, description="least share of a frame filter in that tile")
    silicon_depth_um: tuple[_Depth, _Depth] | None = Field(
        None, description="range in which the depth of the silicon is varied; default that of the palette"
    )
    family: Literal["dye", "thin_film", "free"] = "dye"
    bands: int = Field(2, ge=1, le=6, description="absorption bands of a dye")
    layers: int = Field(9, ge=1, le=40, description="layers of a stack of thin films")
    transmittance_max: float = Field(0.95, gt=0, le=1)
    transmittance_min: float = Field(0.0, ge=0, lt=1, description="what passes a filter where it is darkest")
    slope_max_per_nm: float = Field(0.03, gt=0, le=1, description="steepest change of the transmittance")
    fit: DesignLightsSpec
    illuminance_lux: list[_Lux] = Field([20.0, 1000.0], min_length=1)
    exposure_us: int | None = Field(None, ge=1, le=10**9, description="default that of the sensor")
    area_px: float = Field(4.0, gt=0, le=1e6)
    cost: CostSpec = CostSpec()
    starts: int = Field(4, ge=1, le=1000)
    steps: int = Field(125, ge=1, le=100_000, description="of the optimiser, for each start")
    seed: int = Field(1, ge=0, lt=2**63)
    judge: DesignLightsSpec = Field(description="what the result is judged on; should not be what it was fitted to")
    compare: list[SetUseSpec] = Field([], description="sets that the result is compared with; none: that of the start")
    demosaic: bool = Field(True, description="judge it after demosaicing, too")
    repeats: int = Field(8, ge=2, le=1000, description="noisy frames of the judgement")

    @model_validator(mode="after")
    def _check(self) -> "DesignSpec":
        if self.transmittance_min >= self.transmittance_max:
            raise ValueError("transmittance_min must be below transmittance_max")
        if len(set(self.vary)) != len(self.vary):
            raise ValueError("vary: a filter is there twice")
        if self.silicon_depth_um is not None and self.silicon_depth_um[0] >= self.silicon_depth_um[1]:
            raise ValueError("silicon_depth_um: expected the least and the largest depth")
        return self
