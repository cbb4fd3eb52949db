"""Build a Mitsuba scene with movable objects from a scene file."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device_types import MitsubaModule, MitsubaObject
from hesim_render.core.errors import SpecError
from hesim_render.sources.render.scene import lights
from hesim_render.sources.render.scene.deformation import Deformation
from hesim_render.sources.render.scene.diffuse_scene import DiffuseScene
from hesim_render.sources.render.scene.direct_lights import DirectLight, direct_lights
from hesim_render.sources.render.scene.mesh_file import mesh_shapes
from hesim_render.sources.render.scene.mitsuba_scene import MitsubaCamera, load_mitsuba, path_tracer
from hesim_render.sources.render.scene.mitsuba_version import (
    Movable,
    as_spec_error,
    box_corners,
    can_move,
    files_readable,
    make_mesh,
    number_of,
    path_depths,
    settle_normals,
    spectrum_dict,
    transform,
)
from hesim_render.sources.render.scene.parents import trajectories
from hesim_render.sources.render.scene.pictures import picture_texture
from hesim_render.sources.render.scene.scene_spectra import check_coverage, target_pieces
from hesim_render.sources.render.scene.solid_meshes import box_mesh, rectangle_mesh
from hesim_render.sources.render.scene.surfaces import (
    Paint,
    are_few,
    area_emitter,
    bsdf_of,
    is_diffuse,
    paint_of,
    picture_of,
    pictured,
    radiance_of,
)
from hesim_render.sources.render.scene.trajectory import Trajectory
from hesim_render.sources.render.scene.vertex_normals import MESH_FILES, brings_normals
from hesim_render.specs.geometry import rotation_about
from hesim_render.specs.scene import ObjectSpec, SceneSpec
from hesim_render.spectral.spectrum import Spectrum
from hesim_render.targets.piece import Picture, TargetPiece


@dataclass
class BuiltScene:
    """A loaded Mitsuba scene.

    Parameters
    ----------
    mi : the mitsuba module it was built with (its variant must stay current while the scene is used).
    scene : mitsuba.Scene.
    integrator : a path tracer of the scene's depth.
    parameters : mitsuba.traverse(scene).
    groups : movable shapes by name: ``target``, an object's name, a Mitsuba shape id.
    trajectories : tracks of the groups that really move.
    is_dark : True where nothing emits.
    diffuse : diffuse surfaces and lights, if the direct light of one has a closed form; otherwise None. What traces the
        scene takes it, because pictures in it are large.
    exact_because : why the scene needs the exact mode; None if it does not.
    camera : the Mitsuba scene's own camera, if it is used.
    integrator_plugin : plugin description of a Mitsuba scene's integrator; None if it was given as an object.
    object_of_shape : name of the object of each shape, by the shape's id; a shape of a Mitsuba scene is an object
        of its own, under its id, and is not listed.
    deformations : objects that change their shape, by name.
    """

    mi: MitsubaModule
    scene: MitsubaObject
    integrator: MitsubaObject
    parameters: MitsubaObject
    groups: dict[str, list[Movable]]
    trajectories: dict[str, Trajectory]
    is_dark: bool
    diffuse: DiffuseScene | None
    exact_because: str | None = None
    camera: MitsubaCamera | None = None
    integrator_plugin: dict[str, Any] | None = None
    object_of_shape: dict[str, str] = field(default_factory=dict)
    deformations: dict[str, Deformation] = field(default_factory=dict)

    @property
    def moves(self) -> bool:
        """True if an object moves or changes its shape."""
        return bool(self.trajectories or self.deformations)

    def pose(self, t_us: float) -> None:
        """Move every moving object to its pose at `t_us`, and give it its shape of that time."""
        self.place(t_us, {name: track.matrix(t_us) for name, track in self.trajectories.items()})

    def place(self, t_us: float, poses: Mapping[str, NDArray[np.float64]]) -> None:
        """As `pose`, where the poses of `trajectories` at that time are known."""
        for name in dict.fromkeys((*self.trajectories, *self.deformations)):
            for shape in self.groups[name]:
                if name in self.deformations:
                    shape.deform(self.deformations[name].at(t_us))
                shape.set_pose(poses.get(name, np.eye(4)))
        if self.moves:
            self.parameters.update()

    def rest(self) -> None:
        """Move every moving object back to its place in the file; it keeps its shape."""
        for name in self.trajectories:
            for shape in self.groups[name]:
                shape.set_pose(np.eye(4))
        if self.trajectories:
            self.parameters.update()

    @property
    def corners(self) -> NDArray[np.float64]:
        """Corners of the box around all shapes at their current poses, [8, 3], m; the origin if there are none."""
        box = self.scene.bbox()
        if not self.scene.shapes():
            return np.zeros((8, 3))
        return box_corners(np.array(box.min, dtype=np.float64).ravel(), np.array(box.max, dtype=np.float64).ravel())

    def mitsuba_sensor(self) -> MitsubaCamera | None:
        """The camera of the scene's own first sensor, if there is one and the scene file has no camera."""
        return self.camera


@files_readable()
def build(mi: MitsubaModule, spec: SceneSpec, responses: Mapping[str, Spectrum] | None = None) -> BuiltScene:
    """Load a scene for rendering.

    Parameters
    ----------
    mi : the mitsuba module with the wanted variant set.
    spec : content of the scene file.
    responses : spectra that light and reflectance must cover (≥ 99.9 % of each), by name.

    Raises
    ------
    SpecError
        If Mitsuba refuses the scene, a plugin of it is not rendered, a spectrum does not cover a response, or a track
        moves nothing.
    """
    if responses:
        check_coverage(spec, responses)
    because, camera, plugin = None, None, None
    if spec.mitsuba is not None:
        loaded = load_mitsuba(mi, spec, spec.mitsuba)
        scene, integrator, because, camera = loaded.scene, loaded.integrator, loaded.exact_because, loaded.camera
        plugin = loaded.integrator_plugin
        groups: dict[str, list[str]] = {}
        deformations: dict[str, Deformation] = {}
        diffuse = loaded.diffuse
    else:
        content, groups, diffuse, deformations = _describe(mi, spec)
        if deformations:
            because = f"object {next(iter(deformations))!r} changes its shape"
        with as_spec_error(spec.file):
            scene = mi.load_dict({"type": "scene", **content}, optimize=False)
        integrator = path_tracer(mi, spec.depth)
    parameters = mi.traverse(scene)
    if spec.mitsuba is None:
        without = {name for item in spec.objects for name in _without_normals(item, spec, groups)}
        settle_normals(parameters, without.__contains__)
    tracks = {name: track for name, track in trajectories(spec).items() if name != "camera"}
    movable: dict[str, list[Movable]] = {}
    shapes = {shape.id(): shape for shape in scene.shapes()}
    for name in (*tracks, *(own for own in deformations if own not in tracks)):
        prefixes = groups.get(name, [name])
        for prefix in prefixes:
            if prefix not in shapes:
                known = ", ".join(sorted(shapes))
                raise SpecError(f"motion: no shape {name!r} in the Mitsuba scene; there are {known}", file=spec.file)
            if not can_move(parameters, prefix):
                kind = shapes[prefix].class_name()
                raise SpecError(
                    f"motion: shape {name!r} is a {kind}, which cannot move; use a mesh (PLY, OBJ)", file=spec.file
                )
        movable[name] = [Movable(parameters, prefix, shapes[prefix]) for prefix in prefixes]
    return BuiltScene(
        mi=mi,
        scene=scene,
        integrator=integrator,
        parameters=parameters,
        groups=movable,
        trajectories={name: track for name, track in tracks.items() if track.moves},
        is_dark=len(scene.emitters()) == 0,
        diffuse=diffuse if _follows_light(integrator) and _fits(diffuse, responses) else None,
        exact_because=because,
        camera=camera,
        integrator_plugin=plugin,
        deformations=deformations,
        object_of_shape={prefix: name for name, prefixes in groups.items() for prefix in prefixes},
    )


def _follows_light(integrator: MitsubaObject) -> bool:
    """True if light is followed from its sources to surfaces."""
    is_known = integrator.class_name() in ("DirectIntegrator", "PathIntegrator")
    return is_known and path_depths(integrator)[0] not in (0, 1)


def _fits(diffuse: DiffuseScene | None, responses: Mapping[str, Spectrum] | None) -> bool:
    """True if the numbers of all texels fit into memory."""
    filters = 1 if responses is None else len(responses)
    return diffuse is not None and are_few(diffuse.paints, len(diffuse.lights) * filters)


def _describe(
    mi: MitsubaModule, spec: SceneSpec
) -> tuple[dict[str, Any], dict[str, list[str]], DiffuseScene | None, dict[str, Deformation]]:
    """Mitsuba's dictionary of a scene file, the shape ids of each movable name, surfaces and lights (None if no light
    has a closed form), and the objects that change their shape.
    """
    deformations: dict[str, Deformation] = {}
    others, glows = list[str](), dict[str, Spectrum | None]()
    content: dict[str, Any] = {}
    groups: dict[str, list[str]] = {}
    paints: list[Paint] = []
    shining: list[DirectLight] = []
    if spec.target is not None:
        groups["target"] = []
        for number, piece in enumerate(target_pieces(spec)):
            name = f"target_{number}"
            content[name] = _piece(mi, name, piece)
            groups["target"].append(name)
            if piece.radiance is not None:
                glows[name] = piece.radiance
            if isinstance(piece.reflectance, Picture):
                paints.append(pictured(name, piece.reflectance))
            else:
                paints.append(Paint(name, (piece.reflectance,)))
    for number, item in enumerate(spec.objects):
        name = f"object_{number}"
        picture = picture_of(item)
        placement, bsdf = _placement(item), bsdf_of(mi, item, spec, picture)
        if item.shape == "mesh":
            anywhere = spec.allow_outside or spec.file is None
            parts, deformation = mesh_shapes(mi, item, name, placement, bsdf, spec.folder, anywhere)
            if deformation is not None:
                deformations[item.name] = deformation
        else:
            parts = {name: _object(mi, item, name, placement, bsdf)}
        content.update(parts)
        groups[item.name] = list(parts)
        radiance, light = radiance_of(item), _shining(item, name, placement)
        if light is not None and is_diffuse(item):
            shining.append(light)
        elif radiance is not None:
            glows.update(dict.fromkeys(parts, radiance))
        if is_diffuse(item):
            paints += [paint_of(item, part, picture) for part in parts]
        else:
            others += list(parts)
    try:
        sources = lights.emitters(mi, spec.lights)
    except SpecError as error:
        raise SpecError(str(error), file=spec.file) from None
    content.update(sources)
    apart = [source for source in sources.values() if source["type"] != "rectangle"]
    more = [number for number, source in enumerate(apart) if source["type"] == "envmap"]
    diffuse = DiffuseScene(paints, direct_lights(spec.lights, shining), others, glows, more)
    return content, groups, diffuse if diffuse.lights or not (glows or more) else None, deformations


def _without_normals(item: ObjectSpec, spec: SceneSpec, groups: Mapping[str, list[str]]) -> list[str]:
    """Ids of an object's shapes that Mitsuba reads from a file without normals of its vertices."""
    path = spec.folder / str(item.mesh)
    is_read = item.shape == "mesh" and path.suffix.lower().lstrip(".") in MESH_FILES
    return groups[item.name] if is_read and not brings_normals(path) else []


def _piece(mi: MitsubaModule, name: str, piece: TargetPiece) -> MitsubaObject:
    """A part of the target."""
    if isinstance(piece.reflectance, Picture):
        bsdf = {"type": "diffuse", "reflectance": picture_texture(mi, piece.reflectance)}
    else:
        bsdf = {"type": "diffuse", "reflectance": spectrum_dict(piece.reflectance)}
    return make_mesh(mi, name, piece.vertices_m, piece.faces, bsdf, piece.uv, area_emitter(piece.radiance))


def _placement(item: ObjectSpec) -> NDArray[np.float64]:
    """Pose [4, 4] of an object at rest."""
    placement = np.eye(4)
    placement[:3, :3] = rotation_about(item.rotation_axis, item.rotation_deg)
    placement[:3, 3] = item.position_m
    return placement


def _shining(item: ObjectSpec, name: str, placement: NDArray[np.float64]) -> DirectLight | None:
    """The light of an object that shines, if it has a closed form; `name` is that of its shape."""
    radiance, half = radiance_of(item), np.array(item.size_m) / 2
    if radiance is None or item.shape not in ("rectangle", "sphere"):
        return None
    if item.shape == "sphere":
        return DirectLight("ball", radiance, 1.0, np.array([*placement[:3, 3], half[0]]), name)
    return DirectLight("rectangle", radiance, 1.0, placement @ np.diag([half[0], half[1], 1.0, 1.0]), name)


def _object(mi: MitsubaModule, item: ObjectSpec, name: str, placement: NDArray[np.float64], bsdf: Any) -> MitsubaObject:
    half, emitter = np.array(item.size_m) / 2, area_emitter(radiance_of(item))
    if item.shape == "sphere":
        to_world = transform(mi, placement @ np.diag([half[0]] * 3 + [1.0]))
        sphere = {"type": "sphere", "to_world": to_world, "bsdf": bsdf}
        return sphere if emitter is None else {**sphere, "emitter": emitter}
    corners, faces, uv = box_mesh() if item.shape == "box" else rectangle_mesh()
    vertices = (corners * half) @ placement[:3, :3].T + placement[:3, 3]
    return make_mesh(mi, name, vertices, faces, bsdf, uv, emitter)


class NeedsExactMode(SpecError):
    """The scene needs the exact mode: paths between resting and rigidly moving surfaces do not describe it."""


def require_paths(built: BuiltScene) -> None:
    """Refuse scenes that paths between surfaces do not describe."""
    if built.exact_because is not None:
        raise NeedsExactMode(built.exact_because)
    name = built.integrator.class_name()
    if name == "DirectIntegrator":
        for kind in ("emitter_samples", "bsdf_samples"):
            if number_of(built.integrator, kind) == 0:
                raise NeedsExactMode(f"integrator 'direct': with {kind} 0 it leaves light out")
    elif name != "PathIntegrator":
        raise NeedsExactMode(f"integrator {name!r} follows more than paths between surfaces")
    if built.integrator.hide_emitters:
        raise NeedsExactMode("the integrator hides lights that are seen directly")
