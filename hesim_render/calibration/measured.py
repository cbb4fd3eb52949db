"""The maps that a sensor takes from the calibration that its file names."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from numpy.typing import NDArray

from hesim_render.calibration.file import load_calibration, maps_and_digest
from hesim_render.calibration.rates import COUNTED, RATES, needs_interval
from hesim_render.calibration.spec import AsynchronousSection, CalibrationSpec, EventSection, FrameSection
from hesim_render.core.errors import SpecError
from hesim_render.core.guard import WholeFile
from hesim_render.core.units import S_PER_US
from hesim_render.specs.geometry import Region
from hesim_render.specs.sensor import NoiseFile

#: Maps that a sensor takes from each section; thresholds are known only where contrast steps were captured.
SENSOR_MAPS = {
    section: tuple(dict.fromkeys((*names, *RATES[section].names(), *COUNTED[section].names())))
    for section, names in (
        ("aps", ("n_row", "n_blc", "n_dp", "response")),
        ("evs", ("bad_pixels", "threshold_on_rel", "threshold_off_rel")),
    )
}


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


def read_named(noise: NoiseFile) -> CalibrationSpec:
    """The calibration that a sensor file names.

    Raises
    ------
    SpecError
        If it cannot be read, or holds no section.
    """
    data = load_calibration(noise.path)
    if not data.sections:
        raise SpecError("holds neither a section 'aps' nor 'evs'", file=noise.path)
    return data


def measured_maps(noise: NoiseFile, data: CalibrationSpec | None = None) -> MeasuredMaps:
    """Read the maps of the calibration that a sensor file names.

    Parameters
    ----------
    noise : how the sensor file names it.
    data : its content, if it was read before.

    Raises
    ------
    SpecError
        If they cannot be read, are not those of `noise.sha256`, or hold values per interval that nobody stated.
    """
    data = read_named(noise) if data is None else data
    digest = hashlib.sha256(bytes.fromhex(WholeFile(noise.path).sha256()))
    sections: dict[str, dict[str, NDArray]] = {}
    intervals_s: dict[str, float | None] = {}
    for name, section in data.sections.items():
        sections[name], own = maps_and_digest(noise.path, section.maps, name, SENSOR_MAPS[name])
        digest.update(bytes.fromhex(own))
        intervals_s[name] = section.interval_s or _stated_s(noise, name)
        if needs_interval(name, sections[name]):
            interval_s(noise, name, section)
    if noise.sha256 not in (None, digest.hexdigest()):
        raise SpecError("it, or a map of it, is not the one this sensor was written with", file=noise.path)
    return MeasuredMaps(digest.hexdigest(), noise.path, data.capture.roi, sections, intervals_s)


def interval_s(noise: NoiseFile, name: str, section: FrameSection | EventSection | AsynchronousSection) -> float:
    """From one frame (comparison) of the captures to the next, s: that of the calibration, else of the sensor file.

    Raises
    ------
    SpecError
        If neither states it.
    """
    result = section.interval_s or _stated_s(noise, name)
    if result is None:
        key = "frame_rate_hz" if name == "aps" else "tick_us"
        text = "is not stated, and values per frame or comparison tell no rate per second without it"
        raise SpecError(f"{text}; add that of the captures", file=noise.path, key=f"{name}.{key}")
    return result


def _stated_s(noise: NoiseFile, name: str) -> float | None:
    if name == "aps":
        return None if noise.frame_rate_hz is None else 1.0 / noise.frame_rate_hz
    return None if noise.tick_us is None else noise.tick_us * S_PER_US
