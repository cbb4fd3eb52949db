"""A scene in which every ray has a time of its own: what moves rests in a scene of its own, and rays go to it.

Mitsuba has no animated transforms, and setting a pose costs a rebuild. Here a ray is turned into each
moving object's own frame at the ray's own time, met with the object at rest, and the nearest hit of all
frames is turned back. Any number of instants is then one kernel, motion within an exposure is exact, and
nothing is rebuilt or recompiled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.errors import SpecError
from hesim_render.renderer.builder import BuiltScene
from hesim_render.renderer.parts import Part
from hesim_render.renderer.trajectory import DevicePose, Trajectory


class NeedsExactMode(SpecError):
    """A scene that paths between resting and rigidly moving surfaces do not describe."""


@dataclass(frozen=True)
class Group:
    """Shapes that move together.

    Parameters
    ----------
    name : of the object.
    part : they themselves, at rest.
    trajectory : how they move.
    corners : bounding-box corners at rest, [n, 3], m.
    """

    name: str
    part: Part
    trajectory: Trajectory
    corners: NDArray[np.float64]

    def swept_box(self, begin_us: float, end_us: float, steps: int = 16) -> NDArray[np.float64]:
        """Axis-parallel box around every place the group takes within an interval, [2, 3], m."""
        times = np.linspace(begin_us, end_us, steps + 1)
        poses = self.trajectory.matrix(times)
        points = self.corners @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
        # between two steps a corner leaves their chord by less than the chord's own length
        margin = np.linalg.norm(np.diff(points, axis=0), axis=-1).max(initial=0.0) / 2 + 1e-6
        return np.stack([points.min(axis=(0, 1)) - margin, points.max(axis=(0, 1)) + margin])


class MovingScene:
    """The parts of a built scene: what rests, with all light, and each group that moves.

    Parameters
    ----------
    built : from `build`, its moving shapes anywhere.

    Raises
    ------
    NeedsExactMode
        If a moving shape emits light, the scene's integrator is not Mitsuba's path tracer, or it hides lights.
    """

    def __init__(self, built: BuiltScene) -> None:
        mi = built.mi
        if not path_traced(built):
            name = built.integrator.class_name()
            raise NeedsExactMode(f"integrator {name!r} follows more than paths between surfaces")
        if built.integrator.hide_emitters:
            raise NeedsExactMode("the integrator hides lights that are seen directly")
        self.mi = mi
        moving = {
            shape: group
            for group, trajectory in built.trajectories.items()
            for shape in (part.prefix for part in built.groups[group])
        }
        built.rest()
        parts: dict[str, dict[str, Any]] = {name: {} for name in built.trajectories}
        resting: dict[str, Any] = {}
        for number, shape in enumerate(built.scene.shapes()):
            group = moving.get(shape.id())
            if group is None:
                resting[f"shape_{number}"] = shape
                continue
            if shape.is_emitter():
                raise NeedsExactMode(f"{group!r} moves and emits light")
            parts[group][f"shape_{number}"] = shape
        emitters = built.scene.emitters()
        spare_even_skies(mi, emitters)
        for number, emitter in enumerate(emitters):
            if emitter.get_shape() is None:
                resting[f"emitter_{number}"] = emitter
        self.static = mi.load_dict({"type": "scene", **resting}, optimize=False)
        lights = self.static.emitters()
        #: Light that a ray meets: from everywhere beyond the scene, and corners of boxes around all other [n, 2, 3], m.
        self.has_sky = any(light.is_environment() for light in lights)
        boxes = [light.get_shape().bbox() for light in lights if light.get_shape() is not None]
        self.lamp_boxes = np.array([[box.min, box.max] for box in boxes], dtype=np.float64).reshape(-1, 2, 3)
        self._resting = Part(mi, self.static, apart=False)
        self.groups = [
            Group(
                name,
                Part(mi, mi.load_dict({"type": "scene", **shapes}, optimize=False), apart=True),
                built.trajectories[name],
                np.concatenate([part.corners for part in built.groups[name]]),
            )
            for name, shapes in parts.items()
        ]

    def intersect(self, ray: Any, poses: Sequence[DevicePose], coherent: Any, active: Any) -> Any:
        """The nearest surface of all parts, `SurfaceInteraction3f` in world space.

        Parameters
        ----------
        ray : Ray3f in world space.
        poses : of each group, per lane.
        coherent : whether neighbouring lanes' rays are alike.
        """
        import drjit as dr

        mi = self.mi
        nearest, face, chosen, ray_there = self._nearest(ray, poses, coherent, active)
        si = nearest.compute_surface_interaction(ray_there, mi.RayFlags.All, active & (face == 0))
        for number, part in enumerate([self._resting, *(group.part for group in self.groups)]):
            if part.face_count:
                part.describe(si, ray_there, nearest, dr.select(chosen == number, face, 0))
        if not poses:
            return si
        pose = _pose_of(chosen, poses)
        si.p, si.n = mi.Point3f(pose.to_world(si.p)), mi.Normal3f(pose.turn_to_world(si.n))
        for part, names in ((si.sh_frame, ("s", "t", "n")), (si, ("dp_du", "dp_dv"))):
            for name in names:
                own = getattr(part, name)
                setattr(part, name, type(own)(pose.turn_to_world(own)))
        return si

    def distance(self, ray: Any, poses: Sequence[DevicePose], active: Any) -> Any:
        """To the nearest surface of all parts, m; infinite where there is none."""
        return self._nearest(ray, poses, False, active)[0].t

    def place_before(self, ray: Any, now: Sequence[DevicePose], then: Sequence[DevicePose]) -> tuple[Any, Any, Any]:
        """Where the point that a ray meets at one time was at another, in world space; whether it meets any; whose."""
        nearest, _, whose, ray_there = self._nearest(ray, now, True, self.mi.Bool(True))
        point = ray_there(nearest.t)
        return _pose_of(whose, then).to_world(point) if then else point, nearest.is_valid(), whose

    def occluded(self, ray: Any, poses: Sequence[DevicePose], active: Any) -> Any:
        """Whether anything lies on a ray before its `maxt`."""
        blocked = self._resting.blocks(ray, active)
        for group, pose in zip(self.groups, poses, strict=True):
            blocked |= group.part.blocks(_at_rest(ray, pose), active & ~blocked)
        return blocked

    def _nearest(self, ray: Any, poses: Sequence[DevicePose], coherent: Any, active: Any) -> tuple[Any, Any, Any, Any]:
        """Preliminary intersection, face of its part, number of that (0 rests), and the ray in its frame."""
        import drjit as dr

        mi = self.mi
        nearest, face = self._resting.nearest(ray, coherent, active)
        chosen, ray_there = mi.UInt32(0), ray
        for number, (group, pose) in enumerate(zip(self.groups, poses, strict=True), start=1):
            local = _at_rest(ray, pose)
            local.maxt = dr.select(nearest.t < ray.maxt, nearest.t, ray.maxt)
            hit, place = group.part.nearest(local, coherent, active)
            closer = hit.is_valid()
            nearest, face = dr.select(closer, hit, nearest), dr.select(closer, place, face)
            chosen = dr.select(closer, mi.UInt32(number), chosen)
            ray_there = dr.select(closer, local, ray_there)
        return nearest, face, chosen, ray_there


def _at_rest(ray: Any, pose: DevicePose) -> Any:
    """A ray in the frame of what has a pose."""
    local = type(ray)(ray)
    local.o, local.d = pose.to_rest(ray.o), pose.turn_to_rest(ray.d)
    return local


def _pose_of(chosen: Any, poses: Sequence[DevicePose]) -> DevicePose:
    """The pose of the group of each lane's number, from 1; 0 rests."""
    pose = DevicePose.none(type(poses[0].shift))
    for number, other in enumerate(poses, start=1):
        pose = other.where(chosen == number, pose)
    return pose


def spare_even_skies(mi: Any, emitters: Sequence[Any]) -> None:
    """Ask no surface for the light of a sky that is the same everywhere, where there is other light.

    The surface's own directions find it, and rays towards it take from those to the lamps.
    """
    even = [emitter for emitter in emitters if emitter.class_name() == "ConstantBackgroundEmitter"]
    if any(emitter.sampling_weight() > 0 for emitter in emitters if emitter not in even):
        for emitter in even:
            parameters = mi.traverse(emitter)
            parameters["sampling_weight"] = 0.0
            parameters.update()


def device_box(mi: Any, corners: NDArray[np.float64]) -> tuple[Any, Any]:
    """Corners [2, 3] of an axis-parallel box for `meets_box`, somewhat widened: rounding must not take a rim."""
    import drjit as dr

    margin = 1e-4 * float(np.linalg.norm(corners[1] - corners[0]))
    box = mi.Vector3f(corners[0] - margin), mi.Vector3f(corners[1] + margin)
    dr.make_opaque(*box)
    return box


def inverse_of(direction: Any) -> Any:
    """1 / d of each coordinate for `meets_box`; finite, for 0 · ∞ is nowhere."""
    import drjit as dr

    return dr.rcp(dr.select(abs(direction) < 1e-30, 1e-30, direction))


def meets_box(ray: Any, inverse: Any, length: Any, box: tuple[Any, Any]) -> Any:
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


def path_traced(built: BuiltScene) -> bool:
    """Whether the scene is rendered by Mitsuba's path tracer, whose paths run between surfaces only."""
    return built.integrator.class_name() == "PathIntegrator"
