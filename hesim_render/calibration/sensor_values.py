"""A sensor file's own noise, replaced by that of a calibration."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hesim_render.calibration.measured import interval_s
from hesim_render.calibration.rates import rate_hz
from hesim_render.calibration.spec import (
    AsynchronousSection,
    CalibrationSpec,
    EstimateSpec,
    EventSection,
    FrameSection,
)
from hesim_render.core.errors import SpecError
from hesim_render.specs.sensor import NoiseFile


def with_intervals(own: Mapping[str, Mapping[str, Any]], noise: NoiseFile, data: CalibrationSpec) -> NoiseFile:
    """A calibration with the intervals that it does not state: those of the sensor file.

    Captures need not state them. A dump of the sensor holds what was taken.

    Parameters
    ----------
    own : sections ``aps`` and ``evs`` of the sensor file, without overrides: these are of the simulation.
    noise : the calibration.
    data : its content.
    """
    taken = {}
    for name, key in (("aps", "frame_rate_hz"), ("evs", "tick_us")):
        section, value = data.sections.get(name), own.get(name, {}).get(key)
        if getattr(section, key, value) is None and getattr(noise, key) is None and value is not None:
            taken[key] = float(value)
    return noise.model_copy(update=taken)


def apply_calibration(sensor: dict[str, Any], noise: NoiseFile, data: CalibrationSpec) -> None:
    """Replace a sensor file's own noise by the calibrated one, in place; the file is valid.

    Frames take K, the black level and the variance polynomial (0 where a term is not identified), and what
    is known of read noise, dark current, DSNU, PRNU and full well; their fixed maps are those of
    `MeasuredMaps`. Events take the coefficients of each position, thresholds, mismatch, leak and signal reference.

    Raises
    ------
    SpecError
        If the calibration does not fit the sensor, or lacks a parameter that a simulation needs.
    """
    tile = ["".join(line.split()) for line in sensor["tile"].strip().splitlines()]
    shape, captured = (len(tile), len(tile[0])), (data.capture.tile_rows, data.capture.tile_cols)
    if shape != captured:
        raise SpecError(
            f"is of a sensor with a tile of {captured[0]}×{captured[1]}, not {shape[0]}×{shape[1]}", file=noise.path
        )
    # all values are collected before any is set: a calibration that does not fit changes nothing
    changed: dict[str, Any] = {}
    for section in data.sections:
        if not isinstance(sensor.get(section), dict):
            raise SpecError(f"holds a section {section!r}, but the sensor has none", file=noise.path)
    if data.aps is not None:
        changed |= {
            f"aps.{key}": value for key, value in _aps_values(sensor["aps"], data, data.aps, noise.path).items()
        }
    if data.evs is not None:
        if isinstance(data.evs, AsynchronousSection):
            result = _asynchronous_values(sensor, data.evs, noise.path)
        else:
            result = _evs_values(sensor, data.evs, noise)
        sensor["evs"].pop("leak", None)  # leak_rate_hz is the calibrated one
        changed |= {f"evs.{key}": value for key, value in (result | _signal_reference(data)).items()}
    # each value that was measured says so; what the file said of its source does not hold any more
    for key, value in changed.items():
        section, name = key.split(".")
        sensor[section][name] = value
        for group in ("sources", "assumptions"):
            if isinstance(sensor.get(group), dict):
                sensor[group].pop(key, None)
        sensor.setdefault("sources", {})[key] = f"measured: {noise.file}"


def _aps_values(own: Mapping[str, Any], data: CalibrationSpec, aps: FrameSection, file: Path) -> dict[str, Any]:
    if own.get("bit_depth") != data.capture.bit_depth:
        raise SpecError(
            f"is of frames of {data.capture.bit_depth} bits, the sensor has {own.get('bit_depth')}", file=file
        )
    values = {
        "system_gain_dn_per_e": _needed(aps.K, "aps.K", file),
        "black_level_dn": aps.black_dn,
        "row_offset_std_dn": aps.n_row_std_dn,
        "row_noise_dn": 0.0 if aps.row_noise_dn is None else aps.row_noise_dn.value or 0.0,
        "beta": [[[b or 0.0 for b in cell] for cell in row] for row in aps.beta],
    }
    for key, item in (
        ("column_noise_dn", aps.column_noise_dn),
        ("read_noise_correlation", aps.read_noise_correlation),
    ):
        if item is not None:
            values[key] = item.value or 0.0
    for key in ("column_offset_std_dn", "nonlinearity", "interference"):
        if getattr(aps, key) is not None:
            values[key] = getattr(aps, key)
    if aps.full_well_e.limited_by == "full well":
        values["full_well_e"] = aps.full_well_e.cut_off_e or aps.full_well_e.value
    for key, item, scale in (
        ("read_noise_e", aps.read_noise_e, 1.0),
        ("dark_current_e_per_s", aps.dark_current_e_per_s, 1.0),
        ("dsnu_e", aps.dsnu_e, 1.0),
        ("prnu_rel", aps.prnu_percent, 0.01),
    ):
        if item.value is not None:
            values[key] = max(0.0, scale * item.value)
    return values


def _evs_values(sensor: Mapping[str, Any], evs: EventSection, noise: NoiseFile) -> dict[str, Any]:
    """In the gauge of the calibration, β2 = 1 V; θ is the file's own where the calibration could not tell it."""
    own, file = sensor["evs"], noise.path
    if own.get("reference") != "previous_sample":
        raise SpecError("its events are of fixed comparisons; the sensor needs reference 'previous_sample'", file=file)
    hardware = None if isinstance(evs.theta_hardware_v, EstimateSpec) else evs.theta_hardware_v
    theta_v = 1.0 if hardware is None else hardware
    theta = evs.theta.value
    if theta is None:
        theta = (own["contrast_threshold_on"] + own["contrast_threshold_off"]) / 2
    rho = _asymmetry(evs)
    grid = sensor.get("evs_grid") or {}
    if len(evs.positions) != grid.get("rows_per_tile", 0) * grid.get("cols_per_tile", 0):
        raise SpecError(f"has {len(evs.positions)} event positions, not as many as the sensor", file=file)
    pooled = [_needed(evs.A, "evs.A", file), _needed(evs.B, "evs.B", file), evs.C.value or 0.0, evs.D.value or 0.0]
    coefficients = []
    for position in evs.positions:
        result = [position.A.value, position.B.value, position.C.value, position.D.value]
        known = [value for value in result if value is not None]
        a, b, c, d = known if len(known) == len(result) else pooled
        beta4 = theta / theta_v / b
        coefficients.append({"beta1": a / b, "beta2": 1.0, "beta3": c * beta4, "beta4": beta4, "beta5": d})
    values = {
        "contrast_threshold_on": theta * (1 - rho),
        "contrast_threshold_off": theta * (1 + rho),
        "threshold_mismatch_rel": evs.threshold_mismatch_rel.value or 0.0,
        "coefficients": coefficients,
        "shot_law": evs.shot_law,
        "leak_rate_hz": _leak_rate_hz(evs, noise),
    }
    return values if hardware is None else values | {"threshold_hardware_v": hardware}


def _leak_rate_hz(evs: EventSection, noise: NoiseFile) -> float:
    """Rate of the leak: as stated, or where the captures' tick is not known, from the chance in a comparison."""
    if evs.leak_rate_hz is not None:
        return max(0.0, evs.leak_rate_hz.value or 0.0)
    chance = max(0.0, evs.leak_per_trial.value or 0.0)
    return float(rate_hz(chance, interval_s(noise, "evs", evs))) if chance > 0 else 0.0


def _asynchronous_values(sensor: Mapping[str, Any], evs: AsynchronousSection, file: Path) -> dict[str, Any]:
    """Of a sensor without fixed comparisons: one set of coefficients for all positions, in the gauge β2 = 1 V."""
    if sensor["evs"].get("reference") != "last_event":
        raise SpecError("its events are of an asynchronous sensor; the sensor needs reference 'last_event'", file=file)
    beta: dict[str, float] = {}
    for number, value in enumerate(evs.beta[0][1:], start=1):
        if value is None:
            raise SpecError(
                "not known, so that nothing can be simulated with it", file=file, key=f"evs.beta[0][{number}]"
            )
        beta[f"beta{number}"] = value
    return {
        "contrast_threshold_on": _needed(evs.theta_on, "evs.theta_on", file),
        "contrast_threshold_off": _needed(evs.theta_off, "evs.theta_off", file),
        "threshold_mismatch_rel": _needed(evs.threshold_mismatch_rel, "evs.threshold_mismatch_rel", file),
        "coefficients": [beta],
        "shot_law": evs.shot_law,
        "leak_rate_hz": max(0.0, _needed(evs.leak_rate_hz, "evs.leak_rate_hz", file)),
        "noise_cutoff_hz": _needed(evs.noise_cutoff_hz, "evs.noise_cutoff_hz", file),
    }


def _signal_reference(data: CalibrationSpec) -> dict[str, Any]:
    reference = data.capture.signal_reference
    if reference is None:
        return {}
    return {"signal_reference": {"k_dn_per_e": reference.k, "t_ref_us": reference.t_ref_us, "filter": reference.filter}}


def _asymmetry(evs: EventSection) -> float:
    """(θ₋ − θ₊)/(θ₋ + θ₊), from the static counts or from the steps, whichever is better known."""
    static, on, off = evs.asymmetry, evs.theta_on, evs.theta_off
    if on.value is None or off.value is None:
        return static.value or 0.0
    total = on.value + off.value
    error = 2 * math.hypot(on.value * off.error, off.value * on.error) / total**2
    if static.value is not None and static.error < error:
        return static.value
    return (off.value - on.value) / total


def _needed(item: EstimateSpec, key: str, file: Path) -> float:
    if item.value is None:
        raise SpecError(
            f"not identifiable, so that nothing can be simulated with it: {item.reason}", file=file, key=key
        )
    return item.value
