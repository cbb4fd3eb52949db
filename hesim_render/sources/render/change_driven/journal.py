"""What a source has given so far, kept on disk span by span, so that a run that was killed goes on from there."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.npz import NpzWriter, read_arrays
from hesim_render.core.output import replacing

Arrays = dict[str, NDArray]
_KEY, _END = "key", "end_us"


@dataclass(frozen=True)
class Recalled:
    """An answer of an earlier run.

    Parameters
    ----------
    answer : its arrays.
    state : of the source after this answer, where its span ended with it; otherwise None.
    """

    answer: Arrays
    state: Arrays | None


def key_of(question: Sequence[NDArray]) -> NDArray[np.uint8]:
    """A hash by which a question (pixels and times) is known again, [32]."""
    digest = hashlib.sha256()
    for values in question:
        digest.update(np.ascontiguousarray(values).tobytes())
    return np.frombuffer(digest.digest(), np.uint8)


class Journal:
    """The answers of one source in order, in a folder with one file for each span of simulated time.

    A file appears whole or not at all, and ends with the state of the source. A run asks the same questions again; it
    gets the answers of the files first. A file that is damaged is dropped with all later ones.

    Parameters
    ----------
    folder : of the files; of this source alone.
    span_us : length of a span, µs.
    """

    def __init__(self, folder: Path, span_us: int) -> None:
        self._folder, self._span_us, self._due_us = folder, span_us, float(span_us)
        self._number, self._reads = 0, True
        self._waiting: deque[Arrays] = deque()
        self._state: Arrays = {}
        self._held: list[Arrays] = []

    def recall(self, key: NDArray[np.uint8]) -> Recalled | None:
        """The next answer; None where the earlier run had come to its end.

        Raises
        ------
        SpecError
            If the earlier run asked something else.
        """
        if not self._waiting and self._reads:
            self._read()
        if not self._waiting:
            return None
        answer = self._waiting.popleft()
        if not np.array_equal(answer.pop(_KEY), key):
            raise SpecError("holds spans of another run; remove it", file=self._folder)
        self._move_on(float(answer.pop(_END)))
        return Recalled(answer, None if self._waiting else self._state)

    def add(self, key: NDArray[np.uint8], answer: Arrays, end_us: float, state: Callable[[], Arrays]) -> None:
        """Keep an answer; a span that it completes is written.

        Parameters
        ----------
        key, answer : what was asked, and the answer.
        end_us : end of the latest window of the question, µs.
        state : gives the state of the source after this answer.
        """
        self._held.append({**answer, _KEY: key, _END: np.array(end_us)})
        if end_us >= self._due_us:
            self.flush(state)
            self._move_on(end_us)

    def flush(self, state: Callable[[], Arrays]) -> None:
        """Write what is not yet on disk; `state` gives the state of the source."""
        if not self._held:
            return
        with replacing(self._file(self._number)) as unfinished, NpzWriter(unfinished) as writer:
            for place, entry in enumerate(self._held):
                for name, values in entry.items():
                    writer.add(f"{place}/{name}", values)
            for name, values in state().items():
                writer.add(f"state/{name}", values)
        self._number += 1
        self._held = []

    def _move_on(self, end_us: float) -> None:
        self._due_us = max(self._due_us, (end_us // self._span_us + 1) * self._span_us)

    def _file(self, number: int) -> Path:
        return self._folder / f"{number:06d}.npz"

    def _read(self) -> None:
        """Load the answers of the next file, if there is one."""
        file = self._file(self._number)
        self._reads = file.is_file()
        if not self._reads:
            return
        try:
            arrays = read_arrays(file)
        except SpecError:
            self._reads = False
            for later in self._folder.glob("*.npz"):
                if later.name >= file.name:
                    later.unlink(missing_ok=True)
            return
        entries: dict[str, Arrays] = {}
        for name, values in arrays.items():
            place, _, what = name.partition("/")
            entries.setdefault(place, {})[what] = values
        self._state = entries.pop("state", {})
        self._waiting.extend(entries[str(place)] for place in range(len(entries)))
        self._number += 1
