"""The noise-free signal of the scene from all exposures: a rate of light per pixel, DN/s."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from hesim_render.calibrate.aps.dark import DarkModel
from hesim_render.calibrate.aps.variance import variance_map
from hesim_render.calibrate.moments import FrameMoments
from hesim_render.pixels.aps.formulas import ADC_VARIANCE_DN2
from hesim_render.specs.sensor import SensorSpec
from hesim_render.spectral import spectrum as spectra

_CLEAR_SIGMAS = 6.0
#: Relative standard deviation of the frame pixels around an event pixel above which its signal is uncertain.
_UNEVEN = 0.1
#: σ of the Gaussian that interpolates, px; it is widened where no frame pixel is near.
_SIGMA_PX = 1.0
#: Factor of their noise variance by which a few of them may scatter.
_NOISE_MARGIN = 3.0


@dataclass(frozen=True)
class Composite:
    """High-dynamic-range signal of a static scene.

    Attributes
    ----------
    rate_dn_per_s, standard_error_dn_per_s : float32 [row, col]; NaN where no exposure is usable.
    """

    rate_dn_per_s: NDArray[np.float32]
    standard_error_dn_per_s: NDArray[np.float32]


def light_signal(lit: FrameMoments, dark: DarkModel, k: int) -> NDArray[np.float32]:
    """Light above black of exposure k: mean − N_FP − t · N_DP, DN [row, col]."""
    return lit.mean[k] - dark.n_fp - np.float32(lit.exposures_s[k]) * dark.n_dp


def saturation_dn(lit: FrameMoments, signals: NDArray, good: NDArray[np.bool_], full_scale_dn: int) -> float | None:
    """Light signal in DN at which the full well clips below the ADC's full scale, or None where it does not.

    A pixel is over full well if a shorter exposure predicts more than 1.15 times its signal while its value stays below
    full scale. Full well shows as many such pixels at one level.

    Parameters
    ----------
    lit : moments of the lit frames.
    signals : [exposure, row, col], light above black, DN.
    good : [row, col], pixels that are used.
    full_scale_dn : largest value of the ADC, DN.
    """
    t = lit.exposures_s
    levels = []
    for k in range(1, t.size):
        # what a straight response would give after the shorter exposure, and its noise
        predicted = signals[k - 1] * (t[k] / t[k - 1])
        noise = np.sqrt(np.maximum(lit.variance[k - 1], ADC_VARIANCE_DN2) / lit.frames) * (t[k] / t[k - 1])
        over = good & (predicted - 6 * noise > 1.15 * signals[k]) & (lit.highest[k] < full_scale_dn)
        if over.sum() >= max(20, 5e-4 * good.sum()):
            # pixels that fall short all stop at one level where it is a full well, and at many where the light changed
            level = float(np.median(signals[k][over]))
            if np.median(np.abs(signals[k][over] - level)) < 0.05 * level:
                levels.append(level)
    return min(levels) if levels else None


def clear_of_clipping(
    lit: FrameMoments,
    signal: NDArray,
    k: int,
    beta: NDArray | None,
    full_scale_dn: int,
    saturation: float | None,
    row_variance_dn2: float = 0.0,
) -> NDArray[np.bool_]:
    """Pixels [row, col] of exposure k whose values stay clear of 0, full scale and full well.

    With `beta` the margin is 6σ of the fitted variance, which does not depend on the sample variance of the pixel. To
    leave pixels out by their own extremes would bias the variance of the rest.

    Parameters
    ----------
    lit : moments of the frames.
    signal : [row, col], light above black, DN.
    k : number of the exposure.
    beta : [tile_row, tile_col, 6], in DN and s, or None.
    full_scale_dn : largest value of the ADC, DN.
    saturation : light signal at full well, DN, or None.
    row_variance_dn2 : variance of the temporal row noise, DN².
    """
    if beta is None:
        margin = _CLEAR_SIGMAS * np.sqrt(np.maximum(lit.variance[k], ADC_VARIANCE_DN2))
        clear = (lit.highest[k] < full_scale_dn) & (lit.lowest[k] > 0)
    else:
        variance = variance_map(beta, signal, lit.exposures_s[k])
        margin = _CLEAR_SIGMAS * np.sqrt(np.maximum(variance, 0) + ADC_VARIANCE_DN2 + row_variance_dn2)
        clear = (lit.mean[k] + margin < full_scale_dn) & (lit.mean[k] > margin)
    return clear if saturation is None else clear & (signal + margin < saturation)


def compose(lit: FrameMoments, dark: DarkModel, usable: NDArray[np.bool_], beta: NDArray) -> Composite:
    """Weighted least squares of signal = rate · exposure through the usable exposures [exposure, row, col]."""
    top = np.zeros(lit.mean.shape[1:])
    bottom = np.zeros_like(top)
    for k, t in enumerate(lit.exposures_s):
        signal = light_signal(lit, dark, k)
        noise = (np.maximum(variance_map(beta, signal, t), 0) + ADC_VARIANCE_DN2) / lit.frames
        # inverse variance of the mean of the frames, that of the dark level included
        weight = np.where(usable[k], 1 / (noise + dark.mean_variance(t)), 0.0)
        top += weight * signal * t
        bottom += weight * t * t
    with np.errstate(divide="ignore", invalid="ignore"):
        rate = np.where(bottom > 0, top / bottom, np.nan)
        error = np.where(bottom > 0, 1 / np.sqrt(bottom), np.nan)
    return Composite(rate.astype(np.float32), error.astype(np.float32))


def signal_at_event_pixels(
    composite: Composite, sensor: SensorSpec, illuminant: str | None = None
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Composite at the event pixels, on the event grid [y, x], DN/s, and where it is not to be relied on.

    A pixel with both roles is taken as it is; an event-only one is interpolated from frame pixels of its
    own filter by a normalised Gaussian (σ in pixels, widened until it finds any).

    Parameters
    ----------
    illuminant : light on the neutral scene. It tells the response of an event filter that no frame pixel has (the
        white of many sensors) over that of each frame pixel's, which is ∫ light · filter · λ dλ of both.

    Returns
    -------
    The signal, NaN where no frame pixel has the event pixel's filter and the light is not known (what a filter passes
    of an unknown spectrum does not follow from what others do), and whether the frame pixels around that it was taken
    from differ by more than a tenth beyond their noise, as at an edge of the scene.

    Raises
    ------
    SpecError
        If the illuminant is unknown or does not cover the response.
    """
    tile = sensor.tile_rows
    height, width = len(tile), len(tile[0])
    rate_dn_per_s, error = composite.rate_dn_per_s, composite.standard_error_dn_per_s
    grid = sensor.evs_grid
    if grid is None:
        return np.empty((0, 0), np.float32), np.empty((0, 0), bool)
    shape = rate_dn_per_s.shape[0] // height * grid.rows_per_tile, rate_dn_per_s.shape[1] // width * grid.cols_per_tile
    signal, uneven = np.full(shape, np.nan, np.float32), np.zeros(shape, bool)
    values: NDArray
    differ: NDArray
    for k, (i, j) in enumerate(sensor.positions("evs")):
        pixel = sensor.pixels[tile[i][j]]
        if "aps" in pixel.roles:
            values = rate_dn_per_s[i::height, j::width]
            differ = np.zeros(values.shape, bool)
        else:
            # the frame values that tell the signal of this filter, each in its units, on an otherwise empty mosaic
            scaled, noise = np.full((2, *rate_dn_per_s.shape), np.nan)
            for (a, b), ratio in _like_it(sensor, pixel.filter, illuminant).items():
                cut = np.s_[a::height, b::width]
                scaled[cut], noise[cut] = ratio * rate_dn_per_s[cut], ratio * error[cut]
            values, differ = (v[i::height, j::width] for v in _smoothed(scaled, noise, _SIGMA_PX, max(height, width)))
        a, b = divmod(k, grid.cols_per_tile)
        signal[a :: grid.rows_per_tile, b :: grid.cols_per_tile] = values
        uneven[a :: grid.rows_per_tile, b :: grid.cols_per_tile] = differ
    return signal, uneven


def _like_it(sensor: SensorSpec, name: str, illuminant: str | None) -> dict[tuple[int, int], float]:
    """Frame positions from which the signal through filter `name` follows, and the ratio of that signal to theirs."""
    filters = {p: sensor.pixels[sensor.tile_rows[p[0]][p[1]]].filter for p in sensor.positions("aps")}
    same = {p: 1.0 for p, other in filters.items() if other == name}
    if same or illuminant is None:
        return same
    light = spectra.illuminant(illuminant)
    total = {}
    for other in {name, *filters.values()}:
        response = sensor.filter_response(other)
        spectra.require_coverage(light, response, f"illuminant {illuminant!r}", f"filter {other!r}")
        per_watt = spectra.Spectrum(response.wavelength_nm, response.values * response.wavelength_nm)
        # electrons, not energy: λ turns watts into photons
        total[other] = spectra.integrate_product(light, per_watt)
    return {p: total[name] / total[other] for p, other in filters.items()}


def _smoothed(
    values: NDArray, noise: NDArray, sigma_px: float, widest_px: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Normalised Gaussian mean of the finite values, and where they differ by `_UNEVEN` beyond their noise."""
    result, uneven = np.full(values.shape, np.nan), np.zeros(values.shape, bool)
    known = np.isfinite(values)
    filled, noise = np.where(known, values, 0.0), np.where(known, noise, 0.0)
    while sigma_px <= widest_px:

        def blur(image: NDArray, sigma_px: float = sigma_px) -> NDArray:
            return gaussian_filter(image, sigma_px, truncate=3)

        # share of the Gaussian that lies on known values; a wider one follows where there are nearly none
        weight = blur(known.astype(float))
        use = ~np.isfinite(result) & (weight > 1e-3)
        weight = np.maximum(weight, 1e-3)
        mean = blur(filled) / weight
        # variance within the Gaussian beyond that of the noise: an edge of the scene
        excess = blur(filled * filled) / weight - mean * mean - _NOISE_MARGIN * blur(noise * noise) / weight
        result[use], uneven[use] = mean[use], (excess > (_UNEVEN * mean) ** 2)[use]
        sigma_px *= 2
    return result, uneven
