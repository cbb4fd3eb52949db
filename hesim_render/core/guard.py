"""Reading of untrusted files: every reader of recordings, captures and calibrations uses this module.

A damaged or malicious file causes one clear error. It cannot name files outside its own folder, or request more
memory than there is.
"""

import contextlib
import hashlib
import json
import os
import stat
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hesim_render.core.errors import HesimError, SpecError

#: Largest array that is read whole: a map of float64 over a sensor of 256 Mpx.
MOST_BYTES = 1 << 31
#: Pixels of the largest frame.
MOST_PIXELS = 1 << 28
#: Largest text file.
MOST_TEXT_BYTES = 64 << 20
#: Part of the machine's memory that one file may use.
_SHARE_OF_MEMORY = 0.5


@contextlib.contextmanager
def reading(file: str | Path, what: str = "") -> Iterator[None]:
    """Turn any exception of a library on a damaged file into one `SpecError`.

    Use it only around calls of a library: it catches every exception, because parsers raise any kind on damaged bytes.

    Parameters
    ----------
    file : the file; what is neither a file nor a folder is refused before it is opened, because a pipe would be waited
        for without end.
    what : how the file was read (``as events``).
    """
    require_plain(file)
    try:
        yield
    except HesimError:
        raise
    except MemoryError:
        raise SpecError("holds more than there is memory for", file=file) from None
    except RecursionError:
        raise SpecError("is nested too deeply", file=file) from None
    except Exception as error:
        raise SpecError(" ".join(filter(None, ("cannot be read", what, f"({reason(error)})"))), file=file) from None


def require_plain(file: str | Path) -> None:
    """Refuse a pipe, a socket or a device; what is missing is left to the reader.

    Parameters
    ----------
    file : what is going to be opened.

    Raises
    ------
    SpecError
        If it is one.
    """
    try:
        mode = os.stat(file).st_mode
    except (OSError, ValueError):
        return
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise SpecError("is a pipe or a device, and no file", file=file)


def reason(error: BaseException) -> str:
    """The reason of an error on one line."""
    if isinstance(error, KeyError):
        return f"no {error.args[0]!r}" if error.args and len(str(error.args[0])) < 80 else "a part is missing"
    if isinstance(error, zlib.error):
        return "its compressed data are damaged"
    lines = str(getattr(error, "strerror", None) or error).splitlines()
    return lines[0][:200] if lines and lines[0].strip() else type(error).__name__


def leads_out(folder: Path, name: str | Path) -> bool:
    """True if a name, relative to a folder, refers to something outside the folder; links are followed."""
    return not (folder / name).resolve().is_relative_to(folder.resolve())


def printable(text: str) -> str:
    """A text on one line without control characters that move the cursor, change colours or the writing direction."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def inside(folder: Path, name: str, *, file: str | Path | None = None, key: str | None = None) -> Path:
    """The file `name` in `folder`, which must exist and lie in that folder.

    Parameters
    ----------
    folder, name : the folder, and a path relative to it.
    file, key : file and key that state the name, for the error.

    Raises
    ------
    SpecError
        If the name or a link leads out of the folder, or to something other than a plain file.
    """
    named = folder / name if file is None else file
    with reading(named):
        if leads_out(folder, name):
            raise SpecError(f"{name!r} leads out of its folder {folder.resolve()}", file=named, key=key)
        path = (folder / name).resolve()
        if not path.is_file():
            raise SpecError(f"no such file: {folder / name}" if key else "no such file", file=named, key=key)
    return path


def require_memory(size_bytes: int, what: str, file: str | Path, most: int | None = None) -> None:
    """Refuse data that would not fit into memory, before they are read.

    Parameters
    ----------
    size_bytes : size of the data, bytes.
    what, file : description and file of the data, for the error.
    most : limit, bytes; default half of the machine's memory.
    """
    limit = _machine_bytes() * _SHARE_OF_MEMORY if most is None else most
    if size_bytes > limit:
        raise SpecError(
            f"{what} would take {size_bytes / 1e9:.3g} GB of memory, more than {limit / 1e9:.3g}", file=file
        )


def require_picture(width: int, height: int, pixel_bytes: int, file: str | Path) -> None:
    """Refuse a picture by the size that its header states.

    Parameters
    ----------
    width, height : its size, px.
    pixel_bytes : memory that a pixel takes while the picture is read, bytes.
    file : the file, for the error.

    Raises
    ------
    SpecError
        If it has more than `MOST_PIXELS`, or would not fit into memory.
    """
    if width * height > MOST_PIXELS:
        raise SpecError(f"has {width}x{height} px; a picture has at most {MOST_PIXELS} px", file=file)
    require_memory(pixel_bytes * width * height, "the picture", file)


@dataclass(frozen=True)
class WholeFile:
    """A file that is read whole, so that its size has a limit.

    Parameters
    ----------
    path : the file.
    most_bytes : largest size; default `MOST_BYTES`, for text `MOST_TEXT_BYTES`.
    """

    path: Path
    most_bytes: int | None = None

    def checked(self) -> Path:
        """The path, for a library that opens the file itself.

        Raises
        ------
        SpecError
            If there is no such file, it is a pipe or a device, or it is too large.
        """
        self._require_size(MOST_BYTES)
        return self.path

    def read(self) -> bytes:
        """All bytes; see `checked` for the errors."""
        with reading(self.path):
            return self.checked().read_bytes()

    def text(self) -> str:
        """The content as text.

        Raises
        ------
        SpecError
            As `checked`, and if it is not UTF-8.
        """
        self._require_size(MOST_TEXT_BYTES)
        with reading(self.path):
            try:
                return self.path.read_text(encoding="utf-8")
            except UnicodeDecodeError:
                raise SpecError("is not a UTF-8 text file", file=self.path) from None

    def json(self) -> Any:
        """The content of a JSON file.

        Raises
        ------
        SpecError
            As `text`, and if it is not JSON.
        """
        text = self.text()
        with reading(self.path, "as JSON"):
            return json.loads(text)

    def sha256(self) -> str:
        """SHA-256 of the bytes, hexadecimal; of any size, as only a part of them is in memory at a time.

        Raises
        ------
        SpecError
            If there is no such file, or it is a pipe or a device.
        """
        with reading(self.path), self.path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()

    def _require_size(self, usual_bytes: int) -> None:
        most = usual_bytes if self.most_bytes is None else self.most_bytes
        with reading(self.path):
            size = self.path.stat().st_size
        if size > most:
            problem = f"holds {size / 1e6:.0f} MB; such a file holds at most {most / 1e6:.0f}"
            raise SpecError(problem, file=self.path)


def _machine_bytes() -> int:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
