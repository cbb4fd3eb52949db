"""A benchmark as a `torch.utils.data.Dataset` (extra ``torch``)."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hesim_render.benchmark.folder import Benchmark, BenchmarkClip
from hesim_render.core.errors import RangeError, SpecError, how_to_install
from hesim_render.events import voxel_grid
from hesim_render.mosaic.description import Mosaic

try:
    import torch
    from torch.utils.data import Dataset as _Dataset
except ImportError:  # reported when a data set is made
    torch, _Dataset = None, object

Task = Literal["deblur", "interpolate"]
_NEIGHBOURS = {"deblur": (0, 0), "interpolate": (1, 1)}


def signal_of(raw: NDArray, valid: NDArray[np.bool_], mosaic: Mosaic) -> NDArray[np.float32]:
    """RAW with black at 0 and full scale at 1, not clipped; 0 where there is no value.

    Parameters
    ----------
    raw, valid : [row, col], DN and the pixels that give values.
    mosaic : levels.
    """
    span = 2**mosaic.bit_depth - 1 - mosaic.black_level_dn
    return np.where(valid, (raw.astype(np.float32) - mosaic.black_level_dn) / span, 0).astype(np.float32)


class BenchmarkDataset(_Dataset):
    """Frames of a benchmark with their events and their sharp images, as tensors of RAW.

    An item of ``deblur`` is one frame: ``frame`` float32 [1, row, col] (0 is black, 1 full scale; noise below black is
    kept, so that dark frames have the mean of their light, and pixels without a value are 0), ``sharp`` of the same
    shape (the nearest sharp image to the middle of the exposure), ``valid`` bool [1, row, col] and ``voxels`` float32
    [bin, y, x] of the events of the exposure. An item of ``interpolate`` is a frame k with a neighbour on each side:
    ``before`` and ``after``, ``sharp`` of frame k, and the voxels from the middle of one neighbour to that of the
    other. Both have ``clip`` (name), ``index`` (number of the frame) and ``t_us`` of the sharp image.

    Parameters
    ----------
    root : folder of the benchmark.
    split : ``train``, ``val``, ``test``, or None for all.
    task : ``deblur`` or ``interpolate``.
    bins : number of bins of the voxel grid.
    transform : called with each item; what it returns is the item.

    Raises
    ------
    RangeError
        If the task is unknown.
    SpecError
        If PyTorch is missing, the folder is no finished benchmark, or no clip of the split has such items.
    """

    def __init__(
        self,
        root: str | Path,
        split: str | None = "train",
        task: Task = "deblur",
        bins: int = 5,
        transform: Callable[[dict[str, Any]], Any] | None = None,
    ) -> None:
        if torch is None:
            raise SpecError(f"the loader needs PyTorch: {how_to_install('torch')}")
        if task not in _NEIGHBOURS:
            raise RangeError("task", task, "deblur or interpolate")
        self._task, self._bins, self._transform = task, bins, transform
        before, after = _NEIGHBOURS[task]
        self._clips: list[BenchmarkClip] = []
        self._items: list[tuple[int, int]] = []
        for clip in Benchmark(root).clips(split):
            counts = clip.content["counts"]
            if counts["sharp"]:
                self._items += [(len(self._clips), k) for k in range(before, counts["frames"] - after)]
                self._clips.append(clip)
        if not self._items:
            raise SpecError(f"no clip of the split {split} has frames and sharp images for {task}", file=root)

    def __len__(self) -> int:
        return len(self._items)

    def __getitem__(self, item: int) -> Any:
        number, k = self._items[item]
        # opened anew for each item: an open HDF5 file must not be shared by the processes of a loader
        clip = BenchmarkClip(self._clips[number].folder)
        recording, sharp = clip.recording, clip.sharp
        assert sharp is not None
        frame = recording.frames[k]

        def signal(raw: NDArray) -> Any:
            return torch.from_numpy(signal_of(raw, frame.valid, recording.mosaic))[None]

        def middle(frame: Any) -> float:
            return frame.exposure_start_us + frame.exposure_us / 2

        nearest = sharp.nearest(middle(frame))
        result: dict[str, Any] = {"clip": clip.name, "index": k, "t_us": float(sharp.time_us[nearest])}
        result["sharp"] = signal(sharp.raw_dn(nearest))
        result["valid"] = torch.from_numpy(np.ascontiguousarray(frame.valid))[None]
        if self._task == "deblur":
            result["frame"] = signal(frame.raw)
            begin, end = float(frame.exposure_start_us), float(frame.exposure_start_us + frame.exposure_us)
        else:
            first, last = recording.frames[k - 1], recording.frames[k + 1]
            result |= {"before": signal(first.raw), "after": signal(last.raw)}
            begin, end = middle(first), middle(last)
        events = recording.event_slice(int(np.floor(begin)), int(np.ceil(end)) + 1)
        if 0 not in recording.event_shape:
            result["voxels"] = torch.from_numpy(voxel_grid(events, recording.event_shape, self._bins, begin, end))
        return result if self._transform is None else self._transform(result)
