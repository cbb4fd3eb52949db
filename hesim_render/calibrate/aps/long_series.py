"""The two long series of EMVA 1288 captures: their mean, temporal and spatial variances."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.aps.noise_spectrum import NoiseSpectrum, noise_spectrum
from hesim_render.calibrate.aps.pair_levels import CLIPPED_SHARE, MOST_CHANGE, Levels, SpatialStack
from hesim_render.calibrate.aps.spatial import SpatialVariance, Temporal, spatial_variance, temporal_of
from hesim_render.calibrate.moments import FrameMoments, Progress, measure
from hesim_render.recording.pair_set import PairSet

#: Part of the pixels at full scale in the dark that are taken for defects; more are a dark series that is lit.
_MOST_STUCK = 0.01
#: Part of the largest temporal variance below which a brighter series is at the full well.
_WELL_PART = 0.5


@dataclass(frozen=True)
class Long:
    """One long series: mean of its frames, temporal variances and spatial ones.

    Attributes
    ----------
    mean : [row, col], DN.
    variance : float32 [row, col], temporal, DN².
    first : the first frame.
    frames : number of frames.
    levels : [frame], mean of each frame, DN.
    spectrum : of the temporal noise; None in the light.
    """

    mean: NDArray[np.float64]
    variance: NDArray[np.float32]
    first: NDArray[np.uint16]
    frames: int
    levels: NDArray[np.float64]
    temporal: Temporal
    spatial: SpatialVariance
    spectrum: NoiseSpectrum | None


def long_series(pairs: PairSet, progress: Progress | None) -> tuple[Long, Long]:
    """Read and check the long series of a set: dark and lit."""
    dark, white = _read(pairs, False, progress, None)
    lit, _ = _read(pairs, True, progress, white)
    return dark, lit


def stuck_pixels(full_scale_dn: int, dark: Long, lit: Long) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Pixels at full scale in the dark, and those at 0 in the light."""
    return np.asarray(dark.mean >= full_scale_dn - 0.5), np.asarray(lit.mean <= 0.5)


def _read(
    pairs: PairSet, is_lit: bool, progress: Progress | None, stuck: NDArray[np.bool_] | None
) -> tuple[Long, NDArray[np.bool_]]:
    """One series, and its pixels at full scale; in the light, those that are so in the dark do not count."""
    series = pairs.spatial_lit if is_lit else pairs.spatial_dark
    used = np.ones(pairs.shape, bool)
    full = pairs.spec.full_scale_dn
    stack = SpatialStack(pairs, series, progress)
    moments = measure(stack, used, full)
    mean = moments.mean[0].astype(np.float64)
    white = np.asarray(mean >= full - 0.5)
    light = np.ones(pairs.shape, bool) if stuck is None else ~stuck
    clipped = float(np.mean((moments.highest[0] >= full) & light))
    most = CLIPPED_SHARE if is_lit else _MOST_STUCK
    if clipped > most and float(np.mean(white & light)) > most:
        raise series.error(
            f"{100 * clipped:.3g} % of the pixels of the long series are saturated; EMVA 1288 takes it at 50 % of "
            "saturation"
        )
    levels = moments.row_means[0].mean(axis=1)
    if is_lit and np.ptp(levels) > MOST_CHANGE * mean.mean():
        raise series.error(
            f"the light drifts: the frames of the long series differ by {100 * np.ptp(levels) / mean.mean():.2g} %; "
            "warm the light up and keep it steady"
        )
    return long_of(moments, None if is_lit else noise_spectrum(stack, mean)), white


def long_of(moments: FrameMoments, spectrum: NoiseSpectrum | None) -> Long:
    """A long series from the moments of its frames."""
    mean = moments.mean[0].astype(np.float64)
    temporal, levels = temporal_of(moments)
    spatial = spatial_variance(mean, temporal, moments.frames, moments.variance[0])
    return Long(mean, moments.variance[0], moments.first[0], moments.frames, levels, temporal, spatial, spectrum)


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
