"""The plugins of a parsed Mitsuba scene: their places, and what follows from the tables of `plugin_tables`."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hesim_render.core.device_types import MitsubaModule
from hesim_render.core.errors import SpecError
from hesim_render.sources.render.scene.mitsuba_version import files_readable
from hesim_render.sources.render.scene.parsed_scene import children_of
from hesim_render.sources.render.scene.plugin_tables import (
    EXACT,
    HONOURED,
    KIND_OF_CLASS,
    KIND_OF_PLUGIN,
    OF_THE_SENSOR_FILE,
    REFUSED,
)

#: Shapes that stay round whatever their transform, and the largest part by which it may differ from a scale.
_ROUND, _UNEVEN = ("sphere", "cylinder"), 1e-3
#: Largest value of a picture of light, but for rounding.
_WHITE = 1.001
_THROUGH_MEDIA = ("volpath", "volpathmis")
#: Integrators whose path length can be set.
_HAVE_DEPTH = ("path", *_THROUGH_MEDIA)
#: Kinds that belong to a camera; they are checked only if that camera is used.
OF_A_CAMERA = ("Sensor", "Film", "Sampler", "ReconstructionFilter")
#: Kinds that do nothing in a scene by themselves; shapes, lights and cameras use them.
_OF_OTHERS = ("BSDF", "Texture", "Volume", "Medium", "PhaseFunction")
_PLACE = re.compile(r"(?P<file>.+) \(line (?P<line>\d+), col \d+\)")
_KEY = re.compile(r'dictionary node "(?P<key>.*)"')


@dataclass(frozen=True)
class Used:
    """One plugin of a parsed scene.

    Parameters
    ----------
    kind, name : kind and type name of the plugin.
    own_id : its id, empty if it has none.
    place : arguments of a `SpecError` that state its place.
    node : node of Mitsuba's parser; None for an object given in a dictionary.
    owners : nodes that contain it.
    """

    kind: str
    name: str
    own_id: str
    place: Mapping[str, Any]
    node: Any
    owners: tuple[Any, ...]

    def refused(self, why: str) -> SpecError:
        """The error that this plugin is not rendered."""
        return SpecError(f"{self}: {why}", **self.place)

    def __str__(self) -> str:
        return f"{self.kind if self.kind == 'BSDF' else self.kind.lower()} '{self.name}'"


def used_plugins(mi: MitsubaModule, state: Any, file: Path | None) -> list[Used]:
    """The plugins of a parsed scene, in order; `file` is the scene file, for a dictionary within it.

    What no shape, light, camera or integrator uses is taken out of the scene: it decides nothing, and is not loaded.

    Raises
    ------
    SpecError
        If a plugin is not one of Mitsuba's, used or not.
    """
    nodes, types = list(state.nodes), mi.Properties.Type
    for node in nodes:
        name = node.props.plugin_name()
        if name not in KIND_OF_PLUGIN and node.type.name != "Scene":
            unknown = Used(_kind_of(node), name, node.props.id(), _place(mi, state, node, file), node, ())
            raise unknown.refused(_unknown(unknown.kind))
    _leave_out_unused(mi, nodes)
    owners: list[list[Any]] = [[] for _ in nodes]
    reached, waiting = {0}, [0]
    while waiting:
        node = nodes[waiting.pop()]
        for number in children_of(node):
            owners[number].append(node)
            if number not in reached:
                reached.add(number)
                waiting.append(number)
    used_nodes: list[Used] = []
    for number in sorted(reached):
        node, above = nodes[number], owners[number]
        place, name, kind = _place(mi, state, node, file), node.props.plugin_name(), _kind_of(node)
        if kind != "Scene":
            used_nodes.append(Used(kind, name, node.props.id(), place, node, tuple(above)))
        for key in node.props:
            if node.props.type(key) == types.Object:
                inside = {**place, "key": ".".join(filter(None, (place.get("key"), key)))}
                used_nodes.extend(_made(mi, node.props[key], inside, node))
    return used_nodes


def _kind_of(node: Any) -> str:
    """Kind of a node. A parsed dictionary does not state that of an object written in Python."""
    return (
        KIND_OF_PLUGIN.get(node.props.plugin_name(), "Plugin") if node.type.name == "Unknown" else str(node.type.name)
    )


def _leave_out_unused(mi: MitsubaModule, nodes: Sequence[Any]) -> None:
    """Remove from the scene itself, the first node, what only other objects can use, and groups without copies."""
    types, scene = mi.Properties.Type, nodes[0].props
    copied = {number for node in nodes if node.props.plugin_name() == "instance" for number in children_of(node)}
    for key in list(scene.keys()):
        if scene.type(key) == types.ResolvedReference:
            number = scene[key].index()
            is_group = nodes[number].props.plugin_name() == "shapegroup"
            unused = number not in copied if is_group else _kind_of(nodes[number]) in _OF_OTHERS
        else:
            made = scene[key] if scene.type(key) == types.Object else None
            unused = isinstance(made, (mi.BSDF, mi.Texture, mi.Volume, mi.Medium, mi.PhaseFunction))
        if unused:
            del scene[key]


def _place(mi: MitsubaModule, state: Any, node: Any, file: Path | None) -> dict[str, Any]:
    """Arguments of a `SpecError` that state the place of a node."""
    location, own = mi.parser.file_location(state, node), node.props.id()
    if match := _PLACE.fullmatch(location):
        return {"file": match["file"], "line": int(match["line"]), "key": own or None}
    match = _KEY.fullmatch(location)
    inside = "" if match is None or match["key"] == "root" else f".{match['key']}"
    return {"file": file, "key": f"mitsuba.inline{inside}"}


def _made(mi: MitsubaModule, value: Any, place: Mapping[str, Any], owner: Any) -> Iterator[Used]:
    """An object given in a dictionary, and the objects in it."""
    if not isinstance(value, mi.Object):
        return
    for item in mi.traverse(value).hierarchy:
        name = item.class_name()
        kinds = (mi.Integrator, mi.Sensor, mi.Shape, mi.Medium)
        kind = next((kind.__name__ for kind in kinds if isinstance(item, kind)), "")
        if name in KIND_OF_CLASS:
            kind, name = KIND_OF_CLASS[name]
        elif kind == "Medium":
            name = name.removesuffix("Medium").lower()
        if kind:
            yield Used(kind, name, item.id(), place, None, (owner,))


def exact_reason(plugins: Iterable[Used], moving: Iterable[str]) -> str | None:
    """Why a scene needs the exact mode; None if it does not.

    Parameters
    ----------
    plugins : from `used_plugins`.
    moving : ids of shapes that move.

    Raises
    ------
    SpecError
        If a plugin is not rendered.
    """
    plugins, moved = list(plugins), set(moving)
    reason = None
    for used in plugins:
        if used.kind in OF_A_CAMERA:
            continue
        if (why := _why_refused(used)) is not None:
            raise used.refused(why)
        if used.node is None and used.kind == "Shape" and used.own_id in moved:
            raise used.refused("it moves, and was made before, so that it would keep its pose; give it as a dictionary")
        exact = EXACT.get(used.kind, {}).get(used.name) or _exact_where_it_moves(used, moved)
        if exact and reason is None:
            reason = f"{used}: {exact}"
    _check_media(plugins, moved)
    return reason


def _why_refused(used: Used) -> str | None:
    why = REFUSED.get(used.kind, {}).get(used.name)
    if why is not None or used.name in EXACT.get(used.kind, {}):
        return why
    if used.node is None and used.kind not in ("Integrator", "Sensor"):
        return None  # an object of a Mitsuba class that no table refuses
    if used.name in _ROUND and (why := _why_not_round(used.node.props)) is not None:
        return why
    if used.name == "bitmap" and any(owner.type.name == "Emitter" for owner in used.owners):
        return _why_too_bright(used.node.props)
    known = HONOURED.get(used.kind, ()) + OF_THE_SENSOR_FILE.get(used.kind, ())
    return None if used.name in known else _unknown(used.kind)


def _why_not_round(properties: Any) -> str | None:
    """Why a sphere or a cylinder would become another shape than its transform says; Mitsuba only logs that."""
    matrix = np.eye(3)
    if "to_world" in properties:
        matrix = np.array(properties["to_world"].matrix, np.float64)[:3, :3]
    if "p0" in properties and "p1" in properties:
        axis = np.subtract(properties["p1"], properties["p0"], dtype=np.float64)
        matrix = matrix @ np.linalg.svd(axis[None])[2].T[:, [1, 2, 0]]
    # a rotation times a scale has perpendicular columns, and those across the axis are of the same length
    products = matrix.T @ matrix
    across = 2 if properties.plugin_name() == "cylinder" else 3
    even = np.diag(np.concatenate([np.full(across, products[0, 0]), np.diag(products)[across:]]))
    if np.abs(products - even).max() <= _UNEVEN * np.abs(products).max():
        return None
    return "its to_world scales it unevenly, and Mitsuba would leave it round; use a mesh, or an 'instance' of it"


def _why_too_bright(properties: Any) -> str | None:
    """Why Mitsuba would not shine as the picture of a lamp says: in spectral scenes it cuts pictures at 1, silently."""
    import mitsuba as mi

    picture = properties.get("bitmap", None) or properties.get("data", None)
    if picture is None:
        with files_readable():
            picture = mi.Bitmap(str(mi.file_resolver().resolve(properties["filename"])))  # type: ignore[operator]
    values = np.array(picture)
    if values.dtype.kind != "f" or not values.size or float(values.max()) <= _WHITE:
        return None
    return (
        f"the picture of a lamp has values up to {values.max():.3g}, and Mitsuba cuts them at 1; scale the picture to "
        "1, and the light with radiance_scale or a level"
    )


def _unknown(kind: str) -> str:
    known = HONOURED.get(kind, ()) + OF_THE_SENSOR_FILE.get(kind, ())
    return f"it is not known here; use one of {', '.join(sorted(known))}"


def _exact_where_it_moves(used: Used, moved: set[str]) -> str | None:
    if used.kind == "Texture" and used.name == "volume" and moved:
        return "it stays where it is while shapes move through it"
    if used.name == "sdfgrid" and used.own_id in moved:
        return "it moves, and its surface is found by steps"
    return None


def _check_media(plugins: Iterable[Used], moved: set[str]) -> None:
    """Refuse media that the integrator would not see, or that would not move with their shape."""
    integrator = next((used.name for used in plugins if used.kind == "Integrator"), None)
    for used in plugins:
        shapes = [owner for owner in used.owners if owner.type.name == "Shape"]
        if used.kind != "Medium" or (used.node is not None and not shapes):
            continue
        if integrator not in _THROUGH_MEDIA:
            own = f"integrator '{integrator}'" if integrator else "'path', which is used where there is no integrator,"
            raise used.refused(f"{own} does not see media; use 'volpath' or 'volpathmis', or remove the medium")
        if used.name == "heterogeneous" and any(shape.props.id() in moved for shape in shapes):
            raise used.refused("the shape around it moves, and its volume would not; use a 'homogeneous' medium")


def set_depth(plugins: Iterable[Used], depth: int) -> bool:
    """Set the path length of a parsed scene's integrator; returns False if the scene has no integrator.

    Raises
    ------
    SpecError
        If the integrator has no path length.
    """
    for used in plugins:
        if used.kind != "Integrator":
            continue
        if used.node is None:
            raise used.refused("it was made before, so that max_depth cannot be set; give it as a dictionary")
        if used.name in _HAVE_DEPTH:
            used.node.props["max_depth"] = depth
        elif depth != 2:  # 'direct' has depth 2
            raise used.refused(f"it has no path length, and the scene file asks for max_depth {depth}; use 'path'")
        return True
    return False


def integrator_plugin(plugins: Iterable[Used], otherwise: dict[str, Any]) -> dict[str, Any] | None:
    """A parsed scene's integrator as a dictionary; `otherwise` if there is none; None if it was given as an object."""
    for used in plugins:
        if used.kind == "Integrator":
            return None if used.node is None else {"type": used.name, **dict(used.node.props.items())}
    return otherwise


def check_camera(plugins: Iterable[Used]) -> Used | None:
    """The first sensor of a parsed scene, None if it has no sensor.

    Raises
    ------
    SpecError
        If the sensor asks for something that is not rendered; the message has plugin, place and alternative.
    """
    plugins = list(plugins)
    first = next((used for used in plugins if used.kind == "Sensor"), None)
    if first is None:
        return None
    for used in plugins:
        own = used.place is first.place if first.node is None else any(owner is first.node for owner in used.owners)
        if used is not first and not own:
            continue
        if (why := _why_refused(used)) is not None:
            raise used.refused(why)
        if used.kind == "Medium":
            raise used.refused("the camera stands in it, which is not rendered; put the camera outside")
        if used.kind == "Texture":
            raise used.refused("it is the camera's 'srf', and the responses are the sensor file's; remove it")
    return first
