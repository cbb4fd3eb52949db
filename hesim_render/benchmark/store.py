"""Places that hold files by name: a folder, or whatever fsspec knows by its address (extra ``remote``)."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol

from hesim_render.core.errors import OutputError, SpecError, how_to_install
from hesim_render.core.guard import inside
from hesim_render.core.names import file_name, require_file_name
from hesim_render.core.output import OutputFolder, output_errors

_BLOCK = 1 << 20
#: Copies a local file to a name.
Put = Callable[[str, Path], None]


class Store(Protocol):
    """A set of files by name (`file_name`), of which one, the marker, says that the set is whole."""

    def writing(self, marker: str, overwrite: bool) -> AbstractContextManager[Put]:
        """A function that copies a local file to a name, to be used in a with statement; the marker comes last.

        After an error nothing of the new set is left.

        Raises
        ------
        OutputError
            If there is a set and `overwrite` is False, or it cannot be written.
        """

    def blocks(self, name: str) -> Iterator[bytes]:
        """The content of a file, in parts of one MiB.

        Raises
        ------
        SpecError
            If it is not there, or cannot be read.
        """


class FolderStore:
    """A folder of this machine, which appears whole or not at all."""

    def __init__(self, root: Path) -> None:
        self._root = root.expanduser().resolve()

    @contextmanager
    def writing(self, marker: str, overwrite: bool) -> Iterator[Put]:
        with OutputFolder(self._root, marker, overwrite) as folder:

            def put(name: str, file: Path) -> None:
                with output_errors(folder.target):
                    shutil.copyfile(file, folder.path / file_name(name))

            yield put

    def blocks(self, name: str) -> Iterator[bytes]:
        path = inside(self._root, require_file_name(name, self._root))
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
            raise OutputError(f"{address}: needs fsspec: {how_to_install('remote')}") from None
        self._address = address
        try:
            self._system, self._root = fsspec.core.url_to_fs(address)
        except (ImportError, ValueError, OSError) as error:
            raise OutputError(f"{address}: {error}") from None

    def _path(self, name: str) -> str:
        return f"{self._root.rstrip('/')}/{require_file_name(name, self._address)}"

    @contextmanager
    def writing(self, marker: str, overwrite: bool) -> Iterator[Put]:
        made: list[str] = []

        def put(name: str, file: Path) -> None:
            path = self._path(name)
            unfinished = f"{path}.partial"
            with _address_errors(self._address):
                made.append(unfinished)
                self._system.makedirs(path.rpartition("/")[0], exist_ok=True)
                self._system.put_file(str(file), unfinished)
                made.append(path)
                self._system.mv(unfinished, path)  # object stores show an object when all of it is there, others do not

        with _address_errors(self._address):
            if self._system.isfile(self._path(marker)):
                if not overwrite:
                    problem = "exists; give another name, or overwrite it (--overwrite, overwrite=True)"
                    raise OutputError(f"{self._address}: {problem}")
                self._system.rm_file(self._path(marker))  # the set is no longer whole
        try:
            yield put
        except BaseException:
            for path in made:
                with suppress(Exception):  # of any kind, as each system has its own
                    self._system.rm_file(path)
            raise

    def blocks(self, name: str) -> Iterator[bytes]:
        try:
            with self._system.open(self._path(name), "rb") as file:
                while block := file.read(_BLOCK):
                    yield block
        except OSError as error:
            raise SpecError(f"cannot be read ({error.strerror or type(error).__name__})", file=name) from None


def _address_errors(address: str) -> Any:
    return output_errors(Path(address))


def store_of(target: str | Path) -> Store:
    """The place of an address (``scheme://…``), or of a folder."""
    text = str(target)
    return RemoteStore(text) if "://" in text else FolderStore(Path(text))
