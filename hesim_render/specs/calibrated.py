"""A sensor file's own noise, replaced by that of a calibration."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hesim_render.core.errors import SpecError
from hesim_render.core.units import S_PER_US
from hesim_render.specs.calibration import NoiseFile, as_written


def apply_calibration(sensor: dict[str, Any], noise: NoiseFile) -> dict[str, Any]:
    """Replace a sensor file's own noise by the calibrated one, in place, and return the calibration; the file is valid.

    Frames take K, the black level and the variance polynomial (0 where a term is not identified), and what
    is known of read noise, dark current, DSNU, PRNU and full well; their fixed maps are kept by
    `NoiseFile`. Events take the coefficients of each position, thresholds, mismatch, leak and signal reference.

    Raises
    ------
    SpecError
        If the calibration cannot be read, does not fit the sensor, or lacks a parameter that a simulation needs.
    """
    data = noise.read()
    with as_written(noise.path):
        _apply(sensor, noise, data)
    return data


def _apply(sensor: dict[str, Any], noise: NoiseFile, data: Mapping[str, Any]) -> None:
    changed: dict[str, Any] = {}
    tile = ["".join(line.split()) for line in sensor["tile"].strip().splitlines()]
    shape = len(tile), len(tile[0])
    capture = data["capture"]
    if shape != (capture["tile_rows"], capture["tile_cols"]):
        raise SpecError(
            f"is of a sensor with a tile of {capture['tile_rows']}×{capture['tile_cols']}, not {shape[0]}×{shape[1]}",
            file=noise.path,
        )
    for section, values in (("aps", _aps_values), ("evs", _evs_values)):
        if section not in data:
            continue
        if not isinstance(sensor.get(section), dict):
            raise SpecError(f"holds a section {section!r}, but the sensor has none", file=noise.path)
        for key, value in values(sensor, data, noise.path).items():
            sensor[section][key] = value
            changed[f"{section}.{key}"] = value
    for key in changed:
        for group in ("sources", "assumptions"):
            if isinstance(sensor.get(group), dict):
                sensor[group].pop(key, None)
        sensor.setdefault("sources", {})[key] = f"measured: {noise.file}"


def _aps_values(sensor: Mapping[str, Any], data: Mapping[str, Any], file: Path) -> dict[str, Any]:
    aps, capture = data["aps"], data["capture"]
    if sensor["aps"].get("bit_depth") != capture["bit_depth"]:
        raise SpecError(
            f"is of frames of {capture['bit_depth']} bits, the sensor has {sensor['aps'].get('bit_depth')}", file=file
        )
    values = {
        "system_gain_dn_per_e": _needed(aps["K"], "aps.K", file),
        "black_level_dn": aps["black_dn"],
        "row_offset_std_dn": aps["n_row_std_dn"],
        "row_noise_dn": aps.get("row_noise_dn", {}).get("value") or 0.0,
        "beta": [[[b or 0.0 for b in cell] for cell in row] for row in aps["beta"]],
    }
    if aps["full_well_e"].get("limited_by") == "full well":
        values["full_well_e"] = aps["full_well_e"]["value"]
    for key, name, scale in (
        ("read_noise_e", "read_noise_e", 1.0),
        ("dark_current_e_per_s", "dark_current_e_per_s", 1.0),
        ("dsnu_e", "dsnu_e", 1.0),
        ("prnu_rel", "prnu_percent", 0.01),
    ):
        if aps[name]["value"] is not None:
            values[key] = max(0.0, scale * aps[name]["value"])
    return values


def _evs_values(sensor: Mapping[str, Any], data: Mapping[str, Any], file: Path) -> dict[str, Any]:
    """In the gauge of the calibration, β2 = 1 V; θ is the file's own where the calibration could not tell it."""
    evs, own, capture = data["evs"], sensor["evs"], data["capture"]
    if evs.get("reference") == "last_event":
        return _asynchronous_values(sensor, data, file)
    if own.get("reference") != "previous_sample":
        raise SpecError("its events are of fixed comparisons; the sensor needs reference 'previous_sample'", file=file)
    theta_v = evs["theta_hardware_v"]
    theta_v = 1.0 if isinstance(theta_v, Mapping) else float(theta_v)
    measured = evs["theta"]["value"] is not None
    theta = evs["theta"]["value"] if measured else (own["contrast_threshold_on"] + own["contrast_threshold_off"]) / 2
    rho = _asymmetry(evs)
    grid = sensor.get("evs_grid") or {}
    if len(evs["positions"]) != grid.get("rows_per_tile", 0) * grid.get("cols_per_tile", 0):
        raise SpecError(f"has {len(evs['positions'])} event positions, not as many as the sensor", file=file)
    pooled = [_needed(evs[name], f"evs.{name}", file) for name in "AB"] + [evs[name]["value"] or 0.0 for name in "CD"]
    coefficients = []
    for position in evs["positions"]:
        found = [position[name]["value"] for name in "ABCD"]
        a, b, c, d = pooled if any(value is None for value in found) else found
        beta4 = theta / theta_v / b
        coefficients.append({"beta1": a / b, "beta2": 1.0, "beta3": c * beta4, "beta4": beta4, "beta5": d})
    values = {
        "contrast_threshold_on": theta * (1 - rho),
        "contrast_threshold_off": theta * (1 + rho),
        "threshold_mismatch_std": evs["threshold_mismatch"]["value"] or 0.0,
        "coefficients": coefficients,
        "shot_law": evs["shot_law"],
        "leak_rate_hz": -math.log1p(-max(0.0, evs["leak_per_trial"]["value"] or 0.0)) / (own["tick_us"] * S_PER_US),
    }
    if not isinstance(evs["theta_hardware_v"], Mapping):
        values["threshold_hardware_v"] = theta_v
    return values | _signal_reference(capture)


def _asynchronous_values(sensor: Mapping[str, Any], data: Mapping[str, Any], file: Path) -> dict[str, Any]:
    """Of a sensor without fixed comparisons: one set of coefficients for all positions, in the gauge β2 = 1 V."""
    evs = data["evs"]
    if sensor["evs"].get("reference") != "last_event":
        raise SpecError("its events are of an asynchronous sensor; the sensor needs reference 'last_event'", file=file)
    names = ("beta1", "beta2", "beta3", "beta4", "beta5")
    return {
        "contrast_threshold_on": _needed(evs["theta_on"], "evs.theta_on", file),
        "contrast_threshold_off": _needed(evs["theta_off"], "evs.theta_off", file),
        "threshold_mismatch_std": _needed(evs["threshold_mismatch"], "evs.threshold_mismatch", file),
        "coefficients": [dict(zip(names, map(float, evs["beta"][0][1:]), strict=True))],
        "shot_law": evs["shot_law"],
        "leak_rate_hz": max(0.0, _needed(evs["leak_rate_hz"], "evs.leak_rate_hz", file)),
        "photoreceptor_cutoff_hz": _needed(evs["photoreceptor_cutoff_hz"], "evs.photoreceptor_cutoff_hz", file),
    } | _signal_reference(data["capture"])


def _signal_reference(capture: Mapping[str, Any]) -> dict[str, Any]:
    if "signal_reference" not in capture:
        return {}
    reference = capture["signal_reference"]
    return {
        "signal_reference": {
            "k_dn_per_e": reference["k"], "t_ref_us": reference["t_ref_us"], "filter": reference["filter"]
        }
    }  # fmt: skip


def _asymmetry(evs: Mapping[str, Any]) -> float:
    """(θ₋ − θ₊)/(θ₋ + θ₊), from the static counts or from the steps, whichever is better known."""
    static, on, off = evs["asymmetry"], evs["theta_on"], evs["theta_off"]
    if on["value"] is None or off["value"] is None:
        return float(static["value"] or 0.0)
    total = on["value"] + off["value"]
    error = 2 * math.hypot(on["value"] * off["standard_error"], off["value"] * on["standard_error"]) / total**2
    if static["value"] is not None and static.get("standard_error", math.inf) < error:
        return float(static["value"])
    return (off["value"] - on["value"]) / total


def _needed(item: Mapping[str, Any], key: str, file: Path) -> float:
    if item["value"] is None:
        raise SpecError(
            f"not identifiable, so that nothing can be simulated with it: {item['reason']}", file=file, key=key
        )
    return float(item["value"])
