"""The variance polynomial β of a tile position: weighted least squares on pooled pixels.

    Var = β0 + β1 I + β2 t + β3 I² + β4 I t + β5 t²      (I in DN of light, t in s, before the ADC)

Sample variances of Gaussian values scatter by 2 Var²/(n − 1), so they are weighted by the inverse of
that, from the fit itself: the score equation is then that of maximum likelihood. Pixels are pooled
into bins of brightness that keep their moments: only the weight is constant within a bin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.dark import ADC_VARIANCE_DN2, HIDDEN_VARIANCE_DN2

TERMS = ("1", "I", "t", "I^2", "I*t", "t^2")
#: The order in which terms go where the data cannot tell them apart.
_DROP_ORDER = (5, 4, 3, 2, 1)
_BINS = 256
_FLOOR_DN2 = 0.05
_USELESS = 0.25


def polynomial(beta: NDArray, signal_dn: NDArray, exposure_s: NDArray | float) -> NDArray:
    """Temporal variance in DN² without the ADC's; `beta` has the six terms on its last axis."""
    b = np.moveaxis(np.asarray(beta), -1, 0)
    return b[0] + b[2] * exposure_s + b[5] * exposure_s**2 + signal_dn * (b[1] + b[4] * exposure_s + b[3] * signal_dn)


def variance_map(beta: NDArray, signal_dn: NDArray, exposure_s: float) -> NDArray[np.float64]:
    """The polynomial of each pixel's own position; `beta` [tile_row, tile_col, 6], signal [row, col] (≥ 0 is used)."""
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
    powers : [bin, 5], Σ Iᵏ, k = 0 … 4. products : [bin, 3], Σ y Iᵏ, k = 0 … 2. squares : [bin], Σ y².
        y is the sample variance less the ADC's.
    freedom : frames − 1.
    lit : [bin], whether of the lit captures.
    """

    exposure_s: NDArray[np.float64]
    noise: NDArray[np.float64]
    powers: NDArray[np.float64]
    products: NDArray[np.float64]
    squares: NDArray[np.float64]
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


def pool(
    signal_dn: NDArray, variance_dn2: NDArray, exposure_s: float, mean_variance: float, frames: int, lit: bool
) -> Pooled:
    """Pool the pixels (flat arrays) of one position, capture and exposure.

    Parameters
    ----------
    variance_dn2 : sample variances, the ADC's still in.
    mean_variance : variance of the estimate of the dark mean that was subtracted, DN².
    """
    x = np.asarray(signal_dn, np.float64)
    y = np.asarray(variance_dn2, np.float64) - ADC_VARIANCE_DN2
    if not lit or x.size == 0:
        index, count = np.zeros(x.size, np.intp), 1
    else:
        low, high = float(x.min()), float(x.max())
        count = _BINS if high > low else 1
        index = np.minimum(((x - low) * (count / max(high - low, 1e-30))).astype(np.intp), count - 1)

    def total(values: NDArray | None) -> NDArray:
        return np.bincount(index, weights=values, minlength=count).astype(np.float64)

    x2, yx = x * x, y * x
    powers = np.stack([total(None), total(x), total(x2), total(x2 * x), total(x2 * x2)], axis=1)
    products = np.stack([total(y), total(yx), total(yx * x)], axis=1)
    squares = total(y * y)
    kept = powers[:, 0] > 0
    powers, products, squares = powers[kept], products[kept], squares[kept]
    size = len(squares)
    # Light or not, the error of the signal's estimate is that of a mean over the frames and of the dark line.
    noise = (
        np.maximum(products[:, 0] / powers[:, 0] + ADC_VARIANCE_DN2, 0) / frames + mean_variance
        if lit
        else np.zeros(size)
    )
    return Pooled(
        np.full(size, exposure_s), noise, powers, products, squares, np.full(size, frames - 1.0), np.full(size, lit)
    )


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
    chi2_per_dof, dof : goodness of fit over all pixels and exposures.
    hidden_pixels : pixel-exposures left out because rounding hides their noise.
    """

    beta: NDArray[np.float64]
    identified: NDArray[np.bool_]
    covariance: NDArray[np.float64]
    chi2_per_dof: float
    dof: int
    hidden_pixels: int


def fit_variance(bins: Pooled) -> VarianceFit:
    """Iteratively reweighted least squares, corrected for the noise of the signal.

    A signal estimated with error variance τ² inflates Σ I², Σ I³ and Σ I⁴ by known amounts (corrected
    score, Carroll et al., *Measurement Error in Nonlinear Models*, ch. 7); these are taken off, so noise
    neither biases β nor lets a flat scene pass for one of many brightnesses.
    """
    everything = bins.pixels.sum()
    seen = bins.variance_dn2 >= HIDDEN_VARIANCE_DN2
    bins = Pooled(*(getattr(bins, name)[seen] for name in Pooled.__dataclass_fields__))
    if bins.pixels.size == 0:
        nothing = np.zeros(6)
        return VarianceFit(nothing, nothing > 0, np.zeros((6, 6)), float("nan"), 0, int(everything))
    scale = np.array([1.0, 1.0, 1.0])
    scale[1] = max(float(np.max(np.abs(bins.signal_dn))), 1e-9)
    scale[2] = float(bins.exposure_s.max())
    units = np.array([1, scale[1], scale[2], scale[1] ** 2, scale[1] * scale[2], scale[2] ** 2])
    equations = _normal_equations(bins, scale)
    dropped: list[int] = []
    limit = _USELESS * float(bins.variance_dn2[bins.pixels >= np.median(bins.pixels)].max())
    while True:
        beta, keep, covariance, chi2, dof = _solve(bins, units, equations, dropped)
        # A term whose error alone could make up a good part of the largest variance is no estimate: fit without it.
        # (in scaled units every term is 1 at the largest signal and the longest exposure)
        useless = [j for j in _DROP_ORDER if keep[j] and covariance[j, j] > limit**2]
        if not useless:
            break
        dropped.append(useless[0])
    covariance /= np.outer(units, units)
    return VarianceFit(beta / units, keep, covariance, chi2, dof, int(everything - bins.pixels.sum()))


def _solve(
    bins: Pooled, units: NDArray, equations: tuple[NDArray, NDArray, NDArray], dropped: list[int]
) -> tuple[NDArray, NDArray, NDArray, float, int]:
    """β, the terms kept, covariance (scaled units), χ² per degree of freedom and the degrees of freedom."""
    products, exact, noisy = equations
    predicted = np.maximum(bins.variance_dn2, _FLOOR_DN2)
    beta = np.zeros(6)
    for _ in range(30):
        weight = bins.freedom / (2 * (predicted + ADC_VARIANCE_DN2) ** 2)
        matrix = np.tensordot(weight, exact, 1)
        keep = _identifiable(matrix, dropped)
        previous, beta = beta, np.zeros(6)
        beta[keep] = np.linalg.solve(matrix[np.ix_(keep, keep)], np.tensordot(weight, products, 1)[keep])
        predicted = np.maximum(polynomial(beta / units, bins.signal_dn, bins.exposure_s), _FLOOR_DN2)
        if np.allclose(beta, previous, rtol=1e-10, atol=1e-12):
            break
    inverse = np.linalg.inv(matrix[np.ix_(keep, keep)])
    scatter = np.tensordot(weight, noisy, 1)
    squares = float(weight @ bins.squares - 2 * beta @ np.tensordot(weight, products, 1) + beta @ scatter @ beta)
    dof = max(int(bins.pixels.sum()) - int(keep.sum()), 1)
    chi2 = squares / dof
    covariance = np.zeros((6, 6))
    covariance[np.ix_(keep, keep)] = inverse @ scatter[np.ix_(keep, keep)] @ inverse * max(chi2, 1.0)
    return beta, keep, covariance, chi2, dof


def _normal_equations(bins: Pooled, scale: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Xᵀy [bin, 6] and XᵀX [bin, 6, 6] (corrected, and as they are) of each bin in scaled units."""
    t = bins.exposure_s / scale[2]
    tau = bins.noise / scale[1] ** 2
    power = bins.powers / scale[1] ** np.arange(5)
    product = bins.products / scale[1] ** np.arange(3)
    corrected = power.copy()
    corrected[:, 2] -= tau * power[:, 0]
    corrected[:, 3] -= 3 * tau * power[:, 1]
    corrected[:, 4] -= tau * (6 * power[:, 2] - 3 * tau * power[:, 0])
    light, time = np.array([0, 1, 0, 2, 1, 0]), np.array([0, 0, 1, 0, 1, 2])
    times = t[:, None] ** np.arange(5)
    xty = product[:, light] * times[:, time]
    xty[:, 3] -= tau * product[:, 0]
    pairs = light[:, None] + light, time[:, None] + time
    factor = times[:, pairs[1]]
    return xty, corrected[:, pairs[0]] * factor, power[:, pairs[0]] * factor


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
        if np.linalg.eigvalsh(part / np.outer(root, root))[0] > 1e-7:
            break
    return keep
