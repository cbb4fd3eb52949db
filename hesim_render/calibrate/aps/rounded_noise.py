"""Dark noise that is smaller than a step of the ADC, from the probabilities of grey values under rounding.

A dark pixel with its own level μ and noise σ has the grey value k with the chance Φ((k + ½ − μ)/σ) − Φ((k − ½ − μ)/σ).
Over the pixels μ is normal, with mean m and deviation s. Mean and variance of all values follow from m and τ² = σ² + s²
alone, and give these two. The mean over pixels of each one's variance over the frames then rises with σ from 0, as only
pixels whose level is near the edge of a step change their value. Sheppard's 1/12 holds for none of these.

Where the noise is larger, Sheppard's 1/12 nearly holds. With e = exp(−2π²σ²), to the first order in e, the mean of a
rounded value is μ − e sin(2πμ)/π, and its variance σ² + 1/12 − e (4σ² + 1/π²) cos(2πμ).
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special

from hesim_render.calibrate.aps.long_series import Long
from hesim_render.calibrate.aps.pair_levels import Levels
from hesim_render.calibrate.aps.spatial import spatial_variance
from hesim_render.calibrate.estimate import Z_95
from hesim_render.pixels.aps.formulas import ADC_VARIANCE_DN2

#: Groups of rows of the jackknife.
_GROUPS = 20
#: Relative part of the noise by which the law of the levels moves it at least.
_OTHER_LAW = 0.02
#: Deviations from the mean level, in standard deviations, at which pixels are taken.
_PLACES = np.linspace(-5.0, 5.0, 201)
#: Laws of the levels over the pixels, all of deviation 1: normal, evenly spread, and with long tails (Laplace).
_LAWS = [
    np.exp(-0.5 * _PLACES**2),
    (np.abs(_PLACES) <= np.sqrt(3)).astype(np.float64),
    np.exp(-np.sqrt(2) * np.abs(_PLACES)),
]
_LAWS = [law / law.sum() for law in _LAWS]
#: Variance, DN², from which rounding adds less than 1e-4 of it to 1/12.
_NO_TRACE_DN2 = 0.6
#: Sines are made larger by no more than the inverse of this.
_LEAST_FADE = 0.05
#: Rounds in which noise and what rounding makes of it are found from each other.
_ROUNDS = 8
#: Values of σ over τ between which the estimate lies.
_PARTS = np.linspace(0.0, 1.0, 51)


class RoundedNoise(NamedTuple):
    """Noise of a pixel in the dark from frame to frame, with what rows, columns and frames share.

    Parameters
    ----------
    value : DN.
    error : standard error by chance, DN.
    low, high : interval of 95 %, DN, which also holds what the law of the levels over the pixels may be.
    spread : standard deviation of the levels over the pixels, DN.
    """

    value: float
    error: float
    low: float
    high: float
    spread: float


def rounded_noise(series: Long, defects: NDArray[np.bool_]) -> RoundedNoise | None:
    """Noise of a dark series; None where no grey value changes, so that nothing tells it.

    Parameters
    ----------
    series : of dark frames.
    defects : [row, col], pixels to leave out.
    """
    rows = series.mean.shape[0]
    good = ~defects
    middle = float(series.mean[good].mean())
    away = series.mean - middle
    group = np.arange(rows) * _GROUPS // rows
    sums = np.array([
        np.bincount(group, np.where(good, values, 0.0).sum(axis=1), _GROUPS)
        for values in (np.ones(good.shape), away, away**2, series.variance.astype(np.float64))
    ])  # fmt: skip
    number = sums[0].sum()
    parts = sums[1:] / np.maximum(sums[0], 1.0)
    moments = sums[1:].sum(axis=1) / number
    if moments[2] <= 0:
        return None
    # means over the pixels of rows that are apart scatter by chance
    weight = sums[0] / number
    scatter = (parts - moments[:, None]) * weight
    covariance = scatter @ scatter.T * _GROUPS / (_GROUPS - 1)
    whole, deviation = _of_moments(moments, series.frames, middle)
    # steps along the axes of the covariance, as mean and mean square go together
    variances, axes = np.linalg.eigh(covariance)
    changes = [
        _of_moments(moments + axis * np.sqrt(max(size, 0.0)), series.frames, middle)[0][0] - whole[0]
        for size, axis in zip(variances, axes.T, strict=True)
    ]
    error = float(np.linalg.norm(changes))
    value = float(whole[0])
    chance, other = Z_95 * error, _OTHER_LAW * value
    below, above = max(value - min(whole), other), max(max(whole) - value, other)
    low, high = value - float(np.hypot(below, chance)), value + float(np.hypot(above, chance))
    spread = float(np.sqrt(max(deviation**2 - value**2, 0.0)))
    return RoundedNoise(value, error, max(low, 0.0), high, spread)


def without_rounding(dark: Levels, series: Long) -> tuple[Levels, Long]:
    """Dark variances, and the means of a dark series, without what rounding adds beyond 1/12 DN².

    Of noise above 0.4 DN; below, that law does not hold. Where the noise is so large that it adds nothing, both are
    those given.
    """
    part = series.temporal
    whole = part.pixel + sum(max(value, 0.0) for value in (part.row, part.col, part.frame))
    if min(whole, dark.least_variance) > _NO_TRACE_DN2:
        return dark, series
    # the noise of the mean over the frames makes its sines smaller
    fades = max(float(np.exp(-2 * np.pi**2 * whole / series.frames)), _LEAST_FADE)
    noise, mean, places, bend = whole - ADC_VARIANCE_DN2, series.mean, 0j, 0.0
    for _ in range(_ROUNDS):
        bend = float(np.exp(-2 * np.pi**2 * noise))
        mean = series.mean + bend / (np.pi * fades) * np.sin(2 * np.pi * series.mean)
        places = complex(np.mean(np.exp(2j * np.pi * mean))) / fades
        noise = whole - ADC_VARIANCE_DN2 + bend * places.real * (4 * noise + 1 / np.pi**2)
    # of each level, whose places are those of the series moved by its mean
    along = np.real(places * np.exp(2j * np.pi * (dark.mean - series.mean.mean())))
    own, shared = dark.variance - ADC_VARIANCE_DN2, np.maximum(dark.row, 0.0) + np.maximum(dark.col, 0.0)
    less = np.zeros_like(along)
    for _ in range(_ROUNDS):
        less = along * np.exp(-2 * np.pi**2 * (own + shared * (1 + 4 * less)))
        own = dark.variance - ADC_VARIANCE_DN2 + less * (4 * own + 1 / np.pi**2)
    free = replace(dark, variance=own + ADC_VARIANCE_DN2, row=dark.row * (1 + 4 * less), col=dark.col * (1 + 4 * less))
    temporal = replace(part, pixel=part.pixel * (1 + 4 * bend * places.real))
    spatial = spatial_variance(mean, temporal, series.frames, series.variance)
    return free, replace(series, mean=mean, spatial=spatial)


def levels_of(mean: NDArray[np.float64], good: NDArray[np.bool_], spread: float, seed: int = 1) -> NDArray[np.float64]:
    """Levels of pixels in the order of their means, by the normal law that the grey values have, DN from its mean.

    The means themselves gather at whole numbers: of a pixel that has one grey value in all frames, its level between
    two edges is not known, and any order of such pixels is as likely.

    Parameters
    ----------
    mean : [row, col], of a dark series.
    good : [row, col], pixels of that law; the others keep their deviations.
    spread : of the law.
    seed : of the order of pixels with the same mean.
    """
    values = mean[good]
    order = np.lexsort((np.random.default_rng(seed).random(values.size), values))
    place = np.empty(values.size)
    place[order] = (np.arange(values.size) + 0.5) / values.size
    result = mean - values.mean()
    result[good] = spread * special.ndtri(place)
    return result


def _of_moments(moments: NDArray[np.float64], frames: int, middle: float) -> tuple[NDArray[np.float64], float]:
    """σ for each of the laws of the levels, and the deviation of noise and levels together.

    Parameters
    ----------
    moments : means over pixels of their mean, of its square and of the temporal variance.
    frames : of the series.
    middle : that was subtracted from the means, DN.
    """
    mean, square, variance = moments
    # variance of all values: of the means over pixels, and over the frames
    level, deviation = _of_all(mean + middle, square - mean**2 + variance * (1 - 1 / frames))
    sigma, spread = deviation * _PARTS, deviation * np.sqrt(1 - _PARTS**2)
    pairs = zip(spread, np.maximum(sigma, 1e-9), strict=True)
    changes = np.array([grey_moments(level + one * _PLACES, noise)[1] for one, noise in pairs])
    results = [float(np.interp(variance, np.maximum.accumulate(changes @ law), sigma)) for law in _LAWS]
    return np.array(results), deviation


def grey_moments(level: NDArray | float, noise: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and variance of a rounded normal value.

    Parameters
    ----------
    level : before rounding, DN, any shape.
    noise : standard deviation, DN, above 0.
    """
    level = np.asarray(level, np.float64)
    # steps of the ADC about the level; the mean is its number of edges below
    edge = np.floor(level)[..., None] + np.arange(-_REACH, _REACH + 1) + 0.5
    above = special.ndtr((level[..., None] - edge) / noise)
    number = np.arange(-_REACH, _REACH + 1)
    mean = above.sum(axis=-1) - _REACH
    # the sum of (2 k + 1) P(y > k) over k from 0, less that below 0, is the mean square
    square = np.sum((2 * number + 1) * (above - (number < 0)), axis=-1)
    return np.floor(level) + mean, np.asarray(square - mean**2)


#: Steps of the ADC on either side of a level that are summed over.
_REACH = 12


def _of_all(mean: float, variance: float) -> tuple[float, float]:
    """Mean and deviation of normal values that have this mean and variance after rounding."""
    best, least = (mean, np.sqrt(variance)), np.inf

    def away(values: NDArray[np.float64]) -> NDArray[np.float64]:
        moments = grey_moments(values[0], float(np.exp(values[1])))
        return np.array([float(moments[0]) - mean, np.log(max(float(moments[1]), 1e-300) / variance)])

    most = 1.0 + 0.5 * np.log(max(variance, 1.0))
    for shift in (0.0, 0.25, -0.25):
        start = np.array([mean + shift, 0.5 * np.log(max(variance - 1 / 12, 0.02))])
        result = optimize.least_squares(away, start, bounds=([mean - 1, -4.0], [mean + 1, most]))
        if result.cost < least - 1e-9:
            least, best = result.cost, (float(result.x[0]), float(np.exp(result.x[1])))
    return best
