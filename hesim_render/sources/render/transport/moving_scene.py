"""A scene in which every ray has its own time: rays are transformed into the frames of moving objects.

Mitsuba has no animated transforms, and setting a pose costs a rebuild. Here each moving object rests in a scene of its
own. A ray is transformed into the object's frame at the ray's own time and intersected with the object at rest, and the
nearest hit of all frames counts. One kernel therefore serves any number of instants, motion within an exposure is
exact, and nothing is rebuilt or recompiled.

Objects are tested only against rays that meet the box which contains the object during the whole window
(`Moment.boxes`). For other rays, not even the pose is computed.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device import dr
from hesim_render.core.device_types import (
    Float,
    Interaction,
    LoopState,
    Mask,
    MitsubaModule,
    MitsubaObject,
    Ray,
    UInt32,
    Vector3,
)
from hesim_render.core.errors import SpecError
from hesim_render.sources.render.scene.builder import BuiltScene, NeedsExactMode, require_paths
from hesim_render.sources.render.scene.mitsuba_version import names_of
from hesim_render.sources.render.scene.surfaces import reflects_diffusely
from hesim_render.sources.render.scene.tracks import DevicePose, Tracks
from hesim_render.sources.render.scene.trajectory import Trajectory
from hesim_render.sources.render.transport.closed_form import Part, surface_of
from hesim_render.sources.render.transport.leaving import Leaving
from hesim_render.sources.render.transport.many_objects import Fleet
from hesim_render.sources.render.transport.motion_bounds import stays_in
from hesim_render.sources.render.transport.swept_boxes import Moment, box_rows, inverse_of, meets_box

#: Largest number of objects in closed form that are tested one by one; more are tested in a loop of one kernel.
_FEW = 3


@dataclass(frozen=True)
class Group:
    """Shapes that move together.

    Parameters
    ----------
    name : name of the object.
    scene : Mitsuba scene of the shapes at rest.
    part : the shapes at rest.
    trajectory : their motion.
    corners : bounding-box corners at rest, [n, 3], m.
    is_diffuse : True if all its surfaces reflect diffusely, whether they emit light or not.
    """

    name: str
    scene: MitsubaObject
    part: Part
    trajectory: Trajectory
    corners: NDArray[np.float64]
    is_diffuse: bool


class Surface:
    """Surfaces that rays have hit.

    A moving object is intersected, and its surface evaluated, in its rest frame: textures and attributes of meshes are
    looked up by the position on the mesh as it was loaded. Directions that leave the surface are turned into world
    space.

    Parameters
    ----------
    mi : the mitsuba module.
    rest : `SurfaceInteraction3f` in the frame in which the hit shapes rest.
    pose : pose of those shapes, per lane; None where nothing moves.
    met : Dr.Jit Bool, True where the ray came through the box of a moving object.
    """

    def __init__(self, mi: MitsubaModule, rest: Interaction, pose: DevicePose | None, met: Mask) -> None:
        self.rest, self._pose, self.met = rest, pose, met
        point, normal = rest.p, rest.n
        if pose is not None:
            point, normal = mi.Point3f(pose.to_world(point)), mi.Normal3f(pose.turn_to_world(normal))
        #: The same point as `Interaction3f` in world space.
        self.world = mi.Interaction3f(rest.t, rest.time, rest.wavelengths, point, normal)

    @property
    def shading_normal(self) -> Vector3:
        """Shading normal in world space."""
        n = self.rest.sh_frame.n
        return n if self._pose is None else self._pose.turn_to_world(n)

    def to_local(self, direction: Vector3) -> Vector3:
        """Direction in the shading frame, from world space."""
        turned = direction if self._pose is None else self._pose.turn_to_rest(direction)
        return self.rest.to_local(turned)

    def to_world(self, direction: Vector3) -> Vector3:
        """Direction in world space, from the shading frame."""
        turned = self.rest.to_world(direction)
        return turned if self._pose is None else type(turned)(self._pose.turn_to_world(turned))


class MovingScene:
    """The parts of a built scene: the resting part, with all lights, and each moving group.

    Parameters
    ----------
    built : from `build`; its moving shapes may be at any pose.
    geometry_only : True if the scene is used to find surfaces, not to render them; no scene is then refused.

    Raises
    ------
    SpecError
        If something moves in a scene with instances, or a mesh changes its shape and only geometry is wanted.
    NeedsExactMode
        If a moving shape emits light, a plugin of the scene asks for that mode, the scene's integrator is not Mitsuba's
        path tracer, or it hides lights.
    """

    def __init__(self, built: BuiltScene, geometry_only: bool = False) -> None:
        if geometry_only and built.deformations:
            raise SpecError(
                f"geometric truth follows rigid motion, and {next(iter(built.deformations))!r} changes its shape"
            )
        mi = built.mi
        if not geometry_only:
            require_paths(built)
        self.mi = mi
        moving = {
            shape: group
            for group, trajectory in built.trajectories.items()
            for shape in (part.prefix for part in built.groups[group])
        }
        built.rest()
        parts: dict[str, dict[str, Any]] = {name: {} for name in built.trajectories}
        resting: dict[str, Any] = {}
        #: All shapes by their names in the loaded scene; Mitsuba gives them other ids in the scenes made here.
        self.shapes = dict(zip(names_of(built.scene.shapes()), built.scene.shapes(), strict=True))
        for number, shape in enumerate(built.scene.shapes()):
            group = moving.get(shape.id())
            if group is None:
                resting[f"shape_{number}"] = shape
                continue
            if shape.is_emitter() and not geometry_only:
                raise NeedsExactMode(f"{group!r} moves and emits light")
            parts[group][f"shape_{number}"] = shape
        #: All lights, in the order of the loaded scene.
        self.lights = built.scene.emitters()
        spare_even_skies(mi, self.lights)
        for number, emitter in enumerate(self.lights):
            if emitter.get_shape() is None:
                resting[f"emitter_{number}"] = emitter
        if any(shape.class_name() == "Instance" for shape in built.scene.shapes()):
            # Mitsuba cannot put an instance into a second scene
            if parts:
                raise SpecError(
                    "geometric truth is not known of moving objects in a scene with instances; give copies of the "
                    "shape in their place"
                )
            self.static = built.scene
        else:
            self.static = mi.load_dict({"type": "scene", **resting}, optimize=False)
        #: Lights that a ray can hit: the environment, and corners of boxes around all other lights [n, 2, 3], m.
        self.has_sky = any(light.is_environment() for light in self.lights)
        boxes = [light.get_shape().bbox() for light in self.lights if light.get_shape() is not None]
        self.lamp_boxes = np.array([[box.min, box.max] for box in boxes], dtype=np.float64).reshape(-1, 2, 3)
        #: What begins the rays that leave surfaces.
        self.leaving = Leaving(mi, built.scene)
        self._resting = Part(mi, self.static, apart=False)
        self.groups, faces = [], self._resting.face_count
        for name, shapes in parts.items():
            own = mi.load_dict({"type": "scene", **shapes}, optimize=False)
            part = Part(mi, own, apart=True, faces_before=faces)
            corners = np.concatenate([part.corners for part in built.groups[name]])
            is_diffuse = all(reflects_diffusely(mi, shape.bsdf()) for shape in own.shapes())
            self.groups.append(Group(name, own, part, built.trajectories[name], corners, is_diffuse))
            faces += part.face_count
        self._sort_groups()

    def _sort_groups(self) -> None:
        """Sort groups into those tested one by one and those tested in a loop."""
        forms = {number: group.part.form for number, group in enumerate(self.groups)}
        simple = [number for number, form in forms.items() if form is not None and not form.sheets]
        together = simple if len(simple) > _FEW else []
        self._single = [number for number in range(len(self.groups)) if number not in together]
        self._described = [self._resting, *(self.groups[number].part for number in self._single)]
        self._fleet = None
        if self.groups:
            self._tracks = Tracks([group.trajectory for group in self.groups])
        if together:
            own = [form for k in together if (form := forms[k]) is not None]
            self._fleet = Fleet(self.mi, own, together, self._tracks, len(self.groups))

    def intersect(self, ray: Ray, moment: Moment, coherent: Mask, active: Mask, flags: MitsubaObject = None) -> Surface:
        """The nearest surface of all parts.

        Parameters
        ----------
        ray : Ray3f in world space.
        moment : time of each ray.
        coherent : True if rays of neighbouring lanes are similar.
        active : lanes to trace.
        flags : `RayFlags`, fields to compute; default all.
        """
        mi = self.mi
        flags = mi.RayFlags.All if flags is None else flags
        hit, face = self._resting.nearest(ray, coherent, active)
        if not self.groups:
            return Surface(mi, surface_of([self._resting], hit, face, ray, flags, active), None, mi.Bool(False))
        pose = DevicePose.none(mi.Vector3f)

        def take(
            is_nearer: Mask, candidate: Interaction, number: UInt32, own: DevicePose, state: LoopState
        ) -> LoopState:
            columns = (dr.select(is_nearer, a, b) for a, b in zip((*own.columns, own.shift), state[2:], strict=True))
            return dr.select(is_nearer, candidate, state[0]), dr.select(is_nearer, number, state[1]), *columns

        def visit(group: Group, own: DevicePose, local: Ray, near: Mask, state: LoopState) -> LoopState:
            local.maxt = dr.minimum(local.maxt, state[0].t)
            candidate, number = group.part.nearest(local, coherent, near)
            return take(near & candidate.is_valid(), candidate, number, own, state)

        state: LoopState = hit, face, *pose.columns, pose.shift
        state, met = self._visit_groups(ray, moment, active, hit.t, state, visit)
        if self._fleet is not None:
            fleet = self._fleet
            fleet_hit, number, near = fleet.nearest(ray, moment, dr.minimum(ray.maxt, state[0].t), active)
            met |= near

            def pose_of(*state: Any) -> LoopState:
                return take(fleet_hit.is_valid(), fleet_hit, mi.UInt32(0), fleet.pose(number, moment), state)

            state = dr.if_stmt(state, fleet_hit.is_valid(), pose_of, lambda *state: state, label="moving surface")
        # surfaces are described once, for all parts: a description of each would be most of the kernel
        hit, face, *columns, shift = state
        pose = DevicePose(tuple(columns), shift)
        rest = surface_of(self._described, hit, face, _at_rest(ray, pose), flags, active)
        return Surface(mi, rest, pose, met)

    def distance(self, ray: Ray, moment: Moment, active: Mask) -> tuple[Float, Mask]:
        """Distance to the nearest surface of all parts, m, infinite where there is none; and True where a box was
        met.
        """

        def visit(group: Group, own: DevicePose, local: Ray, near: Mask, state: LoopState) -> LoopState:
            local.maxt = dr.minimum(local.maxt, state[0])
            hit, _ = group.part.nearest(local, False, near)
            return (dr.select(near & hit.is_valid(), hit.t, state[0]),)

        resting = self._resting.nearest(ray, False, active)[0].t
        (nearest,), met = self._visit_groups(ray, moment, active, resting, (resting,), visit)
        if self._fleet is not None:
            hit, _, near = self._fleet.nearest(ray, moment, dr.minimum(ray.maxt, nearest), active)
            nearest, met = dr.select(hit.is_valid(), hit.t, nearest), met | near
        return nearest, met

    def box_rows_in(self, spans_us: tuple[tuple[float, float], ...]) -> NDArray[np.float32]:
        """Boxes that contain each group during some intervals, and what the fleet adds: rows of `Moment.boxes`,
        [interval, row, 8].
        """
        if not self.groups:
            return np.empty((len(spans_us), 0, 8), np.float32)
        rows = box_rows(np.stack([stays_in(one.corners, one.trajectory, spans_us) for one in self.groups], axis=1))
        return rows if self._fleet is None else np.concatenate([rows, self._fleet.rows(rows)], axis=1)

    def pose(self, group: UInt32 | int, moment: Moment) -> DevicePose:
        """Pose of the group whose number each lane holds."""
        known = moment.poses.get(group) if isinstance(group, int) else None
        return known or self._tracks.pose(group, moment.local_us(group))

    def posed(self, moment: Moment, groups: Iterable[int]) -> Moment:
        """The same times with the poses of some groups, which all lanes share: each is then computed once a ray."""
        return replace(moment, poses={group: self.pose(group, moment) for group in groups})

    def resting_distance(self, ray: Ray) -> Float:
        """Distance to the nearest resting surface, m; infinite where there is none."""
        return self._resting.nearest(ray, True, self.mi.Bool(True))[0].t

    def occluded(self, ray: Ray, moment: Moment, active: Mask) -> tuple[Mask, Mask]:
        """True where anything lies on a ray before its `maxt`; and True where the ray met the box of a group."""

        def visit(group: Group, own: DevicePose, local: Ray, near: Mask, state: LoopState) -> LoopState:
            return (state[0] | group.part.blocks(local, near & ~state[0]),)

        blocked = self._resting.blocks(ray, active)
        # a ray that the resting part blocks needs no test of moving groups
        free = active & ~blocked
        (blocked,), met = self._visit_groups(ray, moment, free, ray.maxt, (blocked,), visit)
        if self._fleet is not None:
            others, near = self._fleet.blocks(ray, moment, free)
            blocked, met = blocked | others, met | near
        return blocked, met

    def _visit_groups(
        self, ray: Ray, moment: Moment, active: Mask, length: Float, state: LoopState, visit: Callable[..., LoopState]
    ) -> tuple[LoopState, Mask]:
        """Call `visit` to update a state for each group that is tested one by one and whose box a ray meets.

        Parameters
        ----------
        length : the first metres of the ray that count.
        state : initial values.
        visit : returns the new state.

        Returns
        -------
        state, met : the final state; and Dr.Jit Bool, True where any box was met.
        """
        met = self.mi.Bool(False)
        inverse = inverse_of(ray.d)
        for number in self._single:
            near = active & meets_box(ray, inverse, length, moment.box(number))
            met |= near

            def turn_to(*state: Any, number: int = number, near: Mask = near) -> LoopState:
                pose = self.pose(number, moment)
                return visit(self.groups[number], pose, _at_rest(ray, pose), near, state)

            state = dr.if_stmt(state, near, turn_to, lambda *state: state, label="moving group")
        return state, met


def _at_rest(ray: Ray, pose: DevicePose) -> Ray:
    """Transform a ray into the rest frame of a posed object."""
    local = type(ray)(ray)
    local.o, local.d = pose.to_rest(ray.o), pose.turn_to_rest(ray.d)
    return local


def spare_even_skies(mi: MitsubaModule, emitters: Sequence[MitsubaObject]) -> None:
    """Do not sample a uniform sky from surfaces if there is other light.

    Directions of the surface's own sampling find the sky. Shadow rays to it would reduce the number of those to lamps.
    """
    even = [emitter for emitter in emitters if emitter.class_name() == "ConstantBackgroundEmitter"]
    if any(emitter.sampling_weight() > 0 for emitter in emitters if emitter not in even):
        for emitter in even:
            parameters = mi.traverse(emitter)
            parameters["sampling_weight"] = 0.0
            parameters.update()
