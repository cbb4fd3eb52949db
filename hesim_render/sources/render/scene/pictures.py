"""Pictures of targets and surfaces as textures of Mitsuba."""

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Interaction, Mask, MitsubaModule
from hesim_render.core.errors import SpecError
from hesim_render.core.host_arrays import from_host
from hesim_render.sources.render.scene.mitsuba_version import transform
from hesim_render.targets.piece import Picture


@dataclass(frozen=True, eq=False)
class TextureData:
    """A picture as a bitmap texture of Mitsuba holds it.

    Parameters
    ----------
    values : float32 [row, col, channel], the row with v = 0 first: one channel of grey reflectances, or three
        coefficients of smooth spectra [jakob2019].
    interpolation : between texels, ``bilinear`` or ``nearest``.
    """

    values: NDArray[np.float32]
    interpolation: str

    @property
    def kind(self) -> str:
        """``grey`` or ``smooth``."""
        return "grey" if self.values.shape[2] == 1 else "smooth"


def picture_texture(mi: MitsubaModule, picture: Picture, repeat: tuple[int, int] | None = None) -> Any:
    """A texture with the reflectances of a picture.

    Grey pictures are the same at all wavelengths. Mitsuba turns sRGB colours into smooth spectra [jakob2019]. Spectral
    pictures are linear between their wavelengths and zero beyond them.

    Parameters
    ----------
    mi : the mitsuba module.
    picture : the reflectances.
    repeat : how often the picture is seen along u and v, also beyond 0 to 1; None: once, and its rim beyond.

    Raises
    ------
    SpecError
        If a spectral picture is to be rendered in a scalar variant.
    """
    if picture.kind == "spectral":
        if mi.variant().startswith("scalar"):
            raise SpecError("a hyperspectral picture is rendered in vectorised variants of Mitsuba only")
        return _spectral_texture(mi.variant())(picture, repeat)
    values = np.ascontiguousarray(picture.values[::-1], dtype=np.float32)  # Mitsuba's first row has v = 0
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(values[..., 0] if picture.kind == "grey" else values),
        "raw": picture.kind == "grey",
        "filter_type": picture.interpolation,
        **({"wrap_mode": "clamp"} if repeat is None else {"wrap_mode": "repeat", "to_uv": _scaled(mi, repeat)}),
    }


def _scaled(mi: MitsubaModule, repeat: tuple[int, int]) -> Any:
    return transform(mi, np.diag([*map(float, repeat), 1.0, 1.0]))


@functools.cache
def _spectral_texture(variant: str) -> type:
    """The class of textures with one plane per wavelength; its base class depends on the variant."""
    import mitsuba as mi

    class SpectralPicture(mi.Texture):  # type: ignore[misc, name-defined]
        """A table of reflectances [row, col, wavelength] with linear interpolation between wavelengths."""

        def __init__(self, picture: Picture, repeat: tuple[int, int] | None) -> None:
            mi.Texture.__init__(self, mi.Properties())
            assert picture.wavelength_nm is not None
            rows, cols, planes = picture.values.shape
            self._size, self._planes = (mi.UInt32(rows), mi.UInt32(cols)), planes
            self._values = from_host(mi.Float, picture.values)
            self._knots = from_host(mi.Float, picture.wavelength_nm)
            self._ends = mi.Float(float(picture.wavelength_nm[0])), mi.Float(float(picture.wavelength_nm[-1]))
            self._bilinear = picture.interpolation == "bilinear"
            self._repeats = repeat is not None
            self._scale = mi.Float(float((repeat or (1, 1))[0])), mi.Float(float((repeat or (1, 1))[1]))
            self._mean = float(picture.values.mean())
            dr.make_opaque(self._size, self._values, self._knots, self._ends, self._scale)

        def eval(self, si: Interaction, active: Mask = True) -> Any:
            rows, cols = self._size
            u, v = si.uv.x * self._scale[0], si.uv.y * self._scale[1]
            if self._repeats:
                u, v = u - dr.floor(u), v - dr.floor(v)
            x, y = u * mi.Float(cols), (1 - v) * mi.Float(rows)
            if not self._bilinear:
                return self._at(si, dr.floor(y), dr.floor(x), active)
            x, y = x - 0.5, y - 0.5
            col, row = dr.floor(x), dr.floor(y)
            right, low = x - col, y - row
            upper = dr.lerp(self._at(si, row, col, active), self._at(si, row, col + 1, active), right)
            lower = dr.lerp(self._at(si, row + 1, col, active), self._at(si, row + 1, col + 1, active), right)
            return dr.lerp(upper, lower, low)

        def _at(self, si: Interaction, row: Float, col: Float, active: Mask) -> Any:
            """Reflectance of a texel at the wavelengths of each lane."""
            (rows, cols), planes = self._size, self._planes
            height, width = mi.Float(rows), mi.Float(cols)
            if self._repeats:  # neighbours across the rim are those of the next copy
                row, col = (place - dr.floor(place / size) * size for place, size in ((row, height), (col, width)))
            inside_row = mi.UInt32(dr.clip(row, 0, height - 1))
            inside_col = mi.UInt32(dr.clip(col, 0, width - 1))
            first = (inside_row * cols + inside_col) * planes
            bands = []
            for wavelength in si.wavelengths:
                above = dr.binary_search(0, planes, lambda k, w=wavelength: dr.gather(mi.Float, self._knots, k) < w)
                above = dr.clip(above, 1, planes - 1)
                start, end = (dr.gather(mi.Float, self._knots, k) for k in (above - 1, above))
                a, b = (dr.gather(mi.Float, self._values, first + k, active) for k in (above - 1, above))
                covered = (wavelength >= self._ends[0]) & (wavelength <= self._ends[1])
                bands.append(dr.select(covered, dr.lerp(a, b, (wavelength - start) / (end - start)), 0.0))
            return mi.UnpolarizedSpectrum(bands)

        def mean(self) -> Float:
            return mi.Float(self._mean)

        def max(self) -> float:
            return 1.0

        def is_spatially_varying(self) -> bool:
            return True

        def to_string(self) -> str:
            return "SpectralPicture[]"

    return SpectralPicture
