"""Noise that pixels share from frame to frame: rows (temporal row noise), and whole frames (black level, light).

The variance of a mean over n pixels that share nothing is Σ s²/n², with their own sample variances s². The excess over
it is the mean covariance of two pixels. The mean of a row, minus the mean of its frame, gives that of the row. The mean
of the frame gives that of the frame.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_law

from hesim_render.calibrate.estimate import ALARM
from hesim_render.calibrate.moments import FrameMoments

#: Least fraction of a row that is not clipped for which the row's own sample of its noise is used.
_LEAST_CLEAR = 0.2
#: Least variance of the mean of a row, DN²: identical frames have none.
_LEAST_NOISE_DN2 = 1e-12
#: Ratio to the median noise of the rows above which a row has a smaller weight.
_BUSY = 2.0
#: Least difference of the halves' light, relative to the brighter half, that separates light from black level.
_LEAST_BETWEEN = 0.2


@dataclass(frozen=True)
class Shared:
    """Variance that pixels share.

    Attributes
    ----------
    variance : unbiased estimate, which noise may make negative.
    error : standard error.
    ratio : variance of the mean over that of its noise, 1 where nothing is shared.
    p_value : probability of a ratio as large where nothing is shared.
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


def row_noise(dark: FrameMoments, used: NDArray[np.bool_]) -> Shared:
    """Temporal row noise in DN² of the dark frames, all exposures together.

    Lit frames are not suitable: flickering light changes bright rows more than dim ones.

    Parameters
    ----------
    dark : moments of the dark frames.
    used : [row, col], pixels that have an APS value.
    """
    rows = used.any(axis=1)
    count = int(rows.sum())
    if count < 2:
        return Shared(0.0, float("inf"), 1.0, 1.0)
    exposures = range(dark.exposures_us.size)
    parts = [_row_changes(dark, k, used) for k in exposures]
    own = np.maximum([noise[rows] for _, noise in parts], _LEAST_NOISE_DN2)
    # variance of each row's mean over the frames, with the mean over rows taken out, [exposure, row]
    result = np.stack([np.sum(change[:, rows] ** 2, axis=0) for change, _ in parts]) / (dark.frames - 1)
    result *= count / (count - 1)
    # a row with a flickering pixel has less information; weights from the rows' own samples would bias the sum
    weight = 1 / np.maximum(own, _BUSY * np.median(own, axis=1)[:, None]) ** 2
    level, total = weight * own, float(np.sum(weight * own))
    ratio = float(np.sum(weight * result)) / total
    # effective number of squares in a weighted sum of them
    freedom = total**2 / float(np.sum(level**2)) * (dark.frames - 1) * (count - 1) / count
    behind = (dark.frames - 1) * float(used.sum()) * len(exposures)
    # mean of the pixels' own part, DN², by which the ratio becomes a variance
    scale = total / float(weight.sum())
    error = scale * ratio * float(np.sqrt(2 / freedom))
    return Shared(scale * (ratio - 1), error, ratio, float(f_law.sf(ratio, freedom, behind)))


def without_rows(moments: FrameMoments, used: NDArray[np.bool_], full_scale_dn: int, typical: float) -> FrameMoments:
    """The moments with temporal row noise subtracted from the sample variances.

    The subtracted value is the rows' own sample of the noise in these frames. Subtracting the expected value would
    leave the scatter of that sample, which all pixels of a row share, in the variance polynomial.

    Parameters
    ----------
    moments : of the frames.
    used : [row, col], pixels that have an APS value.
    full_scale_dn : largest value of the ADC, DN.
    typical : variance of the row noise, DN²; used where nearly the whole row is clipped.
    """
    variance = moments.variance.copy()
    for k in range(moments.exposures_us.size):
        change, noise = _row_changes(moments, k, used)
        saturated = (moments.lowest[k] >= full_scale_dn) | (moments.highest[k] == 0)
        # part of the row's pixels that are not clipped
        clear = np.sum(~saturated & used, axis=1) / np.maximum(used.sum(axis=1), 1)
        own = (np.sum(change**2, axis=0) / (moments.frames - 1) - noise) / np.maximum(clear, _LEAST_CLEAR) ** 2
        own += typical / change.shape[1]  # what the frame's mean took of it
        variance[k] -= np.where(clear >= _LEAST_CLEAR, own, typical)[:, None].astype(np.float32)
        variance[k][saturated] = moments.variance[k][saturated]
    return replace(moments, variance=variance)


def _row_changes(
    moments: FrameMoments, k: int, used: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Changes of the rows' means from frame to frame, and the part of their variance due to the pixels' own noise.

    Parameters
    ----------
    moments : of the frames.
    k : number of the exposure.
    used : [row, col], pixels that have an APS value.

    Returns
    -------
    change : [frame, row], DN, without the change of the whole frame.
    own : [row], DN².
    """
    rows = used.any(axis=1)
    change = moments.row_means[k] - moments.row_means[k].mean(axis=0)
    # the change of the whole frame is drift, and no row noise
    change = change - change[:, rows].mean(axis=1)[:, None]
    total = np.sum(np.where(used, moments.variance[k], 0.0), axis=1, dtype=np.float64)
    pixels = np.maximum(used.sum(axis=1), 2)
    # a pixel's variance includes the row noise R: Σ (s² − R)/n² with R = (variance of the row − Σ s²/n²)·n/(n − 1)
    of_row = np.sum(change**2, axis=0) / (moments.frames - 1) * rows.sum() / max(int(rows.sum()) - 1, 1)
    shared = (of_row - total / pixels**2) * pixels / (pixels - 1)
    return change, (total - pixels * shared) / pixels**2


@dataclass(frozen=True)
class FrameDrift:
    """Drift of whole frames of one exposure.

    Attributes
    ----------
    black : variance of the level that all pixels share, DN².
    light : relative variance of the light; None where the frames are dark, or too even to separate light from black
        level.
    black_range_dn, light_range : range from the lowest to the highest frame.
    """

    exposure_us: int
    black: Shared
    light: Shared | None
    black_range_dn: float
    light_range: float


def frame_drift(moments: FrameMoments, k: int, row_variance: float, signal_dn: NDArray | None) -> FrameDrift:
    """Drift of the frames of an exposure: of the black level in the dark; of black level and light separately in the
    light.

    A shift of the black level changes dim and bright pixels equally, the light changes them in proportion to their
    signal. The means of the dimmer and of the brighter half separate the two. The first frame, which sorts the pixels,
    is not used.

    Parameters
    ----------
    moments : of the frames.
    k : number of the exposure.
    row_variance : variance of the temporal row noise, DN².
    signal_dn : [row, col], light above black, DN; None in the dark.
    """
    halves = [moments.half[k] == side for side in (0, 1)]
    # [half]; the variance of their means by the pixels' own noise
    pixels = np.array([max(int(mask.sum()), 1) for mask in halves])
    own = np.array([float(np.sum(moments.variance[k][m], dtype=np.float64)) for m in halves]) / pixels**2
    # the halves may lie in different rows: row noise does not cancel in their difference
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
    # two equations for each frame: level + light · signal of the half
    levels = [float(signal_dn[m].mean()) if m.any() else 0.0 for m in halves]
    between = levels[1] - levels[0]
    if between < _LEAST_BETWEEN * max(levels[1], 1e-9) or between <= 0:
        return alone
    light, of_light = series(np.array([-1.0, 1.0]) / between)
    # change of the dim half minus the contribution of the light
    black, of_black = series(np.array([1 + levels[0] / between, -levels[0] / between]))
    return FrameDrift(exposure, of_black, of_light, float(np.ptp(black)), float(np.ptp(light)))


def _excess(change: NDArray, noise: float, pixels: float) -> Shared:
    """Variance of a series beyond that of its noise.

    Parameters
    ----------
    change : [frame], the series.
    noise : variance of its noise, known from many pixels.
    pixels : number of these pixels.
    """
    freedom = change.size - 1
    noise = max(noise, 1e-30)
    ratio = float(change @ change) / freedom / noise
    return Shared(
        noise * (ratio - 1), noise * ratio * float(np.sqrt(2 / freedom)), ratio,
        float(f_law.sf(ratio, freedom, freedom * pixels)),
    )  # fmt: skip
