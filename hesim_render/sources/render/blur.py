"""Point-spread functions of a lens on the device: places in the picture at which rays of a pixel start.

The light of a point whose chief ray lies at p is spread over places s with the density PSF(s − p). A ray that starts at
its pixel's place s therefore goes on at p = s − δ, with δ drawn from the PSF; rays need no weights. Convolutions are
sums of independent δ. The PSF of a pixel is that of the image height of its centre.
"""

from functools import cache
from math import log, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, MitsubaObject, Point2, UInt32
from hesim_render.core.host_arrays import from_host
from hesim_render.core.units import MM_PER_M
from hesim_render.sensor.sensor import Sensor
from hesim_render.specs.lens import GaussianPsf, MeasuredPsf

FWHM_PER_SIGMA = 2.3548200450309493  # 2 √(2 ln 2)
#: Entries of tables over image height, and least width of a Gaussian that has any, px.
_HEIGHTS, _LEAST_SIGMA_PX = 1024, 1e-4
#: Parts of the light of an Airy pattern whose radii are tabulated; the last one follows the law of the far rings.
_AIRY_PARTS = 1 << 14
#: Part of the light of a PSF that lies within its stated reach.
_MOST_LIGHT = 0.98


def radius_of(sensor: Sensor, place: tuple[Float, Float]) -> Float:
    """Distance of column and row on the full sensor from the axis, px."""
    types, geometry = jit(), sensor.spec.geometry
    middle = [
        dr.opaque(types.Float, (count - 1) / 2 + axis / (geometry.pitch_um * 1e-3))
        for count, axis in zip((geometry.cols, geometry.rows), sensor.lens.axis_mm, strict=True)
    ]
    return dr.hypot(place[0] - middle[0], place[1] - middle[1])


class _OverHeight:
    """A function of the image height on the device, linear between the values of an even table."""

    def __init__(self, sensor: Sensor, height_mm: list[float], values: NDArray[np.float64]) -> None:
        types, geometry = jit(), sensor.spec.geometry
        self._sensor = sensor
        pitch_mm = geometry.pitch_um * 1e-3
        far = max(float(np.hypot(geometry.cols, geometry.rows)), max(height_mm) / pitch_mm) + 1
        self._values = from_host(types.Float, np.interp(np.linspace(0, far * pitch_mm, _HEIGHTS), height_mm, values))
        self._per_px = dr.opaque(types.Float, (_HEIGHTS - 1) / far)
        dr.make_opaque(self._values)

    def at(self, place: tuple[Float, Float]) -> Float:
        """Value at columns and rows of the full sensor."""
        types = jit()
        index = dr.minimum(radius_of(self._sensor, place) * self._per_px, _HEIGHTS - 1)
        cell = dr.minimum(types.UInt32(index), _HEIGHTS - 2)
        low, high = (dr.gather(types.Float, self._values, cell + k) for k in (0, 1))
        return dr.fma(index - types.Float(cell), high - low, low)


class GaussianBlur:
    """A Gaussian, of one width or of a width that follows the image height; the sensor has the lens in use."""

    def __init__(self, sensor: Sensor) -> None:
        types, pitch_um, psf = jit(), sensor.spec.geometry.pitch_um, sensor.optics.psf
        widths = psf.fwhm_um if isinstance(psf, GaussianPsf) else [sensor.optics.psf_fwhm_um]
        sigma_px = np.array(widths) / FWHM_PER_SIGMA / pitch_um
        self._widest = dr.opaque(types.Float, float(sigma_px.max()))
        #: Radius that holds nearly all of it, px.
        self.reach_px = float(sqrt(-2 * log(1 - _MOST_LIGHT)) * sigma_px.max())
        self._of_height = None
        if isinstance(psf, GaussianPsf) and len(widths) > 1:
            self._of_height = _OverHeight(sensor, psf.image_height_mm, np.maximum(sigma_px, _LEAST_SIGMA_PX))

    @property
    def widest_px(self) -> Float:
        """Largest standard deviation, px."""
        return self._widest

    def sigma_px(self, place: tuple[Float, Float] | None) -> Float:
        """Standard deviation at columns and rows of the full sensor, px."""
        if self._of_height is None or place is None:
            return self._widest
        return self._of_height.at(place)

    def numbers(self, sampler: MitsubaObject) -> Point2:
        """Random numbers of one ray."""
        return sampler.next_2d()

    def offset(self, numbers: Point2, place: tuple[Float, Float] | None) -> tuple[Float, Float]:
        """Where a ray goes on relative to where it starts, px, for `numbers` in [0, 1) (Box-Muller)."""
        radius = self.sigma_px(place) * dr.sqrt(-2 * dr.log(1 - numbers[0]))
        sine, cosine = dr.sincos(2 * dr.pi * numbers[1])
        return radius * cosine, radius * sine


class KernelBlur:
    """Measured kernels, each turned about the axis to the pixel's own direction, but for the one on the axis.

    Parameters
    ----------
    sensor : with the lens in use.
    """

    def __init__(self, sensor: Sensor) -> None:
        types, psf = jit(), sensor.optics.psf
        assert isinstance(psf, MeasuredPsf)
        self._sensor = sensor
        kernels = np.array(psf.kernels, dtype=np.float64)
        kernels /= kernels.sum(axis=(1, 2), keepdims=True)
        count, self._rows, self._cols = kernels.shape
        by_row = np.cumsum(kernels.sum(axis=2), axis=1)
        within = np.cumsum(kernels, axis=2)
        within /= np.maximum(within[..., -1:], 1e-300)
        self._row_sums, self._col_sums = (from_host(types.Float, values) for values in (by_row, within))
        self._on_axis = psf.image_height_mm[0] == 0
        self._which = _OverHeight(sensor, psf.image_height_mm, np.arange(count, dtype=np.float64))
        step_px = psf.sample_um / sensor.spec.geometry.pitch_um
        self._step = dr.opaque(types.Float, step_px)
        dr.make_opaque(self._row_sums, self._col_sums)
        row, col = np.mgrid[: self._rows, : self._cols]
        away = np.hypot(row - self._rows // 2, col - self._cols // 2).ravel() * step_px
        order, light = np.argsort(away), kernels.reshape(count, -1)
        held = np.cumsum(light[:, order], axis=1)
        #: Radius that holds nearly all of it, px.
        self.reach_px = float(max(np.interp(_MOST_LIGHT, each, away[order]) for each in held))

    def numbers(self, sampler: MitsubaObject) -> tuple[Point2, Float]:
        """Random numbers of one ray."""
        return sampler.next_2d(), sampler.next_1d()

    def offset(self, numbers: tuple[Point2, Float], place: tuple[Float, Float] | None) -> tuple[Float, Float]:
        """Where a ray goes on relative to where it starts, px; see `GaussianBlur.offset`."""
        types = jit()
        assert place is not None
        (u, v), luck = numbers
        height = self._which.at(place)
        kernel = types.UInt32(height)
        kernel = kernel + dr.select(luck < height - types.Float(kernel), types.UInt32(1), 0)
        row, down = _drawn(self._row_sums, kernel * self._rows, self._rows, v)
        col, right = _drawn(self._col_sums, (kernel * self._rows + row) * self._cols, self._cols, u)
        x = (types.Float(col) + right - 0.5 * self._cols) * self._step
        y = (types.Float(row) + down - 0.5 * self._rows) * self._step
        geometry, (axis_x, axis_y) = self._sensor.spec.geometry, self._sensor.lens.axis_mm
        pitch_mm = geometry.pitch_um * 1e-3
        out_x = place[0] - dr.opaque(types.Float, (geometry.cols - 1) / 2 + axis_x / pitch_mm)
        out_y = place[1] - dr.opaque(types.Float, (geometry.rows - 1) / 2 + axis_y / pitch_mm)
        far = dr.hypot(out_x, out_y)
        turned = (far > 0) & ((kernel > 0) | (not self._on_axis))
        cosine, sine = (dr.select(turned, part / far, unit) for part, unit in ((out_x, 1.0), (out_y, 0.0)))
        return y * sine - x * cosine, -x * sine - y * cosine


def _drawn(sums: Float, first: UInt32, count: int, u: Float) -> tuple[UInt32, Float]:
    """Entry of a table of running sums in which a number in [0, 1) lies, and its place inside it, 0 to 1."""
    types = jit()
    entry = dr.binary_search(0, count - 1, lambda k: dr.gather(types.Float, sums, first + types.UInt32(k)) <= u)
    entry = types.UInt32(entry)
    low = dr.select(entry > 0, dr.gather(types.Float, sums, first + dr.maximum(entry, 1) - 1), 0.0)
    high = dr.gather(types.Float, sums, first + entry)
    return entry, dr.clip((u - low) / dr.maximum(high - low, 1e-30), 0, 1)


@cache
def airy_radii() -> NDArray[np.float64]:
    """Radii x = π r/(λ N) that hold the parts k/n of the light of an Airy pattern, k = 0 … n − 1.

    The light within x is 1 − J₀²(x) − J₁²(x) (Rayleigh; [goodman2005]).
    """
    from scipy.special import j0, j1

    x = np.concatenate([np.linspace(0, 60, 60_001), np.geomspace(60, 4 * _AIRY_PARTS, 400_001)[1:]])
    held = np.maximum.accumulate(1 - j0(x) ** 2 - j1(x) ** 2)
    keep = np.concatenate([[True], np.diff(held) > 0])
    return np.interp(np.arange(_AIRY_PARTS) / _AIRY_PARTS, held[keep], x[keep])


class AiryBlur:
    """Diffraction at a round aperture: the Airy pattern at the working f-number N (1 + |m|) and a ray's wavelength.

    Parameters
    ----------
    sensor : with the lens in use.
    """

    def __init__(self, sensor: Sensor) -> None:
        types = jit()
        self._radii = from_host(types.Float, airy_radii())
        scale = sensor.lens.working_f_number / (pi * sensor.spec.geometry.pitch_um * MM_PER_M)
        self._px_per_nm = dr.opaque(types.Float, scale)
        dr.make_opaque(self._radii)

    def offset(self, numbers: Point2, wavelength_nm: Float) -> tuple[Float, Float]:
        """Where a ray goes on relative to where it starts, px, for `numbers` in [0, 1)."""
        types = jit()
        at = numbers[0] * _AIRY_PARTS
        cell = dr.minimum(types.UInt32(at), _AIRY_PARTS - 1)
        low = dr.gather(types.Float, self._radii, cell)
        high = dr.gather(types.Float, self._radii, dr.minimum(cell + 1, _AIRY_PARTS - 1))
        # outside the last part, the light beyond x is 2/(π x) on average
        far = low / dr.maximum(_AIRY_PARTS * (1 - numbers[0]), 1e-3)
        x = dr.select(cell == _AIRY_PARTS - 1, far, dr.fma(at - types.Float(cell), high - low, low))
        radius = x * wavelength_nm * self._px_per_nm
        sine, cosine = dr.sincos(2 * dr.pi * numbers[1])
        return radius * cosine, radius * sine
