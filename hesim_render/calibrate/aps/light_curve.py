"""Straight and bent lines through the levels of an EMVA 1288 set: gain, responsivity, linearity, mean curve."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_law
from scipy.stats import f as f_law

from hesim_render.calibrate.aps.pair_levels import MOST_CHANGE
from hesim_render.calibrate.estimate import ALARM
from hesim_render.recording.pair_set import PairSet

#: Gauss–Newton steps of a fit that is nearly linear.
_STEPS = 4
#: Degrees of freedom from which the scatter of points about a line tells their errors better than what is known.
_ENOUGH = 8
#: Chance of a larger χ² below which points do not lie on a line, and their scatter counts as error.
_MISFIT = 0.01


@dataclass(frozen=True)
class Line:
    """A slope through the origin by least squares, as EMVA 1288 takes it, and its standard error.

    Attributes
    ----------
    slope, error : the error includes that the points do not lie on the line.
    chi2_per_dof : of the points, with their own errors; NaN where those are unknown.
    groups : number of points where the error follows from their scatter; None where it is known.
    """

    slope: float
    error: float
    chi2_per_dof: float
    groups: int | None


def through_origin(x: NDArray, y: NDArray, covariance: NDArray | None) -> Line:
    """Unweighted line through the origin.

    Parameters
    ----------
    covariance : [point, point] of y; None where it is unknown and follows from the residuals (HC3, which is that of the
        jackknife).
    """
    total = float(x @ x)
    slope = float(x @ y) / total
    residual = y - slope * x
    if covariance is None:
        # each residual as if its own point had not been fitted
        leverage = x**2 / total
        error = float(np.sqrt(np.sum((x * residual / (1 - leverage)) ** 2))) / total
        return Line(slope, error, float("nan"), x.size)
    chi2 = float(np.sum(residual**2 / np.diag(covariance))) / max(x.size - 1, 1)
    # of stated errors; larger where the points scatter by more
    error = float(np.sqrt(x @ covariance @ x)) / total
    if chi2_law.sf(chi2 * (x.size - 1), x.size - 1) < _MISFIT:
        error *= float(np.sqrt(chi2))
    return Line(slope, error, chi2, None)


def _scale(chi2: float, dof: int) -> float:
    """Factor of variances that are known but for a factor: χ² per degree of freedom, if there are enough of them."""
    return chi2 if dof >= _ENOUGH else max(chi2, 1.0)


@dataclass(frozen=True)
class Intercept:
    """A straight line with a constant, by weighted least squares.

    Attributes
    ----------
    value, error : constant and its standard error.
    slope, slope_error : likewise.
    rms : of the residuals.
    groups : degrees of freedom and one.
    covariance : of constant and slope; of the constant alone where all points have one x.
    """

    value: float
    error: float
    slope: float
    slope_error: float
    rms: float
    groups: int
    covariance: NDArray[np.float64]

    def error_at(self, x: NDArray) -> NDArray[np.float64]:
        """Standard error of the line at x."""
        design = np.stack([np.ones_like(x), x])[: len(self.covariance)]
        return np.asarray(np.sqrt(np.einsum("il,ij,jl->l", design, self.covariance, design)))


def straight(x: NDArray, y: NDArray, error: NDArray) -> Intercept:
    """Weighted line; errors are scaled by the residuals. One x alone gives a constant."""
    design = np.stack([np.ones_like(x), x] if np.ptp(x) > 0 else [np.ones_like(x)])
    weight = 1 / error**2
    inverse = np.linalg.inv((design * weight) @ design.T)
    result = inverse @ (design * weight) @ y
    residual = y - result @ design
    dof = max(x.size - design.shape[0], 1)
    scale = _scale(float(np.sum(weight * residual**2)) / dof, dof)
    errors = np.sqrt(np.diag(inverse) * scale)
    rms = float(np.sqrt(np.sum(residual**2) / dof))
    if result.size == 1:
        return Intercept(float(result[0]), float(errors[0]), 0.0, float("nan"), rms, dof + 1, inverse * scale)
    return Intercept(
        float(result[0]), float(errors[0]), float(result[1]), float(errors[1]), rms, dof + 1, inverse * scale
    )


def linearity_error(light: NDArray, signal: NDArray, top: float) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Deviations of EMVA 1288 R4.0 linear, %: from a line weighted by 1/y², between 5 and 95 % of saturation.

    Returns
    -------
    The levels used, and their deviations.
    """
    use = (signal >= 0.05 * top) & (signal <= 0.95 * top)
    if use.sum() < 3:
        return use, np.empty(0)
    x, y = light[use], signal[use]
    # relative deviations are least: y/y = 1 is fitted by (1, x)/y
    design = np.stack([np.ones_like(x), x]) / y
    fit = np.linalg.lstsq(design.T, np.ones_like(y), rcond=None)[0]
    return use, 100 * (y / (fit[0] + fit[1] * x) - 1)


@dataclass(frozen=True)
class MeanCurve:
    """Signal against light: y = H' (b₁ + b₂ H' + b₃ H'²) with H' = H + offset.

    Attributes
    ----------
    offset : light beyond the stated one, in the unit of H: exposures that are longer than stated, or smear.
    offset_error : its standard error; 0 where the offset is not significant and left out.
    terms : b₁, b₂, b₃; 0 where not significant.
    covariance : [4, 4] of offset and terms.
    light_rms : relative scatter of the levels about the curve: of the light from exposure to exposure.
    """

    offset: float
    offset_error: float
    terms: NDArray[np.float64]
    covariance: NDArray[np.float64]
    light_rms: float

    @property
    def bends(self) -> bool:
        return bool(np.any(self.terms[1:] != 0))

    def at(self, light: NDArray) -> NDArray[np.float64]:
        """Signal, DN."""
        shifted = light + self.offset
        return np.asarray(shifted * np.polynomial.polynomial.polyval(shifted, self.terms))

    def gradient(self, light: NDArray) -> NDArray[np.float64]:
        """Derivatives [4, light] by offset and terms."""
        shifted = np.asarray(light, np.float64) + self.offset
        b = self.terms
        slope = b[0] + 2 * b[1] * shifted + 3 * b[2] * shifted**2
        return np.stack([slope, shifted, shifted**2, shifted**3])

    def error(self, light: NDArray) -> NDArray[np.float64]:
        """Standard error of the curve, DN."""
        g = self.gradient(light)
        return np.sqrt(np.einsum("il,ij,jl->l", g, self.covariance, g))

    def nonlinearity(self, responsivity: float, full_scale_dn: float) -> list[float]:
        """n₀, n₁, n₂ of f(E) = E (1 + n₀ + n₁ u + n₂ u²), u = E/full scale, E = responsivity · H'."""
        scale = full_scale_dn / responsivity
        return [float(self.terms[k] * scale**k / responsivity) - (k == 0) for k in range(3)]


def mean_curve(light: NDArray, signal: NDArray, error_dn: NDArray) -> MeanCurve:
    """The curve with the fewest terms that the levels need.

    The light scatters by an unknown relative amount from exposure to exposure, the signal by `error_dn` besides. A term
    is kept if the residuals fall more than chance lets them (F test at `ALARM`).
    """
    scale = float(light.max())
    # light from 0 to 1, so that all terms are of one size
    h = light / scale
    relative = 1e-4
    free = np.array([False, True, False, False])
    for _ in range(3):
        # the scatter of the light is found with the curve, in three rounds
        weight = 1 / np.hypot(error_dn, relative * signal)
        free = np.array([False, True, False, False])
        best, squares = _fit(h, signal, weight, free)
        # a bend is tested before an offset, and both at once: one alone may hide the other
        for more in ([2], [0], [0, 2], [3], [0, 3], [2, 3]):
            trial = free.copy()
            trial[more] = True
            added = int(trial.sum() - free.sum())
            dof = h.size - int(trial.sum())
            if added == 0 or dof < 2:
                continue
            result, less = _fit(h, signal, weight, trial)
            ratio = (squares - less) / added / max(less / dof, 1e-300)
            if f_law.sf(ratio, added, dof) < ALARM:
                free, best, squares = trial, result, less
        dof = h.size - int(free.sum())
        residual = signal - _value(best, h)
        # levels of little light would decide alone: the scatter of the light is that of the brighter half
        bright = signal >= np.median(signal)
        excess = float(np.mean(residual[bright] ** 2 / signal[bright] ** 2)) * h.size / dof
        excess -= float(np.mean(error_dn[bright] ** 2 / signal[bright] ** 2))
        relative = float(np.sqrt(max(excess, 1e-12)))
    # covariance by the linearised curve, wider where χ² shows misfit
    jacobian = _gradient(best, h)[free] * weight
    covariance = np.zeros((4, 4))
    inside = np.linalg.inv(jacobian @ jacobian.T) * max(squares / dof, 1.0)
    # back to the unit of the light
    units = np.array([scale, 1 / scale, 1 / scale**2, 1 / scale**3])
    covariance[np.ix_(free, free)] = inside
    covariance *= np.outer(units, units)
    values = best * units
    return MeanCurve(float(values[0]), float(np.sqrt(covariance[0, 0])), values[1:], covariance, relative)


def _value(p: NDArray, h: NDArray) -> NDArray[np.float64]:
    shifted = h + p[0]
    return np.asarray(shifted * (p[1] + p[2] * shifted + p[3] * shifted**2))


def _gradient(p: NDArray, h: NDArray) -> NDArray[np.float64]:
    shifted = h + p[0]
    return np.stack([p[1] + 2 * p[2] * shifted + 3 * p[3] * shifted**2, shifted, shifted**2, shifted**3])


def _fit(h: NDArray, y: NDArray, weight: NDArray, free: NDArray) -> tuple[NDArray[np.float64], float]:
    """Parameters (offset, b₁, b₂, b₃) and the weighted sum of squares."""
    p = np.zeros(4)
    # a line through the origin to begin with, then Gauss–Newton steps
    p[1] = float(np.sum(weight**2 * h * y) / np.sum(weight**2 * h * h))
    for _ in range(_STEPS):
        p[free] += np.linalg.lstsq((_gradient(p, h)[free] * weight).T, weight * (y - _value(p, h)), rcond=None)[0]
    return p, float(np.sum((weight * (y - _value(p, h))) ** 2))


def require_steady_light(
    pairs: PairSet, curve: MeanCurve, light: NDArray, signal: NDArray, clear: NDArray[np.bool_]
) -> None:
    """Refuse a level that lies far from the curve of all others: its light was another."""
    expected = curve.at(light)
    deviation = np.where(clear, np.abs(signal / expected - 1), 0.0)
    deviation[signal < 0.02 * signal.max()] = 0.0  # offsets and dark drift weigh more than light there
    k = int(np.argmax(deviation))
    if deviation[k] > MOST_CHANGE:
        raise pairs.lit[k].error(
            f"the light drifts between exposures: this pair is {100 * deviation[k]:.2g} % off the curve of all others"
        )
