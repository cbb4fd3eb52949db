"""A sensor file that goes with a calibration from EMVA 1288 captures."""

import os
from pathlib import Path

from hesim_render.calibrate.aps.pair_levels import WELL_SHARE
from hesim_render.calibrate.aps.pairs import PairCalibration
from hesim_render.core.output import write_whole

_TEXT = """\
# Written by `hesim-render calibrate` with {calibration}, whose noise replaces the figures of `aps` below. What the
# captures do not tell is a placeholder, under `assumptions`. docs/sensors.md has all keys.
schema_version: 1
name: {name}
description: "{cols}x{rows} px, {bits} bit, monochrome, from captures of EMVA 1288"
device_seed: 1
geometry: {{rows: {rows}, cols: {cols}, pitch_um: 5.0}}
tile: |
  m
pixels:
  m: {{filter: clear, roles: [aps]}}
filters:
  clear: {{wavelength_nm: [380, 400, 420, 650, 690, 720], value: [0.0, 0.5, 1.0, 1.0, 0.5, 0.0]}}
quantum_efficiency: {efficiency:.5g}
lens:
  f_number: 2.0
  focal_length_mm: 8.0
noise: {calibration}
aps:
  full_well_e: {full_well:.6g}
  system_gain_dn_per_e: {gain:.6g}
  bit_depth: {bits}
  black_level_dn: {black:.6g}
  read_noise_e: {read_noise:.6g}
  dark_current_e_per_s: {dark_current:.6g}
  law: poisson
  exposure_us: {exposure_us}
  frame_rate_hz: {rate:.6g}
  shutter: global
sources:
  quantum_efficiency: "{efficiency_source}"
  aps: "measured: {calibration}"
assumptions:
  geometry.pitch_um: not known from the captures; a placeholder
  filters: the captures tell the efficiency at their own wavelength alone; clear between ultraviolet and infrared
  lens: user's choice; a placeholder
  aps.full_well_e: "{well_note}"
  aps.exposure_us: that of the long series
  aps.frame_rate_hz: not known from the captures
  aps.shutter: not known from the captures
"""


def write_sensor(file: str | Path, calibration: str | Path, result: PairCalibration) -> Path:
    """Write a sensor file whose noise is that of a calibration.

    Parameters
    ----------
    file : to write, replaced if it exists.
    calibration : the calibration, which it names by its path from `file`.
    result : of the captures.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    path = Path(file)
    k, spec = result.gain.slope, result.pairs.spec
    limited = bool(result.saturation < result.signal.size and result.lit.high[result.saturation :].max() <= WELL_SHARE)
    well = result.brightest_dn / k if limited else 1.25 * spec.full_scale_dn / k
    has_photons = result.pairs.has_photons
    exposure_us = max(1, round(1e6 * result.pairs.spatial_lit.exposure_s))
    text = _TEXT.format(
        calibration=os.path.relpath(Path(calibration).absolute(), path.absolute().parent), name=path.stem,
        rows=result.pairs.shape[0], cols=result.pairs.shape[1], bits=spec.bit_depth,
        efficiency=min(1.0, result.responsivity.slope / k) if has_photons else 0.5,
        efficiency_source="measured, at the wavelength of the captures" if has_photons else
        "placeholder: the captures do not state photons per pixel",
        full_well=well, gain=k, black=result.black.value,
        read_noise=max(result.noise.value - 1 / 12, 0.0) ** 0.5 / k, dark_current=max(result.black.slope / k, 0.0),
        exposure_us=exposure_us, rate=min(30.0, 0.5e6 / exposure_us),
        well_note="largest signal of the captures" if limited else
        "not seen in the captures, which the ADC limits; a quarter above full scale",
    )  # fmt: skip
    write_whole(path, text)
    return path
