"""Eq. 1 on any radiance cube: from spectral radiance to electrons, without a renderer."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device_types import Float
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.units import S_PER_US
from hesim_render.sensor.sensor import Sensor
from hesim_render.spectral.spectrum import (
    INTEGRATION_STEP_NM,
    REQUIRED_COVERAGE,
    Spectrum,
    constant,
    coverage,
    merged_grid,
)

Quadrature = Literal["trapezoid", "rectangle"]


def band_weights(
    response: Spectrum, wavelength_nm: NDArray[np.float64], quadrature: Quadrature = "trapezoid"
) -> NDArray[np.float64]:
    """Weights w with ∫ R(λ) L(λ) dλ = Σ_b w_b L(λ_b), in the unit of R × nm.

    ``trapezoid``: L is linear between bands and zero outside them; the product is integrated by a
    trapezoid on the merged grid of R and the bands, refined to 1 nm or finer. ``rectangle``:
    w_b = R(λ_b)·Δλ on an even grid, the rule of ISETCam; up to 8 % off at 10 nm.

    Raises
    ------
    SpecError
        If the bands cover less than 99.9 % of the response, or ``rectangle`` meets an uneven grid.
    """
    bands = np.asarray(wavelength_nm, dtype=np.float64)
    if quadrature == "rectangle":
        steps = np.diff(bands)
        if not np.allclose(steps, steps[0], rtol=1e-9):
            raise SpecError("quadrature 'rectangle' needs evenly spaced wavelengths")
        return response.at(bands) * steps[0]
    flat = constant(1.0, float(bands[0]), float(bands[-1]))
    if coverage(flat, response) < REQUIRED_COVERAGE:
        low, high = response.support_nm
        raise SpecError(
            f"bands from {bands[0]:g} to {bands[-1]:g} nm do not cover the response ({low:g}-{high:g} nm); "
            f"at least {REQUIRED_COVERAGE:.1%} of it is needed"
        )
    grid = merged_grid(response, Spectrum(bands, np.ones_like(bands)), step_nm=INTEGRATION_STEP_NM)
    step = np.diff(grid)
    trapezoid = np.zeros_like(grid)
    trapezoid[:-1] += step / 2
    trapezoid[1:] += step / 2
    # each grid point's share goes to the two bands around it, as linear interpolation has it
    weight = trapezoid * response.at(grid)
    right = np.clip(np.searchsorted(bands, grid, side="right"), 1, bands.size - 1)
    fraction = (grid - bands[right - 1]) / (bands[right] - bands[right - 1])
    weights = np.zeros_like(bands)
    np.add.at(weights, right - 1, weight * (1 - fraction))
    np.add.at(weights, right, weight * fraction)
    return weights


def photocurrent(
    spectral_radiance: NDArray | Float,
    wavelength_nm: ArrayLike,
    sensor: Sensor,
    exposure_us: float,
    *,
    filter: str | None = None,
    quadrature: Quadrature = "trapezoid",
) -> NDArray[np.float64] | Float:
    """I_c of Eq. 1: mean electrons that a radiance gives within an exposure.

    I_c = Δt · V · ∫ P_c(λ) C_f(λ) L(λ) dλ with P_c = A_pix·FF·G·τ_lens·η·λ/(h c) (see
    `Sensor.spectral_response`); radiance is constant over the exposure.

    Parameters
    ----------
    spectral_radiance : [..., band], W m⁻² sr⁻¹ nm⁻¹; a NumPy array, or a Dr.Jit TensorXf for
        derivatives. Without `filter` it must be [row, col, band] with the sensor's own rows and
        columns, seen pixel by pixel through the mosaic; relative illumination V applies.
    wavelength_nm : [band], increasing.
    exposure_us : Δt, µs.
    filter : name of one filter: every element is seen through it, on the optical axis (V = 1), and
        the leading shape is free.
    quadrature : see `band_weights`.

    Examples
    --------
    Light that is the same at all wavelengths, against the integral of the response (e⁻/s per W m⁻² sr⁻¹ nm⁻¹):

    >>> import numpy as np
    >>> import hesim_render as hr
    >>> sensor, wavelength_nm = hr.load_sensor("reference-mono"), np.arange(360.0, 831.0)
    >>> (name, response), = sensor.spectral_response(wavelength_nm).items()
    >>> electrons = hr.photocurrent(np.full(471, 1e-3), wavelength_nm, sensor, 10_000, filter=name)
    >>> round(float(electrons / (0.01 * 1e-3 * np.trapezoid(response, wavelength_nm))), 2)
    1.0

    Returns
    -------
    Electrons, with the shape of the radiance less its last axis; NumPy float64 for NumPy input, a
    Dr.Jit TensorXf (differentiable with respect to the radiance) for Dr.Jit input.

    Raises
    ------
    RangeError
        For a wrong shape or a negative exposure.
    SpecError
        If the bands do not cover a response.
    """
    bands = np.asarray(wavelength_nm, dtype=np.float64)
    shape = tuple(spectral_radiance.shape)
    if bands.ndim != 1 or bands.size < 2 or not np.all(np.diff(bands) > 0):
        raise RangeError("wavelength_nm", f"shape {bands.shape}", "a list of at least 2 increasing wavelengths")
    if len(shape) < 1 or shape[-1] != bands.size:
        raise RangeError("spectral_radiance.shape", shape, f"a last axis of {bands.size} bands")
    if not exposure_us >= 0:
        raise RangeError("exposure_us", exposure_us, "0 or more")
    names = list(sensor.responses) if filter is None else [filter]
    if filter is not None and filter not in sensor.responses:
        raise RangeError("filter", filter, f"one of {', '.join(sensor.responses)}")
    if filter is None and shape[:-1] != sensor.layout.shape:
        raise RangeError(
            "spectral_radiance.shape", shape, f"({sensor.rows}, {sensor.cols}, {bands.size}), or a 'filter' argument"
        )
    weights = np.stack([band_weights(sensor.responses[name], bands, quadrature) for name in names])
    weights *= exposure_us * S_PER_US
    if isinstance(spectral_radiance, np.ndarray):
        return _numpy(spectral_radiance, weights, sensor, filter)
    return _drjit(spectral_radiance, weights, sensor, filter)


def _numpy(radiance: NDArray, weights: NDArray, sensor: Sensor, filter: str | None) -> NDArray[np.float64]:
    if filter is not None:
        return np.asarray(radiance @ weights[0], dtype=np.float64)
    electrons = np.empty(radiance.shape[:-1])
    index = sensor.layout.filter_index
    for number, weight in enumerate(weights):
        mask = index == number
        electrons[mask] = radiance[mask] @ weight
    return electrons * sensor.relative_illumination


def _drjit(radiance: Float, weights: NDArray, sensor: Sensor, filter: str | None) -> Float:
    import drjit as dr

    types = jit()
    shape = tuple(radiance.shape)
    bands = shape[-1]
    count = int(np.prod(shape[:-1], dtype=np.int64))
    table = types.Float(weights.astype(np.float32).ravel())
    if filter is None:
        offset = types.UInt32(sensor.layout.filter_index.ravel().astype(np.uint32)) * bands
        vignetting = types.Float(sensor.relative_illumination.ravel())
    else:
        offset, vignetting = dr.zeros(types.UInt32, count), types.Float(1.0)
    source = types.Float(radiance.array)
    first = dr.arange(types.UInt32, count) * bands
    electrons = dr.zeros(types.Float, count)
    for band in range(bands):
        electrons += dr.gather(types.Float, source, first + band) * dr.gather(types.Float, table, offset + band)
    return types.TensorXf(electrons * vignetting, shape=shape[:-1])
