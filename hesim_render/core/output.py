"""Output folders and files that appear whole or not at all."""

import atexit
import contextlib
import ctypes
import fcntl
import glob
import hashlib
import os
import re
import shutil
import socket
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from hesim_render.core.errors import HesimError, OutputError

#: Temporary files and folders of this process that are neither committed nor discarded, with their targets.
_unfinished: dict[Path, Path] = {}
#: Longest part of a target's name in a temporary name, because file names have at most 255 bytes.
_LONGEST_NAME = 100
#: Time to wait for another run in the same folder, and between two looks at it, s.
_PATIENCE_S, _PAUSE_S = 120.0, 0.05
_CUT_SHORT = re.compile(r"\d+ requested and \d+ written")
_RENAME_EXCHANGE = 2  # of renameat2(2)


@atexit.register
def discard_unfinished() -> None:
    """Remove all unfinished temporary output, and put back what it was to replace.

    An interrupt can arrive between any two instructions, also before the `try` block that would
    discard the folder. Code that ends the process because of an interrupt calls this last.
    """
    for path, target in list(_unfinished.items()):
        _put_back(path.with_suffix(".old"), target)
        _remove(path)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
    _unfinished.pop(path, None)


def short_name(target: Path) -> str:
    """Name of a target, shortened where names made of it would be too long."""
    name = target.name
    if len(os.fsencode(name)) > _LONGEST_NAME:
        name = f"{name[: _LONGEST_NAME // 4]}-{hashlib.sha256(os.fsencode(name)).hexdigest()[:16]}"
    return name


def _prefix(target: Path) -> str:
    """Common begin of the names of temporary files for a target; the process number follows."""
    return f".{short_name(target)}.{socket.gethostname()[:64]}-"


def unfinished_place(target: Path) -> Path:
    """Where the output of this process for an absolute target lies until it is complete."""
    return target.with_name(f"{_prefix(target)}{os.getpid()}.partial")


def _tidy_up(target: Path) -> None:
    """Clean up after killed runs on this machine: restore old output of a target, remove unfinished output."""
    prefix = _prefix(target)
    for suffix in (".old", ".partial"):  # first what can be put back
        for leftover in target.parent.glob(f"{glob.escape(prefix)}*{suffix}"):
            owner = leftover.name.removeprefix(prefix).removesuffix(suffix)
            if owner.isdigit() and leftover not in _unfinished and not _is_alive_elsewhere(int(owner)):
                _put_back(leftover, target) if suffix == ".old" else _remove(leftover)


def _put_back(old: Path, target: Path) -> None:
    """Move replaced output back if its place is empty, otherwise remove it."""
    if not old.exists():
        return
    if target.exists():
        _remove(old)
        return
    with contextlib.suppress(OSError):
        os.rename(old, target)


def _exchange(path: Path, target: Path) -> bool:
    """Exchange two paths in one step; False if the system cannot."""
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError):
        return False
    here = -100  # AT_FDCWD
    return rename(here, os.fsencode(path), here, os.fsencode(target), _RENAME_EXCHANGE) == 0


def check_target(target: str | Path, marker: str, overwrite: bool = False) -> Path:
    """Check that a folder may be written at `target`; returns its absolute path.

    Parameters
    ----------
    target : the folder.
    marker : file that marks a folder of this package, which `overwrite` may replace; no other folder is touched.
    overwrite : allow replacing such a folder.

    Raises
    ------
    OutputError
        If something exists there that must not be replaced, or the place cannot hold a folder.
    """
    with output_errors(Path(target)):
        path = Path(target).expanduser().resolve()
        _check_name(path, target)
        _tidy_up(path)
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


def check_place(target: str | Path, suffixes: Sequence[str] = ()) -> Path:
    """Check that a file may be written at `target`; returns its absolute path, without following a final link.

    Parameters
    ----------
    target : the file.
    suffixes : ends of names that say what the file holds; () for any.

    Raises
    ------
    OutputError
        If there is a folder, the place cannot hold a file, or the name ends otherwise.
    """
    with output_errors(Path(target)):
        path = Path(target).expanduser().absolute()
        _check_name(path, target)
        _tidy_up(path)
        if path.is_dir():
            raise OutputError(f"{target}: is a folder; give the name of a file")
    if suffixes and path.suffix.lower() not in suffixes:
        raise OutputError(f"{target}: give a name that ends in {' or '.join(suffixes)}")
    return path


def free_place(target: str | Path, overwrite: bool, suffixes: Sequence[str] = ()) -> Path:
    """As `check_place`; a file that is there already must be meant to be replaced.

    Raises
    ------
    OutputError
        If there is something and `overwrite` is False, or a file cannot be there, or its name ends otherwise.
    """
    path = check_place(target, suffixes)
    if (path.exists() or path.is_symlink()) and not overwrite:
        raise OutputError(f"{target}: exists; give another name, or overwrite it (--overwrite, overwrite=True)")
    return path


def _check_name(path: Path, target: str | Path) -> None:
    """Check that the name is short enough, and that its folder can be created and written to."""
    if len(os.fsencode(path.name)) > _most_bytes(path.parent):
        raise OutputError(f"{str(target)[:60]}…: the name is too long")
    for parent in path.parents:
        if parent.exists():
            if not parent.is_dir():
                raise OutputError(f"{target}: cannot be written ({parent} is not a folder)")
            if not os.access(parent, os.W_OK | os.X_OK):
                raise OutputError(f"{target}: cannot be written (no permission to write in {parent})")
            break


def _most_bytes(folder: Path) -> int:
    """Longest name in a folder, bytes."""
    try:
        return os.pathconf(next(parent for parent in (folder, *folder.parents) if parent.is_dir()), "PC_NAME_MAX")
    except (OSError, ValueError):
        return 255


@contextlib.contextmanager
def output_errors(target: Path) -> Iterator[None]:
    """Turn write errors (also the various ones of HDF5) into `OutputError`."""
    try:
        yield
    except HesimError:
        raise
    except (OSError, RuntimeError) as error:
        raise OutputError(f"{_final(target)}: cannot be written ({_reason(error)})") from None


def _final(path: Path) -> Path:
    """The place that a file will have: temporary names mean nothing to a user."""
    for unfinished, target in _unfinished.items():
        if path.is_relative_to(unfinished):
            return target / path.relative_to(unfinished)
    return path


def _reason(error: Exception) -> str:
    reason = getattr(error, "strerror", None) or (str(error).splitlines() or [type(error).__name__])[0]
    # NumPy reports a truncated write only by its number of items
    return "no space left, or a limit on the size of files" if _CUT_SHORT.fullmatch(reason) else reason


@contextlib.contextmanager
def replacing(target: Path) -> Iterator[Path]:
    """Path of a temporary file that replaces the target after success, and is removed after an error.

    The target is replaced in one step. If it is a link, the link is replaced, not followed.
    """
    with output_errors(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        _tidy_up(target)
        path = unfinished_place(target)
        _unfinished[path] = target
        try:
            yield path
            os.replace(path, target)
            _unfinished.pop(path, None)
        except BaseException:
            _remove(path)
            raise


def write_whole(target: Path, text: str) -> None:
    """Write a text as a file that appears whole or not at all, as `replacing` does."""
    with replacing(target) as unfinished:
        unfinished.write_text(text, encoding="utf-8")


@contextlib.contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Keep other runs from changing files of a folder that belong together, while they are read, changed and written.

    The folder itself is locked (flock), so nothing is left behind, and the lock ends with the process. A run that holds
    it does so for seconds. Where a file system has no such locks, none is taken.

    Raises
    ------
    OutputError
        If the folder cannot be made, or another run holds it for two minutes.
    """
    with output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        end = time.monotonic() + _PATIENCE_S
        while True:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > end:
                    raise OutputError(
                        f"{folder}: another run has been writing its results there for {_PATIENCE_S:g} s; run this "
                        "again when it has ended"
                    ) from None
                time.sleep(_PAUSE_S)
            except OSError:
                break
        yield
    finally:
        os.close(handle)


class OutputFolder:
    """A folder that is written under a temporary name beside its target.

    `commit` gives it the final name; `discard` removes it. Leftovers of killed runs on this machine are
    removed when it is created.

    Raises
    ------
    OutputError
        As `check_target`, and if the temporary folder cannot be created.
    """

    def __init__(self, target: str | Path, marker: str, overwrite: bool = False) -> None:
        self.target = check_target(target, marker, overwrite)
        self._marker, self._overwrite = marker, overwrite
        self.path = unfinished_place(self.target)
        with output_errors(self.target):
            self.target.parent.mkdir(parents=True, exist_ok=True)
            _remove(self.path)  # of an earlier try of this process
            _unfinished[self.path] = self.target
            self.path.mkdir()

    def commit(self) -> Path:
        """Give the finished folder its name, then remove the folder that it replaces.

        At every instant the name refers to the old folder or to the new one. If the file system cannot exchange two
        folders, there is an instant without either; after a crash there, the next run puts the old folder back.
        """
        check_target(self.target, self._marker, self._overwrite)
        with output_errors(self.target):
            if not self.target.exists():
                os.rename(self.path, self.target)
            elif not _exchange(self.path, self.target):
                self._move_in()
            _remove(self.path)  # the old one, after an exchange
        return self.target

    def _move_in(self) -> None:
        old = self.path.with_suffix(".old")
        try:
            os.rename(self.target, old)
            os.rename(self.path, self.target)
        finally:
            _put_back(old, self.target)

    def discard(self) -> None:
        _remove(self.path)

    def __enter__(self) -> "OutputFolder":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Give the folder its name at the end of the with statement; remove it after an exception."""
        try:
            if kind is None:
                self.commit()
        finally:
            self.discard()


def _is_alive_elsewhere(pid: int) -> bool:
    """True if another process with this number is running."""
    if pid == os.getpid():
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True
