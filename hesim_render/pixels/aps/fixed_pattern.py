"""Fixed maps of a device's frame pixels: PRNU, offset and dark current, from the device seed or measured."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import special

from hesim_render.core.plain import PlainState
from hesim_render.core.rng import Stream, device_normal
from hesim_render.mosaic.layout import Layout
from hesim_render.pixels.measured import frame_maps
from hesim_render.specs.frame_pixels import ApsSpec

Map = float | NDArray[np.float32]

#: Least relative spread of the dark current. A smaller one is lost in 32-bit numbers, and the shape parameter of its
#: gamma law would be too large to compute.
_LEAST_SPREAD_REL = 1e-6


@dataclass(frozen=True)
class FixedPattern(PlainState):
    """Maps over one read-out region, each computed on first use; keyed by the full sensor's pixels.

    Parameters
    ----------
    spec : the ``aps`` section of the sensor file.
    layout : region read out.
    device_seed : which device of this kind.
    off : names of terms left out (``prnu``, ``dsnu``, ``row``, ``column``, ``dark_current``).
    """

    spec: ApsSpec
    layout: Layout
    device_seed: int
    off: frozenset[str] = frozenset()

    def _deviates(self, stream: Stream) -> NDArray[np.float32]:
        return device_normal(self.device_seed, stream, self.layout.full_index)

    @cached_property
    def _measured(self) -> dict[str, NDArray[np.float32]] | None:
        """Maps of the calibration that the sensor file points at."""
        return frame_maps(self.layout)

    @cached_property
    def response(self) -> Map:
        """1 + PRNU, [row, col]; the number 1 where there is no spread. Never below 0."""
        if "prnu" in self.off:
            return 1.0
        if self._measured is not None and "response" in self._measured:
            return np.maximum(self._measured["response"], np.float32(0.0))
        if self.spec.prnu_rel == 0:
            return 1.0
        return np.maximum(1.0 + np.float32(self.spec.prnu_rel) * self._deviates(Stream.PRNU), np.float32(0.0))

    @cached_property
    def offset_dn(self) -> Map:
        """N_FP = black + N_row + N_col + N_BLC in DN, [row, col]; a number where there is no spread.

        N_BLC = K·dsnu_e·z is drawn per pixel, N_row per row and N_col per column of the full sensor. The draws are
        independent. Measured N_BLC has the columns in it. A
        calibration uses the gauge in which the row means of N_BLC are 0, so it splits the same sum slightly
        differently. Measured maps replace both draws.
        """
        spec = self.spec
        if self._measured is not None:
            parts = [self._measured[m] for m, term in (("n_row", "row"), ("n_blc", "dsnu")) if term not in self.off]
            return np.broadcast_to(np.float32(spec.black_level_dn) + sum(parts, np.float32(0.0)), self.layout.shape)
        offset: Map = spec.black_level_dn
        if "row" not in self.off and spec.row_offset_std_dn > 0:
            rows = np.arange(self.layout.row0, self.layout.row0 + self.layout.rows, dtype=np.uint32)[:, None]
            deviates = device_normal(self.device_seed, Stream.ROW_OFFSET, rows)
            offset = np.broadcast_to(
                np.float32(spec.black_level_dn) + np.float32(spec.row_offset_std_dn) * deviates, self.layout.shape
            )
        if "column" not in self.off and spec.column_offset_std_dn > 0:
            cols = np.arange(self.layout.col0, self.layout.col0 + self.layout.cols, dtype=np.uint32)[None]
            deviates = device_normal(self.device_seed, Stream.COLUMN_OFFSET, cols)
            offset = np.broadcast_to(offset + np.float32(spec.column_offset_std_dn) * deviates, self.layout.shape)
        if "dsnu" not in self.off and spec.dsnu_e > 0:
            offset = offset + np.float32(spec.system_gain_dn_per_e * spec.dsnu_e) * self._deviates(Stream.DSNU)
        return offset

    @cached_property
    def dark_e_per_s(self) -> Map:
        """Dark current D of each pixel, e⁻/s, [row, col]: from a gamma law over pixels, or measured.

        It is a number where there is no spread.
        """
        spec = self.spec
        if "dark_current" in self.off:
            return 0.0
        if self._measured is not None:
            rate = self._measured["n_dp"] / np.float32(spec.system_gain_dn_per_e) * np.float32(spec.dark_current_growth)
            # an estimate near 0 may be negative, but the mean of a count in the physical form may not
            return rate if spec.beta is not None else np.maximum(rate, np.float32(0.0))
        if spec.dark_current_nonuniformity_rel < _LEAST_SPREAD_REL or spec.dark_current_now_e_per_s == 0:
            return spec.dark_current_now_e_per_s
        # the quantile function is tabulated over the normal deviate; linear interpolation is accurate to 1e-6
        shape = spec.dark_current_nonuniformity_rel**-2.0
        z = np.linspace(-7.0, 7.0, 28001)
        lower, upper = special.gammaincinv(shape, special.ndtr(z)), special.gammainccinv(shape, special.ndtr(-z))
        rate = np.where(z < 0, lower, upper) / shape * spec.dark_current_now_e_per_s
        return np.interp(self._deviates(Stream.DARK_CURRENT), z, rate).astype(np.float32)
