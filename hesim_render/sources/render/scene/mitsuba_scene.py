"""Scenes in Mitsuba's own formats: an XML file, a built-in scene, or a dictionary, and the camera in them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import radians, tan
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device_types import MitsubaModule, MitsubaObject
from hesim_render.core.errors import SpecError
from hesim_render.sources.render.scene.diffuse_scene import DiffuseScene, loaded_diffuse_scene
from hesim_render.sources.render.scene.files import require_short_number
from hesim_render.sources.render.scene.mitsuba_version import as_spec_error, box_corners, matrix_of, transform
from hesim_render.sources.render.scene.parsed_diffuse import ParsedDiffuseScene, parsed_diffuse_scene
from hesim_render.sources.render.scene.parsed_scene import load_mitsuba_scene, switch_off
from hesim_render.sources.render.scene.plugin_tables import require_known
from hesim_render.sources.render.scene.plugins import (
    Used,
    check_camera,
    exact_reason,
    integrator_plugin,
    set_depth,
    used_plugins,
)
from hesim_render.specs.mitsuba_scene import MitsubaSpec
from hesim_render.specs.scene import SceneSpec

#: Path length for a scene without an integrator of its own.
_DEFAULT_DEPTH = 8
#: First segment with Russian roulette. Mitsuba's default is 5. But a vector of lanes takes as long
#: as its longest path, so roulette saves little time and adds much noise.
_ROULETTE = {"rr_depth": 16}


@dataclass(frozen=True)
class MitsubaScene:
    """A loaded Mitsuba scene.

    Parameters
    ----------
    scene : mitsuba.Scene.
    integrator : its own integrator, or a path tracer if it has none.
    integrator_plugin : plugin description of the integrator; None if it was given as an object.
    exact_because : why the scene needs the exact mode; None if it does not.
    camera : its first sensor, if there is one and the scene file has no camera.
    diffuse : its surfaces and lights, if all are diffuse and of closed form; otherwise None.
    """

    scene: MitsubaObject
    integrator: MitsubaObject
    integrator_plugin: dict[str, Any] | None
    exact_because: str | None
    camera: "MitsubaCamera | None"
    diffuse: DiffuseScene | None


def load_mitsuba(mi: MitsubaModule, spec: SceneSpec, source: MitsubaSpec) -> MitsubaScene:
    """Load a Mitsuba scene with the wanted emitters.

    Raises
    ------
    SpecError
        If Mitsuba refuses the scene, a plugin of it is not rendered, or a name does not belong to an emitter.
    """
    where: tuple[Path | None, str | None] = (spec.file, "mitsuba.inline")
    if source.file is not None:
        path = spec.folder / source.file
        if not path.is_file():
            raise SpecError(f"no such Mitsuba scene file: {path}", file=spec.file, key="mitsuba.file")
        where = (path, None)

    root: Path | None = None  # a program may name any file in its own dictionary
    if not spec.allow_outside and spec.file is not None:
        root = spec.folder
    elif not spec.allow_outside and source.file is not None:
        root = path.parent

    def load(review: Callable[[Any], None]) -> MitsubaObject:
        with as_spec_error(*where):
            if source.file is not None:
                return load_mitsuba_scene(mi, path, review, root)
            own = mi.cornell_box() if source.builtin else _plugin_dict(mi, source.inline or {}, spec.file)
            return load_mitsuba_scene(mi, {"type": "scene", **own}, review, root)

    moving = [track.object for track in spec.motion]
    reason: str | None = None
    camera: Used | None = None
    plugin: dict[str, Any] | None = None
    parsed: ParsedDiffuseScene | None = None

    def check(state: Any) -> None:
        nonlocal reason, camera, plugin, parsed
        if state.nodes[0].type != mi.ObjectType.Scene:
            raise SpecError("the Mitsuba file describes no scene", file=source.file or spec.file, key="mitsuba")
        used = used_plugins(mi, state, spec.file)
        reason = exact_reason(used, moving)
        camera = check_camera(used) if spec.camera is None else None
        if spec.max_depth is not None:
            set_depth(used, spec.max_depth)
        plugin = integrator_plugin(used, {"type": "path", "max_depth": spec.max_depth or _DEFAULT_DEPTH, **_ROULETTE})
        parsed = parsed_diffuse_scene(state)

    def check_and_switch_off(state: Any) -> None:
        nonlocal parsed
        check(state)
        try:
            switch_off(state, source.may_shine, [*(source.lit or ()), *source.unlit, *source.waveforms])
        except SpecError as error:
            raise SpecError(str(error), file=spec.file, key="mitsuba") from None
        parsed = parsed_diffuse_scene(state)

    scene = load(check)
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
        scene = load(check_and_switch_off)
    integrator = scene.integrator() or mi.load_dict(plugin)
    seen = None if camera is None else MitsubaCamera.of(mi, scene, camera)
    # scalar variants trace one ray at a time, in the exact mode
    is_vectorised = not mi.variant().startswith("scalar")
    diffuse = loaded_diffuse_scene(mi, scene, parsed) if parsed is not None and is_vectorised else None
    return MitsubaScene(scene, integrator, plugin, reason, seen, diffuse)


def path_tracer(mi: MitsubaModule, depth: int) -> MitsubaObject:
    """Mitsuba's path tracer for paths of up to `depth` segments."""
    return mi.load_dict({"type": "path", "max_depth": depth, **_ROULETTE})


def _plugin_dict(
    mi: MitsubaModule, node: Mapping[str, Any], file: Path | None = None, key: str = "mitsuba.inline"
) -> dict[str, Any]:
    """A Mitsuba dictionary from YAML: 4×4 lists become transforms, lists of numbers in spectra become text.

    Parameters
    ----------
    node : the dictionary as read.
    file, key : file and key of the dictionary, for errors.
    """
    content: dict[str, Any] = {}
    for name, value in node.items():
        require_short_number(str(name), file)
        if name == "type":
            require_known(value, file, key)
        if isinstance(value, Mapping):
            content[name] = _plugin_dict(mi, value, file, f"{key}.{name}")
        elif isinstance(value, list) and np.shape(value) == (4, 4):
            content[name] = transform(mi, value)
        elif isinstance(value, list) and name in ("wavelengths", "values"):
            content[name] = ",".join(f"{float(v):.9g}" for v in value)
        elif isinstance(value, mi.Bitmap):
            content[name] = mi.Bitmap(value)  # a copy: a texture empties its bitmap
        else:
            content[name] = value
    return content


@dataclass(frozen=True)
class MitsubaCamera:
    """A perspective sensor of a Mitsuba scene.

    Parameters
    ----------
    to_world : 4×4, from Mitsuba's axes: x to the left of the picture, y up, view direction +z.
    picture : tangents of the angles between the optical axis and the borders of the picture: left, right, top, bottom;
        positive to the right and downwards. If the film has a crop window, the picture is that window.
    near_m : surfaces nearer than this depth are not seen, m.
    """

    to_world: NDArray[np.float64]
    picture: tuple[float, float, float, float]
    near_m: float

    @classmethod
    def of(cls, mi: MitsubaModule, scene: MitsubaObject, used: Used) -> "MitsubaCamera":
        """The first sensor of a loaded scene.

        Parameters
        ----------
        mi : the mitsuba module.
        scene : the loaded scene.
        used : that sensor, from `check_camera`.

        Raises
        ------
        SpecError
            If the sensor asks for an exposure, or its far plane cuts off shapes.
        """
        sensor = scene.sensors()[0]
        parameters = mi.traverse(sensor)
        if sensor.shutter_open_time() > 0:
            raise used.refused("its shutter_open and shutter_close are an exposure, which the sensor file gives; "
                               "remove them")  # fmt: skip
        to_world = matrix_of(parameters["to_world"])
        far, depth = float(parameters["far_clip"]), _farthest(scene, to_world)
        if depth > far:
            raise used.refused(
                f"its far_clip is {far:g}, and there are shapes up to {depth:g} away, which would be seen here; "
                "give a far_clip beyond them, or remove them"
            )
        film = (parameters[f"film.{key}"] for key in ("size", "crop_size", "crop_offset"))
        size, crop, first = (np.ravel(value).astype(float) for value in film)
        half_x = tan(radians(float(np.ravel(parameters["x_fov"])[0])) / 2)
        half = np.array([half_x, half_x * size[1] / size[0]])
        shift = np.array([float(np.ravel(parameters[f"principal_point_offset_{axis}"])[0]) for axis in "xy"])
        low, high = ((2 * (edge / size + shift) - 1) * half for edge in (first, first + crop))
        picture = float(low[0]), float(high[0]), float(low[1]), float(high[1])
        return cls(to_world, picture, float(parameters["near_clip"]))


def _farthest(scene: MitsubaObject, to_world: NDArray[np.float64]) -> float:
    """Largest depth of anything in a scene along the axis, m; minus infinity in an empty scene."""
    if not scene.shapes():
        return -np.inf
    box = scene.bbox()
    corners = box_corners(*(np.array(corner, dtype=np.float64).ravel() for corner in (box.min, box.max)))
    axis = to_world[:3, 2] / np.linalg.norm(to_world[:3, 2])
    return float(((corners - to_world[:3, 3]) @ axis).max())
