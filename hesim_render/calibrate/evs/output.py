"""Output of an EVS calibration: its section of ``calibration.yaml``, its maps and the data of the report's figures."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.estimate import estimated, not_identifiable
from hesim_render.calibrate.evs.analysis import DECISIVE, EvsCalibration
from hesim_render.calibrate.evs.cells import Cells, PixelThresholds, pool_events
from hesim_render.calibrate.evs.checks import check_events
from hesim_render.calibrate.evs.counts import StaticCapture
from hesim_render.calibrate.evs.fitted import EventFit
from hesim_render.calibrate.evs.model import both_probabilities
from hesim_render.calibrate.evs.steps import GROUPS
from hesim_render.calibrate.evs.thresholds import curve
from hesim_render.calibration.rates import EventDefectsPerTrial, rate_hz
from hesim_render.calibration.spec import Defect
from hesim_render.core.units import US_PER_S
from hesim_render.recording.capture_set import CaptureSet

_FIGURE_PX = 320
#: Most bins of a histogram of counts.
_BINS = 64
_UNITS = {"A": "1/(V DN)", "B": "1/V", "C": "1/DN", "D": ""}
_MODEL = (
    "theta/sigma_n = Theta (A I + B) / sqrt(2 (1 + 2 D y + y^2)), y = C I (linear) or C sqrt(I) (sqrt); "
    "P = Q(theta/sigma_n), over the thresholds' mismatch"
)


def content(captures: CaptureSet, result: EvsCalibration) -> dict[str, Any]:
    """The section ``evs``; a parameter that the data do not determine is null, with the reason."""
    fit, tile = result.together, result.static.tile
    findings, levels = check_events(result, captures.spec.contrast_of)
    section: dict[str, Any] = {
        "findings": [finding.described() for finding in findings],
        "model": _MODEL,
        "theta_hardware_v": captures.spec.theta_hardware_v
        or not_identifiable("not stated in capture.yaml; 1 V is taken as its unit"),
        **_shot_law(result),
        **_parameters(fit),
        "positions": [
            {"tile_position": list(divmod(k, tile[1])), **_parameters(one)} for k, one in enumerate(result.fits)
        ],
        **_gauge(result),
        **_thresholds(result),
    }
    if levels is not None:
        section["s_curve"] = {
            name: estimated(value, error, "events per trial", GROUPS) for name, (value, error) in vars(levels).items()
        }
    section["threshold_mismatch_rel"] = result.mismatch.described() | {
        "from": "static counts" if result.thresholds is None else "steps"
    }
    section |= _asymmetry_and_leak(fit, captures.interval_s)
    section |= {
        "dispersion": _dispersion(result),
        "goodness": {
            "chi2_per_dof": fit.goodness.per_dof,
            "dof": fit.goodness.dof,
            "p_value": fit.goodness.p_value,
            "positions_chi2_per_dof": [one.goodness.per_dof for one in result.fits],
            "positions_p_value": [one.goodness.p_value for one in result.fits],
        },
        "signal_range_dn": [float(np.nanmin(result.static.signal_dn)), float(np.nanmax(result.static.signal_dn))],
        "trials": result.static.trials,
        "bad_pixels": int(result.bad.sum()),
        "defects": {kind.name.lower(): result.defects.count(kind) for kind in Defect if kind is not Defect.NONE},
        "multi_start": _multi_start(result),
    }
    return section


def _shot_law(result: EvsCalibration) -> dict[str, Any]:
    """The law of the shot noise, and how much likelier it is than the other."""
    fit = result.together
    other = "sqrt" if fit.law == "linear" else "linear"
    return {
        "shot_law": fit.law,
        "shot_law_log_likelihood": {
            fit.law: fit.log_likelihood,
            other: fit.log_likelihood - result.advantage,
            "decisive": bool(abs(result.advantage) > DECISIVE and fit.identified("C")),
        },
    }


def _thresholds(result: EvsCalibration) -> dict[str, Any]:
    """Contrast thresholds, which need steps of contrast."""
    thresholds = result.thresholds
    if thresholds is None:
        return dict.fromkeys(("theta", "theta_on", "theta_off"), not_identifiable(result.thresholds_reason))
    error = np.sqrt(np.diag(thresholds.covariance))
    return {
        "theta": estimated(thresholds.theta, thresholds.theta_error, "ln", GROUPS),
        "theta_on": estimated(thresholds.theta_on, error[0], "ln", GROUPS),
        "theta_off": estimated(thresholds.theta_off, error[1], "ln", GROUPS),
    }


def _asymmetry_and_leak(fit: EventFit, interval_s: float | None) -> dict[str, Any]:
    """ρ and λ of a fit, 0 where the counts do not need them; the leak per second where the tick is known."""
    rho, leak = fit.values[4:]
    error = np.sqrt(np.maximum(np.diag(fit.covariance), 0))
    absent = {"value": 0.0, "note": "not significant (likelihood ratio at 1e-3): the model without it is kept"}
    leaks = fit.free[5]
    section: dict[str, Any] = {
        "asymmetry": estimated(rho, error[4]) if fit.free[4] else absent,
        "leak_per_trial": estimated(leak, error[5], "ON events") if leaks else absent,
    }
    if interval_s is not None:
        rate = float(rate_hz(leak, interval_s)), error[5] / (1 - leak) / interval_s
        section["tick_us"] = interval_s * US_PER_S
        section["leak_rate_hz"] = estimated(*rate, "Hz") if leaks else absent
    return section


def _dispersion(result: EvsCalibration) -> dict[str, Any]:
    """Scatter of the counts in time over that of counting, and that over pixels, which widens the errors."""
    spread = result.dispersion
    reason = "hidden behind the mismatch of thresholds, or too few events"
    section: dict[str, Any] = {
        name: estimated(value, error) if np.isfinite(value) else not_identifiable(reason)
        for name, value, error in (
            ("temporal", spread.total, spread.total_error),
            ("temporal_difference", spread.difference, spread.difference_error),
        )
    }
    return section | {"standard_errors": "sandwich", "design_effect": result.together.design_effect}


def _multi_start(result: EvsCalibration) -> dict[str, Any]:
    """Searches from many starts, and how far apart those that describe the counts end."""
    fit, ends = result.together, result.ends
    describes = ends.describe_counts(fit.goodness.per_dof)
    scatter = np.ptp(ends.values[describes], axis=0) / ends.standard_error
    return {
        "starts": describes.size,
        "lost": int(np.sum(~describes)),
        "largest_difference_in_standard_errors": [s if ok else None for s, ok in zip(scatter, fit.free, strict=False)],
    }


def _parameters(fit: EventFit) -> dict[str, Any]:
    error = np.sqrt(np.maximum(np.diag(fit.covariance), 0))
    return {
        name: estimated(fit.values[k], error[k], _UNITS[name])
        if fit.identified(name)
        else not_identifiable(fit.reasons.get(name, "not determined by the data"))
        for k, name in enumerate("ABCD")
    }


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
        is_known = {name: fit.identified(name) for name in "ABCD"}
        identifiable = [
            True, is_known["A"] and is_known["B"], True, is_known["C"] and is_known["B"], is_known["B"], is_known["D"]
        ]  # fmt: skip
        values = [theta0, a / b, 1.0, c * theta0 / b, theta0 / b, d]
        betas.append([v if ok else None for v, ok in zip(values, identifiable, strict=True)])
        errors.append([e if ok else None for e, ok in zip(error, identifiable, strict=True)])
    return {
        "gauge": "beta2 = 1 V; beta0 = theta/Theta"
        + ("" if known else " = 1, as theta was not measured: the response to contrast is not calibrated"),
        "beta": betas,
        "beta_standard_error": errors,
    }


def maps(captures: CaptureSet, result: EvsCalibration) -> dict[str, NDArray]:
    """Map files of the section, and small arrays for the report (their names start with ``figure_``)."""
    defects, static, interval_s = result.defects, result.static, captures.interval_s
    counted = EventDefectsPerTrial(defects.kind, defects.on, defects.off, defects.firing_share, defects.correlation)
    known = counted if interval_s is None else counted.per_second(interval_s)
    arrays = {"bad_pixels": result.bad, **known.maps()}
    if result.thresholds is not None:
        arrays["threshold_on_rel"] = result.thresholds.pixel_on
        arrays["threshold_off_rel"] = result.thresholds.pixel_off
    return arrays | _static_figures(result, static) | _step_figures(result)


def _static_figures(result: EvsCalibration, static: StaticCapture) -> dict[str, NDArray]:
    fit, good = result.together, ~result.bad
    step = max(1, -(-max(static.n_on.shape) // _FIGURE_PX))
    figures: dict[str, NDArray] = {
        "figure_probability": ((static.n_on + static.n_off)[::step, ::step] / (2 * static.trials)).astype(np.float32)
    }
    figures["figure_rates"] = _rates(result.plain.cells)
    top = float(figures["figure_rates"][:, 0].max())
    line = np.unique(np.concatenate([np.linspace(0, top, 150), np.geomspace(1e-4 * top, top, 150)]))
    on, off = both_probabilities(fit.parameters, line, result.theta_v, fit.law, result.mismatch.value)
    figures["figure_rates_fit"] = np.stack([line, on, off], axis=1)
    unknown = PixelThresholds.unknown(good.shape, result.mismatch.value)
    figures["figure_position_rates"] = np.concatenate(
        [
            np.column_stack([np.full(len(rates), k), rates])
            for k in range(len(result.fits))
            for rates in [_rates(pool_events(static, good, unknown, k).cells)]
        ]
    )
    figures["figure_position_fits"] = np.stack(
        [
            np.mean(both_probabilities(one.parameters, line, result.theta_v, one.law, result.mismatch.value), axis=0)
            for one in result.fits
        ]
    )
    for name, (_, on_map, off_map) in zip(("lit", "dark"), static.sessions, strict=False):
        most = max(4, int(np.quantile(np.maximum(on_map, off_map)[good], 0.999) * 1.15))
        # bins of whole counts, so that every bin covers the same number of counts
        wide = -(-(most + 1) // _BINS)
        edges = np.arange(-(-(most + 1) // wide) + 1) * wide - 0.5
        top = float(edges[-1])
        figures[f"figure_on_off_{name}"] = np.histogram2d(off_map[good], on_map[good], bins=(edges, edges))[0]
        figures[f"figure_on_off_{name}_top"] = np.array(top)
    figures["figure_starts"] = result.ends.values[result.ends.describe_counts(result.together.goodness.per_dof)]
    figures["figure_starts_error"] = result.ends.standard_error
    return figures


def _rates(cells: Cells) -> NDArray[np.float64]:
    """Signal, ON and OFF events, and trials of either, of each brightness: rows [cell, 4]."""
    on, off = cells.polarity > 0, cells.polarity < 0
    return np.stack([cells.signal_dn[on], cells.events[on], cells.events[off], cells.total[on]], axis=1)


def _step_figures(result: EvsCalibration) -> dict[str, NDArray]:
    thresholds, steps = result.thresholds, result.steps
    if thresholds is None or steps is None:
        return {}
    events = [counts.sum(axis=1) for counts in (steps.on, steps.off)]
    line = np.linspace(thresholds.step.min(), thresholds.step.max(), 200)
    return {
        "figure_steps": np.stack([thresholds.step, *events], axis=1),
        "figure_steps_trials": np.array(steps.trials_of_all),
        "figure_steps_fit": np.stack(
            [line, curve(thresholds.values, 1.0, line), curve(thresholds.values, -1.0, line)], axis=1
        ),
    }
