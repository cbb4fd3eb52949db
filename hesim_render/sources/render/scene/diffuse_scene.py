"""Diffuse surfaces under lights of closed form, as `transport.diffuse` renders them.

Those of this project's own objects are described by their file. Those of Mitsuba are read twice: the parsed scene says
what its surfaces and lights are, and the loaded one has their spectra, pictures and places.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from math import pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device import dr
from hesim_render.core.device_types import Bands, Interaction, MitsubaModule, MitsubaObject
from hesim_render.core.errors import SpecError
from hesim_render.core.host_arrays import from_host
from hesim_render.sources.render.scene.direct_lights import DirectLight
from hesim_render.sources.render.scene.mitsuba_version import ball_of, matrix_of, names_of
from hesim_render.sources.render.scene.parsed_scene import children_of
from hesim_render.sources.render.scene.pictures import TextureData
from hesim_render.sources.render.scene.surfaces import Paint
from hesim_render.spectral.spectrum import RENDERABLE_NM, Spectrum, constant

#: Shapes whose surface is what their BSDF says, and nothing else.
_PLAIN_SHAPES = ("cube", "cylinder", "disk", "obj", "ply", "rectangle", "serialized", "sphere")
#: Textures that are the same everywhere, and types of properties that are such a colour.
_EVEN_TEXTURES = ("blackbody", "d65", "irregular", "regular", "srgb", "uniform")
_EVEN_TYPES = ("Color", "Float", "Spectrum")
_KINDS_OF_LIGHT = {"point": "point", "directional": "beam", "constant": "sky"}
#: Largest cosine between the sides of a rectangle.
_RIGHT_ANGLED = 1e-5
#: Distance of a spectrum's first and last sample from the zeros next to them, nm.
_JUMP_NM = 1e-3


@dataclass(frozen=True)
class DiffuseScene:
    """Diffuse surfaces and the lights on them.

    Parameters
    ----------
    paints : paint of all shapes that reflect light diffusely.
    lights : all lights that are on; a sky comes last.
    others : names of the shapes that reflect it in another way, none of which shines.
    """

    paints: list[Paint]
    lights: list[DirectLight]
    others: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class ParsedPaint:
    """What the parser of Mitsuba says of a diffuse surface.

    Parameters
    ----------
    name : id of the shape, empty if it has none.
    shines : True if the shape is a lamp as well.
    two_sided, scale : see `Paint`.
    texture : ``even``, ``checks`` or ``picture``; ``other`` if the surface is not diffuse, or has no closed form.
    interpolation, repeats : of a picture.
    """

    name: str
    shines: bool
    two_sided: bool
    scale: tuple[float, float] = (1.0, 1.0)
    texture: str = "even"
    interpolation: str = "bilinear"
    repeats: bool = True


@dataclass(frozen=True)
class ParsedDiffuseScene:
    """Surfaces of a parsed scene, and kinds of its lights that no shape is."""

    paints: list[ParsedPaint]
    lights: list[str]


def parsed_diffuse_scene(state: Any) -> ParsedDiffuseScene | None:
    """What the parser of Mitsuba says of a scene of diffuse surfaces under lights of closed form; None of others.

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
            if name not in _KINDS_OF_LIGHT or not _is_even_light(nodes, node):
                return None
            result.lights.append(_KINDS_OF_LIGHT[name])
        elif kind not in ("Integrator", "Sensor"):
            return None
    return result


def _has_objects(node: Any) -> bool:
    """True if a node has objects that were made before, of which the parser says nothing."""
    return any(node.props.type(key).name == "Object" for key in node.props)


def _parsed_paint(nodes: Sequence[Any], node: Any) -> ParsedPaint | None:
    """A shape with a diffuse surface; None of others."""
    children = [nodes[number] for number in children_of(node)]
    lamps, bsdfs = ([child for child in children if child.type.name == kind] for kind in ("Emitter", "BSDF"))
    if node.props.plugin_name() not in _PLAIN_SHAPES or max(len(lamps), len(bsdfs)) > 1:
        return None
    if lamps and not (_is_lamp(node) and _is_even_light(nodes, lamps[0])):
        return None
    own: dict[str, Any] = {"name": node.props.id(), "shines": bool(lamps), "two_sided": False}
    if not bsdfs:
        return ParsedPaint(**own)  # what Mitsuba gives a shape without BSDF is diffuse
    paint = _parsed_bsdf(nodes, bsdfs[0], own)
    if paint is None and not lamps:
        return ParsedPaint(node.props.id(), False, False, texture="other")
    return paint


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
    """True if the light of a shape that shines has a closed form: a ball must shine outwards."""
    name = node.props.plugin_name()
    return name == "rectangle" or (name == "sphere" and not node.props.get("flip_normals", False))


def _is_even_light(nodes: Sequence[Any], node: Any) -> bool:
    """True if a light is the same all over, and lamps are drawn as usual: one of weight 0 would be left out."""
    is_known = node.props.plugin_name() == "area" or node.props.plugin_name() in _KINDS_OF_LIGHT
    keys = ("radiance", "intensity", "irradiance")
    return is_known and "sampling_weight" not in node.props and _is_even(nodes, node, keys)


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


def loaded_diffuse_scene(mi: MitsubaModule, scene: MitsubaObject, parsed: ParsedDiffuseScene) -> DiffuseScene | None:
    """The paints and lights of a loaded scene; None if one of them has no closed form.

    Parameters
    ----------
    mi : the mitsuba module.
    scene : mitsuba.Scene.
    parsed : of this scene.
    """
    shapes, lights = scene.shapes(), [light for light in scene.emitters() if light.get_shape() is None]
    # both lists are in the order of the file
    if [(shape.id(), shape.is_emitter()) for shape in shapes] != [(p.name, p.shines) for p in parsed.paints]:
        return None
    if len(lights) != len(parsed.lights):
        return None
    try:
        return _read(_Reader(mi), shapes, lights, parsed)
    except SpecError:
        return None  # a spectrum that is not finite, of which a render says who sees it


def _read(
    reader: "_Reader", shapes: Sequence[MitsubaObject], lights: Sequence[MitsubaObject], parsed: ParsedDiffuseScene
) -> DiffuseScene | None:
    """See `loaded_diffuse_scene`."""
    result = DiffuseScene([], [])
    for name, shape, paint in zip(names_of(shapes), shapes, parsed.paints, strict=True):
        picture = reader.picture(shape, paint)
        if paint.texture == "other" or (paint.texture == "picture" and picture is None):
            if paint.shines:
                return None
            result.others.append(name)
            continue
        colours = (constant(1.0),) if picture is not None else reader.colours(shape, paint)
        scale, repeats = paint.scale, picture is not None and paint.repeats
        result.paints.append(Paint(name, colours, scale, paint.two_sided, picture, repeats))
        if paint.shines:
            is_ball = shape.class_name() == "Sphere"
            place = ball_of(shape) if is_ball else reader.frame(shape)
            if place is None:
                return None
            own = reader.radiance(shape), 1.0, place, name
            result.lights.append(DirectLight("ball", *own) if is_ball else DirectLight("rectangle", *own))
    # a sky comes last
    for kind, light in sorted(zip(parsed.lights, lights, strict=True), key=lambda pair: pair[0] == "sky"):
        result.lights.append(reader.light(kind, light))
    return result


class _Reader:
    """Reads spectra, pictures and places of loaded objects.

    Parameters
    ----------
    mi : the mitsuba module.
    """

    def __init__(self, mi: MitsubaModule) -> None:
        self._mi = mi

    def colours(self, shape: MitsubaObject, paint: ParsedPaint) -> tuple[Spectrum, ...]:
        """One or two reflectances of a surface without a picture."""
        mi, bsdf = self._mi, shape.bsdf()
        # places in a square of each colour
        places = [(0.25, 0.25), (0.75, 0.25)] if paint.texture == "checks" else [(0.0, 0.0)]

        def at(u: float, v: float) -> Spectrum:
            def evaluate(si: Interaction) -> Bands:
                si.uv = mi.Point2f(u / paint.scale[0], v / paint.scale[1])
                return bsdf.eval_diffuse_reflectance(si)

            return self._spectrum(bsdf, evaluate)

        return tuple(at(*place) for place in places)

    def picture(self, shape: MitsubaObject, paint: ParsedPaint) -> TextureData | None:
        """The picture on a surface; None for none, or if it is not one of reflectances."""
        if paint.texture != "picture":
            return None
        parameters = self._mi.traverse(shape.bsdf())
        (key,) = (name for name, _ in parameters if name.endswith("reflectance.data"))
        values = np.array(parameters[key], np.float32)
        is_raw = "raw = 1" in str(shape.bsdf())
        if values.shape[2] not in (1, 3) or (is_raw and values.shape[2] == 3):
            return None
        return TextureData(values, paint.interpolation)

    def radiance(self, shape: MitsubaObject) -> Spectrum:
        """Radiance of a lamp, W m⁻² sr⁻¹ nm⁻¹."""
        return self._spectrum(shape.emitter(), shape.emitter().eval)

    def frame(self, shape: MitsubaObject) -> NDArray[np.float64] | None:
        """The frame of a rectangle, see `area_light_frame`; None if it has no right angles."""
        mi = self._mi
        frame = matrix_of(mi.traverse(shape)["to_world"])
        width, height = frame[:3, 0].copy(), frame[:3, 1]
        if abs(width @ height) > _RIGHT_ANGLED * np.linalg.norm(width) * np.linalg.norm(height):
            return None
        normal = np.array(shape.sample_position(0.0, mi.Point2f(0.5)).n, np.float64).ravel()
        # corners run anticlockwise for who sees it shine
        frame[:3, 0] = width if np.cross(width, height) @ normal > 0 else -width
        frame[:3, 2] = normal
        return frame

    def light(self, kind: str, light: MitsubaObject) -> DirectLight:
        """A light that no shape is."""
        mi = self._mi
        if kind == "sky":
            return DirectLight("sky", self._spectrum(light, light.eval).scaled(pi), pi, np.empty(0))
        parameters = mi.traverse(light)
        if kind == "point":
            position = np.array(parameters["position"], np.float64).ravel()
            # a point at a distance of 1 m receives the intensity
            strength = self._from(light, position + np.array([0.0, 0.0, 1.0]))
            return DirectLight("point", strength, 1.0, position)
        matrix = matrix_of(parameters["to_world"])
        direction = matrix[:3, 2] / np.linalg.norm(matrix[:3, 2])
        return DirectLight("beam", self._from(light, np.zeros(3)), 1.0, direction)

    def _from(self, light: MitsubaObject, place: NDArray[np.float64]) -> Spectrum:
        """Irradiance that a point or directional light gives a place across its rays, W m⁻² nm⁻¹."""
        mi = self._mi

        def evaluate(si: Interaction) -> Bands:
            si.p = mi.Point3f(place)
            return light.sample_direction(si, mi.Point2f(0.5))[1]

        return self._spectrum(light, evaluate)

    def _spectrum(self, owner: MitsubaObject, evaluate: Callable[[Interaction], Bands]) -> Spectrum:
        """What an object evaluates, by wavelength: at every nm, and at the samples of its tables."""
        mi = self._mi
        low, high = RENDERABLE_NM
        knots = [np.arange(low, high + 1), *_tables_of(mi, owner)]
        nm = np.unique(np.concatenate(knots))
        nm = nm[(nm >= low) & (nm <= high)]
        si = dr.zeros(mi.SurfaceInteraction3f, nm.size)
        si.wi, si.wavelengths = mi.Vector3f(0, 0, 1), mi.UnpolarizedSpectrum(from_host(mi.Float, nm))
        values = np.array(evaluate(si)[0], np.float64)
        return Spectrum(nm, np.broadcast_to(values, nm.shape))


def _tables_of(mi: MitsubaModule, owner: MitsubaObject) -> list[NDArray[np.float64]]:
    """Wavelengths of all tables of spectra in an object, nm, with places just beyond their ends."""
    result = []
    parameters = mi.traverse(owner)
    for name, value in parameters:
        if name.endswith("wavelengths"):
            own = np.array(value, np.float64).ravel()
        elif name.endswith(".range"):
            first, last = np.array(value, np.float64)
            own = np.linspace(first, last, len(parameters[name.removesuffix("range") + "values"]))
        else:
            continue
        result.append(np.concatenate([[own[0] - _JUMP_NM], own, [own[-1] + _JUMP_NM]]))
    return result
