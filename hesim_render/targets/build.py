"""Exact geometry of the calibration targets: one mesh per reflectance, in the plane z = 0, face to +z."""

from collections.abc import Callable
from typing import Any

import numpy as np

from hesim_render.core.errors import SpecError
from hesim_render.specs import boards as board_specs
from hesim_render.specs import charts as chart_specs
from hesim_render.specs import charts as resolution_specs
from hesim_render.specs.charts import (
    ColorCheckerTarget,
    GreyRampTarget,
    IntegratingSphereTarget,
    PatchChartTarget,
    StepWedgeTarget,
)
from hesim_render.specs.target import TargetSpec
from hesim_render.spectral import spectrum as spectra
from hesim_render.spectral.spectrum import Spectrum, constant
from hesim_render.targets import boards, resolution
from hesim_render.targets.cube import image
from hesim_render.targets.piece import (
    Picture,
    TargetPiece,
    around,
    bent,
    between_patches,
    box,
    disc,
    patch_boxes,
    picture_piece,
    polygons_piece,
)
from hesim_render.targets.points import placement

#: Angle of the flat strips of a bent target. They depart from the cylinder by 1e-5 of its radius at most.
_STRIP_RAD = 0.009


def _flat(target: chart_specs.FlatTarget) -> list[TargetPiece]:
    w, h = target.width_m / 2, target.height_m / 2
    return [polygons_piece("flat", target.reflectance.load(), [box(-w, w, -h, h)])]


def build_target(target: TargetSpec) -> list[TargetPiece]:
    """The pieces of a target before its tilt and shift; flat, they tile its rectangle exactly, without overlap.

    Raises
    ------
    SpecError
        If a file of the target is not valid, or its parts do not fit.
    """
    pieces = _BUILDERS[type(target)](target)
    radius = target.bend_radius_m
    if radius is None:
        return pieces
    if abs(radius) < target.width_m / np.pi:
        raise SpecError(
            f"a target of {target.width_m:g} m covers more than half a cylinder of this radius; it must be "
            f"{target.width_m / np.pi:.4g} m or more",
            key="target.bend_radius_m",
        )
    return [bent(piece, radius, abs(radius) * _STRIP_RAD) for piece in pieces]


def placed_pieces(target: TargetSpec) -> list[TargetPiece]:
    """The pieces of a target at their place at rest."""
    pose = placement(target)
    pieces = build_target(target)
    if np.array_equal(pose, np.eye(4)):
        return pieces
    return [
        TargetPiece(p.name, p.reflectance, p.vertices_m @ pose[:3, :3].T + pose[:3, 3], p.faces, p.uv, p.radiance)
        for p in pieces
    ]


def colorchecker(target: ColorCheckerTarget) -> list[TargetPiece]:
    """24 patches on their surround."""
    return _patches(spectra.colorchecker_reflectances(target.dataset), 4, 6, target)


def patch_chart(target: PatchChartTarget) -> list[TargetPiece]:
    """A user's patches on their surround."""
    return _patches(target.load(), target.rows, target.cols, target)


def _patches(
    chart: dict[str, Spectrum], rows: int, cols: int, target: ColorCheckerTarget | PatchChartTarget
) -> list[TargetPiece]:
    w, h = target.width_m, target.height_m
    boxes = patch_boxes(rows, cols, w, h, target.patch_fill)
    pieces = [polygons_piece(name, chart[name], [box(*limits)]) for name, limits in zip(chart, boxes, strict=True)]
    if target.patch_fill == 1:
        return pieces
    return [*pieces, polygons_piece("surround", target.surround.load(), between_patches(boxes, cols, w, h))]


def step_wedge(target: StepWedgeTarget) -> list[TargetPiece]:
    """Grey steps, equally spaced in density."""
    edges = np.linspace(-target.width_m / 2, target.width_m / 2, target.steps + 1)
    levels = np.geomspace(target.reflectance_min, target.reflectance_max, target.steps)
    h = target.height_m / 2
    return [
        polygons_piece(f"step {k + 1}", constant(float(level)), [box(edges[k], edges[k + 1], -h, h)])
        for k, level in enumerate(levels)
    ]


def grey_ramp(target: GreyRampTarget) -> list[TargetPiece]:
    """A linear ramp: two texels, of which the half between their centres is shown, so that it is exact."""
    values = np.array([[[target.reflectance_min], [target.reflectance_max]]], dtype=np.float32)
    return [picture_piece("ramp", Picture(values, "grey"), target.width_m, target.height_m, (0.25, 0.75, 0.0, 1.0))]


def integrating_sphere(target: IntegratingSphereTarget) -> list[TargetPiece]:
    """A disc that shines evenly, in a black plate."""
    port, half = disc(target.port_diameter_m / 2), target.plate_m / 2
    black = constant(0.0)
    return [
        polygons_piece("port", black, [port], target.radiance() if target.is_on else None),
        polygons_piece("plate", black, around(port, -half, half, -half, half)),
    ]


_BUILDERS: dict[type, Callable[[Any], list[TargetPiece]]] = {
    chart_specs.FlatTarget: _flat,
    chart_specs.ColorCheckerTarget: colorchecker,
    chart_specs.PatchChartTarget: patch_chart,
    chart_specs.StepWedgeTarget: step_wedge,
    chart_specs.GreyRampTarget: grey_ramp,
    chart_specs.DeadLeavesTarget: resolution.dead_leaves,
    chart_specs.ImageTarget: image,
    chart_specs.IntegratingSphereTarget: integrating_sphere,
    resolution_specs.SlantedEdgeTarget: resolution.slanted_edge,
    resolution_specs.EdgeFieldTarget: resolution.edge_field,
    resolution_specs.SiemensStarTarget: resolution.siemens_star,
    resolution_specs.ResolutionWedgesTarget: resolution.resolution_wedges,
    resolution_specs.ZonePlateTarget: resolution.zone_plate,
    board_specs.CheckerboardTarget: boards.checkerboard,
    board_specs.CharucoTarget: boards.charuco,
    board_specs.AprilGridTarget: boards.aprilgrid,
    board_specs.CircleGridTarget: boards.disc_grid,
    board_specs.DotGridTarget: boards.disc_grid,
    board_specs.LedGridTarget: boards.disc_grid,
}
