"""Analysis of the event counts of a sensor with fixed comparisons: A, B, C, D, thresholds and their mismatch."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.estimate import Spread
from hesim_render.calibrate.evs.cells import PixelCounts, PixelThresholds, pool_events
from hesim_render.calibrate.evs.counts import StaticCapture
from hesim_render.calibrate.evs.defects import EventDefects, bad_event_pixels, bad_in_steps, classify
from hesim_render.calibrate.evs.dispersion import Dispersion, dispersion_in_time, static_mismatch
from hesim_render.calibrate.evs.fitted import (
    NO_FIT,
    Ends,
    EventFit,
    best_start,
    fit_events,
    multi_start,
    with_mismatch_error,
)
from hesim_render.calibrate.evs.medians import Typical
from hesim_render.calibrate.evs.model import Law, coefficients, from_natural
from hesim_render.calibrate.evs.steps import Steps, read_steps
from hesim_render.calibrate.evs.thresholds import Thresholds, fit_thresholds, why_not
from hesim_render.calibrate.moments import Progress
from hesim_render.core.errors import SpecError
from hesim_render.pixels.evs.formulas import voltage
from hesim_render.recording.capture_set import CaptureSet

#: Difference of log-likelihood that decides between the shot laws; below it the law of the paper is used.
DECISIVE = 5.0
#: Difference of log-likelihood above which the other law is not examined further.
_BEYOND_DOUBT = 500.0
#: ρ and λ of a start are 0: each fit tests again whether they are needed.
_SYMMETRIC = np.array([1, 1, 1, 1, 0, 0])
_LAWS: tuple[Law, Law] = ("linear", "sqrt")


@dataclass(frozen=True)
class EvsCalibration:
    """Results of the counts. `fits` are per tile position, `together` is the fit of all positions.

    Attributes
    ----------
    known : thresholds of each pixel as far as they were measured.
    plain : counts of all positions, without known thresholds.
    advantage : ln L of the shot law minus that of the other, in units of the scatter of the counts.
    mismatch : relative spread of the threshold of one polarity.
    """

    static: StaticCapture
    defects: EventDefects
    theta_v: float
    known: PixelThresholds
    plain: PixelCounts
    together: EventFit
    fits: list[EventFit]
    advantage: float
    dispersion: Dispersion
    mismatch: Spread
    thresholds: Thresholds | None
    steps: Steps | None
    thresholds_reason: str
    ends: Ends

    @property
    def bad(self) -> NDArray[np.bool_]:
        return self.defects.bad


def analyse(
    captures: CaptureSet, static: StaticCapture, seed: int = 0, progress: Progress | None = None
) -> EvsCalibration:
    """Analyse the counts.

    Parameters
    ----------
    captures : capture set.
    static : counts of the static scene.
    seed : seed of the multi-start study.
    progress : called with a text and the fraction done.

    Raises
    ------
    SpecError
        As `calibrate_evs`.
    """
    tell = progress or (lambda what, fraction: None)
    theta_v = captures.spec.theta_hardware_v or 1.0
    # pixels that no threshold explains would outweigh the others by their counts
    bad = bad_event_pixels(static)
    good = ~bad
    if good.mean() < 0.5:
        raise SpecError(
            "more than half of the event pixels are outliers; check n_trials and signal_dn", file=captures.folder
        )
    _check_brightness(static, good, captures)
    tell("fitting", 0.2)
    begun = _Begun.of(static, good, theta_v)
    pixels = pool_events(static, good, PixelThresholds.unknown(good.shape, 0.0))
    laws = {law: fit_events(pixels, theta_v, law, begun.starts[law]) for law in begun.wanted}
    steps = None
    if captures.has("evs_steps"):
        tell("contrast steps", 0.3)
        steps, bad = _steps_and_bad(captures, laws[_likelier(laws)], bad)
        good = ~bad
    tell("fitting", 0.4)
    laws, pixels, state = _with_thresholds(captures, static, good, steps, begun, laws)
    spread, known, thresholds = state.spread, state.known, state.measured
    # means of widely spread counts tell the two laws apart less well than medians do
    law = begun.law if thresholds is None and spread.value > 0 else _likelier(laws)
    fit, others = laws[law], [other for name, other in laws.items() if name != law]
    advantage = _advantage(fit, others[0]) if others else abs(begun.lead)
    _check_fit(fit, captures)
    best = with_mismatch_error(fit, pixels, theta_v, spread.relative_error)
    tell("fitting positions", 0.6)
    # each tile position by itself, from the parameters of all together
    fits = [
        fit_events(pool_events(static, good, known, k), theta_v, law, best.parameters, best.free)
        for k in range(static.tile[0] * static.tile[1])
    ]
    if thresholds is not None and steps is not None and captures.spec.contrast_of == "signal":
        thresholds = _with_conversion_error(thresholds, steps.signal_dn, best)
    if thresholds is not None:
        best, *fits = (_with_sampling_error(fit, thresholds, good) for fit in (best, *fits))
    tell("200 starts", 0.8)
    # many searches from random starts must end where this one did
    averaged = pool_events(static, good, PixelThresholds.unknown(good.shape, spread.value))
    ends = multi_start(averaged if thresholds is None else pixels, best, theta_v, seed)
    return EvsCalibration(
        static=static,
        defects=classify(static, bad, steps),
        theta_v=theta_v,
        known=known,
        plain=averaged,
        together=best,
        fits=fits,
        advantage=advantage,
        dispersion=dispersion_in_time(pixels, best, theta_v),
        mismatch=spread,
        thresholds=thresholds,
        steps=steps,
        thresholds_reason=state.reason,
        ends=ends,
    )


class _Begun(NamedTuple):
    """A fit to medians of the counts, which bad pixels hardly affect: it starts all later ones.

    Parameters
    ----------
    typical : the medians.
    starts : parameters of either shot law.
    lead : ln L of the sqrt law less that of the linear one, in units of the scatter of the counts.
    theta_v : Θ, threshold in V.
    """

    typical: Typical
    starts: dict[Law, NDArray[np.float64]]
    lead: float
    theta_v: float

    @classmethod
    def of(cls, static: StaticCapture, good: NDArray[np.bool_], theta_v: float) -> "_Begun":
        typical = Typical.of(static, good)
        begun = {law: best_start(typical.cells, theta_v, law) for law in _LAWS}
        lead = (begun["sqrt"][1] - begun["linear"][1]) / min(begun["sqrt"][2], begun["linear"][2])
        return cls(typical, {law: parameters for law, (parameters, _, _) in begun.items()}, lead, theta_v)

    @property
    def law(self) -> Law:
        """The law that is nearer to the medians."""
        return "sqrt" if self.lead > DECISIVE else "linear"

    @property
    def wanted(self) -> tuple[Law, ...]:
        """The laws that are fitted: one where the medians leave no doubt."""
        return (self.law,) if abs(self.lead) > _BEYOND_DOUBT else _LAWS


class _KnownThresholds(NamedTuple):
    """Thresholds of the pixels: measured with steps or, without, their spread alone; and why none are measured."""

    spread: Spread
    known: PixelThresholds
    measured: Thresholds | None
    reason: str


def _steps_and_bad(captures: CaptureSet, fit: EventFit, bad: NDArray[np.bool_]) -> tuple[Steps, NDArray[np.bool_]]:
    """The contrast steps of the good pixels, and the bad pixels, now also those that the steps show."""
    steps = read_steps(captures, ~bad)
    result, _ = _measured_thresholds(captures, steps, fit, ~bad)
    more = np.zeros(bad.shape, bool) if result is None else bad_in_steps(steps, result, ~bad)
    if not more.any():
        return steps, bad
    return read_steps(captures, ~(bad | more)), bad | more


def _with_thresholds(
    captures: CaptureSet,
    static: StaticCapture,
    good: NDArray[np.bool_],
    steps: Steps | None,
    begun: _Begun,
    laws: dict[Law, EventFit],
) -> tuple[dict[Law, EventFit], PixelCounts, _KnownThresholds]:
    """Fits with the thresholds of the pixels, these thresholds, and the counts in cells of like threshold.

    The fit needs the thresholds, and the contrast in volts needs the fit: with steps, both are found in turns.
    """
    alone: _KnownThresholds | None = None
    for turn in range(1 if steps is None else 3):
        thresholds, reason = None, "no contrast steps (evs_steps.npz) were captured"
        if steps is not None:
            thresholds, reason = _measured_thresholds(captures, steps, laws[_likelier(laws)], good)
        if thresholds is not None:
            state = _KnownThresholds(thresholds.spread, thresholds.of_pixels(), thresholds, reason)
        else:
            alone = alone or _of_counts(static, good, begun)
            state = alone._replace(reason=reason)
        pixels = pool_events(static, good, state.known)
        if turn < 2:
            laws = {law: fit_events(pixels, begun.theta_v, law, begun.starts[law]) for law in begun.wanted}
        else:
            law = _likelier(laws)
            laws[law] = fit_events(pixels, begun.theta_v, law, laws[law].whole * _SYMMETRIC)
    return laws, pixels, state


def _of_counts(static: StaticCapture, good: NDArray[np.bool_], begun: _Begun) -> _KnownThresholds:
    """The spread of thresholds that the scatter of counts over pixels shows."""
    plain = pool_events(static, good, PixelThresholds.unknown(good.shape, 0.0))
    spread = static_mismatch(plain, begun.typical)
    return _KnownThresholds(spread, PixelThresholds.unknown(good.shape, spread.value), None, "")


def _measured_thresholds(
    captures: CaptureSet, steps: Steps, fit: EventFit, good: NDArray[np.bool_]
) -> tuple[Thresholds | None, str]:
    """Thresholds from the steps, or the reason why the steps do not determine them."""
    step = step_in_ln(captures, steps, fit)
    if step is None:
        return None, "contrast is of the signal, and the static data do not tell the A/B that turns it into voltage"
    reason = why_not(steps)
    return (None, reason) if reason else (fit_thresholds(steps, step, good), "")


def _likelier(laws: dict[Law, EventFit]) -> Law:
    """The sqrt law where it describes the counts decisively better, else the law of the paper."""
    if len(laws) == 1:
        return next(iter(laws))
    return "sqrt" if _advantage(laws["sqrt"], laws["linear"]) > DECISIVE else "linear"


def _advantage(one: EventFit, other: EventFit) -> float:
    """Log-likelihood of one fit minus that of the other, in units of the scatter of the counts."""
    return (one.log_likelihood - other.log_likelihood) / min(max(one.design_effect, other.design_effect), 1e3)


def _check_brightness(static: StaticCapture, good: NDArray[np.bool_], captures: CaptureSet) -> None:
    signal = static.signal_dn[good]
    if np.ptp(signal) <= 1e-6 * max(float(np.abs(signal).max()), 1e-12) and (
        len(static.sessions) == 1 or signal.max() == 0
    ):
        raise SpecError(
            "the static capture holds one brightness and nothing to compare it with; capture a ramp of brightness, "
            "and the dark",
            file=captures.folder / "evs_static.npz",
        )
    for _, on, off in static.sessions:
        if max(on[good].mean(), off[good].mean()) > 0.5 * static.trials:
            raise SpecError(
                "more than half of the trials have an event, beyond the reach of noise alone; raise the threshold",
                file=captures.folder / "evs_static.npz",
            )


def _check_fit(fit: EventFit, captures: CaptureSet) -> None:
    """Refuse a fit whose parameters have no meaning."""
    if fit.goodness.per_dof > NO_FIT:
        raise SpecError(
            f"neither shot law describes these counts (χ²/dof is {fit.goodness.per_dof:.3g} at best); check that "
            "signal_dn is the clean signal of a scene that stands still, and that n_trials counts every tick",
            file=captures.folder / "evs_static.npz",
        )


def _with_sampling_error(fit: EventFit, thresholds: Thresholds, good: NDArray[np.bool_]) -> EventFit:
    """Adds what the mean of the measured thresholds lacks: they are relative to that of these pixels, not of all such.

    A and B depend on the mean of both polarities, ρ on their difference.
    """
    on, off = (values[good].astype(np.float64) for values in (thresholds.pixel_on, thresholds.pixel_off))
    scale = thresholds.spread.value**2 / max((on.var() + off.var()) / 2, 1e-30)  # without the estimates' own noise
    covariance = fit.covariance.copy()
    both, apart = (min(scale, 1.0) * float(np.var((on + sign * off) / 2)) / on.size for sign in (1, -1))
    change = np.where(fit.free, np.array([*fit.values[:2], 0, 0, 0, 0]), 0.0)
    covariance += both * np.outer(change, change)
    covariance[4, 4] += apart if fit.free[4] else 0.0
    return replace(fit, covariance=covariance)


def _with_conversion_error(thresholds: Thresholds, signal_dn: float, fit: EventFit) -> Thresholds:
    """Adds what the error of r = A/B does to θ₊ and θ₋ where contrasts of the signal were turned into voltage.

    S = ln((r I₀ eᶜ + 1)/(r I₀ + 1)) gives ∂S/∂ln r = r I₀ eᶜ/(r I₀ eᶜ + 1) − r I₀/(r I₀ + 1), at S = θ₊ and −θ₋.
    """
    a, b = fit.values[:2]
    relative = fit.covariance[:2, :2] / np.outer([a, b], [a, b])
    variance = relative[0, 0] + relative[1, 1] - 2 * relative[0, 1]
    x0 = a / b * signal_dn + 1
    step = np.array([thresholds.theta_on, -thresholds.theta_off])
    change = np.zeros(4)
    change[:2] = np.array([1, -1]) * (1 / x0 - 1 / (x0 * np.exp(step)))
    return replace(thresholds, covariance=thresholds.covariance + variance * np.outer(change, change))


def step_in_ln(captures: CaptureSet, steps: Steps, fit: EventFit) -> NDArray[np.float64] | None:
    """S = ln x₁/x₀ of each contrast. A contrast of the signal needs A/B; the result is None where A/B is not
    identified.
    """
    if captures.spec.contrast_of == "voltage":
        return steps.contrast
    if not (fit.identified("A") and fit.identified("B")):
        return None
    # the same change of the signal as one of the voltage, whose offset makes it smaller
    k = coefficients(from_natural(fit.values))
    return np.log(voltage(k, steps.signal_dn * np.exp(steps.contrast)) / voltage(k, steps.signal_dn))
