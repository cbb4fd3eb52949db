"""Lamps of generated scenes, with the illuminance that they give together at the middle of the view."""

from typing import Any

import numpy as np

from hesim_render.benchmark.draws import log_uniform
from hesim_render.benchmark.motions import CAMERA_WAY, CAMERA_Z
from hesim_render.specs.benchmark import LightsSpec
from hesim_render.spectral.spectrum import Spectrum, illuminant, scale_to_lux

#: Samples of the lamps' spectra, nm. Illuminants are given every 1 or 5 nm; lines of fluorescent lamps need 5 nm.
_WAVELENGTH_NM = np.arange(360.0, 831.0, 5.0)
_SMALLEST, _LARGEST = 0.05, 0.6
#: Smallest and largest coordinates of a lamp, m.
_PLACES = [-1.4, -0.6, 0.9], [1.4, 1.8, 2.2]


def _emission(spectrum: Spectrum, factor: float) -> dict[str, Any]:
    low, high = spectrum.support_nm
    inside = (low <= _WAVELENGTH_NM) & (high >= _WAVELENGTH_NM)
    values = np.where(inside, spectrum.at(_WAVELENGTH_NM), 0.0)
    return {"type": "irregular", "wavelengths": _WAVELENGTH_NM.tolist(), "values": (values * factor).tolist()}


def _hides_the_view(place: np.ndarray, size: float) -> bool:
    """True if a lamp of some extent could stand between the camera and what it sees, or around the camera.

    Parameters
    ----------
    place : of its middle, m.
    size : of its side or diameter, m.
    """
    half_width = 0.5 * max(0.0, CAMERA_Z - float(place[2])) / CAMERA_Z
    # corners of a square picture and of a panel; the camera moves a little
    return float(np.hypot(place[0], place[1])) < np.sqrt(2) * (half_width + size / 2) + CAMERA_WAY


def _lamp(rng: np.random.Generator, kind: str, irradiance: Spectrum) -> dict[str, Any]:
    """A lamp that gives an irradiance, W m⁻² nm⁻¹, on the plane z = 0 at the origin, unshadowed; a panel or a ball of
    some extent gives it to within a few percent, as its distance differs over its surface.
    """
    if kind == "sky":
        return {"type": "constant", "radiance": _emission(irradiance, 1 / np.pi)}
    place = rng.uniform(*_PLACES)
    square = float(place @ place)
    cosine = float(place[2] / np.sqrt(square))
    if kind == "sun":
        return {
            "type": "directional", "direction": (-place).round(6).tolist(),
            "irradiance": _emission(irradiance, 1 / cosine),
        }  # fmt: skip
    if kind == "point":
        return {
            "type": "point", "position": place.round(6).tolist(),
            "intensity": _emission(irradiance, square / cosine),
        }  # fmt: skip
    size = log_uniform(rng, (_SMALLEST, _LARGEST))
    while _hides_the_view(place, size):
        place = rng.uniform(*_PLACES)
    square = float(place @ place)
    cosine = float(place[2] / np.sqrt(square))
    matrix = np.eye(4)
    matrix[:3, 3] = place
    if kind == "ball":
        matrix[:3, :3] *= size / 2
        area = np.pi * size**2 / 4
    else:
        normal = -place / np.sqrt(square)
        across = np.cross([0.0, 1.0, 0.0], normal)
        across /= np.linalg.norm(across)
        matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = across * size / 2, np.cross(normal, across) * size / 2, normal
        area = size**2
    radiance = _emission(irradiance, square / cosine / area)
    shape = "sphere" if kind == "ball" else "rectangle"
    return {
        "type": shape, "to_world": matrix.round(9).tolist(),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.0}},
        "emitter": {"type": "area", "radiance": radiance},
    }  # fmt: skip


def lamps(rng: np.random.Generator, spec: LightsSpec) -> tuple[dict[str, Any], dict[str, Any]]:
    """Lamps of one light of a scene.

    Parameters
    ----------
    rng : random numbers of the light.
    spec : ranges.

    Returns
    -------
    Emitters by name, as Mitsuba has them, and the waveforms of those that flicker.
    """
    total = log_uniform(rng, spec.illuminance_lux)
    count = int(rng.integers(int(spec.lamps[0]), int(spec.lamps[1]) + 1))
    parts = rng.dirichlet(np.full(count, 2.0))
    kinds = ["sky", "sun", "point", "panel", "ball"]
    result: dict[str, Any] = {}
    for k, part in enumerate(parts):
        kind = str(rng.choice(kinds, p=[0.25, 0.15, 0.15, 0.25, 0.2]))
        if kind == "sky":
            kinds_left = [name for name in result if result[name]["type"] == "constant"]
            kind = "panel" if kinds_left else kind  # a scene has one sky
        name = spec.illuminants[int(rng.integers(len(spec.illuminants)))]
        irradiance = scale_to_lux(illuminant(name), max(total * float(part), 1e-6))
        result[f"lamp{k}"] = _lamp(rng, kind, irradiance)
    waveforms = {}
    if rng.random() < spec.flicker:
        name = f"lamp{int(rng.integers(count))}"
        waveforms[name] = {
            "type": "mains", "frequency_hz": float(rng.choice([50.0, 60.0])),
            "depth": float(rng.uniform(0.1, 0.95)), "phase_deg": float(rng.uniform(0, 360)),
        }  # fmt: skip
    return result, waveforms
