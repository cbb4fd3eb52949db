"""Results of a user for the tasks of a benchmark: a folder of arrays, one file for each item."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError, did_you_mean
from hesim_render.core.guard import MOST_BYTES, inside, reading


class Predictions:
    """A folder ``TASK/CLIP/000000.npy``, with the numbers of the items that `evaluate_benchmark` scores.

    Parameters
    ----------
    folder : the folder.
    tasks, clips : names that its folders may have.

    Raises
    ------
    SpecError
        If it is missing or empty, or has a folder that is no task or no clip.
    """

    def __init__(self, folder: str | Path, tasks: Collection[str], clips: Collection[str]) -> None:
        self._root = Path(folder).expanduser()
        if not self._root.is_dir():
            raise SpecError("no such folder", file=folder)
        self._waiting = {path.relative_to(self._root).as_posix() for path in self._root.glob("*/*/*.npy")}
        if not self._waiting:
            raise SpecError("has no results; expected TASK/CLIP/000000.npy", file=folder)
        for name in sorted(self._waiting):
            task, clip, _ = name.split("/")
            for given, known, what in ((task, tasks, "task"), (clip, clips, "clip of these")):
                if given not in known:
                    raise SpecError(f"{given!r} is no {what}{did_you_mean(given, known)}", file=self._root / name)

    def read(self, task: str, clip: str, item: int, shape: tuple[int, ...]) -> NDArray[np.float64] | None:
        """The result for an item; None where there is none.

        Parameters
        ----------
        task, clip, item : as in the scores.
        shape : that it must have.

        Raises
        ------
        SpecError
            If it is no array of numbers of this shape.
        """
        name = f"{task}/{clip}/{item:06d}.npy"
        if name not in self._waiting:
            return None
        path = inside(self._root, name)
        if path.stat().st_size > MOST_BYTES:
            raise SpecError("is too large", file=path)
        with reading(path, "as an array"):
            values = np.load(path, allow_pickle=False)
        if values.dtype.kind not in "biuf" or values.shape != shape:
            expected = f"numbers {list(shape)}"
            raise SpecError(f"holds {values.dtype} {list(values.shape)}; expected {expected}", file=path)
        self._waiting.discard(name)
        return values.astype(np.float64)

    @property
    def unused(self) -> list[str]:
        """Files that belong to no item that was scored, in order."""
        return sorted(self._waiting)
