"""One RAW frame and its noise-free truth.

Frames of a recording on disk.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.guard import inside
from hesim_render.core.npz import read_array, read_arrays
from hesim_render.recording import manifest as manifests
from hesim_render.recording.dng import read_dng


@dataclass(frozen=True, eq=False, repr=False)
class Frame:
    """One RAW frame and its truth.

    Parameters
    ----------
    raw : uint16 [row, col], DN; 0 where `valid` is False.
    valid : bool [row, col], which pixels give frame values.
    electrons_mean : float32 [row, col], e⁻: noise-free signal of this exposure; NaN where not valid.
    electrons_stderr : float32 [row, col], e⁻: its standard error.
    t_us : end of row 0's exposure, µs.
    exposure_start_us : begin of row 0's exposure, µs.
    exposure_us : every row's exposure, µs.
    line_time_us : from one row to the next, µs; 0 for a global shutter.
    index : number of the frame, 0 first.
    """

    raw: NDArray[np.uint16]
    valid: NDArray[np.bool_]
    electrons_mean: NDArray[np.float32]
    electrons_stderr: NDArray[np.float32]
    t_us: int
    exposure_start_us: int
    exposure_us: int
    line_time_us: float
    index: int

    def __repr__(self) -> str:
        rows, cols = self.raw.shape
        return f"<Frame {self.index}: {cols}x{rows} px, t_us={self.t_us}, exposure_us={self.exposure_us}>"

    def _repr_html_(self) -> str:
        from hesim_render.recording.outline import frame_summary

        return frame_summary(self.raw, [(name, f"{value:g}") for name, value in self.times.items()])

    @property
    def row_times_us(self) -> NDArray[np.float64]:
        """Middle of each row's exposure, [row], µs: the time at which geometric truth of a frame is given."""
        rows = np.arange(self.raw.shape[0], dtype=np.float64)
        return self.exposure_start_us + self.exposure_us / 2 + rows * self.line_time_us

    @property
    def times(self) -> dict[str, Any]:
        """All fields except the images, as in the manifest."""
        return {
            "index": self.index,
            "t_us": self.t_us,
            "exposure_start_us": self.exposure_start_us,
            "exposure_us": self.exposure_us,
            "line_time_us": self.line_time_us,
        }


@dataclass(frozen=True, eq=False, repr=False)
class EventTruth:
    """Noise-free flux of the event pixels, mean over the recording, float32 [y, x], e⁻/s."""

    flux_mean_e_per_s: NDArray[np.float32]
    flux_stderr_e_per_s: NDArray[np.float32]

    def __repr__(self) -> str:
        rows, cols = self.flux_mean_e_per_s.shape
        return f"<EventTruth of {cols}x{rows} px, mean {self.flux_mean_e_per_s.mean():.4g} e⁻/s>"


class StoredFrames(Sequence[Frame]):
    """Frames of a recording on disk. Each frame is read when it is asked for and is not kept.

    Parameters
    ----------
    folder : the recording's folder.
    entries : the manifest's list of frames.
    shape : rows and columns of a frame, px.
    """

    def __init__(self, folder: Path, entries: Sequence[Mapping[str, Any]], shape: tuple[int, int]) -> None:
        self._folder, self._entries, self._shape = folder, list(entries), shape

    def __repr__(self) -> str:
        rows, cols = self._shape
        return f"<{len(self)} frame{'' if len(self) == 1 else 's'} of {cols}x{rows} px in {self._folder}>"

    @cached_property
    def _valid(self) -> NDArray[np.bool_]:
        return read_array(inside(self._folder, "truth/valid.npy"), self._shape, "b")

    def __len__(self) -> int:
        return len(self._entries)

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> "StoredFrames": ...
    def __getitem__(self, index: int | slice) -> "Frame | StoredFrames":
        if isinstance(index, slice):
            return StoredFrames(self._folder, self._entries[index], self._shape)
        entry = dict(self._entries[index])
        manifest, key = self._folder / manifests.MANIFEST_NAME, f"frames.{range(len(self))[index]}"
        truth_file = inside(self._folder, entry.pop("truth"), file=manifest, key=f"{key}.truth")
        raw = read_dng(inside(self._folder, entry.pop("file"), file=manifest, key=f"{key}.file"), self._shape)
        mean, stderr = read_frame_maps(truth_file, ("electrons_mean", "electrons_stderr"), self._shape)
        return Frame(raw, self._valid, mean, stderr, **entry)


def read_frame_maps(file: Path, names: tuple[str, ...], shape: tuple[int, int]) -> list[NDArray[np.float32]]:
    """float32 maps of one shape from an `.npz` file, in the order of `names`."""
    result = read_arrays(file, names, only=names, shapes=dict.fromkeys(names, shape), kinds="f")
    return [result[name].astype(np.float32, copy=False) for name in names]
