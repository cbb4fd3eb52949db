"""Scatter of event counts beyond counting statistics: over pixels (thresholds), and in time (noise)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import log_ndtr, ndtr, ndtri

from hesim_render.calibrate.estimate import Spread
from hesim_render.calibrate.evs.cells import PixelCounts
from hesim_render.calibrate.evs.fitted import EventFit
from hesim_render.calibrate.evs.medians import Typical
from hesim_render.calibrate.evs.model import log_probability, probability_variance, threshold_over_noise

#: Largest scatter of thresholds, relative to that of counting, with which the scatter in time can be measured.
_CLEAR = 0.3
#: Largest and least number of counts for an estimate of the mismatch.
_MOST_COUNTS, _FEWEST_COUNTS = 12_000, 200
#: Nodes and weights of the quadrature over thresholds.
_NODES, _WEIGHTS = np.polynomial.hermite.hermgauss(15)
_NO_MISMATCH, _LARGEST_MISMATCH = 1e-4, 0.6
#: Relative step of a numerical slope; standard deviation of the weak prior of a group's middle threshold, in ln.
_STEP, _HOLD = 1e-4, 0.3
#: Twice the gain of ln L above which a mismatch is significant (a probability of 6e-5).
_SIGNIFICANT = 16.0


@dataclass(frozen=True)
class Dispersion:
    """Variance of a pixel's counts in time over the trinomial one, with standard errors; NaN where thresholds hide it.

    Attributes
    ----------
    total, total_error : of ON + OFF. Noise drawn once per tick and differenced makes an ON more likely after an OFF,
        so it is above 1 there ...
    difference, difference_error : ... and below 1 for ON − OFF.
    """

    total: float
    total_error: float
    difference: float
    difference_error: float


def dispersion_in_time(pixels: PixelCounts, fit: EventFit, theta_v: float) -> Dispersion:
    """Mean squares about the fit, minus the scatter of thresholds, over counting statistics; never below 0.

    Parameters
    ----------
    pixels : counts.
    fit : the fit.
    theta_v : Θ, threshold in V.
    """
    cells = pixels.cells
    p = np.exp(log_probability(fit.parameters, cells, theta_v, fit.law)[0])
    u, _ = threshold_over_noise(fit.parameters, cells.signal_dn, theta_v, fit.law)
    # variance of a pixel's counts that the spread of thresholds makes, [cell]
    between = cells.trials**2 * probability_variance(
        u * (1 - cells.polarity * fit.parameters[4]), cells.spread, cells.relative
    )
    columns: list[list[NDArray]] = [[] for _ in range(5)]
    for session in np.unique(pixels.is_dark):
        on, off = np.flatnonzero(pixels.is_dark == session)
        p_on, p_off = p[pixels.cell[on]], p[pixels.cell[off]]
        thresholds = between[pixels.cell[on]] + between[pixels.cell[off]]
        n = cells.trials
        e_on, e_off = pixels.counts[on] - n * p_on, pixels.counts[off] - n * p_off
        # variances of ON + OFF and of ON − OFF of a trinomial law
        both, apart = n * (p_on + p_off) * (1 - p_on - p_off), n * (p_on + p_off - (p_on - p_off) ** 2)
        # only where thresholds hide little
        clear = (thresholds < _CLEAR * both) & (both > 0)
        for column, values in zip(columns, (e_on + e_off, e_on - e_off, both, apart, thresholds), strict=True):
            column.append(values[clear])
    total, difference, both, apart, thresholds = (np.concatenate(column) for column in columns)
    return Dispersion(*_ratio(total, both, thresholds), *_ratio(difference, apart, thresholds))


def _ratio(residual: NDArray, counting: NDArray, thresholds: NDArray) -> tuple[float, float]:
    """(Σ residual² − thresholds)/counting with weights of a variance's own scatter, and its standard error."""
    if residual.size < 100:
        return float("nan"), float("nan")
    # the square of the residual of a Poisson count, over its mean, has a variance of 2 + 1/mean
    weight = 1 / (2 + 1 / counting)
    values = (residual**2 - thresholds) / counting
    mean = float(weight @ values / weight.sum())
    error = float(np.sqrt(np.sum((weight * (values - mean)) ** 2)) / weight.sum())
    return max(mean, 0.0), error


def static_mismatch(pixels: PixelCounts, typical: Typical) -> Spread:
    """Relative spread of thresholds from the distribution of the counts of pixels of one brightness.

    It is the maximum likelihood of the mixture of binomial laws that normal thresholds give, as a function of m and of
    the middle threshold of each group. The error is from the scatter of the pixels' efficient scores.
    """
    mixture = _Mixture.of(pixels, typical)
    if mixture.pixel.size < _FEWEST_COUNTS:
        return Spread(0.0, float("nan"), float("nan"))
    # against the likelihood without any mismatch
    top, m, scale = mixture.maximum(float(np.clip(typical.spread, 0.01, 0.4)))
    information, error = mixture.information(m, scale)
    without, _, _ = mixture.maximum(_NO_MISMATCH, fixed=True)
    if 2 * (top - without) < _SIGNIFICANT:
        return Spread(0.0, float("nan"), m + 2 / float(np.sqrt(max(information, 1.0))))
    return Spread(m, error, m + 2 * error)


@dataclass(frozen=True)
class _Mixture:
    """Counts of a sample of pixels, each a mixture of binomial laws over its threshold; arrays [count].

    Attributes
    ----------
    u, events : u of the median threshold at the pixel's brightness, and its events of `trials`.
    group, pixel : of counts whose middle threshold is fitted together; of the pixel.
    """

    u: NDArray[np.float64]
    events: NDArray[np.float64]
    group: NDArray[np.intp]
    pixel: NDArray[np.intp]
    trials: int

    @classmethod
    def of(cls, pixels: PixelCounts, typical: Typical) -> "_Mixture":
        """A sample of the counts of which more than one event is expected."""
        u = np.stack([
            typical.threshold_over_noise(k, pixels.single(k).signal_dn) for k in range(len(pixels.counts))
        ])  # fmt: skip
        rows, pixel = np.nonzero(pixels.cells.trials * ndtr(-u) >= 1.0)
        # a fixed sample, so that the time does not grow with the sensor
        kept = np.random.default_rng(0).permutation(rows.size)[:_MOST_COUNTS]
        rows, pixel = rows[kept], pixel[kept]
        level = np.array([typical.group(k, pixels.single(k).signal_dn) for k in range(len(pixels.counts))])[rows, pixel]
        _, group = np.unique(np.stack([rows, level]), axis=1, return_inverse=True)
        return cls(u[rows, pixel], pixels.counts[rows, pixel], group, pixel, pixels.cells.trials)

    def log_likelihood(self, m: float, scale: NDArray) -> NDArray[np.float64]:
        """ln L of each count, without the constant: the mean over thresholds by Gauss–Hermite about the likeliest one.

        Nodes at fixed thresholds would be too far apart: the count of a low threshold determines it far more precisely.
        """
        u, k, n = self.u * scale[self.group], self.events, self.trials
        # a first guess of the pixel's threshold, z, from its own rate of events
        own = (k + 0.5) / (n + 1)
        middle = -ndtri(own)
        information = (u * m) ** 2 * n * np.exp(-middle * middle) / (2 * np.pi * own * (1 - own))
        z, width = np.clip((middle / u - 1) / m * information / (1 + information), -12, 12), np.ones_like(u)
        # Newton steps to the likeliest z, and the width of the peak there
        for _ in range(4):
            t = u * (1 + m * np.clip(z, -12, 12))
            q = np.clip(ndtr(-t), 1e-300, 1 - 1e-15)
            slope = np.exp(-0.5 * t * t) / np.sqrt(2 * np.pi)
            information = (u * m) ** 2 * n * slope**2 / (q * (1 - q)) + 1
            step = u * m * slope * (n * q - k) / (q * (1 - q)) - z
            z, width = np.clip(z + np.clip(step / information, -2, 2), -12, 12), 1 / np.sqrt(information)
        # Gauss–Hermite over the peak, in logarithms, as counts of thousands underflow
        terms = np.empty((_NODES.size, u.size))
        for row, node in zip(terms, _NODES, strict=True):
            at = z + np.sqrt(2) * width * node
            log_q, log_rest = log_ndtr(-u * (1 + m * at)), log_ndtr(u * (1 + m * at))
            row[:] = k * log_q + (n - k) * log_rest - 0.5 * at * at + node * node
        top = terms.max(axis=0)
        return top + np.log(_WEIGHTS @ np.exp(terms - top)) + np.log(width)

    def maximum(self, m: float, fixed: bool = False) -> tuple[float, float, NDArray[np.float64]]:
        """Largest ln L, and its arguments: m and the scale of each group's middle threshold."""
        size = int(self.group.max()) + 1

        def negative(values: NDArray) -> tuple[float, NDArray]:
            m, scale = float(np.exp(values[0])), np.exp(values[1:])
            here = self.log_likelihood(m, scale)
            of_m = 0.0 if fixed else float(np.sum(self.log_likelihood(m * (1 + _STEP), scale) - here)) / _STEP
            of_s = np.bincount(self.group, self.log_likelihood(m, scale * (1 + _STEP)) - here, size) / _STEP
            # a weak prior for groups of few counts
            slope = np.concatenate([[of_m], of_s - values[1:] / _HOLD**2])
            return float(-here.sum() + 0.5 * np.sum((values[1:] / _HOLD) ** 2)), -slope

        bounds = [(np.log(_NO_MISMATCH), np.log(_LARGEST_MISMATCH)), *[(-1.0, 1.0)] * size]
        start = np.concatenate([[np.log(m)], np.zeros(size)])
        result = minimize(negative, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 60})
        return -float(result.fun), float(np.exp(result.x[0])), np.exp(result.x[1:])

    def information(self, m: float, scale: NDArray) -> tuple[float, float]:
        """Information of m with the groups' thresholds fitted, and the standard error of m."""
        # second differences of ln L of each count, by m and by its group's threshold
        h, k = 0.02 * m, 0.01
        table = {
            (i, j): self.log_likelihood(m + i * h, scale * (1 + j * k))
            for i, j in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1))
        }
        of_m, of_s = (table[1, 0] - table[-1, 0]) / (2 * h), (table[0, 1] - table[0, -1]) / (2 * k)
        mm = (2 * table[0, 0] - table[1, 0] - table[-1, 0]) / h**2
        ss = (2 * table[0, 0] - table[0, 1] - table[0, -1]) / k**2
        both = (table[1, 1] + table[-1, -1] - 2 * table[0, 0]) / (h * k)
        # the groups' middle thresholds are fitted with m: what they take of its information is left out
        cross, own = (np.bincount(self.group, v) for v in (-(mm * h / k + ss * k / h + both) / 2, ss))
        part = cross / (np.maximum(own, 0.0) + 1 / _HOLD**2)
        information = float(mm.sum() - part @ cross)
        # all counts of a pixel together: its two thresholds may be correlated
        of_pixel = np.bincount(self.pixel, of_m - part[self.group] * of_s)
        return information, float(np.sqrt(of_pixel @ of_pixel)) / max(information, 1e-9)
