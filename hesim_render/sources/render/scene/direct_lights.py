"""Lights of which the irradiance on a diffuse surface has a closed form."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hesim_render.sources.render.scene import lights
from hesim_render.specs.light import LightSpec, irradiance
from hesim_render.spectral.spectrum import Spectrum, summed


@dataclass(frozen=True)
class DirectLight:
    """A light that is on.

    Parameters
    ----------
    kind : ``rectangle``: one-sided and Lambertian; ``ball``: Lambertian; ``point``; ``beam``: parallel light; ``sky``:
        the same from all directions.
    level : irradiance on the light's plane, W m⁻² nm⁻¹.
    geometry : that of a light of unit strength: radiance of a rectangle, ball or sky, intensity of a point, irradiance
        across a beam. Without a plane it is 1.
    place : of a rectangle [4, 4], see `area_light_frame`; middle and radius of a ball, [4], m; position of a point, m,
        and direction of a beam, [3].
    shape : name in the Mitsuba scene of the shape that shines; None of others.
    """

    kind: Literal["rectangle", "ball", "point", "beam", "sky"]
    level: Spectrum
    geometry: float
    place: NDArray[np.float64]
    shape: str | None = None

    @property
    def strength(self) -> Spectrum:
        """See `geometry`."""
        return self.level.scaled(1 / self.geometry)


def direct_lights(given: Sequence[LightSpec], shining: Sequence[DirectLight] = ()) -> list[DirectLight]:
    """Lights of a scene file that are on and have a closed form, and objects that shine; all uniform lights are one
    sky, which comes last.

    Raises
    ------
    SpecError
        If a light cannot reach its plane from the front.
    """
    result: list[DirectLight] = []
    skies: list[Spectrum] = []
    for number, light in enumerate(given):
        level = irradiance(light)
        if level is None or light.type == "environment":
            continue
        if light.type == "uniform":
            skies.append(level)
            continue
        geometry = lights.geometry_on_plane(light, lights.key_of(given, number))
        if light.type == "area":
            frame, name = lights.area_light_frame(light), lights.name_of(given, number)
            result.append(DirectLight("rectangle", level, geometry, frame, name))
        elif light.type == "point":
            result.append(DirectLight("point", level, geometry, np.array(light.position_m, np.float64)))
        else:
            result.append(DirectLight("beam", level, geometry, lights.beam_direction(light)))
    result += shining
    if skies:
        result.append(DirectLight("sky", summed(*skies) if len(skies) > 1 else skies[0], pi, np.empty(0)))
    return result
