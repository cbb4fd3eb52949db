"""What pixels do together from frame to frame: rows (temporal row noise), and whole frames (black level, light).

The variance of a mean over n pixels that share nothing is Σ s²/n², with their own sample variances. What it is
above that is the mean covariance of two of them. A row's mean tells that of the row, after each frame's own mean was
taken off; the frame's mean tells that of the frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_law

from hesim_render.calibrate.finding import ALARM
from hesim_render.calibrate.moments import Moments

#: Least part of a row that is not clipped, where the row's own sample of its noise is taken.
_LEAST_CLEAR = 0.2
#: Of a row's mean: frames that are all alike have none.
_LEAST_NOISE_DN2 = 1e-12
#: Times the median noise of a row from which it counts less.
_BUSY = 2.0
#: Difference of the halves' light, as a part of the brighter, that tells light from black.
_LEAST_BETWEEN = 0.2


@dataclass(frozen=True)
class Shared:
    """A variance that pixels share.

    Attributes
    ----------
    variance : its unbiased estimate, which noise may bring below 0. error : standard error.
    ratio : of the variance of the mean to that of its noise, 1 where nothing is shared.
    p_value : chance of one as large where nothing is shared.
    """

    variance: float
    error: float
    ratio: float
    p_value: float

    @property
    def significant(self) -> bool:
        return self.variance > 0 and self.p_value < ALARM

    @property
    def rms(self) -> float:
        return float(np.sqrt(max(self.variance, 0.0)))


def row_noise(dark: Moments, used: NDArray[np.bool_]) -> Shared:
    """Temporal row noise in DN² of the dark frames, all exposures together.

    Lit frames would not do: light that flickers moves bright rows more than dim ones.
    """
    rows = used.any(axis=1)
    count = int(rows.sum())
    if count < 2:
        return Shared(0.0, float("inf"), 1.0, 1.0)
    exposures = range(dark.exposures_us.size)
    parts = [_row_changes(dark, k, used) for k in exposures]
    own = np.maximum([noise[rows] for _, noise in parts], _LEAST_NOISE_DN2)
    found = np.stack([np.sum(change[:, rows] ** 2, axis=0) for change, _ in parts]) / (dark.frames - 1)
    found *= count / (count - 1)
    # a row with a pixel that flickers tells less; weights that follow the rows' own samples would bend the sum
    weight = 1 / np.maximum(own, _BUSY * np.median(own, axis=1)[:, None]) ** 2
    level, total = weight * own, float(np.sum(weight * own))
    ratio = float(np.sum(weight * found)) / total
    freedom = total**2 / float(np.sum(level**2)) * (dark.frames - 1) * (count - 1) / count
    behind = (dark.frames - 1) * float(used.sum()) * len(exposures)
    scale = total / float(weight.sum())
    error = scale * ratio * float(np.sqrt(2 / freedom))
    return Shared(scale * (ratio - 1), error, ratio, float(f_law.sf(ratio, freedom, behind)))


def without_rows(moments: Moments, used: NDArray[np.bool_], full_scale_dn: int, typical: float) -> Moments:
    """The same with temporal row noise taken out of the sample variances.

    What is taken off is the rows' own sample of it in these frames: the expected value would leave the scatter of
    that sample, which all pixels of a row share, in the variance polynomial.

    Parameters
    ----------
    typical : variance of the row noise, DN²; taken where a row is all but clipped.
    """
    variance = moments.variance.copy()
    for k in range(moments.exposures_us.size):
        change, noise = _row_changes(moments, k, used)
        saturated = (moments.lowest[k] >= full_scale_dn) | (moments.highest[k] == 0)
        clear = np.sum(~saturated & used, axis=1) / np.maximum(used.sum(axis=1), 1)
        own = (np.sum(change**2, axis=0) / (moments.frames - 1) - noise) / np.maximum(clear, _LEAST_CLEAR) ** 2
        own += typical / change.shape[1]  # what the frame's mean took of it
        variance[k] -= np.where(clear >= _LEAST_CLEAR, own, typical)[:, None].astype(np.float32)
        variance[k][saturated] = moments.variance[k][saturated]
    return replace(moments, variance=variance)


def _row_changes(moments: Moments, k: int, used: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Of each row, the change of its mean from frame to frame beyond its frame's [frame, row], and what its pixels'
    own noise makes of its variance [row]."""
    rows = used.any(axis=1)
    change = moments.row_means[k] - moments.row_means[k].mean(axis=0)
    change = change - change[:, rows].mean(axis=1)[:, None]
    total = np.sum(np.where(used, moments.variance[k], 0.0), axis=1, dtype=np.float64)
    pixels = np.maximum(used.sum(axis=1), 2)
    # a pixel's own variance holds what the row shares: Σ (s² − R)/n² with R = (variance of the row − Σ s²/n²)·n/(n − 1)
    of_row = np.sum(change**2, axis=0) / (moments.frames - 1) * rows.sum() / max(int(rows.sum()) - 1, 1)
    shared = (of_row - total / pixels**2) * pixels / (pixels - 1)
    return change, (total - pixels * shared) / pixels**2


@dataclass(frozen=True)
class FrameDrift:
    """What whole frames do together, of one exposure.

    Attributes
    ----------
    black : variance of the level that all pixels share, DN². light : relative variance of the light; None where the
        frames are dark, or too even to tell light from black.
    black_range_dn, light_range : from the lowest to the highest frame.
    """

    exposure_us: int
    black: Shared
    light: Shared | None
    black_range_dn: float
    light_range: float


def frame_drift(moments: Moments, k: int, row_variance: float, signal_dn: NDArray | None) -> FrameDrift:
    """Drift of the frames of an exposure: of the black level in the dark; in the light of black and of light, apart.

    A shift of black moves dim and bright pixels alike, light moves them in proportion to their signal: the means of
    the dimmer and of the brighter half tell one from the other. The first frame, which sorts them, takes no part.

    Parameters
    ----------
    row_variance : of temporal row noise, DN². signal_dn : [row, col], light above black; None in the dark.
    """
    halves = [moments.half[k] == side for side in (0, 1)]
    pixels = np.array([max(int(mask.sum()), 1) for mask in halves])
    own = np.array([float(np.sum(moments.variance[k][m], dtype=np.float64)) for m in halves]) / pixels**2
    # halves may lie in different rows: what rows add does not cancel in their difference
    part = np.stack([mask.sum(axis=1) for mask in halves]) / pixels[:, None]
    covariance = np.diag(own) + row_variance * (part @ part.T)
    change = moments.half_means[k, 1:] - moments.half_means[k, 1:].mean(axis=0)
    exposure, count = int(moments.exposures_us[k]), float(pixels.sum())

    def series(weight: NDArray) -> tuple[NDArray[np.float64], Shared]:
        values = change @ weight
        return values, _excess(values, float(weight @ covariance @ weight), count)

    together, shared = series(pixels / count)
    alone = FrameDrift(exposure, shared, None, float(np.ptp(together)), 0.0)
    if signal_dn is None:
        return alone
    levels = [float(signal_dn[m].mean()) if m.any() else 0.0 for m in halves]
    between = levels[1] - levels[0]
    if between < _LEAST_BETWEEN * max(levels[1], 1e-9) or between <= 0:
        return alone
    light, of_light = series(np.array([-1.0, 1.0]) / between)
    # the dim half's change less the light's part of it
    black, of_black = series(np.array([1 + levels[0] / between, -levels[0] / between]))
    return FrameDrift(exposure, of_black, of_light, float(np.ptp(black)), float(np.ptp(light)))


def _excess(change: NDArray, noise: float, pixels: float) -> Shared:
    """Variance of a series beyond that of its noise, which is known from many pixels."""
    freedom = change.size - 1
    noise = max(noise, 1e-30)
    ratio = float(change @ change) / freedom / noise
    return Shared(
        noise * (ratio - 1), noise * ratio * float(np.sqrt(2 / freedom)), ratio,
        float(f_law.sf(ratio, freedom, freedom * pixels)),
    )  # fmt: skip
