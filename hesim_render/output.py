"""Output folders that appear whole or not at all."""

from __future__ import annotations

import atexit
import contextlib
import os
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path

from hesim_render.errors import HesimError, OutputError

#: Temporary folders of this process that have neither been committed nor discarded.
_unfinished: set[Path] = set()


@atexit.register
def discard_unfinished() -> None:
    """Remove every temporary folder still being written.

    An interrupt can arrive between any two instructions, also before the `try` that would have
    discarded the folder; whoever ends on one calls this last.
    """
    for path in list(_unfinished):
        _remove(path)


def _remove(path: Path) -> None:
    shutil.rmtree(path, ignore_errors=True)
    _unfinished.discard(path)


def check_target(target: str | Path, marker: str, overwrite: bool = False) -> Path:
    """Whether a folder may be written at `target`; returns its absolute path.

    Parameters
    ----------
    marker : file that tells a folder of ours, which `overwrite` may replace; no other folder is touched.

    Raises
    ------
    OutputError
        If something is there that must not be replaced, or the place cannot hold a folder.
    """
    path = Path(target).expanduser().resolve()
    for parent in path.parents:
        if parent.exists():
            if not parent.is_dir():
                raise OutputError(f"{target}: cannot be written ({parent} is not a folder)")
            if not os.access(parent, os.W_OK | os.X_OK):
                raise OutputError(f"{target}: cannot be written (no permission to write in {parent})")
            break
    if not path.exists():
        return path
    if not path.is_dir():
        raise OutputError(f"{target}: is a file; give the name of a new folder")
    if not any(path.iterdir()):
        return path
    if not (path / marker).is_file():
        raise OutputError(f"{target}: exists and holds other things; give the name of a new folder")
    if not overwrite:
        raise OutputError(f"{target}: exists; give another name, or overwrite it (--overwrite, overwrite=True)")
    return path


@contextlib.contextmanager
def output_errors(target: Path) -> Iterator[None]:
    """Turns failures of writing (also those of HDF5, which come as several kinds) into `OutputError`."""
    try:
        yield
    except HesimError:
        raise
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or (str(error).splitlines() or [type(error).__name__])[0]
        raise OutputError(f"{target}: cannot be written ({reason})") from None


class OutputFolder:
    """A folder being written under a temporary name beside its target.

    `commit` gives it its name; `discard` removes it. Leftovers of killed runs of this machine are
    removed on the way in.

    Raises
    ------
    OutputError
        As `check_target`, and if the temporary folder cannot be made.
    """

    def __init__(self, target: str | Path, marker: str, overwrite: bool = False) -> None:
        self.target = check_target(target, marker, overwrite)
        self._marker, self._overwrite = marker, overwrite
        host = socket.gethostname()
        prefix = f".{self.target.name}.{host}-"
        self.path = self.target.parent / f"{prefix}{os.getpid()}.partial"
        with output_errors(self.target):
            self.target.parent.mkdir(parents=True, exist_ok=True)
            for leftover in self.target.parent.glob(f"{prefix}*.partial"):
                owner = leftover.name.removeprefix(prefix).removesuffix(".partial")
                if owner.isdigit() and (int(owner) == os.getpid() or not _is_alive(int(owner))):
                    shutil.rmtree(leftover, ignore_errors=True)
            _unfinished.add(self.path)
            self.path.mkdir()

    def commit(self) -> Path:
        """Give the finished folder its name; what was there before is removed afterwards."""
        check_target(self.target, self._marker, self._overwrite)
        with output_errors(self.target):
            old = self.path.with_suffix(".old")
            replaces = self.target.exists()
            if replaces:
                os.rename(self.target, old)
            try:
                os.rename(self.path, self.target)
            except OSError:
                if replaces:
                    os.rename(old, self.target)
                raise
            _unfinished.discard(self.path)
            if replaces:
                shutil.rmtree(old, ignore_errors=True)
        return self.target

    def discard(self) -> None:
        _remove(self.path)


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
