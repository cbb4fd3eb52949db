"""Frames of a recording on disk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.guard import inside
from hesim_render.core.npz import read_array, read_arrays
from hesim_render.recording import manifest as manifests
from hesim_render.recording.dng import read_dng
from hesim_render.recording.frame import Frame


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
    def __getitem__(self, index: slice) -> StoredFrames: ...
    def __getitem__(self, index: int | slice) -> Frame | StoredFrames:
        if isinstance(index, slice):
            return StoredFrames(self._folder, self._entries[index], self._shape)
        entry = dict(self._entries[index])
        manifest, key = self._folder / manifests.MANIFEST_NAME, f"frames.{range(len(self))[index]}"
        truth_file = inside(self._folder, entry.pop("truth"), file=manifest, key=f"{key}.truth")
        raw = read_dng(inside(self._folder, entry.pop("file"), file=manifest, key=f"{key}.file"), self._shape)
        mean, stderr = read_maps(truth_file, ("electrons_mean", "electrons_stderr"), self._shape)
        return Frame(raw, self._valid, mean, stderr, **entry)


def read_maps(file: Path, names: tuple[str, ...], shape: tuple[int, int]) -> list[NDArray[np.float32]]:
    """float32 maps of one shape from an `.npz` file, in the order of `names`."""
    found = read_arrays(file, names, only=names, shapes=dict.fromkeys(names, shape), kinds="f")
    return [found[name].astype(np.float32, copy=False) for name in names]
