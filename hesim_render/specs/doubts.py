"""Values of a sensor file that can be simulated, but that no sensor has: probably a wrong unit or a missing digit."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

from hesim_render.core.units import S_PER_US

if TYPE_CHECKING:
    from hesim_render.specs.frame_pixels import ApsSpec
from hesim_render.specs.event_pixels import EvsSpec
from hesim_render.specs.sensor import SensorSpec

#: Shortest exposure that is not doubted, µs: shutters of cameras take about 10 µs at least.
_SHORTEST_US = 10
#: Ratio of the ADC's range to the full well, either way, from which one of them is doubted.
_MOST_APART = 10.0
#: Parts of the full well above which read noise and dark current are doubted, and of the ADC's range for the black.
_MOST_NOISE, _MOST_DARK, _MOST_BLACK = 0.1, 0.5, 0.5
#: Contrasts of thresholds that are not doubted.
_CONTRASTS = (0.01, 10.0)


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
