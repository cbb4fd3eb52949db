"""Reading a sensor file: parsed once, then what its data sheet and its calibration say becomes values of the model."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from ruamel.yaml.comments import CommentedMap

from hesim_render.calibration.measured import MeasuredMaps, measured_maps, read_named
from hesim_render.calibration.sensor_values import apply_calibration, with_intervals
from hesim_render.core.errors import HesimWarning, SpecError
from hesim_render.sensor.from_data_sheet import derive
from hesim_render.specs.doubts import doubts
from hesim_render.specs.event_pixels import DERIVED, SHEETS
from hesim_render.specs.files import apply_overrides, load_yaml, locate, validate
from hesim_render.specs.noise_file import NoiseFile, NoisePart
from hesim_render.specs.problems import line_of
from hesim_render.specs.sensor import SensorSpec, SheetSensorSpec
from hesim_render.specs.sensor_checks import unused


class SensorFile(NamedTuple):
    """What a sensor file says.

    Parameters
    ----------
    spec : all values of the model.
    maps : those of the calibration that the file names; None without one.
    """

    spec: SensorSpec
    maps: MeasuredMaps | None


def read_sensor(name_or_path: str | Path, overrides: Mapping[str, Any] | None = None) -> SensorSpec:
    """The values of a sensor file, without the maps of its calibration; raises and warns as `read_sensor_file`."""
    return read_sensor_file(name_or_path, overrides).spec


def read_sensor_file(name_or_path: str | Path, overrides: Mapping[str, Any] | None = None) -> SensorFile:
    """A sensor file, by shipped name or path, with dotted `overrides`.

    The calibration that ``noise`` names, relative to the file (to the working directory where it is an
    override), replaces the file's own values first: overrides have the last word.

    Raises
    ------
    SpecError
        With file, line and key of all that is wrong. A letter or filter of the file that no pixel uses is an error; one
        that no pixel uses after `overrides` is a `HesimWarning`, as is a value that no sensor has (`doubts`).
    """
    file = locate(name_or_path, "sensors")
    data, changes = load_yaml(file), dict(overrides or {})
    if "pixels" not in data and {"target", "objects", "light", "camera", "mitsuba"} & set(data):
        raise SpecError("is a scene file; expected a sensor file", file=file)
    noise = _noise_of(data, changes, file)
    # the intervals of the file itself: overrides are of the simulation
    own = {name: dict(data[name]) for name in ("aps", "evs") if isinstance(data.get(name), Mapping)}
    # what does not follow from a data sheet is needed to read it; the rest has the last word over it
    needed = {key: value for key, value in changes.items() if not _is_derived(key)}
    apply_overrides(data, needed)
    evs = data.get("evs")
    if isinstance(evs, CommentedMap) and any(evs.get(section) is not None for section in SHEETS):
        _require_once(data, file)
        derive(data, validate(SheetSensorSpec, data, file, needed), file)
    spec, maps = validate(SensorSpec, data, file, changes), None
    if noise is not None:
        calibration = read_named(noise)
        noise = with_intervals(own, noise, calibration)
        apply_calibration(data, noise, calibration)
        maps = measured_maps(noise, calibration)
        data["noise"] = {**dict(noise), "sha256": maps.sha256}
        spec = validate(SensorSpec, data, file, changes)
    _tell_doubts(spec, data, file, changes)
    return SensorFile(spec, maps)


def _noise_of(data: CommentedMap, changes: dict[str, Any], file: Path) -> NoiseFile | None:
    """The calibration that a file or the overrides name, which are taken out of both."""
    folder = Path.cwd() if "noise" in changes else file.parent
    given = changes.pop("noise", data.get("noise"))
    of_noise = {key.removeprefix("noise."): changes.pop(key) for key in list(changes) if key.startswith("noise.")}
    if given is None and not of_noise:
        return None
    given = {"file": given} if isinstance(given, str) else given
    if not isinstance(given, Mapping) or not isinstance(given.get("file"), str):
        raise SpecError("expected the path of a calibration.yaml", file=file, key="noise")
    data.pop("noise", None)
    return validate(NoisePart, {"noise": {**given, **of_noise, "folder": folder}}, file, {}).noise


def _is_derived(key: str) -> bool:
    section, _, rest = key.partition(".")
    return section == "evs" and rest.split(".")[0] in DERIVED


def _require_once(data: CommentedMap, file: Path) -> None:
    """Refuse values beside a data sheet that follow from it."""
    problems = [
        SpecError("follows from data_sheet or v2e: leave one of them out", file=file, line=line_of(data, ("evs", key)),
                  key=f"evs.{key}") for key in DERIVED if key in data["evs"]
    ]  # fmt: skip
    if problems:
        raise SpecError.together(problems)


def _tell_doubts(spec: SensorSpec, data: CommentedMap, file: Path, changes: Mapping[str, Any]) -> None:
    """Refuse what no pixel uses, and warn of values that no sensor has."""
    problems = [SpecError(text, file=file, line=line_of(data, key.split(".")), key=key) for key, text in unused(spec)]
    if problems and not changes:
        raise SpecError.together(problems)
    for problem in problems:  # after an override this may be intended: the replaced part stays in the file
        warnings.warn(str(problem), HesimWarning, stacklevel=4)
    for key, text in doubts(spec):
        known = None if key in changes else line_of(data, key.split("."))
        warnings.warn(str(SpecError(text, file=file, line=known, key=key)), HesimWarning, stacklevel=4)
