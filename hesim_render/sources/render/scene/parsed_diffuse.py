"""What the parser of Mitsuba says of diffuse surfaces and of lights, before a scene is loaded."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hesim_render.sources.render.scene.parsed_scene import children_of

#: Shapes whose surface is what their BSDF says, and nothing else.
_PLAIN_SHAPES = (
    *("bsplinecurve", "cube", "cylinder", "disk", "linearcurve", "obj", "ply", "rectangle", "sdfgrid"),
    *("serialized", "sphere"),
)
#: Textures that are the same everywhere, and types of properties that are such a colour.
_EVEN_TEXTURES = ("blackbody", "d65", "irregular", "regular", "srgb", "uniform")
_EVEN_TYPES = ("Color", "Float", "Spectrum")
_KINDS_OF_LIGHT = {"point": "point", "directional": "beam", "constant": "sky"}


@dataclass(frozen=True)
class ParsedPaint:
    """What the parser of Mitsuba says of a diffuse surface.

    Parameters
    ----------
    name : id of the shape, empty if it has none.
    light : ``none``; ``lamp`` if the shape may be one of closed form as well; ``even`` or ``uneven`` if its light has
        none, and is the same everywhere or not.
    two_sided, scale : see `Paint`.
    texture : ``even``, ``checks`` or ``picture``; ``other`` if the surface is not diffuse, or has no closed form.
    interpolation, repeats : of a picture.
    """

    name: str
    light: str
    two_sided: bool
    scale: tuple[float, float] = (1.0, 1.0)
    texture: str = "even"
    interpolation: str = "bilinear"
    repeats: bool = True


@dataclass(frozen=True)
class ParsedDiffuseScene:
    """Surfaces of a parsed scene, and kinds of its lights that no shape is, ``other`` without a closed form."""

    paints: list[ParsedPaint]
    lights: list[str]


def parsed_diffuse_scene(state: Any) -> ParsedDiffuseScene | None:
    """What the parser of Mitsuba says of a scene with diffuse surfaces and lights of closed form; None if it says too
    little.

    Parameters
    ----------
    state : the `ParserState`.
    """
    nodes, result = state.nodes, ParsedDiffuseScene([], [])
    if any(_has_objects(node) for node in nodes):
        return None
    for number in children_of(nodes[0]):
        node = nodes[number]
        kind, name = node.type.name, node.props.plugin_name()
        if kind == "Shape":
            paint = _parsed_paint(nodes, node)
            if paint is None:
                return None
            result.paints.append(paint)
        elif kind == "Emitter":
            kind = _KINDS_OF_LIGHT.get(name, "other")
            result.lights.append(kind if _is_even_light(nodes, node) and _is_sampled(node) else "other")
        elif kind not in ("Integrator", "Sensor"):
            return None
    return result


def _has_objects(node: Any) -> bool:
    """True if a node has objects that were made before, of which the parser says nothing."""
    return any(node.props.type(key).name == "Object" for key in node.props)


def _parsed_paint(nodes: Sequence[Any], node: Any) -> ParsedPaint | None:
    """Surface and light of a shape; None if the parser says too little."""
    children = [nodes[number] for number in children_of(node)]
    lamps, bsdfs = ([child for child in children if child.type.name == kind] for kind in ("Emitter", "BSDF"))
    if max(len(lamps), len(bsdfs)) > 1:
        return None
    light = "none"
    if lamps:
        is_even = _is_even_light(nodes, lamps[0])
        light = "uneven" if not is_even else "lamp" if _is_lamp(node) and _is_sampled(lamps[0]) else "even"
    own: dict[str, Any] = {"name": node.props.id(), "light": light, "two_sided": False}
    paint = None
    if node.props.plugin_name() in _PLAIN_SHAPES:
        # what Mitsuba gives a shape without BSDF is diffuse
        paint = _parsed_bsdf(nodes, bsdfs[0], own) if bsdfs else ParsedPaint(**own)
    # what is not diffuse gives no light of closed form
    return paint or ParsedPaint(node.props.id(), light.replace("lamp", "even"), False, texture="other")


def _parsed_bsdf(nodes: Sequence[Any], bsdf: Any, own: dict[str, Any]) -> ParsedPaint | None:
    if bsdf.props.plugin_name() == "twosided":
        inner = children_of(bsdf)
        if len(inner) != 1:
            return None
        own["two_sided"], bsdf = True, nodes[inner[0]]
    if bsdf.props.plugin_name() != "diffuse":
        return None
    texture = _textures(nodes, bsdf).get("reflectance")
    if texture is None or texture.props.plugin_name() in _EVEN_TEXTURES:
        return ParsedPaint(**own) if _is_even(nodes, bsdf, ("reflectance",)) else None
    properties = texture.props
    matrix = np.array(properties["to_uv"].matrix, np.float64) if "to_uv" in properties else np.eye(4)
    u, v = matrix[0, 0], matrix[1, 1]
    if not np.array_equal(matrix[:2], np.eye(len(matrix))[:2] * [[u], [v]]) or u * v == 0:
        return None
    own["scale"] = float(u), float(v)
    if properties.plugin_name() == "checkerboard" and _is_even(nodes, texture, ("color0", "color1")):
        return ParsedPaint(**own, texture="checks")
    wrap, interpolation = (properties.get(key, "") for key in ("wrap_mode", "filter_type"))
    if properties.plugin_name() != "bitmap" or wrap not in ("", "repeat", "clamp"):
        return None
    return ParsedPaint(
        **own, texture="picture", interpolation=interpolation or "bilinear", repeats=wrap in ("", "repeat")
    )


def _is_lamp(node: Any) -> bool:
    """True if the light of a shape that shines may have a closed form: a ball must shine outwards, and a mesh be a
    rectangle.
    """
    name = node.props.plugin_name()
    is_mesh = name in ("obj", "ply", "serialized")
    return is_mesh or name == "rectangle" or (name == "sphere" and not node.props.get("flip_normals", False))


def _is_even_light(nodes: Sequence[Any], node: Any) -> bool:
    """True if a light is the same all over."""
    is_known = node.props.plugin_name() == "area" or node.props.plugin_name() in _KINDS_OF_LIGHT
    return is_known and _is_even(nodes, node, ("radiance", "intensity", "irradiance"))


def _is_sampled(node: Any) -> bool:
    """True if lamps are drawn as usual: one of weight 0 would be left out."""
    return "sampling_weight" not in node.props


def _is_even(nodes: Sequence[Any], node: Any, keys: Iterable[str]) -> bool:
    """True if those of a node's properties that are there are the same everywhere."""
    textures = _textures(nodes, node)
    for key in keys:
        if key in textures:
            if textures[key].props.plugin_name() not in _EVEN_TEXTURES:
                return False
        elif key in node.props and node.props.type(key).name not in _EVEN_TYPES:
            return False
    return True


def _textures(nodes: Sequence[Any], node: Any) -> dict[str, Any]:
    """Nodes that a node refers to, by key."""
    keys = [key for key in node.props if node.props.type(key).name == "ResolvedReference"]
    return {key: nodes[node.props[key].index()] for key in keys}
