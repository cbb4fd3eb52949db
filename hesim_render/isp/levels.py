"""From DN to light: black level and lens shading."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.bands import in_bands
from hesim_render.core.errors import RangeError


def black_level(
    raw: NDArray,
    black_level_dn: float,
    white_level_dn: float,
    row_map_dn: ArrayLike | None = None,
    pixel_map_dn: ArrayLike | None = None,
) -> NDArray[np.float32]:
    """RAW data with black at 0 and saturation at 1, float32 [row, col].

    Parameters
    ----------
    raw : [row, col], DN.
    black_level_dn, white_level_dn : levels of black and of saturation, DN.
    row_map_dn, pixel_map_dn : [row] and [row, col], offsets of rows and of pixels from the black level, DN.
    """
    span = white_level_dn - black_level_dn
    if span <= 0:
        raise RangeError("white_level_dn", white_level_dn, f"more than black_level_dn, {black_level_dn:g}")
    rows_dn = None if row_map_dn is None else _fitting("row_map_dn", row_map_dn, (raw.shape[0],))[:, None]
    pixels_dn = None if pixel_map_dn is None else _fitting("pixel_map_dn", pixel_map_dn, raw.shape)
    out = np.empty(raw.shape, dtype=np.float32)

    def work(part: slice) -> None:
        np.subtract(raw[part], np.float32(black_level_dn), out=out[part], dtype=np.float32)
        for offsets in (rows_dn, pixels_dn):
            if offsets is not None:
                out[part] -= offsets[part]
        out[part] *= np.float32(1 / span)

    in_bands(raw.shape[0], work)
    return out


def cos4_illumination(
    shape: tuple[int, int], focal_length_px: float, centre_px: tuple[float, float] | None = None
) -> NDArray[np.float32]:
    """Relative illumination cos⁴ of the chief ray's angle, [row, col].

    Parameters
    ----------
    shape : rows and columns.
    focal_length_px : image distance over pixel pitch.
    centre_px : optical axis (row, col), pixel centres at whole numbers; default the centre of the image.
    """
    if focal_length_px <= 0:
        raise RangeError("focal_length_px", focal_length_px, "more than 0")
    row0, col0 = centre_px or ((shape[0] - 1) / 2, (shape[1] - 1) / 2)
    y, x = np.ogrid[: shape[0], : shape[1]]
    return ((1 + ((y - row0) ** 2 + (x - col0) ** 2) / focal_length_px**2) ** -2).astype(np.float32)


def lens_shading(image: NDArray[np.float32], illumination: ArrayLike) -> NDArray[np.float32]:
    """An image corrected to uniform illumination.

    Parameters
    ----------
    image : [row, col].
    illumination : relative illumination [row, col], more than 0 everywhere.
    """
    given = _fitting("illumination", illumination, image.shape)
    if not given.min() > 0:
        raise RangeError("illumination", float(given.min()), "more than 0 everywhere")
    return image / given


def _fitting(name: str, values: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float32]:
    array = np.asarray(values, dtype=np.float32)
    if array.shape != shape:
        raise RangeError(f"shape of {name}", array.shape, str(shape))
    return array
