"""Edge-preserving smoothing: the guided filter, and a noise reduction based on it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import RangeError
from hesim_render.spectral.transfer import from_root, to_root


def guided_filter(
    image: NDArray[np.float32], guide: NDArray[np.float32], radius_px: int, epsilon: float
) -> NDArray[np.float32]:
    """An image as a local linear function of a guide ([he2013], Eqs. 5-8), in boxes of 2·radius + 1.

    Parameters
    ----------
    image, guide : [row, col].
    radius_px : radius of the boxes, px.
    epsilon : variance of the guide below which it counts as flat.
    """
    from scipy.ndimage import uniform_filter

    def mean(values: NDArray) -> NDArray:
        return uniform_filter(values, 2 * radius_px + 1, mode="nearest")

    if radius_px < 1 or not epsilon > 0:
        raise RangeError("radius_px, epsilon", (radius_px, epsilon), "at least 1, more than 0")
    # subtract the mean first, so that float32 differences of squares keep their digits
    centre = np.float32(guide.mean())
    guide = guide - centre
    mean_guide, mean_image = mean(guide), mean(image)
    slope = (mean(guide * image) - mean_guide * mean_image) / (
        np.maximum(mean(guide * guide) - mean_guide * mean_guide, 0) + np.float32(epsilon)
    )
    return mean(slope) * guide + mean(mean_image - slope * mean_guide)


def reduce_noise(
    image: NDArray[np.float32], luma: float = 0.005, chroma: float = 0.02, radius_px: int = 3
) -> NDArray[np.float32]:
    """Balanced linear channels with less noise: brightness is smoothed little, colour differences more.

    The filter works on square roots. Brightness is filtered with itself as guide, differences to it with brightness.

    Parameters
    ----------
    image : [row, col, channel].
    luma, chroma : standard deviation that counts as noise, in square roots of white; 0 leaves the part unchanged.
    radius_px : radius of the filter, px.
    """
    if min(luma, chroma) < 0:
        raise RangeError("luma, chroma", (luma, chroma), "0 or more")
    root = to_root(image)
    brightness = root.mean(axis=-1)
    clean = guided_filter(brightness, brightness, radius_px, luma**2) if luma > 0 else brightness
    out = np.empty((image.shape[2], *image.shape[:2]), dtype=np.float32)
    for channel in range(image.shape[2]):
        difference = root[..., channel] - brightness
        if chroma > 0 and image.shape[2] > 1:
            difference = guided_filter(difference, clean, 2 * radius_px, chroma**2)
        out[channel] = from_root(clean + difference)
    return np.moveaxis(out, 0, -1)
