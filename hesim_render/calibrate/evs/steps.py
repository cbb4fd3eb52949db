"""``evs_steps.npz``: events after steps of contrast, read one step at a time."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.npz import read_arrays
from hesim_render.recording.capture_set import BRIGHTEST_DN, SIGNAL_RANGE, CaptureSet, count_maps, single_number

#: Number of groups of pixels with separate sums; each group is left out in turn (jackknife).
GROUPS = 100


@dataclass(frozen=True)
class Steps:
    """Sums over ``evs_steps.npz``.

    Attributes
    ----------
    contrast : [step], as in the file.
    signal_dn : signal of I₀, one number, DN.
    on, off : [step, group], events of the good pixels of each of `GROUPS` groups.
    pixels : [group], number of good pixels.
    trials : trials of one pixel and step.
    on_total, off_total : [row, col], events of a pixel over all steps.
    group : [row, col], group of each pixel.
    """

    contrast: NDArray[np.float64]
    signal_dn: float
    on: NDArray[np.float64]
    off: NDArray[np.float64]
    pixels: NDArray[np.float64]
    trials: int
    on_total: NDArray[np.int64]
    off_total: NDArray[np.int64]
    group: NDArray[np.intp]

    @property
    def trials_of_all(self) -> float:
        """Trials of all good pixels together, at one step."""
        return float(self.pixels.sum()) * self.trials


def pixel_groups(shape: tuple[int, ...]) -> NDArray[np.intp]:
    """Group of every pixel [row, col], drawn at random with a fixed seed, so that neighbours are rarely together."""
    return np.random.default_rng(20).integers(0, GROUPS, shape)


def read_steps(captures: CaptureSet, good: NDArray[np.bool_]) -> Steps:
    """Read ``evs_steps.npz`` of a sensor of fixed comparisons.

    Raises
    ------
    SpecError
        If arrays are missing or do not fit each other or the static capture.
    """
    file = captures.folder / "evs_steps.npz"
    contrast, signal, small = read_contrast(captures, ("n_trials",))
    trials = int(single_number(small["n_trials"], "n_trials", file, whole=True, least=1))
    if signal.size > 1:
        if signal.shape != good.shape:
            raise SpecError(f"signal_dn is of size {signal.shape}; expected one number or {good.shape}", file=file)
        signal = signal[good]
        if np.ptp(np.quantile(signal, [0.01, 0.99])) > 0.1 * np.median(signal):
            raise SpecError(
                "signal_dn of the steps varies by more than 10 %; capture them on a uniform light", file=file
            )
    group = pixel_groups(good.shape)
    sums, totals = {}, {}
    for name in ("n_on", "n_off"):
        rows = []
        total = np.zeros(good.shape, np.int64)
        for counts in step_maps(captures, name, contrast.size, good.shape, trials):
            rows.append(np.bincount(group[good], counts[good], GROUPS))
            total += counts
        sums[name], totals[name] = np.array(rows, dtype=np.float64), total
    return Steps(
        contrast=contrast,
        signal_dn=float(np.median(signal)),
        on=sums["n_on"],
        off=sums["n_off"],
        pixels=np.bincount(group[good], minlength=GROUPS).astype(np.float64),
        trials=trials,
        on_total=totals["n_on"],
        off_total=totals["n_off"],
        group=group,
    )


def read_contrast(
    captures: CaptureSet, more: tuple[str, ...]
) -> tuple[NDArray[np.float64], NDArray[np.float64], dict[str, NDArray]]:
    """contrast [step], signal_dn (a number or a map) and the small arrays `more`, checked.

    Raises
    ------
    SpecError
        If one is missing or is not of numbers.
    """
    file = captures.folder / "evs_steps.npz"
    small = read_arrays(file, ("contrast", "signal_dn", "n_on", "n_off", *more), skip=("n_on", "n_off"))
    contrast = small["contrast"]
    if contrast.dtype.kind not in "uif" or contrast.ndim != 1 or not np.all(np.isfinite(contrast)):
        raise SpecError("contrast must be a list of finite numbers, ln I₁/I₀ of each step", file=file)
    if np.unique(contrast).size < 3:
        raise SpecError("contrast holds fewer than 3 steps; capture 10 or more, from −2 θ to 2 θ", file=file)
    signal = small["signal_dn"]
    if signal.dtype.kind not in "uif" or signal.size == 0 or signal.ndim not in (0, 1, 2):
        raise SpecError("signal_dn must be a number, or numbers [row, col]", file=file)
    signal = signal.astype(np.float64)
    if not np.all((signal >= 0) & (signal <= BRIGHTEST_DN)):
        raise SpecError(SIGNAL_RANGE, file=file)
    return contrast.astype(np.float64), signal, small


def step_maps(captures: CaptureSet, name: str, steps: int, shape: tuple[int, ...], most: int):  # noqa: ANN201
    """Maps [row, col] of ``n_on`` or ``n_off``, one step at a time, each from 0 to `most`.

    Raises
    ------
    SpecError
        If they are of another size or type, or out of range.
    """
    file = captures.folder / "evs_steps.npz"
    count = 0
    for counts in count_maps(captures, "evs_steps", name):
        if counts.shape != shape or counts.dtype.kind not in "ui":
            raise SpecError(
                f"{name} must be whole numbers [contrast, row, col] of the static capture's size", file=file
            )
        if counts.min() < 0 or np.any(counts > most):
            raise SpecError(f"{name} holds counts outside 0 to n_trials", file=file)
        count += 1
        yield counts
    if count != steps:
        raise SpecError(f"{name} holds {count} steps, contrast {steps}", file=file)
