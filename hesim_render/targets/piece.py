"""Parts of a target, each of one reflectance or one picture, and the polygons that they are made of."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi, sin, sqrt
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import MOST_PIXELS
from hesim_render.spectral.spectrum import Spectrum

#: Corners of the polygon of a disc. Its area is that of the disc, and its rim departs from the circle by 1.5e-4 of
#: the radius at most.
DISC_CORNERS = 144


@dataclass(frozen=True, eq=False)
class Picture:
    """A reflectance that depends on the place.

    Parameters
    ----------
    values : float32 [row, col, channel], row 0 at the top.
    kind : ``grey``: one channel, the same at all wavelengths; ``srgb``: three channels of linear sRGB, which the
        renderer turns into spectra; ``spectral``: a channel for each of `wavelength_nm`, linear between them.
    wavelength_nm : [channel] of a spectral picture, increasing.
    interpolation : between texels.
    """

    values: NDArray[np.float32]
    kind: Literal["grey", "srgb", "spectral"]
    wavelength_nm: NDArray[np.float64] | None = None
    interpolation: Literal["bilinear", "nearest"] = "bilinear"


@dataclass(frozen=True, eq=False)
class TargetPiece:
    """Part of a target with one reflectance, or with a picture.

    Parameters
    ----------
    name : name of the part (a patch's name, ``light``, ``dark``, ``step 3``).
    reflectance : diffuse, 0 to 1.
    vertices_m : [n, 3], z = 0 unless the target is bent, m.
    faces : [m, 3], counter-clockwise as seen from +z.
    uv : [n, 2] of a picture: (0, 0) is its lower left corner, (1, 1) its upper right one.
    radiance : of a part that shines, W m⁻² sr⁻¹ nm⁻¹.
    """

    name: str
    reflectance: Spectrum | Picture
    vertices_m: NDArray[np.float64]
    faces: NDArray[np.uint32]
    uv: NDArray[np.float64] | None = None
    radiance: Spectrum | None = None


def polygons_piece(
    name: str, reflectance: Spectrum, polygons: Sequence[ArrayLike], radiance: Spectrum | None = None
) -> TargetPiece:
    """Convex polygons, each [k, 2] counter-clockwise, as one mesh of triangle fans."""
    vertices: list[NDArray[np.float64]] = []
    faces: list[tuple[int, int, int]] = []
    base = 0
    for polygon in polygons:
        points = np.asarray(polygon, dtype=np.float64)
        vertices.append(np.column_stack([points, np.zeros(len(points))]))
        faces += [(base, base + k, base + k + 1) for k in range(1, len(points) - 1)]
        base += len(points)
    return TargetPiece(name, reflectance, np.concatenate(vertices), np.array(faces, dtype=np.uint32), radiance=radiance)


def picture_piece(
    name: str,
    picture: Picture,
    width_m: float,
    height_m: float,
    uv: tuple[float, float, float, float] = (0.0, 1.0, 0.0, 1.0),
) -> TargetPiece:
    """A picture on a rectangle; `uv` are the u of its left and right side and the v of its lower and upper one."""
    u0, u1, v0, v1 = uv
    corners = np.array(box(-width_m / 2, width_m / 2, -height_m / 2, height_m / 2))
    return TargetPiece(
        name,
        picture,
        np.column_stack([corners, np.zeros(4)]),
        np.array([[0, 1, 2], [0, 2, 3]], dtype=np.uint32),
        np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]]),
    )


def require_texels(rows: int, cols: int, key: str) -> None:
    """Refuse a drawn picture of more texels than the largest frame has pixels.

    Raises
    ------
    SpecError
        If it has.
    """
    if rows * cols > MOST_PIXELS:
        raise SpecError(f"the picture would have {cols:.3g} x {rows:.3g} texels, more than {MOST_PIXELS:.3g}", key=key)


def box(x0: float, x1: float, y0: float, y1: float) -> list[tuple[float, float]]:
    """Corners of a rectangle, counter-clockwise."""
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


def between_patches(boxes: NDArray[np.float64], cols: int, width_m: float, height_m: float) -> list[ArrayLike]:
    """Boxes of the lattice around patches from `patch_boxes`: nothing lies behind a patch."""
    w, h = width_m / 2, height_m / 2
    # borders of patches and of the target cut it into a lattice, in which every second cell of both axes is a patch
    x = np.unique(np.concatenate([[-w], np.sort(boxes[:cols, :2].ravel()), [w]]))
    y = np.unique(np.concatenate([[-h], np.sort(boxes[::cols, 2:].ravel()), [h]]))
    return [
        box(x[i], x[i + 1], y[j], y[j + 1])
        for i in range(len(x) - 1)
        for j in range(len(y) - 1)
        if i % 2 == 0 or j % 2 == 0
    ]


def disc(radius_m: float) -> NDArray[np.float64]:
    """A regular polygon about the origin with the area of a disc, [DISC_CORNERS, 2], m."""
    step = 2 * pi / DISC_CORNERS
    angle = np.arange(DISC_CORNERS) * step
    return radius_m * sqrt(step / sin(step)) * np.column_stack([np.cos(angle), np.sin(angle)])


def around(hole: NDArray[np.float64], x0: float, x1: float, y0: float, y1: float) -> list[ArrayLike]:
    """Convex polygons that fill a rectangle except for a convex polygon in it.

    Parameters
    ----------
    hole : [k, 2], counter-clockwise, with the origin inside.
    x0, x1, y0, y1 : limits of the rectangle, which contains the hole.
    """
    rectangle = np.array(box(x0, x1, y0, y1))
    # sectors between the directions of all corners: in each, hole and rectangle have one straight side
    outline = np.concatenate([hole, rectangle])
    angles = np.unique(np.round(np.arctan2(outline[:, 1], outline[:, 0]), 12))
    ends = np.append(angles, angles[0] + 2 * pi)
    inner, outer = _reach(hole, ends), _reach(rectangle, ends)
    return [np.array([inner[k], outer[k], outer[k + 1], inner[k + 1]]) for k in range(len(angles))]


def _reach(polygon: NDArray[np.float64], angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points of a convex polygon's rim in directions from the origin, which is inside; [n, 2]."""
    following = np.roll(polygon, -1, axis=0)
    normal = np.column_stack([following[:, 1] - polygon[:, 1], polygon[:, 0] - following[:, 0]])
    direction = np.column_stack([np.cos(angles), np.sin(angles)])
    # a ray leaves at the first of the lines that it comes nearer to
    away = np.sum(normal * polygon, axis=1)
    speed = direction @ normal.T
    length = np.min(np.where(speed > 0, away / np.where(speed > 0, speed, 1.0), np.inf), axis=1)
    return direction * length[:, None]


def cells(dark: NDArray[np.bool_], x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[list, list]:
    """Boxes of the light and of the dark cells of a lattice, where neighbours of a row are joined.

    Parameters
    ----------
    dark : [row, col], row 0 at the top.
    x, y : limits of the columns, increasing, [cols + 1], and of the rows, decreasing, [rows + 1], m.
    """
    result: tuple[list, list] = ([], [])
    for row, values in enumerate(dark):
        ends = np.concatenate([[0], np.flatnonzero(np.diff(values)) + 1, [len(values)]])
        for first, last in zip(ends[:-1], ends[1:], strict=True):
            result[int(values[first])].append(box(x[first], x[last], y[row + 1], y[row]))
    return result


def bent(piece: TargetPiece, radius_m: float, step_m: float) -> TargetPiece:
    """A piece on a cylinder about an axis parallel to y; lengths along the surface stay.

    Triangles are cut at lines of equal x, `step_m` apart, and each part is flat.

    Parameters
    ----------
    piece : flat, z = 0.
    radius_m : of the cylinder; above 0 the sides come nearer to a viewer at +z.
    step_m : width of the flat strips.
    """
    uv = np.zeros((len(piece.vertices_m), 2)) if piece.uv is None else piece.uv
    corners = np.concatenate([piece.vertices_m[:, :2], uv], axis=1)[piece.faces.astype(int)]
    parts: list[NDArray[np.float64]] = []
    for triangle in corners:
        low, high = np.floor(triangle[:, 0].min() / step_m), np.ceil(triangle[:, 0].max() / step_m)
        for k in range(int(low), int(high)):
            # the part of the triangle between two lines, as a fan of triangles
            part = clipped(triangle, triangle[:, 0] - k * step_m)
            part = clipped(part, (k + 1) * step_m - part[:, 0])
            parts += [part[[0, j, j + 1]] for j in range(1, len(part) - 1)]
    flat = np.concatenate(parts)
    vertices = on_cylinder(flat[:, :2], radius_m)
    faces = np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)
    own_uv = None if piece.uv is None else flat[:, 2:]
    return TargetPiece(piece.name, piece.reflectance, vertices, faces, own_uv, piece.radiance)


def on_cylinder(flat: NDArray[np.float64], radius_m: float) -> NDArray[np.float64]:
    """Points [n, 2] of a flat target on a cylinder about an axis parallel to y, [n, 3], m; see `bent`."""
    angle = flat[:, 0] / radius_m
    return np.column_stack([radius_m * np.sin(angle), flat[:, 1], radius_m * (1 - np.cos(angle))])


def clipped(polygon: NDArray[np.float64], height: NDArray[np.float64]) -> NDArray[np.float64]:
    """The part of a convex polygon [k, n] in which a linear function, `height` at its corners [k], is not negative."""
    kept: list[NDArray[np.float64]] = []
    for i in range(len(polygon)):
        j = (i + 1) % len(polygon)
        if height[i] >= 0:
            kept.append(polygon[i])
        if height[i] * height[j] < 0:
            kept.append(polygon[i] + (polygon[j] - polygon[i]) * (height[i] / (height[i] - height[j])))
    return np.array(kept).reshape(-1, polygon.shape[1])
