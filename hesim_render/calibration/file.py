"""Reading ``calibration.yaml`` and its files of maps."""

import contextlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray
from pydantic import ValidationError

from hesim_render.calibration.spec import CalibrationSpec, MapsFile
from hesim_render.core.errors import HesimError, SpecError
from hesim_render.core.guard import WholeFile, inside, reason
from hesim_render.core.npz import read_arrays
from hesim_render.core.yaml_file import read_yaml
from hesim_render.specs.problems import spec_error


def read_calibration(file: str | Path) -> dict[str, Any]:
    """Read a ``calibration.yaml`` and check it against `CalibrationSpec`.

    Parameters
    ----------
    file : the calibration.

    Returns
    -------
    Plain dictionaries, lists and numbers.

    Raises
    ------
    SpecError
        If the file cannot be read, has another schema, or is not valid; the message names lines and keys.
    """
    path = Path(file)
    data = read_yaml(path, with_lines=False)
    _checked(path, data)
    return data


def load_calibration(file: str | Path) -> CalibrationSpec:
    """A ``calibration.yaml`` as its model; raises as `read_calibration`."""
    path = Path(file)
    return _checked(path, read_yaml(path, with_lines=False))


def _checked(path: Path, data: Any) -> CalibrationSpec:
    try:
        return CalibrationSpec.model_validate(data)
    except ValidationError as error:
        raise spec_error(error, CalibrationSpec, read_yaml(path), path) from None


@contextlib.contextmanager
def as_written(file: str | Path) -> Iterator[None]:
    """Turn errors from a calibration with a missing or misplaced part into a `SpecError`."""
    try:
        yield
    except HesimError:
        raise
    except KeyError as error:
        raise SpecError(f"is not as 'calibrate' writes it; it lacks {error}", file=file) from None
    except (TypeError, ValueError, AttributeError, IndexError, OverflowError, ZeroDivisionError) as error:
        raise SpecError(f"is not as 'calibrate' writes it ({reason(error)})", file=file) from None


def _map_file(file: Path, name: str, section: str) -> Path:
    """Path of a section's map file, in the folder of the calibration; a `SpecError` if it is missing or elsewhere."""
    if not (file.parent / name).exists():
        raise SpecError(f"no such file; it belongs to {file.name}: copy it along", file=file.parent / name)
    return inside(file.parent, name, file=file, key=f"{section}.maps.file")


def read_maps(
    file: str | Path, section: str, data: Mapping[str, Any] | None = None, names: Iterable[str] | None = None
) -> dict[str, NDArray]:
    """Read the maps of one section of a calibration.

    Parameters
    ----------
    file : the calibration.
    section : ``aps`` or ``evs``.
    data : result of an earlier `read_calibration`, if there is one.
    names : names of the maps to read, as far as they exist; default all.

    Returns
    -------
    {name: array}, mostly [row, col] over the captured region; docs/calibration.md lists names and units.

    Raises
    ------
    SpecError
        If the section or its map file is missing or unreadable, or the file is not the one the calibration names.
    """
    path = Path(file)
    data = read_calibration(path) if data is None else data
    if section not in data:
        raise SpecError(f"holds no section {section!r}; run 'calibrate {section}'", file=path)
    return maps_and_digest(path, MapsFile.model_validate(data[section]["maps"]), section, names)[0]


def maps_and_digest(
    file: Path, about: MapsFile, section: str, names: Iterable[str] | None
) -> tuple[dict[str, NDArray], str]:
    """Maps of a section, and the SHA-256 of their file, which must be the stated one."""
    maps = _map_file(file, about.file, section)
    digest = WholeFile(maps).sha256()
    if about.sha256 not in (None, digest):
        raise SpecError(f"is not the one that {file.name} was written with; run 'calibrate {section}' again", file=maps)
    return read_arrays(maps, only=names, kinds="bifu"), digest
