"""Figures of a set of EMVA 1288 captures that a twin is compared by: defects and spectra of the long series."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from hesim_render.calibrate.aps.long_series import Long
from hesim_render.calibrate.aps.noise_spectrum import NoiseSpectrum

#: Bands of spatial frequency, of equal numbers of frequencies.
_BANDS = 20
#: Bins of the histogram of deviations, and the fewest pixels of one.
_BINS, _FEWEST = 24, 16
#: Box that separates shading from pixels, px.
_BOX = 15


@dataclass(frozen=True)
class Spectrum:
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


def spectrum(
    image: NDArray, noise_pixel: float, noise_shared: float, axis: int, sines: Sequence[tuple[float, float]] = ()
) -> Spectrum:
    """Spectrum along rows (axis 1) or columns (axis 0) of a mean image, as EMVA 1288 takes it.

    Each line is transformed, and the mean of their powers is taken.

    Parameters
    ----------
    image : [row, col], a mean over frames.
    noise_pixel : temporal variance of the mean of a pixel.
    noise_shared : variance of what all lines share: columns in a spectrum along rows, rows in one along columns.
    axis : direction of the transform.
    sines : interference: cycles per pixel in this direction, and the power that it is expected to have in the mean.
    """
    lines = image if axis == 1 else image.T
    count, size = lines.shape
    transform = np.fft.rfft(lines - lines.mean(axis=1, keepdims=True), axis=1)[:, 1:]
    power = np.mean(np.abs(transform) ** 2, axis=0) / size
    groups = np.array_split(np.arange(power.size), min(_BANDS, power.size))
    banded = np.array([power[group].mean() for group in groups])
    noise = noise_pixel + noise_shared
    pattern = np.maximum(banded - noise, 0.0)
    number = np.array([group.size for group in groups])
    own = (2 * pattern * noise_pixel + noise_pixel**2) / (count * number)
    shared = (2 * pattern * noise_shared + noise_shared**2 + 2 * noise_pixel * noise_shared / count) / number
    for frequency, expected in sines:
        # frames of any phase add up to an exponential law, or a squared normal one at half a period a pixel
        band = next(
            k for k, group in enumerate(groups) if group[-1] + 1 >= round(frequency * size) > 0 or k == number.size - 1
        )
        shared[band] += ((2 if frequency == 0.5 else 1) * expected**2 + 2 * expected * noise) / number[band] ** 2
    cycles = np.array([(group.mean() + 1) / size for group in groups])
    return Spectrum(cycles, banded, np.sqrt(own + shared))


def spectra(series: Long, scale: float, temporal: NoiseSpectrum) -> dict[str, Spectrum]:
    """Both spectra of a long series.

    Parameters
    ----------
    series : the series.
    scale : divides the image: 1 in the dark, the signal in the light.
    temporal : spectrum of the temporal noise, whose lines have another phase in each frame.
    """
    row, col, pixel = (noise / scale**2 for noise in series.spatial.noise)
    rows, cols = series.mean.shape
    image = series.mean / scale

    def lines(name: str, size: int) -> list[tuple[float, float]]:
        found = [(abs(getattr(line, name)), line.rms_dn**2 / scale**2 / series.frames) for line in temporal.lines]
        return [(cycles, variance * size / (1 if cycles == 0.5 else 2)) for cycles, variance in found if cycles > 0]

    return {
        "rows": spectrum(image, pixel, max(col - pixel / rows, 0.0), 1, lines("cycles_per_col", cols)),
        "columns": spectrum(image, pixel, max(row - pixel / cols, 0.0), 0, lines("cycles_per_row", rows)),
    }


def deviations(image: NDArray) -> NDArray[np.float64]:
    """Absolute deviation of each pixel of a mean image from its surroundings, rows and columns taken out."""
    rest = image - image.mean(axis=1, keepdims=True) - image.mean(axis=0) + image.mean()
    spread = 1.4826 * float(np.median(np.abs(rest)))
    return np.abs(rest - uniform_filter(np.clip(rest, -5 * spread, 5 * spread), _BOX, mode="nearest"))


def bin_edges(*images: NDArray) -> NDArray[np.float64]:
    """Edges of a histogram of deviations: each bin with some pixels of all images together, the last one open."""
    everything = np.concatenate([image.ravel() for image in images])
    edges = list(np.linspace(0.0, float(everything.max()), _BINS + 1))
    counts = np.histogram(everything, edges)[0]
    while len(counts) > 1 and counts.min() < 2 * _FEWEST:
        thin = int(np.argmin(counts))
        edges.pop(thin if thin == len(counts) - 1 else thin + 1)
        counts = np.histogram(everything, edges)[0]
    return np.array([*edges[:-1], np.inf])


def counts_in(image: NDArray, edges: NDArray) -> NDArray[np.float64]:
    """Pixels in each bin."""
    return np.histogram(image, edges)[0].astype(np.float64)
