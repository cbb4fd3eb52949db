"""The curves of a sensor as one picture."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hesim_render.core.drawing import COLOURS, new_figure, report_style
from hesim_render.core.errors import RangeError
from hesim_render.core.html import tick_text
from hesim_render.core.output import replacing
from hesim_render.describe.curves import event_curves, photon_transfer, s_curve
from hesim_render.sensor.sensor import Sensor
from hesim_render.spectral.spectrum import product

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Formats of pictures, by the end of the file's name.
FORMATS = ("png", "svg", "pdf")
#: Illuminances of the curves and of the S-curves, lx.
_LUX = np.geomspace(1e-2, 1e5, 141)
_LUX_TICKS = (0.01, 1.0, 100.0, 10000.0)
_S_LUX = (0.1, 1.0, 10.0, 1000.0)
_SIZE_PX = (430, 310)
#: Rates below are not drawn, 1/s.
_LEAST_HZ = 1e-4


def write_picture(sensor: Sensor, file: Path) -> None:
    """Draw the curves of a sensor: noise, noise rate, latency and S-curves against light, photon transfer, spectra.

    Parameters
    ----------
    sensor : the sensor; of one with a calibration, the part that was measured stands for the whole.
    file : PNG, SVG or PDF by the end of its name; replaced in one step.

    Raises
    ------
    RangeError
        If the name ends otherwise.
    """
    kind = file.suffix.lower().removeprefix(".")
    if kind not in FORMATS:
        raise RangeError("format of the picture", file.name, f"a name that ends in {', '.join(FORMATS)}")
    sensor = sensor.calibrated_part
    draws = [_spectra]
    if sensor.spec.evs is not None:
        draws += [_noise, _rates, _latency, _s_curves]
    if sensor.spec.aps is not None:
        draws.append(_transfer)
    columns = min(3, len(draws))
    rows = -(-len(draws) // columns)
    with report_style():
        figure = new_figure((columns * _SIZE_PX[0], rows * _SIZE_PX[1] + 30))
        every = np.atleast_1d(figure.subplots(rows, columns)).ravel()
        for axes, draw in zip(every, draws, strict=False):
            draw(sensor, axes)
            for axis in (axes.xaxis, axes.yaxis):
                if axis.get_scale() == "log":
                    axis.set_major_formatter(tick_text)
                    axis.set_minor_formatter("")
        for axes in every[len(draws) :]:
            axes.set_axis_off()
        figure.suptitle(f"{sensor.name}: {sensor.spec.description}", fontsize=12)
        with replacing(file) as unfinished:
            figure.savefig(unfinished, format=kind, dpi=144)


def _spectra(sensor: Sensor, axes: "Axes") -> None:
    axes.set(title="Spectral response", xlabel="wavelength, nm", ylabel="electrons per photon on the pixel")
    quantum_efficiency = sensor.spec.quantum_efficiency.load()
    for k, (name, filter_) in enumerate(sensor.spec.filters.items()):
        response = product(filter_.load(), quantum_efficiency)
        colour = {"red": "#d62728", "green": "#2ca02c", "blue": "#1f77b4"}.get(name, COLOURS[k % len(COLOURS)])
        axes.plot(response.wavelength_nm, response.values, color=colour, label=name)
    axes.set_xlim(360, 830)
    axes.set_ylim(bottom=0)
    axes.legend(frameon=False)


def _against_light(axes: "Axes", title: str, unit: str) -> None:
    axes.set(title=title, xlabel="illuminance on the sensor, lx", ylabel=unit, xscale="log", yscale="log")
    axes.set_xlim(_LUX[0] / 2, 2 * _LUX[-1])
    axes.set_xticks(_LUX_TICKS)


def _noise(sensor: Sensor, axes: "Axes") -> None:
    _against_light(axes, "Noise of ln x", "standard deviation")
    curves = event_curves(sensor, _LUX)
    if np.any(curves.sigma > 0):
        axes.plot(curves.lux, curves.sigma, color=COLOURS[0], label="model")
    axes.plot(curves.lux, curves.shot_limit, color=COLOURS[6], linestyle="--", label="shot noise of the electrons")
    evs = sensor.evs.spec
    axes.axhline(evs.contrast_threshold_on, color=COLOURS[1], linewidth=1, label="θ₊")
    if evs.contrast_threshold_off != evs.contrast_threshold_on:
        axes.axhline(evs.contrast_threshold_off, color=COLOURS[2], linewidth=1, label="θ₋")
    axes.legend(frameon=False)


def _rates(sensor: Sensor, axes: "Axes") -> None:
    _against_light(axes, "Events in steady light", "events per s and pixel")
    curves = event_curves(sensor, _LUX)
    for rate, colour, label in (
        (curves.on_hz + curves.off_hz, COLOURS[7], "all events"), (curves.on_hz, COLOURS[1], "ON, with leak"),
        (curves.off_hz, COLOURS[0], "OFF"),
    ):  # fmt: skip
        axes.plot(curves.lux, np.where(rate >= _LEAST_HZ, rate, np.nan), color=colour, label=label)
    sheet = sensor.evs.spec.data_sheet
    for level in sheet.background if sheet is not None else ():
        if level.lux > 0:
            axes.plot(level.lux, level.rate_hz, "o", color=COLOURS[7], label="data sheet, all events")
    if np.all(np.maximum(curves.on_hz, curves.off_hz) < _LEAST_HZ):
        axes.set_ylim(_LEAST_HZ, 1)
        axes.text(0.5, 0.5, "none", transform=axes.transAxes, ha="center")
        return
    axes.set_ylim(bottom=_LEAST_HZ)
    axes.legend(frameon=False)


def _latency(sensor: Sensor, axes: "Axes") -> None:
    _against_light(axes, "Latency of an ON event, without noise", "µs")
    sheet = sensor.evs.spec.data_sheet
    stated = 1.0 if sheet is None else 0.01 * sheet.speed_step_percent
    for k, step in enumerate(dict.fromkeys((0.5, stated, 3.0))):
        curves = event_curves(sensor, _LUX, step)
        if np.any(curves.latency_us > 0):
            axes.plot(curves.lux, curves.latency_us, color=COLOURS[k], label=f"step of {100 * step:g} %")
    for speed in sheet.speed if sheet is not None else ():
        if speed.latency_us is not None:
            axes.plot(speed.lux, speed.latency_us, "o", color=COLOURS[7])
    if not axes.lines:
        axes.set_ylim(1, 100)
        axes.text(0.5, 0.5, "none: the pixel follows the light at once", transform=axes.transAxes, ha="center")
        return
    axes.legend(frameon=False)


def _s_curves(sensor: Sensor, axes: "Axes") -> None:
    axes.set(title="S-curves, one comparison after a step", xlabel="contrast (L₁ − L₀)/L₀, %",
             ylabel="probability of an event")  # fmt: skip
    widest = 4 * max(sensor.evs.spec.contrast_threshold_on, sensor.evs.spec.contrast_threshold_off)
    contrast = np.expm1(np.linspace(-widest, widest, 401))
    for k, lux in enumerate(_S_LUX):
        axes.plot(100 * contrast, s_curve(sensor, lux, contrast), color=COLOURS[k], label=f"{lux:g} lx")
    axes.set_ylim(-0.03, 1.03)
    axes.legend(frameon=False)


def _transfer(sensor: Sensor, axes: "Axes") -> None:
    axes.set(title="Photon transfer", xlabel="mean above black, DN", ylabel="temporal noise, DN", xscale="log",
             yscale="log")  # fmt: skip
    electrons, mean, deviation = photon_transfer(sensor)
    gain = sensor.aps.spec.system_gain_dn_per_e
    axes.plot(mean, deviation, color=COLOURS[0], label="model")
    axes.plot(gain * electrons, gain * np.sqrt(electrons), color=COLOURS[6], linestyle="--", label="shot noise")
    axes.legend(frameon=False)
