"""From the codes of a picture to linear light, in one kernel over the picture."""

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, UInt32
from hesim_render.core.host_arrays import from_host
from hesim_render.sources.video.colours import ColourTags, code_scale, yuv_to_rgb
from hesim_render.sources.video.picture_layout import PictureFormat, Planes
from hesim_render.spectral.transfer import decode

#: Steps of a transfer table between 0 and 1. The error of linear interpolation is at most 2e-6 of white.
_STEPS = 4096
#: Highest picture value the table holds; limited-range video goes to 1.09, YUV with strong chroma higher.
_TOP = 1.25
#: RGB and grey codes of at most this many bits have a table entry each; others interpolate in a table of cache size.
_CODE_BITS = 12


class Lineariser:
    """Converts the planes of a picture to linear R, G, B (or one plane for grey), with white at 1.

    Values below black count as black. Values above white are kept up to 1.25 of picture values (PQ and HLG: 1).
    Linear floating-point pictures are unchanged. Chroma is interpolated linearly between its samples.

    Parameters
    ----------
    shape : layout of the pictures.
    tags : complete tags; the caller handles the primaries.
    """

    def __init__(self, shape: PictureFormat, tags: ColourTags) -> None:
        types = jit()
        self._shape, self._types = shape, types
        self._is_light = tags.transfer == "linear" and shape.bits == 0
        transfer, gamma, range_ = tags.transfer or "srgb", tags.gamma or 2.2, tags.range or "full"
        top = 1.0 if transfer in ("pq", "hlg") else _TOP
        self._top = round(top * _STEPS)
        self._table = from_host(types.Float, decode(np.arange(self._top + 2) / _STEPS, transfer, gamma))
        scale = code_scale(shape.bits, range_) if shape.bits else (0.0, 1.0)
        self._scale = self._opaque(*scale)
        self._by_code = None
        if 0 < shape.bits <= _CODE_BITS and shape.layout != "yuv":
            value = (np.arange(2**shape.bits) - scale[0]) * scale[1]
            self._by_code = from_host(types.Float, decode(np.clip(value, 0, top), transfer, gamma))
        if shape.layout == "yuv":
            self._chroma_scale = self._opaque(*code_scale(shape.bits or 8, range_, chroma=True))
            self._matrix = [self._opaque(*row) for row in yuv_to_rgb(tags.matrix or "bt709")]
        self._index = dr.arange(types.UInt32, shape.width * shape.height)
        dr.eval(self._table, self._by_code, self._index)

    def _opaque(self, *values: float) -> list[Float]:
        return [dr.opaque(self._types.Float, float(np.float32(value))) for value in values]

    def linear(self, planes: Planes) -> list[Float]:
        """[R, G, B] or [grey] as Dr.Jit Float [row · width + col], not evaluated."""
        shape = self._shape
        if shape.layout == "yuv":
            return [self._light(value) for value in self._yuv(planes)]
        if shape.layout == "interleaved":
            codes = self._interleaved(planes[0])
        else:
            codes = [self._samples(plane)(None) for plane in planes]
        if self._is_light:
            return codes
        if self._by_code is not None:
            return [self._gather(self._by_code, self._types.UInt32(code)) for code in codes]
        return [self._light(self._scaled(code)) for code in codes]

    def _gather(self, table: Float, index: UInt32) -> Float:
        return dr.gather(self._types.Float, table, index)

    def _interleaved(self, picture: NDArray) -> list[Float]:
        """R, G and B of [row, col, 3]. Bytes are extracted from whole words, which is three times as fast."""
        types = self._types
        if picture.dtype != np.uint8:
            samples, first = self._samples(picture), self._index * 3
            return [samples(first + channel) for channel in range(3)]
        words = from_host(types.UInt32, _words(picture))
        first = self._index * 3
        word, shift = first >> 2, (first & 3) << 3
        # the last pixel has all three bytes in the last word itself
        last = dr.width(words) - 1
        low, high = dr.gather(types.UInt32, words, word), dr.gather(types.UInt32, words, dr.minimum(word + 1, last))
        # a shift by 32 is undefined, so use two smaller shifts
        both = (low >> shift) | ((high << 1) << (31 - shift))
        return [types.Float((both >> (8 * channel)) & 0xFF) for channel in range(3)]

    def _samples(self, plane: NDArray) -> Float:
        """A function from indices into a plane (None: all of it, in order) to its values as Float."""
        types = self._types
        flat = plane.reshape(-1)
        if flat.dtype == np.uint16:  # two to a word: Dr.Jit has no 16-bit integers
            words = from_host(types.UInt32, _words(flat))
            every = dr.arange(types.UInt32, flat.size)

            def pick(index: UInt32) -> Float:
                where = every if index is None else index
                return types.Float((dr.gather(types.UInt32, words, where >> 1) >> ((where & 1) << 4)) & 0xFFFF)

            return pick
        kind = {"u1": types.UInt8, "f2": types.Float16, "f4": types.Float}[flat.dtype.str[1:]]
        array = from_host(kind, flat)
        return lambda index: types.Float(array if index is None else dr.gather(kind, array, index))

    def _scaled(self, value: Float) -> Float:
        offset, scale = self._scale
        return value if self._shape.bits == 0 else (value - offset) * scale

    def _light(self, value: Float) -> Float:
        """Linear light of picture values, from the table."""
        types = self._types
        place = dr.clip(value * float(_STEPS), 0.0, float(self._top))
        index = types.UInt32(place)
        low = self._gather(self._table, index)
        return dr.fma(place - types.Float(index), self._gather(self._table, index + 1) - low, low)

    def _yuv(self, planes: Planes) -> list[Float]:
        luma = self._scaled(self._samples(planes[0])(None))
        offset, scale = self._chroma_scale
        cb, cr = ((value - offset) * scale for value in self._chroma(planes[1:]))
        return [row[0] * luma + row[1] * cb + row[2] * cr for row in self._matrix]

    def _chroma(self, planes: Planes) -> list[Float]:
        """Both chroma planes at every luma sample."""
        shape = self._shape
        if shape.chroma_shift == (0, 0):
            return [self._samples(plane)(None) for plane in planes]
        width, height = shape.chroma_size
        row = self._index // shape.width
        across = self._between(self._index - row * shape.width, shape.chroma_shift[0], width, shape.chroma_left)
        down = self._between(row, shape.chroma_shift[1], height, False)
        result = []
        for plane in planes:
            pick = self._samples(plane)
            lines = []
            for line in dict.fromkeys((down[0], down[1])) if down[2] is None else down[:2]:
                left = pick(line * width + across[0])
                lines.append(left if across[2] is None else left + (pick(line * width + across[1]) - left) * across[2])
            result.append(lines[0] if down[2] is None else lines[0] + (lines[1] - lines[0]) * down[2])
        return result

    def _between(self, place: UInt32, shift: int, count: int, aligned: bool) -> tuple[UInt32, UInt32, Float | None]:
        """Chroma samples before and after a luma position along one axis, and the fraction of the way between them."""
        types = self._types
        if shift == 0:
            return place, place, None
        # in units of chroma samples; aligned: sample k sits on luma k·2^shift, else amid its 2^shift luma samples
        at = types.Float(place) * (1 / (1 << shift)) + (0.0 if aligned else 0.5 / (1 << shift) - 0.5)
        at = dr.clip(at, 0.0, float(count - 1))
        first = types.UInt32(at)
        return first, dr.minimum(first + 1, count - 1), at - types.Float(first)


def _words(values: NDArray) -> NDArray[np.uint32]:
    """The bytes of an array as 32-bit words (little-endian), padded with zeros to a whole word.

    The array is used in place if it consists of whole, aligned words.
    """
    flat = np.ascontiguousarray(values).reshape(-1)
    missing = -flat.size % (4 // flat.itemsize)
    if missing or flat.ctypes.data % 4:
        flat = np.append(flat, np.zeros(missing, flat.dtype))
    return flat.view(np.uint32)
