"""Colour correction matrices of a camera, and the colour errors that remain.

A matrix maps the channels of a camera (white at 1) to CIE XYZ (white at Y = 1). Errors are colour differences in CIELAB
under the white of the light itself, so no chromatic adaptation is needed.

Matrices that a study uses besides the best one: to sRGB, and against noise.
"""

from dataclasses import dataclass
from itertools import combinations
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.errors import RangeError, SpecError
from hesim_render.spectral.colorimetry import delta_e_2000, delta_e_ab, lab, xyz_to_linear_srgb
from hesim_render.studies.colour_noise import ChannelNoise
from hesim_render.studies.colour_samples import ColourSamples
from hesim_render.studies.subspace import rank

#: How a matrix is fitted: least squares in XYZ, or the least mean colour difference from there on.
MatrixMethod = Literal["least_squares_xyz", "least_delta_e_ab", "least_delta_e_2000"]
#: What a matrix is applied to: the channels, or these and the roots of their products [finlayson2015].
Expansion = Literal["linear", "root_polynomial"]
#: Chromatic patches of the chart and points per unit of mean ΔE*ab in ISO 17321-1.
_CHROMATIC, _SMI_PER_DELTA_E = 18, 5.5
#: Step of the numerical derivatives, relative to the scale of a matrix.
_STEP = 1e-6


@dataclass(frozen=True, eq=False)
class ColourError:
    """A matrix and its colour differences.

    Parameters
    ----------
    matrix : [3, term], from the (expanded) channels with white at 1 to XYZ with white at Y = 1.
    method : how it was fitted.
    expansion : what it is applied to.
    delta_e : [surface].
    """

    matrix: NDArray[np.float64]
    method: MatrixMethod
    expansion: Expansion
    delta_e: NDArray[np.float64]

    @property
    def mean(self) -> float:
        """Mean over the surfaces."""
        return float(self.delta_e.mean())

    @property
    def p95(self) -> float:
        """95 % quantile over the surfaces, linear between them."""
        return float(np.quantile(self.delta_e, 0.95))

    @property
    def max(self) -> float:
        """Largest of the surfaces."""
        return float(self.delta_e.max())


def expanded(camera: ArrayLike, expansion: Expansion = "linear") -> NDArray[np.float64]:
    """The terms that a matrix is applied to, [..., term].

    Parameters
    ----------
    camera : [..., channel].
    expansion : ``linear`` gives the channels; ``root_polynomial`` appends √(c_i c_j) of all pairs [finlayson2015],
        which grow with the exposure as the channels do.
    """
    values = np.asarray(camera, dtype=np.float64)
    if expansion == "linear":
        return values
    held = np.maximum(values, 0.0)  # noise may make a channel negative
    pairs = [np.sqrt(held[..., i] * held[..., j]) for i, j in combinations(range(values.shape[-1]), 2)]
    return np.concatenate([values, np.stack(pairs, axis=-1)], axis=-1) if pairs else values


def fit_matrix(
    samples: ColourSamples, method: MatrixMethod = "least_delta_e_2000", expansion: Expansion = "linear"
) -> ColourError:
    """The best matrix from a camera's channels to XYZ, and the colour differences on the surfaces it was fitted to.

    Parameters
    ----------
    samples : of three or more independent channels.
    method : ``least_squares_xyz`` minimises the squares of the differences in XYZ; of many equal solutions it takes the
        one with the least elements. The other two start there and minimise the mean ΔE*ab or ΔE2000 (BFGS).
    expansion : see `expanded`.

    Examples
    --------
    >>> import hesim_render as hr
    >>> from hesim_render.spectral import spectrum as spectra
    >>> from hesim_render.studies import colour_samples, fit_matrix
    >>> responses = list(hr.load_sensor("reference-bayer").responses.values())
    >>> surfaces = list(spectra.colorchecker_reflectances().values())
    >>> samples = colour_samples(responses, spectra.illuminant("D65"), surfaces)
    >>> fit_matrix(samples).mean < fit_matrix(samples, "least_squares_xyz").mean < 1.5
    True

    Returns
    -------
    Matrix and errors: ΔE2000, or ΔE*ab of ``least_delta_e_ab``.

    Raises
    ------
    RangeError
        If the method or the expansion is unknown, or there are fewer surfaces than terms.
    SpecError
        If the channels span fewer than three dimensions.
    """
    if method not in get_args(MatrixMethod):
        raise RangeError("method", method, f"one of {', '.join(get_args(MatrixMethod))}")
    if expansion not in get_args(Expansion):
        raise RangeError("expansion", expansion, f"one of {', '.join(get_args(Expansion))}")
    terms = expanded(samples.camera, expansion)
    seen_rank = rank(samples.camera)
    if seen_rank < 3:
        raise SpecError(
            f"the channels see these surfaces in {seen_rank} of the 3 dimensions that colour needs; add a filter, or "
            "other surfaces"
        )
    if len(terms) < terms.shape[1]:
        raise RangeError("surfaces", len(terms), f"at least {terms.shape[1]}, the number of terms of the matrix")
    start, *_ = np.linalg.lstsq(terms, samples.xyz, rcond=1e-9)
    result: NDArray[np.float64] = np.asarray(start.T, dtype=np.float64)
    if method != "least_squares_xyz":
        result = _least_difference(terms, samples, result, method)
    return ColourError(result, method, expansion, colour_differences(samples, result, expansion, _measure_of(method)))


def colour_differences(
    samples: ColourSamples,
    matrix: ArrayLike,
    expansion: Expansion = "linear",
    measure: Literal["ab", "2000"] = "2000",
) -> NDArray[np.float64]:
    """Colour differences that a given matrix leaves on surfaces, [surface].

    Parameters
    ----------
    samples : the surfaces.
    matrix : [3, term].
    expansion : what the matrix is applied to.
    measure : ``2000`` or ``ab``.
    """
    difference = delta_e_2000 if measure == "2000" else delta_e_ab
    corrected = expanded(samples.camera, expansion) @ np.asarray(matrix).T
    return difference(lab(corrected, samples.white_xyz), lab(samples.xyz, samples.white_xyz))


@dataclass(frozen=True)
class MetamerismIndex:
    """Sensitivity metamerism index of ISO 17321-1.

    Parameters
    ----------
    value : 100 − 5.5 · mean ΔE*ab; 100 for a camera that meets the Luther condition, and below 0 for bad ones.
    method : how the matrix was fitted, as the standard leaves it open.
    mean_delta_e_ab : over the 18 chromatic patches.
    """

    value: float
    method: MatrixMethod
    mean_delta_e_ab: float


def metamerism_index(samples: ColourSamples, method: MatrixMethod = "least_delta_e_ab") -> MetamerismIndex:
    """SMI of ISO 17321-1: 100 − 5.5 times the mean ΔE*ab of the 18 chromatic patches of the ColorChecker.

    Parameters
    ----------
    samples : of the ColorChecker under the light; the first 18 surfaces are its chromatic patches, to which the matrix
        is fitted.
    method : ``least_squares_xyz`` or ``least_delta_e_ab``.

    Examples
    --------
    >>> import hesim_render as hr
    >>> from hesim_render.spectral import spectrum as spectra
    >>> from hesim_render.studies import colour_samples, metamerism_index, reflectance_set
    >>> responses = list(hr.load_sensor("reference-bayer").responses.values())
    >>> patches = list(reflectance_set("colorchecker").values())
    >>> round(metamerism_index(colour_samples(responses, spectra.illuminant("D65"), patches)).value)
    91

    Returns
    -------
    The index, with the method.

    Raises
    ------
    RangeError
        If there are fewer than 18 surfaces, or the method is unknown.
    SpecError
        If the channels span fewer than three dimensions.
    """
    if len(samples.camera) < _CHROMATIC:
        raise RangeError("surfaces", len(samples.camera), "the ColorChecker, with its 18 chromatic patches first")
    some = ColourSamples(samples.camera[:_CHROMATIC], samples.xyz[:_CHROMATIC], samples.white_xyz)
    matrix = fit_matrix(some, method).matrix
    mean = float(colour_differences(some, matrix, measure="ab").mean())
    return MetamerismIndex(100 - _SMI_PER_DELTA_E * mean, method, mean)


def _measure_of(method: MatrixMethod) -> Literal["ab", "2000"]:
    return "ab" if method == "least_delta_e_ab" else "2000"


def _least_difference(
    terms: NDArray, samples: ColourSamples, start: NDArray, method: MatrixMethod
) -> NDArray[np.float64]:
    """The matrix with the least mean colour difference near `start`; `start` itself where that is better."""
    from scipy.optimize import minimize

    difference = delta_e_2000 if _measure_of(method) == "2000" else delta_e_ab
    wanted = lab(samples.xyz, samples.white_xyz)
    steps = _STEP * np.abs(start).max() * np.eye(start.size)

    def loss(values: NDArray) -> NDArray[np.float64]:
        """Mean difference of matrices [..., element]."""
        matrices = values.reshape(*values.shape[:-1], *start.shape)
        corrected = np.einsum("st,...xt->...sx", terms, matrices)
        return difference(lab(corrected, samples.white_xyz), np.broadcast_to(wanted, corrected.shape)).mean(axis=-1)

    def loss_and_slope(values: NDArray) -> tuple[float, NDArray[np.float64]]:
        # central differences along all elements in one call
        around = loss(np.concatenate([values[None], values + steps, values - steps]))
        return float(around[0]), (around[1 : 1 + start.size] - around[1 + start.size :]) / (2 * steps[0, 0])

    result = minimize(loss_and_slope, start.ravel(), jac=True, method="BFGS", options={"maxiter": 200, "gtol": 1e-4})
    return result.x.reshape(start.shape) if result.fun < loss(start.ravel()) else start


def to_srgb(matrix: ArrayLike, white_xyz: ArrayLike) -> NDArray[np.float64]:
    """A matrix to linear sRGB in place of XYZ; the white of the light becomes (1, 1, 1) (Bradford).

    Parameters
    ----------
    matrix : [3, channel], to XYZ.
    white_xyz : [3].
    """
    return xyz_to_linear_srgb(np.asarray(matrix).T, white_xyz).T


def noise_aware_matrix(samples: ColourSamples, white_e: ArrayLike, noise: ChannelNoise) -> NDArray[np.float64]:
    """The matrix to XYZ with the least squared error over surfaces, noise included (Wiener's filter), [3, channel].

    M = (Σ x cᵀ)(Σ c cᵀ + Σ diag Var c)⁻¹ over the surfaces: it gives up colour where noise would cost more. Its second
    row is the best estimate of the luminance, also of cameras that see no colour.

    Parameters
    ----------
    samples : the surfaces.
    white_e : [channel], electrons of one pixel on a perfect white.
    noise : of the channels.
    """
    white = np.asarray(white_e, dtype=np.float64)
    variance = noise.variance_e2(np.maximum(samples.camera, 0) * white) / white**2
    normal = samples.camera.T @ samples.camera + np.diag(variance.sum(axis=0))
    return np.asarray(np.linalg.solve(normal, samples.camera.T @ samples.xyz).T, dtype=np.float64)
