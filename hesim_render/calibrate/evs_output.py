"""What an EVS calibration writes: the section of ``calibration.yaml``, its maps and what the report draws."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from hesim_render.calibrate.captures import CaptureSet
from hesim_render.calibrate.estimate import estimated, not_identifiable
from hesim_render.calibrate.event_estimate import EventFit
from hesim_render.calibrate.event_model import probabilities
from hesim_render.calibrate.evs import DECISIVE, EvsCalibration

_FIGURE_PX = 320
_UNITS = {"A": "1/(V DN)", "B": "1/V", "C": "1/DN", "D": ""}
_MODEL = (
    "theta/sigma_n = Theta (A I + B) / sqrt(2 (1 + 2 D y + y^2)), y = C I (linear) or C sqrt(I) (sqrt); "
    "P = Q(theta/sigma_n), over the thresholds' mismatch"
)


def content(captures: CaptureSet, result: EvsCalibration, bootstrap: NDArray | None) -> dict[str, Any]:
    """The section ``evs``; a parameter the data do not tell is null, with its reason."""
    fit, other, spread, thresholds = result.together, result.other_law, result.spread, result.thresholds
    tile = result.static.tile
    theta = not_identifiable(result.thresholds_reason)
    section: dict[str, Any] = {
        "model": _MODEL,
        "theta_hardware_v": captures.spec.theta_hardware_v
        or not_identifiable("not stated in capture.yaml; 1 V is taken as its unit"),
        "shot_law": fit.law,
        "shot_law_log_likelihood": {
            fit.law: fit.log_likelihood,
            other.law: other.log_likelihood,
            "decisive": bool(abs(fit.log_likelihood - other.log_likelihood) > DECISIVE and fit.identified("C")),
        },
        **_parameters(fit),
        "positions": [
            {"tile_position": list(divmod(k, tile[1])), **_parameters(one)} for k, one in enumerate(result.fits)
        ],
        **_gauge(result),
    }
    if thresholds is None:
        section |= {"theta": theta, "theta_on": theta, "theta_off": theta}
    else:
        error = np.sqrt(np.diag(thresholds.covariance))
        section |= {
            "theta": estimated(thresholds.theta, thresholds.theta_error, "ln"),
            "theta_on": estimated(thresholds.theta_on, error[0], "ln"),
            "theta_off": estimated(thresholds.theta_off, error[1], "ln"),
            "step_chi2_per_dof": thresholds.chi2_per_dof,
        }
    section["threshold_mismatch"] = _mismatch(result)
    rho, leak = fit.values[4:]
    error = np.sqrt(np.maximum(np.diag(fit.covariance), 0))
    absent = "not significant (likelihood ratio at 1e-3): the model without it is kept"
    section["asymmetry"] = estimated(rho, error[4]) if fit.free[4] else {"value": 0.0, "note": absent}
    section["leak_per_trial"] = (
        estimated(leak, error[5], "ON events") if fit.free[5] else {"value": 0.0, "note": absent}
    )
    section["dispersion"] = {
        "temporal": estimated(spread.temporal, spread.temporal_error),
        "temporal_difference": estimated(spread.temporal_difference, spread.temporal_difference_error),
        "standard_errors": "binomial" if np.array_equal(fit.covariance, fit.fisher_covariance) else "sandwich",
    }
    section["goodness"] = {
        "chi2_per_dof": fit.pearson_chi2 / max(fit.dof, 1),
        "dof": fit.dof,
        "positions_chi2_per_dof": [one.pearson_chi2 / max(one.dof, 1) for one in result.fits],
    }
    section["signal_range_dn"] = [float(np.nanmin(result.static.signal_dn)), float(np.nanmax(result.static.signal_dn))]
    section["trials"] = result.static.trials
    section["bad_pixels"] = int(result.bad.sum())
    scatter = np.ptp(result.starts, axis=0) / result.starts_standard_error
    section["multi_start"] = {
        "starts": len(result.starts),
        "largest_difference_in_standard_errors": [s if ok else None for s, ok in zip(scatter, fit.free, strict=False)],
    }
    if bootstrap is not None:
        section["bootstrap_standard_error"] = {
            name: e if ok else None for name, e, ok in zip("ABCD", bootstrap, fit.free, strict=False)
        }
    return section


def _parameters(fit: EventFit) -> dict[str, Any]:
    error = np.sqrt(np.maximum(np.diag(fit.covariance), 0))
    return {
        name: estimated(fit.values[k], error[k], _UNITS[name])
        if fit.identified(name)
        else not_identifiable(fit.reasons.get(name, "not told by the data"))
        for k, name in enumerate("ABCD")
    }


def _mismatch(result: EvsCalibration) -> dict[str, Any]:
    if result.mismatch > 0:
        where = "steps" if result.thresholds is not None else "static counts"
        return estimated(result.mismatch, _error_of_mismatch(result), "relative std") | {"from": where}
    limit = float(np.sqrt(4) * _error_of_mismatch(result))
    return {"value": 0.0, "upper_limit": limit, "note": "the pixels scatter no more than counting makes them"}


def _error_of_mismatch(result: EvsCalibration) -> float:
    if result.thresholds is not None or result.mismatch == 0:
        return result.mismatch_error
    return result.mismatch_error**2 / (2 * result.mismatch)


def _gauge(result: EvsCalibration) -> dict[str, Any]:
    """β of each position in a fixed gauge, standard errors by the delta method."""
    known = result.thresholds is not None
    theta0 = result.thresholds.theta / result.theta_v if result.thresholds is not None else 1.0
    theta0_error = result.thresholds.theta_error / result.theta_v if result.thresholds is not None else 0.0
    betas, errors = [], []
    for fit in result.fits:
        a, b, c, d = fit.values[:4]
        jacobian = np.zeros((6, 5))  # rows β0 … β5, columns A, B, C, D, β0
        jacobian[0, 4] = 1.0
        jacobian[1, :2] = 1 / b, -a / b**2
        jacobian[3, [1, 2, 4]] = -c * theta0 / b**2, theta0 / b, c / b
        jacobian[4, [1, 4]] = -theta0 / b**2, 1 / b
        jacobian[5, 3] = 1.0
        covariance = np.zeros((5, 5))
        covariance[:4, :4] = fit.covariance[:4, :4]
        covariance[4, 4] = theta0_error**2
        error = np.sqrt(np.maximum(np.diag(jacobian @ covariance @ jacobian.T), 0))
        a_told, b_told, c_told, d_told = (fit.identified(name) for name in "ABCD")
        told = [True, a_told and b_told, True, c_told and b_told, b_told, d_told]
        values = [theta0, a / b, 1.0, c * theta0 / b, theta0 / b, d]
        betas.append([v if ok else None for v, ok in zip(values, told, strict=True)])
        errors.append([e if ok else None for e, ok in zip(error, told, strict=True)])
    return {
        "gauge": "beta2 = 1 V; beta0 = theta/Theta"
        + ("" if known else " = 1, as theta was not measured: the response to contrast is not calibrated"),
        "beta": betas,
        "beta_standard_error": errors,
    }


def maps(result: EvsCalibration) -> dict[str, NDArray]:
    """Map files of the section, and small arrays for the report (their names start with ``figure_``)."""
    static, fit = result.static, result.together
    arrays: dict[str, NDArray] = {"bad_pixels": result.bad}
    if result.thresholds is not None:
        arrays["threshold_on_relative"] = result.thresholds.pixel_on
        arrays["threshold_off_relative"] = result.thresholds.pixel_off
    step = max(1, -(-max(static.signal_dn.shape) // _FIGURE_PX))
    arrays["figure_probability"] = ((static.n_on + static.n_off) / (2 * static.trials))[::step, ::step].astype(
        np.float32
    )
    together = result.pooled.together()
    used = together.pixels[0] > 0
    c = together.counts
    signal, n = c.signal_dn[0][used], c.trials[0][used]
    arrays["figure_rates"] = np.stack([signal, c.on[0][used] / n, c.off[0][used] / n, n], axis=1)
    top = float(signal.max())
    line = np.unique(np.concatenate([np.linspace(0, top, 150), np.geomspace(1e-4 * top, top, 150)]))
    on, off = probabilities(fit.parameters, line, result.theta_v, fit.law, result.mismatch)
    arrays["figure_rates_fit"] = np.stack([line, on, off], axis=1)
    by_position = result.pooled.counts
    arrays["figure_position_rates"] = np.stack(
        [
            by_position.signal_dn,
            (by_position.on + by_position.off) / np.maximum(2 * by_position.trials, 1),
            by_position.trials,
        ],
        axis=-1,
    )
    arrays["figure_position_fits"] = np.stack(
        [
            np.mean(probabilities(one.parameters, line, result.theta_v, one.law, result.mismatch), axis=0)
            for one in result.fits
        ]
    )
    for name, (_, on_map, off_map) in zip(("lit", "dark"), static.sessions, strict=False):
        top = max(4.0, float(np.quantile(np.maximum(on_map, off_map)[~result.bad], 0.999)) * 1.15)
        edges = np.linspace(-0.5, top, min(64, int(top) + 1) + 1)
        arrays[f"figure_on_off_{name}"] = np.histogram2d(
            off_map[~result.bad], on_map[~result.bad], bins=(edges, edges)
        )[0]
        arrays[f"figure_on_off_{name}_top"] = np.array(top)
    arrays["figure_starts"] = result.starts
    arrays["figure_starts_error"] = result.starts_standard_error
    if result.thresholds is not None and result.steps is not None:
        t, total = result.thresholds, result.steps.pixels * result.steps.trials
        arrays["figure_steps"] = np.stack([t.step, result.steps.on / total, result.steps.off / total], axis=1)
        line = np.linspace(t.step.min(), t.step.max(), 200)
        width = t.width * np.maximum(1 + t.slope * line / t.theta, 0.2)
        arrays["figure_steps_fit"] = np.stack(
            [line, ndtr(-(t.theta_on - line) / width), ndtr(-(t.theta_off + line) / width)], axis=1
        )
    return arrays
