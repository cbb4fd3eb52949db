"""Calibration targets of a scene file: in the plane z = 0, centred on the origin, facing +z, unless placed so."""

from typing import Annotated

from pydantic import Field

from hesim_render.specs.boards import (
    AprilGridTarget,
    CharucoTarget,
    CheckerboardTarget,
    CircleGridTarget,
    DotGridTarget,
    LedGridTarget,
)
from hesim_render.specs.charts import (
    ColorCheckerTarget,
    DeadLeavesTarget,
    EdgeFieldTarget,
    FlatTarget,
    GreyRampTarget,
    ImageTarget,
    IntegratingSphereTarget,
    PatchChartTarget,
    ResolutionWedgesTarget,
    SiemensStarTarget,
    SlantedEdgeTarget,
    StepWedgeTarget,
    ZonePlateTarget,
)
from hesim_render.specs.light import LampSpec

TargetSpec = Annotated[
    FlatTarget
    | ColorCheckerTarget
    | PatchChartTarget
    | StepWedgeTarget
    | GreyRampTarget
    | DeadLeavesTarget
    | ImageTarget
    | IntegratingSphereTarget
    | SlantedEdgeTarget
    | EdgeFieldTarget
    | SiemensStarTarget
    | ResolutionWedgesTarget
    | ZonePlateTarget
    | CheckerboardTarget
    | CharucoTarget
    | AprilGridTarget
    | CircleGridTarget
    | DotGridTarget
    | LedGridTarget,
    Field(discriminator="type"),
]


def lamps_of(target: object) -> LampSpec | None:
    """The target, if it shines itself; otherwise None."""
    return target if isinstance(target, LampSpec) else None
