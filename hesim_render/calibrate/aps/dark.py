"""Parameters of the dark frames: N_DP, N_FP, rows, black level, hot pixels."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.moments import FrameMoments
from hesim_render.core.errors import SpecError
from hesim_render.pixels.aps.formulas import ADC_VARIANCE_DN2, QUANTISED_VARIANCE_DN2


@dataclass(frozen=True)
class DarkModel:
    """Dark mean = N_FP + t · N_DP, with N_FP = black + N_row + N_BLC.

    Attributes
    ----------
    n_dp : float32 [row, col], DN/s.
    black : mean of the row offsets, DN.
    n_row : float64 [row], DN, mean 0.
    n_blc : float32 [row, col], DN, row means 0.
    covariance : [2, 2] of a pixel's (N_FP, N_DP), DN², DN²/s, DN²/s².
    chi2_per_dof : of the straight line, over all good pixels; None with 2 exposures.
    bad : [row, col], pixels without two unclipped dark exposures, or without an APS value.
    hot : [row, col], pixels with an outlying N_DP.
    hot_limit_dn_per_s : N_DP above which a pixel counts as hot, DN/s.
    """

    n_dp: NDArray[np.float32]
    black: float
    n_row: NDArray[np.float64]
    n_blc: NDArray[np.float32]
    covariance: NDArray[np.float64]
    chi2_per_dof: float | None
    bad: NDArray[np.bool_]
    hot: NDArray[np.bool_]
    hot_limit_dn_per_s: float

    @property
    def n_fp(self) -> NDArray[np.float32]:
        return (self.n_blc + (self.black + self.n_row)[:, None]).astype(np.float32)

    def mean_variance(self, exposure_s: float) -> float:
        """Variance of the estimate of a pixel's dark mean at an exposure in s, DN²."""
        line = np.array([1.0, exposure_s])
        return float(line @ self.covariance @ line)


def fit_dark(
    moments: FrameMoments, used: NDArray[np.bool_], full_scale_dn: int, row_variance_dn2: float = 0.0
) -> DarkModel:
    """Straight lines through the dark means, one per pixel, exposures weighted by their median variance.

    Parameters
    ----------
    used : [row, col], pixels that have an APS value.
    row_variance_dn2 : variance of the temporal row noise, DN², already subtracted from the moments' variances.

    Raises
    ------
    SpecError
        If the dark frames are clipped, or their noise is below the steps of the ADC.
    """
    t = moments.exposures_s
    # [exposure, row, col]; clipping at either end takes part of the noise away, and moves the mean
    valid = (moments.lowest > 0) & (moments.highest < full_scale_dn)
    if np.mean(valid[:, used]) < 0.5:
        clipped_low = np.mean(moments.lowest[:, used] == 0) > 0.4
        raise SpecError(
            "most dark frames are clipped at 0 DN, which hides half of the noise; capture with a black level "
            "(pedestal) of several standard deviations of the noise"
            if clipped_low
            else "most dark frames reach full scale; cover the lens and shorten the exposures"
        )
    # noise of each exposure, [exposure]: a median, as hot pixels would raise a mean
    spread = np.array(
        [
            np.median(v[used & ok]) + row_variance_dn2 if np.any(used & ok) else np.nan
            for v, ok in zip(moments.variance, valid, strict=True)
        ]
    )
    # The means of exposures whose noise is lost in quantisation are biased by up to half a step: they are not used.
    quantised = ~(spread - ADC_VARIANCE_DN2 >= QUANTISED_VARIANCE_DN2)
    if np.sum(~quantised) < 2:
        measured = max(np.nanmax(spread) - ADC_VARIANCE_DN2, 0)
        raise SpecError(
            f"the temporal variance of the dark frames is {measured:.3f} DN² without the ADC's 1/12, below "
            f"{QUANTISED_VARIANCE_DN2} DN²: rounding hides the noise and biases the means; capture RAW with more bits "
            "(10 or more) or a higher analog gain"
        )
    spread[quantised] = np.nan
    valid &= ~quantised[:, None, None]
    # one weight for all pixels of an exposure, so that one matrix solves all lines at once
    weight = np.where(np.isfinite(spread), moments.frames / np.maximum(spread, ADC_VARIANCE_DN2), 0.0)
    n_fp, n_dp, covariance = _all_pixels(moments.mean, t, weight)
    # pixels that are clipped at some exposure have a line of their own through the others
    broken = used & ~valid[~quantised].all(axis=0)
    bad = used & (valid.sum(axis=0) < 2)
    n_fp[broken], n_dp[broken] = _masked(moments.mean[:, broken], t, weight, valid[:, broken])
    n_dp[bad | ~used] = 0.0
    good = used & ~bad
    black, n_row, n_blc = split_fixed_pattern(n_fp, good)
    # χ² needs an exposure more than the two that a line takes
    whole = used & valid[~quantised].all(axis=0)
    freedom = int(np.sum(~quantised)) - 2
    chi2 = None
    if freedom > 0 and np.any(whole):
        chi2 = sum(
            w * float(np.mean((m[whole] - (n_fp + n_dp * s)[whole]) ** 2))
            for w, m, s in zip(weight, moments.mean, t, strict=True)
        ) / freedom  # fmt: skip
    # hot: six robust standard deviations, or six errors of a single pixel where that is more
    middle = float(np.median(n_dp[good]))
    robust = 1.4826 * float(np.median(np.abs(n_dp[good] - middle)))
    limit = middle + 6 * max(robust, np.sqrt(covariance[1, 1]))
    return DarkModel(
        n_dp=n_dp.astype(np.float32),
        black=black,
        n_row=n_row,
        n_blc=n_blc.astype(np.float32),
        covariance=covariance,
        chi2_per_dof=chi2,
        bad=bad | ~used,
        hot=good & (n_dp > limit),
        hot_limit_dn_per_s=limit,
    )


def split_fixed_pattern(
    n_fp: NDArray[np.float64], good: NDArray[np.bool_]
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """black, N_row and N_BLC of N_FP, with mean(N_row) = 0 and every row mean of N_BLC = 0.

    Pixels that are not `good` have N_BLC = 0 and are not part of the means.
    """
    count = good.sum(axis=1)
    rows = np.where(count > 0, np.where(good, n_fp, 0.0).sum(axis=1) / np.maximum(count, 1), np.nan)
    black = float(np.nanmean(rows))
    rows = np.where(np.isfinite(rows), rows, black)
    return black, rows - black, np.where(good, n_fp - rows[:, None], 0.0)


def _all_pixels(
    mean: NDArray[np.float32], t: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    # weighted least squares [2, exposure]: the coefficients are sums of images with fixed factors
    design = np.stack([np.ones_like(t), t])
    covariance: NDArray[np.float64] = np.linalg.inv((design * weight) @ design.T).astype(np.float64)
    solve = covariance @ (design * weight)
    n_fp: NDArray[np.float64] = np.zeros(mean.shape[1:])
    n_dp: NDArray[np.float64] = np.zeros(mean.shape[1:])
    for (a, b), image in zip(solve.T, mean, strict=True):
        n_fp += a * image
        n_dp += b * image
    return n_fp, n_dp, covariance


def _masked(
    mean: NDArray[np.float32], t: NDArray[np.float64], weight: NDArray[np.float64], valid: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The same line where some exposures of a pixel are clipped; arrays [exposure, pixel]."""
    w = weight[:, None] * valid
    total = np.maximum(w.sum(axis=0), 1e-30)
    t_mean, y_mean = (w * t[:, None]).sum(axis=0) / total, (w * mean).sum(axis=0) / total
    # about the weighted means of each pixel the normal equations have no mixed term
    centred = t[:, None] - t_mean
    slope = (w * centred * mean).sum(axis=0) / np.maximum((w * centred**2).sum(axis=0), 1e-30)
    return y_mean - slope * t_mean, slope
