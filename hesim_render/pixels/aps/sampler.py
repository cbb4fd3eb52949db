"""Sampler of frame pixels on Dr.Jit. Values are drawn from the law of `hesim_render.pixels.aps.formulas`."""

import math
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Generator, UInt32, device_namespace
from hesim_render.core.host_arrays import from_host
from hesim_render.core.rng import Stream, normal_pair, philox
from hesim_render.core.units import S_PER_US
from hesim_render.mosaic.layout import Layout
from hesim_render.pixels.aps.fixed_pattern import FixedPattern
from hesim_render.pixels.aps.formulas import PixelProperties
from hesim_render.pixels.aps.poisson import poisson
from hesim_render.pixels.arrays import take, to_device
from hesim_render.specs.frame_pixels import InterferenceSpec

if TYPE_CHECKING:
    from hesim_render.pixels.aps.model import ApsNoise


class DeviceMaps:
    """Maps over the pixels of a region on the device, for the sampler.

    Parameters
    ----------
    layout : the region.
    maps : its fixed pattern.
    beta : [tile_row, tile_col, 6] of the polynomial form, or None.
    """

    def __init__(self, layout: Layout, maps: FixedPattern, beta: NDArray[np.float64] | None) -> None:
        self._layout = layout
        terms = None
        if beta is not None:
            # a coefficient that is the same at all places of the tile stays a number
            uniform = np.all(beta == beta[:1, :1], axis=(0, 1))
            tiled = layout.tiled(beta)
            terms = tuple(to_device(beta[0, 0, k] if uniform[k] else tiled[..., k]) for k in range(6))
        self._pixels = PixelProperties(
            to_device(maps.response), to_device(maps.dark_e_per_s), to_device(maps.offset_dn), terms
        )  # fmt: skip

    def pixels(self, index: UInt32) -> PixelProperties:
        """Properties of the pixels `index` of the region. As many indices as pixels means all pixels in their order."""
        if dr.width(index) == self._layout.rows * self._layout.cols:
            return self._pixels

        def entries(values: Float) -> Float:
            return take(values, index)

        own = self._pixels
        beta = None if own.beta is None else tuple(map(entries, own.beta))
        return PixelProperties(entries(own.response), entries(own.dark_e_per_s), entries(own.offset_dn), beta)

    @cached_property
    def _keys(self) -> UInt32:
        return from_host(jit().UInt32, self._layout.full_index)

    def keys(self, index: UInt32) -> UInt32:
        """Full-sensor index of pixels of the region. A region as wide as the sensor needs no table."""
        types, sensor_cols = jit(), self._layout.spec.geometry.cols
        if self._layout.cols == sensor_cols:
            return index + dr.opaque(types.UInt32, self._layout.row0 * sensor_cols)
        return dr.gather(types.UInt32, self._keys, index)


def draw_dn(
    noise: "ApsNoise", maps: DeviceMaps, electrons: Float, exposure_us: float, seed: int, frame: int, first_pixel: int
) -> UInt32:
    """Values of the pixels of a frame from `first_pixel` on, UInt32 [n], DN; see `ApsNoise.sample_dn`.

    Parameters
    ----------
    noise : noise model.
    maps : maps of the region on the device.
    electrons : Float [n], mean photo-electrons of the exposure.
    exposure_us : exposure, µs.
    seed, frame : seed of the noise and number of the frame.
    first_pixel : index of the first pixel in the region, row-major.
    """
    types, spec = jit(), noise.spec
    index = dr.arange(types.UInt32, dr.width(electrons)) + dr.opaque(types.UInt32, first_pixel)
    pixels = maps.pixels(index)
    value = noise.value(electrons, dr.opaque(types.Float, exposure_us * S_PER_US), pixels, device_namespace())

    key = maps.keys(index)
    # one generator a pixel and frame, so that no value depends on the region or on the order
    generator = philox(seed, Stream.APS, key, frame)
    word = generator.next_uint32x4()
    if spec.law == "poisson":
        counts = poisson(value.count, generator, (word[0], word[1]))
        deviate = normal_pair(word[2], word[3])[0]
    else:
        shot, deviate = normal_pair(word[0], word[1])
        counts = dr.fma(dr.sqrt(value.count), shot, value.count)
    if noise.read_noise_correlation != 0:
        # the deviate of the pixel before it in the row, drawn again from its own key
        before = philox(seed, Stream.APS, key - 1, frame).next_uint32x4()
        earlier = (
            normal_pair(before[2], before[3])[0] if spec.law == "poisson" else normal_pair(before[0], before[1])[1]
        )
        own, other = _weights(noise.read_noise_correlation)
        deviate = dr.fma(dr.opaque(types.Float, own), deviate, dr.opaque(types.Float, other) * earlier)
    # the well clips what is collected; offset and read noise come after it
    full_well_dn = spec.full_well_e * spec.system_gain_dn_per_e
    level: Float = dr.minimum(dr.fma(value.gain_dn, counts, value.fixed_dn), full_well_dn) + pixels.offset_dn
    level = dr.fma(dr.sqrt(types.Float(value.gaussian_dn2)), deviate, level)
    if noise.telegraph is not None:
        level += noise.telegraph.added_dn(seed, frame, noise.layout.rows * noise.layout.cols, index)
    if noise.row_noise_dn > 0:
        # row of the full sensor: all pixels of the row draw the same number
        row = key // dr.opaque(types.UInt32, noise.layout.spec.geometry.cols)
        word = philox(seed, Stream.ROW_NOISE, row, frame).next_uint32x4()
        level = dr.fma(dr.opaque(types.Float, noise.row_noise_dn), normal_pair(word[0], word[1])[0], level)
    if noise.column_noise_dn > 0:
        columns = dr.opaque(types.UInt32, noise.layout.spec.geometry.cols)
        word = philox(seed, Stream.COLUMN_NOISE, key % columns, frame).next_uint32x4()
        level = dr.fma(dr.opaque(types.Float, noise.column_noise_dn), normal_pair(word[0], word[1])[0], level)
    for number, line in enumerate(noise.interference):
        level += _sine(
            noise.layout.spec.geometry.cols, line, key, philox(seed, Stream.INTERFERENCE, 0 * key + number, frame)
        )
    # not clip: it would turn NaN into the largest integer, which is above the full scale of the ADC
    return types.UInt32(dr.select(level >= 0.0, dr.minimum(dr.round(level), float(noise.full_scale_dn)), 0.0))


def _sine(cols: int, line: InterferenceSpec, key: UInt32, generator: Generator) -> Float:
    """Value of an interference at pixels of the full sensor, DN; its phase is the generator's next number."""
    types = jit()
    word = generator.next_uint32x4()[0]
    width = dr.opaque(types.UInt32, cols)
    row, col = types.Float(key // width), types.Float(key % width)
    turns = dr.fma(dr.opaque(types.Float, line.cycles_per_row), row, dr.opaque(types.Float, line.cycles_per_col) * col)
    turns = turns - dr.floor(turns) + types.Float(word) * 2.0**-32
    return dr.opaque(types.Float, line.rms_dn * math.sqrt(2.0)) * dr.cos(math.tau * turns)


def _weights(correlation: float) -> tuple[float, float]:
    """Weights of a deviate and of the one before it whose sum has unit variance and the correlation with the next sum.

    a² + b² = 1 and a b = ρ: the squares are (1 ± √(1 − 4ρ²))/2.
    """
    root = math.sqrt(1.0 - 4.0 * correlation * correlation)
    return math.sqrt((1.0 + root) / 2.0), math.copysign(math.sqrt((1.0 - root) / 2.0), correlation)
