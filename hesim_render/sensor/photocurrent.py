"""Eq. 1 for any radiance cube: electrons from spectral radiance, without a renderer."""

from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.host_arrays import from_host
from hesim_render.core.units import S_PER_US
from hesim_render.sensor.sensor import Sensor, as_sensor
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
    """Quadrature weights w with ∫ R(λ) L(λ) dλ = Σ_b w_b L(λ_b).

    ``trapezoid``: L is linear between the bands and zero outside them. The product R·L is integrated by the trapezoidal
    rule on the merged grid of R and the bands, refined to 1 nm or finer. ``rectangle``: w_b = R(λ_b)·Δλ on an even
    grid, the rule of ISETCam; its error is up to 8 % at 10 nm.

    Parameters
    ----------
    response : R(λ).
    wavelength_nm : [band], increasing, nm.
    quadrature : ``trapezoid`` or ``rectangle``.

    Returns
    -------
    [band], in the unit of R times nm.

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
    # on the samples of both, so that each is linear within a step
    grid = merged_grid(response, Spectrum(bands, np.ones_like(bands)), step_nm=INTEGRATION_STEP_NM)
    step = np.diff(grid)
    trapezoid = np.zeros_like(grid)
    trapezoid[:-1] += step / 2
    trapezoid[1:] += step / 2
    # linear interpolation splits the weight of each grid point between the two bands around it
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
    sensor: Sensor | str | Path,
    exposure_us: float,
    *,
    filter: str | None = None,
    quadrature: Quadrature = "trapezoid",
    responses: NDArray | Float | None = None,
) -> NDArray[np.float64] | Float:
    """I_c of Eq. 1: mean electrons of an exposure to a spectral radiance.

    I_c = Δt · V · ∫ P_c(λ) C_f(λ) L(λ) dλ with P_c = A_pix·FF·G·τ_lens·η·λ/(h c) (see
    `Sensor.spectral_response`). The radiance is constant over the exposure.

    Parameters
    ----------
    spectral_radiance : [..., band], W m⁻² sr⁻¹ nm⁻¹; a NumPy array, or a Dr.Jit TensorXf or TensorXf64 for
        derivatives. Without `filter` it must be [row, col, band] with the rows and columns of the sensor;
        each pixel then applies its own filter and its relative illumination V.
    wavelength_nm : [band], increasing, nm.
    sensor : the sensor, or its name or path; supplies responses, mosaic and relative illumination.
    exposure_us : Δt, µs.
    filter : name of one filter that all elements are seen through, on the optical axis (V = 1). The
        leading shape is then free.
    quadrature : see `band_weights`.
    responses : [filter, band], responses P_c·C_f at the bands in place of those of the sensor, in the order of
        `sensor.layout.filters` ([band] with `filter`), e⁻/s per W m⁻² sr⁻¹ nm⁻¹; linear between the bands, as the
        radiance, whose product is then integrated exactly. NumPy, or a Dr.Jit tensor for derivatives.

    Examples
    --------
    Compare light of equal radiance at all wavelengths with the integral of the response (e⁻/s per W m⁻² sr⁻¹ nm⁻¹):

    >>> import numpy as np
    >>> import hesim_render as hr
    >>> sensor, wavelength_nm = hr.load_sensor("reference-mono"), np.arange(360.0, 831.0)
    >>> (name, response), = sensor.spectral_response(wavelength_nm).items()
    >>> electrons = hr.photocurrent(np.full(471, 1e-3), wavelength_nm, sensor, 10_000, filter=name)
    >>> round(float(electrons / (0.01 * 1e-3 * np.trapezoid(response, wavelength_nm))), 2)
    1.0

    Returns
    -------
    Electrons, with the shape of the radiance without its last axis; NumPy float64 for NumPy input, a Dr.Jit tensor
    (differentiable with respect to radiance and responses) if one of both is one, of 64 bits if one of both is.

    Raises
    ------
    RangeError
        For a wrong shape or a negative exposure.
    SpecError
        If the bands do not cover a response.
    """
    sensor = as_sensor(sensor)
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
    exposure_s = exposure_us * S_PER_US
    if responses is not None:
        expected = (bands.size,) if filter is not None else (len(names), bands.size)
        if tuple(responses.shape) not in (expected, (len(names), bands.size)):
            raise RangeError("responses.shape", tuple(responses.shape), f"{expected}, at the bands of the radiance")
        widths = _own_widths(bands, quadrature) * exposure_s
        if isinstance(spectral_radiance, np.ndarray) and isinstance(responses, np.ndarray):
            given = responses.reshape(-1, bands.size).astype(np.float64)
            return _numpy(spectral_radiance, _of_own(given, widths), sensor, filter)
        is_double = any(isinstance(given, jit().TensorXf64) for given in (spectral_radiance, responses))
        radiance, own = (_tensor(given, is_double) for given in (spectral_radiance, responses))
        return _drjit(radiance, _own_table(own, widths), sensor, filter)
    weights = np.stack([band_weights(sensor.responses[name], bands, quadrature) for name in names])
    weights *= exposure_s
    if isinstance(spectral_radiance, np.ndarray):
        return _numpy(spectral_radiance, weights, sensor, filter)
    kind = jit().Float64 if isinstance(spectral_radiance, jit().TensorXf64) else jit().Float
    return _drjit(spectral_radiance, from_host(kind, weights), sensor, filter)


def _own_widths(bands: NDArray[np.float64], quadrature: Quadrature) -> NDArray[np.float64]:
    """Factors of R(λ_b−1), R(λ_b) and R(λ_b+1) in the weight of L(λ_b), [3, band], nm.

    With R and L linear between bands of distance h, ∫ R L = Σ h/6 (2 R₀L₀ + R₀L₁ + R₁L₀ + 2 R₁L₁).
    """
    step = np.diff(bands)
    if quadrature == "rectangle":
        if not np.allclose(step, step[0], rtol=1e-9):
            raise SpecError("quadrature 'rectangle' needs evenly spaced wavelengths")
        return np.stack([np.zeros(bands.size), np.full(bands.size, step[0]), np.zeros(bands.size)])
    before, after = np.append(0.0, step), np.append(step, 0.0)
    return np.stack([before, 2 * (before + after), after]) / 6


def _of_own(responses: NDArray[np.float64], widths: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights [filter, band] of responses [filter, band]."""
    padded = np.pad(responses, ((0, 0), (1, 1)))
    return widths[0] * padded[:, :-2] + widths[1] * responses + widths[2] * padded[:, 2:]


def _own_table(responses: Float, widths: NDArray[np.float64]) -> Float:
    """The same on Dr.Jit, flat; differentiable."""
    types = jit()
    count = int(np.prod(responses.shape))
    bands = widths.shape[1]
    values = responses.array
    kind = type(values)
    place = dr.arange(types.UInt32, count)
    band = place % bands
    factors = [dr.gather(kind, from_host(kind, row), band) for row in widths]
    # at the ends the factor is 0, so that the neighbour does not matter
    before = dr.gather(kind, values, dr.select(band > 0, place - 1, place))
    after = dr.gather(kind, values, dr.select(band < bands - 1, place + 1, place))
    return factors[0] * before + factors[1] * values + factors[2] * after


def _tensor(values: NDArray | Float, is_double: bool) -> Float:
    """A Dr.Jit tensor of 32-bit or 64-bit numbers."""
    types = jit()
    kind = types.TensorXf64 if is_double else types.TensorXf
    if isinstance(values, np.ndarray):
        return kind(from_host(types.Float64 if is_double else types.Float, values), shape=values.shape)
    return values if isinstance(values, kind) else kind(values)


def _numpy(radiance: NDArray, weights: NDArray, sensor: Sensor, filter: str | None) -> NDArray[np.float64]:
    if filter is not None:
        return np.asarray(radiance @ weights[0], dtype=np.float64)
    electrons = np.empty(radiance.shape[:-1])
    index = sensor.layout.filter_index
    for number, weight in enumerate(weights):
        mask = index == number
        electrons[mask] = radiance[mask] @ weight
    return electrons * sensor.relative_illumination


def _drjit(radiance: Float, table: Float, sensor: Sensor, filter: str | None) -> Float:
    types = jit()
    shape = tuple(radiance.shape)
    bands = shape[-1]
    count = int(np.prod(shape[:-1], dtype=np.int64))
    kind = type(radiance.array)
    if filter is None:
        offset = from_host(types.UInt32, sensor.layout.filter_index) * bands
        vignetting = from_host(kind, sensor.relative_illumination)
    else:
        offset, vignetting = dr.zeros(types.UInt32, count), kind(1.0)
    source = radiance.array
    first = dr.arange(types.UInt32, count) * bands
    electrons = dr.zeros(kind, count)
    for band in range(bands):
        electrons += dr.gather(kind, source, first + band) * dr.gather(kind, table, offset + band)
    return type(radiance)(electrons * vignetting, shape=shape[:-1])
