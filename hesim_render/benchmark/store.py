"""Places that hold files by name: a folder, or whatever fsspec knows by its address (extra ``remote``)."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

from hesim_render.core.errors import OutputError, SpecError
from hesim_render.core.guard import leads_out
from hesim_render.core.output import output_errors, replacing

_BLOCK = 1 << 20


class Store(Protocol):
    """Files by name, with ``/`` between folders. A file appears whole or not at all."""

    def put(self, name: str, file: Path) -> None:
        """Copy a local file to a name; it replaces what is there."""
        ...

    def blocks(self, name: str) -> Iterator[bytes]:
        """The content of a file, in parts of one MiB.

        Raises
        ------
        SpecError
            If it is not there, or cannot be read.
        """
        ...

    def has(self, name: str) -> bool:
        """True if there is a file of that name."""
        ...


class FolderStore:
    """A folder of this machine.

    Parameters
    ----------
    root : the folder; it is made when the first file comes.
    """

    def __init__(self, root: Path) -> None:
        self._root = root.expanduser().resolve()

    def _path(self, name: str) -> Path:
        if leads_out(self._root, name):
            raise SpecError(f"{name!r} leads out of the folder", file=self._root)
        return self._root / name

    def put(self, name: str, file: Path) -> None:
        with replacing(self._path(name)) as unfinished:
            shutil.copyfile(file, unfinished)

    def has(self, name: str) -> bool:
        return self._path(name).is_file()

    def blocks(self, name: str) -> Iterator[bytes]:
        path = self._path(name)
        try:
            with path.open("rb") as file:
                while block := file.read(_BLOCK):
                    yield block
        except OSError as error:
            raise SpecError(f"cannot be read ({error.strerror})", file=path) from None


class RemoteStore:
    """What lies below an address that fsspec knows, such as ``s3://bucket/set``, ``memory://set`` or ``file:///set``.

    Parameters
    ----------
    address : of the place.

    Raises
    ------
    OutputError
        If fsspec or its part for this kind of address is missing, or the address is wrong.
    """

    def __init__(self, address: str) -> None:
        try:
            import fsspec
        except ImportError:
            raise OutputError(f"{address}: needs fsspec: pip install 'hesim_render[remote]'") from None
        self._address = address
        try:
            self._system, self._root = fsspec.core.url_to_fs(address)
        except (ImportError, ValueError, OSError) as error:
            raise OutputError(f"{address}: {error}") from None

    def _path(self, name: str) -> str:
        if ".." in Path(name).parts or name.startswith("/"):
            raise SpecError(f"{name!r} leads out of the folder", file=self._address)
        return f"{self._root.rstrip('/')}/{name}"

    def put(self, name: str, file: Path) -> None:
        path = self._path(name)
        unfinished = f"{path}.partial"
        with _told(self._address):
            self._system.makedirs(path.rpartition("/")[0], exist_ok=True)
            self._system.put_file(str(file), unfinished)
            self._system.mv(unfinished, path)  # object stores show an object when all of it is there, others do not

    def has(self, name: str) -> bool:
        with _told(self._address):
            return bool(self._system.isfile(self._path(name)))

    def blocks(self, name: str) -> Iterator[bytes]:
        try:
            with self._system.open(self._path(name), "rb") as file:
                while block := file.read(_BLOCK):
                    yield block
        except OSError as error:
            raise SpecError(f"cannot be read ({error.strerror or type(error).__name__})", file=name) from None


def _told(address: str) -> Any:
    return output_errors(Path(address))


def store_of(target: str | Path) -> Store:
    """The place of an address (``scheme://…``), or of a folder."""
    text = str(target)
    return RemoteStore(text) if "://" in text else FolderStore(Path(text))
