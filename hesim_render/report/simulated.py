"""An instrument that records a simulated sensor on a bench of even light, as a person would a real one.

It chooses lights, contrasts and times from the nominal figures of the sensor and from what it has recorded so far. The
recordings are files; the estimators read nothing else.
"""

import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device_types import Float
from hesim_render.core.host_arrays import from_host
from hesim_render.core.units import S_PER_US, US_PER_S
from hesim_render.core.yaml_file import yaml_text
from hesim_render.exchange import EventStream, evt3
from hesim_render.pixels.evs.events import no_events
from hesim_render.pixels.evs.stage import EvsStage
from hesim_render.report.bench import BENCH_NAME, EventBench
from hesim_render.report.latency import answers
from hesim_render.report.limits import DETECTED
from hesim_render.report.s_curves import s_curve
from hesim_render.sensor.from_data_sheet import electrons_per_s_lux
from hesim_render.sensor.sensor import Sensor
from hesim_render.spectral.spectrum import illuminant

#: Light of S-curves, bandwidth and busy recordings, lx.
REFERENCE_LUX = 1000.0
#: Lights of the other recordings, from the reference on: darker ones, brighter ones.
_DARKER, _BRIGHTER = (300.0, 100.0, 30.0, 10.0, 3.0, 1.0, 0.3, 0.1, 0.03, 0.01), (1e4, 1e5)
#: Coarse and fine steps of the S-curve: thresholds, widths of the curve; periods of each.
_COARSE, _FINE = (0.0, 0.4, 0.6, 0.8, 1.0, 1.2, 1.5, 2.0), (-2.4, -1.5, -0.7, 0.0, 0.7, 1.5, 2.4)
_COARSE_PERIODS, _FINE_PERIODS = 2, 6
#: Periods of steps of two thresholds at each light.
_PERIODS = 2
#: Longest half period, µs: darker lights, which need more, are left out.
_LONGEST_US = 1_200_000
#: Swings of modulated light in thresholds, frequencies in corners, cycles, samples of each.
_SWINGS, _FREQUENCIES = (0.6, 0.85, 1.2, 1.7, 2.4, 3.4), (1 / 8, 1 / 4, 1 / 2, 1.0, 2.0)
_CYCLES, _SAMPLES = 8, 48
#: Bursts: their number, cycles of each, swings in those of continuous light, since a burst begins in the middle.
_BURSTS, _BURST_CYCLES, _BURST_SWING = 2, 5, 1.7
#: Busy light: thresholds of a step, periods.
_BUSY, _BUSY_PERIODS = 12.0, 10
#: Rapid light: swing in thresholds, cycles.
_RAPID, _RAPID_CYCLES = 30.0, 20
#: Shortest steady recording, µs, and half periods in it.
_STEADY_US, _STEADY_PERIODS = 1_000_000, 4


class Instrument:
    """A bench with a simulated sensor on it.

    Parameters
    ----------
    sensor : with event pixels, cropped to what is recorded.
    folder : for the recordings.
    seed : of all noise; each recording has its own.
    progress : called with what is being recorded, and the part that is done.
    """

    def __init__(self, sensor: Sensor, folder: Path, seed: int, progress: Callable[[str, float], None]) -> None:
        self._noise, self._folder, self._seed, self._progress = sensor.evs, folder, seed, progress
        spec, layout = sensor.spec, sensor.layout
        evs = self._noise.spec
        sheet = evs.data_sheet or evs.v2e
        self._light = sheet.light.load() if sheet is not None else illuminant("D65")
        flux = np.array([
            electrons_per_s_lux(spec, spec.pixels[spec.tile_rows[row][col]].filter, self._light)
            for row, col in spec.positions("evs")
        ])  # fmt: skip
        self._per_lux = flux[layout.evs_position].ravel() * (evs.window_us * S_PER_US)
        rows, cols = layout.evs_shape
        self._shape = rows, cols
        self._number = 0
        self._content: dict[str, Any] = {
            "schema_version": 1, "sensor": sensor.name, "notes": self._notes(), "simulated": True,
            "rows": rows, "cols": cols, "steady": [], "steps": [], "modulation": [], "busy": [],
        }  # fmt: skip

    def _notes(self) -> str:
        notes = f"simulated; even light, {self._light_name()}"
        if self._noise.spec.reference == "previous_sample":
            return notes + "; the light jumps right after a comparison of the pixels, so that a latency is the longest"
        return notes + "; all pixels are reset before each jump and each burst"

    def _light_name(self) -> str:
        sheet = self._noise.spec.data_sheet or self._noise.spec.v2e
        return "D65" if sheet is None else "the light of the data sheet"

    def record(self) -> Path:
        """Record everything, and write ``bench.yaml``."""
        evs = self._noise.spec
        theta = (evs.contrast_threshold_on + evs.contrast_threshold_off) / 2
        self._progress("S-curves", 0.02)
        for part in _COARSE:
            self._steps(REFERENCE_LUX, max(part, 0.02) * theta, _COARSE_PERIODS)
        for low, centre, high in self._coarse_curves():
            width = min(max((high - low) / 1.7, 0.03 * centre), 0.2 * centre)
            for part in _FINE:
                self._steps(REFERENCE_LUX, max(centre + part * width, 0.02 * theta), _FINE_PERIODS)
        bench = self._written()
        everything = np.ones(bench.pixels, np.bool_)
        curves = [s_curve(bench.responses, polarity, everything) for polarity in (0, 1)]
        pairs = [2 * curve.theta for curve in curves if np.isfinite(curve.theta)] or [2 * theta]
        if max(pairs) < 1.02 * min(pairs):
            pairs = [float(np.mean(pairs))]
        self._lights(pairs)
        self._progress("bandwidth", 0.8)
        self._modulations(theta)
        self._progress("busy light", 0.95)
        self._content["busy"] += [self._strobe(theta), self._rapid(theta)]
        self._write()
        return self._folder

    def _lights(self, pairs: list[float]) -> None:
        """Steady light and steps of two thresholds, from the reference to both ends."""
        for k, lux in enumerate((REFERENCE_LUX, *_BRIGHTER)):
            self._progress(f"{lux:g} lx", 0.2 + 0.03 * k)
            self._one_light(lux, pairs)
        for k, lux in enumerate(_DARKER):
            if self._half_us(lux) > _LONGEST_US:
                break
            self._progress(f"{lux:g} lx", 0.3 + 0.05 * k)
            if self._one_light(lux, pairs) < DETECTED / 2:
                break

    def _one_light(self, lux: float, pairs: list[float]) -> float:
        """The smallest share of steps that are found."""
        half_us = self._half_us(lux)
        outcome = []
        for size in pairs:
            self._steps(lux, size, _PERIODS)
            bench = self._written()
            one = bench.answers_to(bench.spec.steps[-1])
            everything = np.ones(bench.pixels, np.bool_)
            outcome += [answers(one, polarity, everything, None).share for polarity in (0, 1)]
        length_us = max(_STEADY_US, _STEADY_PERIODS * half_us)
        events = self._run([(0, lux), (length_us, lux)])
        name = self._save(events, f"steady-{lux:g}lx")
        self._content["steady"].append({"file": name, "lux": lux, "interval_us": [0, length_us]})
        return min(outcome)

    def _coarse_curves(self) -> list[tuple[float, ...]]:
        """Sizes at which 20, 50 and 80 % of the steps are answered so far, of rises and of falls."""
        every = self._written().responses
        size = [one.size for one in every]
        shares = [[float((one.of(polarity) > 0).mean()) for one in every] for polarity in (0, 1)]
        rising = [np.maximum.accumulate(share) + 1e-9 * np.arange(len(size)) for share in shares]
        return [tuple(float(np.interp(part, share, size)) for part in (0.2, 0.5, 0.8)) for share in rising]

    def _half_us(self, lux: float) -> int:
        """Time in which the pixels settle after a jump, µs."""
        evs = self._noise.spec
        if evs.reference == "previous_sample":
            return 4 * (evs.tick_us or 1)
        corner_hz = evs.noise_cutoff_hz or 1.0
        if evs.photoreceptor is not None:
            corner_hz = evs.photoreceptor.cutoff_hz
            if evs.photoreceptor.follows_light:
                electrons = np.array(lux * self._per_lux.mean())
                corner_hz = float(self._noise.corner_hz(electrons, 0))
        dead_us = evs.refractory_period_us or 0
        return max(math.ceil(US_PER_S / corner_hz), 4 * dead_us, 2000)

    def _steps(self, lux: float, size: float, periods: int) -> None:
        """Steps of `size` (ln) up and down."""
        half_us, contrast = self._half_us(lux), math.expm1(size)
        levels = [lux, lux * (1 + contrast)]
        begin_us = half_us
        jumps = [(begin_us + k * half_us, levels[k % 2], levels[(k + 1) % 2]) for k in range(2 * periods)]
        end_us = begin_us + 2 * periods * half_us
        has_ticks = self._noise.spec.reference == "previous_sample"
        if has_ticks:
            events = self._run([(0, lux), *((t + 1, after) for t, _, after in jumps), (end_us, lux)])
        else:
            events = self._run_reset(lux, jumps, end_us)
        self._number += 1
        name = self._save(events, f"steps-{lux:g}lx-{self._number}")
        self._content["steps"].append({
            "file": name, "lux": lux, "contrast": contrast, "begin_us": begin_us, "period_us": 2 * half_us,
            "reset": not has_ticks, "interval_us": [0, end_us],
        })  # fmt: skip

    @property
    def _corner_hz(self) -> float:
        """Corner frequency of the pixels in bright light, or half of the highest frequency that ticks can see."""
        evs = self._noise.spec
        if evs.reference == "previous_sample":
            return US_PER_S / (evs.tick_us or 1) / 4
        return evs.photoreceptor.cutoff_hz if evs.photoreceptor else (evs.noise_cutoff_hz or 1.0)

    def _sine(self, hz: float, swing: float, cycles: int) -> tuple[NDArray[np.void], int]:
        """Events of light whose logarithm swings by `swing`, and the end, µs."""
        depth = math.tanh(swing / 2)
        time_us = np.unique(np.round(np.arange(cycles * _SAMPLES + 1) * (US_PER_S / hz / _SAMPLES)).astype(int))
        lux = REFERENCE_LUX * (1 + depth * np.sin(2 * np.pi * hz * time_us * S_PER_US))
        return self._run(zip(time_us.tolist(), lux.tolist(), strict=True)), int(time_us[-1])

    def _modulations(self, theta: float) -> None:
        """Continuous modulation of pixels with ticks; bursts, each after a reset, of others."""
        has_ticks = self._noise.spec.reference == "previous_sample"
        for part in _FREQUENCIES:
            hz = float(f"{part * self._corner_hz:.3g}")
            for number in _SWINGS:
                swing = number * theta * (1.0 if has_ticks else _BURST_SWING)
                about: dict[str, Any] = {"lux": REFERENCE_LUX, "hz": hz, "depth": math.tanh(swing / 2)}
                if has_ticks:
                    events, end_us = self._sine(hz, swing, _CYCLES)
                else:
                    events, end_us, about["bursts"] = self._bursts(hz, swing)
                name = self._save(events, f"sine-{hz:g}hz-{number:g}")
                self._content["modulation"].append({"file": name, **about, "interval_us": [0, end_us]})

    def _bursts(self, hz: float, swing: float) -> tuple[NDArray[np.void], int, dict[str, int]]:
        """Events of bursts of modulated light; the end, µs, and the times of the bursts."""
        length_us = math.ceil(_BURST_CYCLES * US_PER_S / hz)
        pause_us = self._half_us(REFERENCE_LUX)
        after_us = np.unique(np.round(np.linspace(0, length_us, _BURST_CYCLES * _SAMPLES + 1)).astype(int))
        envelope = np.sin(np.pi * after_us / length_us) ** 2
        lux = REFERENCE_LUX * np.exp(swing / 2 * envelope * np.sin(2 * np.pi * hz * after_us * S_PER_US))
        stage, parts = self._stage(), [no_events()]
        times = {"begin_us": pause_us, "length_us": length_us, "period_us": length_us + pause_us}
        parts.append(stage.step(self._electrons(REFERENCE_LUX), 0))
        for k in range(_BURSTS):
            begin_us = times["begin_us"] + k * times["period_us"]
            parts.append(stage.step(self._electrons(REFERENCE_LUX), begin_us))
            stage.compare_with(stage.level)
            parts += [
                stage.step(self._electrons(float(light)), begin_us + int(t_us))
                for t_us, light in zip(after_us[1:], lux[1:], strict=True)
            ]
        end_us = times["begin_us"] + _BURSTS * times["period_us"]
        parts.append(stage.step(self._electrons(REFERENCE_LUX), end_us))
        return np.concatenate(parts), end_us, times

    def _rapid(self, theta: float) -> str:
        """Light that changes by a threshold in a short time, always: the next event comes right after the dead time."""
        dead_s = (self._noise.spec.refractory_period_us or 0) * S_PER_US
        cycles = _RAPID_CYCLES + math.ceil(_RAPID_CYCLES * dead_s * self._corner_hz)
        return self._save(self._sine(self._corner_hz, _RAPID * theta, cycles)[0], "rapid")

    def _strobe(self, theta: float) -> str:
        half_us = self._half_us(REFERENCE_LUX)
        levels = [REFERENCE_LUX, REFERENCE_LUX * math.exp(_BUSY * theta)]
        points = [(0, levels[0])]
        for k in range(2 * _BUSY_PERIODS):
            points += [((k + 1) * half_us, levels[k % 2]), ((k + 1) * half_us + 1, levels[(k + 1) % 2])]
        return self._save(self._run([*points, ((2 * _BUSY_PERIODS + 1) * half_us, levels[0])]), "busy")

    def _run_reset(self, lux: float, jumps: list[tuple[int, float, float]], end_us: int) -> NDArray[np.void]:
        """Events of asynchronous pixels that are reset right before each jump, which takes a microsecond."""
        stage = self._stage()
        parts = [stage.step(self._electrons(lux), 0)]
        for t_us, before, after in jumps:
            parts.append(stage.step(self._electrons(before), t_us))
            stage.compare_with(stage.level)
            parts.append(stage.step(self._electrons(after), t_us + 1))
        parts.append(stage.step(self._electrons(jumps[-1][2]), end_us))
        return np.concatenate(parts)

    def _run(self, points: Iterable[tuple[int, float]]) -> NDArray[np.void]:
        """Events in the light of points (µs, lx): in between, ln of the light is a straight line, or the light of the
        last point before a comparison holds for pixels with ticks."""
        stage, tick_us = self._stage(), self._noise.spec.tick_us
        every = list(points)
        if self._noise.spec.reference != "previous_sample":
            return np.concatenate([no_events(), *(stage.step(self._electrons(lux), t_us) for t_us, lux in every)])
        assert tick_us is not None
        times = np.array([t_us for t_us, _ in every])
        parts = [no_events()]
        for t_us in range(0, int(times[-1]) + 1, tick_us):
            here = int(np.searchsorted(times, t_us, side="right")) - 1
            parts.append(stage.step(self._electrons(every[here][1]), t_us))
        return np.concatenate(parts)

    def _stage(self) -> EvsStage:
        self._seed += 1
        return EvsStage(self._noise, self._seed % 2**64)

    def _electrons(self, lux: float) -> Float:
        return from_host(jit().Float, lux * self._per_lux)

    def _save(self, events: NDArray[np.void], name: str) -> str:
        file = self._folder / f"{name}.raw"
        with file.open("wb") as target:
            evt3.write(EventStream.of(events, self._shape, file), target, file)
        return file.name

    def _write(self) -> None:
        content = {key: value for key, value in self._content.items() if value or key == "schema_version"}
        (self._folder / BENCH_NAME).write_text(yaml_text(content, width=120), encoding="utf-8")

    def _written(self) -> EventBench:
        """What has been recorded so far, as the estimators see it."""
        self._write()
        return EventBench(self._folder)
