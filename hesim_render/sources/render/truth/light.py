"""Levels of the lights of a scene at any time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.sources.scene import Scene
from hesim_render.spectral.waveform import Waveform


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
