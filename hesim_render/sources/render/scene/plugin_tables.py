"""What is done with each plugin that a Mitsuba scene may name.

A plugin is rendered as Mitsuba renders it, or leads to the exact mode with a reason, or is refused with an alternative.
A few plugins belong to the sensor file, so their settings are ignored. Plugins that are not in these tables are never
loaded, so a scene file cannot name a library to run.
"""

from pathlib import Path
from typing import Any

from hesim_render.core.errors import SpecError

#: Plugins that both modes render as Mitsuba does, by kind.
HONOURED: dict[str, tuple[str, ...]] = {
    "Integrator": ("direct", "path"),
    "Sensor": ("perspective",),
    "Emitter": ("area", "constant", "directional", "envmap", "point", "projector", "spot", "sunsky"),
    "Shape": (
        *("cube", "cylinder", "disk", "obj", "ply", "rectangle", "serialized", "sphere"),
        *("bsplinecurve", "ellipsoids", "ellipsoidsmesh", "linearcurve", "merge", "sdfgrid"),
    ),
    "BSDF": (
        *("blendbsdf", "bumpmap", "conductor", "dielectric", "diffuse", "hair", "mask", "measured", "normalmap"),
        *("null", "plastic", "pplastic", "principled", "principledthin", "roughconductor", "roughdielectric"),
        *("roughplastic", "thindielectric", "twosided"),
    ),
    "Texture": (
        *("bitmap", "blackbody", "checkerboard", "d65", "irregular", "mesh_attribute", "rawconstant", "regular"),
        *("srgb", "uniform", "volume"),
    ),
    "Volume": ("constvolume", "gridvolume"),
}


#: Plugins that only the exact mode renders, and why.
EXACT: dict[str, dict[str, str]] = {
    "Integrator": {
        "volpath": "it follows light through media, not only between surfaces",
        "volpathmis": "it follows light through media, not only between surfaces",
    },
    "Shape": {
        "instance": "it is a copy that has no surface of its own",
        "shapegroup": "its copies have no surface of their own",
    },
    "Medium": {name: "light is followed through it" for name in ("heterogeneous", "homogeneous")},
    "PhaseFunction": {
        name: "it belongs to a medium" for name in ("blendphase", "hg", "isotropic", "rayleigh", "sggx", "tabphase")
    },
}


#: Ignored, because the sensor file decides: pixels are boxes that integrate, with noise of their own.
OF_THE_SENSOR_FILE: dict[str, tuple[str, ...]] = {
    "Film": ("hdrfilm",),
    "Sampler": ("independent", "ldsampler", "multijitter", "orthogonal", "stratified"),
    "ReconstructionFilter": ("box", "catmullrom", "gaussian", "lanczos", "mitchell", "tent"),
}


_UNPOLARISED = "light is rendered without its polarisation, of which this would keep a part; remove it"


_BESIDE = "it adds other quantities to a picture; put the integrator that is inside it in its place"


_DERIVATIVES = "it is made for derivatives; use 'path'"


_CAMERA = "use a 'perspective' sensor, or add a 'camera' section to the scene file"


#: Plugins that are refused, and alternatives.
REFUSED: dict[str, dict[str, str]] = {
    "Integrator": {
        "aov": _BESIDE,
        "moment": _BESIDE,
        "stokes": _BESIDE,
        "depth": "it gives distances, not light; use 'path'",
        "ptracer": "it throws light at a film of its own, and pixels are asked one by one here; use 'path'",
        "prb": _DERIVATIVES,
        "prb_basic": _DERIVATIVES,
        "prb_projective": _DERIVATIVES,
        "direct_projective": "it is made for derivatives; use 'direct'",
        "prbvolpath": "it is made for derivatives; use 'volpath'",
        "volprim_rf_basic": "it shows a radiance field that has no units; use 'path' with emitters and materials",
    },
    "Sensor": {
        "thinlens": f"its depth of field is not rendered: all is in focus here; {_CAMERA}",
        "orthographic": f"a lens sees in perspective; {_CAMERA}",
        "irradiancemeter": f"it has no picture; {_CAMERA}",
        "radiancemeter": f"it has no picture; {_CAMERA}",
        "distant": f"it has no picture; {_CAMERA}",
        "batch": f"it is several cameras at once; {_CAMERA}",
        "flat_sensor": f"it has no picture; {_CAMERA}",
    },
    "Film": {"specfilm": "its channels are responses, which the sensor file gives; use 'hdrfilm'"},
    "Emitter": {
        "directionalarea": "no path from the camera can find its light; use 'directional', 'spot' or 'projector'",
        "timed_sunsky": "its sun moves by a clock of its own; use 'sunsky' with the time of day that is meant",
    },
    "Shape": {"blender": "it is read from the memory of a running Blender; export the mesh as PLY"},
    "BSDF": {name: _UNPOLARISED for name in ("circular", "measured_polarized", "polarizer", "retarder")},
}


#: Class names of objects that a dictionary may contain. (All objects written in Python share one.)
KIND_OF_CLASS: dict[str, tuple[str, str]] = {
    "AOVIntegrator": ("Integrator", "aov"),
    "BatchSensor": ("Sensor", "batch"),
    "BlenderMesh": ("Shape", "blender"),
    "CircularPolarizer": ("BSDF", "circular"),
    "DepthIntegrator": ("Integrator", "depth"),
    "DirectIntegrator": ("Integrator", "direct"),
    "DirectionalArea": ("Emitter", "directionalarea"),
    "Instance": ("Shape", "instance"),
    "LinearPolarizer": ("BSDF", "polarizer"),
    "LinearRetarder": ("BSDF", "retarder"),
    "MeasuredPolarized": ("BSDF", "measured_polarized"),
    "MomentIntegrator": ("Integrator", "moment"),
    "ParticleTracerIntegrator": ("Integrator", "ptracer"),
    "PathIntegrator": ("Integrator", "path"),
    "PerspectiveCamera": ("Sensor", "perspective"),
    "ShapeGroupPlugin": ("Shape", "shapegroup"),
    "SpecFilm": ("Film", "specfilm"),
    "StokesIntegrator": ("Integrator", "stokes"),
    "ThinLensCamera": ("Sensor", "thinlens"),
    "TimedSunskyEmitter": ("Emitter", "timed_sunsky"),
    "VolpathMisIntegratorImpl": ("Integrator", "volpathmis"),
    "VolumetricPathIntegrator": ("Integrator", "volpath"),
}


#: Kind of each plugin.
KIND_OF_PLUGIN = {
    name: kind
    for table in (HONOURED, EXACT, OF_THE_SENSOR_FILE, REFUSED)
    for kind, names in table.items()
    for name in names
}


#: Types that a dictionary may name besides plugins.
BESIDE_PLUGINS = ("scene", "ref", "rgb", "spectrum")


def require_known(name: Any, file: Path | None, key: str) -> None:
    """Refuse a type in a dictionary that is not a plugin of Mitsuba. To examine an unknown type, Mitsuba would load it.

    Raises
    ------
    SpecError
        Names the place.
    """
    if not isinstance(name, str) or (name not in KIND_OF_PLUGIN and name not in BESIDE_PLUGINS):
        raise SpecError(f"type {name!r} is no plugin of Mitsuba's that is known here", file=file, key=key)
