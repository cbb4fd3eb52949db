"""The figures of a sensor as a table: what the file says, and what its model makes of it."""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from hesim_render.core.units import US_PER_S
from hesim_render.describe.curves import event_curves, photon_transfer
from hesim_render.sensor.sensor import Sensor
from hesim_render.specs.data_sheet import DataSheetSpec

#: Illuminances on the sensor of the table, lx.
TABLE_LUX = (0.0, 0.1, 1.0, 10.0, 100.0, 1000.0, 10000.0)


class Row(NamedTuple):
    """One figure.

    Parameters
    ----------
    name : what it is.
    value : what the model has, or makes of the other figures.
    unit : its unit; empty for a pure number.
    stated : what the data sheet in the file says; None where it says nothing.
    """

    name: str
    value: float
    unit: str
    stated: float | None = None


def figures_of(sensor: Sensor) -> dict[str, list[Row]]:
    """The figures of a sensor by section: ``geometry``, ``frames``, ``events``, ``events against light``.

    Parameters
    ----------
    sensor : the sensor; of one with a calibration, the part that was measured stands for the whole.

    Returns
    -------
    {section: rows}; sections that the sensor lacks are left out.
    """
    geometry, sensor = sensor.spec.geometry, sensor.calibrated_part
    result = {
        "geometry": [
            Row("columns", geometry.cols, "px"), Row("rows", geometry.rows, "px"),
            Row("pixel pitch", geometry.pitch_um, "µm"), Row("fill factor", geometry.fill_factor, ""),
            Row("width", 1e-3 * geometry.cols * geometry.pitch_um, "mm"),
            Row("height", 1e-3 * geometry.rows * geometry.pitch_um, "mm"),
        ]
    }  # fmt: skip
    if sensor.spec.aps is not None:
        result["frames"] = _frames(sensor)
    if sensor.spec.evs is not None:
        result["events"] = _events(sensor)
        result["events against light"] = _against_light(sensor)
    return result


def _frames(sensor: Sensor) -> list[Row]:
    aps = sensor.spec.aps
    assert aps is not None
    _, mean, deviation = photon_transfer(sensor)
    dark_e = math.hypot(aps.read_noise_e, math.sqrt(aps.dark_current_now_e_per_s * aps.exposure_us / US_PER_S))
    return [
        Row("full well", aps.full_well_e, "e⁻"), Row("system gain", aps.system_gain_dn_per_e, "DN/e⁻"),
        Row("read noise", aps.read_noise_e, "e⁻"), Row("dark current", aps.dark_current_now_e_per_s, "e⁻/s"),
        Row("noise in the dark at the sensor's exposure", dark_e, "e⁻"),
        Row("largest SNR", 20 * math.log10(float(np.max(mean / deviation))), "dB"),
        Row("dynamic range", 20 * math.log10(aps.full_well_e / max(dark_e, 1e-3)), "dB"),
        Row("bit depth", aps.bit_depth, "bit"), Row("exposure", aps.exposure_us, "µs"),
        Row("frame rate", aps.frame_rate_hz, "Hz"),
    ]  # fmt: skip


def _events(sensor: Sensor) -> list[Row]:
    evs, grid = sensor.evs.spec, sensor.layout.evs_shape
    sheet = evs.data_sheet
    contrast = [100 * math.expm1(theta) for theta in (evs.contrast_threshold_on, evs.contrast_threshold_off)]
    spread = evs.threshold_mismatch_rel * (evs.contrast_threshold_on + evs.contrast_threshold_off) / 2
    stated = (
        (None, None, None) if sheet is None else
        (sheet.threshold_on_percent, sheet.threshold_off_percent, sheet.threshold_mismatch_percent)
    )  # fmt: skip
    leak = ("leak in the dark", evs.leak.rate_hz) if evs.leak else ("leak", evs.leak_rate_hz)
    rows = [
        Row("event columns", grid[1], "px"), Row("event rows", grid[0], "px"),
        Row("threshold ON", contrast[0], "%", stated[0]), Row("threshold OFF", contrast[1], "%", stated[1]),
        Row("threshold mismatch", spread * (100 + sum(contrast) / 2), "%", stated[2]),
        Row(leak[0], leak[1], "Hz", None if sheet is None else sheet.leak_hz),
    ]  # fmt: skip
    if evs.tick_us is not None:
        rows.append(Row("tick", evs.tick_us, "µs"))
    if evs.noise_cutoff_hz is not None:
        rows.append(
            Row(
                "noise bandwidth",
                evs.noise_cutoff_hz,
                "Hz",
                None if sheet is None else sheet.noise_cutoff_hz,
            )
        )
    if evs.refractory_period_us is not None:
        rows.append(
            Row("refractory period", evs.refractory_period_us, "µs", None if sheet is None else sheet.refractory_us)
        )
    if evs.photoreceptor is not None:
        rows.append(Row("bandwidth of the signal, bright", evs.photoreceptor.cutoff_hz, "Hz"))
    return rows + (_stated(sensor, sheet) if sheet is not None else [])


def _stated(sensor: Sensor, sheet: DataSheetSpec) -> list[Row]:
    """Figures of the data sheet at its own illuminances."""
    rows = []
    for level in sheet.background:
        curves = event_curves(sensor, level.lux)
        rows.append(
            Row(f"background at {level.lux:g} lx", float(curves.on_hz[0] + curves.off_hz[0]), "Hz", level.rate_hz)
        )
    for speed in sheet.speed:
        if speed.latency_us is not None:
            curves = event_curves(sensor, speed.lux, 0.01 * sheet.speed_step_percent)
            name = f"latency at {speed.lux:g} lx, {sheet.speed_step_percent:g} % step"
            rows.append(Row(name, float(curves.latency_us[0]), "µs", speed.latency_us))
    return rows


def _against_light(sensor: Sensor) -> list[Row]:
    curves = event_curves(sensor, TABLE_LUX)
    rows = []
    for k, lux in enumerate(TABLE_LUX):
        at = f"at {lux:g} lx"
        rows += [
            Row(f"noise of ln x {at}", float(curves.sigma[k]), ""),
            Row(f"ON events {at}", float(curves.on_hz[k]), "Hz"),
            Row(f"OFF events {at}", float(curves.off_hz[k]), "Hz"),
            Row(f"latency {at}, {100 * curves.step:g} % step", float(curves.latency_us[k]), "µs"),
        ]
    return rows


def table_lines(figures: dict[str, list[Row]]) -> Iterable[str]:
    """Lines of text: the figures of each section, events against light as one line per illuminance.

    Parameters
    ----------
    figures : as from `figures_of`.

    Yields
    ------
    Lines without line ends.
    """
    for section, rows in figures.items():
        yield f"{section}:"
        if section == "events against light":
            yield f"  {'illuminance':>12} {'noise of ln x':>14} {'ON':>12} {'OFF':>12} {'latency, 100 % step':>20}"
            for k, lux in enumerate(TABLE_LUX):
                sigma, on, off, latency = (row.value for row in rows[4 * k : 4 * k + 4])
                delay = "none" if math.isnan(latency) else f"{_short(latency)} µs"
                yield f"  {lux:>9g} lx {sigma:>14.3g} {_short(on):>9} Hz {_short(off):>9} Hz {delay:>20}"
            continue
        for row in rows:
            stated = "" if row.stated is None else f"  (data sheet: {_short(row.stated)} {row.unit})"
            yield f"  {row.name:<44} {_short(row.value):>10} {row.unit}{stated}".rstrip()


def _short(value: float) -> str:
    """Four figures, or a whole number as it is, without an exponent; rates that nobody will see as 0."""
    if 0 < abs(value) < 1e-6:
        return "0"
    four = f"{value:.4g}"
    if not 1e3 <= abs(value) < 1e12:  # nor NaN
        return four
    return f"{value if value == round(value) else float(four):.0f}"
