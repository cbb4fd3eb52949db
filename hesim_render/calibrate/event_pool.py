"""Event counts pooled by tile position and brightness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.event_counts import StaticCapture
from hesim_render.calibrate.event_model import EventCounts

#: Bins even in brightness and, down to `_LEAST_SIGNAL` of the brightest, in its logarithm.
_BINS, _LOG_BINS, _LEAST_SIGNAL = 96, 240, 1e-4


@dataclass(frozen=True)
class PooledEvents:
    """Counts pooled by position and brightness; arrays [position, bin].

    Attributes
    ----------
    counts : sums over the pixels of a bin. pixels : how many they are.
    on_on, off_off, on_off : sums of products of the pixels' counts, for their scatter.
    lit_dark : [position, bin, 2, 2], sums of products of a lit bin's counts (ON, OFF) with those of the same pixels
        in the dark. in_dark : [position, bin, 2], the latter alone. Both 0 in bins of the dark.
    dark_bin : [bin], the bin of the dark that holds a lit bin's pixels too; −1 where there is none.
    relative : threshold of a bin's pixels relative to the mean of all, as far as it was measured.
    trials : trials of one pixel.
    """

    counts: EventCounts
    pixels: NDArray[np.float64]
    on_on: NDArray[np.float64]
    off_off: NDArray[np.float64]
    on_off: NDArray[np.float64]
    lit_dark: NDArray[np.float64]
    in_dark: NDArray[np.float64]
    dark_bin: NDArray[np.intp]
    relative: NDArray[np.float64]
    trials: int

    def together(self) -> PooledEvents:
        """All positions pooled: [1, bin]."""

        def total(values: NDArray) -> NDArray:
            return values.sum(axis=0, keepdims=True)

        pixels = total(self.pixels)
        signal = total(self.counts.signal_dn * self.pixels) / np.maximum(pixels, 1)
        counts = EventCounts(signal, total(self.counts.trials), total(self.counts.on), total(self.counts.off))
        return PooledEvents(
            counts,
            pixels,
            total(self.on_on),
            total(self.off_off),
            total(self.on_off),
            total(self.lit_dark),
            total(self.in_dark),
            self.dark_bin,
            self.relative[:1],
            self.trials,
        )

    def position(self, k: int) -> PooledEvents:
        """One position without its empty bins: [1, bin]."""
        used = self.pixels[k] > 0
        c = self.counts
        counts = EventCounts(*(v[k, used][None] for v in (c.signal_dn, c.trials, c.on, c.off)))
        renumbered = np.append(np.cumsum(used) - 1, -1)
        return PooledEvents(
            counts,
            self.pixels[k, used][None],
            self.on_on[k, used][None],
            self.off_off[k, used][None],
            self.on_off[k, used][None],
            self.lit_dark[k, used][None],
            self.in_dark[k, used][None],
            renumbered[self.dark_bin[used]],
            self.relative[k, used][None],
            self.trials,
        )

    def scatter(self) -> NDArray[np.float64]:
        """Measured covariance [position, bin, 2, 2] of one pixel's counts (ON, OFF) within a bin."""
        n = np.maximum(self.pixels, 1)
        free = np.maximum(self.pixels - 1, 1)
        on, off = self.counts.on, self.counts.off
        cross = (self.on_off - on * off / n) / free
        return np.stack(
            [
                np.stack([(self.on_on - on * on / n) / free, cross], -1),
                np.stack([cross, (self.off_off - off * off / n) / free], -1),
            ],
            -2,
        )

    def scatter_about(self, on: NDArray, off: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Mean squares [position, bin, 2, 2] of one pixel's counts about `on` and `off` [position, bin] events.

        Returns
        -------
        Of (ON, OFF) with themselves, and of a lit bin's with those of the same pixels in the dark.
        """
        n = np.maximum(self.pixels, 1)[..., None, None]
        expected = np.stack([on, off], axis=-1)
        totals = np.stack([self.counts.on, self.counts.off], axis=-1)
        products = np.stack(
            [np.stack([self.on_on, self.on_off], axis=-1), np.stack([self.on_off, self.off_off], axis=-1)], axis=-2
        )
        dark = np.where((self.dark_bin >= 0)[:, None], expected[..., self.dark_bin, :], 0.0)

        def about(products: NDArray, first: NDArray, middle: NDArray, second: NDArray, other: NDArray) -> NDArray:
            mixed = first[..., :, None] * other[..., None, :] + middle[..., :, None] * second[..., None, :]
            return products / n - mixed / n + middle[..., :, None] * other[..., None, :]

        own = about(products, totals, expected, totals, expected)
        return own, about(self.lit_dark, totals, expected, self.in_dark, dark)


def pool_events(
    static: StaticCapture,
    good: NDArray[np.bool_],
    weight: NDArray | None = None,
    group: NDArray | None = None,
    relative: NDArray | None = None,
) -> PooledEvents:
    """Pool good pixels in bins of brightness; the dark is a bin of its own.

    A bin spans 1 % of the range, 4 % of its brightness and 2 % of the pixels at most. P at its mean brightness is the
    mean of P to 3 in a thousand even where P changes fastest with brightness.

    Parameters
    ----------
    weight : [row, col], how often a pixel counts (bootstrap).
    group, relative : number [row, col] of the group of like thresholds that a pixel belongs to, and the relative
        threshold of each group; bins are then kept apart by group.
    """
    positions = static.tile[0] * static.tile[1]
    signal = static.signal_dn[good]
    sample = signal[:: max(1, signal.size // 20000)]
    low, high = float(signal.min()), float(signal.max())
    even = np.linspace(low, high, _BINS + 1), np.quantile(sample, np.linspace(0, 1, _BINS // 2 + 1))
    ratios = np.geomspace(_LEAST_SIGNAL, 1.0, _LOG_BINS + 1) * high
    edges = np.unique(np.concatenate([*even, ratios[ratios > low]]))
    inner = edges[1:-1]
    position = np.broadcast_to(static.position, static.signal_dn.shape)[good]
    weights = None if weight is None else weight[good].astype(np.float64)
    relative = np.ones(1) if group is None or relative is None else relative
    groups = np.zeros(signal.size, np.intp) if group is None else group[good]
    number = positions * relative.size

    def sums(index: NDArray, size: int, value: NDArray | None) -> NDArray[np.float64]:
        """Sums [position, bin × group] of a value of each pixel; of None, how many they are."""
        if value is None or weights is None:
            value = weights if value is None else value
        else:
            value = value * weights
        return np.bincount(index, value, number * size).reshape(positions, -1).astype(np.float64)

    columns: list[list[NDArray]] = [[] for _ in range(7)]
    counted = [(on[good].astype(np.float64), off[good].astype(np.float64)) for _, on, off in static.sessions]
    lit_size = len(inner) + 1
    lit_index = (position * lit_size + np.searchsorted(inner, signal, side="right")) * relative.size + groups
    for k, (on, off) in enumerate(counted):
        index, size, light = (
            (lit_index, lit_size, signal) if k == 0 else (position * relative.size + groups, 1, np.zeros_like(signal))
        )
        for column, value in zip(columns, (None, light, on, off, on * on, off * off, on * off), strict=True):
            column.append(sums(index, size, value))
    pixels, light, on, off, on_on, off_off, on_off = (np.concatenate(c, axis=1) for c in columns)
    lit_dark, in_dark = np.zeros((*pixels.shape, 2, 2)), np.zeros((*pixels.shape, 2))
    dark_bin = np.full(pixels.shape[1], -1)
    if len(counted) > 1:
        lit_bins = lit_size * relative.size
        dark_bin[:lit_bins] = lit_bins + np.arange(lit_bins) % relative.size
        for j, dark in enumerate(counted[1]):
            in_dark[:, :lit_bins, j] = sums(lit_index, lit_size, dark)
            for i, lit in enumerate(counted[0]):
                lit_dark[:, :lit_bins, i, j] = sums(lit_index, lit_size, lit * dark)
    counts = EventCounts(light / np.maximum(pixels, 1), pixels * static.trials, on, off)
    thresholds = np.broadcast_to(np.tile(relative, pixels.shape[1] // relative.size), pixels.shape)
    return PooledEvents(counts, pixels, on_on, off_off, on_off, lit_dark, in_dark, dark_bin, thresholds, static.trials)
