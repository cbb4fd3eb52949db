"""Captures of EMVA 1288 that are refused: clipped, saturated, of several colours, or of light that drifts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.aps.light_curve import MeanCurve
from hesim_render.calibrate.aps.long_series import Long
from hesim_render.calibrate.aps.pair_levels import MOST_CHANGE, Levels
from hesim_render.recording.pair_set import PairSet

#: Relative differences of the places of a tile from which they are colours.
_MOSAIC = 0.08
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


def require_one_colour(pairs: PairSet, signal: NDArray) -> None:
    """Refuse frames whose places of a 2x2 tile have signals of their own, far apart beside the pixels' spread."""
    rows, cols = (count - count % 2 for count in signal.shape)
    # the four places of a tile, [place, pixel]
    places = signal[:rows, :cols].reshape(rows // 2, 2, cols // 2, 2).transpose(1, 3, 0, 2).reshape(4, -1)
    middle = np.median(places, axis=1)
    spread = np.median(np.abs(places - middle[:, None])) / 0.6745
    if np.ptp(middle) > max(_MOSAIC * middle.mean(), 3 * spread):
        shares = ", ".join(f"{100 * value / middle.max():.0f}" for value in middle)
        raise pairs.spatial_lit.error(
            f"the places of a 2x2 tile have {shares} % of the largest signal: a colour mosaic. EMVA 1288 evaluates one "
            "colour at a time; state tile_rows: 2, tile_cols: 2 and tile_position: [row, column] in capture.yaml"
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
