"""SHA-256 of a video's data, computed in parallel to the run; the manifest waits for it."""

import hashlib
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.journal import key_of


class Digest:
    """Hashes pieces of data in its own thread; hashing lets other threads of Python run.

    Parameters
    ----------
    pieces : called in that thread; yields bytes, or arrays whose bytes are hashed in order.
    """

    def __init__(self, pieces: Callable[[], Iterable[Any]]) -> None:
        self._pieces, self._hash = pieces, hashlib.sha256()
        self._is_stopped = False
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="digest", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            for piece in self._pieces():
                if self._is_stopped:
                    return
                self._hash.update(piece)
        except Exception as error:
            self._error = error

    def hexdigest(self) -> str:
        """The hash, after all data are read.

        Raises
        ------
        Exception
            Whatever reading the data raised.
        """
        self._thread.join()
        if self._error is not None:
            raise self._error
        return self._hash.hexdigest()

    def stop(self) -> None:
        """Stop early, because the hash is no longer needed."""
        self._is_stopped = True
        self._thread.join()


class Hashed(ABC):
    """An input whose data are hashed."""

    _digest: Digest | None = None

    @abstractmethod
    def _pieces(self) -> Iterable[Any]:
        """All data of the input, in order: bytes, or arrays whose bytes are hashed."""

    def start_digest(self) -> None:
        """Start hashing in parallel to the run."""
        self._digest = Digest(self._pieces)

    def _sha256(self) -> str:
        """The hash as hexadecimal digits; waits for it."""
        if self._digest is None:
            self.start_digest()
        assert self._digest is not None
        return self._digest.hexdigest()

    def _stop_digest(self) -> None:
        if self._digest is not None:
            self._digest.stop()


def stamp_of(source: str | Path | NDArray) -> str:
    """What tells an input from another one, or from itself before a change, without reading it: names, sizes and times
    of change of its files; of an array in memory the hash.

    Parameters
    ----------
    source : file, folder or array.
    """
    if isinstance(source, np.ndarray):
        return key_of(source).hex()
    path = Path(source).resolve()
    files = sorted(entry for entry in path.iterdir() if entry.is_file()) if path.is_dir() else [path]
    states = [(file.name, file.stat()) for file in files]
    return key_of(str(path), *((name, state.st_size, state.st_mtime_ns) for name, state in states)).hex()
