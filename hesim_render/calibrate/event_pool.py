"""Event counts pooled by tile position and brightness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.event_counts import StaticCapture
from hesim_render.calibrate.event_model import EventCounts

_BINS = 96


@dataclass(frozen=True)
class PooledEvents:
    """Counts pooled by position and brightness; arrays [position, bin].

    Attributes
    ----------
    counts : sums over the pixels of a bin. pixels : how many they are.
    on_on, off_off, on_off : sums of products of the pixels' counts, for their scatter.
    relative : threshold of a bin's pixels relative to the mean of all, as far as it was measured.
    trials : trials of one pixel.
    """

    counts: EventCounts
    pixels: NDArray[np.float64]
    on_on: NDArray[np.float64]
    off_off: NDArray[np.float64]
    on_off: NDArray[np.float64]
    relative: NDArray[np.float64]
    trials: int

    def together(self) -> PooledEvents:
        """All positions pooled: [1, bin]."""

        def total(values: NDArray) -> NDArray:
            return values.sum(axis=0, keepdims=True)

        pixels = total(self.pixels)
        signal = total(self.counts.signal_dn * self.pixels) / np.maximum(pixels, 1)
        counts = EventCounts(signal, total(self.counts.trials), total(self.counts.on), total(self.counts.off))
        squares = total(self.on_on), total(self.off_off), total(self.on_off)
        return PooledEvents(counts, pixels, *squares, self.relative[:1], self.trials)

    def position(self, k: int) -> PooledEvents:
        """One position without its empty bins: [1, bin]."""
        used = self.pixels[k] > 0
        c = self.counts
        counts = EventCounts(*(v[k, used][None] for v in (c.signal_dn, c.trials, c.on, c.off)))
        arrays = self.pixels, self.on_on, self.off_off, self.on_off, self.relative
        pixels, on_on, off_off, on_off, relative = (v[k, used][None] for v in arrays)
        return PooledEvents(counts, pixels, on_on, off_off, on_off, relative, self.trials)

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


def pool_events(
    static: StaticCapture,
    good: NDArray[np.bool_],
    weight: NDArray | None = None,
    group: NDArray | None = None,
    relative: NDArray | None = None,
) -> PooledEvents:
    """Pool good pixels in bins of brightness, even in brightness and in number of pixels; the dark is a bin of its own.

    A bin spans 1 % of the range at most: within it P is straight to a few parts in a million.

    Parameters
    ----------
    weight : [row, col], how often a pixel counts (bootstrap).
    group, relative : number [row, col] of the group of like thresholds that a pixel belongs to, and the relative
        threshold of each group; bins are then kept apart by group.
    """
    positions = static.tile[0] * static.tile[1]
    signal = static.signal_dn[good]
    sample = signal[:: max(1, signal.size // 20000)]
    edges = np.unique(
        np.concatenate(
            [np.linspace(signal.min(), signal.max(), _BINS + 1), np.quantile(sample, np.linspace(0, 1, _BINS // 2 + 1))]
        )
    )
    inner = edges[1:-1]
    position = np.broadcast_to(static.position, static.signal_dn.shape)[good]
    weights = None if weight is None else weight[good].astype(np.float64)
    relative = np.ones(1) if group is None or relative is None else relative
    groups = np.zeros(signal.size, np.intp) if group is None else group[good]
    columns: list[list[NDArray]] = [[] for _ in range(7)]
    for k, (_, on_map, off_map) in enumerate(static.sessions):
        size = len(inner) + 1 if k == 0 else 1
        bins = np.searchsorted(inner, signal, side="right") if k == 0 else np.zeros(signal.size, np.intp)
        index = (position * size + bins) * relative.size + groups
        on, off = on_map[good].astype(np.float64), off_map[good].astype(np.float64)
        values = (None, signal if k == 0 else np.zeros_like(signal), on, off, on * on, off * off, on * off)
        for column, value in zip(columns, values, strict=True):
            if value is None:
                value = weights
            elif weights is not None:
                value = value * weights
            total = np.bincount(index, value, positions * size * relative.size)
            column.append(total.reshape(positions, -1).astype(np.float64))
    pixels, light, on, off, on_on, off_off, on_off = (np.concatenate(c, axis=1) for c in columns)
    counts = EventCounts(light / np.maximum(pixels, 1), pixels * static.trials, on, off)
    thresholds = np.broadcast_to(np.tile(relative, pixels.shape[1] // relative.size), pixels.shape)
    return PooledEvents(counts, pixels, on_on, off_off, on_off, thresholds, static.trials)
