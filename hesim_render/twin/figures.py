"""Figures of a set of EMVA 1288 captures that a twin is compared by: defects and spectra of the long series."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from hesim_render.calibrate.aps.long_series import Long
from hesim_render.calibrate.aps.noise_spectrum import NoiseSpectrum
from hesim_render.calibrate.aps.spatial import spatial_variance

#: Bands of spatial frequency, of equal numbers of frequencies.
_BANDS = 20
#: Bins of the histogram of deviations up to so many median deviations, bins above, and the fewest pixels of one.
_BINS, _COMMON, _MORE_BINS, _FEWEST = 18, 7.0, 8, 16
#: Box that separates shading from pixels, px.
_BOX = 15


@dataclass(frozen=True)
class SpatialSpectrum:
    """Power of the mean image in bands of frequency, rows or columns.

    Attributes
    ----------
    cycles : middle of each band, periods per pixel.
    power : mean power of a value, DN² (relative in the light).
    error : its standard error for this very device: of the noise of the mean.
    """

    cycles: NDArray[np.float64]
    power: NDArray[np.float64]
    error: NDArray[np.float64]


def spectrum(image: NDArray, noise_pixel: float, noise_shared: float, axis: int) -> SpatialSpectrum:
    """Spectrum along rows (axis 1) or columns (axis 0) of a mean image, as EMVA 1288 takes it.

    Each line is transformed, and the mean of their powers is taken.

    Parameters
    ----------
    image : [row, col], a mean over frames.
    noise_pixel : temporal variance of the mean of a pixel.
    noise_shared : variance of what all lines share: columns in a spectrum along rows, rows in one along columns.
    axis : direction of the transform.
    """
    lines = image if axis == 1 else image.T
    count, size = lines.shape
    transform = np.fft.rfft(lines - lines.mean(axis=1, keepdims=True), axis=1)[:, 1:]
    power = np.mean(np.abs(transform) ** 2, axis=0) / size
    groups = np.array_split(np.arange(power.size), min(_BANDS, power.size))
    banded = np.array([power[group].mean() for group in groups])
    noise = noise_pixel + noise_shared
    pattern = np.maximum(banded - noise, 0.0)
    # noise that lines share beats with what their patterns share, and not with what is a line's own
    mean = np.abs(transform.mean(axis=0)) ** 2 / size
    common = np.array([mean[group].mean() for group in groups]) - noise_pixel / count - noise_shared
    common = np.maximum(common, 0.0)
    number = np.array([float(group.size) for group in groups])
    if size % 2 == 0:  # half a period a pixel has a real amplitude, and its power twice the variance
        number[-1] **= 2
        number[-1] /= groups[-1].size + 1
    own = (2 * pattern * noise_pixel + noise_pixel**2) / (count * number)
    shared = (2 * common * noise_shared + noise_shared**2 + 2 * noise_pixel * noise_shared / count) / number
    cycles = np.array([(group.mean() + 1) / size for group in groups])
    return SpatialSpectrum(cycles, banded, np.sqrt(own + shared))


def spectra(series: Long, scale: float) -> dict[str, SpatialSpectrum]:
    """Both spectra of a long series.

    Parameters
    ----------
    series : the series.
    scale : divides the image: 1 in the dark, the signal in the light.
    """
    row, col, pixel = (noise / scale**2 for noise in series.spatial.noise)
    rows, cols = series.mean.shape
    image = series.mean / scale
    return {
        "rows": spectrum(image, pixel, max(col - pixel / rows, 0.0), 1),
        "columns": spectrum(image, pixel, max(row - pixel / cols, 0.0), 0),
    }


def without_lines(series: Long, temporal: NoiseSpectrum) -> Long:
    """The series without the frequencies of interference.

    Frames of any phase add up to a pattern that scatters by its own size, which tells nothing about a twin.
    """
    rows, cols = series.mean.shape
    transform = np.fft.rfft2(series.mean)
    for line in temporal.lines:
        row, col = round(line.cycles_per_row * rows), round(line.cycles_per_col * cols)
        transform[row % rows, col] = 0
        if 2 * col == cols:
            transform[-row % rows, col] = 0
    mean = np.fft.irfft2(transform, series.mean.shape)
    pixel = series.temporal.pixel - sum(line.rms_dn**2 for line in temporal.lines)
    changes = replace(series.temporal, pixel=pixel)
    spatial = spatial_variance(mean, changes, series.frames, series.variance)
    return replace(series, mean=mean, temporal=changes, spatial=spatial)


def without_defects(series: Long, defects: NDArray[np.bool_]) -> Long:
    """The series with the means of row and column in place of defects.

    A hot pixel adds to all frequencies alike, and so does its noise: no error of a band would tell it from a pattern.
    The histogram of deviations has these pixels.
    """
    good = ~defects
    if not defects.any() or not good.any():
        return series
    level = float(series.mean[good].mean())
    profiles = []
    for axis in (1, 0):
        count = good.sum(axis=axis)
        total = np.sum(np.where(good, series.mean - level, 0.0), axis=axis)
        profiles.append(total / np.maximum(count, 1))
    plain = level + profiles[0][:, None] + profiles[1]
    mean = np.where(good, series.mean, plain)
    usual = float(series.variance[good].mean(dtype=np.float64))
    less = float(series.variance.mean(dtype=np.float64)) - usual
    temporal = replace(series.temporal, pixel=series.temporal.pixel - less)
    variance = np.where(good, series.variance, np.float32(usual))
    spatial = spatial_variance(mean, temporal, series.frames, variance)
    return replace(series, mean=mean, variance=variance, temporal=temporal, spatial=spatial)


def deviations(image: NDArray) -> NDArray[np.float64]:
    """Absolute deviation of each pixel of a mean image from its surroundings, rows and columns taken out."""
    rest = image - image.mean(axis=1, keepdims=True) - image.mean(axis=0) + image.mean()
    spread = 1.4826 * float(np.median(np.abs(rest)))
    return np.abs(rest - uniform_filter(np.clip(rest, -5 * spread, 5 * spread), _BOX, mode="nearest"))


def bin_edges(*images: NDArray) -> NDArray[np.float64]:
    """Edges of a histogram of deviations: each bin with some pixels of all images together, the last one open.

    Bins are of equal width up to some median deviations, and grow from there on: hot pixels are a hundred times as far.
    """
    everything = np.concatenate([image.ravel() for image in images])
    most = float(everything.max())
    common = min(_COMMON * float(np.median(everything)), most)
    edges = list(np.linspace(0.0, common, _BINS + 1))
    if 0 < common < most:
        edges += list(np.geomspace(common, most, _MORE_BINS + 1)[1:])
    counts = np.histogram(everything, edges)[0]
    while len(counts) > 1 and counts.min() < 2 * _FEWEST:
        thin = int(np.argmin(counts))
        edges.pop(thin if thin == len(counts) - 1 else thin + 1)
        counts = np.histogram(everything, edges)[0]
    return np.array([*edges[:-1], np.inf])


def counts_in(image: NDArray, edges: NDArray) -> NDArray[np.float64]:
    """Pixels in each bin."""
    return np.histogram(image, edges)[0].astype(np.float64)
