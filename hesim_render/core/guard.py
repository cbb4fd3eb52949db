"""Files that come from a stranger: every reader of recordings, captures and calibrations goes through here.

A damaged or hostile file costs one clear error. It names no file outside its own folder, and asks for no more
memory than there is.
"""

from __future__ import annotations

import contextlib
import os
import zlib
from collections.abc import Iterator
from pathlib import Path

from hesim_render.core.errors import HesimError, SpecError

#: Largest array that is read whole: a map of float64 over a sensor of 256 Mpx.
MOST_BYTES = 1 << 31
#: Pixels of the largest frame.
MOST_PIXELS = 1 << 28
#: Text files (YAML, JSON) are larger than this only by mistake: each is held as objects, a hundred times as large.
MOST_TEXT_BYTES = 64 << 20
#: Part of the machine's memory that one file may fill.
_SHARE_OF_MEMORY = 0.5


@contextlib.contextmanager
def reading(file: str | Path, what: str = "") -> Iterator[None]:
    """Turn whatever a library raises on a damaged file into one `SpecError`.

    For the calls of a library only: it takes every exception, as parsers of damaged bytes raise any of them.

    Parameters
    ----------
    what : what the file cannot be read as (``as events``).
    """
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


def reason(error: BaseException) -> str:
    """One line that says why."""
    if isinstance(error, KeyError):
        return f"no {error.args[0]!r}" if error.args and len(str(error.args[0])) < 80 else "a part is missing"
    if isinstance(error, zlib.error):
        return "its compressed data are damaged"
    lines = str(getattr(error, "strerror", None) or error).splitlines()
    return lines[0][:200] if lines and lines[0].strip() else type(error).__name__


def leads_out(folder: Path, name: str | Path) -> bool:
    """Whether a name, relative to a folder, stands for something that is not in it; links are followed."""
    return not (folder / name).resolve().is_relative_to(folder.resolve())


def printable(text: str) -> str:
    """A text on one line without what moves the cursor, changes colours or turns the direction of writing."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def inside(folder: Path, name: str, *, file: str | Path | None = None, key: str | None = None) -> Path:
    """The file `name` in `folder`, which must be there and not elsewhere.

    Parameters
    ----------
    file, key : where the name stands, for the error.

    Raises
    ------
    SpecError
        If the name or a link leads out of the folder, or to no plain file.
    """
    told = folder / name if file is None else file
    with reading(told):
        if leads_out(folder, name):
            raise SpecError(f"{name!r} leads out of its folder {folder.resolve()}", file=told, key=key)
        path = (folder / name).resolve()
        if not path.is_file():
            raise SpecError(f"no such file: {folder / name}" if key else "no such file", file=told, key=key)
    return path


def require_memory(size_bytes: int, what: str, file: str | Path, most: int | None = None) -> None:
    """Refuse what would not fit into memory, before it is read.

    Parameters
    ----------
    most : limit; default half of the machine's memory.
    """
    limit = _machine_bytes() * _SHARE_OF_MEMORY if most is None else most
    if size_bytes > limit:
        raise SpecError(
            f"{what} would take {size_bytes / 1e9:.3g} GB of memory, more than {limit / 1e9:.3g}", file=file
        )


def read_text(file: Path) -> str:
    """A UTF-8 text file of reasonable size.

    Raises
    ------
    SpecError
        If it is none.
    """
    with reading(file):
        size = file.stat().st_size
        if size > MOST_TEXT_BYTES:
            raise SpecError(f"holds {size / 1e6:.0f} MB; such files are small", file=file)
        try:
            return file.read_text(encoding="utf-8")
        except UnicodeDecodeError:
            raise SpecError("is not a UTF-8 text file", file=file) from None


def _machine_bytes() -> int:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
