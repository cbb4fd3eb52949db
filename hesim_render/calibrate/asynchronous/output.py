"""Output of the calibration of an asynchronous sensor: its section of ``calibration.yaml``, maps and figures."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.asynchronous.analysis import DECISIVE, AsynchronousCalibration
from hesim_render.calibrate.asynchronous.fit import Fit
from hesim_render.calibrate.asynchronous.likelihood import (
    DARK,
    LEAK,
    NAMES,
    RESPONSE,
    SHOT,
    chances,
    noise_of,
    step_of,
)  # fmt: skip
from hesim_render.calibrate.asynchronous.trials import Trials
from hesim_render.calibrate.estimate import estimated, not_identifiable
from hesim_render.calibration.rates import EventDefectRates
from hesim_render.calibration.spec import Defect

_MODEL = (
    "first event after a reset: S = ln((1 + r I1)/(1 + r I0)), sigma^2 = (beta3^2 I^p + beta4^2)/(1 + r I)^2, "
    "r = beta1 in the gauge beta2 = 1 V, p = 1 (sqrt) or 2 (linear); noise through two equal poles at the cut-off; "
    "thresholds normal over the pixels; leak a Poisson process"
)
_NO_LEAK = "no event that only leak explains: the model without it is kept"


def content(result: AsynchronousCalibration) -> dict[str, Any]:
    """The section ``evs``; a parameter that the data do not determine is null, with the reason."""
    fit = result.fit
    theta = estimated(
        (fit.value("theta_on") + fit.value("theta_off")) / 2,
        float(np.sqrt(fit.covariance[:2, :2].sum())) / 2, "ln",
    )  # fmt: skip
    all_ = result.goodness["all"]
    beta, error = _beta(fit)
    return {
        "reference": "last_event",
        "findings": [finding.described() for finding in result.findings],
        "model": _MODEL,
        "shot_law": fit.law,
        "shot_law_decisive": bool(abs(result.advantage) > DECISIVE),
        "shot_law_advantage": result.advantage,
        "theta": theta,
        "theta_on": estimated(fit.value("theta_on"), fit.error("theta_on"), "ln"),
        "theta_off": estimated(fit.value("theta_off"), fit.error("theta_off"), "ln"),
        "threshold_mismatch_rel": result.mismatch.described() | {"from": "trials after a reset"},
        "threshold_mismatch_on_rel": estimated(fit.value("mismatch_on"), fit.error("mismatch_on"), "relative std"),
        "threshold_mismatch_off_rel": estimated(fit.value("mismatch_off"), fit.error("mismatch_off"), "relative std"),
        "noise_cutoff_hz": estimated(fit.value("cutoff_hz"), fit.error("cutoff_hz"), "Hz"),
        "leak_rate_hz": estimated(fit.value("leak_hz"), fit.error("leak_hz"), "Hz, ON events")
        if fit.free[LEAK]
        else {"value": 0.0, "note": _NO_LEAK},
        "noise": [
            {"signal_dn": float(light), **_noise(fit, float(light))}
            for light in np.unique(np.concatenate([result.steady.signal_dn, result.steps.signal_dn]))
        ],
        "gauge": "beta2 = 1 V; beta0 = theta/V; beta5, the correlation of shot and dark noise, is taken to be 0",
        "beta": [beta],
        "beta_standard_error": [error],
        "goodness": {
            "chi2_per_dof": all_.chi2 / max(all_.dof, 1),
            "dof": all_.dof,
            "p_value": all_.p_value,
            **{f"{name}_p_value": g.p_value for name, g in result.goodness.items() if name != "all"},
        },
        "fitted_pixels": int(result.fitted.size),
        "bad_pixels": int(result.defects.bad.sum()),
        "defects": {kind.name.lower(): int(np.sum(result.defects.kind == kind)) for kind in Defect if kind},
    }


def _beta(fit: Fit) -> tuple[list[float | None], list[float | None]]:
    """(β0 … β5) and standard errors, in the gauge β2 = 1 V."""
    error = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    theta = (fit.value("theta_on") + fit.value("theta_off")) / 2
    values: list[float | None] = [theta, fit.values[RESPONSE], 1.0, 0.0, 0.0, 0.0]
    errors: list[float | None] = [
        float(np.sqrt(fit.covariance[:2, :2].sum())) / 2,
        error[RESPONSE],
        0.0,
        None,
        None,
        None,
    ]
    for place, k in ((3, SHOT), (4, DARK)):
        if fit.free[k]:
            root = float(np.sqrt(fit.values[k]))
            values[place], errors[place] = root, error[k] / (2 * root)
    return values, errors


def _noise(fit: Fit, signal_dn: float) -> dict[str, Any]:
    """σ of ln x in a light of `signal_dn`, DN, with its error by the delta method."""
    light = np.array([signal_dn])
    value = float(noise_of(fit.values, light, fit.law)[0])
    slope = np.zeros(len(NAMES))
    for k in (RESPONSE, SHOT, DARK):
        there = fit.values.copy()
        there[k] *= 1 + 1e-4
        slope[k] = (float(noise_of(there, light, fit.law)[0]) - value) / max(1e-4 * fit.values[k], 1e-300)
    some = fit.free & (slope != 0)
    variance = slope[some] @ fit.covariance[np.ix_(some, some)] @ slope[some]
    if not variance > 0:
        return not_identifiable("the trials do not determine it")
    return estimated(value, float(np.sqrt(variance)), "ln")


def maps(result: AsynchronousCalibration) -> dict[str, NDArray]:
    """Map files of the section, and small arrays for the report (their names start with ``figure_``)."""
    shape, defects = result.steps.shape, result.defects
    rates = EventDefectRates(defects.kind, defects.on_hz, defects.off_hz, defects.firing_share, defects.change_hz)
    arrays: dict[str, NDArray] = {
        "bad_pixels": defects.bad, **rates.maps(),
        "threshold_on_rel": result.relative[0], "threshold_off_rel": result.relative[1],
        "threshold_on_noise": result.noise[0], "threshold_off_noise": result.noise[1],
    }  # fmt: skip
    good = ~defects.bad
    figures = _figures(result.fit, result.steady.of(good), result.steps.of(good))
    return {name: values.reshape(shape) for name, values in arrays.items()} | figures


def _figures(fit: Fit, steady: Trials, steps: Trials) -> dict[str, NDArray]:
    """Rows of counts and of the numbers expected by the fit.

    ``figure_s_curves``: polarity, light, S, time bin, events, trials, chance by the fit, for the steps towards each
    polarity. ``figure_noise_rate``: light, ON and OFF events, seconds, and the two rates by the fit.
    """
    rows, rates = [], [np.array(steady.signal_dn)]
    for k, polarity in enumerate((1, -1)):
        grid, weight = fit.likelihood.grids[k], fit.law_of_thresholds(k)
        there = steps.towards(polarity)
        mean = np.cumsum(chances(fit.values, there, polarity, grid, fit.law) @ weight, axis=1)
        trials = there.calm.sum(axis=1, dtype=np.float64)
        events = np.cumsum(there.events(polarity).sum(axis=2, dtype=np.float64), axis=1)
        for j in range(mean.shape[1]):
            rows.append(
                np.stack(
                    [
                        np.full(trials.size, polarity), there.signal_dn, step_of(fit.values, there),
                        np.full(trials.size, j), events[:, j], trials, mean[:, j],
                    ],
                    axis=1,
                )
            )  # fmt: skip
        rates.append(steady.events(polarity).sum(axis=(1, 2), dtype=np.float64))
    duration = steady.calm.sum(axis=1, dtype=np.float64) * steady.edges_s[-1]
    rates.append(duration)
    for k, polarity in enumerate((1, -1)):
        grid, weight = fit.likelihood.grids[k], fit.law_of_thresholds(k)
        mean = chances(fit.values, steady, polarity, grid, fit.law).sum(axis=1) @ weight
        rates.append(mean / steady.edges_s[-1])
    return {"figure_s_curves": np.concatenate(rows), "figure_noise_rate": np.stack(rates, axis=1)}
