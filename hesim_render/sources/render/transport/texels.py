"""Pictures on diffuse surfaces: the flux of direct light that each texel reflects.

The spectral integral C[k, ρ, R] of `diffuse` is linear in the reflectance ρ, and Mitsuba interpolates reflectances
between texels. The integral is therefore computed for each texel, light and filter, and interpolated.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Mask, MitsubaModule, Point2, UInt32
from hesim_render.core.host_arrays import from_host
from hesim_render.sources.render.scene.pictures import TextureData, picture_texture
from hesim_render.spectral.spectrum import Spectrum, merged_grid
from hesim_render.targets.piece import Picture

#: Columns of a picture's row in the table: first entry, texels across and up, entries of a texel, whether texels are
#: interpolated, whether the picture repeats, and whether it is grey.
_ROW = 8
#: Texels whose spectra are integrated at once.
_TEXELS_AT_ONCE = 1 << 20
#: Distance of the wavelengths at which the smooth spectra of sRGB pictures are evaluated, and of those between which
#: the spline through them counts as linear, nm.
_STEP_NM, _FINE_NM = 5.0, 0.5


@dataclass(frozen=True)
class Texel:
    """What rays see of pictures, per lane.

    Parameters
    ----------
    entries : first entry of each of the four texels around.
    weights : of these texels.
    is_seen : True where there is a picture.
    has_spectrum : True where a texel has entries of its own for each light and filter.
    """

    entries: tuple[UInt32, UInt32, UInt32, UInt32]
    weights: tuple[Float, Float, Float, Float]
    is_seen: Mask
    has_spectrum: Mask


class Texels:
    """Factors of all texels of a scene's pictures.

    Parameters
    ----------
    mi : the mitsuba module.
    pictures : pictures, and whether each of them repeats beyond 0 to 1.
    irradiances : S_k of each light on its own plane, W m⁻² nm⁻¹.
    responses : R per filter, e⁻ s⁻¹ per W m⁻² sr⁻¹ nm⁻¹.
    """

    def __init__(
        self,
        mi: MitsubaModule,
        pictures: Sequence[tuple[Picture | TextureData, bool]],
        irradiances: Sequence[Spectrum],
        responses: Sequence[Spectrum],
    ) -> None:
        self._mi = mi
        rows, parts, begin = np.zeros((len(pictures), _ROW)), [], 0
        for number, (picture, repeats) in enumerate(pictures):
            values = _factors(mi, picture, irradiances, responses)
            height, width, entries = values.shape
            is_linear = picture.interpolation == "bilinear"
            rows[number, :7] = begin, width, height, entries, is_linear, repeats, picture.kind == "grey"
            begin += values.size
            parts.append(values.ravel())
        # whole numbers, which a Float does not hold beyond 2²⁴
        self._rows = from_host(mi.UInt32, rows.astype(np.uint32))
        self._values = from_host(mi.Float, parts[0] if len(parts) == 1 else np.concatenate(parts))
        dr.make_opaque(self._rows, self._values)

    def at(self, number: UInt32, place: Point2, active: Mask) -> Texel:
        """Texels around a place.

        Parameters
        ----------
        number : of the picture, in the order given.
        place : (u, v); (0, 0) is the lower left corner of the picture, (1, 1) the upper right one.
        active : True where there is a picture.
        """
        mi = self._mi
        begin, width, height, entries = dr.gather(mi.Vector4u, self._rows, 2 * number, active)
        is_linear, repeats, is_grey, _ = dr.gather(mi.Vector4u, self._rows, 2 * number + 1, active)
        corners, shares = [], []
        for along, size in ((place.x, width), (place.y, height)):
            # texel k covers k to k + 1, and has its value at the middle
            where = along * mi.Float(size) - dr.select(is_linear > 0, 0.5, 0.0)
            first = dr.floor(where)
            shares.append(dr.select(is_linear > 0, where - first, 0.0))
            pair = []
            for texel in (first, first + 1):
                around = texel - dr.floor(texel / mi.Float(size)) * mi.Float(size)
                inside = dr.clip(dr.select(repeats > 0, around, texel), 0.0, mi.Float(size) - 1)
                pair.append(mi.UInt32(inside))
            corners.append(pair)
        (left, right), (low, high) = corners
        x, y = shares
        texels = (low, left), (low, right), (high, left), (high, right)
        first_entries = [begin + (row * width + col) * entries for row, col in texels]
        weights = [(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y]
        return Texel(tuple(first_entries), tuple(weights), active, is_grey == 0)

    def factor(self, texel: Texel, entry: UInt32, paint: Float, active: Mask) -> Float:
        """∫ R(λ) ρ(λ)/π S_k(λ) dλ of what rays see, e⁻/s: of a picture where there is one, else `paint`.

        Parameters
        ----------
        texel : from `at`.
        entry : number of light and filter, light · filters + filter.
        paint : the integral of the surface's paint; that of a surface with a picture is white.
        active : lanes that count.
        """
        active, own = active & texel.is_seen, dr.select(texel.has_spectrum, entry, 0)
        sum_ = self._mi.Float(0)
        for first, weight in zip(texel.entries, texel.weights, strict=True):
            sum_ = dr.fma(weight, dr.gather(self._mi.Float, self._values, first + own, active), sum_)
        # the texels of a grey picture are parts of white
        return dr.select(active, dr.select(texel.has_spectrum, sum_, sum_ * paint), paint)


def _factors(
    mi: MitsubaModule, picture: Picture | TextureData, irradiances: Sequence[Spectrum], responses: Sequence[Spectrum]
) -> NDArray[np.float32]:
    """Entries of the texels of a picture, [row, col, entry], the row with v = 0 first: the reflectance of a grey one,
    else the integrals of each light and filter, e⁻/s.
    """
    from_below = picture.values if isinstance(picture, TextureData) else picture.values[::-1]
    if picture.kind == "grey":
        return from_below.astype(np.float32)
    pairs = [(level, response) for level in irradiances for response in responses]
    if isinstance(picture, Picture) and picture.wavelength_nm is not None:
        knots = picture.wavelength_nm
        weights = np.stack([_weights(knots, *pair) for pair in pairs], axis=1)
        return (from_below @ weights.astype(np.float32)).astype(np.float32)
    low, high = (each(end) for each, end in zip((min, max), _ends(pairs), strict=True))
    knots, fine = (np.linspace(low, high, ceil((high - low) / step) + 4) for step in (_STEP_NM, _FINE_NM))
    linear = np.stack([_weights(fine, *pair) for pair in pairs], axis=1)
    # values between the knots are those of a spline, which is linear in the values at the knots
    weights = CubicSpline(knots, np.eye(knots.size))(fine).T @ linear
    height, width = from_below.shape[:2]
    out = np.empty((height, width, len(pairs)), np.float32)
    at_once = max(1, _TEXELS_AT_ONCE // width)
    for begin in range(0, height, at_once):
        rows = from_below[begin : begin + at_once]
        if isinstance(picture, Picture):
            # Mitsuba's own coefficients of its smooth spectra, as they are rendered; it doubles single rows and columns
            texture = mi.load_dict(picture_texture(mi, replace(picture, values=rows[::-1])))
            rows = np.array(mi.traverse(texture)["data"])[: len(rows), :width]
        integrals = _integrals(mi, rows.reshape(-1, 3), knots, weights)
        out[begin : begin + at_once] = integrals.reshape(len(rows), width, -1)
    dr.flush_malloc_cache()
    return out


def _ends(pairs: Sequence[tuple[Spectrum, Spectrum]]) -> tuple[list[float], list[float]]:
    """First and last wavelength at which each pair of spectra is not zero, nm."""
    first = [max(one.support_nm[0], other.support_nm[0]) for one, other in pairs]
    return first, [min(one.support_nm[1], other.support_nm[1]) for one, other in pairs]


def _weights(knots: NDArray[np.float64], level: Spectrum, response: Spectrum) -> NDArray[np.float64]:
    """Weights w with ∫ R(λ) ρ(λ)/π S(λ) dλ = Σ_j w_j·ρ(λ_j) for any ρ that is linear between knots λ_j, nm, and zero
    beyond them, exactly.
    """
    ends = merged_grid(level, response, Spectrum(knots, np.ones_like(knots)))
    out = np.zeros(knots.size)
    if ends.size < 2:
        return out
    # the product of three lines is a cubic, for which two nodes are exact
    place, share = np.polynomial.legendre.leggauss(2)
    half, middle = np.diff(ends) / 2, (ends[1:] + ends[:-1]) / 2
    nodes = middle + half * place[:, None]
    values = share[:, None] * half * level.at(nodes) * response.at(nodes) / np.pi
    above = np.clip(np.searchsorted(knots, nodes), 1, knots.size - 1)
    part = (nodes - knots[above - 1]) / (knots[above] - knots[above - 1])
    np.add.at(out, above - 1, values * (1 - part))
    np.add.at(out, above, values * part)
    return out


def _integrals(
    mi: MitsubaModule,
    coefficients: NDArray[np.float32],
    knots: NDArray[np.float64],
    weights: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Σ_j w_j·ρ(λ_j) of the smooth spectra [jakob2019] of texels [n, 3], for each column of weights: [n, column]."""
    kinds = mi.Float
    c2, c1, c0 = (from_host(kinds, coefficients[:, k]) for k in range(3))
    table = from_host(kinds, np.column_stack([knots, weights]))
    columns, count = weights.shape[1], dr.opaque(mi.UInt32, knots.size)

    def step(number: UInt32, *sums: Float) -> tuple:
        first = number * (columns + 1)
        x = dr.gather(kinds, table, first)
        x = dr.fma(dr.fma(c2, x, c1), x, c0)
        value = dr.fma(0.5 * x, dr.rsqrt(dr.fma(x, x, 1.0)), 0.5)
        added = [dr.fma(value, dr.gather(kinds, table, first + 1 + k), sums[k]) for k in range(columns)]
        return number + 1, *added

    state = mi.UInt32(0), *(dr.zeros(kinds, len(coefficients)) for _ in range(columns))
    _, *sums = dr.while_loop(state, lambda number, *_: number < count, step, label="texels")
    return np.stack([np.array(each) for each in sums], axis=1)
