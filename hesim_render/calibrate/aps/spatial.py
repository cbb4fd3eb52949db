"""Spatial variances of the mean of a long series: rows, columns and pixels, and their maps without temporal noise."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, uniform_filter

from hesim_render.calibrate.aps.noise_spectrum import NoiseSpectrum
from hesim_render.calibrate.moments import FrameMoments

#: Deviation, in standard deviations, from which a pixel is an individual and no part of the spread of the others.
_INDIVIDUAL = 5.0
#: Box that separates shading from pixels, px.
_BOX = 15
#: Number of robust standard deviations from which a pixel is an outlier.
_OUTLYING = 8.0
#: The light's shading varies over more than this part of the picture; finer structure is the sensor's.
_SHADING_PART = 1 / 24
#: Chance that the noise of a profile makes a peak in its spectrum that counts as a pattern.
_PEAK_CHANCE = 0.01


@dataclass(frozen=True)
class Temporal:
    """Temporal variances of single frames of a series, DN².

    Attributes
    ----------
    pixel : of pixels, without what rows, columns and frames share; the ADC's 1/12 is in it.
    row, col : of what rows and columns get anew in each frame.
    frame : of what whole frames get.
    row_error, col_error : standard errors.
    """

    pixel: float
    row: float
    col: float
    frame: float
    row_error: float
    col_error: float


@dataclass(frozen=True)
class SpatialVariance:
    """Spatial variances of the mean of a series, DN²; unbiased, so that noise may make them negative.

    Attributes
    ----------
    row, col, pixel : parts; their sum is `total`.
    noise : temporal variance of the mean that each part had: row, column, pixel.
    freedom : degrees of freedom of each part.
    scatter : variance of `pixel` times its degrees of freedom, of noise alone; of pixels whose noise is not alike, as
        that of hot ones. None where it is that of pixels which are alike.
    """

    row: float
    col: float
    pixel: float
    noise: tuple[float, float, float]
    freedom: tuple[int, int, int]
    scatter: float | None = None

    @property
    def total(self) -> float:
        return self.row + self.col + self.pixel

    @property
    def parts(self) -> tuple[float, float, float]:
        return self.row, self.col, self.pixel

    def errors(self, fixed: bool) -> NDArray[np.float64]:
        """Standard errors of row, col, pixel and total, DN².

        Parameters
        ----------
        fixed : of this very device, whose pattern is a given one and only noise differs; otherwise of the law that
            the pattern was drawn from, with the scatter of the draw.
        """
        values = np.maximum(self.parts, 0.0)
        values[0] += values[2] / (self.freedom[1] + 1)  # what the pixels of a row add to its mean
        values[1] += values[2] / (self.freedom[0] + 1)
        noise, freedom = np.array(self.noise), np.array(self.freedom)
        scatter = (4 * values * noise + 2 * noise**2) if fixed else 2 * (values + noise) ** 2
        if fixed and self.scatter is not None:
            scatter[2] = self.scatter
        each = np.sqrt(scatter / freedom)
        return np.append(each, np.sqrt(np.sum(each**2)))


def temporal_of(moments: FrameMoments) -> tuple[Temporal, NDArray[np.float64]]:
    """Temporal variances of a series, and the mean of each frame, DN."""
    _, rows, cols = moments.variance.shape
    frames = moments.frames
    whole = float(moments.variance[0].mean(dtype=np.float64))
    levels = moments.row_means[0].mean(axis=1)
    level = float(levels.var(ddof=1))

    def of(means: NDArray) -> tuple[float, float]:
        """Variance of the changes of rows or columns, without those of the whole frame, and its standard error."""
        change = means - means.mean(axis=0)
        change = change - change.mean(axis=1)[:, None]
        freedom = (frames - 1) * (means.shape[1] - 1)
        value = float(np.sum(change**2)) / freedom
        return value, value * float(np.sqrt(2 / freedom))

    (of_rows, row_error), (of_cols, col_error) = of(moments.row_means[0]), of(moments.col_means[0])
    # with R, C and F of rows, columns and frames: of_rows = R + σ²/cols, of_cols = C + σ²/rows, a pixel's own variance
    # is σ² + R + C + F, and that of the levels F + R/rows + C/cols + σ²/(rows cols)
    pixel = (whole - level) / ((1 - 1 / rows) * (1 - 1 / cols)) - of_rows / (1 - 1 / cols) - of_cols / (1 - 1 / rows)
    frame = level - of_rows / rows - of_cols / cols + pixel / (rows * cols)
    return Temporal(pixel, of_rows - pixel / cols, of_cols - pixel / rows, frame, row_error, col_error), levels


def spatial_variance(
    mean: NDArray, temporal: Temporal, frames: int, variance: NDArray | None = None
) -> SpatialVariance:
    """Row, column and pixel variance of a mean image; with the temporal variance of each pixel, errors that follow it.

    EMVA 1288 R4.0 solves the three equations of the variances of row means, of column means and of all pixels; this is
    the same with degrees of freedom in place of numbers, and with what rows and columns share from frame to frame.
    """
    rows, cols = mean.shape
    # row means, column means, and the rest, in which neither has a part
    by_row, by_col = mean.mean(axis=1), mean.mean(axis=0)
    rest = mean - by_row[:, None] - by_col + mean.mean()
    freedom = (rows - 1, cols - 1, (rows - 1) * (cols - 1))
    pixel = float(np.sum(rest**2)) / freedom[2]
    noise_pixel = temporal.pixel / frames
    noise = (noise_pixel / cols + temporal.row / frames, noise_pixel / rows + temporal.col / frames, noise_pixel)
    # row means contain the mean of their pixels, of the pattern and of noise
    row = float(by_row.var(ddof=1)) - max(pixel - noise_pixel, 0.0) / cols - noise[0]
    col = float(by_col.var(ddof=1)) - max(pixel - noise_pixel, 0.0) / rows - noise[1]
    scatter = None
    if variance is not None:
        own = variance.astype(np.float64)
        own += temporal.pixel - own.mean()  # without what rows, columns and frames share
        own /= frames
        # of a pixel's square with the pattern's p² and noise u: 4 p² u + 2 u²; that of u itself is taken off
        alone = 2 * float(np.mean(own**2)) * (frames - 1) / (frames + 1)
        scatter = max(4 * float(np.mean((rest**2 - own) * own)), 0.0) + alone
    return SpatialVariance(row, col, pixel - noise_pixel, noise, freedom, scatter)


@dataclass(frozen=True)
class Pattern:
    """A fixed pattern without the noise of its estimate.

    Attributes
    ----------
    row, col : profiles, mean 0.
    pixel : [row, col], the rest.
    """

    row: NDArray[np.float64]
    col: NDArray[np.float64]
    pixel: NDArray[np.float64]

    @property
    def whole(self) -> NDArray[np.float64]:
        return self.row[:, None] + self.col + self.pixel

    def shading(self) -> NDArray[np.float64]:
        """The part that varies slowly over the picture."""
        width = max(self.pixel.shape) * _SHADING_PART
        return np.asarray(gaussian_filter(self.whole, width, mode="nearest"))


def pattern_of(
    image: NDArray,
    noise: tuple[float, float, float],
    spectrum: NoiseSpectrum | None = None,
    frames: int = 1,
    expected: bool = False,
) -> Pattern:
    """The pattern of a mean image.

    The spread that the noise of the estimate adds is taken off by scaling, so that the pattern's variance is unbiased.
    Pixels and spatial frequencies that stand out of the noise keep their values: they are known.

    Parameters
    ----------
    image : [row, col], a mean over frames.
    noise : variance of the noise of row means, column means and pixels.
    spectrum : of the temporal noise; at the frequency of an interference, the mean has more noise.
    frames : frames of the mean.
    expected : the pattern that is expected, whose errors are smallest and whose variance is smaller than the pattern's.
    """
    power_law = 1.0 if expected else 0.5
    level, individual = _individuals(image)
    by_row, by_col = (image - individual).mean(axis=1) - level, (image - individual).mean(axis=0) - level
    plain = image - individual - level - by_row[:, None] - by_col
    waves = _waves(plain, noise[2], spectrum, frames, power_law)
    smooth = uniform_filter(plain - waves, _BOX, mode="nearest")
    part = 1 / _BOX**2
    # what is left of the noise when a box mean was taken out
    fine = _scaled(plain - waves - smooth, noise[2] * (1 - part), power_law)
    fine += individual * _true_part(individual**2, noise[2]) ** power_law - individual.mean()
    power = float(np.mean(smooth**2))
    smooth *= _true_part(power, noise[2] * part) ** power_law
    profiles = _profile(by_row, noise[0], power_law), _profile(by_col, noise[1], power_law)
    return Pattern(*profiles, waves + smooth + fine)


def _individuals(image: NDArray) -> tuple[float, NDArray[np.float64]]:
    """Mean of an image without the pixels that stand out, and how far these do; 0 elsewhere.

    Such pixels would ring in a transform, and be in the means of their rows and columns, where they are not at home.
    """
    own, spread = _without_profiles(image)
    own[np.abs(own) <= _INDIVIDUAL * spread] = 0.0
    return float((image - own).mean()), own


def _without_profiles(image: NDArray) -> tuple[NDArray[np.float64], float]:
    """An image less the means of its rows and columns, to which pixels that stand out do not add, and its spread."""
    rest = image - np.median(image, axis=1)[:, None]
    rest -= np.median(rest, axis=0)
    for _ in range(3):
        spread = 1.4826 * float(np.median(np.abs(rest)))
        good = np.abs(rest) <= _INDIVIDUAL * spread
        rest = rest - _mean_of(rest, good, 1)[:, None]
        rest -= _mean_of(rest, good, 0)
    return rest, spread


def _mean_of(values: NDArray, good: NDArray[np.bool_], axis: int) -> NDArray[np.float64]:
    """Means of the good pixels along an axis; 0 where none is good."""
    return np.asarray(np.sum(np.where(good, values, 0.0), axis=axis) / np.maximum(good.sum(axis=axis), 1))


def _true_part(power: NDArray | float, noise: NDArray | float) -> NDArray[np.float64]:
    """Part of a power that is not noise."""
    return np.asarray(np.maximum(0.0, power - noise) / np.maximum(power, 1e-300))


def _waves(
    values: NDArray, noise: float, temporal: NoiseSpectrum | None, frames: int, law: float = 0.5
) -> NDArray[np.float64]:
    """The frequencies of an image that stand out of its white part and of interference: shading, periodic patterns."""
    spectrum = np.fft.rfft2(values)
    power = np.abs(spectrum) ** 2 / values.size
    noises = np.full(power.shape, noise)
    rows, cols = values.shape
    for line in [] if temporal is None else temporal.lines:
        row, col = round(line.cycles_per_row * rows), round(line.cycles_per_col * cols)
        # a real image has each frequency twice, but for those of half a period
        noises[[row % rows, -row % rows], [col, col if 2 * col == cols else 0]] += line.power(values.shape) / frames
    # the median of an exponential law is ln 2 of its mean
    white = np.maximum(noises, max(float(np.median(power)) / np.log(2.0), 1e-300))
    # the power of white noise is exponential: a share `_PEAK_CHANCE` of images has one above this
    peak = power > white * np.log(power.size / _PEAK_CHANCE)
    own = _true_part(power, noises) ** law
    return np.asarray(np.fft.irfft2(np.where(peak, spectrum * own, 0.0), values.shape))


def _scaled(values: NDArray, noise: float, law: float = 0.5) -> NDArray[np.float64]:
    """Pixels scaled to the variance that they have without noise; individuals lose only what noise adds on average."""
    power = values**2
    spread = 1.4826 * float(np.median(np.abs(values)))
    alone = power > (_INDIVIDUAL * max(spread, float(np.sqrt(noise)))) ** 2
    common = float(power[~alone].mean()) if not alone.all() else 0.0
    return values * np.where(alone, _true_part(power, noise), _true_part(common, noise)) ** law


def _profile(values: NDArray, noise: float, law: float = 0.5) -> NDArray[np.float64]:
    """A profile, scaled frequency by frequency; frequencies that stand out keep their power less that of the noise."""
    spectrum = np.fft.rfft(values)
    power = np.abs(spectrum) ** 2 / values.size
    peak = power > max(noise, 1e-300) * np.log(power.size / _PEAK_CHANCE)
    common = float(power[~peak].mean()) if not peak.all() else 0.0
    part = np.where(peak, _true_part(power, noise), _true_part(common, noise))
    return np.asarray(np.fft.irfft(spectrum * part**law, values.size))


def outliers(image: NDArray, noise: tuple[float, float, float]) -> NDArray[np.bool_]:
    """Pixels [row, col] that lie so many robust standard deviations from the pixels around them."""
    rest, spread = _without_profiles(image)
    spread = max(spread, float(np.sqrt(max(noise[2], 0.0))), 1e-12)
    rest -= uniform_filter(np.clip(rest, -_INDIVIDUAL * spread, _INDIVIDUAL * spread), _BOX, mode="nearest")
    return np.abs(rest) > _OUTLYING * spread
