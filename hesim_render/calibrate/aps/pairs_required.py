"""Captures of EMVA 1288 that are refused: clipped, saturated, of several colours, or of light that drifts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.aps.light_curve import MeanCurve
from hesim_render.calibrate.aps.long_series import Long
from hesim_render.calibrate.aps.pair_levels import MOST_CHANGE, Levels
from hesim_render.recording.pair_set import PairSet

#: Part of the largest temporal variance below which a brighter series is at the full well.
_WELL_PART = 0.5


def require_dark_noise(pairs: PairSet, dark: Levels, long_dark: Long) -> None:
    """Refuse dark frames that are clipped at 0, or whose series does not differ from frame to frame."""
    for k, entry in enumerate(pairs.dark):
        if dark.low[k] > 0.01:
            raise entry.error(
                f"{100 * dark.low[k]:.3g} % of the dark pixels are 0 DN, which hides a part of the noise; raise the "
                "black level (offset)"
            )
    if long_dark.temporal.pixel <= 0:
        raise pairs.spatial_dark.error("the frames do not differ")


def require_series_below_well(pairs: PairSet, long_lit: Long, lit: Levels, saturation: int) -> None:
    """Refuse a long series at the full well, where the light makes no noise any more and no spread over pixels."""
    if saturation >= lit.mean.size:
        return
    if long_lit.mean.mean() >= lit.mean[saturation] and long_lit.temporal.pixel < _WELL_PART * lit.variance[saturation]:
        raise pairs.spatial_lit.error(
            f"the long series is saturated, at {long_lit.mean.mean():.0f} DN; EMVA 1288 takes it at 50 % of saturation"
        )


def require_steady_light(
    pairs: PairSet, curve: MeanCurve, light: NDArray, signal: NDArray, clear: NDArray[np.bool_]
) -> None:
    """Refuse a level that lies far from the curve of all others: its light was another."""
    expected = curve.at(light)
    deviation = np.where(clear, np.abs(signal / expected - 1), 0.0)
    deviation[signal < 0.02 * signal.max()] = 0.0  # offsets and dark drift weigh more than light there
    k = int(np.argmax(deviation))
    if deviation[k] > MOST_CHANGE:
        raise pairs.lit[k].error(
            f"the light drifts between exposures: this pair is {100 * deviation[k]:.2g} % off the curve of all others"
        )
