"""Event pixels of a data sheet, or of v2e's options, as coefficients of the model.

One DN of the signal reference is one lux of the data sheet's light on the sensor: with F the electrons per second and
lux of a pixel, k = 1/F and t_ref = 1 s. With L that signal and L₀ the illuminance that equals the dark current::

    x = L + L₀,   s² = B (L + L₀)                 shot noise of light and dark current: σ² = B/(L + L₀)
    f = f_max·min((L + L₀)/(L_max + L₀), 1)       corner of the photoreceptor: follows light and dark current
    σ² = B/(L + L₀) · min(f/f_n, 1)                where f limits the bandwidth f_n of the noise as well
    1 − (1 + y) exp(−y) = θ/ln(1 + c),  y = a·t    two poles a, latency t after a step of contrast c

σ follows from the background activity by `hesim_render.pixels.evs.noise_rates`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from ruamel.yaml.comments import CommentedMap
from scipy import special

from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.units import M_PER_UM, US_PER_S, photons_per_joule
from hesim_render.pixels.evs.formulas import POLE, corner_line
from hesim_render.pixels.evs.noise_rates import noise_sigma
from hesim_render.specs.data_sheet import DataSheetSpec, V2eSpec
from hesim_render.specs.event_pixels import SHEETS
from hesim_render.specs.files import as_read
from hesim_render.specs.problems import line_of
from hesim_render.specs.sensor import SensorSpec, SheetSensorSpec
from hesim_render.spectral.spectrum import (
    INTEGRATION_STEP_NM,
    Spectrum,
    constant,
    integrate_product,
    merged_grid,
    product,
    scale_to_lux,
)

#: L₀ of a pixel of which nothing else tells it, lx.
_LEAST_DARK_LUX = 1e-3
#: v2e's time constant at a grey level g of 255 is that at white times 275/(g + 20): 20 levels are its dark current.
_V2E_DARK_SHARE = 20 / 255
#: Noise events of v2e at white over those in the dark.
_V2E_WHITE_SHARE = 0.25
#: Bandwidth of the noise where v2e has no cut-off, Hz: v2e's own default.
_V2E_BANDWIDTH_HZ = 300.0


@dataclass(frozen=True)
class Figures:
    """What both kinds of section say, in one form.

    Parameters
    ----------
    thresholds : θ₊, θ₋, ln units.
    mismatch : relative standard deviation over pixels.
    noise : illuminance in lx and rate of noise events in Hz, none to two of them.
    dark_lux : L₀; None where two rates tell it.
    bandwidth_hz : of the noise; None for that of the highest corner.
    filters_noise : whether the corners limit it.
    leak_hz : rate of leak events.
    own_hz : rate of the events of the comparators' own noise.
    corners : illuminance in lx and corner frequency in Hz, none to two of them.
    dead_us : dead time, µs; None for none.
    shot_law : law of the noise; with two rates and "linear", σ is (β3 L + β4)/(L + L₀).
    """

    thresholds: tuple[float, float]
    mismatch: float
    noise: list[tuple[float, float]]
    dark_lux: float | None
    bandwidth_hz: float | None
    filters_noise: bool
    leak_hz: float
    corners: list[tuple[float, float]]
    dead_us: int | None
    shot_law: Literal["linear", "sqrt"] = "sqrt"
    own_hz: float = 0.0

    @classmethod
    def of_data_sheet(cls, sheet: DataSheetSpec, own_hz: float) -> "Figures":
        """Figures of a data sheet. A latency is that of an ON event; the corner is that of the light after the step."""
        for stated in sheet.background:
            if stated.rate_hz <= sheet.leak_hz + own_hz:
                raise SpecError(
                    f"background of {stated.rate_hz:g} Hz at {stated.lux:g} lx is not above leak and comparator_noise, "
                    f"{sheet.leak_hz + own_hz:g} Hz together: nothing is left for the noise of the light"
                )
        contrasts = [0.01 * value for value in (sheet.threshold_on_percent, sheet.threshold_off_percent)]
        on, off = (math.log1p(contrast) for contrast in contrasts)
        # dθ = dc/(1 + c)
        spread = 0.01 * sheet.threshold_mismatch_percent / (1 + sum(contrasts) / 2)
        step = 0.01 * sheet.speed_step_percent
        corners = []
        for level in sheet.speed:
            if level.bandwidth_hz is not None:
                corners.append((level.lux, level.bandwidth_hz))
            elif level.latency_us is not None:
                assert sheet.dark_lux is not None
                change = math.log1p(step * level.lux / (level.lux + sheet.dark_lux))
                corners.append((level.lux * (1 + step), corner_of_latency_hz(level.latency_us, on, change)))
        return cls(
            (on, off), spread / ((on + off) / 2),
            [(level.lux, level.rate_hz - sheet.leak_hz - own_hz) for level in sheet.background],
            sheet.dark_lux, sheet.noise_cutoff_hz, bool(sheet.speed), sheet.leak_hz, corners, sheet.refractory_us,
            own_hz=own_hz,
        )  # fmt: skip

    @classmethod
    def of_v2e(cls, options: V2eSpec) -> "Figures":
        """Figures of v2e's options. Its cut-off and its logarithm follow the light and 20 of its grey levels."""
        thresholds = options.pos_thres, options.neg_thres
        rate, white = options.shot_noise_rate_hz, options.white_lux
        return cls(
            thresholds, options.sigma_thres / (sum(thresholds) / 2),
            [(0.0, rate), (white, _V2E_WHITE_SHARE * rate)] if rate > 0 else [],
            _V2E_DARK_SHARE * white,
            options.cutoff_hz or _V2E_BANDWIDTH_HZ, False, options.leak_rate_hz,
            [(white, options.cutoff_hz)] if options.cutoff_hz > 0 else [],
            round(options.refractory_period_s * US_PER_S) or None, "linear",
        )  # fmt: skip


def corner_of_latency_hz(latency_us: float, theta: float, step: float) -> float:
    """Corner of a photoreceptor of two equal poles whose event comes this long after a step.

    Parameters
    ----------
    latency_us : from the step to the event, µs.
    theta : threshold, ln units.
    step : change of ln x, more than θ.

    Raises
    ------
    RangeError
        If the step is not above the threshold.
    """
    return _settling(theta, step) * US_PER_S / (latency_us * POLE)


def latency_us(corner_hz: float, theta: float, step: float) -> float:
    """Time from a step of ln x to the event, µs; inverse of `corner_of_latency_hz`."""
    return _settling(theta, step) * US_PER_S / (corner_hz * POLE)


def _settling(theta: float, step: float) -> float:
    """y of 1 − (1 + y) exp(−y) = θ/S: 1 + y = −W₋₁(−(1 − θ/S)/e), W the Lambert function."""
    if not step > theta:
        raise RangeError("step of contrast", f"{100 * math.expm1(step):.3g} %",
                         f"more than the threshold of {100 * math.expm1(theta):.3g} %")  # fmt: skip
    return float(-special.lambertw(-(1 - theta / step) / math.e, -1).real - 1)


def electrons_per_s_lux(spec: SensorSpec, filter_name: str, light: Spectrum) -> float:
    """Electrons per second of a pixel for one lux on the sensor: A·FF·∫ C_f η λ/(h c) E(λ) dλ, no lens in between.

    Parameters
    ----------
    spec : the sensor.
    filter_name : filter of the pixel.
    light : spectrum of the light; its scale does not matter.
    """
    response = product(spec.filters[filter_name].load(), spec.quantum_efficiency.load())
    grid = merged_grid(response, constant(1.0, *response.support_nm), step_nm=INTEGRATION_STEP_NM)
    per_joule = Spectrum(grid, response.at(grid) * photons_per_joule(grid))
    area_m2 = (spec.geometry.pitch_um * M_PER_UM) ** 2 * spec.geometry.fill_factor
    return area_m2 * integrate_product(scale_to_lux(light, 1.0), per_joule)


def derive(data: CommentedMap, spec: SheetSensorSpec, file: Path) -> None:
    """Add the values that follow from a data sheet to the content of a file.

    Parameters
    ----------
    data : content of the file, changed in place.
    spec : the same content, checked.
    file : the file.

    Raises
    ------
    SpecError
        If no parameters of the model have these figures.
    """
    section = next(name for name in SHEETS if getattr(spec.evs, name) is not None)
    try:
        values = _values(spec)
    except (RangeError, SpecError) as error:
        line = line_of(data, ("evs", section))
        raise SpecError(str(error), file=file, line=line, key=f"evs.{section}") from None
    data["evs"].update({key: as_read(value) for key, value in values.items() if value is not None})


def _values(spec: SheetSensorSpec) -> dict[str, Any]:
    evs = spec.evs
    if evs.data_sheet is not None:
        own = evs.comparator_noise
        own_hz = 0.0 if own is None else own.on_hz + own.off_hz
        figures, light = Figures.of_data_sheet(evs.data_sheet, own_hz), evs.data_sheet.light.load()
    else:
        assert evs.v2e is not None
        figures, light = Figures.of_v2e(evs.v2e), evs.v2e.light.load()
    names = list(dict.fromkeys(spec.pixels[spec.tile_rows[i][j]].filter for i, j in spec.positions("evs")))
    flux = electrons_per_s_lux(spec, names[0], light)
    photoreceptor = _photoreceptor(figures)
    bandwidth_hz = figures.bandwidth_hz or photoreceptor["cutoff_hz"]
    if photoreceptor and bandwidth_hz > photoreceptor["cutoff_hz"]:
        raise SpecError(f"noise_cutoff_hz {bandwidth_hz:g} is above the pixel's {photoreceptor['cutoff_hz']:.4g} Hz")
    dark_lux, beta3, beta4 = _noise(figures, bandwidth_hz, photoreceptor)
    beta = {"beta1": 1.0, "beta2": dark_lux, "beta3": beta3, "beta4": beta4}
    if figures.shot_law == "linear":
        beta["beta5"] = 1.0
    reference = {"k_dn_per_e": 1 / flux, "t_ref_us": float(US_PER_S)}
    return {
        "contrast_threshold_on": figures.thresholds[0],
        "contrast_threshold_off": figures.thresholds[1],
        "threshold_mismatch_rel": figures.mismatch,
        "signal_reference": {**reference, "filter": "own" if len(names) == 1 else names[0]},
        "coefficients": [beta],
        "shot_law": figures.shot_law,
        "leak_rate_hz": figures.leak_hz,
        "noise_cutoff_hz": bandwidth_hz,
        "photoreceptor": photoreceptor or None,
        "refractory_period_us": figures.dead_us,
    }


def _noise(figures: Figures, bandwidth_hz: float, photoreceptor: Mapping[str, float]) -> tuple[float, float, float]:
    """L₀ in lx, β3 and β4, of the noise in its full bandwidth."""
    dead_s = 0.0 if figures.dead_us is None else figures.dead_us / US_PER_S

    def variance(lux: float, rate_hz: float) -> float:
        share = 1.0
        if figures.filters_noise:
            limits = photoreceptor["min_cutoff_hz"], photoreceptor["cutoff_hz"]
            share = min(corner_line(min(lux / photoreceptor["signal_dn"], 1.0), *limits) / bandwidth_hz, 1.0)
        sigma = noise_sigma(
            rate_hz,
            figures.thresholds,
            figures.mismatch,
            share * bandwidth_hz,
            dead_s,
            figures.leak_hz + figures.own_hz,
        )
        return sigma**2 / share

    variances = [variance(lux, rate_hz) for lux, rate_hz in figures.noise]
    lux = [level for level, _ in figures.noise]
    if not lux:
        return figures.dark_lux or _LEAST_DARK_LUX, 0.0, 0.0
    darker, brighter = int(np.argmin(lux)), int(np.argmax(lux))
    if figures.shot_law == "linear":
        assert figures.dark_lux is not None and lux[darker] == 0
        beta4 = math.sqrt(variances[darker]) * figures.dark_lux
        beta3 = (math.sqrt(variances[brighter]) * (lux[brighter] + figures.dark_lux) - beta4) / lux[brighter]
        return figures.dark_lux, beta3, beta4
    dark = figures.dark_lux
    if dark is None:
        fall = variances[darker] - variances[brighter]
        dark = (variances[brighter] * lux[brighter] - variances[darker] * lux[darker]) / fall if fall > 0 else 0.0
        if dark <= 0:
            raise SpecError(
                f"background: rates of {figures.noise[darker][1]:g} Hz at {lux[darker]:g} lx and "
                f"{figures.noise[brighter][1]:g} Hz at {lux[brighter]:g} lx (without leak) do not follow shot noise, "
                "whose variance is inverse to the light and the dark current together; give one of them, and dark_lux"
            )
    scale = variances[darker] * (lux[darker] + dark)
    return dark, math.sqrt(scale), math.sqrt(scale * dark)


def _photoreceptor(figures: Figures) -> dict[str, Any]:
    """Corner proportional to light and dark current through the darker of two levels, up to that of the brighter one;
    empty where nothing limits the speed.
    """
    if not figures.corners:
        return {}
    assert figures.dark_lux is not None
    dark = figures.dark_lux
    (lux, corner), (brighter_lux, highest) = min(figures.corners), max(figures.corners)
    if highest < corner or highest / corner > (brighter_lux + dark) / (lux + dark) * (1 + 1e-9):
        raise SpecError(
            f"speed: corners of {corner:.4g} Hz at {lux:g} lx and {highest:.4g} Hz at {brighter_lux:g} lx: in between "
            f"the corner can rise at most as fast as the light with the dark current of {dark:g} lx, and not fall"
        )
    return {
        "cutoff_hz": highest, "signal_dn": (lux + dark) * highest / corner - dark,
        "min_cutoff_hz": max(corner * dark / (lux + dark), 1e-3), "filters_noise": figures.filters_noise,
    }  # fmt: skip
