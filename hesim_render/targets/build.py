"""Exact geometry of the calibration targets: one mesh per reflectance, in the plane z = 0, face to +z."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from hesim_render.core.errors import SpecError
from hesim_render.specs import boards as board_specs
from hesim_render.specs import charts as chart_specs
from hesim_render.specs import charts as resolution_specs
from hesim_render.specs.target import TargetSpec
from hesim_render.targets import boards, charts, leaves, resolution
from hesim_render.targets.image import image
from hesim_render.targets.piece import TargetPiece, bent, box, polygons_piece
from hesim_render.targets.points import placement

#: Angle of the flat strips of a bent target. They depart from the cylinder by 1e-5 of its radius at most.
_STRIP_RAD = 0.009


def _flat(target: chart_specs.FlatTarget) -> list[TargetPiece]:
    w, h = target.width_m / 2, target.height_m / 2
    return [polygons_piece("flat", target.reflectance.load(), [box(-w, w, -h, h)])]


_BUILDERS: dict[type, Callable[[Any], list[TargetPiece]]] = {
    chart_specs.FlatTarget: _flat,
    chart_specs.ColorCheckerTarget: charts.colorchecker,
    chart_specs.PatchChartTarget: charts.patch_chart,
    chart_specs.StepWedgeTarget: charts.step_wedge,
    chart_specs.GreyRampTarget: charts.grey_ramp,
    chart_specs.DeadLeavesTarget: leaves.dead_leaves,
    chart_specs.ImageTarget: image,
    chart_specs.IntegratingSphereTarget: charts.integrating_sphere,
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
