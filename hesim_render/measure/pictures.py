"""Measures of pictures against a truth. Range, window and border of each are stated."""

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import RangeError
from hesim_render.isp.colour import delta_e_2000

#: Window and constants of SSIM [wang2004].
_SIGMA, _TRUNCATE, _K1, _K2 = 1.5, 3.5, 0.01, 0.03


def psnr(picture: NDArray, truth: NDArray, peak: float = 1.0, valid: NDArray[np.bool_] | None = None) -> float:
    """Peak signal-to-noise ratio, dB: 10 log₁₀(peak² / MSE), one MSE over all pixels and channels, no border cut.

    Parameters
    ----------
    picture, truth : of the same shape; both are clipped at the peak, and not at black: noise below it counts.
    peak : largest value.
    valid : pixels that count; default all.

    Returns
    -------
    dB; infinite for equal pictures.
    """
    a, b = below_peak(picture, truth, peak)
    if valid is not None and not np.any(valid):
        raise RangeError("valid", 0, "at least one pixel that counts")
    square = (a - b) ** 2
    mse = float(square.mean() if valid is None else square[valid].mean())
    return float("inf") if mse == 0 else 10 * float(np.log10(peak**2 / mse))


def ssim(picture: NDArray, truth: NDArray) -> float:
    """Structural similarity [wang2004]: Gaussian window of σ 1.5 px (11×11), K₁ 0.01, K₂ 0.03, mean over channels.

    The border of 5 px, where the window leaves the picture, does not count. This is skimage's `structural_similarity`
    with ``gaussian_weights=True, use_sample_covariance=False``; EFNet's own measure uses a three-dimensional window.

    Parameters
    ----------
    picture, truth : [row, col] or [row, col, channel], at least 11 px on each side; clipped at 1.
    """
    from scipy.ndimage import gaussian_filter

    a, b = below_peak(picture, truth, 1.0)
    if min(a.shape[:2]) < 11:
        raise RangeError("shape of the picture", a.shape, "11 px or more on each side, the window of SSIM")
    if a.ndim == 2:
        a, b = a[..., None], b[..., None]

    def smooth(values: NDArray) -> NDArray:
        return gaussian_filter(values, _SIGMA, truncate=_TRUNCATE, axes=(0, 1))

    mean_a, mean_b = smooth(a), smooth(b)
    var_a, var_b = smooth(a * a) - mean_a**2, smooth(b * b) - mean_b**2
    both = smooth(a * b) - mean_a * mean_b
    c1, c2 = _K1**2, _K2**2
    index = (2 * mean_a * mean_b + c1) * (2 * both + c2) / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))
    return float(index[5:-5, 5:-5].mean(dtype=np.float64))


def delta_e(picture: NDArray, truth: NDArray) -> float:
    """Mean CIEDE2000 colour difference [sharma2005].

    Parameters
    ----------
    picture, truth : [row, col, 3], linear sRGB; clipped at white, 1, and not at black.
    """
    a, b = below_peak(picture, truth, 1.0)
    return float(np.mean(delta_e_2000(a.reshape(-1, 3), b.reshape(-1, 3))))


def below_peak(picture: NDArray, truth: NDArray, peak: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Two pictures of one shape, clipped at the peak, where sensors saturate; noise below black stays."""
    if np.shape(picture) != np.shape(truth):
        raise RangeError("shape of the picture", np.shape(picture), f"that of the truth, {np.shape(truth)}")
    a, b = (np.minimum(np.asarray(image, dtype=np.float64), peak) for image in (picture, truth))
    return a, b
