"""The main parameters of a calibration in a few lines of text."""

from collections.abc import Mapping
from typing import Any

_APS = {
    "K": "K, system gain",
    "read_noise_e": "read noise",
    "dark_current_e_per_s": "dark current",
    "full_well_e": "saturation capacity",
    "dsnu_e": "DSNU",
    "prnu_percent": "PRNU",
    "linearity_error_percent": "linearity error",
    "row_noise_dn": "temporal row noise",
    "column_noise_dn": "temporal column noise",
    "quantum_efficiency": "quantum efficiency",
}
_EVS = {
    **{name: name for name in "ABCD"},
    "theta_on": "θ₊",
    "theta_off": "θ₋",
    "threshold_mismatch_rel": "threshold mismatch",
    "leak_per_trial": "leak per trial",
    "leak_rate_hz": "leak",
    "noise_cutoff_hz": "noise bandwidth",
}


def summary_lines(calibration: Mapping[str, Any], section: str) -> list[str]:
    """One line a parameter, with its 95 % interval or the reason why it is not known, and the truth where it is known.

    Parameters
    ----------
    calibration : from `read_calibration`.
    section : ``aps`` or ``evs``.
    """
    content = calibration[section]
    names = _APS if section == "aps" else _EVS
    truth = (calibration.get("capture", {}).get("truth") or {}).get(section, {})
    lines = [
        "; ".join(filter(None, (_line(text, content[key]), beside(content[key], truth.get(key)))))
        for key, text in names.items()
        if key in content
    ]
    lines += [_line(f"noise at {item['signal_dn']:.4g} DN", item) for item in content.get("noise", [])]
    if section == "aps":
        values = [c for row in content["goodness"]["chi2_per_dof"] for c in row if c is not None]
        lines.append(f"{'β, χ²/dof':<20} {min(values):.3f} to {max(values):.3f} over {len(values)} tile positions")
    else:
        lines.append(f"{'shot law':<20} {content['shot_law']}; χ²/dof {content['goodness']['chi2_per_dof']:.3f}")
    kinds = ", ".join(f"{count} {kind}" for kind, count in (content.get("defects") or {}).items())
    lines.append(f"{'bad pixels':<20} {content['bad_pixels']}" + (f" ({kinds})" if kinds else ""))
    if content.get("telegraph_pixels") is not None:
        lines.append(f"{'telegraph pixels':<20} {content['telegraph_pixels']}")
    return lines + [f"look at: {finding['check']}: {finding['text']}" for finding in content.get("findings", [])]


def _line(text: str, item: Mapping[str, Any]) -> str:
    if item["value"] is None:
        return f"{text:<20} not identifiable: {item['reason']}"
    interval = item.get("interval_95")
    between = f" ({interval[0]:.5g} to {interval[1]:.5g})" if interval else ""
    value = f"{text:<20} {item['value']:.5g}{between} {item.get('unit', '')}".rstrip()
    return f"{value}; {item['note']}" if item.get("note") else value


def beside(item: Mapping[str, Any], truth: float | None) -> str:
    """The truth for a place beside an estimate; one of twenty lies outside of a 95 % interval."""
    if truth is None:
        return ""
    interval = item.get("interval_95")
    is_outside = interval is not None and not interval[0] <= truth <= interval[1]
    return f"truth {truth:.5g}{' (outside)' if is_outside else ''}"
