"""High dynamic range from exposures of different lengths, and how flux over many decades is measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hesim_render.measure.pictures import psnr
from hesim_render.mosaic.description import Mosaic
from hesim_render.specs.sensor import ApsSpec

#: Of μ-law tone mapping [kalantari2017].
_MU = 5000.0
#: Values above this part of full scale count as saturated.
_SATURATED = 0.98


def flux_of(
    raw: NDArray, exposure_us: float, aps: ApsSpec, mosaic: Mosaic
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Flux of one exposure with its variance, as the sensor's own figures have them.

    Parameters
    ----------
    raw : [row, col], DN.
    exposure_us : its exposure, µs.
    aps, mosaic : gain and noise; black level and white level.

    Returns
    -------
    Two arrays [row, col]: e⁻/s, and (e⁻/s)²; the variance of a saturated pixel is infinite.
    """
    seconds = exposure_us * 1e-6
    electrons = (raw.astype(np.float64) - mosaic.black_level_dn) / aps.system_gain_dn_per_e
    variance = np.maximum(electrons, 0) + aps.read_noise_e**2 + aps.dark_current_e_per_s * seconds
    top = mosaic.black_level_dn + _SATURATED * (mosaic.white_level_dn - mosaic.black_level_dn)
    return electrons / seconds, np.where(raw >= top, np.inf, np.maximum(variance, 1e-12) / seconds**2)


def merged(exposures: Sequence[tuple[NDArray, NDArray]]) -> NDArray[np.float64]:
    """Mean flux of several exposures, weighted by their inverse variances; without motion it is the best linear one.

    A pixel that is saturated in all of them has the flux of the first, which is to be the shortest.

    Parameters
    ----------
    exposures : flux and variance of each (`flux_of`), the shortest first.

    Returns
    -------
    [row, col], e⁻/s.
    """
    weights = [np.where(np.isfinite(variance), 1 / variance, 0.0) for _, variance in exposures]
    total = np.sum(weights, axis=0)
    mean = np.sum([w * flux for w, (flux, _) in zip(weights, exposures, strict=True)], axis=0)
    return np.where(total > 0, mean / np.where(total > 0, total, 1.0), exposures[0][0])


def flux_scores(flux: NDArray, truth: NDArray, valid: NDArray[np.bool_]) -> dict[str, float]:
    """Measures of flux against the true one.

    Parameters
    ----------
    flux, truth : [row, col], e⁻/s.
    valid : pixels that count.

    Returns
    -------
    ``psnr_mu_db``: PSNR after μ-law tone mapping with μ = 5000 [kalantari2017], 1 at the largest true flux;
    ``psnr_linear_db``; ``log2_rmse``: of pixels whose true flux is above 1/4096 of the largest, in stops.
    """
    white = float(np.max(truth[valid])) if valid.any() else 0.0
    if white <= 0:
        return dict.fromkeys(("psnr_mu_db", "psnr_linear_db", "log2_rmse"), float("nan"))
    a, b = (np.clip(values[valid].astype(np.float64) / white, 0, 1) for values in (flux, truth))
    mu_a, mu_b = (np.log1p(_MU * values) / np.log1p(_MU) for values in (a, b))
    bright = b > 1 / 4096
    stops = np.log2(np.maximum(flux[valid][bright] / white, 1e-6) / b[bright])
    return {
        "psnr_mu_db": psnr(mu_a, mu_b), "psnr_linear_db": psnr(a, b),
        "log2_rmse": float(np.sqrt(np.mean(stops**2))),
    }  # fmt: skip
