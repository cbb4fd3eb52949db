"""Absolute light of Mitsuba scenes: the factor on their radiance that gives a wanted level on a plane.

The irradiance of all light together, interreflections included, is measured by paths from a point of the plane. Light
sampling and directions of a Lambertian surface are combined at that point by multiple importance sampling [veach1995];
beyond it, the scene's own integrator is used.

The levels of all lights of a scene at any time follow from its file.
"""

from dataclasses import asdict, dataclass
from math import ceil, log2, pi
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, MitsubaModule, MitsubaObject
from hesim_render.core.errors import SpecError
from hesim_render.core.rng import Stream, stream_key
from hesim_render.sources.render.sampling.sampler import sampler_class
from hesim_render.sources.render.sampling.wavelengths import WavelengthSampler
from hesim_render.sources.render.scene.builder import BuiltScene, build
from hesim_render.sources.render.scene.mitsuba_version import mitsuba
from hesim_render.sources.render.transport.paths import power_heuristic
from hesim_render.sources.scene import Scene
from hesim_render.specs.mitsuba_scene import MitsubaSpec
from hesim_render.specs.scene import SceneSpec
from hesim_render.spectral.spectrum import LUMINOUS_EFFICACY_LM_PER_W, RENDERABLE_NM, Spectrum, constant, photopic
from hesim_render.spectral.waveform import Waveform

#: Relative standard error that is aimed at, and the largest one that is accepted.
WISH, MOST_ERROR = 1e-3, 1e-2
#: Number of independent estimates, whose scatter gives the error; rays of each in the pilot, and at most.
_ESTIMATES, _LOOK, _MOST = 64, 1 << 10, 1 << 17
#: Rays at a time.
_BLOCK = 1 << 20


@dataclass(frozen=True)
class LightLevel:
    """A wanted level of light, and how it was reached.

    Parameters
    ----------
    level : wanted level on the plane at t = 0, in `unit`.
    unit : lx or W m⁻².
    plane_point_m, plane_normal : point, m, and normal of the plane.
    measured : level with a factor of 1, in `unit`.
    error : relative standard error of `measured`.
    radiance_scale : factor on the scene's radiance.
    rays : number of rays of the measurement.
    """

    level: float
    unit: str
    plane_point_m: tuple[float, float, float]
    plane_normal: tuple[float, float, float]
    measured: float
    error: float
    radiance_scale: float
    rays: int

    def as_dict(self) -> dict[str, Any]:
        """The fields as plain values."""
        return asdict(self)


def in_absolute_light(scene: Scene) -> tuple[Scene, LightLevel | None]:
    """The scene with a factor on its radiance instead of a level, and how the factor was found.

    A scene without a level is returned unchanged, with None. All lit emitters count at their time means, and everything
    stands where it does at t = 0. The numbers are a pure function of the scene.

    Raises
    ------
    SpecError
        If the scene cannot be loaded, no light reaches the plane, or the level is uncertain by more than `MOST_ERROR`.
    """
    source = scene.spec.mitsuba
    if source is None or not source.has_level:
        return scene, None
    level = _measured(scene.spec, source)
    scaled = source.model_copy(
        update={"radiance_scale": level.radiance_scale, "illuminance_lux": None, "irradiance_w_m2": None,
                "plane_point_m": None, "plane_normal": None}
    )  # fmt: skip
    return Scene(scene.spec.model_copy(update={"mitsuba": scaled})), level


def _measured(spec: SceneSpec, source: MitsubaSpec) -> LightLevel:
    assert source.plane_point_m is not None and source.plane_normal is not None
    if source.illuminance_lux is not None:
        level, unit, key = source.illuminance_lux, "lx", "mitsuba.illuminance_lux"
        response = photopic().scaled(LUMINOUS_EFFICACY_LM_PER_W)
    else:
        assert source.irradiance_w_m2 is not None
        level, unit, key = source.irradiance_w_m2, "W m^-2", "mitsuba.irradiance_w_m2"
        response = constant(1.0, *RENDERABLE_NM)
    built = build(mitsuba(), spec)
    built.pose(0.0)
    meter = _Meter(built, spec, key, response, source.plane_point_m, source.plane_normal)
    look = meter.estimates(_LOOK, Stream.LIGHT_LEVEL_PILOT)
    # a separate pilot decides the number of rays, so that the decision does not bias the estimate
    scatter = float(_error(look))
    rays = min(_MOST, max(_LOOK, 1 << ceil(log2(max(1.0, _LOOK * (scatter / WISH) ** 2)))))
    values = meter.estimates(rays, Stream.LIGHT_LEVEL)
    built.rest()
    mean, error = float(values.mean()), float(_error(values))
    if not mean > 0:
        raise SpecError("no light of the scene reaches the plane from the front (see plane_point_m, plane_normal)",
                        file=spec.file, key=key)  # fmt: skip
    if error > MOST_ERROR:
        raise SpecError(
            f"the light on the plane can be measured to {100 * error:.2g} % only (glass, or a lamp in a niche?); take "
            "another point, or give radiance_scale",
            file=spec.file,
            key=key,
        )
    normal = tuple((np.array(source.plane_normal) / np.linalg.norm(source.plane_normal)).tolist())
    return LightLevel(level, unit, source.plane_point_m, normal, mean, error, level / mean, rays * _ESTIMATES)


def _error(values: np.ndarray) -> float:
    """Relative standard error of the mean of independent estimates; 1 if the mean is not above 0."""
    mean = values.mean()
    return float(values.std(ddof=1) / np.sqrt(values.size) / mean) if mean > 0 else 1.0


class _Meter:
    """Measures light on a plane.

    Parameters
    ----------
    built : the scene, posed.
    spec, key : scene file and key, for errors.
    response : response to the spectral irradiance.
    point, normal : point and normal of the plane; the normal may have any length.
    """

    def __init__(
        self,
        built: BuiltScene,
        spec: SceneSpec,
        key: str,
        response: Spectrum,
        point: tuple[float, float, float],
        normal: tuple[float, float, float],
    ) -> None:
        mi = built.mi
        self._mi, self._scene = mi, built.scene
        if any(shape.is_medium_transition() for shape in built.scene.shapes()):
            raise SpecError("a level cannot be measured among media; give radiance_scale", file=spec.file, key=key)
        self._beyond = _beyond_one(mi, built, spec, key)
        self._wavelengths = WavelengthSampler({"level": response})
        self._point = mi.Point3f(*point)
        self._normal = mi.Normal3f(*(np.array(normal) / np.linalg.norm(normal)).tolist())
        self._sampler = sampler_class(mi.variant())()

    def estimates(self, rays: int, stream: Stream) -> np.ndarray:
        """Independent estimates of the level from `rays` rays each, a power of two."""
        types = jit()
        key = dr.opaque(types.UInt64, stream_key(0, stream))
        at_once = max(1, _BLOCK // rays)
        estimates = []
        for first in range(0, _ESTIMATES, at_once):
            lane = dr.arange(types.UInt32, min(at_once, _ESTIMATES - first) * rays)
            number = lane // rays
            estimate = number + dr.opaque(types.UInt32, first)
            self._sampler.setup(key, estimate, types.UInt32(0), lane - number * rays, rays)
            estimates.append(np.array(dr.block_sum(self._level(), rays), np.float64) / rays)
            self._sampler.rest()
        return np.concatenate(estimates)

    def _level(self) -> Float:
        """Level from one ray per lane."""
        mi, scene, sampler = self._mi, self._scene, self._sampler
        index = mi.UInt32(0)
        bands = mi.UnpolarizedSpectrum(*self._wavelengths.sample(index, sampler.next_1d()))
        here = mi.Interaction3f(0.0, 0.0, bands, self._point, self._normal)

        seen, weight = scene.sample_emitter_direction(here, sampler.next_2d(), True, True)
        cosine = dr.maximum(dr.dot(self._normal, seen.d), 0.0)
        share = dr.select(seen.delta, 1.0, power_heuristic(seen.pdf, cosine / pi))
        total = dr.select((seen.pdf > 0) & (cosine > 0), weight * cosine * share, 0.0)

        local = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
        ray = here.spawn_ray(mi.Frame3f(self._normal).to_world(local))
        ray.wavelengths = bands
        si = scene.ray_intersect(ray)
        light = si.emitter(scene)
        shines = light != None  # noqa: E711  (a Dr.Jit comparison)
        own = dr.select(shines, light.eval(si, shines), 0.0)
        density = scene.pdf_emitter_direction(here, mi.DirectionSample3f(scene, si, here), shines)
        total += pi * own * power_heuristic(local.z / pi, density)
        if self._beyond is not None:
            radiance, _, _ = self._beyond.sample(scene, sampler, mi.RayDifferential3f(ray))
            total += pi * (radiance - own)
        return dr.sum(total) / len(total) * self._wavelengths.total(index)


def _beyond_one(mi: MitsubaModule, built: BuiltScene, spec: SceneSpec, key: str) -> MitsubaObject | None:
    """The scene's integrator for paths that continue from a surface: one segment shorter; None if paths end there."""
    plugin = built.integrator_plugin
    if plugin is None:
        raise SpecError(
            "the integrator was made before, so that its path length is not known; give it as a dictionary",
            file=spec.file,
            key=key,
        )
    depth = plugin.get("max_depth", -1)
    if plugin["type"] == "direct" or 0 <= depth <= 2:
        return None
    return mi.load_dict({**plugin, "max_depth": depth - 1 if depth > 0 else -1, "hide_emitters": False})


@dataclass(frozen=True, eq=False)
class LightLevels:
    """Level of one light on its own plane.

    Parameters
    ----------
    name : ``light`` or ``lights.N`` of a scene file, ``target`` or ``objects.NAME`` for one that shines itself, or the
        name of a Mitsuba scene's emitter with a waveform.
    unit : ``lx``, ``W m^-2``, ``cd m^-2``, or ``1`` for the power over its mean.
    mean : time mean.
    level : level at the given times, in the shape of these.
    """

    name: str
    unit: str
    mean: float
    level: NDArray[np.float64]


def light_levels(scene: Scene, t_us: ArrayLike) -> list[LightLevels]:
    """Levels of all lights of a scene at given times, µs."""
    times = np.asarray(t_us, dtype=np.float64)
    levels = []
    for number, light in enumerate(scene.spec.lights):
        if light.type == "none":
            continue
        name = "light" if len(scene.spec.lights) == 1 else f"lights.{number}"
        lux = light.illuminance_lux
        mean, unit = (lux, "lx") if lux is not None else (float(light.irradiance_w_m2 or 0.0), "W m^-2")
        power = _power(None if light.waveform is None else light.waveform.load(), times)
        levels.append(LightLevels(name, unit, float(mean), mean * power))
    for name, lamp in scene.spec.named_lamps:
        power = _power(None if lamp.waveform is None else lamp.waveform.load(), times)
        levels.append(LightLevels(name, "cd m^-2", lamp.luminance_cd_m2, lamp.luminance_cd_m2 * power))
    if scene.spec.mitsuba is not None:
        for name, spec in scene.spec.mitsuba.waveforms.items():
            levels.append(LightLevels(name, "1", 1.0, _power(spec.load(), times)))
    return levels


def _power(waveform: Waveform | None, t_us: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.ones(t_us.shape) if waveform is None else np.asarray(waveform.mean(t_us, t_us), dtype=np.float64)
