"""SHA-256 of a video's data, computed in parallel to the run; the manifest waits for it."""

from __future__ import annotations

import hashlib
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from typing import Any


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
