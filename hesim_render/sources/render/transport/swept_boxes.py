"""When rays set out, and the boxes that hold what moves meanwhile."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device_types import Float, Mask, Ray, UInt32, Vector3


@dataclass(frozen=True)
class Moment:
    """When the rays of a kernel set out, per lane.

    Parameters
    ----------
    instant_us : Float, since the begin of the ray's window.
    times : Float table, `tracks` entries a window: local time of each track at its begin, µs; `window`, UInt32, which.
    boxes : Float table, 8 entries a group: low and high corner of the box that holds it, each with a number that means
        nothing; `bin`, UInt32, whose boxes hold for the ray's window, and `groups` of a bin.
    """

    instant_us: Float
    times: Float
    tracks: int
    window: UInt32
    boxes: Float
    groups: int
    bin: UInt32

    def local_us(self, track: UInt32) -> Float:
        """Time since a track's first keyframe, as `Tracks.pose` takes it."""
        import drjit as dr

        kind = type(self.window)
        return dr.gather(type(self.times), self.times, self.window * self.tracks + kind(track)) + self.instant_us

    def box(self, group: UInt32) -> tuple[Vector3, Vector3]:
        """Low and high corner, 3-vectors."""
        import drjit as dr
        import mitsuba as mi

        place = 2 * (self.bin * self.groups + type(self.bin)(group))
        low, high = (dr.gather(mi.Vector4f, self.boxes, place + k) for k in (0, 1))
        return mi.Vector3f(low.x, low.y, low.z), mi.Vector3f(high.x, high.y, high.z)


def box_rows(boxes: NDArray[np.float64]) -> NDArray[np.float32]:
    """Boxes [..., 2, 3] as `Moment` has them, [..., 8], somewhat widened: rounding must not take a rim."""
    low, high = boxes[..., 0, :], boxes[..., 1, :]
    margin = 1e-4 * np.linalg.norm(high - low, axis=-1, keepdims=True)
    nothing = np.zeros((*low.shape[:-1], 1))
    return np.concatenate([low - margin, nothing, high + margin, nothing], axis=-1).astype(np.float32)


def inverse_of(direction: Vector3) -> Vector3:
    """1 / d of each coordinate for `meets_box`; finite, for 0 · ∞ is nowhere."""
    import drjit as dr

    return dr.rcp(dr.select(abs(direction) < 1e-30, 1e-30, direction))


def meets_box(ray: Ray, inverse: Vector3, length: Float, box: tuple[Vector3, Vector3]) -> Mask:
    """Whether the first `length` metres of a ray meet a box; `inverse` is `inverse_of` its direction."""
    import drjit as dr

    one, other = (box[0] - ray.o) * inverse, (box[1] - ray.o) * inverse
    # not dr.minimum and dr.maximum: what those do about NaN takes most of the time
    ordered = one < other
    near, far = dr.select(ordered, one, other), dr.select(ordered, other, one)
    enter, leave = near.x, far.x
    for axis in ("y", "z"):
        first, last = getattr(near, axis), getattr(far, axis)
        enter, leave = dr.select(first > enter, first, enter), dr.select(last < leave, last, leave)
    return (enter <= leave) & (leave >= 0) & (enter <= length)
