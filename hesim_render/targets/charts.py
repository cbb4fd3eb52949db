"""Charts for tone and colour, and the port of an integrating sphere."""

from __future__ import annotations

import numpy as np

from hesim_render.specs.charts import (
    ColorCheckerTarget,
    GreyRampTarget,
    IntegratingSphereTarget,
    PatchChartTarget,
    StepWedgeTarget,
)
from hesim_render.spectral import spectrum as spectra
from hesim_render.spectral.spectrum import Spectrum, constant
from hesim_render.targets.piece import (
    Picture,
    TargetPiece,
    around,
    between_patches,
    box,
    disc,
    patch_boxes,
    picture_piece,
    polygons_piece,
)


def colorchecker(target: ColorCheckerTarget) -> list[TargetPiece]:
    """24 patches on their surround."""
    return _patches(spectra.colorchecker(target.dataset), 4, 6, target)


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
        polygons_piece("port", black, [port], target.radiance() if target.is_lit else None),
        polygons_piece("plate", black, around(port, -half, half, -half, half)),
    ]
