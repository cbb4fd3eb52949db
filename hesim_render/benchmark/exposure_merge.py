"""High dynamic range from exposures of different lengths, and how flux over many decades is measured."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hesim_render.measure.pictures import psnr
from hesim_render.mosaic.description import Mosaic
from hesim_render.specs.frame_pixels import ApsSpec

#: Of μ-law tone mapping [kalantari2017].
_MU = 5000.0
#: Values above this part of full scale count as saturated.
_SATURATED = 0.98


class ExposureFlux(NamedTuple):
    """One exposure as flux.

    Parameters
    ----------
    flux : [row, col], e⁻/s; below 0 where noise is.
    dark_variance : [row, col], (e⁻/s)² without light; infinite where the pixel is saturated.
    seconds : length, s.
    """

    flux: NDArray[np.float64]
    dark_variance: NDArray[np.float64]
    seconds: float


def flux_of(raw: NDArray, exposure_us: float, aps: ApsSpec, mosaic: Mosaic) -> ExposureFlux:
    """Flux of one exposure with the variance that it has in the dark, as the sensor's own figures have them.

    Parameters
    ----------
    raw : [row, col], DN.
    exposure_us : its exposure, µs.
    aps, mosaic : gain and noise; black level and white level.
    """
    seconds = exposure_us * 1e-6
    dark_e = aps.dark_current_now_e_per_s * seconds
    electrons = (raw.astype(np.float64) - mosaic.black_level_dn) / aps.system_gain_dn_per_e - dark_e
    variance = max(aps.read_noise_e**2 + dark_e, 1e-12)
    top = mosaic.black_level_dn + _SATURATED * (mosaic.white_level_dn - mosaic.black_level_dn)
    return ExposureFlux(electrons / seconds, np.where(raw >= top, np.inf, variance / seconds**2), seconds)


def merged_exposures(exposures: Sequence[ExposureFlux]) -> NDArray[np.float64]:
    """Mean flux of several exposures, weighted by their inverse variances; without motion it is the best linear one.

    The variance of all has the shot noise of one flux, their mean weighted by the dark variances. With the noisy flux
    of each, those that are too low by chance would weigh more, and the mean of a dark scene would be below black. A
    pixel that is saturated in all exposures has the flux of the first, which is to be the shortest.

    Parameters
    ----------
    exposures : the shortest first (`flux_of`).

    Returns
    -------
    [row, col], e⁻/s.
    """
    first = _weighted(exposures, [each.dark_variance for each in exposures])
    light = np.maximum(first, 0)
    return _weighted(exposures, [each.dark_variance + light / each.seconds for each in exposures])


def _weighted(exposures: Sequence[ExposureFlux], variances: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    weights = [1 / variance for variance in variances]
    total = np.sum(weights, axis=0)
    mean = np.sum([w * each.flux for w, each in zip(weights, exposures, strict=True)], axis=0)
    return np.where(total > 0, mean / np.where(total > 0, total, 1.0), exposures[0].flux)


def flux_scores(flux: NDArray, truth: NDArray, valid: NDArray[np.bool_]) -> dict[str, float]:
    """Measures of flux against the true one.

    Parameters
    ----------
    flux, truth : [row, col], e⁻/s.
    valid : pixels that count.

    Returns
    -------
    ``psnr_mu_db``: PSNR after μ-law tone mapping with μ = 5000 [kalantari2017], odd about black, 1 at the largest true
    flux; ``psnr_linear_db``; ``log2_rmse``: of pixels whose true flux is above 1/4096 of the largest, in stops, where a
    flux at or below black counts as 1e-6 of the largest.
    """
    white = float(np.max(truth[valid])) if valid.any() else 0.0
    if white <= 0:
        return dict.fromkeys(("psnr_mu_db", "psnr_linear_db", "log2_rmse"), float("nan"))
    a, b = (np.minimum(values[valid].astype(np.float64) / white, 1) for values in (flux, truth))
    mu_a, mu_b = (np.copysign(np.log1p(_MU * np.abs(values)), values) / np.log1p(_MU) for values in (a, b))
    bright = b > 1 / 4096
    stops = np.log2(np.maximum(flux[valid][bright] / white, 1e-6) / b[bright])
    return {
        "psnr_mu_db": psnr(mu_a, mu_b), "psnr_linear_db": psnr(a, b),
        "log2_rmse": float(np.sqrt(np.mean(stops**2))),
    }  # fmt: skip
