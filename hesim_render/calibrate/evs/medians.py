"""Thresholds over noise from medians of counts, which bad pixels hardly affect."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from hesim_render.calibrate.evs.cells import Cells
from hesim_render.calibrate.evs.counts import StaticCapture

#: Number of pixels of similar brightness in a group.
_GROUP = 200
#: Number of groups that define the lines of a typical pixel.
_LINE = 40
#: Quantiles of counts, and the deviate of the threshold of each: the highest threshold has the fewest events.
QUANTILES = {0.16: 0.9945, 0.5: 0.0, 0.84: -0.9945, 0.975: -1.96}
#: Least number of events of a count that gives a threshold.
LEAST_EVENTS = 10.0


def like_brightness(signal: NDArray, most: int = 300) -> NDArray[np.intp]:
    """Number of each pixel's group of like brightness, of `_GROUP` pixels or more; the first is the darkest."""
    order = np.argsort(signal, kind="stable")
    size = max(_GROUP, signal.size // most)
    group = np.empty(signal.size, np.intp)
    group[order] = np.minimum(np.arange(signal.size) // size, max(signal.size // size - 1, 0))
    return group


def by_group(values: NDArray, group: NDArray[np.intp]) -> list[NDArray]:
    """The values of each group."""
    order = np.argsort(group, kind="stable")
    return np.split(values[order], np.searchsorted(group[order], np.arange(1, int(group.max()) + 1)))


def density(u: NDArray) -> NDArray[np.float64]:
    return np.exp(-0.5 * u * u) / np.sqrt(2 * np.pi)


def middle_and_spread(
    both: list[NDArray], group: NDArray[np.intp], trials: int, known: float | None = None
) -> tuple[list[NDArray[np.float64]], float]:
    """u of the median threshold of each group, for ON and OFF, and the relative spread of thresholds (or that `known`).

    Quantiles of the counts are thresholds t = −Q⁻¹(count/trials) of so many deviations: t = u (1 + m z). Of each
    group the lowest quantile that holds enough events is taken, the same for ON and OFF, and the next one for m.
    """
    levels = np.array([QUANTILES[q] for q in QUANTILES])
    quantiles = []
    for counts in both:
        # integers are spread evenly over their step, so that quantiles are not limited to a few values
        parts = by_group(counts + np.random.default_rng(0).uniform(-0.5, 0.5, counts.shape), group)
        # mean without the highest hundredth, which contains the bad pixels, in place of a further quantile
        means = [part[part <= np.quantile(part, 0.99)].mean() for part in parts]
        quantiles.append(np.column_stack([[np.quantile(part, list(QUANTILES)) for part in parts], means]))
    # [group, quantile]: enough events in both polarities, so that both take the same quantile
    enough = np.min([q[:, :-1] for q in quantiles], axis=0) >= LEAST_EVENTS
    first = np.where(enough.any(axis=1), np.argmax(enough, axis=1), levels.size - 1)
    has_quantile, row = enough.any(axis=1), np.arange(first.size)
    spreads = []
    for q in quantiles:
        for k in range(levels.size - 1):
            at = has_quantile & (first == k)
            if not at.any():
                continue
            low, high = (-ndtri(np.maximum(q[at, j] + 0.5, 0.5) / (trials + 1)) for j in (k, k + 1))
            # two quantiles give t₁ = u (1 + m z₁) and t₂ = u (1 + m z₂), which are solved for m
            m = (low - high) / np.maximum(high * levels[k] - low * levels[k + 1], 1e-6)
            own = np.mean(
                [
                    q[at, j] / trials * (1 - q[at, j] / trials) / trials / density(t) ** 2
                    for j, t in ((k, low), (k + 1, high))
                ],
                axis=0,
            )
            u = low / np.maximum(1 + m * levels[k], 0.1)
            # the part of m² that counting makes is taken off
            spreads.append((m**2 - own / u**2)[(low > 0.02) & (high > 0)])
    values = np.concatenate(spreads) if spreads else np.empty(0)
    if known is not None:
        spread = known
    elif values.size:
        spread = float(np.sqrt(max(np.median(values), 0.0)))
    else:
        spread = _spread_of_few_events(both, group, [q[:, -1] for q in quantiles], trials)
    middles = []
    for q in quantiles:
        rate = np.maximum(q[row, first] + 0.5, 0.5) / (trials + 1)
        here = -ndtri(rate)
        # the spread of the quantile is that of thresholds and of counting together
        counting = rate * (1 - rate) / trials / density(here) ** 2
        wide = np.sqrt(spread**2 + counting / np.maximum(here, 0.05) ** 2)
        # back from the deviate of the quantile to the median
        from_quantile = here / np.maximum(1 + wide * levels[first], 0.1)
        v = -ndtri(np.clip((q[:, -1] + 0.5) / (trials + 1), 1e-300, 0.5))
        # few events: the mean rate of a normal law of thresholds, solved for its middle
        from_mean = v / np.sqrt(np.maximum(1 - (spread * v) ** 2, 0.05))
        middles.append(np.where(has_quantile, from_quantile, from_mean))
    return middles, spread


def _spread_of_few_events(both: list[NDArray], group: NDArray, means: list[NDArray], trials: int) -> float:
    """Spread of thresholds from the variance of counts beyond counting, without the highest hundredth."""
    top, bottom = 0.0, 0.0
    for counts, mean in zip(both, means, strict=True):
        middle = mean[group]
        kept = counts <= np.quantile(counts, 0.99)
        u = -ndtri(np.clip((middle[kept] + 0.5) / (trials + 1), 1e-300, 0.5))
        # variance beyond that of counting, over the square of the slope of counts by ln θ
        top += float(np.sum((counts[kept] - middle[kept]) ** 2 - middle[kept]))
        bottom += float(np.sum((trials * density(u) * u) ** 2))
    return min(float(np.sqrt(max(top / max(bottom, 1e-300), 0.0))), 0.3)


def spread_of_thresholds(static: StaticCapture, good: NDArray[np.bool_]) -> float:
    """Relative spread of thresholds: the larger of the lit scene and the dark, because few events do not show it."""
    return max(
        middle_and_spread([counts[good] for counts in both], like_brightness(signal[good]), static.trials)[1]
        for signal, *both in static.sessions
    )


@dataclass(frozen=True)
class Typical:
    """Behaviour of a pixel with the median threshold.

    Attributes
    ----------
    cells : cells as if all pixels were such pixels; a search for the parameters begins with them.
    spread : relative spread of thresholds.
    lines : signal in DN and u of each group, for each count of `PixelCounts` (ON and OFF, lit and dark).
    """

    cells: Cells
    spread: float
    lines: list[tuple[NDArray[np.float64], NDArray[np.float64]]]

    @classmethod
    def of(cls, static: StaticCapture, good: NDArray[np.bool_]) -> "Typical":
        lines, polarities, numbers = [], [], []
        spread = spread_of_thresholds(static, good)
        for signal, *both in static.sessions:
            # groups of like brightness, few enough for smooth lines of u against signal
            light = signal[good]
            group = like_brightness(light, _LINE)
            middle, _ = middle_and_spread([counts[good] for counts in both], group, static.trials, spread)
            number = np.bincount(group).astype(np.float64)
            for polarity, u in zip((1.0, -1.0), middle, strict=True):
                lines.append((np.bincount(group, light) / number, u))
                polarities.append(np.full(u.size, polarity))
                numbers.append(number)
        signal, u = (np.concatenate(values) for values in zip(*lines, strict=True))
        pixels, one = np.concatenate(numbers), np.ones(u.size)
        events = pixels * static.trials * ndtr(-u)
        cells = Cells(signal, np.concatenate(polarities), one, 0 * one, pixels, events, static.trials)
        return cls(cells, spread, lines)

    def threshold_over_noise(self, count: int, signal_dn: NDArray) -> NDArray[np.float64]:
        """u of pixels [pixel] of a count, on a straight line between the groups."""
        return np.interp(signal_dn, *self.lines[count])

    def group(self, count: int, signal_dn: NDArray) -> NDArray[np.intp]:
        """Number of the group that is nearest in brightness."""
        light, _ = self.lines[count]
        return np.searchsorted((light[1:] + light[:-1]) / 2, signal_dn)
