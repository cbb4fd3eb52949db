"""SHA-256 of a video's data, made beside the run: nothing waits for it until the manifest is written."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Iterable
from typing import Any


class Digest:
    """Hashes pieces of data in a thread of its own; hashing lets other threads of Python run.

    Parameters
    ----------
    pieces : called in that thread; gives bytes, or arrays whose bytes lie one after another.
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
        """The hash, once all is read.

        Raises
        ------
        Exception
            What reading the data raised.
        """
        self._thread.join()
        if self._error is not None:
            raise self._error
        return self._hash.hexdigest()

    def stop(self) -> None:
        """End soon: nobody wants the hash any more."""
        self._is_stopped = True
        self._thread.join()


class Hashed:
    """An input whose data are hashed; `_pieces` gives them."""

    _digest: Digest | None = None

    def _pieces(self) -> Iterable[Any]:
        raise NotImplementedError

    def start_digest(self) -> None:
        """Begin to hash, beside what follows."""
        self._digest = Digest(self._pieces)

    def _sha256(self) -> str:
        """The hash, in hexadecimal digits; waits for it."""
        if self._digest is None:
            self.start_digest()
        assert self._digest is not None
        return self._digest.hexdigest()

    def _stop_digest(self) -> None:
        if self._digest is not None:
            self._digest.stop()
