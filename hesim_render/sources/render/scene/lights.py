"""Absolute emitters: radiance, intensity or irradiance of a light from its level on a stated plane."""

from collections.abc import Sequence
from math import pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device_types import MitsubaModule
from hesim_render.core.errors import SpecError
from hesim_render.sources.render.scene.environment import environment
from hesim_render.sources.render.scene.mitsuba_version import spectrum_dict, transform
from hesim_render.specs.light import LightSpec, irradiance
from hesim_render.spectral.spectrum import Spectrum, summed
from hesim_render.targets.piece import clipped

#: Least cosine at which a light can still set a level on its plane.
_GRAZING = 1e-6


def form_factor_integral(
    corners: NDArray[np.float64], point: NDArray[np.float64], normal: NDArray[np.float64]
) -> float:
    """∫ cos θ dω over a polygon as seen from a point of a plane, in sr: E = L × this.

    Lambert's formula, ½ Σ γ_i (Γ_i · n) [lambert1760], with γ_i the angle that edge i subtends and Γ_i the unit
    normal of the plane through `point` and that edge. The part below the horizon of the plane is cut off.

    Parameters
    ----------
    corners : corners of the polygon in order, [n, 3], m.
    point : [3], m.
    normal : unit normal of the plane, [3].
    """
    rays = clipped(corners - point, (corners - point) @ normal)
    if len(rays) < 3:
        return 0.0
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    following = np.roll(rays, -1, axis=0)
    cross = np.cross(rays, following)
    sine = np.linalg.norm(cross, axis=1)
    angle = np.arctan2(sine, np.sum(rays * following, axis=1))
    weight = np.divide(angle, sine, out=np.zeros_like(angle), where=sine > 0)
    return abs(float(0.5 * np.sum(weight * (cross @ normal))))


def area_light_frame(light: LightSpec) -> NDArray[np.float64]:
    """Placement [4, 4] of an area light: columns are half its width, half its height, its unit normal, its centre, m.

    The normal points at the plane point; the width runs horizontally (along x if the light
    shines straight up or down).
    """
    assert light.position_m is not None and light.size_m is not None
    centre = np.array(light.position_m, dtype=np.float64)
    normal = _unit(np.array(light.plane_point_m) - centre, light)
    width = np.cross([0.0, 1.0, 0.0], normal)
    width = np.array([1.0, 0.0, 0.0]) if np.linalg.norm(width) < 1e-9 else width / np.linalg.norm(width)
    height = np.cross(normal, width)
    frame = np.eye(4)
    frame[:3, 0], frame[:3, 1] = width * light.size_m[0] / 2, height * light.size_m[1] / 2
    frame[:3, 2], frame[:3, 3] = normal, centre
    return frame


def emitters(mi: MitsubaModule, given: Sequence[LightSpec]) -> dict[str, Any]:
    """Entries of the Mitsuba scene for its lights, at their time means.

    ``uniform``: L = E/π from all directions, as for a plane under a uniform sky, visible behind the scene; several
    become one sky of their sum. ``point``: I = E d²/cos θ. ``directional``: E/cos θ across the beam. ``area``:
    a one-sided Lambertian rectangle, L = E / ∫ cos θ dω exactly, black if it is switched off. ``environment``: see
    there.

    Raises
    ------
    SpecError
        If a light cannot reach its plane from the front.
    """
    entries: dict[str, Any] = {}
    skies: list[Spectrum] = []
    for number, light in enumerate(given):
        name = name_of(given, number)
        level = irradiance(light)
        if light.type == "area":
            entries[name] = _area(mi, light, level, key_of(given, number))
        elif level is None:
            continue
        elif light.type == "uniform":
            skies.append(level.scaled(1 / pi))
        elif light.type == "environment":
            key = key_of(given, number)
            entries[name] = environment(mi, light, _plane(light, key)[1], key)
        else:
            entries[name] = _beam(light, level, key_of(given, number))
    if skies:
        # Under a uniform sky, sampling by the BSDF alone has no variance, but sampling of the sky has. The sky's
        # weight is therefore 0. Mitsuba needs one emitter with a weight: without another light, a black point light.
        radiance = skies[0] if len(skies) == 1 else summed(*skies)
        if not any(entry["type"] != "rectangle" or "emitter" in entry for entry in entries.values()):
            black = {"type": "uniform", "value": 0.0}
            entries["light_unlit"] = {"type": "point", "position": [0, 0, 0], "intensity": black}
        entries["light_sky"] = {"type": "constant", "radiance": spectrum_dict(radiance), "sampling_weight": 0.0}
    return entries


def name_of(given: Sequence[LightSpec], number: int) -> str:
    """Name of a light in the Mitsuba scene."""
    return "light" if len(given) == 1 else f"light_{number}"


def key_of(given: Sequence[LightSpec], number: int) -> str:
    """Key of a light in the scene file."""
    return "light" if len(given) == 1 else f"light.{number}"


def geometry_on_plane(light: LightSpec, key: str) -> float:
    """Irradiance on its plane point by a light of unit strength, without shadows.

    Unit of strength and result: ``area``: radiance, ∫ cos θ dω in sr. ``point``: intensity, cos θ/d² in sr/m².
    ``directional``: irradiance across the beam, cos θ.

    Raises
    ------
    SpecError
        If the light cannot reach its plane from the front.
    """
    plane, normal = _plane(light, key)
    if light.type == "directional":
        return _facing(float(-beam_direction(light, key) @ normal), key)
    if light.type == "point":
        away = np.array(light.position_m, dtype=np.float64) - plane
        return _facing(float(_unit(away, light, f"{key}.position_m") @ normal), key) / float(away @ away)
    frame = area_light_frame(light)
    corners = frame[:3, 3] + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ frame[:3, :2].T
    return _facing(form_factor_integral(corners, plane, normal), key)


def beam_direction(light: LightSpec, key: str = "light") -> NDArray[np.float64]:
    """Unit vector [3] in which a directional light travels."""
    return _unit(np.array(light.direction, dtype=np.float64), light, f"{key}.direction")


def _beam(light: LightSpec, level: Spectrum, key: str) -> dict[str, Any]:
    """A directional or a point light."""
    strength = spectrum_dict(level.scaled(1 / geometry_on_plane(light, key)))
    if light.type == "directional":
        return {"type": "directional", "direction": beam_direction(light, key).tolist(), "irradiance": strength}
    return {"type": "point", "position": list(light.position_m or ()), "intensity": strength}


def _area(mi: MitsubaModule, light: LightSpec, level: Spectrum | None, key: str) -> dict[str, Any]:
    frame, geometry = area_light_frame(light), geometry_on_plane(light, key)
    rectangle: dict[str, Any] = {
        "type": "rectangle",
        "to_world": transform(mi, frame),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.0}},
    }
    if level is not None:
        rectangle["emitter"] = {"type": "area", "radiance": spectrum_dict(level.scaled(1 / geometry))}
    return rectangle


def _plane(light: LightSpec, key: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Point and unit normal of the plane on which the level holds."""
    normal = _unit(np.array(light.plane_normal, dtype=np.float64), light, f"{key}.plane_normal")
    return np.array(light.plane_point_m, dtype=np.float64), normal


def _facing(cosine: float, key: str) -> float:
    if cosine < _GRAZING:
        raise SpecError("the light does not reach its plane from the front (see plane_point_m, plane_normal)", key=key)
    return cosine


def _unit(vector: NDArray[np.float64], light: LightSpec, key: str = "light") -> NDArray[np.float64]:
    length = float(np.linalg.norm(vector))
    if length == 0:
        raise SpecError(f"a light of type '{light.type}' is given a direction of length zero", key=key)
    return vector / length
