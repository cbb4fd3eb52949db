"""From linear sRGB to the photo-electron rate behind each filter: a small matrix, computed once.

``matrix``, the method of the H-ESIM paper: the camera's colour matrix and white balance are inverted, which gives
camera RGB. The filter with the strongest white sets its scale. Filters that are not a colour of the camera
(white event pixels) see a luma, or the spectral method, scaled to their own white.

``spectral``: a colour becomes the reflectance r·ρ_r(λ) + g·ρ_g(λ) + b·ρ_b(λ) with the basis of Mallett and Yuksel
[mallett2019], which lies between 0 and 1, sums to 1 for white and has the colour's own tristimulus values under D65.
This reflectance under the light goes through Eq. 1 with the sensor's own curves. Any filter thus has a defined
response: that to one smooth surface among the many of this colour. The basis ends at 380 and 780 nm and is held
constant beyond.
"""

from collections.abc import Sequence
from math import pi

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import RangeError
from hesim_render.mosaic.colour_profile import Camera
from hesim_render.mosaic.description import describe
from hesim_render.sensor.sensor import Sensor
from hesim_render.spectral import spectrum as spectra
from hesim_render.spectral.spectrum import Spectrum, integrate_product, require_coverage

#: Luma of linear sRGB, ITU-R BT.709.
LUMA = (0.2126, 0.7152, 0.0722)
_BEYOND_NM = (250.0, 1200.0)


def surface_basis() -> list[Spectrum]:
    """Reflectances of linear sRGB red, green and blue, held constant beyond their table."""
    return [
        Spectrum(
            np.concatenate([_BEYOND_NM[:1], part.wavelength_nm, _BEYOND_NM[1:]]), np.pad(part.values, 1, mode="edge")
        )
        for part in spectra.srgb_reflectances()
    ]


def white_flux(sensor: Sensor, filters: Sequence[str], light: Spectrum, lux: float) -> NDArray[np.float64]:
    """Φ of a perfect diffuser under `lux` of a light, [filter], e⁻/s on the optical axis: ∫ R(λ) E(λ)/π dλ.

    Raises
    ------
    SpecError
        If the light does not cover a filter's response.
    """
    irradiance = spectra.scale_to_lux(light, lux)
    for name in filters:
        require_coverage(irradiance, sensor.responses[name], "the light", name)
    return np.array([integrate_product(sensor.responses[name], irradiance) for name in filters]) / pi


def lux_of(sensor: Sensor, light: Spectrum, e_per_s: float, filter_name: str) -> float:
    """Illuminance at which a perfect diffuser gives this rate behind a filter."""
    if filter_name not in sensor.responses:
        raise RangeError("white_filter", filter_name, f"one of {', '.join(sensor.responses)}")
    return e_per_s / float(white_flux(sensor, [filter_name], light, 1.0)[0])


def spectral_matrix(sensor: Sensor, filters: Sequence[str], light: Spectrum, lux: float) -> NDArray[np.float64]:
    """[filter, 3]: Φ of linear sRGB in e⁻/s, white being a perfect diffuser under `lux`."""
    irradiance = spectra.scale_to_lux(light, lux)
    white_flux(sensor, filters, light, lux)  # the light must cover the responses
    basis = surface_basis()
    return (
        np.array([[integrate_product(sensor.responses[name], irradiance, part) for part in basis] for name in filters])
        / pi
    )


def camera_matrix(
    sensor: Sensor,
    filters: Sequence[str],
    light: Spectrum,
    lux: float,
    camera: Camera | None = None,
    others: str = "luma",
    luma: Sequence[float] = LUMA,
) -> NDArray[np.float64]:
    """[filter, 3]: Φ of linear sRGB in e⁻/s by the camera's own matrix and white balance.

    Parameters
    ----------
    sensor, filters : the sensor, and names of its filters.
    light, lux : spectrum of the light, and its illuminance on white, lx.
    camera : its channels are filters of the sensor; default: the camera of the sensor's mosaic under `light`.
    others : model of filters that are not channels of the camera: ``luma`` or ``spectral``.
    luma : weights of linear R, G, B; they are scaled to sum to 1.

    Raises
    ------
    RangeError
        If the camera's matrix cannot be inverted, its channels are not filters of the sensor, or the luma sums to 0.
    """
    white = white_flux(sensor, filters, light, lux)
    result = spectral_matrix(sensor, filters, light, lux) if others == "spectral" else white[:, None] * _unit(luma)
    used = camera or _own_camera(sensor, light)
    if used is None:
        return result
    unknown = [name for name in used.channels if name not in sensor.responses]
    if unknown:
        raise RangeError("channels of the camera", unknown, f"filters of the sensor: {', '.join(sensor.responses)}")
    if np.shape(used.matrix) != (3, 3):
        raise RangeError(
            "number of colours of the frame pixels", len(used.channels), "3 for mode 'matrix'; use mode 'spectral'"
        )
    colours = used.from_linear(np.eye(3)).T
    own_white = white_flux(sensor, used.channels, light, lux)
    strongest = int(np.argmax(own_white))
    colours *= own_white[strongest] / colours[strongest].sum()
    for number, name in enumerate(filters):
        if name in used.channels:
            result[number] = colours[used.channels.index(name)]
    return result


def _own_camera(sensor: Sensor, light: Spectrum) -> Camera | None:
    """The camera of the sensor's mosaic; None for sensors with one colour or without frames."""
    mosaic = describe(sensor, light)
    return None if sensor.spec.aps is None or len(mosaic.channels) == 1 else Camera.of(mosaic)


def _unit(luma: Sequence[float]) -> NDArray[np.float64]:
    weights = np.asarray(luma, dtype=np.float64)
    if weights.shape != (3,) or not weights.sum() > 0:
        raise RangeError("luma", list(luma), "three weights with a sum above 0")
    return weights / weights.sum()
