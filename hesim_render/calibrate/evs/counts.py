"""``evs_static.npz``: event counts of a static scene, read and checked."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.result import read_calibration, read_maps
from hesim_render.core.errors import SpecError
from hesim_render.core.output import alone_in
from hesim_render.core.units import S_PER_US
from hesim_render.recording.capture_set import BRIGHTEST_DN, SIGNAL_RANGE, CaptureSet, single_number


@dataclass(frozen=True)
class StaticCapture:
    """``evs_static.npz``; maps [row, col] on the event grid.

    Attributes
    ----------
    signal_dn : noise-free signal, DN.
    n_on, n_off : counts of the lit scene.
    dark_n_on, dark_n_off : counts in the dark, or None.
    position : number of each pixel's tile position.
    tile : event pixels of a tile, (rows, cols).
    parts : [part, row, col], events of both polarities in parts of equal length of the dark capture, or None.
    """

    signal_dn: NDArray[np.float64]
    n_on: NDArray[np.int64]
    n_off: NDArray[np.int64]
    dark_n_on: NDArray[np.int64] | None
    dark_n_off: NDArray[np.int64] | None
    trials: int
    tile: tuple[int, int]
    parts: NDArray[np.integer] | None = None

    @property
    def part_trials(self) -> int:
        """Trials of one part."""
        return self.trials if self.parts is None else self.trials // self.parts.shape[0]

    @property
    def position(self) -> NDArray[np.int64]:
        height, width = self.signal_dn.shape
        rows, cols = np.ogrid[:height, :width]
        return (rows % self.tile[0]) * self.tile[1] + cols % self.tile[1]

    @property
    def sessions(self) -> list[tuple[NDArray, NDArray, NDArray]]:
        """(signal, ON, OFF) of the lit scene and, where there is one, of the dark."""
        lit = [(self.signal_dn, self.n_on, self.n_off)]
        if self.dark_n_on is None or self.dark_n_off is None:
            return lit
        return [*lit, (np.zeros_like(self.signal_dn), self.dark_n_on, self.dark_n_off)]


def read_static(captures: CaptureSet, calibration: str | Path | None = None) -> StaticCapture:
    """Read and check ``evs_static.npz``.

    Parameters
    ----------
    calibration : ``calibration.yaml`` of the frames, whose composite is the signal where the file gives none.

    Raises
    ------
    SpecError
        If arrays are missing or do not fit each other, or the counts hold nothing to fit.
    """
    file = captures.folder / "evs_static.npz"
    data = captures.arrays("evs_static", ("n_on", "n_off", "n_trials"))
    signal = np.asarray(data["signal_dn"]) if "signal_dn" in data else _composite_signal(captures, calibration, file)
    if signal.ndim != 2 or signal.dtype.kind not in "uif" or signal.size == 0:
        raise SpecError(f"signal_dn has shape {signal.shape}; expected numbers [row, col]", file=file)
    trials = int(single_number(data["n_trials"], "n_trials", file, whole=True, least=1))
    # counts are whole, within the trials, and of the size of the signal; a trial gives one event at most
    names = [name for name in ("n_on", "n_off", "dark_n_on", "dark_n_off") if name in data]
    if len(names) == 3:
        raise SpecError("dark_n_on and dark_n_off are given together or not at all", file=file)
    for name in names:
        counts = data[name]
        if counts.shape != signal.shape:
            raise SpecError(f"{name} is of size {counts.shape}, signal_dn of {signal.shape}", file=file)
        if counts.dtype.kind not in "ui":
            raise SpecError(f"{name} holds {counts.dtype.name}; save whole numbers of events", file=file)
        if counts.min() < 0 or counts.max() > trials:
            raise SpecError(f"{name} holds counts outside 0 to n_trials = {trials}", file=file)
    maps: dict[str, NDArray[np.int64]] = {name: data[name].astype(np.int64) for name in names}
    for first, second in (("n_on", "n_off"), ("dark_n_on", "dark_n_off")):
        if first in maps and (maps[first] + maps[second]).max() > trials:
            raise SpecError(f"{first} and {second} hold more events together than n_trials = {trials}", file=file)
    total = sum(int(counts.sum()) for counts in maps.values())
    # neither no event nor an event in every trial tells how wide the noise is
    if total == 0:
        raise SpecError("holds no event at all; capture more trials, or lower the threshold", file=file)
    if total > 0.98 * trials * signal.size * len(names) / 2:
        raise SpecError(
            "there is an event in nearly every trial, which tells nothing of the noise; raise the threshold", file=file
        )
    signal = signal.astype(np.float64)
    if np.any(signal < 0) or np.any(signal > BRIGHTEST_DN) or not np.any(np.isfinite(signal)):
        raise SpecError(SIGNAL_RANGE, file=file)
    return StaticCapture(
        signal,
        maps["n_on"],
        maps["n_off"],
        maps.get("dark_n_on"),
        maps.get("dark_n_off"),
        trials,
        event_tile(captures, signal.shape),
        _parts(data, maps, trials, file),
    )


def _parts(
    data: dict[str, NDArray], maps: dict[str, NDArray[np.int64]], trials: int, file: Path
) -> NDArray[np.integer] | None:
    """``dark_parts``, checked against the counts of the whole; None where it is not given."""
    if "dark_parts" not in data:
        return None
    parts = data["dark_parts"]
    if "dark_n_on" not in maps:
        raise SpecError("dark_parts needs dark_n_on and dark_n_off, which it divides", file=file)
    whole = maps["dark_n_on"] + maps["dark_n_off"]
    if parts.ndim != 3 or parts.shape[1:] != whole.shape or parts.dtype.kind not in "ui":
        raise SpecError(f"dark_parts must be whole numbers [part, row, col] of {whole.shape} pixels", file=file)
    if parts.shape[0] < 8 or trials % parts.shape[0]:
        raise SpecError(
            f"dark_parts holds {parts.shape[0]} parts; expected 8 or more, a divisor of n_trials", file=file
        )
    if parts.min() < 0 or np.any(parts.sum(axis=0, dtype=np.int64) != whole):
        raise SpecError("dark_parts does not add up to dark_n_on and dark_n_off", file=file)
    return parts


def _composite_signal(captures: CaptureSet, calibration: str | Path | None, file: Path) -> NDArray[np.float64]:
    """Signal [row, col] at the event pixels from the frames' composite, in DN of each pixel's own filter.

    It is a rate times the exposure of the signal reference. It is NaN at edges of the scene, where the interpolation
    is inaccurate.

    Raises
    ------
    SpecError
        If the signal cannot be determined.
    """
    rate = None
    if calibration is not None and Path(calibration).exists() and "aps" in read_calibration(calibration):
        with alone_in(Path(calibration).absolute().parent):
            maps = read_maps(calibration, "aps")
        if "evs_signal_uneven" in maps:
            rate = np.where(maps["evs_signal_uneven"], np.nan, maps["evs_signal_dn_per_s"])
    if rate is None:
        raise SpecError(
            "holds no array 'signal_dn', the clean signal at the event pixels; give it, or state the sensor in "
            "capture.yaml and calibrate frames of the same scene first, into the same --out",
            file=file,
        )
    if not np.isfinite(rate).any():
        raise SpecError(
            "no frame pixel has the filter of the event pixels: state the light on the neutral scene and calibrate the "
            "frames again, or give signal_dn in evs_static.npz",
            file=captures.folder / "capture.yaml",
            key="illuminant",
        )
    reference = captures.spec.signal_reference
    if reference is None or reference.filter != "own":
        raise SpecError(
            "the signal is to be taken from the frames: state {k, t_ref_us, filter: own}, or give signal_dn in "
            "evs_static.npz",
            file=captures.folder / "capture.yaml",
            key="signal_reference",
        )
    # values below 0 are noise of a dark patch
    return np.maximum(rate.astype(np.float64), 0.0) * reference.t_ref_us * S_PER_US


def event_tile(captures: CaptureSet, shape: tuple[int, ...]) -> tuple[int, int]:
    """Event pixels of a tile: from the sensor or capture.yaml, else from the sizes of the two grids.

    Raises
    ------
    SpecError
        If the event maps are not whole tiles.
    """
    spec = captures.spec
    tile = spec.tile_rows, spec.tile_cols
    if captures.sensor is not None and captures.sensor.evs_grid is not None:
        tile = captures.sensor.evs_grid.rows_per_tile, captures.sensor.evs_grid.cols_per_tile
    elif spec.evs_tile_rows is not None and spec.evs_tile_cols is not None:
        tile = spec.evs_tile_rows, spec.evs_tile_cols
    elif captures.has("aps_dark"):
        frame = captures.frames("aps_dark").shape[2:]
        if frame[0] * shape[1] == frame[1] * shape[0] and shape[0] * tile[0] % frame[0] == 0:
            tile = tile[0] * shape[0] // frame[0], tile[1] * shape[1] // frame[1]
    if 0 in tile or shape[0] % tile[0] or shape[1] % tile[1]:
        raise SpecError(
            f"event maps of {shape[0]}×{shape[1]} pixels are not whole tiles; state evs_tile_rows and evs_tile_cols in "
            "capture.yaml",
            file=captures.folder,
        )
    roi, wanted = spec.roi, (shape[0] // tile[0] * spec.tile_rows, shape[1] // tile[1] * spec.tile_cols)
    if roi is not None and wanted != (roi.height_px, roi.width_px):
        raise SpecError(
            f"event maps of {shape[0]}×{shape[1]} pixels belong to {wanted[0]}×{wanted[1]} frame pixels, not to the "
            f"roi of {roi.height_px}×{roi.width_px}; change it, or state evs_tile_rows and evs_tile_cols",
            file=captures.folder / "capture.yaml",
            key="roi",
        )
    return tile
