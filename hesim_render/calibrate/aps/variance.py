"""The variance polynomial β of a tile position: weighted least squares on pooled pixels.

    Var = β0 + β1 I + β2 t + β3 I² + β4 I t + β5 t²      (I in DN of light, t in s, before the ADC)

Sample variances of Gaussian values scatter by 2 Var²/(n − 1), so they are weighted by the inverse of
that, from the fit itself: the score equation is then that of maximum likelihood. Pixels are pooled
into bins of brightness that keep their moments: only the weight is constant within a bin.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import factorial

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from hesim_render.pixels.aps.formulas import (
    ADC_VARIANCE_DN2,
    QUANTISED_VARIANCE_DN2,
    fourth_cumulant_dn4,
    polynomial,
)

TERMS = ("1", "I", "t", "I^2", "I*t", "t^2")
#: Order in which terms are dropped where the data cannot separate them.
_DROP_ORDER = (5, 4, 3, 2, 1)
#: Powers of light and of time of the terms, and of I³, which tests for curvature beyond the polynomial.
_LIGHT, _TIME = np.array([0, 1, 0, 2, 1, 0, 3]), np.array([0, 0, 1, 0, 1, 2, 0])
_POWERS, _PRODUCTS = 7, 4
#: Least eigenvalue of the scaled normal matrix at which terms can be separated.
_SINGULAR = 1e-7
_BINS = 256
_FLOOR_DN2 = 0.05
_USELESS = 0.25
#: Rounds after which a dropped term stays out.
_SETTLED = 3


def variance_map(beta: NDArray, signal_dn: NDArray, exposure_s: float) -> NDArray[np.float64]:
    """The polynomial of each pixel's own position, DN² [row, col].

    Parameters
    ----------
    beta : [tile_row, tile_col, 6], in DN and s.
    signal_dn : [row, col], light, DN; negative values count as 0.
    exposure_s : exposure, s.
    """
    tile_rows, tile_cols, _ = beta.shape
    rows, cols = signal_dn.shape
    tiled = np.maximum(signal_dn, 0).reshape(rows // tile_rows, tile_rows, cols // tile_cols, tile_cols)
    return polynomial(beta[:, None], tiled, exposure_s).reshape(rows, cols)


@dataclass(frozen=True)
class Pooled:
    """Moments of pixels pooled by brightness, one entry a bin (of one capture and exposure).

    Attributes
    ----------
    exposure_s, noise : [bin], exposure and variance of the error of a pixel's signal, DN².
    powers : [bin, 7], Σ Iᵏ, k = 0 … 6. products : [bin, 4], Σ y Iᵏ, k = 0 … 3. squares : [bin], Σ y².
        y is the sample variance less the ADC's.
    row_variance : of the row noise that was taken out of y, DN²: it still adds to the scatter of y.
    freedom : frames − 1.
    lit : [bin], whether of the lit captures.
    """

    exposure_s: NDArray[np.float64]
    noise: NDArray[np.float64]
    powers: NDArray[np.float64]
    products: NDArray[np.float64]
    squares: NDArray[np.float64]
    row_variance: NDArray[np.float64]
    freedom: NDArray[np.float64]
    lit: NDArray[np.bool_]

    @property
    def pixels(self) -> NDArray[np.float64]:
        return self.powers[:, 0]

    @property
    def signal_dn(self) -> NDArray[np.float64]:
        return self.powers[:, 1] / self.powers[:, 0]

    @property
    def variance_dn2(self) -> NDArray[np.float64]:
        return self.products[:, 0] / self.powers[:, 0]

    def weight(self, expected_dn2: NDArray) -> NDArray[np.float64]:
        """Inverse variance [bin] of a pixel's y where its variance is `expected_dn2`, the ADC's in it.

        For a Gaussian it is 2 V²/(n − 1). Row noise of variance R, after its own sample was subtracted, leaves its
        product with the pixel's noise: 2 (V² + 2 V R)/(n − 1).
        """
        return self.freedom / (2 * (expected_dn2**2 + 2 * expected_dn2 * self.row_variance))


def pool(
    signal_dn: NDArray,
    variance_dn2: NDArray,
    exposure_s: float,
    mean_variance: float,
    frames: int,
    lit: bool,
    row_variance: float = 0.0,
) -> Pooled:
    """Pool the pixels (flat arrays) of one position, capture and exposure.

    Parameters
    ----------
    variance_dn2 : sample variances, the ADC's still in, those of the rows' common noise taken out.
    mean_variance : variance of the estimate of the dark mean that was subtracted, DN².
    row_variance : of the row noise, DN².
    """
    x = np.asarray(signal_dn, np.float64)
    y = np.asarray(variance_dn2, np.float64) - ADC_VARIANCE_DN2
    if not lit or x.size == 0:
        index, count = np.zeros(x.size, np.intp), 1
    else:
        low, high = float(x.min()), float(x.max())
        count = _BINS if high > low else 1
        # bins of equal width in brightness; dark pixels make one bin
        index = np.minimum(((x - low) * (count / max(high - low, 1e-30))).astype(np.intp), count - 1)

    def total(values: NDArray | None) -> NDArray:
        return np.bincount(index, weights=values, minlength=count).astype(np.float64)

    # sums of powers of the signal, and of their products with the sample variance, [bin, power]
    powers, products = np.empty((count, _POWERS)), np.empty((count, _PRODUCTS))
    powers[:, 0], products[:, 0], power = total(None), total(y), np.ones_like(x)
    for k in range(1, _POWERS):
        power = power * x
        powers[:, k] = total(power)
        if k < _PRODUCTS:
            products[:, k] = total(y * power)
    squares = total(y * y)
    # bins without pixels go
    kept = powers[:, 0] > 0
    powers, products, squares = powers[kept], products[kept], squares[kept]
    size = len(squares)
    # Dark or lit, the error of the signal is that of a mean over the frames and of the dark line.
    noise = (
        np.maximum(products[:, 0] / powers[:, 0] + ADC_VARIANCE_DN2 + row_variance, 0) / frames + mean_variance
        if lit
        else np.zeros(size)
    )
    return Pooled(
        np.full(size, exposure_s), noise, powers, products, squares, np.full(size, row_variance),
        np.full(size, frames - 1.0), np.full(size, lit),
    )  # fmt: skip


def join(parts: list[Pooled]) -> Pooled:
    """Bins of several captures, exposures or positions as one."""
    return Pooled(*(np.concatenate([getattr(p, name) for p in parts]) for name in Pooled.__dataclass_fields__))


@dataclass(frozen=True)
class VarianceFit:
    """β of one position.

    Attributes
    ----------
    beta : [6], 0 where not identified. identified : [6].
    covariance : [6, 6], scaled by χ² where that exceeds 1; 0 for terms that are not identified.
    chi2_per_dof, dof : goodness of fit over all pixels and exposures. p_value : chance of a larger χ².
    expected_chi2 : per dof; above 1 where the variance is of few electrons, whose Poisson law has longer tails.
    cubic : coefficient of I³ where it is fitted besides, DN⁻¹, and its standard error; None where none is identifiable.
    quantised_pixels : pixel-exposures left out because rounding hides their noise.
    """

    beta: NDArray[np.float64]
    identified: NDArray[np.bool_]
    covariance: NDArray[np.float64]
    chi2_per_dof: float
    dof: int
    p_value: float
    expected_chi2: float
    cubic: tuple[float, float] | None
    quantised_pixels: int


def fit_variance(bins: Pooled, without: Sequence[int] = (), least_dn2: float = QUANTISED_VARIANCE_DN2) -> VarianceFit:
    """Iteratively reweighted least squares, corrected for the noise of the signal.

    A signal estimated with error variance τ² inflates Σ I², Σ I³ and Σ I⁴ by known amounts (corrected
    score, Carroll et al., *Measurement Error in Nonlinear Models*, ch. 7); these are taken off, so noise
    neither biases β nor lets a flat scene pass for one of many brightnesses.

    Parameters
    ----------
    bins : pooled variances.
    without : numbers of terms that are not fitted.
    least_dn2 : variance, without that of the ADC, below which rounding hides it, so that it tells nothing.
    """
    everything = bins.pixels.sum()
    seen = bins.variance_dn2 >= least_dn2
    bins = Pooled(*(getattr(bins, name)[seen] for name in Pooled.__dataclass_fields__))
    if bins.pixels.size == 0:
        nothing = np.zeros(6)
        return VarianceFit(nothing, nothing > 0, np.zeros((6, 6)), float("nan"), 0, 1.0, 1.0, None, int(everything))
    # units in which the largest signal and the longest exposure are 1
    scale = np.array([1.0, 1.0, 1.0])
    scale[1] = max(float(np.max(np.abs(bins.signal_dn))), 1e-9)
    scale[2] = float(bins.exposure_s.max())
    units = np.prod(scale[1:] ** np.stack([_LIGHT, _TIME], axis=1), axis=1)
    equations = _normal_equations(bins, scale)
    # terms whose error is as large as a quarter of the largest variance leave one by one
    dropped = list(without)
    limit = _USELESS * float(bins.variance_dn2[bins.pixels >= np.median(bins.pixels)].max())
    while True:
        solved = beta, keep, covariance, chi2, dof = _solve(bins, units, equations, dropped)
        # A term whose error could be a large part of the largest variance is no estimate: fit without it.
        # (in scaled units every term is 1 at the largest signal and the longest exposure)
        useless = [j for j in _DROP_ORDER if keep[j] and covariance[j, j] > limit**2]
        if not useless:
            break
        dropped.append(useless[0])
    cubic = _cubic(bins, units, equations, solved)
    quantised = int(everything - bins.pixels.sum())
    units = units[:6]
    covariance = covariance / np.outer(units, units)
    beta = beta / units
    expected = _expected_chi2(bins, beta)
    p_value = _p_value(bins, chi2 / expected, dof)
    return VarianceFit(beta, keep, covariance, chi2, dof, p_value, expected, cubic, quantised)


def _p_value(bins: Pooled, chi2: float, dof: int) -> float:
    """Probability of a larger χ² of the sample variances: each square scatters by 2 + 12/(n − 1) (Gaussian noise)."""
    # normal law of a sum of so many squares
    each = float(np.average(2 + 12 / bins.freedom, weights=bins.pixels))
    return float(ndtr(-(chi2 - 1) * np.sqrt(dof / each)))


def _expected_chi2(bins: Pooled, beta: NDArray) -> float:
    """χ²/dof if light and dark current are counts with gain K = β1: s² scatters by κ₄/n more, κ₄ = K³ (I + D t)/K."""
    predicted = np.maximum(polynomial(beta, bins.signal_dn, bins.exposure_s), _FLOOR_DN2)
    fourth = fourth_cumulant_dn4(max(beta[1], 0.0), np.maximum(predicted - max(beta[0], 0.0), 0.0))
    more = bins.weight(predicted + ADC_VARIANCE_DN2) * fourth / (bins.freedom + 1)
    return 1 + float(np.average(more, weights=bins.pixels))


def _cubic(bins: Pooled, units: NDArray, equations: tuple, solved: tuple) -> tuple[float, float] | None:
    """Coefficient of I³ fitted with the kept terms, and its standard error; None where it cannot be separated from
    them.
    """
    beta, keep, _, chi2, _ = solved
    products, exact, noisy = equations
    predicted = np.maximum(polynomial(beta / units[:6], bins.signal_dn, bins.exposure_s), _FLOOR_DN2)
    weight = bins.weight(predicted + ADC_VARIANCE_DN2)
    # the terms of the fit, and I³
    kept = np.append(np.flatnonzero(keep), 6)
    matrix, scatter = (np.tensordot(weight, m, 1)[np.ix_(kept, kept)] for m in (exact, noisy))
    # not separable from the others: the scaled matrix is singular
    root = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    if np.linalg.eigvalsh(matrix / np.outer(root, root))[0] < _SINGULAR:
        return None
    inverse = np.linalg.inv(matrix)
    value = float((inverse @ np.tensordot(weight, products, 1)[kept])[-1])
    error = float(np.sqrt((inverse @ scatter @ inverse)[-1, -1] * max(chi2, 1.0)))
    return value / float(units[6]), error / float(units[6])


def _solve(
    bins: Pooled, units: NDArray, equations: tuple[NDArray, NDArray, NDArray], dropped: list[int]
) -> tuple[NDArray, NDArray, NDArray, float, int]:
    """β, the terms kept, covariance (scaled units), χ² per degree of freedom and the degrees of freedom."""
    products, (exact, noisy) = equations[0][:, :6], (m[:, :6, :6] for m in equations[1:])
    units = units[:6]
    predicted = np.maximum(bins.variance_dn2, _FLOOR_DN2)
    beta, dropped = np.zeros(6), list(dropped)
    for turn in range(30):
        # weights from the variance that the last round predicts
        weight = bins.weight(predicted + ADC_VARIANCE_DN2)
        matrix = np.tensordot(weight, exact, 1)
        keep = _identifiable(matrix, dropped)
        if turn >= _SETTLED:
            # a term identified with the weights of one round and not of the next would alternate without end
            dropped = list(np.flatnonzero(~keep))
        # normal equations of the terms that the captures tell apart
        previous, beta = beta, np.zeros(6)
        beta[keep] = np.linalg.solve(matrix[np.ix_(keep, keep)], np.tensordot(weight, products, 1)[keep])
        predicted = np.maximum(polynomial(beta / units, bins.signal_dn, bins.exposure_s), _FLOOR_DN2)
        if np.allclose(beta, previous, rtol=1e-10, atol=1e-12):
            break
    inverse = np.linalg.inv(matrix[np.ix_(keep, keep)])
    # covariance by the sandwich, as regressors have noise of their own; wider where χ² shows misfit
    scatter = np.tensordot(weight, noisy, 1)
    squares = float(weight @ bins.squares - 2 * beta @ np.tensordot(weight, products, 1) + beta @ scatter @ beta)
    dof = max(int(bins.pixels.sum()) - int(keep.sum()), 1)
    chi2 = squares / dof
    covariance = np.zeros((6, 6))
    covariance[np.ix_(keep, keep)] = inverse @ scatter[np.ix_(keep, keep)] @ inverse * max(chi2, 1.0)
    return beta, keep, covariance, chi2, dof


def _normal_equations(bins: Pooled, scale: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Xᵀy [bin, 7] and XᵀX [bin, 7, 7] (corrected, and as they are) of each bin in scaled units; the last is I³.

    Of an Î = I + τ z, Hermite polynomials have the mean Iᵏ: Î² − τ², Î³ − 3 τ² Î, and so on.
    """
    t = bins.exposure_s / scale[2]
    tau = bins.noise / scale[1] ** 2
    power = bins.powers / scale[1] ** np.arange(_POWERS)
    product = bins.products / scale[1] ** np.arange(_PRODUCTS)
    corrected, corrected_product = _without_noise(power, tau), _without_noise(product, tau)
    # every entry is a sum of Iᵃ tᵇ, with the exponents of both terms added
    times = t[:, None] ** np.arange(5)
    pairs = _LIGHT[:, None] + _LIGHT, _TIME[:, None] + _TIME
    factor = times[:, pairs[1]]
    return corrected_product[:, _LIGHT] * times[:, _TIME], corrected[:, pairs[0]] * factor, power[:, pairs[0]] * factor


def _without_noise(sums: NDArray, tau: NDArray) -> NDArray[np.float64]:
    """Σ of a factor times Hermite polynomials of Î, from Σ of it times powers of Î: [bin, power]; `tau` is τ²."""
    result = sums.astype(np.float64).copy()
    for n in range(2, sums.shape[1]):
        for j in range(1, n // 2 + 1):
            # coefficients of the Hermite polynomial of degree n
            count = factorial(n) / (factorial(j) * factorial(n - 2 * j) * 2**j)
            result[:, n] += (-1) ** j * count * tau**j * sums[:, n - 2 * j]
    return result


def _identifiable(matrix: NDArray, dropped: list[int]) -> NDArray[np.bool_]:
    """Which terms to keep, besides those `dropped`, so that the scaled normal matrix is well conditioned."""
    keep = np.ones(6, bool)
    keep[dropped] = False
    for term in (None, *_DROP_ORDER):
        if term is not None:
            keep[term] = False
        part = matrix[np.ix_(keep, keep)]
        diagonal = np.diag(part)
        if np.any(diagonal <= 0):
            continue
        root = np.sqrt(diagonal)
        if np.linalg.eigvalsh(part / np.outer(root, root))[0] > _SINGULAR:
            break
    return keep
