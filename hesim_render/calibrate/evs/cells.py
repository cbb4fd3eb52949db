"""Event counts pooled over pixels that are alike in brightness, polarity and, where it was measured, threshold."""

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.evs.counts import StaticCapture

#: Number of bins of equal width in brightness and, down to `_LEAST_SIGNAL` of the brightest, in its logarithm.
_BINS, _LOG_BINS, _LEAST_SIGNAL = 192, 480, 1e-4
#: Width of a bin of relative thresholds. Their variation within a bin counts as spread.
_THRESHOLD_STEP = 0.01
#: Largest deviation of a typical pixel's relative threshold from 1.
_TYPICAL = 0.1


@dataclass(frozen=True)
class PixelThresholds:
    """Known thresholds of each pixel; arrays [row, col].

    Attributes
    ----------
    on, off : expected threshold relative to the mean of all pixels.
    on_spread, off_spread : relative standard deviation about it; the mismatch where nothing is known.
    """

    on: NDArray[np.float64]
    off: NDArray[np.float64]
    on_spread: NDArray[np.float64]
    off_spread: NDArray[np.float64]

    @classmethod
    def unknown(cls, shape: tuple[int, ...], mismatch: float) -> "PixelThresholds":
        one, spread = np.ones(shape), np.full(shape, mismatch)
        return cls(one, one, spread, spread)


@dataclass(frozen=True)
class Cells:
    """Sums over the pixels of a cell; arrays [cell].

    Attributes
    ----------
    signal_dn : mean signal, DN.
    polarity : +1 ON, −1 OFF.
    relative, spread : mean of the pixels' relative thresholds, and rms of the deviations about it.
    pixels : number of pixels.
    events : events of that polarity, of all pixels.
    trials : trials of one pixel.
    """

    signal_dn: NDArray[np.float64]
    polarity: NDArray[np.float64]
    relative: NDArray[np.float64]
    spread: NDArray[np.float64]
    pixels: NDArray[np.float64]
    events: NDArray[np.float64]
    trials: int

    @property
    def total(self) -> NDArray[np.float64]:
        """Trials of all pixels of a cell."""
        return self.pixels * self.trials

    def coarser(self, most: int = 150) -> "Cells":
        """At most `most` cells of each polarity, by pooling neighbours in brightness. For searches, not for results."""
        order = np.lexsort((self.signal_dn, self.polarity))
        pixels = self.pixels[order]
        # neighbours in brightness get one number, for each polarity apart
        rank = np.concatenate(
            [np.arange(n) * min(most / n, 1.0) for n in np.unique(self.polarity, return_counts=True)[1]]
        )
        _, group = np.unique(np.stack([self.polarity[order], np.floor(rank)]), axis=1, return_inverse=True)
        total = np.bincount(group, pixels).astype(np.float64)

        def mean(values: NDArray) -> NDArray[np.float64]:
            return np.bincount(group, values[order] * pixels) / np.maximum(total, 1e-30)

        relative = mean(self.relative)
        # within and between the pooled cells
        spread = np.sqrt(np.maximum(mean(self.spread**2 + self.relative**2) - relative**2, 0.0))
        events = np.bincount(group, self.events[order]).astype(np.float64)
        return Cells(mean(self.signal_dn), mean(self.polarity), relative, spread, total, events, self.trials)

    def typical(self) -> "Cells":
        """The cells whose known thresholds are near the mean, or all if none is.

        A pixel whose threshold nearly vanishes has a thousand times the events of others. Pooled with them it would
        outweigh them, and no normal law describes such a cell.
        """
        near = np.abs(self.relative - 1) <= _TYPICAL
        if not near.any():
            return self
        parts = {f.name: getattr(self, f.name)[near] for f in fields(self) if f.name != "trials"}
        return replace(self, **parts)

    def with_spread(self, factor: float) -> "Cells":
        """The same cells with the spread of thresholds scaled."""
        return replace(self, spread=self.spread * factor)


@dataclass(frozen=True)
class PixelCounts:
    """Good pixels in flat arrays, with the cell of each of their counts.

    Attributes
    ----------
    signal_dn, position : [pixel], signal in DN and number of the tile position.
    counts : [count, pixel], ON and OFF events of the lit scene and of the dark.
    polarity, is_dark : [count].
    relative, spread : [count, pixel], thresholds as in `PixelThresholds`.
    cell : [count, pixel], number of the cell.
    cells : sums over the cells.
    """

    signal_dn: NDArray[np.float64]
    position: NDArray[np.intp]
    counts: NDArray[np.float64]
    polarity: NDArray[np.float64]
    is_dark: NDArray[np.bool_]
    relative: NDArray[np.float32]
    spread: NDArray[np.float32]
    cell: NDArray[np.intp]
    cells: Cells

    def single(self, count: int) -> Cells:
        """One of the counts, with one cell per pixel."""
        one = np.ones(self.signal_dn.shape)
        return Cells(
            signal_dn=np.zeros_like(one) if self.is_dark[count] else self.signal_dn,
            polarity=self.polarity[count] * one,
            relative=self.relative[count].astype(np.float64),
            spread=self.spread[count].astype(np.float64),
            pixels=one,
            events=self.counts[count],
            trials=self.cells.trials,
        )


def brightness_edges(signal_dn: NDArray) -> NDArray[np.float64]:
    """Inner edges of bins of brightness: 0.5 % of the range, 2 % of the brightness, 1 % of the pixels at most.

    P at a bin's mean brightness equals the mean of P to 1 in a thousand, even where P changes fastest with brightness.
    """
    low, high = float(signal_dn.min()), float(signal_dn.max())
    sample = signal_dn[:: max(1, signal_dn.size // 20000)]
    even = np.linspace(low, high, _BINS + 1), np.quantile(sample, np.linspace(0, 1, _BINS // 2 + 1))
    ratios = np.geomspace(_LEAST_SIGNAL, 1.0, _LOG_BINS + 1) * high
    return np.unique(np.concatenate([*even, ratios[ratios > low]]))[1:-1]


def pool_events(
    static: StaticCapture,
    good: NDArray[np.bool_],
    thresholds: PixelThresholds,
    position: int | None = None,
) -> PixelCounts:
    """Sort the counts of good pixels into cells. The dark capture is a brightness of its own.

    Parameters
    ----------
    static : counts of the static scene.
    good : [row, col], pixels that are used.
    thresholds : known thresholds of the pixels.
    position : number of the tile position whose pixels are used; None for all.
    """
    # bins of all good pixels, so that cells do not depend on the chosen position
    edges = brightness_edges(static.signal_dn[good])
    take = good if position is None else good & (static.position == position)
    signal = static.signal_dn[take]
    bright = np.searchsorted(edges, signal, side="right")
    counts, polarities, is_dark, relatives, spreads, index = [], [], [], [], [], []
    columns: list[list[NDArray]] = [[] for _ in range(6)]
    number = 0
    for session, (light, *both) in enumerate(static.sessions):
        for polarity, events, relative, spread in zip(
            (1.0, -1.0), both, (thresholds.on, thresholds.off), (thresholds.on_spread, thresholds.off_spread),
            strict=True,
        ):  # fmt: skip
            x, r, left, n = light[take], relative[take], spread[take], events[take].astype(np.float64)
            # a cell has pixels of one bin of brightness, whose thresholds are alike; the dark has no bins
            alike = np.rint(r / _THRESHOLD_STEP).astype(np.intp)
            alike -= alike.min(initial=0)
            key = alike if session else bright * (alike.max(initial=0) + 1) + alike
            _, cell = np.unique(key, return_inverse=True)
            pixels = np.bincount(cell).astype(np.float64)

            def mean(values: NDArray, cell: NDArray = cell, pixels: NDArray = pixels) -> NDArray[np.float64]:
                return np.bincount(cell, values) / pixels

            # mean threshold of each cell, and what is left of the spread about it
            centre = mean(r)
            within = np.sqrt(mean(left * left + (r - centre[cell]) ** 2))
            values = mean(x), np.full(pixels.size, polarity), centre, within, pixels, mean(n) * pixels
            for column, value in zip(columns, values, strict=True):
                column.append(value)
            counts.append(n)
            polarities.append(polarity)
            is_dark.append(session > 0)
            relatives.append(r.astype(np.float32))
            spreads.append(left.astype(np.float32))
            index.append(cell + number)
            number += pixels.size
    signals, signs, centres, withins, numbers, events = (np.concatenate(column) for column in columns)
    cells = Cells(signals, signs, centres, withins, numbers, events, static.trials)
    return PixelCounts(
        signal, np.broadcast_to(static.position, good.shape)[take], np.stack(counts), np.array(polarities),
        np.array(is_dark), np.stack(relatives), np.stack(spreads), np.stack(index), cells,
    )  # fmt: skip
