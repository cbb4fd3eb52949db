"""Mean and temporal variance of each light and exposure of an EMVA 1288 set, from the difference of its two frames."""

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.moments import Progress
from hesim_render.recording.pair_set import PairSet, Series

#: Parts of the pixels between whose grey values all are expected to occur, and their distance in standard deviations.
_CENTRAL, _CENTRAL_SIGMAS = (0.067, 0.933), 3.0
#: Fewest pixels that a grey value is expected to have before its absence tells something.
_EXPECTED = 50.0
#: Share of absent grey values from which frames were scaled after the ADC.
_GAPS = 0.1
#: Part of the pixels at an end of the ADC's range from which a variance is not that of the light.
CLIPPED_SHARE = 1e-4
#: Part of the pixels at full scale up to which saturated levels are those of a full well and not of the ADC.
WELL_SHARE = 0.01
#: Change of the light between frames of one series that is refused.
MOST_CHANGE = 0.02
#: Relative differences of the places of a tile from which they are colours.
_MOSAIC = 0.08
_SIGMAS = 6.0


@dataclass(frozen=True)
class Levels:
    """Statistics of pairs, one entry a series.

    Attributes
    ----------
    exposure_s, photons : of the series; photons are 0 in the dark and NaN where they are not stated.
    mean : mean of both frames, DN.
    change : mean of the first less that of the second frame, DN.
    variance : temporal variance of a pixel, DN²: half the mean squared difference, less what the frames, rows and
        columns share; the ADC's 1/12 is in it.
    error : its standard error, from its scatter over rows.
    row, col : variance of what rows and columns get anew in each frame, DN²; unbiased, hence possibly negative.
    row_error, col_error : their standard errors.
    squares : mean over pixels of the squared variance of one pixel, DN⁴.
    low, high : part of the pixels at 0 and at full scale; of `both_levels` without those that are stuck there.
    missing : grey values that no frame has, though many pixels of one have those on both sides.
    """

    exposure_s: NDArray[np.float64]
    photons: NDArray[np.float64]
    mean: NDArray[np.float64]
    change: NDArray[np.float64]
    variance: NDArray[np.float64]
    error: NDArray[np.float64]
    row: NDArray[np.float64]
    row_error: NDArray[np.float64]
    col: NDArray[np.float64]
    col_error: NDArray[np.float64]
    squares: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    missing: tuple[int, ...] = ()

    @property
    def clear(self) -> NDArray[np.bool_]:
        """Series clear of both ends of the ADC's range."""
        return (self.low <= CLIPPED_SHARE) & (self.high <= CLIPPED_SHARE)

    @property
    def least_variance(self) -> float:
        """Least variance as measured, DN²: noise that rows and columns share moves values over edges as well."""
        return float(np.min(self.variance + np.maximum(self.row, 0.0) + np.maximum(self.col, 0.0)))


def pair_levels(pairs: PairSet, series: tuple[Series, ...], progress: Progress | None = None) -> Levels:
    """Read pairs, two at a time: decoding takes most of the time and releases Python's lock.

    Raises
    ------
    SpecError
        With file and line: if the two frames are one and the same, their light differs, or grey values are missing.
    """
    full = pairs.spec.full_scale_dn
    different = list(dict.fromkeys(series))

    def one(entry: Series) -> tuple[tuple[float, ...], slice | None, set[int], NDArray[np.bool_]]:
        first, second = pairs.frames(entry)
        result = pair_statistics(first, second, full)
        _check(entry, result, first, second, full)
        low, absent, _ = _absent(first, full)
        present = np.bincount(first.ravel(), minlength=full + 1) > 0
        return result, _hole(first, full), set((low + np.flatnonzero(absent)).tolist()), present

    seen = np.zeros(full + 1, np.bool_)
    missing: set[int] = set()
    with ThreadPoolExecutor(2) as two:
        results, holes = [], []
        for number, (measured, hole, lacking, present) in enumerate(two.map(one, different)):
            results.append(measured)
            holes.append(hole)
            missing |= lacking
            seen |= present
            if progress is not None:
                progress("reading pairs", (number + 1) / len(different))
    for entry, hole in zip(different, holes, strict=True):
        if hole is not None and not seen[hole].any():
            raise entry.error(
                f"grey values {hole.start} to {hole.stop - 1} occur in none of the frames, those on both sides do: the "
                "frames were changed after the ADC; capture RAW frames"
            )
    result = dict(zip(different, results, strict=True))
    photons = [0.0 if not s.lit else np.nan if s.photons is None else s.photons for s in series]
    outcome = levels([s.exposure_s for s in series], photons, [result[s] for s in series])
    return replace(outcome, missing=tuple(sorted(k for k in missing if not seen[k])))


def both_levels(pairs: PairSet, progress: Progress | None = None) -> tuple[Levels, Levels]:
    """The lit and the dark pairs of a set.

    Pixels that are at full scale in the dark of the same exposure, or at 0 in every light, are defects: neither has to
    do with the light or with the black level.
    """
    return without_stuck(pair_levels(pairs, pairs.lit, progress), pair_levels(pairs, pairs.dark, progress))


def without_stuck(lit: Levels, dark: Levels) -> tuple[Levels, Levels]:
    """Lit and dark levels whose pixels at the ends of the range are those that light or noise brings there."""
    dead = lit.low.min()
    return (
        replace(lit, low=lit.low - dead, high=np.maximum(lit.high - dark.high, 0.0)),
        replace(dark, low=np.maximum(dark.low - dead, 0.0)),
    )


def levels(exposure_s: Iterable[float], photons: Iterable[float], statistics: list[tuple[float, ...]]) -> Levels:
    """`pair_statistics` of several pairs as one table."""
    table = np.array(statistics, np.float64).T
    return Levels(np.array(list(exposure_s)), np.array(list(photons)), *table)


def pair_statistics(first: NDArray, second: NDArray, full_scale_dn: int) -> tuple[float, ...]:
    """The statistics of `Levels` of one pair, from `mean` on.

    The difference of the frames is free of every fixed pattern. Its variance is twice that of a frame [emva2021]. Row
    means and column means of the difference have what rows and columns share; the pixels' part is that of the
    residuals.
    """
    rows, cols = first.shape
    difference = first.astype(np.float32) - second
    mean = float(first.mean(dtype=np.float64) + second.mean(dtype=np.float64)) / 2
    change = float(difference.mean(dtype=np.float64))
    by_row = difference.mean(axis=1, dtype=np.float64) - change
    by_col = difference.mean(axis=0, dtype=np.float64) - change
    difference -= (by_row + change)[:, None].astype(np.float32)
    difference -= by_col.astype(np.float32)
    np.multiply(difference, difference, out=difference)
    # the residuals have (rows − 1)(cols − 1) degrees of freedom
    freedom = (1 - 1 / rows) * (1 - 1 / cols)
    per_row = difference.mean(axis=1, dtype=np.float64) / (2 * freedom)
    variance = float(per_row.mean())
    squares = float(np.mean(difference.astype(np.float64) ** 2)) / (2 * freedom) ** 2
    shared = []
    for means, across in ((by_row, cols), (by_col, rows)):
        whole = float(np.sum(means**2)) / (2 * (means.size - 1))
        shared += [whole - variance / across, whole * np.sqrt(2 / (means.size - 1))]
    ends = [float(np.mean((first == end) | (second == end))) for end in (0, full_scale_dn)]
    return mean, change, variance, float(per_row.std(ddof=1)) / np.sqrt(rows), *shared, squares, *ends


def _check(entry: Series, statistics: tuple[float, ...], first: NDArray, second: NDArray, full: int) -> None:
    mean, change, variance = statistics[:3]
    low, high = statistics[-2:]
    if max(low, high) > 0.5:
        return
    if variance == 0 and first.min() == first.max():
        return  # at the full well
    if np.array_equal(first, second):
        raise entry.error("both frames are the same; a pair has two exposures")
    noise = np.sqrt(2 * variance / first.size + 2 * max(statistics[4], 0.0) / first.shape[0])
    if entry.lit and abs(change) > MOST_CHANGE * mean and abs(change) > _SIGMAS * noise:
        raise entry.error(
            f"the light drifts: the second frame is {100 * abs(change) / mean:.2g} % "
            f"{'darker' if change > 0 else 'brighter'} than the first; warm the light up and keep it steady"
        )
    absent, expected = _gaps(first, second, full)
    if expected >= 4 and absent > _GAPS * expected:
        require_one_colour(entry, first)  # between the values of colours are such that no pixel has
        every = int(np.bitwise_or.reduce(first, axis=None))
        step = every & -every  # largest power of two that divides all values
        bits = full.bit_length() - step.bit_length() + 1
        advice = f"; if they are {bits} bits of an ADC, moved to the left, state {bits} bits" if step > 1 else ""
        raise entry.error(
            f"{absent} of {expected} grey values around the mean never occur: the frames were scaled, or stretched to "
            f"more bits, after the ADC; capture RAW frames{advice}"
        )


def require_one_colour(entry: Series, signal: NDArray) -> None:
    """Refuse frames whose places of a 2x2 tile have signals of their own, far apart beside the pixels' spread."""
    rows, cols = (count - count % 2 for count in signal.shape)
    # the four places of a tile, [place, pixel]
    places = signal[:rows, :cols].reshape(rows // 2, 2, cols // 2, 2).transpose(1, 3, 0, 2).reshape(4, -1)
    middle = np.median(places, axis=1)
    spread = np.median(np.abs(places - middle[:, None])) / 0.6745
    if np.ptp(middle) > max(_MOSAIC * middle.mean(), 3 * spread):
        shares = ", ".join(f"{100 * value / middle.max():.0f}" for value in middle)
        raise entry.error(
            f"the places of a 2x2 tile have {shares} % of the largest signal: a colour mosaic. EMVA 1288 evaluates one "
            "colour at a time; state tile_rows: 2, tile_cols: 2 and tile_position: [row, column] in capture.yaml"
        )


def _gaps(first: NDArray, second: NDArray, full: int) -> tuple[int, int]:
    """Grey values near the mean that no pixel has, and how many were expected; of the frame that lacks more.

    Each frame has its own range: after light, the first in the dark may be brighter (image lag).
    """
    return max((_gaps_of(frame, full) for frame in (first, second)), key=lambda gaps: gaps[0] / max(gaps[1], 1))


def _gaps_of(frame: NDArray, full: int) -> tuple[int, int]:
    """Those of one frame. One gap alone may lie between two groups of pixels, as those of two read-outs."""
    absent = _absent(frame, full)[1]
    runs = int(np.sum(np.diff(absent.astype(np.int8)) == 1))
    return int(absent.sum()) if runs > 1 else 0, absent.size


def _hole(frame: NDArray, full: int) -> slice | None:
    """Grey values of one gap near the mean, wider than the pixels' standard deviation; None without one."""
    low, absent, spread = _absent(frame, full)
    inside = np.flatnonzero(absent)
    if inside.size <= spread or inside[-1] - inside[0] >= inside.size:
        return None
    return slice(int(low + inside[0]), int(low + inside[-1] + 1))


def _absent(frame: NDArray, full: int) -> tuple[int, NDArray[np.bool_], float]:
    """Lowest grey value near the mean, which of those from it on no pixel has, and the standard deviation.

    The range is that of the middle 87 % of the pixels: a few hot pixels, or masked ones, would widen a standard
    deviation. Where few pixels are expected to have each value, it is empty.
    """
    counts = np.bincount(frame.ravel(), minlength=full + 1)
    below = np.cumsum(counts)
    low, high = (int(np.searchsorted(below, part * below[-1])) for part in _CENTRAL)
    spread = max((high - low) / _CENTRAL_SIGMAS, 0.5)
    if counts.sum() * 0.13 / spread < _EXPECTED:
        high = low - 1
    return low, counts[low : high + 1] == 0, spread


class SpatialStack:
    """Frames of one series in the form that `measure` reads: a stack of one exposure.

    Attributes
    ----------
    file : of messages.
    shape : (1, frames, rows, cols).
    exposures_us : int64 [1], rounded.
    """

    def __init__(self, pairs: PairSet, series: Series, progress: Progress | None = None) -> None:
        self._pairs, self._series, self._progress = pairs, series, progress
        self.file = series.where
        self.shape: tuple[int, int, int, int] = (1, len(series.files), *pairs.shape)
        self.exposures_us = np.array([round(series.exposure_s * 1e6)], np.int64)

    def __iter__(self) -> Iterator[NDArray]:
        for number, frame in enumerate(self._pairs.frames(self._series)):
            if self._progress is not None:
                self._progress("reading the long series", (number + 1) / self.shape[1])
            yield frame
