"""Keyframed rigid poses on the device, per lane, for several tracks."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Mask, Point3, UInt32, Vector3
from hesim_render.core.host_arrays import from_host

if TYPE_CHECKING:
    from hesim_render.sources.render.scene.trajectory import Trajectory


@dataclass(frozen=True)
class DevicePose:
    """Rigid poses, one per lane: x → R x + shift; `columns` are those of R."""

    columns: tuple[Vector3, Vector3, Vector3]
    shift: Vector3

    @classmethod
    def about(cls, w: Float, v: Vector3, pivot: Point3, shift: Vector3) -> "DevicePose":
        """x → R (x − pivot) + pivot + shift, R from the unit quaternion (w, v)."""
        x, y, z = v
        vector = type(v)
        rest = cls(
            (
                vector(1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
                vector(2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
                vector(2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
            ),
            dr.zeros(vector),
        )
        return cls(rest.columns, shift + pivot - rest.turn_to_world(pivot))

    @classmethod
    def none(cls, vector: type[Vector3]) -> "DevicePose":
        """The identity."""
        return cls((vector(1, 0, 0), vector(0, 1, 0), vector(0, 0, 1)), dr.zeros(vector))

    def where(self, condition: Mask, other: "DevicePose") -> "DevicePose":
        """This pose in lanes where a condition holds, `other` in the rest."""
        columns = (dr.select(condition, a, b) for a, b in zip(self.columns, other.columns, strict=True))
        return DevicePose(tuple(columns), dr.select(condition, self.shift, other.shift))

    def turn_to_world(self, direction: Vector3) -> Vector3:
        (x, y, z), (first, second, third) = direction, self.columns
        return dr.fma(first, x, dr.fma(second, y, third * z))

    def to_world(self, point: Point3) -> Point3:
        (x, y, z), (first, second, third) = point, self.columns
        return dr.fma(first, x, dr.fma(second, y, dr.fma(third, z, self.shift)))

    def turn_to_rest(self, direction: Vector3) -> Vector3:
        vector = type(self.shift)
        return vector(*(dr.dot(column, vector(direction)) for column in self.columns))

    def to_rest(self, point: Point3) -> Point3:
        return self.turn_to_rest(type(self.shift)(point) - self.shift)


class Tracks:
    """Tracks of several objects in tables, so that one kernel serves any number of them."""

    def __init__(self, trajectories: "Sequence[Trajectory]") -> None:
        types = jit()
        rows: list[NDArray[np.float64]] = []
        times: list[NDArray[np.float64]] = []
        heads: list[list[float]] = []
        for track in trajectories:
            knots = track.knots_us - track.knots_us[0]
            heads.append(
                [
                    sum(t.size for t in times),
                    sum(len(row) for row in rows),
                    knots.size,
                    knots[-1],
                    track.repeat,
                    *track.pivot_m,
                ]
            )
            # one row per segment, fetched as four packets of four: gathers of single numbers cost more than the poses
            columns = [
                *(knots[:-1, None], 1 / np.diff(knots)[:, None], track.arc_rad[:, None] / 2, track.arc_axis),
                *(track.start_rotation, track.translation_m[:-1], np.diff(track.translation_m, axis=0)),
            ]
            rows.append(np.hstack(columns))
            times.append(knots)
        self._heads, self._rows, self._times = (
            from_host(types.Float, np.concatenate(values)) for values in (heads, rows, times)
        )
        #: Cells of equal length of each track, two for each segment, of which a table has the first segment.
        self._cells = 2 << max(0, max(map(len, rows)) - 1).bit_length()
        # what rounding may move a time by, in cells
        margin = max(0.01, 2.0**-22 * self._cells)
        first, last = (np.stack([self._segments(knots, shift) for knots in times]) for shift in (-margin, 1 + margin))
        self._first = from_host(types.UInt32, first)
        #: Largest number of segments that begin in a cell; rounded so that similar tracks share a kernel.
        self._most = (1 << int((last - first).max()).bit_length()) - 1
        dr.make_opaque(self._heads, self._rows, self._times, self._first)

    def _segments(self, knots: NDArray[np.float64], shift: float) -> NDArray[np.int64]:
        """Segment of each cell of a track at a place in it, in cells from its begin."""
        at = (np.arange(self._cells) + shift) / self._cells * knots[-1]
        segment = np.searchsorted(np.float32(knots), np.float32(at), side="right") - 1
        return np.asarray(np.clip(segment, 0, knots.size - 2))

    def pose(self, number: UInt32, local_us: Float) -> DevicePose:
        """Pose of every lane at its own time.

        Parameters
        ----------
        number : number of its track, an integer or UInt32.
        local_us : Float, time since that track's first keyframe, µs, see `Trajectory.pose_at`.
        """
        types = jit()
        number = types.UInt32(number)
        first_time, first_row, knots, period = dr.gather(types.Array4f, self._heads, 2 * number)
        repeat, *pivot = dr.gather(types.Array4f, self._heads, 2 * number + 1)
        wrapped = local_us - period * dr.floor(local_us / period)
        local_us = dr.select((repeat > 0) & (local_us >= period), wrapped, local_us)
        local_us = dr.clip(local_us, 0, period)
        place = types.UInt32(first_row)
        # a track of one segment has nothing to search for
        if self._most:
            last, base = types.UInt32(knots) - 2, types.UInt32(first_time)
            cell = dr.minimum(types.UInt32(local_us * (self._cells / period)), self._cells - 1)
            first = dr.gather(types.UInt32, self._first, number * self._cells + cell)

            def is_later(further: UInt32) -> Mask:
                """Whether the time is beyond the segment so many after the first one of its cell."""
                end = base + dr.minimum(first + types.UInt32(further) + 1, last)
                return dr.gather(types.Float, self._times, end) <= local_us

            place += dr.minimum(first + types.UInt32(dr.binary_search(0, self._most, is_later)), last)
        row = [x for k in range(4) for x in dr.gather(types.Array4f, self._rows, 4 * place + k)]
        share = (local_us - row[0]) * row[1]
        sine, cosine = dr.sincos(share * row[2])
        vector = types.Array3f
        turn_v = vector(*row[3:6]) * sine
        base_w, base_v = row[6], vector(*row[7:10])
        return DevicePose.about(
            w=cosine * base_w - dr.dot(turn_v, base_v),
            v=cosine * base_v + base_w * turn_v + dr.cross(turn_v, base_v),
            pivot=vector(*pivot),
            shift=dr.fma(vector(*row[13:16]), share, vector(*row[10:13])),
        )
