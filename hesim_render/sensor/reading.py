"""Reading a sensor file: parsed once, then what its data sheet and its calibration say becomes values of the model.

Doubts are values that can be simulated, but that no sensor has: probably a wrong unit or a missing digit.
"""

import math
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from ruamel.yaml.comments import CommentedMap

from hesim_render.calibration.measured import MeasuredMaps, measured_maps, read_named
from hesim_render.calibration.sensor_values import apply_calibration, with_intervals
from hesim_render.core.errors import HesimWarning, SpecError
from hesim_render.core.units import S_PER_US
from hesim_render.core.yaml_file import read_yaml
from hesim_render.sensor.from_data_sheet import derive
from hesim_render.specs.event_pixels import DERIVED, SHEETS, EvsSpec
from hesim_render.specs.files import apply_overrides, locate, validate
from hesim_render.specs.frame_pixels import ApsSpec
from hesim_render.specs.problems import line_of
from hesim_render.specs.sensor import NoiseFile, NoisePart, SensorSpec, SheetSensorSpec
from hesim_render.specs.sensor_checks import unused

#: Shortest exposure that is not doubted, µs: shutters of cameras take about 10 µs at least.
_SHORTEST_US = 10
#: Ratio of the ADC's range to the full well, either way, from which one of them is doubted.
_MOST_APART = 10.0
#: Parts of the full well above which read noise and dark current are doubted, and of the ADC's range for the black.
_MOST_NOISE, _MOST_DARK, _MOST_BLACK = 0.1, 0.5, 0.5
#: Contrasts of thresholds that are not doubted.
_CONTRASTS = (0.01, 10.0)


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
    data, changes = read_yaml(file), dict(overrides or {})
    if "pixels" not in data and {"target", "objects", "light", "camera", "mitsuba"} & set(data):
        raise SpecError("is a scene file; expected a sensor file", file=file)
    # parse: the calibration is taken out, because its values come before those of the overrides
    noise = _noise_of(data, changes, file)
    # the intervals of the file itself: overrides are of the simulation
    own = {name: dict(data[name]) for name in ("aps", "evs") if isinstance(data.get(name), Mapping)}
    # what does not follow from a data sheet is needed to read it; the rest has the last word over it
    needed = {key: value for key, value in changes.items() if not _is_derived(key)}
    apply_overrides(data, needed)
    # resolve, first step: thresholds and noise from the figures of a data sheet
    evs = data.get("evs")
    if isinstance(evs, CommentedMap) and any(evs.get(section) is not None for section in SHEETS):
        _require_once(data, file)
        derive(data, validate(SheetSensorSpec, data, file, needed), file)
    # the whole file is checked here; where nothing is to be resolved this is the only time
    spec, maps = validate(SensorSpec, data, file, changes), None
    # second step: what was measured replaces what was assumed
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


def doubts(spec: SensorSpec) -> Iterator[tuple[str, str]]:
    """Dotted keys of values that are hardly meant, and what is odd about each.

    Parameters
    ----------
    spec : the content of a sensor file, which is valid.
    """
    if spec.aps is not None:
        yield from _of_frames(spec.aps)
    if spec.evs is not None:
        yield from _of_events(spec.evs)


def _of_frames(aps: ApsSpec) -> Iterator[tuple[str, str]]:
    if aps.exposure_us < _SHORTEST_US:
        yield "aps.exposure_us", f"{aps.exposure_us} µs is shorter than any camera's shutter; exposures are in µs"
    elif aps.shutter == "rolling" and aps.exposure_us < aps.line_time_us:
        yield "aps.exposure_us", f"{aps.exposure_us} µs is shorter than line_time_us, {aps.line_time_us:g} µs"
    full_scale = 2**aps.bit_depth - 1
    range_e = (full_scale - aps.black_level_dn) / aps.system_gain_dn_per_e
    if range_e > _MOST_APART * aps.full_well_e:
        yield (
            "aps.full_well_e",
            f"pixels clip at {aps.full_well_e:g} e⁻ of the {range_e:.0f} e⁻ that the ADC reaches: RAW stays below "
            f"{aps.black_level_dn + aps.full_well_e * aps.system_gain_dn_per_e:.0f} of {full_scale} DN",
        )
    elif aps.full_well_e > _MOST_APART * range_e:
        yield (
            "aps.system_gain_dn_per_e",
            f"the ADC clips at {range_e:.0f} e⁻ of a full well of {aps.full_well_e:g} e⁻",
        )
    if aps.read_noise_e > _MOST_NOISE * aps.full_well_e:
        yield "aps.read_noise_e", f"{aps.read_noise_e:g} e⁻ is a large part of the full well, {aps.full_well_e:g} e⁻"
    dark_e = aps.dark_current_now_e_per_s * aps.exposure_us * S_PER_US
    if dark_e > _MOST_DARK * aps.full_well_e:
        yield (
            "aps.dark_current_e_per_s",
            f"dark current alone gives {dark_e:.3g} e⁻ in an exposure, of a full well of {aps.full_well_e:g} e⁻",
        )
    if aps.black_level_dn > _MOST_BLACK * full_scale:
        yield "aps.black_level_dn", f"{aps.black_level_dn:g} DN takes most of the ADC's {full_scale} DN"


def _of_events(evs: EvsSpec) -> Iterator[tuple[str, str]]:
    low, high = _CONTRASTS
    for key in ("contrast_threshold_on", "contrast_threshold_off"):
        theta = getattr(evs, key)
        if not low <= math.expm1(theta) <= high:
            yield (
                f"evs.{key}",
                f"{theta:g} is an event for a contrast of {100 * math.expm1(theta):.3g} %; thresholds are in ln units",
            )
