"""Captures of an asynchronous sensor: the first event of each pixel after a reset, in steady light and after steps.

``evs_noise_rate.npz`` (steady light) and ``evs_s_curve.npz`` (steps of contrast) hold the same arrays, of uniform
light. A trial begins with a reset of the pixels; ``settle_us`` later comes the step of light, and then the time bins
bounded by ``edges_us``. A pixel without an event while settling was calm; its first event after that falls into one of
the bins. ``evs_noise_rate.npz`` may also hold counts of successive parts of the trials in its brightest light, which
tell flickering pixels from steady ones.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.npz import read_arrays
from hesim_render.core.units import S_PER_US
from hesim_render.recording.capture_set import BRIGHTEST_DN, SIGNAL_RANGE, CaptureSet, single_number

NOISE_RATE, S_CURVE = "evs_noise_rate", "evs_s_curve"
_ARRAYS = ("signal_dn", "settle_us", "edges_us", "n_calm", "n_on", "n_off")
_PART_ARRAYS = ("bright_parts", "part_trials", "part_us")
#: Least number of parts.
_FEWEST_PARTS = 8
#: Largest |ln I₁/I₀| of a step.
_LARGEST_CONTRAST = 20.0
#: Least fraction of all trials that must be calm.
_LEAST_CALM = 0.2


@dataclass(frozen=True)
class Parts:
    """Successive parts of the trials in the brightest steady light, one after another without a pause.

    Attributes
    ----------
    disturbed : [part, pixel], number of trials with an event of this pixel at any time after the reset.
    trials : number of trials of a part.
    trial_s : time from one reset to the next, s.
    """

    disturbed: NDArray[np.integer]
    trials: int
    trial_s: float


@dataclass(frozen=True)
class Trials:
    """Trials of one file. Kinds differ in light and step; pixels are in row-major order.

    Attributes
    ----------
    signal_dn, contrast : [kind], light before the step in DN, and ln I₁/I₀, 0 in steady light.
    settle_s : time from reset to step, s.
    edges_s : [bin + 1], bounds of the time bins after the step, s; the first is 0.
    calm : [kind, pixel], number of trials without an event while settling.
    on, off : [kind, bin, pixel], number of calm trials whose first event has this polarity and falls in this bin.
    shape : (rows, cols) of the event grid.
    parts : counts of successive parts, None where there are none.
    """

    signal_dn: NDArray[np.float64]
    contrast: NDArray[np.float64]
    settle_s: float
    edges_s: NDArray[np.float64]
    calm: NDArray[np.integer]
    on: NDArray[np.integer]
    off: NDArray[np.integer]
    shape: tuple[int, int]
    parts: Parts | None = None

    def of(self, pixels: NDArray) -> "Trials":
        """Trials of some pixels, given by indices or a mask, without their parts."""
        return Trials(
            self.signal_dn, self.contrast, self.settle_s, self.edges_s, self.calm[:, pixels], self.on[..., pixels],
            self.off[..., pixels], self.shape,
        )  # fmt: skip

    def towards(self, polarity: int) -> "Trials":
        """The trials without steps towards the other polarity."""
        kinds = np.flatnonzero(np.sign(self.contrast) != -polarity)
        return Trials(
            self.signal_dn[kinds], self.contrast[kinds], self.settle_s, self.edges_s, self.calm[kinds], self.on[kinds],
            self.off[kinds], self.shape,
        )  # fmt: skip

    def events(self, polarity: int) -> NDArray[np.integer]:
        return self.on if polarity > 0 else self.off


def is_asynchronous(captures: CaptureSet) -> bool:
    """Whether the event captures are trials after a reset.

    Raises
    ------
    SpecError
        If the captures do not suit the sensor.
    """
    result = captures.has(S_CURVE) or captures.has(NOISE_RATE)
    evs = captures.sensor.evs if captures.sensor is not None else None
    if evs is not None and evs.reference == "previous_sample" and result:
        raise SpecError(
            "its sensor compares at fixed ticks: capture evs_static.npz and evs_steps.npz, not trials after a reset",
            file=captures.folder / "capture.yaml",
            key="sensor",
        )
    if evs is not None and evs.reference == "last_event" and not result and captures.has("evs_static"):
        raise SpecError(
            "its sensor has reference 'last_event', without comparisons at fixed ticks: capture trials after a reset, "
            f"{NOISE_RATE}.npz and {S_CURVE}.npz",
            file=captures.folder / "capture.yaml",
            key="sensor",
        )
    return result or (evs is not None and evs.reference == "last_event")


def read_trials(captures: CaptureSet) -> tuple[Trials, Trials]:
    """Trials in steady light, and with steps.

    Raises
    ------
    SpecError
        If a file is missing, damaged or invalid; the message says what to capture instead.
    """
    for name, what in (
        (NOISE_RATE, "trials after a reset in steady light, from dark to bright"),
        (S_CURVE, "trials after a reset with steps of contrast up and down"),
    ):
        if not captures.has(name):
            raise SpecError(f"no such file; capture {what}", file=captures.folder / f"{name}.npz")
    steady, steps = (_read(captures.folder / f"{name}.npz", name == S_CURVE) for name in (NOISE_RATE, S_CURVE))
    if steady.shape != steps.shape:
        raise SpecError(
            f"is of {steps.shape[0]}×{steps.shape[1]} pixels, {NOISE_RATE}.npz of {steady.shape[0]}×{steady.shape[1]}",
            file=captures.folder / f"{S_CURVE}.npz",
        )
    return steady, steps


def _read(file: Path, has_steps: bool) -> Trials:
    arrays = read_arrays(file, (*_ARRAYS, *(("contrast",) if has_steps else ())), kinds="uif")
    has_parts = not has_steps and "bright_parts" in arrays
    signal = _list(arrays["signal_dn"], "signal_dn", file)
    if not np.all((signal >= 0) & (signal <= BRIGHTEST_DN)):
        raise SpecError(SIGNAL_RANGE, file=file)
    contrast = _list(arrays.get("contrast", np.zeros(signal.size)), "contrast", file)
    _require_contrast(contrast, signal, has_steps, file)
    settle_s = single_number(arrays["settle_us"], "settle_us", file) * S_PER_US
    edges = _list(arrays["edges_us"], "edges_us", file)
    if edges.size < 2 or edges[0] != 0 or np.any(np.diff(edges) <= 0):
        raise SpecError(
            "edges_us must begin with 0, the time of the step, and rise: bounds of the time bins", file=file
        )
    calm, on, off = (arrays[name] for name in ("n_calm", "n_on", "n_off"))
    if calm.ndim != 3 or calm.size == 0 or len(calm) != signal.size:
        raise SpecError(f"n_calm has shape {calm.shape}; expected [{signal.size} kinds of trials, row, col]", file=file)
    wanted = (signal.size, edges.size - 1, *calm.shape[1:])
    _require_counts({"n_calm": calm, "n_on": on, "n_off": off}, wanted, file)
    events = on.sum(axis=1, dtype=np.int64) + off.sum(axis=1, dtype=np.int64)
    if np.any(events > calm):
        raise SpecError("n_on and n_off hold more trials together than n_calm: count first events only", file=file)
    if calm.sum(dtype=np.float64) < _LEAST_CALM * calm.max(axis=(1, 2)).sum(dtype=np.float64) * calm[0].size:
        raise SpecError(
            "fewer than a fifth of the trials are calm while settling; shorten settle_us, raise the thresholds, or "
            "take brighter light",
            file=file,
        )
    if has_steps and not (on.any() and off.any()):
        raise SpecError("holds no event of one polarity; take steps of up to twice the threshold", file=file)
    count = len(calm)
    return Trials(
        signal, contrast, settle_s, edges * S_PER_US, calm.reshape(count, -1), on.reshape(*wanted[:2], -1),
        off.reshape(*wanted[:2], -1), (calm.shape[1], calm.shape[2]),
        _parts(arrays, signal, calm, events, file) if has_parts else None,
    )  # fmt: skip


def _require_contrast(contrast: NDArray[np.float64], signal: NDArray[np.float64], has_steps: bool, file: Path) -> None:
    """Refuse contrasts [kind] that do not belong to trials with steps, or to trials without."""
    if contrast.shape != signal.shape:
        raise SpecError(f"contrast has {contrast.size} values, signal_dn {signal.size}; each kind needs one", file=file)
    if np.abs(contrast).max() > _LARGEST_CONTRAST:
        raise SpecError(f"contrast, ln I₁/I₀, must lie within ±{_LARGEST_CONTRAST:g}", file=file)
    if has_steps and not (np.any(contrast > 0) and np.any(contrast < 0)):
        raise SpecError("contrast must hold steps up, which tell θ₊, and down, which tell θ₋", file=file)
    if has_steps and (np.any(contrast == 0) or np.any(signal == 0)):
        raise SpecError(
            f"a step needs light before it and a contrast; steady light goes into {NOISE_RATE}.npz", file=file
        )
    if not has_steps and np.any(contrast != 0):
        raise SpecError(f"contrast must be 0 in steady light; steps go into {S_CURVE}.npz", file=file)


def _require_counts(counts: Mapping[str, NDArray], wanted: tuple[int, ...], file: Path) -> None:
    """Refuse counts of trials that are no whole numbers, or not of the shape of those of events."""
    for name, values in counts.items():
        if values.dtype.kind not in "ui":
            raise SpecError(f"{name} holds {values.dtype.name}; save whole numbers of trials", file=file)
        if name != "n_calm" and values.shape != wanted:
            raise SpecError(
                f"{name} has shape {values.shape}; expected {wanted}: [kind, time bin, row, col]", file=file
            )
        if values.min() < 0 or values.max() >= 2**31:
            raise SpecError(f"{name} holds numbers below 0, or beyond 2^31", file=file)


def _parts(
    arrays: dict[str, NDArray], signal: NDArray[np.float64], calm: NDArray, events: NDArray, file: Path
) -> Parts:
    """``bright_parts``, checked against the counts of the brightest light."""
    for name in _PART_ARRAYS:
        if name not in arrays:
            raise SpecError(f"holds bright_parts and no {name!r}, which belongs to it", file=file)
    disturbed = arrays["bright_parts"]
    trials = int(single_number(arrays["part_trials"], "part_trials", file, whole=True, least=2))
    part_s = single_number(arrays["part_us"], "part_us", file) * S_PER_US
    if disturbed.ndim != 3 or disturbed.shape[1:] != calm.shape[1:] or disturbed.dtype.kind not in "ui":
        raise SpecError(f"bright_parts must be whole numbers [part, row, col] of {calm.shape[1:]} pixels", file=file)
    if len(disturbed) < _FEWEST_PARTS:
        raise SpecError(f"bright_parts holds {len(disturbed)} parts; expected {_FEWEST_PARTS} or more", file=file)
    bright = int(np.argmax(signal))
    silent = calm[bright].astype(np.int64) - events[bright]
    if disturbed.min() < 0 or disturbed.max() > trials:
        raise SpecError(f"bright_parts holds numbers outside 0 to part_trials = {trials}", file=file)
    if np.any(disturbed.sum(axis=0, dtype=np.int64) + silent != trials * len(disturbed)):
        raise SpecError(
            "bright_parts does not add up: the trials with an event, and those of the brightest signal_dn without one "
            "(n_calm less n_on and n_off), must be part_trials times the number of parts",
            file=file,
        )
    return Parts(disturbed.reshape(len(disturbed), -1), trials, part_s / trials)


def _list(values: NDArray, name: str, file: Path) -> NDArray[np.float64]:
    result = values.astype(np.float64)
    if result.ndim != 1 or result.size == 0 or not np.all(np.isfinite(result)):
        raise SpecError(f"{name} must be a list of finite numbers", file=file)
    return result
