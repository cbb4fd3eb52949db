"""EVS calibration: from counts of events to A, B, C, D, thresholds and their mismatch."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.aps import describe
from hesim_render.calibrate.captures import CaptureSet, read_captures
from hesim_render.calibrate.event_cells import PixelCounts, PixelThresholds, pool_events
from hesim_render.calibrate.event_counts import StaticCapture, read_static
from hesim_render.calibrate.event_defects import EventDefects, bad_event_pixels, bad_in_steps, classify
from hesim_render.calibrate.event_dispersion import Dispersion, dispersion_in_time, static_mismatch
from hesim_render.calibrate.event_estimate import NO_FIT, EventFit, fit_events, with_mismatch_error
from hesim_render.calibrate.event_model import Law
from hesim_render.calibrate.event_starts import multi_start
from hesim_render.calibrate.moments import Progress
from hesim_render.calibrate.steps import Steps, read_steps
from hesim_render.calibrate.thresholds import Thresholds, fit_thresholds, why_not
from hesim_render.errors import SpecError

#: A difference of log-likelihood that decides between the shot laws; below it the paper's stands.
DECISIVE = 5.0
_LAWS: tuple[Law, Law] = ("linear", "sqrt")


@dataclass(frozen=True)
class EvsCalibration:
    """What the counts tell; `fits` are per tile position, `together` pools them all.

    Attributes
    ----------
    known : each pixel's thresholds as far as they were measured.
    plain : counts of all positions, without that.
    mismatch, mismatch_error, mismatch_limit : the last where the first is 0.
    """

    static: StaticCapture
    defects: EventDefects
    theta_v: float
    known: PixelThresholds
    plain: PixelCounts
    together: EventFit
    fits: list[EventFit]
    other_law: EventFit
    dispersion: Dispersion
    mismatch: float
    mismatch_error: float
    mismatch_limit: float
    thresholds: Thresholds | None
    steps: Steps | None
    thresholds_reason: str
    starts: NDArray[np.float64]
    starts_standard_error: NDArray[np.float64]

    @property
    def bad(self) -> NDArray[np.bool_]:
        return self.defects.bad


def calibrate_evs(
    folder: str | Path,
    out: str | Path,
    report: str | Path | None = None,
    progress: Progress | None = None,
    bootstrap: int = 0,
    seed: int = 0,
) -> Path:
    """Calibrate the events of a capture set and write (or update) a ``calibration.yaml``.

    Parameters
    ----------
    folder : capture set with ``capture.yaml``, ``evs_static.npz`` and, for θ, ``evs_steps.npz``.
    out : the calibration; its section ``evs`` is written, others are kept. Where ``evs_static.npz`` has no
        ``signal_dn``, the composite in its section ``aps`` is the signal: frames of the same scene.
    report : HTML file, if one is wanted; it covers every section of `out`.
    progress : called with what is being done and the fraction done.
    bootstrap : number of resamplings of the pixels for a second opinion on the standard errors.
    seed : of the multi-start study and the bootstrap.

    Returns
    -------
    Path of the calibration.

    Raises
    ------
    SpecError
        If the captures cannot be used; the message says what to capture instead.
    OutputError
        If a result cannot be written.
    """
    from hesim_render.calibrate.evs_output import content, maps
    from hesim_render.calibrate.result import write_section

    captures = read_captures(folder)
    tell = progress or (lambda what, fraction: None)
    tell("reading event counts", 0.0)
    static = read_static(captures, out)
    result = analyse(captures, static, seed, tell)
    errors = bootstrap_errors(result, bootstrap, seed) if bootstrap else None
    tell("writing", 0.95)
    write_section(out, "evs", describe(captures), content(captures, result, errors), maps(result))
    if report is not None:
        from hesim_render.calibrate.report import write_report

        write_report(out, report)
    tell("done", 1.0)
    return Path(out)


def analyse(
    captures: CaptureSet, static: StaticCapture, seed: int = 0, progress: Progress | None = None
) -> EvsCalibration:
    """Everything the counts tell.

    Raises
    ------
    SpecError
        As `calibrate_evs`.
    """
    tell = progress or (lambda what, fraction: None)
    theta_v = captures.spec.theta_hardware_v or 1.0
    bad = bad_event_pixels(static)
    good = ~bad
    if good.mean() < 0.5:
        raise SpecError(
            "more than half of the event pixels are outliers; check n_trials and signal_dn", file=captures.folder
        )
    _check_brightness(static, good, captures)
    tell("fitting", 0.2)
    shape = static.signal_dn.shape
    plain = pool_events(static, good, PixelThresholds.unknown(shape, 0.0))
    laws = _fit_laws(plain, theta_v, None)
    steps, thresholds, reason = None, None, "no contrast steps (evs_steps.npz) were captured"
    if captures.has("evs_steps"):
        tell("contrast steps", 0.3)
        steps = read_steps(captures, good)
        thresholds, reason = _measured_thresholds(captures, steps, laws[_likelier(laws)], good)
        more = np.zeros(shape, bool) if thresholds is None else bad_in_steps(steps, thresholds, good)
        if more.any():
            bad, good = bad | more, good & ~more
            steps = read_steps(captures, good)
            plain = pool_events(static, good, PixelThresholds.unknown(shape, 0.0))
            thresholds, reason = _measured_thresholds(captures, steps, laws[_likelier(laws)], good)
    tell("fitting", 0.4)
    if thresholds is None:
        mismatch, error, limit = static_mismatch(plain, laws[_likelier(laws)], theta_v)
    else:
        mismatch, error, limit = thresholds.mismatch, thresholds.mismatch_error, thresholds.mismatch_limit
    pixels = averaged = pool_events(static, good, PixelThresholds.unknown(shape, mismatch))
    if mismatch > 0 or not np.array_equal(plain.signal_dn, averaged.signal_dn):
        laws = _fit_laws(averaged, theta_v, laws)
    law = _likelier(laws)
    fit, known = laws[law], PixelThresholds.unknown(shape, mismatch)
    # the fit needs the thresholds, the contrast in volts needs the fit
    for _ in range(2 if steps is not None and thresholds is not None else 0):
        assert steps is not None
        thresholds, reason = _measured_thresholds(captures, steps, fit, good)
        if thresholds is None:
            break
        mismatch, error, limit = thresholds.mismatch, thresholds.mismatch_error, thresholds.mismatch_limit
        known = thresholds.of_pixels()
        pixels = pool_events(static, good, known)
        fit = fit_events(pixels, theta_v, law, _again(fit))
    _check_fit(fit, captures)
    best = with_mismatch_error(fit, pixels, theta_v, error / mismatch if mismatch else 0.0)
    tell("fitting positions", 0.6)
    fits = [
        fit_events(pool_events(static, good, known, k), theta_v, law, best.parameters, best.free)
        for k in range(static.tile[0] * static.tile[1])
    ]
    if thresholds is not None and steps is not None and captures.spec.contrast_of == "signal":
        thresholds = _with_conversion_error(thresholds, steps.signal_dn, best)
    if thresholds is not None:
        best, *fits = (_with_sampling_error(fit, thresholds, good) for fit in (best, *fits))
    tell("200 starts", 0.8)
    starts, errors = multi_start(averaged, best, theta_v, seed)
    return EvsCalibration(
        static=static,
        defects=classify(static, bad, steps),
        theta_v=theta_v,
        known=known,
        plain=averaged,
        together=best,
        fits=fits,
        other_law=laws["linear" if law == "sqrt" else "sqrt"],
        dispersion=dispersion_in_time(pixels, best, theta_v),
        mismatch=mismatch,
        mismatch_error=error,
        mismatch_limit=limit,
        thresholds=thresholds,
        steps=steps,
        thresholds_reason=reason,
        starts=starts,
        starts_standard_error=errors,
    )


def _measured_thresholds(
    captures: CaptureSet, steps: Steps, fit: EventFit, good: NDArray[np.bool_]
) -> tuple[Thresholds | None, str]:
    """Thresholds from the steps, or why they do not tell them."""
    step = step_in_ln(captures, steps, fit)
    if step is None:
        return None, "contrast is of the signal, and the static data do not tell the A/B that turns it into voltage"
    reason = why_not(steps)
    return (None, reason) if reason else (fit_thresholds(steps, step, good), "")


def _fit_laws(pixels: PixelCounts, theta_v: float, before: dict[Law, EventFit] | None) -> dict[Law, EventFit]:
    """Both shot laws fitted to all positions together, from where a fit `before` ended."""
    starts = {law: _again(fit) for law, fit in (before or {}).items()}
    return {law: fit_events(pixels, theta_v, law, starts.get(law)) for law in _LAWS}


def _again(fit: EventFit) -> NDArray[np.float64]:
    """Where a fit of like data begins; ρ and λ begin at 0: whether they are needed is tested anew."""
    return fit.whole * np.array([1, 1, 1, 1, 0, 0])


def _likelier(laws: dict[Law, EventFit]) -> Law:
    """The sqrt law where it describes the counts decisively better; else the paper's."""
    return "sqrt" if advantage(laws["sqrt"], laws["linear"]) > DECISIVE else "linear"


def advantage(one: EventFit, other: EventFit) -> float:
    """Log-likelihood of one fit above another's, in units of the scatter of the counts."""
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
    """No parameters are given where they mean nothing."""
    if fit.goodness.per_dof > NO_FIT:
        raise SpecError(
            f"neither shot law describes these counts (χ²/dof is {fit.goodness.per_dof:.3g} at best); check that "
            "signal_dn is the clean signal of a scene that stands still, and that n_trials counts every tick",
            file=captures.folder / "evs_static.npz",
        )


def _with_sampling_error(fit: EventFit, thresholds: Thresholds, good: NDArray[np.bool_]) -> EventFit:
    """Adds what the mean of the measured thresholds lacks: they are relative to that of these pixels, not of all such.

    A and B go with the mean of both polarities, ρ with their difference.
    """
    on, off = (values[good].astype(np.float64) for values in (thresholds.pixel_on, thresholds.pixel_off))
    scale = thresholds.mismatch**2 / max((on.var() + off.var()) / 2, 1e-30)  # without the estimates' own noise
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
    """S = ln x₁/x₀ of each contrast; a contrast of the signal needs A/B, None where they are not identified."""
    if captures.spec.contrast_of == "voltage":
        return steps.contrast
    if not (fit.identified("A") and fit.identified("B")):
        return None
    a, b = fit.values[:2]
    return np.log((a * steps.signal_dn * np.exp(steps.contrast) + b) / (a * steps.signal_dn + b))


def bootstrap_errors(result: EvsCalibration, samples: int, seed: int) -> NDArray[np.float64]:
    """Standard errors [4] of A, B, C, D from resampling the pixels (Poisson bootstrap); that of θ is not in them."""
    rng = np.random.default_rng(seed + 1)
    good, fit = ~result.bad, result.together
    values = []
    for _ in range(samples):
        weight = rng.poisson(1.0, good.shape)
        pixels = pool_events(result.static, good & (weight > 0), result.known, None, weight)
        values.append(fit_events(pixels, result.theta_v, fit.law, fit.parameters, fit.free).values[:4])
    return np.std(values, axis=0, ddof=1)
