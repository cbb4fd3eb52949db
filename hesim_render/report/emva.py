"""EMVA 1288 figures of frames, from the standard's captures [emva2021]."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hesim_render.calibrate.aps.pairs import PairCalibration, evaluate
from hesim_render.calibrate.aps.pairs_findings import findings
from hesim_render.calibrate.aps.pairs_output import content
from hesim_render.calibrate.estimate import estimated, not_identifiable
from hesim_render.calibrate.recordings.still import share
from hesim_render.recording.pair_set import read_pair_set
from hesim_render.report.estimates import figure


@dataclass(frozen=True, eq=False)
class FrameFigures:
    """What EMVA 1288 captures tell.

    Parameters
    ----------
    result : the evaluation.
    entries : by name, as entries of the report.
    findings : what the sensor or the bench has beyond a linear model.
    """

    result: PairCalibration
    entries: dict[str, dict[str, Any]]
    findings: list[str]

    @property
    def pixels(self) -> int:
        rows, cols = self.result.pairs.shape
        return rows * cols

    @property
    def lights(self) -> dict[str, str]:
        """The light that each figure was measured in."""
        result = self.result
        has_photons = result.pairs.has_photons
        scale, unit = (1.0, "photons") if has_photons else (1e3, "ms")

        def between(part: float, to: float) -> str:
            top = result.top_dn
            used = result.light[result.clear & (result.signal >= part * top) & (result.signal <= to * top)] * scale
            return f"{figure(used.min(), 3)} to {figure(used.max(), 3)} {unit}" if used.size else ""

        fitted, most = between(0.0, 0.7), f"up to {figure(result.light.max() * scale, 3)} {unit}"
        long = result.pairs.spatial_lit
        light = (long.photons or 0.0) if has_photons else 1e3 * long.exposure_s
        series = f"{figure(light, 3)} {unit}, and dark"
        return {
            "K": fitted, "responsivity": fitted, "quantum_efficiency": fitted, "full_well_e": most, "snr_max": most,
            "dynamic_range": f"{most}, and dark", "threshold_photons": f"{fitted}, and dark",
            "threshold_e": f"{fitted}, and dark", "prnu_percent": series, "defect_pixels": series,
            "linearity_error_percent": between(0.05, 0.95),
            **dict.fromkeys(
                ("temporal_dark_noise_e", "dark_current_e_per_s", "dsnu_e", "row_noise_dn", "column_noise_dn"), "dark"
            ),
        }  # fmt: skip


def frame_figures(folder: str | Path) -> FrameFigures:
    """Evaluate EMVA 1288 captures."""
    result = evaluate(read_pair_set(folder))
    section = content(result)
    names = (
        "K", "responsivity", "quantum_efficiency", "temporal_dark_noise_e", "dark_current_e_per_s", "full_well_e",
        "dsnu_e", "prnu_percent", "linearity_error_percent", "row_noise_dn", "column_noise_dn",
    )  # fmt: skip
    entries = {name: section[name] for name in names}
    entries |= _of_both(entries, result)
    entries["defect_pixels"] = share(int(section["bad_pixels"]), result.defects.size)
    return FrameFigures(result, entries, [one.text for one in findings(result)])


def _of_both(entries: dict[str, dict[str, Any]], result: PairCalibration) -> dict[str, dict[str, Any]]:
    """Signal-to-noise ratio, sensitivity threshold and dynamic range, from the other figures."""
    well, noise, efficiency, k = (
        entries[name] for name in ("full_well_e", "temporal_dark_noise_e", "quantum_efficiency", "K")
    )
    outcome: dict[str, dict[str, Any]] = {}
    if well["value"] is None:
        outcome["snr_max"] = not_identifiable(well["reason"])
    else:
        ratio = well["standard_error"] / well["value"]
        outcome["snr_max"] = estimated(10 * np.log10(well["value"]), 10 / np.log(10) * ratio, "dB")
    if noise["value"] is None:
        unknown = not_identifiable(f"the dark noise is not known: {noise['reason']}")
        return outcome | dict.fromkeys(("threshold_e", "threshold_photons", "dynamic_range"), unknown)
    # σ_d of the standard has the ADC in it: σ_d² of ours and σ_q²/K²
    dark = float(np.hypot(noise["value"], np.sqrt(1 / 12) / k["value"]))
    error = noise["value"] / dark * noise["standard_error"]
    outcome["threshold_e"] = estimated(dark + 0.5, error, "e-")
    if efficiency["value"] is None:
        outcome["threshold_photons"] = not_identifiable(efficiency["reason"])
    else:
        photons = (dark + 0.5) / efficiency["value"]
        relative = float(np.hypot(error / (dark + 0.5), efficiency["standard_error"] / efficiency["value"]))
        outcome["threshold_photons"] = estimated(photons, photons * relative, "photons")
    if well["value"] is None:
        outcome["dynamic_range"] = not_identifiable(well["reason"])
    else:
        relative = float(np.hypot(error / (dark + 0.5), ratio))
        outcome["dynamic_range"] = estimated(
            20 * np.log10(well["value"] / (dark + 0.5)), 20 / np.log(10) * relative, "dB"
        )
    return outcome
