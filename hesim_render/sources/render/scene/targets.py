"""Exact geometry of the calibration targets: one mesh per reflectance, in the plane z = 0, face to +z."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import cos, pi, radians, sin, tan

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.specs.target import (
    CheckerboardTarget,
    ColorCheckerTarget,
    FlatTarget,
    SiemensStarTarget,
    SlantedEdgeTarget,
    StepWedgeTarget,
    TargetSpec,
)
from hesim_render.spectral import spectrum as spectra
from hesim_render.spectral.spectrum import Spectrum, constant

#: Largest angle of one straight piece of the rim of a Siemens star; its sagitta is 4e-6 of the diameter.
_RIM_STEP_RAD = radians(0.5)


@dataclass(frozen=True)
class Piece:
    """Part of a target with one reflectance.

    Parameters
    ----------
    name : name of the part (a patch's name, ``light``, ``dark``, ``step 3``).
    reflectance : diffuse, 0 to 1.
    vertices_m : [n, 3], z = 0, m.
    faces : [m, 3], counter-clockwise as seen from +z.
    """

    name: str
    reflectance: Spectrum
    vertices_m: NDArray[np.float64]
    faces: NDArray[np.uint32]


def _piece(name: str, reflectance: Spectrum, polygons: Sequence[ArrayLike]) -> Piece:
    """Convex polygons, each [k, 2] counter-clockwise, as one mesh of triangle fans."""
    vertices: list[NDArray[np.float64]] = []
    faces: list[tuple[int, int, int]] = []
    base = 0
    for polygon in polygons:
        points = np.asarray(polygon, dtype=np.float64)
        vertices.append(np.column_stack([points, np.zeros(len(points))]))
        faces += [(base, base + k, base + k + 1) for k in range(1, len(points) - 1)]
        base += len(points)
    return Piece(name, reflectance, np.concatenate(vertices), np.array(faces, dtype=np.uint32))


def _box(x0: float, x1: float, y0: float, y1: float) -> list[tuple[float, float]]:
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]


def patch_boxes(rows: int, cols: int, width_m: float, height_m: float, fill: float) -> NDArray[np.float64]:
    """Limits x0, x1, y0, y1 of centred patches, [rows · cols, 4], m, row by row from the top left."""
    pitch_x, pitch_y = width_m / cols, height_m / rows
    row, col = (index.ravel() for index in np.mgrid[:rows, :cols])
    x = (col + 0.5) * pitch_x - width_m / 2
    y = height_m / 2 - (row + 0.5) * pitch_y
    # the smaller pitch sets one margin for all sides, so that frames between patches are equally wide
    margin = (1 - fill) / 2 * min(pitch_x, pitch_y)
    half_x, half_y = pitch_x / 2 - margin, pitch_y / 2 - margin
    return np.column_stack([x - half_x, x + half_x, y - half_y, y + half_y])


def _colorchecker(target: ColorCheckerTarget) -> list[Piece]:
    w, h = target.width_m, target.height_m
    boxes = patch_boxes(4, 6, w, h, target.patch_fill)
    chart = spectra.colorchecker(target.dataset)
    pieces = [_piece(name, chart[name], [_box(*box)]) for name, box in zip(chart, boxes, strict=True)]
    if target.patch_fill == 1:
        return pieces
    # the surround is a lattice of boxes between the patches: nothing lies behind a patch
    x = np.unique(np.concatenate([[-w / 2], np.sort(boxes[:6, :2].ravel()), [w / 2]]))
    y = np.unique(np.concatenate([[-h / 2], np.sort(boxes[::6, 2:].ravel()), [h / 2]]))
    rest = [
        _box(x[i], x[i + 1], y[j], y[j + 1])
        for i in range(len(x) - 1)
        for j in range(len(y) - 1)
        if i % 2 == 0 or j % 2 == 0
    ]
    return [*pieces, _piece("surround", target.surround.load(), rest)]


def _step_wedge(target: StepWedgeTarget) -> list[Piece]:
    edges = np.linspace(-target.width_m / 2, target.width_m / 2, target.steps + 1)
    levels = np.geomspace(target.reflectance_min, target.reflectance_max, target.steps)
    h = target.height_m / 2
    return [
        _piece(f"step {k + 1}", constant(float(level)), [_box(edges[k], edges[k + 1], -h, h)])
        for k, level in enumerate(levels)
    ]


def _checkerboard(target: CheckerboardTarget) -> list[Piece]:
    boxes = patch_boxes(target.rows, target.cols, target.width_m, target.height_m, 1.0)
    is_light = np.add.outer(np.arange(target.rows), np.arange(target.cols)).ravel() % 2 == 0
    pieces = [_piece("light", target.light.load(), [_box(*box) for box in boxes[is_light]])]
    if not is_light.all():
        pieces.append(_piece("dark", target.dark.load(), [_box(*box) for box in boxes[~is_light]]))
    return pieces


def _slanted_edge(target: SlantedEdgeTarget) -> list[Piece]:
    w, h = target.width_m / 2, target.height_m / 2
    # the edge passes through the centre, turned clockwise from the vertical: its upper end leans to the right
    lean = tan(radians(target.angle_deg))
    ends = [(x, y) for x, y in ((-lean * h, -h), (lean * h, h)) if abs(x) <= w]
    if len(ends) == 2:
        (x0, _), (x1, _) = ends
        dark = [(-w, -h), (x0, -h), (x1, h), (-w, h)]
        light = [(x0, -h), (w, -h), (w, h), (x1, h)]
    else:  # with a large tilt the edge meets the left and right sides instead
        y = w / lean
        upper, lower = [(-w, -y), (w, y), (w, h), (-w, h)], [(-w, -h), (w, -h), (w, y), (-w, -y)]
        dark, light = (upper, lower) if lean > 0 else (lower, upper)
    return [_piece("dark", target.dark.load(), [dark]), _piece("light", target.light.load(), [light])]


def _siemens_star(target: SiemensStarTarget) -> list[Piece]:
    w, h = target.width_m / 2, target.height_m / 2
    radius = min(w, h)
    sectors = 2 * target.spokes
    per_sector = max(1, int(np.ceil(2 * pi / sectors / _RIM_STEP_RAD)))
    rim_angles = np.arange(sectors * per_sector + 1) * (2 * pi / (sectors * per_sector))
    dark: list[ArrayLike] = []
    light: list[ArrayLike] = []
    for sector in range(sectors):
        angles = rim_angles[sector * per_sector : (sector + 1) * per_sector + 1]
        rim = np.column_stack([np.cos(angles), np.sin(angles)]) * radius
        # the first dark sector begins at the +x axis and runs counter-clockwise
        (dark if sector % 2 == 0 else light).append(np.vstack([[0.0, 0.0], rim]))
    corners = np.arctan2([h, h, -h, -h], [w, -w, -w, w]) % (2 * pi)
    outline = np.unique(np.concatenate([rim_angles[:-1], corners]))
    closed = np.append(outline, outline[0] + 2 * pi)
    for a, b in zip(closed[:-1], closed[1:], strict=True):
        # points between two rim points lie on the straight piece of the rim, so pieces do not overlap
        inner = [_on_rim(float(angle), rim_angles, radius) for angle in (a, b)]
        outer = [_on_rectangle(float(angle), w, h) for angle in (a, b)]
        light.append([inner[0], outer[0], outer[1], inner[1]])
    return [_piece("dark", target.dark.load(), dark), _piece("light", target.light.load(), light)]


def _on_rim(angle: float, rim_angles: NDArray, radius: float) -> tuple[float, float]:
    step = rim_angles[1] - rim_angles[0]
    middle = (np.floor(angle / step + 1e-9) + 0.5) * step
    reach = radius * cos(step / 2) / cos(angle - middle)
    return reach * cos(angle), reach * sin(angle)


def _on_rectangle(angle: float, half_width: float, half_height: float) -> tuple[float, float]:
    c, s = cos(angle), sin(angle)
    reach = min(half_width / max(abs(c), 1e-12), half_height / max(abs(s), 1e-12))
    return reach * c, reach * s


def build_target(target: TargetSpec) -> list[Piece]:
    """The pieces of a target; together they tile its rectangle exactly, without overlap."""
    if isinstance(target, FlatTarget):
        w, h = target.width_m / 2, target.height_m / 2
        return [_piece("flat", target.reflectance.load(), [_box(-w, w, -h, h)])]
    if isinstance(target, ColorCheckerTarget):
        return _colorchecker(target)
    if isinstance(target, StepWedgeTarget):
        return _step_wedge(target)
    if isinstance(target, CheckerboardTarget):
        return _checkerboard(target)
    if isinstance(target, SlantedEdgeTarget):
        return _slanted_edge(target)
    return _siemens_star(target)
