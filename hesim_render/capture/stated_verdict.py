"""Verdict on a run of the exact mode, from its stated errors alone.

All pixels of the exact mode get the same number of independent rays in every slice, and no value is interpolated, so
half the difference of a value's two halves is distributed as its error. The limit is the audit's: at most `MOST_OFF` of
the values are off by more than `TOLERANCE` wanted errors.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hesim_render.capture.error_meter import ErrorMeter
from hesim_render.sources.render.audit.audit import MOST_OFF, TOLERANCE


def stated_verdict(errors: Mapping[str, ErrorMeter], samples: int, wanted: float) -> dict[str, Any]:
    """The entry ``audit`` of a run in the exact mode, as plain values.

    Parameters
    ----------
    errors : error meters of frames and events.
    samples : rays per pixel and slice.
    wanted : largest error that is good enough, over the sensor's noise.

    Returns
    -------
    The verdict, shares that are off, and where it is not met ``samples_needed``: the next power of two that suffices,
    as the error of independent rays falls with the root of their number.
    """
    limit = TOLERANCE * wanted
    found: dict[str, Any] = {
        "compares_with": "the two halves of each value's own rays; nothing was rendered again",
        "tolerance_noise": limit,
        "off_wanted_at_most": MOST_OFF,
    }
    needed = float(samples)
    for name, meter in errors.items():
        if meter.values:
            found[f"{name}_off"] = meter.share_from(limit)
            needed = max(needed, samples * (meter.quantile(1 - MOST_OFF) / limit) ** 2)
    failed = any(found.get(f"{name}_off", 0.0) > MOST_OFF for name in errors)
    found["verdict"] = "not met" if failed else "met"
    found["samples_needed"] = 1 << int(np.ceil(np.log2(max(needed, samples + 1)))) if failed else None
    return found
