"""``calibration.yaml``: reading it, and a sensor file that points at one (``noise: calibration.yaml``)."""

from __future__ import annotations

import contextlib
import hashlib
import math
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
from hesim_render.core.units import S_PER_US
from hesim_render.specs.calibration_spec import SECTIONS, CalibrationSpec
from hesim_render.specs.files import Strict
from hesim_render.specs.geometry import Region
from hesim_render.specs.problems import spec_error
from hesim_render.specs.yamlfile import read_yaml


def read_calibration(file: str | Path) -> dict[str, Any]:
    """A ``calibration.yaml`` as plain dictionaries, lists and numbers, checked by `CalibrationSpec`.

    Raises
    ------
    SpecError
        If it cannot be read, is of another schema, or is not as 'calibrate' writes it; with lines and keys.
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
#: Maps that a sensor takes from each section; thresholds are known only where contrast steps were captured.
SENSOR_MAPS = {
    "aps": ("n_row", "n_blc", "n_dp", *TELEGRAPH_MAPS),
    "evs": ("bad_pixels", "threshold_on_relative", "threshold_off_relative", *DEFECT_MAPS),
}


@contextlib.contextmanager
def as_written(file: str | Path) -> Iterator[None]:
    """Turn what comes of a calibration that lacks a part, or has another in its place, into a `SpecError`."""
    try:
        yield
    except HesimError:
        raise
    except KeyError as error:
        raise SpecError(f"is not as 'calibrate' writes it; it lacks {error}", file=file) from None
    except (TypeError, ValueError, AttributeError, IndexError, OverflowError, ZeroDivisionError) as error:
        raise SpecError(f"is not as 'calibrate' writes it ({reason(error)})", file=file) from None


def map_file(file: Path, data: Mapping[str, Any], section: str) -> Path:
    """The map file of a section, in the calibration's own folder.

    Raises
    ------
    SpecError
        If it is not there, or elsewhere.
    """
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
    """The maps of a section, ``aps`` or ``evs``, of a calibration.

    Parameters
    ----------
    data : what `read_calibration` gave, where it was called before.
    names : which maps, of those that are there; default all.

    Raises
    ------
    SpecError
        If the section or its map file is missing, cannot be read, or is not the one the calibration was written with.
    """
    path = Path(file)
    data = read_calibration(path) if data is None else data
    if section not in data:
        raise SpecError(f"holds no section {section!r}; run 'calibrate {section}'", file=path)
    return _maps_and_digest(path, data, section, names)[0]


def _maps_and_digest(
    file: Path, data: Mapping[str, Any], section: str, names: Iterable[str] | None
) -> tuple[dict[str, NDArray], str]:
    """Maps of a section that is there, and the SHA-256 of their file, which must be the one stated."""
    maps = map_file(file, data, section)
    digest = file_digest(maps)
    if data[section]["maps"].get("sha256", digest) != digest:
        raise SpecError(f"is not the one that {file.name} was written with; run 'calibrate {section}' again", file=maps)
    return read_arrays(maps, only=names, kinds="bifu"), digest


@dataclass(frozen=True)
class MeasuredMaps:
    """What a sensor keeps of its calibration: no file is needed afterwards.

    Attributes
    ----------
    sha256 : of the calibration and its maps; two of one hash are equal.
    file : for errors.
    roi : region that was captured, None for the whole sensor.
    sections : arrays of ``aps`` and ``evs``, as far as they were calibrated, by name.
    """

    sha256: str
    file: Path = field(compare=False)
    roi: Region | None = field(compare=False)
    sections: Mapping[str, Mapping[str, NDArray]] = field(compare=False, repr=False)


class NoiseFile(Strict):
    """The calibration a sensor file points at, and its maps, read once.

    A dump holds the SHA-256 of the calibration and its maps, not its place.
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
        """The maps that a simulation takes from the calibration; the first call reads them.

        Raises
        ------
        SpecError
            If they cannot be read, or are not those that the calibration or `sha256` names.
        """
        if self._measured is None:
            self.keep_maps(self.read())
        assert self._measured is not None
        return self._measured

    def keep_maps(self, data: Mapping[str, Any]) -> None:
        """Read the maps of the calibration `data`, and keep them; raises as `measured`."""
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
    """What of a sensor file is read before the rest of it."""

    noise: NoiseFile


def apply_calibration(sensor: dict[str, Any], noise: NoiseFile) -> dict[str, Any]:
    """Replace a sensor file's own noise by the calibrated one, in place, and return the calibration; the file is valid.

    Frames take K, the black level and the variance polynomial (0 where a term is not identified), and what
    is known of read noise, dark current, DSNU, PRNU and full well; their fixed maps are kept by
    `NoiseFile`. Events take the coefficients of each position, thresholds, mismatch, leak and signal reference.

    Raises
    ------
    SpecError
        If the calibration cannot be read, does not fit the sensor, or lacks a parameter that a simulation needs.
    """
    data = noise.read()
    with as_written(noise.path):
        _apply(sensor, noise, data)
    return data


def _apply(sensor: dict[str, Any], noise: NoiseFile, data: Mapping[str, Any]) -> None:
    changed: dict[str, Any] = {}
    tile = ["".join(line.split()) for line in sensor["tile"].strip().splitlines()]
    shape = len(tile), len(tile[0])
    capture = data["capture"]
    if shape != (capture["tile_rows"], capture["tile_cols"]):
        raise SpecError(
            f"is of a sensor with a tile of {capture['tile_rows']}×{capture['tile_cols']}, not {shape[0]}×{shape[1]}",
            file=noise.path,
        )
    for section, values in (("aps", _aps_values), ("evs", _evs_values)):
        if section not in data:
            continue
        if not isinstance(sensor.get(section), dict):
            raise SpecError(f"holds a section {section!r}, but the sensor has none", file=noise.path)
        for key, value in values(sensor, data, noise.path).items():
            sensor[section][key] = value
            changed[f"{section}.{key}"] = value
    for key in changed:
        for group in ("sources", "assumptions"):
            if isinstance(sensor.get(group), dict):
                sensor[group].pop(key, None)
        sensor.setdefault("sources", {})[key] = f"measured: {noise.file}"


def _aps_values(sensor: Mapping[str, Any], data: Mapping[str, Any], file: Path) -> dict[str, Any]:
    aps, capture = data["aps"], data["capture"]
    if sensor["aps"].get("bit_depth") != capture["bit_depth"]:
        raise SpecError(
            f"is of frames of {capture['bit_depth']} bits, the sensor has {sensor['aps'].get('bit_depth')}", file=file
        )
    values = {
        "system_gain_dn_per_e": _needed(aps["K"], "aps.K", file),
        "black_level_dn": aps["black_dn"],
        "row_offset_std_dn": aps["n_row_std_dn"],
        "row_noise_dn": aps.get("row_noise_dn", {}).get("value") or 0.0,
        "beta": [[[b or 0.0 for b in cell] for cell in row] for row in aps["beta"]],
    }
    if aps["full_well_e"].get("limited_by") == "full well":
        values["full_well_e"] = aps["full_well_e"]["value"]
    for key, name, scale in (
        ("read_noise_e", "read_noise_e", 1.0),
        ("dark_current_e_per_s", "dark_current_e_per_s", 1.0),
        ("dsnu_e", "dsnu_e", 1.0),
        ("prnu_rel", "prnu_percent", 0.01),
    ):
        if aps[name]["value"] is not None:
            values[key] = max(0.0, scale * aps[name]["value"])
    return values


def _evs_values(sensor: Mapping[str, Any], data: Mapping[str, Any], file: Path) -> dict[str, Any]:
    """In the gauge of the calibration, β2 = 1 V; θ is the file's own where the calibration could not tell it."""
    evs, own, capture = data["evs"], sensor["evs"], data["capture"]
    if own.get("reference") != "previous_sample":
        raise SpecError("its events are of fixed comparisons; the sensor needs reference 'previous_sample'", file=file)
    theta_v = evs["theta_hardware_v"]
    theta_v = 1.0 if isinstance(theta_v, Mapping) else float(theta_v)
    measured = evs["theta"]["value"] is not None
    theta = evs["theta"]["value"] if measured else (own["contrast_threshold_on"] + own["contrast_threshold_off"]) / 2
    rho = _asymmetry(evs)
    grid = sensor.get("evs_grid") or {}
    if len(evs["positions"]) != grid.get("rows_per_tile", 0) * grid.get("cols_per_tile", 0):
        raise SpecError(f"has {len(evs['positions'])} event positions, not as many as the sensor", file=file)
    pooled = [_needed(evs[name], f"evs.{name}", file) for name in "AB"] + [evs[name]["value"] or 0.0 for name in "CD"]
    coefficients = []
    for position in evs["positions"]:
        found = [position[name]["value"] for name in "ABCD"]
        a, b, c, d = pooled if any(value is None for value in found) else found
        beta4 = theta / theta_v / b
        coefficients.append({"beta1": a / b, "beta2": 1.0, "beta3": c * beta4, "beta4": beta4, "beta5": d})
    values = {
        "contrast_threshold_on": theta * (1 - rho),
        "contrast_threshold_off": theta * (1 + rho),
        "threshold_mismatch_std": evs["threshold_mismatch"]["value"] or 0.0,
        "coefficients": coefficients,
        "shot_law": evs["shot_law"],
        "leak_rate_hz": -math.log1p(-max(0.0, evs["leak_per_trial"]["value"] or 0.0)) / (own["tick_us"] * S_PER_US),
    }
    if not isinstance(evs["theta_hardware_v"], Mapping):
        values["threshold_hardware_v"] = theta_v
    if "signal_reference" in capture:
        reference = capture["signal_reference"]
        values["signal_reference"] = {
            "k_dn_per_e": reference["k"], "t_ref_us": reference["t_ref_us"], "filter": reference["filter"]
        }  # fmt: skip
    return values


def _asymmetry(evs: Mapping[str, Any]) -> float:
    """(θ₋ − θ₊)/(θ₋ + θ₊), from the static counts or from the steps, whichever is better known."""
    static, on, off = evs["asymmetry"], evs["theta_on"], evs["theta_off"]
    if on["value"] is None or off["value"] is None:
        return float(static["value"] or 0.0)
    total = on["value"] + off["value"]
    error = 2 * math.hypot(on["value"] * off["standard_error"], off["value"] * on["standard_error"]) / total**2
    if static["value"] is not None and static.get("standard_error", math.inf) < error:
        return float(static["value"])
    return (off["value"] - on["value"]) / total


def _needed(item: Mapping[str, Any], key: str, file: Path) -> float:
    if item["value"] is None:
        raise SpecError(
            f"not identifiable, so that nothing can be simulated with it: {item['reason']}", file=file, key=key
        )
    return float(item["value"])
