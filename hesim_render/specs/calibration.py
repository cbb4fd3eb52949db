"""``calibration.yaml``: reading it, and a sensor file that points at one (``noise: calibration.yaml``)."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from numpy.typing import NDArray
from pydantic import (
    Field,
    PrivateAttr,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
    model_validator,
)

from hesim_render.core.errors import HesimError, SpecError
from hesim_render.core.guard import inside, reading, reason
from hesim_render.core.npz import read_arrays
from hesim_render.specs.calibration_spec import SECTIONS, CalibrationSpec
from hesim_render.specs.files import Strict
from hesim_render.specs.geometry import Region
from hesim_render.specs.problems import spec_error
from hesim_render.specs.yamlfile import read_yaml


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
    try:
        CalibrationSpec.model_validate(data)
    except ValidationError as error:
        raise spec_error(error, CalibrationSpec, read_yaml(path), path) from None
    return data


#: Maps of pixels that misbehave.
TELEGRAPH_MAPS = ("telegraph_amplitude_dn", "telegraph_high_share", "telegraph_correlation")
DEFECT_MAPS = (
    *("defect", "defect_on_per_trial", "defect_off_per_trial"),
    *("defect_firing_share", "defect_correlation"),
)
ASYNCHRONOUS_DEFECT_MAPS = ("defect", "defect_on_hz", "defect_off_hz", "defect_firing_share", "defect_change_hz")
#: Maps that a sensor takes from each section; thresholds are known only where contrast steps were captured.
SENSOR_MAPS = {
    "aps": ("n_row", "n_blc", "n_dp", *TELEGRAPH_MAPS),
    "evs": (
        "bad_pixels",
        "threshold_on_relative",
        "threshold_off_relative",
        *dict.fromkeys((*DEFECT_MAPS, *ASYNCHRONOUS_DEFECT_MAPS)),
    ),
}


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


def map_file(file: Path, data: Mapping[str, Any], section: str) -> Path:
    """Path of a section's map file, in the folder of the calibration; a `SpecError` if it is missing or elsewhere."""
    name = data[section]["maps"]["file"]
    if not (file.parent / name).exists():
        raise SpecError(f"no such file; it belongs to {file.name}: copy it along", file=file.parent / name)
    return inside(file.parent, name, file=file, key=f"{section}.maps.file")


def file_digest(file: Path) -> str:
    """SHA-256 of a file."""
    with reading(file), file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


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
    return _maps_and_digest(path, data, section, names)[0]


def _maps_and_digest(
    file: Path, data: Mapping[str, Any], section: str, names: Iterable[str] | None
) -> tuple[dict[str, NDArray], str]:
    """Maps of an existing section, and the SHA-256 of their file, which must be the stated one."""
    maps = map_file(file, data, section)
    digest = file_digest(maps)
    if data[section]["maps"].get("sha256", digest) != digest:
        raise SpecError(f"is not the one that {file.name} was written with; run 'calibrate {section}' again", file=maps)
    return read_arrays(maps, only=names, kinds="bifu"), digest


@dataclass(frozen=True)
class MeasuredMaps:
    """Maps that a sensor keeps of its calibration, so that it needs no file afterwards.

    Attributes
    ----------
    sha256 : hash of the calibration and its maps; equal hashes mean equal maps.
    file : path for error messages.
    roi : captured region, None for the whole sensor.
    sections : arrays of ``aps`` and ``evs`` by name, as far as they were calibrated.
    """

    sha256: str
    file: Path = field(compare=False)
    roi: Region | None = field(compare=False)
    sections: Mapping[str, Mapping[str, NDArray]] = field(compare=False, repr=False)


class NoiseFile(Strict):
    """The calibration that a sensor file points at, and its maps, which are read once.

    A dump holds the SHA-256 of the calibration and its maps, not their path.
    """

    file: str
    sha256: str | None = Field(None, description="of the calibration and its maps; they are refused if they differ")
    folder: Path = Field(Path(), exclude=True)
    _measured: MeasuredMaps | None = PrivateAttr(None)

    @model_validator(mode="before")
    @classmethod
    def _shorthand(cls, data: Any) -> Any:
        return {"file": data} if isinstance(data, str) else data

    @property
    def measured(self) -> MeasuredMaps:
        """Maps that a simulation uses; the first call reads them. A `SpecError` says why they cannot be used."""
        if self._measured is None:
            self.keep_maps(self.read())
        assert self._measured is not None
        return self._measured

    def keep_maps(self, data: Mapping[str, Any]) -> None:
        """Read and keep the maps of the calibration `data`; raises as `measured`."""
        digest = hashlib.sha256(bytes.fromhex(file_digest(self.path)))
        sections = {}
        for section in SECTIONS:
            if section in data:
                sections[section], own = _maps_and_digest(self.path, data, section, SENSOR_MAPS[section])
                digest.update(bytes.fromhex(own))
        if self.sha256 not in (None, digest.hexdigest()):
            raise SpecError("it, or a map of it, is not the one this sensor was written with", file=self.path)
        roi = data["capture"].get("roi")
        region = None if roi is None else Region.model_validate(roi)
        self._measured = MeasuredMaps(digest.hexdigest(), self.path, region, sections)

    @model_serializer(mode="wrap")
    def _with_hash(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {**handler(self), "sha256": self.sha256 or self.measured.sha256}

    @property
    def path(self) -> Path:
        return self.folder / self.file

    def read(self) -> dict[str, Any]:
        """The calibration.

        Raises
        ------
        SpecError
            If it cannot be read, or is not the one that `sha256` names.
        """
        data = read_calibration(self.path)
        if not any(section in data for section in SECTIONS):
            raise SpecError("holds neither a section 'aps' nor 'evs'", file=self.path)
        if self.sha256 is not None:
            self.keep_maps(data)
        return data


class NoisePart(Strict):
    """The part of a sensor file that is read before the rest."""

    noise: NoiseFile
