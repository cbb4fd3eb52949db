"""A journal of long calculations: what a run that was ended has calculated, for the same run to go on from.

The file beside the output begins with one line of JSON, which names all that the results depend on. Entries follow,
each with the hash of what it was calculated from, its length and a checksum. An entry that was cut off by the end of
the process is dropped, and so is all that follows it.
"""

import fcntl
import hashlib
import json
import struct
import time
import zlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import HesimError, OutputError
from hesim_render.core.output import output_errors, short_name

_FORMAT = "hesim_render journal 1"
#: Hash of an entry's input, number of its bytes, and their checksum.
_HEAD = struct.Struct("<16sQI")
#: Longest first line that is read, bytes.
_LONGEST_LINE = 1 << 20


def key_of(*inputs: object) -> bytes:
    """Hash of inputs: arrays with their types, and plain values."""
    result = hashlib.blake2b(digest_size=16)
    for given in inputs:
        if isinstance(given, np.ndarray):
            result.update(f"{given.dtype.str}{given.shape};".encode())
            result.update(np.ascontiguousarray(given).data)
        else:
            result.update(f"{given!r};".encode())
    return result.digest()


def journal_of(target: str | Path) -> Path:
    """The journal of a run whose output is `target`: a hidden file beside it."""
    place = Path(target).expanduser().resolve()
    return place.with_name(f".{short_name(place)}.unfinished")


def _entries(path: Path, file: BinaryIO) -> Iterator[tuple[bytes, tuple[Path, int, int, int]]]:
    """Keys and places of all whole entries from here on; one that another process is writing ends the list."""
    size = path.stat().st_size
    while len(head := file.read(_HEAD.size)) == _HEAD.size:
        key, length, checksum = _HEAD.unpack(head)
        begin = file.tell()
        if begin + length > size:
            return
        file.seek(begin + length)
        yield key, (path, begin, length, checksum)


class Journal:
    """Results that a run has calculated, in a file. In a with statement it is closed at the end, and removed if the run
    has succeeded, or has failed for a reason that would end it again.

    Parameters
    ----------
    target : output of the run.
    run : plain values, by name, of all that the results depend on.
    overwrite : begin anew where the journal is that of another run.
    shared : keep nothing where another process writes the journal, in place of an error.
    after_s : keep nothing in the first seconds; a short run then leaves no file.
    others : journals of parts of the same run, which are only read; another process may be writing them. Those that
        are missing, or of another run, count as empty.
    stays : leave the file after success, for a journal that is among the `others` of another one.

    Attributes
    ----------
    path : the file, from `journal_of`. It appears with the first result.
    run : as given, as plain values of JSON.
    count : number of results of an earlier run, those of `others` included.

    Raises
    ------
    OutputError
        If the journal is that of another run and `overwrite` is False. The message names what differs.
    """

    def __init__(
        self,
        target: str | Path,
        run: Mapping[str, Any],
        overwrite: bool = False,
        shared: bool = False,
        after_s: float = 0.0,
        others: Iterable[Path] = (),
        stays: bool = False,
    ) -> None:
        self.path, self._shared, self._begin_s = journal_of(target), shared, time.monotonic() + after_s
        self._is_off, self._stays = False, stays
        self.run = json.loads(json.dumps({"format": _FORMAT, **run}, default=str))
        #: File, first byte, length and checksum of each result.
        self._places: dict[bytes, tuple[Path, int, int, int]] = {}
        self._file: BinaryIO | None = None
        #: The one of the others that is open.
        self._other: tuple[Path, BinaryIO] | None = None
        for other in others:
            if other != self.path:
                self._places.update(self._results_in(other))
        with output_errors(self.path):
            self._open(target, overwrite)
        self.count = len(self._places)

    def _open(self, target: str | Path, overwrite: bool) -> None:
        if not self.path.is_file():
            return
        with self.path.open("rb") as file:
            line = file.readline(_LONGEST_LINE)
            try:
                before = json.loads(line)
            except ValueError:
                before = None
            if not isinstance(before, dict):
                before = {}
            if before != self.run:
                changed = [name for name in {**self.run, **before} if before.get(name) != self.run.get(name)]
                if not overwrite and before:
                    raise OutputError(
                        f"{target}: the interrupted run at this place differs in {', '.join(changed)}; "
                        f"repeat that run, or begin anew (--overwrite, overwrite=True), or remove {self.path}"
                    )
                self.path.unlink()
                return
            end = file.tell()
            for key, place in _entries(self.path, file):
                self._places[key], end = place, place[1] + place[2]
        self._file = self._locked()
        if self._file is not None:
            self._file.truncate(end)

    def _locked(self) -> BinaryIO | None:
        """The file, which no other process may have open; the lock ends with the process. None where it is shared, and
        another process has it.
        """
        file = self.path.open("a+b")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
            if self._shared:
                self._is_off = True
                return None
            raise OutputError(f"{self.path}: another run is writing it") from None
        except OSError:  # a file system without locks
            pass
        return file

    def _results_in(self, path: Path) -> dict[bytes, tuple[Path, int, int, int]]:
        """Places of the results in another journal of this run."""
        try:
            with path.open("rb") as file:
                if json.loads(file.readline(_LONGEST_LINE)) == self.run:
                    return dict(_entries(path, file))
        except (OSError, ValueError):
            pass
        return {}

    def _reader(self, path: Path) -> BinaryIO | None:
        """A file of results, open; None if it is gone. One of the others is open at a time."""
        if path == self.path:
            return self._file
        if self._other is None or self._other[0] != path:
            self._close_other()
            try:
                self._other = path, path.open("rb")
            except FileNotFoundError:  # the clip that it belongs to was finished elsewhere
                return None
        return self._other[1]

    def _close_other(self) -> None:
        if self._other is not None:
            self._other[1].close()
            self._other = None

    def read(self, key: bytes) -> bytes | None:
        """The bytes of a known result (`key_of`), None where there is none."""
        if key not in self._places:
            return None
        path, begin, length, checksum = self._places[key]
        with output_errors(path):
            file = self._reader(path)
            if file is None:
                return None
            file.seek(begin)
            data = file.read(length)
        if zlib.crc32(data) != checksum:
            del self._places[key]
            return None
        return data

    def recall(self, key: bytes, into: Iterable[NDArray]) -> bool:
        """Fill arrays with a known result.

        Parameters
        ----------
        key : from `key_of`.
        into : contiguous arrays of the types and sizes that were kept.

        Returns
        -------
        False where there is none; the arrays are as before.
        """
        data, arrays = self.read(key), list(into)
        if data is None:
            return False
        if len(data) != sum(array.nbytes for array in arrays):
            del self._places[key]
            return False
        first = 0
        for array in arrays:
            array.ravel()[:] = np.frombuffer(data, array.dtype, array.size, first)
            first += array.nbytes
        return True

    def keep(self, key: bytes, values: Iterable[NDArray]) -> None:
        """Write a result, so that it outlives the process.

        Parameters
        ----------
        key : from `key_of`.
        values : arrays of numbers.
        """
        if self._is_off or time.monotonic() < self._begin_s:
            return
        data = b"".join(np.ascontiguousarray(value).tobytes() for value in values)
        with output_errors(self.path):
            if self._file is None:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                self._file = self._locked()
                if self._file is None:
                    return
                self._file.truncate(0)
                self._file.write(json.dumps(self.run).encode() + b"\n")
            checksum = zlib.crc32(data)
            begin = self._file.seek(0, 2) + _HEAD.size
            self._file.write(_HEAD.pack(key, len(data), checksum) + data)
            self._file.flush()
            self._places[key] = self.path, begin, len(data), checksum

    def __enter__(self) -> "Journal":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._close_other()
        if self._file is not None:
            self._file.close()
            self._file = None
        if kind is None and self._stays:
            return
        is_over = kind is None or (issubclass(kind, HesimError) and not issubclass(kind, OutputError))
        if is_over and not self._is_off:
            with output_errors(self.path):
                self.path.unlink(missing_ok=True)
