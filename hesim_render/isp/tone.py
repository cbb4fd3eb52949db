"""Exposure and tone curves, on linear RGB. Hues are kept, because all channels of a pixel get one factor."""

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.bands import in_bands
from hesim_render.core.errors import RangeError
from hesim_render.isp.denoise import guided_filter

#: Luminance below which a local curve does not brighten further; 1 is white.
_FLOOR = 1e-3


def luminance(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Relative luminance of linear sRGB (ITU-R BT.709 primaries), [row, col]."""
    return np.float32(0.2126) * image[..., 0] + np.float32(0.7152) * image[..., 1] + np.float32(0.0722) * image[..., 2]


def exposure(image: NDArray[np.float32], gain: float) -> NDArray[np.float32]:
    """An image times a factor."""
    if not gain > 0:
        raise RangeError("exposure gain", gain, "more than 0")
    return image if gain == 1 else image * np.float32(gain)


def auto_gain(image: NDArray[np.float32], percentile: float = 99.5, level: float = 0.95) -> float:
    """Factor that brings this percentile of the largest channel of the pixels to `level`; at most 50."""
    brightest = np.percentile(image[::2, ::2].max(axis=-1), percentile)
    return float(level / max(brightest, level / 50))


def tone_global(image: NDArray[np.float32], white: float = 4.0) -> NDArray[np.float32]:
    """A shoulder for highlights: y (1 + y / white²) / (1 + y), which maps `white` to 1 ([reinhard2002], Eq. 4).

    Parameters
    ----------
    image : linear, may exceed 1.
    white : luminance that becomes 1, more than 0.
    """
    if not white > 0:
        raise RangeError("tone white", white, "more than 0")
    return _scaled(image, lambda y: (1 + y * np.float32(1 / white**2)) / (1 + y))


def tone_local(
    image: NDArray[np.float32], compression: float = 0.6, detail: float = 1.0, radius_px: int = 16
) -> NDArray[np.float32]:
    """Reduce large-scale contrast and keep detail ([durand2002], with the guided filter for the base).

    Parameters
    ----------
    image : linear RGB [row, col, 3].
    compression : factor on the log contrast of the base layer; 1 changes nothing.
    detail : factor on the detail layer.
    radius_px : structures larger than this belong to the base, px.
    """
    if not 0 < compression <= 1 or not 0 <= detail <= 4:
        raise RangeError("compression, detail", (compression, detail), "0 to 1 and 0 to 4")
    log = np.log2(np.maximum(luminance(image), np.float32(_FLOOR)))
    base = guided_filter(log, log, radius_px, 0.16)
    change = np.exp2(np.float32(compression - 1) * base + np.float32(detail - 1) * (log - base))
    return image * change[..., None]


def _scaled(image: NDArray[np.float32], factor) -> NDArray[np.float32]:  # noqa: ANN001 - array to array
    out = np.empty((image.shape[2], *image.shape[:2]), dtype=np.float32)

    def work(rows: slice) -> None:
        scale = factor(np.maximum(luminance(image[rows]), 0))
        for channel in range(image.shape[2]):
            np.multiply(image[rows, :, channel], scale, out=out[channel, rows])

    in_bands(image.shape[0], work)
    return np.moveaxis(out, 0, -1)
