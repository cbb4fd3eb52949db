"""Diffuse surfaces under lights of closed form, as `transport.diffuse` renders them.

Those of this project's own objects are described by their file. Those of Mitsuba are read twice: the parsed scene says
what its surfaces and lights are, and the loaded one has their spectra, pictures and places.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import pi

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device import dr
from hesim_render.core.device_types import Bands, Interaction, MitsubaModule, MitsubaObject
from hesim_render.core.errors import SpecError
from hesim_render.core.host_arrays import from_host
from hesim_render.sources.render.scene.direct_lights import DirectLight
from hesim_render.sources.render.scene.lamp_frames import lamp_frame
from hesim_render.sources.render.scene.mitsuba_version import ball_of, matrix_of, names_of
from hesim_render.sources.render.scene.parsed_diffuse import ParsedDiffuseScene, ParsedPaint
from hesim_render.sources.render.scene.pictures import TextureData
from hesim_render.sources.render.scene.surfaces import Paint
from hesim_render.spectral.spectrum import RENDERABLE_NM, Spectrum, constant

#: Distance of a spectrum's first and last sample from the zeros next to them, nm.
_JUMP_NM = 1e-3
#: Largest number of lights in closed form: a kernel takes each of them for every ray.
_MOST_LIGHTS = 64


@dataclass(frozen=True)
class DiffuseScene:
    """Diffuse surfaces and the lights on them.

    Parameters
    ----------
    paints : paint of all shapes that reflect light diffusely.
    lights : lights of closed form that are on; a sky comes last.
    others : names of the shapes that reflect it in another way.
    glows : names of the shapes that shine without a closed form, and their radiance, W m⁻² sr⁻¹ nm⁻¹; None of one that
        is not the same everywhere.
    more_lights : numbers of lights without a closed form among those that no shape is.
    """

    paints: list[Paint]
    lights: list[DirectLight]
    others: list[str] = field(default_factory=list)
    glows: dict[str, Spectrum | None] = field(default_factory=dict)
    more_lights: list[int] = field(default_factory=list)

    @property
    def needs_paths(self) -> bool:
        """True if some direct light has no closed form."""
        return bool(self.others or self.glows or self.more_lights)


def loaded_diffuse_scene(mi: MitsubaModule, scene: MitsubaObject, parsed: ParsedDiffuseScene) -> DiffuseScene | None:
    """The paints and lights of a loaded scene; None if no light of it has a closed form.

    Parameters
    ----------
    mi : the mitsuba module.
    scene : mitsuba.Scene.
    parsed : of this scene.
    """
    shapes, lights = scene.shapes(), [light for light in scene.emitters() if light.get_shape() is None]
    # both lists are in the order of the file
    if [(s.id(), s.is_emitter()) for s in shapes] != [(p.name, p.light != "none") for p in parsed.paints]:
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
        is_ball = shape.class_name() == "Sphere"
        is_other = paint.texture == "other" or (paint.texture == "picture" and picture is None)
        place = None
        if paint.light == "lamp" and not is_other and len(result.lights) < _MOST_LIGHTS:
            place = ball_of(shape) if is_ball else lamp_frame(reader.mi, shape)
        if place is not None:
            own = reader.radiance(shape), 1.0, place, name
            result.lights.append(DirectLight("ball", *own) if is_ball else DirectLight("rectangle", *own))
        elif paint.light != "none":
            result.glows[name] = None if paint.light == "uneven" else reader.radiance(shape)
        if is_other:
            result.others.append(name)
            continue
        colours = (constant(1.0),) if picture is not None else reader.colours(shape, paint)
        scale, repeats = paint.scale, picture is not None and paint.repeats
        result.paints.append(Paint(name, colours, scale, paint.two_sided, picture, repeats))
    # a sky comes last
    for number in sorted(range(len(lights)), key=lambda number: parsed.lights[number] == "sky"):
        if parsed.lights[number] == "other" or len(result.lights) >= _MOST_LIGHTS:
            result.more_lights.append(number)
        else:
            result.lights.append(reader.light(parsed.lights[number], lights[number]))
    return result if result.lights else None


class _Reader:
    """Reads spectra, pictures and places of loaded objects.

    Parameters
    ----------
    mi : the mitsuba module.
    """

    def __init__(self, mi: MitsubaModule) -> None:
        self.mi = mi

    def colours(self, shape: MitsubaObject, paint: ParsedPaint) -> tuple[Spectrum, ...]:
        """One or two reflectances of a surface without a picture."""
        mi, bsdf = self.mi, shape.bsdf()
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
        parameters = self.mi.traverse(shape.bsdf())
        (key,) = (name for name, _ in parameters if name.endswith("reflectance.data"))
        values = np.array(parameters[key], np.float32)
        is_raw = "raw = 1" in str(shape.bsdf())
        if values.shape[2] not in (1, 3) or (is_raw and values.shape[2] == 3):
            return None
        return TextureData(values, paint.interpolation)

    def radiance(self, shape: MitsubaObject) -> Spectrum:
        """Radiance of a lamp, W m⁻² sr⁻¹ nm⁻¹."""
        return self._spectrum(shape.emitter(), shape.emitter().eval)

    def light(self, kind: str, light: MitsubaObject) -> DirectLight:
        """A light that no shape is."""
        mi = self.mi
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
        mi = self.mi

        def evaluate(si: Interaction) -> Bands:
            si.p = mi.Point3f(place)
            return light.sample_direction(si, mi.Point2f(0.5))[1]

        return self._spectrum(light, evaluate)

    def _spectrum(self, owner: MitsubaObject, evaluate: Callable[[Interaction], Bands]) -> Spectrum:
        """What an object evaluates, by wavelength: at every nm, and at the samples of its tables."""
        mi = self.mi
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
