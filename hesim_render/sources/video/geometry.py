"""Mapping from picture to mosaic: the footprint of each mosaic pixel in the picture, and the mean over it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, UInt32
from hesim_render.core.errors import RangeError
from hesim_render.core.host_arrays import from_host

Fit = Literal["cover", "stretch", "pixel"]


@dataclass(frozen=True)
class Axis:
    """Rows or columns: source pixels and their weights for each sensor pixel.

    Parameters
    ----------
    first : [pixel], first source pixel of each footprint.
    weight : [pixel, tap], weights of the source pixels from `first` on; they sum to 1.
    scale : source pixels per sensor pixel.
    begin : begin of the first sensor pixel, in source pixels.
    """

    first: NDArray[np.uint32]
    weight: NDArray[np.float32]
    scale: float
    begin: float

    @property
    def is_plain(self) -> bool:
        """True if each sensor pixel is one source pixel."""
        return self.weight.shape[1] == 1


def axis(pixels: int, source: int, scale: float) -> Axis:
    """Footprints of `scale` source pixels each, centred on the source: exact overlaps with its square pixels."""
    begin = (source - pixels * scale) / 2
    if scale == 1:
        begin = float(np.floor(begin))  # keeps whole pixels whole if an odd number of them is cut off
    # borders between footprints, in source pixels; nearly whole ones are whole, so that no tap has a weight of rounding
    edges = np.clip(begin + np.arange(pixels + 1) * scale, 0, source)
    edges = np.where(np.abs(edges - np.rint(edges)) < 1e-9 * source, np.rint(edges), edges)
    low, high = edges[:-1], edges[1:]
    first = np.minimum(np.floor(low), source - 1)
    taps = int(np.max(np.ceil(high) - first))
    place = first[:, None] + np.arange(taps)
    # overlap of each source pixel with the footprint, [pixel, tap]
    share = np.clip(np.minimum(place + 1, high[:, None]) - np.maximum(place, low[:, None]), 0, None)
    return Axis(
        first.astype(np.uint32), (share / share.sum(axis=1, keepdims=True)).astype(np.float32), scale, float(begin)
    )


@dataclass(frozen=True)
class Mapping:
    """Mapping from the picture to the read-out region by box footprints in linear light, which conserve light."""

    rows: Axis
    cols: Axis
    source_shape: tuple[int, int]

    @property
    def is_identity(self) -> bool:
        """True if picture and region have the same pixels."""
        shape = (self.rows.first.size, self.cols.first.size)
        return shape == self.source_shape and self.rows.is_plain and self.cols.is_plain

    def describe(self) -> dict[str, Any]:
        """Plain values for the manifest."""
        return {
            "picture_px_per_sensor_px": [self.cols.scale, self.rows.scale],
            "first_picture_px": [self.cols.begin, self.rows.begin],
        }


def mapping(source_width: int, source_height: int, rows: int, cols: int, fit: Fit = "cover") -> Mapping:
    """How a picture fills a region of `rows` × `cols` sensor pixels.

    ``cover``: one scale for both axes, the largest at which the picture covers the region; the excess is cut
    off evenly. ``stretch``: a scale for each axis. ``pixel``: one picture pixel per sensor pixel, from the centre.

    Raises
    ------
    RangeError
        If a picture of fit ``pixel`` is smaller than the region.
    """
    scales = source_height / rows, source_width / cols
    if fit == "pixel":
        if source_height < rows or source_width < cols:
            raise RangeError(
                "size of the pictures",
                f"{source_width}x{source_height}",
                f"at least the {cols}x{rows} px read out (with fit 'pixel'; 'cover' enlarges)",
            )
        scales = 1.0, 1.0
    elif fit == "cover":
        scales = min(scales), min(scales)
    return Mapping(
        axis(rows, source_height, scales[0]), axis(cols, source_width, scales[1]), (source_height, source_width)
    )


class Resampler:
    """Applies a mapping to planes on the device: along columns first, then along rows."""

    def __init__(self, mapping: Mapping) -> None:
        types = jit()
        self._mapping = mapping
        rows, cols = mapping.rows.first.size, mapping.cols.first.size
        self._shape, self._width = (rows, cols), mapping.source_shape[1]
        if mapping.is_identity:
            return
        self._first = [from_host(types.UInt32, axis.first) for axis in (mapping.rows, mapping.cols)]
        self._weight = [from_host(types.Float, axis.weight.T) for axis in (mapping.rows, mapping.cols)]
        dr.eval(self._first, self._weight)

    def __call__(self, planes: list[Float]) -> list[Float]:
        """[row · width + col] of the picture to [row · cols + col] of the region, Dr.Jit Float, not evaluated."""
        types = jit()
        if self._mapping.is_identity:
            return planes
        dr.eval(planes)
        rows, cols = self._shape
        # rows first: the planes then have the rows of the region and the columns of the picture
        if not self._mapping.rows.is_plain:
            index = dr.arange(types.UInt32, rows * self._width)
            row = index // self._width
            source_col = index - row * self._width
            planes = self._sum(planes, 0, row, lambda source_row: source_row * self._width + source_col)
            dr.eval(planes)
            first_row = None
        else:
            first_row = self._first[0]
        index = dr.arange(types.UInt32, rows * cols)
        row = index // cols
        col = index - row * cols
        source_row = row if first_row is None else dr.gather(types.UInt32, first_row, row)
        return self._sum(planes, 1, col, lambda source_col: source_row * self._width + source_col)

    def _sum(
        self, planes: list[Float], which: int, target: UInt32, place_of: Callable[[UInt32], UInt32]
    ) -> list[Float]:
        """Weighted sum of source rows (`which` 0) or columns (1) for target rows or columns.

        Parameters
        ----------
        planes : of the source.
        target : row or column of the region, of each lane.
        place_of : place in a plane of a source row or column, of each lane.
        """
        types = jit()
        axis = (self._mapping.rows, self._mapping.cols)[which]
        first = dr.gather(types.UInt32, self._first[which], target)
        last = self._mapping.source_shape[which] - 1
        totals: list[Float] = [0.0 for _ in planes]
        for tap in range(axis.weight.shape[1]):
            weight = dr.gather(types.Float, self._weight[which], target + tap * self._shape[which])
            # beyond the last one the weight is 0
            place = place_of(dr.minimum(first + tap, last))
            totals = [
                dr.fma(weight, dr.gather(types.Float, plane, place), total)
                for plane, total in zip(planes, totals, strict=True)
            ]
        return totals
