"""EVS calibration: from counts of events to A, B, C, D, thresholds and their mismatch."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.aps import describe
from hesim_render.calibrate.captures import CaptureSet, read_captures
from hesim_render.calibrate.event_counts import StaticCapture, bad_event_pixels, read_static
from hesim_render.calibrate.event_dispersion import Dispersion, dispersion
from hesim_render.calibrate.event_estimate import NO_FIT, EventFit, fit_events, with_mismatch_error
from hesim_render.calibrate.event_model import (
    Law,
    threshold_over_noise,
)
from hesim_render.calibrate.event_pool import PooledEvents, pool_events
from hesim_render.calibrate.event_starts import multi_start
from hesim_render.calibrate.moments import Progress
from hesim_render.calibrate.thresholds import (
    Steps,
    Thresholds,
    fit_thresholds,
    groups_of_like_threshold,
    read_steps,
    why_not,
)
from hesim_render.errors import SpecError

#: A difference of log-likelihood that decides between the shot laws; below it the paper's stands.
DECISIVE = 5.0
_LAWS: tuple[Law, Law] = ("linear", "sqrt")


@dataclass(frozen=True)
class EvsCalibration:
    """What the counts tell; `fits` are per tile position, `together` pools them all.

    `group`, `relative` and `residual` are as of `groups_of_like_threshold`; None and the mismatch without S-curves.
    """

    static: StaticCapture
    bad: NDArray[np.bool_]
    theta_v: float
    pooled: PooledEvents
    together: EventFit
    fits: list[EventFit]
    other_law: EventFit
    spread: Dispersion
    mismatch: float
    mismatch_error: float
    group: NDArray[np.intp] | None
    relative: NDArray[np.float64] | None
    residual: float
    thresholds: Thresholds | None
    steps: Steps | None
    thresholds_reason: str
    starts: NDArray[np.float64]
    starts_standard_error: NDArray[np.float64]


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
    pooled = pool_events(static, good)
    _check_brightness(static, good, captures)
    tell("fitting", 0.3)
    laws = _fit_laws(pooled, theta_v, 0.0, None)
    spread = _spread(pooled, theta_v, 0.0, laws)
    if spread.mismatch > 0:
        laws = _fit_laws(pooled, theta_v, spread.mismatch, None, laws)
        spread = _spread(pooled, theta_v, spread.mismatch, laws)
    steps = read_steps(captures, good) if captures.has("evs_steps") else None
    reason = "no contrast steps (evs_steps.npz) were captured" if steps is None else why_not(steps) or ""
    mismatch, mismatch_error = spread.mismatch, float(np.sqrt(max(spread.common_error, spread.difference_error)))
    thresholds = None
    # What the fits of A … D see: all pixels of a brightness together, or apart by threshold where it was measured.
    sorted_pool, residual, residual_error, group, relative = pooled, mismatch, mismatch_error, None, None
    for _ in range(2):
        # The fit needs the mismatch, the contrast in volts needs the fit.
        laws = _fit_laws(sorted_pool, theta_v, residual, spread, laws)
        law: Law = "sqrt" if _advantage(laws, spread) > DECISIVE else "linear"
        if steps is not None and not reason:
            step = step_in_ln(captures, steps, laws[law])
            if step is None:
                reason = "contrast is of the signal, and the static data do not tell the A/B that turns it into voltage"
                break
            thresholds = fit_thresholds(steps, step, good)
            residual, residual_error = mismatch, mismatch_error = thresholds.mismatch, thresholds.mismatch_error
            if mismatch > 0:
                spread = _spread(pooled, theta_v, mismatch, _fit_laws(pooled, theta_v, mismatch, None, laws))
                group, relative, residual = groups_of_like_threshold(thresholds, good)
                sorted_pool = pool_events(static, good, None, group, relative)
                residual_error = mismatch_error * residual / mismatch
    laws = _fit_laws(sorted_pool, theta_v, residual, spread, laws)
    _check_fit(laws[law], captures)
    best = with_mismatch_error(laws[law], sorted_pool.together(), theta_v, residual, residual_error, spread)
    tell("fitting positions", 0.6)
    fits = [
        fit_events(sorted_pool.position(k), theta_v, law, residual, spread, best.parameters, best.free)
        for k in range(len(pooled.pixels))
    ]
    if thresholds is not None and steps is not None and captures.spec.contrast_of == "signal":
        thresholds = _with_conversion_error(thresholds, steps.signal_dn, best)
    if group is not None and relative is not None:
        sampling = float(relative[group[good]].std() / np.sqrt(good.sum()))
        best, *fits = (_with_sampling_error(fit, sampling) for fit in (best, *fits))
    tell("200 starts", 0.8)
    starts, errors = multi_start(pooled.together(), best, theta_v, mismatch, seed)
    return EvsCalibration(
        static=static,
        bad=bad,
        theta_v=theta_v,
        pooled=pooled,
        together=best,
        fits=fits,
        other_law=laws["linear" if law == "sqrt" else "sqrt"],
        spread=spread,
        mismatch=mismatch,
        mismatch_error=mismatch_error,
        group=group,
        relative=relative,
        residual=residual,
        thresholds=thresholds,
        steps=steps,
        thresholds_reason=reason,
        starts=starts,
        starts_standard_error=errors,
    )


def _fit_laws(
    pooled: PooledEvents,
    theta_v: float,
    mismatch: float,
    spread: Dispersion | None,
    before: dict[Law, EventFit] | None = None,
) -> dict[Law, EventFit]:
    """Both shot laws fitted to all positions together, from where a fit `before` ended if it kept A to D."""
    # ρ and λ begin at 0: whether they are needed is tested anew
    symmetric = np.array([1, 1, 1, 1, 0, 0])
    starts = {law: fit.parameters * symmetric for law, fit in (before or {}).items() if all(fit.free[:4])}
    return {law: fit_events(pooled.together(), theta_v, law, mismatch, spread, starts.get(law)) for law in _LAWS}


def _spread(pooled: PooledEvents, theta_v: float, mismatch: float, laws: dict[Law, EventFit]) -> Dispersion:
    """Over-dispersion of the counts about the law that describes them better."""
    fit = max(laws.values(), key=lambda fit: fit.log_likelihood)
    u, _ = threshold_over_noise(fit.parameters, pooled.counts.signal_dn, theta_v, fit.law)
    return dispersion(pooled, u, mismatch)


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
    if fit.pearson_chi2 > NO_FIT * fit.dof:
        raise SpecError(
            f"neither shot law describes these counts (χ²/dof is {fit.pearson_chi2 / fit.dof:.3g} at best); check that "
            "signal_dn is the clean signal of a scene that stands still, and that n_trials counts every tick",
            file=captures.folder / "evs_static.npz",
        )


def _with_sampling_error(fit: EventFit, relative: float) -> EventFit:
    """Adds what the mean of the measured thresholds lacks: relative to that of these pixels, not of all such."""
    change = np.zeros(6)
    change[:2] = fit.values[:2] * relative
    change = np.where(fit.free, change, 0.0)
    return replace(fit, covariance=fit.covariance + np.outer(change, change))


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


def _advantage(laws: dict[Law, EventFit], spread: Dispersion) -> float:
    """Log-likelihood of the sqrt law above the linear one, in units of the scatter of the counts."""
    dispersed = max(
        laws["linear"].pearson_chi2 / max(laws["linear"].dof, 1),
        laws["sqrt"].pearson_chi2 / max(laws["sqrt"].dof, 1),
        1.0,
    )
    return (laws["sqrt"].log_likelihood - laws["linear"].log_likelihood) / min(dispersed, 20.0)


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
        pooled = pool_events(result.static, good, weight, result.group, result.relative).together()
        again = fit_events(pooled, result.theta_v, fit.law, result.residual, result.spread, fit.parameters, fit.free)
        values.append(again.values[:4])
    return np.std(values, axis=0, ddof=1)
