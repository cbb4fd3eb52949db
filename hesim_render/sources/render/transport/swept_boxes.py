"""Start times of rays, and boxes that contain moving objects during a window."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Mask, Ray, UInt32, Vector3
from hesim_render.sources.render.scene.tracks import DevicePose


@dataclass(frozen=True)
class Moment:
    """Start times of the rays of a kernel, per lane.

    Parameters
    ----------
    instant_us : Float, time since the begin of the ray's window, µs.
    times : Float table, `tracks` entries per window: local time of each track at the begin of the window, µs.
    tracks : number of tracks.
    window : UInt32, window of each ray.
    boxes : Float table, rows of `box_rows`: those of all groups, and what `Fleet.rows` adds.
    rows : number of rows in a bin.
    bin : UInt32, number of the set of boxes that holds for the ray's window.
    poses : poses that are known for all lanes, by the number of their track.
    """

    instant_us: Float
    times: Float
    tracks: int
    window: UInt32
    boxes: Float
    rows: int
    bin: UInt32
    poses: Mapping[int, DevicePose] = field(default_factory=dict)

    def local_us(self, track: UInt32) -> Float:
        """Time since the first keyframe of a track, µs, as `Tracks.pose` takes it."""
        kind = type(self.window)
        return dr.gather(type(self.times), self.times, self.window * self.tracks + kind(track)) + self.instant_us

    def box(self, row: UInt32) -> tuple[Vector3, Vector3]:
        """Low and high corner of the box in a row, 3-vectors, m."""
        return self.box_and_mark(row)[0]

    def box_and_mark(self, row: UInt32) -> tuple[tuple[Vector3, Vector3], Float]:
        """The box in a row, and the number that is stored beside its low corner."""
        import mitsuba as mi

        place = 2 * (self.bin * self.rows + type(self.bin)(row))
        low, high = (dr.gather(mi.Vector4f, self.boxes, place + k) for k in (0, 1))
        return (mi.Vector3f(low.x, low.y, low.z), mi.Vector3f(high.x, high.y, high.z)), low.w


def box_rows(boxes: NDArray[np.float64]) -> NDArray[np.float32]:
    """Boxes [..., 2, 3] as rows of `Moment.boxes`, [..., 8]: the low and the high corner, each padded by one number.

    The boxes are slightly widened, so that rounding does not cut a rim.
    """
    low, high = boxes[..., 0, :], boxes[..., 1, :]
    margin = 1e-4 * np.linalg.norm(high - low, axis=-1, keepdims=True)
    nothing = np.zeros((*low.shape[:-1], 1))
    return np.concatenate([low - margin, nothing, high + margin, nothing], axis=-1).astype(np.float32)


def inverse_of(direction: Vector3) -> Vector3:
    """1 / d of each coordinate for `meets_box`; kept finite, because 0 · ∞ is undefined."""
    return dr.rcp(dr.select(abs(direction) < 1e-30, 1e-30, direction))


def meets_box(ray: Ray, inverse: Vector3, length: Float, box: tuple[Vector3, Vector3]) -> Mask:
    """Whether the first `length` metres of a ray meet a box; `inverse` is `inverse_of` its direction."""
    one, other = (box[0] - ray.o) * inverse, (box[1] - ray.o) * inverse
    # not dr.minimum and dr.maximum: their handling of NaN takes most of the time
    ordered = one < other
    near, far = dr.select(ordered, one, other), dr.select(ordered, other, one)
    enter, leave = near.x, far.x
    for axis in ("y", "z"):
        first, last = getattr(near, axis), getattr(far, axis)
        enter, leave = dr.select(first > enter, first, enter), dr.select(last < leave, last, leave)
    return (enter <= leave) & (leave >= 0) & (enter <= length)
