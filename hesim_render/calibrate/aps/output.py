"""Output of an APS calibration: its section of ``calibration.yaml``, its maps and the data of the report's figures."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from hesim_render.calibrate.aps.checks import check_frames
from hesim_render.calibrate.aps.common_mode import Shared
from hesim_render.calibrate.aps.composite import signal_at_event_pixels
from hesim_render.calibrate.aps.fitted import ApsCalibration, Position
from hesim_render.calibrate.aps.variance import TERMS, VarianceFit, variance_map
from hesim_render.calibrate.estimate import estimated
from hesim_render.calibrate.moments import FrameMoments
from hesim_render.calibration.rates import TelegraphPerFrame
from hesim_render.pixels.aps.formulas import ADC_VARIANCE_DN2
from hesim_render.recording.capture_set import CaptureSet

_FIGURE_PX = 320
#: Number of points of pooled variances drawn per position, approximately.
_POINTS = 240


def content(
    captures: CaptureSet, result: ApsCalibration, dark_moments: FrameMoments, lit: FrameMoments
) -> dict[str, Any]:
    tile = captures.spec.tile_rows, captures.spec.tile_cols

    def table(value: Callable[[VarianceFit], Any], missing: Any) -> list[list[Any]]:
        return [
            [value(result.fits[i, j]) if (i, j) in result.fits else missing for j in range(tile[1])]
            for i in range(tile[0])
        ]

    nothing = [None] * 6
    notes = []
    for (i, j), fit in result.fits.items():
        missing = [TERMS[k] for k in range(6) if not fit.identified[k]]
        if missing:
            notes.append(f"position ({i}, {j}): the data do not identify the terms {', '.join(missing)}")
        if fit.quantised_pixels:
            notes.append(
                f"position ({i}, {j}): {fit.quantised_pixels} values left out, their noise is hidden by rounding"
            )
    dark, checks = result.dark, check_frames(result, dark_moments, lit)
    stated = {} if captures.frame_rate_hz is None else {"frame_rate_hz": captures.frame_rate_hz}
    return {
        **stated,
        "findings": [finding.described() for finding in checks.findings],
        "terms": list(TERMS),
        "units": "DN (light above black) and seconds; the ADC's 1/12 DN² is taken out",
        "beta": table(lambda f: [b if ok else None for b, ok in zip(f.beta, f.identified, strict=True)], nothing),
        "beta_standard_error": table(
            lambda f: [e if ok else None for e, ok in zip(np.sqrt(np.diag(f.covariance)), f.identified, strict=True)],
            nothing,
        ),
        "goodness": {
            "chi2_per_dof": table(lambda f: f.chi2_per_dof, None),
            "p_value": table(lambda f: f.p_value, None),
            "cubic_per_dn": table(lambda f: None if f.cubic is None else list(f.cubic), None),
            "dof": table(lambda f: f.dof, None),
            "dark_line_chi2_per_dof": dark.chi2_per_dof,
        },
        "range": {
            "exposures_us": lit.exposures_us,
            "signal_dn": _ranges(result, lit, tile),
        },
        "black_dn": dark.black,
        "n_row_std_dn": float(dark.n_row.std()),
        "row_noise_dn": _row_noise(result),
        "n_dp_median_dn_per_s": float(np.median(dark.n_dp[~result.bad & ~dark.bad])),
        "hot_limit_dn_per_s": dark.hot_limit_dn_per_s,
        "hot_pixels": int(dark.hot.sum()),
        "bad_pixels": int(result.bad.sum()),
        "telegraph_pixels": int(result.telegraph.is_telegraph.sum()),
        "drift": {
            "black_dn_rms": {
                name: max((d.black.rms if d.black.significant else 0.0 for d in drifts), default=0.0)
                for name, drifts in (("dark", checks.dark), ("lit", checks.lit))
            },
            "light_rms_rel": max(
                (d.light.rms for d in checks.lit if d.light is not None and d.light.significant), default=0.0
            ),
            "light_from_proportion_rel": {p.exposure_us: p.deviation for p in checks.proportions},
            "black_from_dark_dn": {p.exposure_us: p.shift_dn for p in checks.proportions},
        },
        **result.transfer,
        "notes": notes,
    }


def _row_noise(result: ApsCalibration) -> dict[str, Any]:
    """Temporal row noise; 0 with a limit where it is not significant."""
    rows = result.rows
    if rows.significant:
        return estimated(rows.rms, rows.error / (2 * rows.rms), "DN")
    limit = float(np.sqrt(max(rows.variance, 0.0) + 2 * rows.error))
    return {"value": 0.0, "upper_limit": limit, "unit": "DN", "note": "rows share no more than chance makes them"}


def _ranges(result: ApsCalibration, lit: FrameMoments, tile: tuple[int, int]) -> list[list[Any]]:
    """[lowest, highest] signal of each lit exposure per position: where the polynomial may be used."""

    def ranges(position: Position) -> list[Any]:
        bins = result.bins[position]
        spans = []
        for t in lit.exposures_s:
            x = bins.signal_dn[bins.lit & (bins.exposure_s == t)]
            spans.append([float(x.min()), float(x.max())] if x.size else None)
        return spans

    return [[ranges((i, j)) if (i, j) in result.bins else None for j in range(tile[1])] for i in range(tile[0])]


def maps(
    captures: CaptureSet, result: ApsCalibration, lit: FrameMoments, dark_moments: FrameMoments
) -> dict[str, NDArray]:
    tile = captures.spec.tile_rows, captures.spec.tile_cols
    dark, composite = result.dark, result.composite
    covariance = np.full((*tile, 6, 6), np.nan)
    for position, fit in result.fits.items():
        covariance[position] = fit.covariance
    telegraph, frame_rate_hz = result.telegraph, captures.frame_rate_hz
    counted = TelegraphPerFrame(telegraph.amplitude_dn, telegraph.high_share, telegraph.correlation)
    known = counted if frame_rate_hz is None else counted.per_second(1.0 / frame_rate_hz)
    arrays: dict[str, NDArray] = {
        "n_row": dark.n_row,
        "n_blc": dark.n_blc,
        "n_dp": dark.n_dp,
        "bad_pixels": result.bad,
        "hot_pixels": dark.hot,
        **known.maps(),
        "signal_dn_per_s": composite.rate_dn_per_s,
        "signal_standard_error_dn_per_s": composite.standard_error_dn_per_s,
        "beta_covariance": covariance,
    }
    if captures.sensor is not None and captures.sensor.evs is not None:
        arrays["evs_signal_dn_per_s"], arrays["evs_signal_uneven"] = signal_at_event_pixels(
            composite, captures.sensor, captures.spec.illuminant
        )
    return arrays | _figures(result, lit, dark_moments, tile)


def _figures(
    result: ApsCalibration, lit: FrameMoments, dark: FrameMoments, tile: tuple[int, int]
) -> dict[str, NDArray]:
    """Data of the report's figures, kept small: thinned maps, pooled variances, histograms of single values."""
    beta = result.beta(tile)
    step = max(1, -(-max(lit.mean.shape[1:]) // _FIGURE_PX))
    middle = len(lit.exposures_us) // 2
    figures = {
        "figure_variance_map": lit.variance[middle][::step, ::step],
        "figure_variance_exposure_us": lit.exposures_us[middle],
    }
    points = []
    for (i, j), bins in result.bins.items():
        size = bins.pixels.sum() / _POINTS
        for t, is_lit in sorted({(t, lit_) for t, lit_ in zip(bins.exposure_s, bins.lit, strict=True)}):
            of = np.flatnonzero((bins.exposure_s == t) & (bins.lit == is_lit))
            # equal numbers of pixels per point; the rest at the end joins the previous point, as a few scatter widely
            total = np.cumsum(bins.pixels[of])
            group = np.minimum(np.floor((total - bins.pixels[of]) / size), max(np.floor(total[-1] / size) - 1, 0))
            for g in np.unique(group):
                use = of[group == g]
                n = bins.pixels[use].sum()
                points.append((i, j, t, is_lit, bins.powers[use, 1].sum() / n, bins.products[use, 0].sum() / n, n))
    figures["figure_variance_points"] = np.array(points)
    for name, moments, signal, mask in (
        ("dark", dark, None, ~(result.bad | result.dark.bad | result.dark.hot)[None] & np.ones(dark.mean.shape, bool)),
        ("lit", lit, result.signals, result.usable & ~result.bad),
    ):
        k = len(moments.exposures_us) - 1
        figures[f"figure_noise_{name}"] = _noise_histogram(
            moments, k, None if signal is None else signal[k], mask[k], beta, result.rows
        )
    return figures


def _noise_histogram(
    moments: FrameMoments, k: int, signal: NDArray | None, mask: NDArray, beta: NDArray, rows: Shared
) -> NDArray[np.float64]:
    """Distribution of single values about their mean: rows of (deviation DN, measured, predicted density)."""
    n = moments.frames
    deviation = (moments.first[k].astype(np.float32) - moments.mean[k])[mask] * np.sqrt(n / (n - 1))
    light = np.zeros(mask.shape, np.float32) if signal is None else signal
    variance = np.maximum(variance_map(beta, light, moments.exposures_s[k])[mask], 0) + ADC_VARIANCE_DN2
    variance += rows.variance if rows.significant else 0.0
    sigma = np.sqrt(np.quantile(variance, (np.arange(200) + 0.5) / 200))
    reach = 5 * float(sigma.max())
    edges = np.linspace(-reach, reach, 2 * min(60, max(12, int(reach))) + 1)
    counts = np.histogram(deviation, edges)[0] / (deviation.size * np.diff(edges))
    predicted = np.diff(ndtr(edges[:, None] / sigma).mean(axis=1)) / np.diff(edges)
    return np.stack([(edges[1:] + edges[:-1]) / 2, counts, predicted], axis=1)
