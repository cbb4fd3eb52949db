"""Figures that compare the subspaces of a camera's curves and of the colour-matching functions.

A camera whose curves are linear combinations of the colour-matching functions (the Luther condition) sees all colours
as the observer does. The figures here say how far a camera is from it, without any reflectances or noise.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.errors import RangeError, SpecError
from hesim_render.spectral.spectrum import Spectrum, colour_matching_functions

#: Singular values below this part of the largest one count as 0.
_RANK_TOLERANCE = 1e-6
#: Grid on which spectra are compared unless another is given, nm.
GRID_NM = np.arange(400.0, 701.0, 10.0)


def sampled(spectra: ArrayLike | list[Spectrum] | tuple[Spectrum, ...], wavelength_nm: ArrayLike = GRID_NM) -> NDArray:
    """Spectra as columns of a table, [wavelength, spectrum]."""
    return np.column_stack([spectrum.at(wavelength_nm) for spectrum in spectra])  # type: ignore[union-attr]


def observer(wavelength_nm: ArrayLike = GRID_NM) -> NDArray[np.float64]:
    """Colour-matching functions of the CIE 1931 2° observer, [wavelength, 3]."""
    return sampled(colour_matching_functions(), wavelength_nm)


def rank(curves: ArrayLike) -> int:
    """Number of independent columns of a table [wavelength, channel]."""
    return int(np.linalg.matrix_rank(_table(curves), tol=_RANK_TOLERANCE * np.linalg.norm(_table(curves), 2)))


def require_colour(curves: ArrayLike, what: str) -> None:
    """Refuse curves that cannot tell three primaries apart.

    Raises
    ------
    SpecError
        If fewer than three columns are independent.
    """
    result = rank(curves)
    if result < 3:
        raise SpecError(
            f"{what}: its filters span {result} of the 3 dimensions that colour needs; add a filter, or leave the "
            "colour figures out"
        )


def vora_value(curves: ArrayLike, wanted: ArrayLike, light: ArrayLike | None = None) -> float:
    """The measure of goodness of Vora and Trussell [vora1993]: ν = tr(P_S P_X) / rank(X).

    P projects onto the space that the columns of a table span. ν is 1 if and only if the curves contain all linear
    combinations of the wanted ones, and 0 if both are orthogonal.

    Parameters
    ----------
    curves : [wavelength, channel], the camera's responses per watt, on an even grid.
    wanted : [wavelength, 3], the colour-matching functions on the same grid.
    light : [wavelength], spectral power that weights both; default none (equal energy).

    Examples
    --------
    >>> from hesim_render.studies import observer, vora_value
    >>> round(vora_value(observer() @ [[1, 0, 1], [2, 1, 0], [0, 1, 3]], observer()), 12)
    1.0

    Returns
    -------
    ν, 0 to 1.

    Raises
    ------
    RangeError
        If the shapes do not fit.
    """
    camera, target = _weighted(curves, wanted, light)
    a, b = _basis(camera), _basis(target)
    return float(np.sum((a.T @ b) ** 2) / b.shape[1])


@dataclass(frozen=True)
class LutherResidual:
    """How badly the best linear combinations of a camera's curves match the colour-matching functions.

    Parameters
    ----------
    total : root of the sum of squared deviations over that of the functions, 0 (exact) to 1.
    each : the same for each function (x̄, ȳ, z̄).
    combination : [channel, 3], the least-squares combination.
    """

    total: float
    each: tuple[float, ...]
    combination: NDArray[np.float64]


def luther_residual(curves: ArrayLike, wanted: ArrayLike, light: ArrayLike | None = None) -> LutherResidual:
    """Deviation of a camera from the Luther condition: ‖X − S·M‖ / ‖X‖ with the least-squares M (Frobenius norms).

    Parameters
    ----------
    curves, wanted, light : as for `vora_value`.

    Examples
    --------
    >>> from hesim_render.studies import luther_residual, observer
    >>> luther_residual(observer()[:, ::-1], observer()).total < 1e-12
    True

    Returns
    -------
    The residual, in all and of each function.

    Raises
    ------
    RangeError
        If the shapes do not fit.
    """
    camera, target = _weighted(curves, wanted, light)
    combination, *_ = np.linalg.lstsq(camera, target, rcond=_RANK_TOLERANCE)
    off, size = np.sum((target - camera @ combination) ** 2, axis=0), np.sum(target**2, axis=0)
    return LutherResidual(
        float(np.sqrt(off.sum() / size.sum())), tuple(np.sqrt(off / size).tolist()), np.asarray(combination)
    )


def filter_quality(curves: ArrayLike, wanted: ArrayLike, light: ArrayLike | None = None) -> list[float]:
    """Neugebauer's quality factor of each curve [neugebauer1956], q = ‖P_X s‖² / ‖s‖²; 1 for a combination of X.

    Parameters
    ----------
    curves, wanted, light : as for `vora_value`.

    Examples
    --------
    >>> from hesim_render.studies import filter_quality, observer
    >>> [round(q, 9) for q in filter_quality(observer()[:, :2], observer())]
    [1.0, 1.0]

    Returns
    -------
    [channel], 0 to 1.

    Raises
    ------
    RangeError
        If the shapes do not fit.
    """
    camera, target = _weighted(curves, wanted, light)
    basis = _basis(target)
    return (np.sum((basis.T @ camera) ** 2, axis=0) / np.sum(camera**2, axis=0)).tolist()


def _basis(table: NDArray) -> NDArray[np.float64]:
    """An orthonormal basis of the columns' space."""
    left, values, _ = np.linalg.svd(table, full_matrices=False)
    return left[:, values > _RANK_TOLERANCE * values[0]]


def _weighted(curves: ArrayLike, wanted: ArrayLike, light: ArrayLike | None) -> tuple[NDArray, NDArray]:
    camera, target = _table(curves), _table(wanted)
    if len(camera) != len(target):
        raise RangeError("curves", camera.shape, f"[wavelength, channel] with {len(target)} wavelengths")
    if not np.all(np.linalg.norm(camera, axis=0) > 0):
        raise RangeError("curves", "a column of zeros", "channels that respond")
    if light is None:
        return camera, target
    power = np.asarray(light, dtype=np.float64)
    if power.shape != (len(camera),) or power.min() < 0 or power.max() <= 0:
        raise RangeError("light", power.shape, f"{len(camera)} values of 0 or more, not all 0")
    return camera * power[:, None], target * power[:, None]


def _table(values: ArrayLike) -> NDArray[np.float64]:
    table = np.asarray(values, dtype=np.float64)
    if table.ndim != 2 or not np.isfinite(table).all():
        raise RangeError("curves", table.shape, "a table [wavelength, channel] of finite numbers")
    return table
