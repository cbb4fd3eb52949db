"""Transfer functions between linear light and picture values, both ways."""

import functools
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.bands import in_bands
from hesim_render.core.errors import RangeError
from hesim_render.spectral.spectrum import colour_science

Transfer = Literal["srgb", "bt709", "gamma", "linear"]
#: Transfers of input pictures, including those of high dynamic range.
InputTransfer = Literal["srgb", "bt709", "gamma", "linear", "pq", "hlg"]
#: Steps that use square roots (`to_root`) add this first, in units of white.
_ROOT_TOE = 0.01
#: Constants of BT.709 to the digits of ITU-T H.273, with which the two branches of the curve meet. (colour-science
#: has them rounded, which is 0.3 % off near the knee; its sRGB is the one below, but costs its import of 1.5 s.)
_BT709_ALPHA, _BT709_BETA = 1.099296826809442, 0.018053968510807
#: Luminance and HLG signal that count as white, 1, in high dynamic range (ITU-R BT.2408).
_PQ_WHITE_CD_PER_M2, _HLG_WHITE = 203, 0.75
Depth = Literal["float", 8, 16]


def decode(values: ArrayLike, transfer: InputTransfer = "srgb", gamma: float = 2.2) -> NDArray[np.float64]:
    """Linear light of picture values in [0, 1]; float64, any shape.

    Parameters
    ----------
    transfer : ``srgb`` (IEC 61966-2-1), ``bt709`` (ITU-R BT.709, the camera's curve), ``gamma``, ``linear``,
        ``pq`` and ``hlg`` (ITU-R BT.2100; the display's light and the scene's, 1 being 203 cd/m² and 75 % signal).
    gamma : exponent of ``gamma``.
    """
    x = np.asarray(values, dtype=np.float64)
    if transfer == "srgb":
        return np.where(x <= 0.04045, x / 12.92, (np.maximum(x, 0.04045) / 1.055 + 0.055 / 1.055) ** 2.4)
    if transfer == "bt709":
        knee = 4.5 * _BT709_BETA
        return np.where(x < knee, x / 4.5, ((np.maximum(x, knee) + _BT709_ALPHA - 1) / _BT709_ALPHA) ** (1 / 0.45))
    if transfer == "gamma":
        return np.maximum(x, 0) ** gamma
    if transfer == "linear":
        return x
    if transfer == "pq":
        return colour_science().models.eotf_ST2084(np.maximum(x, 0)) / _PQ_WHITE_CD_PER_M2
    if transfer == "hlg":
        scene_light = colour_science().models.oetf_inverse_BT2100_HLG
        return scene_light(np.maximum(x, 0)) / scene_light(_HLG_WHITE)
    raise RangeError("transfer", transfer, f"one of {', '.join(get_args(InputTransfer))}")


def encode_exactly(linear: ArrayLike, transfer: Transfer = "srgb", gamma: float = 2.2) -> NDArray[np.float64]:
    """Picture values of linear light, the inverse of `decode`; not clipped, float64, any shape."""
    x = np.asarray(linear, dtype=np.float64)
    if transfer == "srgb":
        return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055)
    if transfer == "bt709":
        return np.where(
            x < _BT709_BETA, 4.5 * x, _BT709_ALPHA * np.maximum(x, _BT709_BETA) ** 0.45 - (_BT709_ALPHA - 1)
        )
    if transfer == "gamma":
        return np.maximum(x, 0) ** (1 / gamma)
    if transfer == "linear":
        return x
    raise RangeError("transfer", transfer, "srgb, bt709, gamma or linear")


def to_root(linear: NDArray[np.float32]) -> NDArray[np.float32]:
    """Square roots of linear light, in which shot noise is uniform: √(x + t) − √t with a small t, odd about black.

    Read noise below black is kept, and that of a dark frame has the mean 0 here as well.
    """
    root = np.abs(linear)
    root += np.float32(_ROOT_TOE)
    np.sqrt(root, out=root)
    root -= np.float32(np.sqrt(_ROOT_TOE))
    return np.copysign(root, linear, out=root)


def from_root(root: NDArray[np.float32]) -> NDArray[np.float32]:
    """Linear light, the inverse of `to_root`."""
    linear = np.abs(root)
    linear += np.float32(np.sqrt(_ROOT_TOE))
    np.square(linear, out=linear)
    linear -= np.float32(_ROOT_TOE)
    return np.copysign(linear, root, out=linear)


@functools.lru_cache(maxsize=8)
def _table(transfer: Transfer, gamma: float) -> NDArray[np.uint8]:
    """8-bit code of each of 65536 linear levels: at most 0.05 of a code off even at the foot of sRGB."""
    return np.rint(255 * encode_exactly(np.linspace(0, 1, 1 << 16), transfer, gamma)).astype(np.uint8)


def encode(
    image: NDArray[np.float32], transfer: Transfer = "srgb", gamma: float = 2.2, depth: Depth = "float"
) -> NDArray:
    """A picture [row, col, 3] in picture values, clipped to [0, 1].

    Parameters
    ----------
    image : linear light, 1 is white.
    depth : ``float`` gives float32 in [0, 1]; 8 and 16 give uint8 and uint16.
    """
    out = np.empty(image.shape, dtype={"float": np.float32, 8: np.uint8, 16: np.uint16}[depth])
    table = _table(transfer, gamma) if depth == 8 else None

    def work(rows: slice) -> None:
        for channel in range(image.shape[2]):
            band = np.clip(image[rows, :, channel], 0, 1)
            if table is not None:
                band *= np.float32(65535)
                band += np.float32(0.5)
                out[rows, :, channel] = table[band.astype(np.uint16)]
                continue
            value = encode_exactly(band, transfer, gamma)
            out[rows, :, channel] = value if depth == "float" else np.rint(65535 * value)

    in_bands(image.shape[0], work)
    return out
