"""Sheets: triangles in one plane, of one mesh or of several. Test targets are made of them.

A ray meets the plane once. A grid on the plane then names the few triangles that may hold the point, which are tested
within the kernel. This pays where triangles are long and thin and lie askew, as the spokes of a star: boxes around them
overlap, so that a tree of boxes excludes little.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import log2

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device import dr
from hesim_render.core.device_types import Bands, Float, Mask, MitsubaModule, MitsubaObject, Point2, Ray, UInt32
from hesim_render.core.host_arrays import from_host
from hesim_render.sources.render.scene.mitsuba_version import mesh_faces, mesh_vertices
from hesim_render.sources.render.transport.intersections import to_face

#: Largest number of triangles of all sheets of a part, and of planes.
_MOST_TRIANGLES, _MOST_PLANES = 1 << 16, 3
#: Largest distance of a corner from its plane, and width of the seam that is closed between two triangles, over the
#: largest coordinate: what float32 rounds.
_ROUNDING, _SEAM = 2e-6, 2e-7
#: Areas of the boxes around all triangles over that of their plane, from which a grid pays: at 26 and 35 (stars), rays
#: took 0.8 times as long as with Embree, at 14 (discs) as long, at 2 (boards, charts) 1.1 to 1.2 times as long.
_LEAST_CROWDED = 20.0
#: Cells per triangle of a grid, about, and how often its sides are halved, at most.
_CELLS, _MOST_HALVINGS = 16, 8
#: Barycentric coordinates of places in a triangle at which others are looked for, and seams by which they lie inside.
_INSIDE = np.array([[1, 1, 1], [6, 1, 1], [1, 6, 1], [1, 1, 6], [5, 5, 1], [5, 1, 5], [1, 5, 5]], np.float64)
_INSIDE /= _INSIDE.sum(axis=1, keepdims=True)
_CLEAR = 10.0
#: Part of a cell that may be open where triangles cover it.
_WHOLE = 1e-6
#: Numbers of a row: those that map a place on the sheet to its distances from the three sides of a triangle, m; the
#: triangle; and the inverse distances of its second and third corner from the sides opposite to them.
_ROW = 12


@dataclass(frozen=True)
class Sheet:
    """Triangles in one plane.

    Parameters
    ----------
    corners : [n, 3, 3], m.
    owner : [n, 2], number of the mesh and of the triangle in it.
    """

    corners: NDArray[np.float64]
    owner: NDArray[np.uint32]

    @property
    def seam_m(self) -> float:
        """Width of the seam that is closed between two triangles."""
        return _SEAM * float(np.abs(self.corners).max())

    @property
    def halvings(self) -> int:
        """How often the sides of the grid are halved."""
        return min(round(log2(_CELLS * len(self.corners)) / 2), _MOST_HALVINGS)

    @cached_property
    def frame(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """See `_frame`."""
        return _frame(self.corners)

    @cached_property
    def cells(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """See `_cells`."""
        return _cells(self.frame[1], self.halvings)

    @property
    def cell_rows(self) -> NDArray[np.uint32]:
        """First and end of the rows of each cell, [cells, 2]; the end counts twice, plus 1 if triangles cover the cell.
        Of a cell within one triangle, both are the row of that one.
        """
        (first, triangle), side = self.cells, 2**self.halvings
        of_cell = np.repeat(np.arange(first.size - 1), np.diff(first))
        row, col = np.divmod(of_cell, side)
        parts = _parts(self.frame[1][triangle] * side - np.stack([col, row], axis=1)[:, None])
        rows = np.stack([first[:-1], 2 * first[1:]], axis=1)
        # a sum above 1 would be of triangles that overlap, which may hide a hole
        rows[:, 1] += abs(np.bincount(of_cell, parts, first.size - 1) - 1) <= _WHOLE
        alone = np.flatnonzero(parts >= 1 - _WHOLE)
        rows[of_cell[alone]] = np.stack([alone, 2 * alone + 1], axis=1)
        return rows.astype(np.uint32)

    @cached_property
    def distances(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """See `_distances`."""
        return _distances(self.frame[1], self.frame[0])

    @property
    def overlaps(self) -> bool:
        """True if some places of a triangle lie on another one too: which is in front, rounding would decide."""
        (_, uv), (first, triangle), (maps, _) = self.frame, self.cells, self.distances
        # some places inside of each triangle, [place, 2], and the rows of the cell of each
        places = np.einsum("pc,nck->npk", _INSIDE, uv).reshape(-1, 2)
        own, side = np.repeat(np.arange(len(uv)), len(_INSIDE)), 2**self.halvings
        col, row = np.minimum((places * side).astype(np.int64), side - 1).T
        begin, end = first[row * side + col], first[row * side + col + 1]
        which = np.repeat(np.arange(len(places)), end - begin)
        rows = np.arange(which.size) + np.repeat(begin - np.cumsum(end - begin) + end - begin, end - begin)
        other = triangle[rows]
        margin = np.einsum("nik,nk->ni", maps[other], np.append(places, np.ones((len(places), 1)), axis=1)[which])
        return bool(((other != own[which]) & (margin.min(axis=1) > _CLEAR * self.seam_m)).any())


def sheets_of(shapes: Sequence[MitsubaObject]) -> list[Sheet]:
    """The planes in which all triangles of some meshes lie; none if there are too many, triangles overlap, or Embree is
    as fast.

    Parameters
    ----------
    shapes : meshes.
    """
    counts = [shape.face_count() for shape in shapes]
    if not counts or sum(counts) > _MOST_TRIANGLES:
        return []
    corners = np.concatenate([mesh_vertices(shape)[mesh_faces(shape)] for shape in shapes]).astype(np.float64)
    owner = np.stack(
        [np.repeat(np.arange(len(counts)), counts), np.concatenate([np.arange(count) for count in counts])], axis=1
    )
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    most_m, out = _ROUNDING * float(np.abs(corners).max()), list[Sheet]()
    # a triangle without an area is hit by no ray
    left = areas > most_m**2
    while left.any():
        if len(out) == _MOST_PLANES:
            return []
        # the plane of the largest triangle, whose normal is known best
        seed = int(np.argmax(np.where(left, areas, 0)))
        heights = (corners - corners[seed, 0]) @ (normals[seed] / areas[seed])
        own = left & (np.abs(heights).max(axis=1) <= most_m)
        out.append(Sheet(corners[own], owner[own].astype(np.uint32)))
        left &= ~own
    pays = any(np.ptp(sheet.frame[1], axis=1).prod(axis=1).sum() >= _LEAST_CROWDED for sheet in out)
    return out if pays and not any(sheet.overlaps for sheet in out) else []


class DeviceSheet:
    """A sheet on the device.

    Parameters
    ----------
    mi : the mitsuba module.
    sheet : the triangles.
    shapes : the meshes.
    """

    def __init__(self, mi: MitsubaModule, sheet: Sheet, shapes: Sequence[MitsubaObject]) -> None:
        self._mi = mi
        self._rows = [(mi.Vector3f(row[:3]), mi.Float(float(row[3]))) for row in sheet.frame[0]]
        (_, triangle), (maps, per_m) = sheet.cells, sheet.distances
        rows = np.zeros((triangle.size + 1, _ROW), np.float32)
        rows[:-1, :9], rows[:-1, 10:] = maps[triangle].reshape(-1, 9), per_m[triangle, 1:]
        rows[:-1, 9] = triangle.astype(np.uint32).view(np.float32)
        pointers: list[UInt32] = [dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape)) for shape in shapes]
        numbers = [int(pointer[0]) for pointer in pointers]
        self._cells, self._triangles = from_host(mi.UInt32, sheet.cell_rows), from_host(mi.Float, rows)
        self._shape = from_host(mi.UInt32, np.array(numbers, np.uint32)[sheet.owner[:, 0]])
        self._prim = from_host(mi.UInt32, sheet.owner[:, 1])
        self._side, self._seam = mi.UInt32(2**sheet.halvings), mi.Float(sheet.seam_m)
        dr.make_opaque(self._rows, self._side, self._seam)

    def meet(self, ray: Ray, active: Mask) -> tuple[Float, Mask, Point2, UInt32]:
        """Where rays meet the plane, before `maxt`, and the triangle there.

        Returns
        -------
        t : distance, m.
        is_met : True where a triangle is met.
        place : barycentric coordinates of its second and third corner.
        triangle : its number.
        """
        mi = self._mi
        t, place, cell, last, covered = self._start(ray, active)

        def step(row: UInt32, most: Float, own: UInt32) -> tuple[UInt32, Float, UInt32]:
            margin, *_ = self._inside(row, place)
            is_better = margin > most
            return row + 1, dr.select(is_better, margin, most), dr.select(is_better, row, own)

        # at a seam, the triangle that holds the point, or comes nearest to it
        _, margin, row = dr.while_loop(
            # a cell within one triangle has no rows to choose from
            (cell, dr.select(covered & (cell == last), mi.Float(dr.inf), -self._seam), mi.UInt32(cell)),
            lambda row, *_: row < last,
            step,
            labels=("row", "margin", "own"),
            label="sheet",
        )
        is_met = margin > -self._seam
        _, second, third, rest = self._inside(row, place, is_met)
        triangle: UInt32 = dr.reinterpret_array(mi.UInt32, rest.y)
        return t, is_met, mi.Point2f(second * rest.z, third * rest.w), triangle

    def owner(self, triangle: UInt32, active: Mask) -> tuple[MitsubaObject, UInt32]:
        """Shape of a triangle, and its number there."""
        shape = dr.gather(self._mi.UInt32, self._shape, triangle, active)
        return dr.reinterpret_array(self._mi.ShapePtr, shape), dr.gather(self._mi.UInt32, self._prim, triangle, active)

    def blocks(self, ray: Ray, active: Mask) -> Mask:
        """True where a triangle is met before `maxt`."""
        _, place, cell, last, covered = self._start(ray, active)

        def step(row: UInt32, is_met: Mask) -> tuple[UInt32, Mask]:
            return row + 1, is_met | (self._inside(row, place)[0] > -self._seam)

        _, is_met = dr.while_loop(
            (cell, covered),
            lambda row, is_met: (row < last) & ~is_met,
            step,
            labels=("row", "is_met"),
            label="sheet",
        )
        blocked: Mask = is_met
        return blocked

    def _start(self, ray: Ray, active: Mask) -> tuple[Float, Point2, UInt32, UInt32, Mask]:
        """Distance to the plane, the place there, begin and end of the rows of its cell, and whether it is covered."""
        mi = self._mi
        t, place, inside = to_face(ray, self._rows)
        active = active & inside & (t >= 0) & (t < ray.maxt)
        col, row = (dr.minimum(mi.UInt32(at * mi.Float(self._side)), self._side - 1) for at in place)
        begin, end = dr.gather(mi.Array2u, self._cells, row * self._side + col, active)
        return t, place, begin, end >> 1, (end & 1) != 0

    def _inside(self, row: UInt32, place: Point2, active: Mask | bool = True) -> tuple[Float, Float, Float, Bands]:
        """Least distance of a place from the sides of the triangle of a row, m, positive inside; those from the sides
        opposite to its second and third corner; and the last numbers of the row.
        """
        mi = self._mi
        one, two, rest = (dr.gather(mi.Vector4f, self._triangles, 3 * row + part, mi.Bool(active)) for part in range(3))
        first = dr.fma(one.x, place.x, dr.fma(one.y, place.y, one.z))
        second = dr.fma(one.w, place.x, dr.fma(two.x, place.y, two.y))
        third = dr.fma(two.z, place.x, dr.fma(two.w, place.y, rest.x))
        return dr.minimum(first, dr.minimum(second, third)), second, third, rest


def _frame(corners: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Map [3, 4] of a point to its place on the smallest rectangle around the triangles, 0 to 1 in u and v, and its
    height, m; and the places of the corners, [n, 3, 2].
    """
    sides = corners[:, 1:] - corners[:, :1]
    normals = np.cross(sides[:, 0], sides[:, 1])
    largest = int(np.argmax(np.linalg.norm(normals, axis=1)))
    normal = normals[largest] / np.linalg.norm(normals[largest])
    along = sides[largest, 0] / np.linalg.norm(sides[largest, 0])
    axes = np.stack([along, np.cross(normal, along), normal])
    points = corners.reshape(-1, 3) @ axes.T
    low, high = points.min(axis=0), points.max(axis=0)
    size = high - low
    # the height is not scaled; it is counted from the middle of what rounding has made of the plane
    origin, size = np.append(low[:2], points[:, 2].mean()), np.append(size[:2], 1.0)
    to_uvh = np.concatenate([axes, -origin[:, None]], axis=1) / size[:, None]
    return to_uvh, ((points - origin) / size)[:, :2].reshape(-1, 3, 2)


def _distances(uv: NDArray[np.float64], to_uvh: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Maps of a place (u, v, 1) to its distances from the sides opposite to the three corners, m, [n, 3, 3]; and the
    inverse distances of the corners themselves, [n, 3].
    """
    # barycentric coordinates are 1 at their own corner and 0 at both others
    coordinates = np.linalg.inv(np.concatenate([uv, np.ones((len(uv), 3, 1))], axis=2)).transpose(0, 2, 1)
    # their slopes, which are the inverse distances of the corners
    slopes = coordinates[..., :2] * np.linalg.norm(to_uvh[:2, :3], axis=1)
    per_m = np.linalg.norm(slopes, axis=2)
    return coordinates / per_m[..., None], per_m


def _cells(uv: NDArray[np.float64], halvings: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Triangles that touch each cell of a grid of 2^halvings cells a side: place of the first one of each cell, [cells
    + 1], and their numbers, cell by cell.
    """
    # rounding on the device may move a point into the next cell
    margin = 1e-4
    low, high, along = uv.min(axis=1), uv.max(axis=1), np.roll(uv, -1, axis=1) - uv
    turn = np.sign(along[:, 0, 0] * along[:, 1, 1] - along[:, 0, 1] * along[:, 1, 0])
    # the inside of side k of a triangle is where normal · place is at least its bound
    normals = np.stack([-along[..., 1], along[..., 0]], axis=2) * turn[:, None, None]
    bounds = (normals * uv).sum(axis=2)
    triangle, cell = np.arange(len(uv)), np.zeros((len(uv), 2))
    quarters = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
    for halving in range(1, halvings + 1):
        # the quarters of each cell that is touched, in units of their own size
        triangle, cell, cells = np.repeat(triangle, 4), (2 * cell[:, None] + quarters).reshape(-1, 2), 2**halving
        keep = ((high[triangle] * cells >= cell - margin) & (low[triangle] * cells <= cell + 1 + margin)).all(axis=1)
        for side in range(3):
            normal = normals[triangle, side]
            # the corner of the cell that lies farthest inside
            farthest = cell + np.where(normal > 0, 1 + margin, -margin)
            keep &= (farthest * normal).sum(axis=1) >= bounds[triangle, side] * cells
        triangle, cell = triangle[keep], cell[keep]
    number = (cell[:, 1] * 2**halvings + cell[:, 0]).astype(np.int64)
    order = np.argsort(number, kind="stable")
    ends = np.cumsum(np.bincount(number, minlength=4**halvings))
    return np.append(0, ends), triangle[order]


def _parts(triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Areas of triangles [n, 3, 2] within the square from 0 to 1."""
    (x, y), (along_x, along_y) = (
        np.moveaxis(each, 2, 0) for each in (triangles, np.roll(triangles, -1, 1) - triangles)
    )
    # the part of each side that lies over the square
    begin, end = np.clip(x, 0, 1), np.clip(x + along_x, 0, 1)
    slope = np.divide(along_y, along_x, out=np.zeros_like(x), where=along_x != 0)
    low, high = y + slope * (begin - x), y + slope * (end - x)
    # mean height of the side there, no less than 0 and no more than 1, by the integral of heights cut like this
    cut_low, cut_high = np.clip(low, 0, 1), np.clip(high, 0, 1)
    areas = [0.5 * np.square(cut) + np.maximum(height - 1, 0) for cut, height in ((cut_low, low), (cut_high, high))]
    is_steep = abs(high - low) > 1e-9
    mean = np.divide(areas[1] - areas[0], high - low, out=0.5 * (cut_low + cut_high), where=is_steep)
    # below two sides of a triangle is what is below the third one, and the triangle
    return np.asarray(abs(((end - begin) * mean).sum(axis=1)))
