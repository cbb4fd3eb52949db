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
    PositiveFloat,
    PrivateAttr,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
    model_validator,
)

from hesim_render.core.errors import HesimError, SpecError
from hesim_render.core.guard import inside, reading, reason
from hesim_render.core.npz import read_arrays
from hesim_render.core.units import S_PER_US
from hesim_render.specs.calibration_rates import PER_INTERVAL, PER_SECOND, needs_interval
from hesim_render.specs.calibration_spec import (
    AsynchronousSection,
    CalibrationSpec,
    EventSection,
    FrameSection,
    MapsFile,
)
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


#: Maps that a sensor takes from each section; thresholds are known only where contrast steps were captured.
SENSOR_MAPS = {
    section: tuple(dict.fromkeys((*names, *PER_SECOND[section], *PER_INTERVAL[section])))
    for section, names in (
        ("aps", ("n_row", "n_blc", "n_dp", "response")),
        ("evs", ("bad_pixels", "threshold_on_relative", "threshold_off_relative")),
    )
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


def _map_file(file: Path, name: str, section: str) -> Path:
    """Path of a section's map file, in the folder of the calibration; a `SpecError` if it is missing or elsewhere."""
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
    return _maps_and_digest(path, MapsFile.model_validate(data[section]["maps"]), section, names)[0]


def _maps_and_digest(
    file: Path, about: MapsFile, section: str, names: Iterable[str] | None
) -> tuple[dict[str, NDArray], str]:
    """Maps of a section, and the SHA-256 of their file, which must be the stated one."""
    maps = _map_file(file, about.file, section)
    digest = file_digest(maps)
    if about.sha256 not in (None, digest):
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
    intervals_s : from one frame (comparison) to the next, of each section; None where it is not known.
    """

    sha256: str
    file: Path = field(compare=False)
    roi: Region | None = field(compare=False)
    sections: Mapping[str, Mapping[str, NDArray]] = field(compare=False, repr=False)
    intervals_s: Mapping[str, float | None] = field(compare=False)


class NoiseFile(Strict):
    """The calibration that a sensor file points at, and its maps, which are read once.

    A dump holds the SHA-256 of the calibration and its maps, not their path.
    """

    file: str
    sha256: str | None = Field(None, description="of the calibration and its maps; they are refused if they differ")
    tick_us: PositiveFloat | None = Field(
        None, description="of the captures, where the calibration does not state it; default evs.tick_us of the file"
    )
    frame_rate_hz: PositiveFloat | None = Field(None, description="the same of frames; default aps.frame_rate_hz")
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

    def keep_maps(self, data: CalibrationSpec) -> None:
        """Read and keep the maps of the calibration `data`; raises as `measured`."""
        digest = hashlib.sha256(bytes.fromhex(file_digest(self.path)))
        sections: dict[str, dict[str, NDArray]] = {}
        for name, section in data.sections.items():
            sections[name], own = _maps_and_digest(self.path, section.maps, name, SENSOR_MAPS[name])
            if needs_interval(name, sections[name]):
                self.interval_s(name, section)
            digest.update(bytes.fromhex(own))
        if self.sha256 not in (None, digest.hexdigest()):
            raise SpecError("it, or a map of it, is not the one this sensor was written with", file=self.path)
        intervals_s = {name: section.interval_s or self._own_s(name) for name, section in data.sections.items()}
        self._measured = MeasuredMaps(digest.hexdigest(), self.path, data.capture.roi, sections, intervals_s)

    def _own_s(self, name: str) -> float | None:
        if name == "aps":
            return None if self.frame_rate_hz is None else 1.0 / self.frame_rate_hz
        return None if self.tick_us is None else self.tick_us * S_PER_US

    def interval_s(self, name: str, section: FrameSection | EventSection | AsynchronousSection) -> float:
        """From one frame (comparison) of the captures to the next, s: that of the calibration, else of the sensor file.

        Raises
        ------
        SpecError
            If neither states it.
        """
        found = section.interval_s or self._own_s(name)
        if found is None:
            key = "frame_rate_hz" if name == "aps" else "tick_us"
            text = "is not stated, and values per frame or comparison tell no rate per second without it"
            raise SpecError(f"{text}; add that of the captures", file=self.path, key=f"{name}.{key}")
        return found

    @model_serializer(mode="wrap")
    def _with_hash(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        known = {key: value for key, value in handler(self).items() if value is not None}
        return {**known, "sha256": self.sha256 or self.measured.sha256}

    @property
    def path(self) -> Path:
        return self.folder / self.file

    def read(self) -> CalibrationSpec:
        """The calibration.

        Raises
        ------
        SpecError
            If it cannot be read, or is not the one that `sha256` names.
        """
        data = load_calibration(self.path)
        if not data.sections:
            raise SpecError("holds neither a section 'aps' nor 'evs'", file=self.path)
        if self.sha256 is not None:
            self.keep_maps(data)
        return data


class NoisePart(Strict):
    """The part of a sensor file that is read before the rest."""

    noise: NoiseFile
