"""Spectrum of the temporal noise of dark frames: interference, and the correlation of neighbours in a row.

Interference is a periodic pattern of a read-out that stands still in a frame and has a new phase in the next one.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import digamma
from scipy.stats import gamma, norm

from hesim_render.calibrate.estimate import ALARM
from hesim_render.calibrate.moments import Frames

#: Most lines that a sensor file keeps, the strongest ones.
_MOST_LINES = 8
#: Cosines of the floor along an axis: one for so many pixels, and so many at most. Fewer do not follow a filter of the
#: read-out; more follow the noise of the spectrum itself.
_PIXELS_A_COSINE, _MOST_COSINES = 16, 8
#: Fits of the floor, each without the lines of the one before.
_ROUNDS = 3


@dataclass(frozen=True)
class InterferenceLine:
    """One sine over the picture.

    Attributes
    ----------
    cycles_per_row, cycles_per_col : periods per pixel, from row to row (−0.5 to 0.5) and from column to column (0 to
        0.5).
    rms_dn : its standard deviation over frames and pixels, DN.
    """

    cycles_per_row: float
    cycles_per_col: float
    rms_dn: float

    def power(self, shape: tuple[int, int]) -> float:
        """Power of the line at its frequency in the transform of a frame over its pixels, DN²."""
        parts = 1 if abs(self.cycles_per_row) in (0, 0.5) and abs(self.cycles_per_col) in (0, 0.5) else 2
        return self.rms_dn**2 * shape[0] * shape[1] / parts


@dataclass(frozen=True)
class NoiseSpectrum:
    """What the temporal noise of a series is beyond white noise, rows and columns.

    Attributes
    ----------
    lines : interference, the strongest lines.
    correlation : of a pixel's noise with that of the next one in its row, lines left out.
    correlation_error : its standard error.
    """

    lines: list[InterferenceLine]
    correlation: float
    correlation_error: float

    @property
    def correlated(self) -> bool:
        """Whether neighbours are correlated, with a chance of `ALARM` where they are not."""
        return bool(abs(self.correlation) > norm.isf(ALARM / 2) * self.correlation_error)


def noise_spectrum(stack: Frames, mean: NDArray) -> NoiseSpectrum:
    """Spectrum of the frames of a series about their mean.

    The power of normal noise, averaged over n frames, has a gamma law of shape n about a floor, which filters of the
    read-out bend. A frequency is a line if its power has a chance of `ALARM` for the whole spectrum. Changes that rows
    or columns share are no lines.

    Parameters
    ----------
    stack : the frames, read once more.
    mean : [row, col], their mean.
    """
    _, frames, rows, cols = stack.shape
    power = np.zeros((rows, cols // 2 + 1))
    for frame in stack:
        power += np.abs(np.fft.rfft2(frame - mean)) ** 2
    power /= (frames - 1) * rows * cols
    inside = power[1:, 1:]
    highest = float(gamma.isf(ALARM / inside.size, frames - 1)) / (frames - 1)
    floor = _floor(inside, (rows, cols), frames - 1, highest)
    limit = floor * highest
    result = []
    for row, col in np.argwhere(inside > limit) + 1:
        mirrored = rows - row
        edge = 2 * col == cols
        if edge and mirrored < row:
            continue
        parts = 1 if edge and mirrored == row else 2
        variance = parts * float(power[row, col] - floor[row - 1, col - 1]) / (rows * cols)
        cycles = row / rows - (1 if 2 * row > rows else 0)
        result.append(InterferenceLine(float(cycles), float(col / cols), float(np.sqrt(variance))))
    lines = sorted(result, key=lambda line: -line.rms_dn)[:_MOST_LINES]
    # the transform of the power is the correlation; all but the last frequency of an even size stands for two
    weight = np.where(inside > limit, 0.0, 2.0)
    if cols % 2 == 0:
        weight[:, -1] /= 2
    turn = np.cos(2 * np.pi * np.arange(1, cols // 2 + 1) / cols)
    # without the frequency 0, which rows share, white noise would have -1/(cols - 1)
    correlation = float(np.sum(weight * inside * turn) / np.sum(weight * inside)) + 1 / (cols - 1)
    return NoiseSpectrum(lines, correlation, 1 / float(np.sqrt((frames - 1) * rows * cols)))


def _floor(inside: NDArray, shape: tuple[int, int], frames: int, highest: float) -> NDArray[np.float64]:
    """Power without lines: the logarithm is a short series of cosines, as that of noise behind a short filter is.

    Parameters
    ----------
    inside : [row, col], mean power of `frames` frames; without the frequencies 0.
    shape : rows and columns of the frames.
    frames : number of independent frames.
    highest : largest power over the floor that is no line.
    """
    series = []
    for size, count in zip(shape, inside.shape, strict=True):
        order = np.arange(min(size // _PIXELS_A_COSINE, _MOST_COSINES) + 1)
        angle = 2 * np.pi / size * np.arange(1, count + 1)[:, None] * order
        # a picture is real: its spectrum is even in both frequencies together, not in each
        series.append((np.cos(angle), np.sin(angle[:, 1:])))
    # the mean of the logarithm of a gamma law of mean 1 is taken off; rounded frames may lack a frequency
    given = np.log(np.maximum(inside, max(1e-12 * float(inside.mean()), 1e-300))) - (digamma(frames) - np.log(frames))
    logarithm = given
    for _ in range(_ROUNDS):
        fit = np.zeros(inside.shape)
        for down, across in zip(*series, strict=True):
            fit += down @ (np.linalg.pinv(down) @ logarithm @ np.linalg.pinv(across).T) @ across.T
        logarithm = np.where(inside > highest * np.exp(fit), fit, given)
    return np.exp(fit)
