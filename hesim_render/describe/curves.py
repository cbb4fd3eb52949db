"""Curves of a sensor by the closed forms of its model: events against light and contrast, photon transfer."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.device_types import NUMPY
from hesim_render.core.errors import RangeError
from hesim_render.core.units import S_PER_US
from hesim_render.pixels.evs import formulas
from hesim_render.pixels.evs.formulas import POLE_HZ
from hesim_render.pixels.evs.noise_rates import noise_rates_hz
from hesim_render.sensor.from_data_sheet import electrons_per_s_lux, latency_us
from hesim_render.sensor.sensor import Sensor
from hesim_render.spectral.spectrum import Spectrum, illuminant


@dataclass(frozen=True)
class EventCurves:
    """An event pixel against the illuminance on the sensor (no lens in between), mean over pixels.

    Parameters
    ----------
    lux : [n], illuminance, lx.
    sigma : [n], standard deviation of ln x.
    on_hz, off_hz : [n], events of a pixel in steady light, with leak and comparator noise, 1/s.
    latency_us : [n], time from a step of `step` to an ON event, without noise; NaN where the step is too small.
    shot_limit : [n], standard deviation of ln of the light that the shot noise of the photo-electrons alone would have
        in the same bandwidth (in the same window at a fixed tick).
    step : contrast c of that step.
    """

    lux: NDArray[np.float64]
    sigma: NDArray[np.float64]
    on_hz: NDArray[np.float64]
    off_hz: NDArray[np.float64]
    latency_us: NDArray[np.float64]
    shot_limit: NDArray[np.float64]
    step: float


class _Pixel:
    """One event position of a sensor in one light."""

    def __init__(self, sensor: Sensor, light: Spectrum | None, position: int) -> None:
        spec, self.noise = sensor.spec, sensor.calibrated_part.evs
        positions = spec.positions("evs")
        if not 0 <= position < len(positions):
            raise RangeError("position", position, f"an event position, 0 to {len(positions) - 1}")
        row, col = positions[position]
        self.spec, self.position = self.noise.spec, position
        if light is None:
            sheet = self.spec.data_sheet or self.spec.v2e
            light = sheet.light.load() if sheet is not None else illuminant("D65")
        self.flux = electrons_per_s_lux(spec, spec.pixels[spec.tile_rows[row][col]].filter, light)
        self._table = self.noise.table.each(lambda values: values[position])
        self.thresholds = self.spec.contrast_threshold_on, self.spec.contrast_threshold_off
        self.mismatch = 0.0 if "mismatch" in self.noise.off else self.spec.threshold_mismatch_rel

    def level(self, lux: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """ln x, its variance, and the part of the noise's bandwidth that the photoreceptor leaves."""
        electrons = np.asarray(lux, np.float64) * (self.flux * self.spec.window_us * S_PER_US)
        log, variance = formulas.log_level(self._table, electrons, self.spec.shot_law, NUMPY)
        share = np.broadcast_to(self.noise.noise_share(electrons, self.position), log.shape)
        return log, variance * share, share

    def leak_hz(self, lux: float) -> float:
        """Leak events of a pixel, Hz, mean over pixels."""
        drift = self.noise.leak_drift
        if drift is None:
            return self.noise.leak_rate_hz
        electrons = lux * self.flux * self.spec.window_us * S_PER_US
        return drift.mean_rate_hz(electrons * float(self.noise.dn_per_electron[self.position]))

    def rates(self, lux: float) -> tuple[float, float]:
        """ON and OFF events per second in steady light, leak included."""
        _, variance, share = (float(value) for value in self.level(lux))
        leak_hz = self.leak_hz(lux)
        if self.spec.reference == "previous_sample":
            assert self.spec.tick_us is not None
            tick_s = self.spec.tick_us * S_PER_US
            on, off = (
                float(formulas.exceedance(theta, math.sqrt(2 * variance + (self.mismatch * theta) ** 2)))
                for theta in self.thresholds
            )
            # at most one event a tick: the comparison first, then the leak, then the comparators' own noise
            leak = formulas.leak_probability(leak_hz, tick_s)
            chances = [formulas.leak_probability(hz, tick_s) for hz in self.noise.comparator_noise_hz]
            free = (1 - on - off) * (1 - leak)
            return (on + (1 - on - off) * leak + free * chances[0]) / tick_s, (off + free * chances[1]) / tick_s
        assert self.spec.noise_cutoff_hz is not None
        dead_s = (self.noise.refractory_period_us or 0) * S_PER_US
        bandwidth_hz = share * self.spec.noise_cutoff_hz
        own = self.noise.comparator_noise_hz
        resets_hz = leak_hz + sum(own)
        on, off = noise_rates_hz(self.thresholds, self.mismatch, math.sqrt(variance), bandwidth_hz, dead_s, resets_hz)
        return on + leak_hz + own[0], off + own[1]

    def shot_limit(self, lux: NDArray[np.float64]) -> NDArray[np.float64]:
        """σ = √(1/N) of the electrons of a window; of band-limited noise √((2/Φ)·(π/4)·f₀), f₀ = f/√(√2 − 1)."""
        flux = np.maximum(lux * self.flux, 1e-30)
        if self.spec.reference == "previous_sample":
            return np.sqrt(1 / (flux * self.spec.window_us * S_PER_US))
        assert self.spec.noise_cutoff_hz is not None
        pole_hz = self.level(lux)[2] * self.spec.noise_cutoff_hz * POLE_HZ
        return np.sqrt(math.pi / 2 * pole_hz / flux)

    def latency(self, lux: float, step: float) -> float:
        """µs from a step up to the event."""
        before, after = (float(self.level(value)[0]) for value in (lux, lux * (1 + step)))
        spec, theta = self.noise.photoreceptor, self.thresholds[0]
        # a step below the threshold gives no event
        if after - before <= theta:
            return math.nan
        # at a fixed tick the step falls anywhere in it
        sampling = 0.5 * self.spec.tick_us if self.spec.reference == "previous_sample" and self.spec.tick_us else 0.0
        if spec is None:
            return sampling
        # the pixel settles with the corner that it has in the light after the step
        corner = spec.cutoff_hz
        if spec.follows_light:
            electrons = np.asarray(lux * (1 + step) * self.flux * (self.spec.window_us * S_PER_US))
            corner = float(self.noise.corner_hz(electrons, self.position))
        return latency_us(corner, theta, after - before) + sampling


def event_curves(
    sensor: Sensor, lux: ArrayLike, step: float = 1.0, light: Spectrum | None = None, position: int = 0
) -> EventCurves:
    """Noise, noise events and latency of an event pixel against light.

    Rates at a fixed tick are the formulas of `hesim_render.pixels.evs.formulas`; of asynchronous pixels those of
    `hesim_render.pixels.evs.noise_rates`.

    Parameters
    ----------
    sensor : a sensor with event pixels.
    lux : [n], illuminances on the sensor, lx.
    step : contrast of the step for the latency, (L₁ − L₀)/L₀.
    light : spectrum of the light; default that of the sensor's data sheet, or D65.
    position : event position, in reading order of the tile.

    Returns
    -------
    The curves.

    Raises
    ------
    RangeError
        If the position is unknown, or an illuminance or the step is not positive and finite.
    """
    levels = np.atleast_1d(np.asarray(lux, np.float64))
    if levels.ndim != 1 or not (np.all(np.isfinite(levels)) and np.all(levels >= 0)):
        raise RangeError("lux", lux, "finite illuminances of 0 or more, one after another")
    if not (math.isfinite(step) and step > 0):
        raise RangeError("step", step, "a contrast above 0")
    pixel = _Pixel(sensor, light, position)
    rates = np.array([pixel.rates(value) for value in levels]).reshape(-1, 2)
    return EventCurves(
        levels, np.sqrt(pixel.level(levels)[1]), rates[:, 0], rates[:, 1],
        np.array([pixel.latency(value, step) for value in levels]), pixel.shot_limit(levels), step,
    )  # fmt: skip


def s_curve(
    sensor: Sensor, lux: float, contrast: ArrayLike, light: Spectrum | None = None, position: int = 0
) -> NDArray[np.float64]:
    """Probability that one comparison, after a settled step from `lux`, gives an ON event (an OFF event for a fall).

    The noise of both instants and the spread of the thresholds add up: Q((θ − |S|)/√(σ₀² + σ₁² + m²θ²)). A pixel that
    is compared for longer has more chances; in bright light, where noise is small, it makes no difference.

    Parameters
    ----------
    sensor : a sensor with event pixels.
    lux : illuminance before the step, lx.
    contrast : [n], (L₁ − L₀)/L₀, above −1.
    light, position : as for `event_curves`.

    Returns
    -------
    [n], probabilities.

    Raises
    ------
    RangeError
        If a contrast is −1 or less, or the position is unknown.
    """
    contrast = np.atleast_1d(np.asarray(contrast, np.float64))
    if not np.all(contrast > -1):
        raise RangeError("contrast", float(contrast.min()), "above -1, which is darkness")
    pixel = _Pixel(sensor, light, position)
    (log_0, variance_0, _), (log_1, variance_1, _) = pixel.level(lux), pixel.level(lux * (1 + contrast))
    theta = np.where(contrast >= 0, *pixel.thresholds)
    sigma = np.sqrt(variance_0 + variance_1 + (pixel.mismatch * theta) ** 2)
    return formulas.exceedance(theta - np.abs(log_1 - log_0), sigma)


def photon_transfer(sensor: Sensor, points: int = 60) -> tuple[NDArray, NDArray, NDArray]:
    """Photon transfer of the frame pixels at the sensor's own exposure.

    Parameters
    ----------
    sensor : a sensor with frame pixels.
    points : number of electron counts, spread evenly in the logarithm from 0.1 to the full well.

    Returns
    -------
    electrons, mean in DN above black, standard deviation in DN (temporal, rounding included): [points] each.

    Raises
    ------
    SpecError
        If the sensor has no frame pixels.
    """
    aps = sensor.calibrated_part.aps
    electrons = np.geomspace(0.1, aps.spec.full_well_e, points)
    exposure_us = aps.spec.exposure_us
    mean = np.array([float(aps.mean_dn(value, exposure_us)) for value in electrons])
    variance = np.array([float(aps.variance_dn2(value, exposure_us, adc=True)) for value in electrons])
    return electrons, mean - aps.spec.black_level_dn, np.sqrt(variance)
