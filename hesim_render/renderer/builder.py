"""From a scene file to a Mitsuba scene whose objects can be moved."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.errors import SpecError
from hesim_render.renderer import lights
from hesim_render.renderer._mitsuba import (
    Movable,
    as_spec_error,
    box_corners,
    load_scene,
    make_mesh,
    spectrum_dict,
    transform,
)
from hesim_render.renderer.paint import Paint
from hesim_render.renderer.targets import build_target
from hesim_render.renderer.trajectory import Trajectory, rotation_about
from hesim_render.specs.scene import MitsubaSpec, ObjectSpec, SceneSpec
from hesim_render.spectra import Spectrum, require_coverage

#: Path length for a Mitsuba scene without a path tracer of its own.
_DEFAULT_MITSUBA_DEPTH = 8
#: Segments from which on Russian roulette ends some paths. Mitsuba's default is 5; but a vector of lanes takes as long
#: as its longest path, so that roulette saves little, and what it adds to the noise is a lot.
_ROULETTE_DEPTH = 16
#: Shapes that have no inside: they are seen from both sides.
_OPEN_SHAPES = ("rectangle", "mesh")


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
    trajectories : of the groups that really move.
    is_dark : True where nothing emits.
    paints : of all shapes but lamps, where all are matt and the light is direct; else None.
    """

    mi: Any
    scene: Any
    integrator: Any
    parameters: Any
    groups: dict[str, list[Movable]]
    trajectories: dict[str, Trajectory]
    is_dark: bool
    paints: list[Paint] | None

    def pose(self, t_us: float) -> None:
        """Put every moving object at its pose of `t_us`."""
        for name, trajectory in self.trajectories.items():
            matrix = trajectory.matrix(t_us)
            for shape in self.groups[name]:
                shape.set_pose(matrix)
        if self.trajectories:
            self.parameters.update()

    def rest(self) -> None:
        """Put every moving object back where the file places it."""
        for name in self.trajectories:
            for shape in self.groups[name]:
                shape.set_pose(np.eye(4))
        if self.trajectories:
            self.parameters.update()

    @property
    def corners(self) -> NDArray[np.float64]:
        """Corners of the box around all shapes as they stand, [8, 3]; the origin where there are none."""
        box = self.scene.bbox()
        if not self.scene.shapes():
            return np.zeros((8, 3))
        return box_corners(np.array(box.min, dtype=np.float64).ravel(), np.array(box.max, dtype=np.float64).ravel())

    def mitsuba_sensor(self) -> Mapping[str, Any] | None:
        """Parameters of the scene's own first sensor, if it has one."""
        sensors = self.scene.sensors()
        return self.mi.traverse(sensors[0]) if sensors else None


def build(mi: Any, spec: SceneSpec, responses: Mapping[str, Spectrum] | None = None) -> BuiltScene:
    """Load a scene for rendering.

    Parameters
    ----------
    mi : the mitsuba module with the wanted variant set.
    responses : spectra that light and reflectance must cover (≥ 99.9 % of each), by name.

    Raises
    ------
    SpecError
        If Mitsuba refuses the scene, a spectrum does not cover a response, or a track moves nothing.
    """
    if responses:
        check_coverage(spec, responses)
    if spec.mitsuba is not None:
        scene = _load_mitsuba(mi, spec, spec.mitsuba)
        integrator = _integrator(mi, scene, spec.max_depth)
        groups: dict[str, list[str]] = {}
        paints = None
    else:
        content, groups, paints = _describe(mi, spec)
        with as_spec_error(spec.file):
            scene = mi.load_dict({"type": "scene", **content}, optimize=False)
        integrator = _path_tracer(mi, spec.max_depth or 2)
    parameters = mi.traverse(scene)
    trajectories = {track.object: Trajectory(track) for track in spec.motion if track.object != "camera"}
    movable: dict[str, list[Movable]] = {}
    for name in trajectories:
        prefixes = groups.get(name, [name])
        for prefix in prefixes:
            if f"{prefix}.vertex_positions" not in parameters and f"{prefix}.to_world" not in parameters:
                known = ", ".join(sorted(shape.id() for shape in scene.shapes()))
                raise SpecError(f"motion: no shape {name!r} in the Mitsuba scene; there are {known}", file=spec.file)
        movable[name] = [Movable(parameters, prefix) for prefix in prefixes]
    return BuiltScene(
        mi=mi,
        scene=scene,
        integrator=integrator,
        parameters=parameters,
        groups=movable,
        trajectories={name: trajectory for name, trajectory in trajectories.items() if trajectory.moves},
        is_dark=len(scene.emitters()) == 0,
        paints=paints if (spec.max_depth or 2) == 2 else None,
    )


def _describe(mi: Any, spec: SceneSpec) -> tuple[dict[str, Any], dict[str, list[str]], list[Paint]]:
    """Mitsuba's dictionary of a scene file, which shape ids belong to each movable name, and the shapes' paint."""
    content: dict[str, Any] = {}
    groups: dict[str, list[str]] = {}
    paints: list[Paint] = []
    if spec.target is not None:
        groups["target"] = []
        for number, piece in enumerate(build_target(spec.target)):
            name = f"target_{number}"
            bsdf = {"type": "diffuse", "reflectance": spectrum_dict(piece.reflectance)}
            content[name] = make_mesh(mi, name, piece.vertices_m, piece.faces, bsdf)
            groups["target"].append(name)
            paints.append(Paint(name, (piece.reflectance,)))
    for number, item in enumerate(spec.objects):
        name = f"object_{number}"
        content[name] = _object(mi, item, name, spec.folder)
        groups[item.name] = [name]
        paints.append(_paint(item, name))
    try:
        content.update(lights.emitters(mi, spec.lights))
    except SpecError as error:
        raise SpecError(str(error), file=spec.file) from None
    return content, groups, paints


def _paint(item: ObjectSpec, name: str) -> Paint:
    """What `_object` paints an object with."""
    colours = [source.load() for source in (item.reflectance, item.pattern) if source is not None]
    u, v = item.pattern_count
    return Paint(name, tuple(colours), (u / 2, v / 2), two_sided=item.shape in _OPEN_SHAPES)


def _object(mi: Any, item: ObjectSpec, name: str, folder: Path) -> Any:
    placement = np.eye(4)
    placement[:3, :3] = rotation_about(item.rotation_axis, item.rotation_deg)
    placement[:3, 3] = item.position_m
    half = np.array(item.size_m) / 2
    texture = spectrum_dict(item.reflectance.load())
    if item.pattern is not None:
        scale = np.diag([item.pattern_count[0] / 2, item.pattern_count[1] / 2, 1.0, 1.0])
        texture = {
            "type": "checkerboard",
            "color0": texture,
            "color1": spectrum_dict(item.pattern.load()),
            "to_uv": transform(mi, scale),
        }
    bsdf: dict[str, Any] = {"type": "diffuse", "reflectance": texture}
    if item.shape in _OPEN_SHAPES:
        bsdf = {"type": "twosided", "material": bsdf}
    if item.shape == "sphere":
        to_world = transform(mi, placement @ np.diag([half[0]] * 3 + [1.0]))
        return {"type": "sphere", "to_world": to_world, "bsdf": bsdf}
    if item.shape == "mesh":
        return _mesh_file(mi, item, placement, bsdf, folder)
    corners, faces, uv = _box_mesh() if item.shape == "box" else _rectangle_mesh()
    vertices = (corners * half) @ placement[:3, :3].T + placement[:3, 3]
    return make_mesh(mi, name, vertices, faces, bsdf, uv)


def _mesh_file(mi: Any, item: ObjectSpec, placement: NDArray[np.float64], bsdf: dict[str, Any], folder: Path) -> Any:
    """A mesh file, scaled so that its bounding box becomes `size_m` and centred on the object's place."""
    path = folder / str(item.mesh)
    if not path.is_file():
        raise SpecError(f"no such mesh file: {path}", key=f"objects.{item.name}.mesh")
    kind = path.suffix.lower().lstrip(".")
    if kind not in ("obj", "ply"):
        raise SpecError(f"a mesh must be an OBJ or PLY file, not {path.name}", key=f"objects.{item.name}.mesh")
    with as_spec_error(path, f"objects.{item.name}.mesh"):
        box = mi.load_dict({"type": kind, "filename": str(path)}).bbox()
    low, high = np.array(box.min, dtype=np.float64), np.array(box.max, dtype=np.float64)
    extent = high - low
    factors = np.divide(item.size_m, extent, out=np.ones(3), where=extent > 0)
    fit = np.diag([*factors, 1.0])
    fit[:3, 3] = -factors * (low + high) / 2
    return {"type": kind, "filename": str(path), "to_world": transform(mi, placement @ fit), "bsdf": bsdf}


def _rectangle_mesh() -> tuple[NDArray, NDArray, NDArray]:
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=np.float64)
    return corners, np.array([[0, 1, 2], [0, 2, 3]]), (corners[:, :2] + 1) / 2


def _box_mesh() -> tuple[NDArray, NDArray, NDArray]:
    """Six faces, normals outwards, each with its own u, v from 0 to 1."""
    vertices: list[NDArray] = []
    faces: list[NDArray] = []
    uv: list[NDArray] = []
    flat, triangles, flat_uv = _rectangle_mesh()
    for axis in range(3):
        for sign in (1.0, -1.0):
            # cyclic axes keep the face right-handed; mirroring u on the far side turns its normal round
            face = np.empty((4, 3))
            face[:, (axis + 1) % 3], face[:, (axis + 2) % 3], face[:, axis] = flat[:, 0] * sign, flat[:, 1], sign
            faces.append(triangles + 4 * len(vertices))
            vertices.append(face)
            uv.append(flat_uv)
    return np.concatenate(vertices), np.concatenate(faces), np.concatenate(uv)


def _load_mitsuba(mi: Any, spec: SceneSpec, source: MitsubaSpec) -> Any:
    """A scene of Mitsuba's own, with the emitters that are wanted."""
    if source.file is not None:
        path = spec.folder / source.file
        if not path.is_file():
            raise SpecError(f"no such Mitsuba scene file: {path}", file=spec.file, key="mitsuba.file")
        content: Path | dict[str, Any] = path
        where: tuple[Path | None, str | None] = (path, None)
    else:
        own = mi.cornell_box() if source.builtin else _plugin_dict(mi, source.inline or {})
        content, where = {"type": "scene", **own}, (spec.file, "mitsuba.inline")
    with as_spec_error(*where):
        scene = load_scene(mi, content)
    if not isinstance(scene, mi.Scene):
        raise SpecError("the Mitsuba file describes no scene", file=source.file or spec.file, key="mitsuba")
    meant_dark = bool(spec.lights)  # of type 'none', or the scene file would have been refused
    if meant_dark and scene.emitters():
        raise SpecError("type 'none' is darkness, but the Mitsuba scene has emitters", file=spec.file, key="light")
    if not meant_dark and not scene.emitters():
        raise SpecError(
            "the Mitsuba scene has no emitter, so there is nothing to see; if it is meant to be dark, write "
            "'light: {type: none}' beside it",
            file=spec.file,
            key="mitsuba",
        )
    if source.lit is not None or source.unlit or source.waveforms:
        names = [*(source.lit or ()), *source.unlit, *source.waveforms]
        try:
            with as_spec_error(*where):
                scene = load_scene(mi, content, source.may_shine, names)
        except SpecError as error:
            if error.file is not None:
                raise
            raise SpecError(str(error), file=spec.file, key="mitsuba") from None
    return scene


def _integrator(mi: Any, scene: Any, depth: int | None) -> Any:
    """The scene's own path tracer where it has one and no depth is asked for, else one of that depth."""
    own = scene.integrator()
    if depth is None and isinstance(own, mi.MonteCarloIntegrator):
        return own
    return _path_tracer(mi, depth or _DEFAULT_MITSUBA_DEPTH)


def _path_tracer(mi: Any, depth: int) -> Any:
    return mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": _ROULETTE_DEPTH})


def _plugin_dict(mi: Any, node: Mapping[str, Any]) -> dict[str, Any]:
    """A dictionary as YAML writes it: 4×4 lists become transforms, lists of numbers in spectra become text."""
    content: dict[str, Any] = {}
    for key, value in node.items():
        if isinstance(value, Mapping):
            content[key] = _plugin_dict(mi, value)
        elif isinstance(value, list) and np.shape(value) == (4, 4):
            content[key] = transform(mi, value)
        elif isinstance(value, list) and key in ("wavelengths", "values"):
            content[key] = ",".join(f"{float(v):.9g}" for v in value)
        else:
            content[key] = value
    return content


def named_spectra(spec: SceneSpec) -> Iterator[tuple[str, Spectrum]]:
    """Key and spectrum of a scene file's light and reflectances; none in darkness or for a Mitsuba scene.

    A Mitsuba scene is taken as it is: its RGB colours become spectra over the whole visible range.
    """
    if spec.mitsuba is not None or not any(light.is_lit for light in spec.lights):
        return
    for number, light in enumerate(spec.lights):
        if light.is_lit:
            yield f"{lights.key_of(spec.lights, number)}.illuminant", light.illuminant.load()
    if spec.target is not None:
        for piece in build_target(spec.target):
            yield f"target ({piece.name})", piece.reflectance
    for item in spec.objects:
        for key, source in (("reflectance", item.reflectance), ("pattern", item.pattern)):
            if source is not None:
                yield f"objects.{item.name}.{key}", source.load()


def check_coverage(spec: SceneSpec, responses: Mapping[str, Spectrum]) -> None:
    """Refuse a scene whose light or a reflectance covers less than 99.9 % of a response.

    Raises
    ------
    SpecError
        With scene file and key.
    """
    for key, spectrum in named_spectra(spec):
        for name, response in responses.items():
            try:
                require_coverage(spectrum, response, "this spectrum", f"filter {name!r}")
            except SpecError as error:
                raise SpecError(str(error), file=spec.file, key=key) from None
