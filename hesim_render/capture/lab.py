"""A virtual calibration session: the captures that a person would make with the sensor on a bench.

Frames and events come from the same noise models and the same event stage as in a simulation. The light
is that of `hesim_render.capture.lab_bench`.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.capture.lab_bench import Bench, set_up, truth_of
from hesim_render.capture.lab_trials import TrialBench, TrialPlan, plan_trials
from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float
from hesim_render.core.errors import RangeError
from hesim_render.core.host_arrays import from_host
from hesim_render.core.npz import NpzWriter
from hesim_render.core.output import OutputFolder, output_errors
from hesim_render.core.progress import Progress
from hesim_render.core.units import S_PER_US
from hesim_render.core.yaml_file import yaml_text
from hesim_render.pixels.evs.stage import EvsStage
from hesim_render.sensor.reading import read_sensor
from hesim_render.sensor.sensor import Sensor, as_sensor
from hesim_render.specs.files import content_hash, list_names

CAPTURE_NAME = "capture.yaml"
#: Exposure sets of the paper, µs. The longer dark set of its two sensors is used for every sensor.
DARK_EXPOSURES_US = (1000, 5000, 20000, 50000, 80000)
LIT_EXPOSURES_US = (1000, 2000, 5000, 10000, 20000, 40000, 50000, 80000)

#: S-curve: contrasts from −2 θ to 2 θ; the brightest level is that of the target's brightest patch.
_CONTRASTS, _REACH = 21, 2.0
_LEAST_TRIALS = 50
_FEWEST_FRAMES = 8
_FEWEST_TRIALS = 4
_FEWEST_PARTS, _MOST_PARTS = 8, 8191
_FRAME_WORK = 8  # a frame takes about as long as this many ticks
_NODES_PER_CUTOFF_PERIOD = 16  # of the noise of asynchronous pixels, each of which costs about as much as a tick


def write_captures(
    sensor: Sensor | str | Path,
    out: str | Path,
    *,
    frames: int = 64,
    ticks: int = 20000,
    trials: int = 20,
    seed: int = 7,
    without: Sequence[str] = (),
    parts: int = 0,
    dark_exposures_us: Sequence[int] = DARK_EXPOSURES_US,
    lit_exposures_us: Sequence[int] = LIT_EXPOSURES_US,
    illuminant: str = "D65",
    overwrite: bool = False,
    progress: Progress | None = None,
    on_estimate: Callable[[object], None] | None = None,
) -> Path:
    """Run a calibration session and write its capture set, which appears whole or not at all; returns the folder.

    Parameters
    ----------
    sensor : from `load_sensor`, or its name or path; crop it to capture a part. Frames are streamed to disk, so memory
        does not grow with their number.
    out : folder to write.
    frames : number of frames per exposure, dark and lit.
    ticks : number of comparisons on the static target, and again in the dark; the S-curve takes a
        hundredth of them, at least 50, at each of 21 contrasts. For sensors with fixed comparisons.
    trials : number of trials after a reset, at each level of light and each step of contrast. For sensors with
        reference ``last_event``.
    seed : seed of the temporal noise. Every frame, tick and trial of a session has its own number, so noise never
        repeats.
    without : noise terms to switch off, as in `simulate`.
    parts : number of equal parts of the dark ticks that are also counted separately (``dark_parts``). They distinguish
        flickering event pixels from steady ones. A divisor of `ticks`, at least 8; or 0 for none. For sensors with
        reference ``last_event``: number of parts of 8 trials in the brightest steady light (``bright_parts``).
    dark_exposures_us, lit_exposures_us : exposures of the dark and of the lit frames, µs.
    illuminant : name of the light's spectrum.
    overwrite : replace an existing capture set.
    progress : called with (done, total, what).
    on_estimate : called with the size of the set before the session begins, a text; an exception that it raises ends
        the session before anything is written.

    Raises
    ------
    RangeError
        If a number is out of range, or a noise term does not exist.
    SpecError
        If the illuminant is unknown or does not cover the response.
    OutputError
        If `out` exists or cannot be written.
    """
    sensor = as_sensor(sensor)
    _require(
        sensor,
        frames,
        ticks,
        trials,
        seed,
        parts,
        {"dark exposures": dark_exposures_us, "lit exposures": lit_exposures_us},
    )
    bench = set_up(sensor, lit_exposures_us, illuminant, without)
    session = _Session(bench, seed, progress)
    step_trials = max(_LEAST_TRIALS, ticks // 100)
    plans: dict[str, TrialPlan] = {}
    if bench.evs is not None and bench.evs.spec.reference == "last_event":
        plans = plan_trials(bench.evs, trials, parts)
        session.total += sum(session.work_of(plan.duration_s) for plan in plans.values())
    shots = 0 if bench.aps is None else frames * (len(dark_exposures_us) + len(lit_exposures_us))
    comparisons = 0 if bench.evs is None or plans else 2 * ticks + 2 * step_trials * _CONTRASTS
    session.total += _FRAME_WORK * shots + comparisons
    if on_estimate is not None:
        on_estimate(_size_in_words(sensor, shots, comparisons, plans))
    with OutputFolder(out, CAPTURE_NAME, overwrite) as folder, output_errors(folder.target):
        if bench.aps is not None:
            session.write_frames(folder.path / "aps_dark.npz", dark_exposures_us, frames, 0.0)
            session.write_frames(folder.path / "aps_lit.npz", lit_exposures_us, frames, 1.0)
        if plans:
            session.write_trials(folder.path, plans)
        elif bench.evs is not None:
            session.write_static(folder.path / "evs_static.npz", ticks, parts)
            session.write_steps(folder.path / "evs_steps.npz", step_trials)
        _describe(bench, folder.path, illuminant, seed, max(lit_exposures_us))
    return folder.target


def _require(
    sensor: Sensor, frames: int, ticks: int, trials: int, seed: int, parts: int, exposures: Mapping[str, Sequence[int]]
) -> None:
    """Refuse numbers that a session cannot have; see `write_captures`."""
    for name, times in exposures.items():
        if len(set(times)) < max(2, len(times)) or min(times) <= 0:
            raise RangeError(name, list(times), "two or more different times above 0, in µs")
    if frames < _FEWEST_FRAMES:
        raise RangeError("frames", frames, f"{_FEWEST_FRAMES} or more, to get a variance")
    if not 1 <= ticks < 2**31:
        raise RangeError("ticks", ticks, "1 to 2^31 - 1")
    if not _FEWEST_TRIALS <= trials < 2**16:
        raise RangeError("trials", trials, f"{_FEWEST_TRIALS} to 65535")
    has_ticks = sensor.spec.evs is None or sensor.spec.evs.reference == "previous_sample"
    if parts and has_ticks and (parts < _FEWEST_PARTS or ticks % parts):
        raise RangeError("parts", parts, f"0, or a divisor of the {ticks} ticks from {_FEWEST_PARTS} on")
    if parts and not has_ticks and not _FEWEST_PARTS <= parts <= _MOST_PARTS:
        raise RangeError("parts", parts, f"0, or {_FEWEST_PARTS} to {_MOST_PARTS}")
    if not 0 <= seed < 2**64:
        raise RangeError("seed", seed, "0 to 2^64 - 1")


def _size_in_words(sensor: Sensor, shots: int, comparisons: int, plans: Mapping[str, TrialPlan]) -> str:
    """What a session takes: frames, and trials or comparisons of event pixels."""
    sizes = [f"{shots} frames, {shots * sensor.rows * sensor.cols * 2e-9:.3g} GB"] if shots else []
    if plans:
        seconds = sum(plan.duration_s for plan in plans.values())
        sizes.append(f"event pixels for {seconds:.3g} s, in {len(plans)} kinds of trials")
    if comparisons:
        sizes.append(f"{comparisons} comparisons of event pixels")
    return "; ".join(sizes)


@dataclass
class _Session:
    """Numbers the frames and ticks of a session, and reports its progress."""

    bench: Bench
    seed: int
    progress: Progress | None
    total: float = 0.0
    done: float = 0.0
    frame: int = 0
    trial: int = 0
    t_us: int = 0

    def _advance(self, work: float, what: str) -> None:
        self.done += work
        if self.progress is not None:
            self.progress(self.done, self.total, what)

    def write_frames(self, file: Path, exposures_us: Sequence[int], frames: int, light: float) -> None:
        aps, layout = self.bench.aps, self.bench.sensor.layout
        assert aps is not None
        flux = from_host(jit().Float, light * self.bench.frame_flux_e_per_s)
        valid = layout.aps_mask

        def shoot() -> Iterator[NDArray[np.uint16]]:
            for exposure_us in exposures_us:
                electrons = flux * dr.opaque(jit().Float, exposure_us * S_PER_US)  # a constant is another kernel
                for _ in range(frames):
                    raw = aps.sample(electrons, exposure_us, self.seed, self.frame)
                    self.frame += 1
                    self._advance(_FRAME_WORK, file.stem)
                    yield np.where(valid, raw, 0).astype(np.uint16)

        with NpzWriter(file) as archive:
            archive.add("exposures_us", np.array(exposures_us, dtype=np.int64))
            archive.add_pieces("frames", (len(exposures_us), frames, *layout.shape), np.uint16, shoot())

    def write_static(self, file: Path, ticks: int, parts: int = 0) -> None:
        signal = self.bench.event_signal_dn
        on, off = self._counts([self._electrons(signal)], ticks, "event counts, lit")
        by_part = np.zeros((parts, *signal.shape), dtype=np.min_scalar_type(ticks))
        dark_on, dark_off = self._counts([self._electrons(0.0 * signal)], ticks, "event counts, dark", by_part)
        arrays: dict[str, NDArray] = {
            "signal_dn": signal, "n_on": on, "n_off": off, "n_trials": np.array(ticks),
            "dark_n_on": dark_on, "dark_n_off": dark_off,
        }  # fmt: skip
        if parts:
            arrays["dark_parts"] = by_part
        with NpzWriter(file) as archive:
            for name, array in arrays.items():
                archive.add(name, array)

    def write_steps(self, file: Path, trials: int) -> None:
        """Steps from one level to others and back. Only the step away from the first level is counted.

        The light is set per filter, so that every event pixel starts from the same signal.
        """
        evs = self.bench.evs
        assert evs is not None
        theta = (evs.spec.contrast_threshold_on + evs.spec.contrast_threshold_off) / 2
        contrast = theta * np.linspace(-_REACH, _REACH, _CONTRASTS)
        level = np.full(self.bench.event_signal_dn.shape, np.exp(-contrast[-1]) * self.bench.event_signal_dn.max())
        before = self._electrons(level)
        counts = [
            self._counts([before, self._electrons(level * np.exp(step))], trials, "contrast steps") for step in contrast
        ]
        with NpzWriter(file) as archive:
            archive.add("contrast", contrast)
            archive.add("signal_dn", np.array(level.flat[0]))
            archive.add("n_trials", np.array(trials))
            for k, name in enumerate(("n_on", "n_off")):
                archive.add_pieces(name, (len(counts), *level.shape), counts[0][k].dtype, (pair[k] for pair in counts))

    def work_of(self, duration_s: float) -> float:
        """What trials of asynchronous pixels cost, in ticks."""
        assert self.bench.evs is not None and self.bench.evs.spec.noise_cutoff_hz is not None
        return duration_s * _NODES_PER_CUTOFF_PERIOD * self.bench.evs.spec.noise_cutoff_hz

    def write_trials(self, folder: Path, plans: dict[str, TrialPlan]) -> None:
        """Trials after a reset, of asynchronous pixels."""
        assert self.bench.evs is not None
        for name, plan in plans.items():

            def advance(seconds: float, name: str = name) -> None:
                self._advance(self.work_of(seconds), name)

            scale = self.bench.event_dn_per_e_per_s
            bench = TrialBench(self.bench.evs, scale, self.seed, advance, self.t_us, self.trial)
            bench.write(folder / f"{name}.npz", plan)
            self.t_us, self.trial = bench.t_us, bench.count

    def _electrons(self, signal_dn: NDArray[np.float64]) -> Float:
        """Electrons of one event window, flat on the device."""
        assert self.bench.evs is not None
        seconds = self.bench.evs.spec.window_us * S_PER_US
        return from_host(jit().Float, signal_dn / self.bench.event_dn_per_e_per_s * seconds)

    def _counts(
        self, levels: Sequence[Float], trials: int, what: str, parts: NDArray | None = None
    ) -> tuple[NDArray, NDArray]:
        """ON and OFF events [y, x] of `trials` steps to the last level; the levels are shown in turn.

        For a single level, events of successive parts of the trials are added to `parts` [part, y, x].
        """
        evs = self.bench.evs
        assert evs is not None and evs.spec.tick_us is not None
        shape = self.bench.sensor.layout.evs_shape
        on, off = np.zeros((2, shape[0] * shape[1]), dtype=np.min_scalar_type(trials))
        stage, period = EvsStage(evs, self.seed), len(levels)
        # the very first sample is only a reference
        for k in range(trials * period + (period == 1)):
            self.t_us += evs.spec.tick_us
            events = stage.step(levels[k % period], self.t_us)
            if k % period == period - 1:
                # a pixel has at most one event per tick
                pixel = events["y"].astype(np.int64) * shape[1] + events["x"]
                on[pixel[events["polarity"] > 0]] += 1
                off[pixel[events["polarity"] < 0]] += 1
                if parts is not None and len(parts) and k > 0:
                    parts[(k - 1) * len(parts) // trials].flat[pixel] += 1
            if k % 64 == 0:
                self._advance(min(64, trials * period - k), what)
        return on.reshape(shape), off.reshape(shape)


def _describe(bench: Bench, folder: Path, illuminant: str, seed: int, longest_us: float) -> None:
    """Write ``capture.yaml``, and the sensor's file if it is not a shipped one."""
    spec, layout = bench.sensor.spec, bench.sensor.layout
    shipped = bench.sensor.file in list_names("sensors") and content_hash(
        read_sensor(bench.sensor.file)
    ) == content_hash(spec)
    if not shipped:
        content_of_sensor = spec.model_dump(mode="json", exclude_none=True, exclude={"noise"})
        (folder / "sensor.yaml").write_text(yaml_text(content_of_sensor), encoding="utf-8")
    tile_rows, tile_cols = layout.tile_shape
    content: dict[str, object] = {
        "bit_depth": 16 if bench.aps is None else bench.aps.spec.bit_depth,
        "tile_rows": tile_rows,
        "tile_cols": tile_cols,
        "sensor": bench.sensor.file if shipped else "sensor.yaml",
        "illuminant": illuminant,
        "roi": {"x": layout.col0, "y": layout.row0, "width_px": layout.cols, "height_px": layout.rows},
    }
    if bench.aps is not None:
        content["frame_rate_hz"] = bench.aps.spec.frame_rate_hz
    if bench.evs is not None:
        if bench.evs.spec.reference == "previous_sample":
            content["tick_us"] = bench.evs.spec.tick_us
        reference = bench.evs.spec.signal_reference
        if bench.evs.spec.threshold_hardware_v is not None:
            content["theta_hardware_v"] = bench.evs.spec.threshold_hardware_v
        content["signal_reference"] = {
            "k": reference.k_dn_per_e, "t_ref_us": reference.t_ref_us, "filter": reference.filter
        }  # fmt: skip
        content["contrast_of"] = "signal"
    content["notes"] = (
        f"a virtual session, hesim-render calibrate lab {spec.name}: {illuminant}, {bench.lux:.4g} lux on the "
        f"brightest patch; seed {seed}"
    )
    content["truth"] = truth_of(bench, longest_us)
    (folder / CAPTURE_NAME).write_text(yaml_text(content), encoding="utf-8")
