"""Colorimetry for pictures: tristimulus values, linear sRGB, CIELAB and the colour difference ΔE2000.

CIELAB and the difference are written once for NumPy and Dr.Jit. Studies fit matrices with thousands of calls on a few
colours, and judge millions of pixels: colour-science, with which tests compare these functions, takes ten times as long
for both.
"""

import functools
from collections.abc import Sequence
from math import pi
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.device_types import NUMPY, Namespace, Values
from hesim_render.spectral.spectrum import Spectrum, colour_matching_functions
from hesim_render.spectral.transfer import encode_exactly

#: XYZ (D65 white, Y = 1) to linear sRGB, IEC 61966-2-1:1999.
_XYZ_TO_SRGB = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
#: Sharpened cone responses of the Bradford adaptation ([lam1985], as in ICC.1).
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])


#: Grid of the sums below, fine enough for pictures (radiometry integrates in `spectrum`).
_GRID_NM = np.arange(360.0, 831.0, 1.0)
#: L*, a* and b*, or X, Y and Z.
Triple: TypeAlias = tuple[Values, Values, Values]
#: Ratio to white below which CIELAB is linear (CIE 15).
_LINEAR_BELOW = (24 / 116) ** 3
_DEGREE = pi / 180


def responses_to(
    light: Spectrum, surfaces: Sequence[Spectrum], sensitivities: Sequence[Spectrum]
) -> NDArray[np.float64]:
    """∫ sensitivity · light · surface dλ, [surface, sensitivity], by sums at 1 nm over 360-830 nm."""
    seen = np.array([surface.at(_GRID_NM) for surface in surfaces]) * light.at(_GRID_NM)
    return seen @ np.array([sensitivity.at(_GRID_NM) for sensitivity in sensitivities]).T


@functools.cache
def _observer() -> tuple[Spectrum, Spectrum, Spectrum]:
    return colour_matching_functions()


def tristimulus(light: Spectrum, surfaces: Sequence[Spectrum]) -> NDArray[np.float64]:
    """CIE 1931 XYZ of surfaces under a light, [surface, 3], in units of the light's power × nm."""
    return responses_to(light, surfaces, _observer())


def xyz_to_linear_srgb(xyz: ArrayLike, white_xyz: ArrayLike) -> NDArray[np.float64]:
    """Linear sRGB of XYZ values under a light with the white `white_xyz`, which becomes (1, 1, 1).

    Bradford adaptation to the white of the sRGB matrix itself, Y = 1 for white.
    """
    white = _BRADFORD @ (np.asarray(white_xyz) / np.asarray(white_xyz)[1])
    srgb_white = np.linalg.solve(_XYZ_TO_SRGB, np.ones(3))
    adapt = np.linalg.solve(_BRADFORD, (_BRADFORD @ srgb_white / white)[:, None] * _BRADFORD)
    return np.asarray(xyz) / np.asarray(white_xyz)[1] @ (_XYZ_TO_SRGB @ adapt).T


def encode_srgb(linear: ArrayLike) -> NDArray[np.uint8]:
    """8-bit sRGB of linear values (clipped to [0, 1]), IEC 61966-2-1."""
    # a table over the square root resolves dark tones finely and beats a power per pixel
    steps = np.sqrt(np.clip(np.nan_to_num(linear), 0.0, 1.0)) * (_SRGB_TABLE.size - 1)
    return _SRGB_TABLE[(steps + 0.5).astype(np.uint16)]


#: Codes of sRGB, 8 bits, at even steps of the square root of the linear value.
_SRGB_TABLE = np.rint(255 * encode_exactly(np.linspace(0.0, 1.0, 4096) ** 2, "srgb")).astype(np.uint8)


def lab_of(ratios: Triple, xp: Namespace = NUMPY) -> Triple:
    """CIELAB (CIE 15) of X, Y and Z over those of white.

    Parameters
    ----------
    ratios : X/X_n, Y/Y_n, Z/Z_n, arrays of one library.
    xp : its functions.
    """

    def curve(ratio: Values) -> Values:
        above = xp.cbrt(xp.maximum(ratio, _LINEAR_BELOW))
        return xp.where(ratio > _LINEAR_BELOW, above, ratio * (841 / 108) + 16 / 116)

    x, y, z = (curve(ratio) for ratio in ratios)
    return 116 * y - 16, 500 * (x - y), 200 * (y - z)


def delta_e_2000_of(first: Triple, second: Triple, xp: Namespace = NUMPY) -> Values:
    """ΔE2000 (CIE 142-2001) with all parametric factors at 1.

    Parameters
    ----------
    first, second : L*, a*, b* of the colours, arrays of one library.
    xp : its functions.
    """
    (l1, a1, b1), (l2, a2, b2) = first, second
    mean_chroma = (xp.sqrt(a1 * a1 + b1 * b1) + xp.sqrt(a2 * a2 + b2 * b2)) / 2
    stretch = 1.5 - 0.5 * _saturating(mean_chroma, xp)
    a1, a2 = a1 * stretch, a2 * stretch
    c1, c2 = xp.sqrt(a1 * a1 + b1 * b1), xp.sqrt(a2 * a2 + b2 * b2)
    h1, h2 = _hue(a1, b1, xp), _hue(a2, b2, xp)
    turn = h2 - h1
    turn = xp.where(turn > pi, turn - 2 * pi, xp.where(turn < -pi, turn + 2 * pi, turn))
    is_grey = c1 * c2 == 0
    # the middle of the shorter way between the hues; a grey has no hue, and the other one's counts
    hue = xp.where(is_grey, h1 + h2, h1 + turn / 2)
    hue = xp.where(hue < 0, hue + 2 * pi, xp.where(hue >= 2 * pi, hue - 2 * pi, hue))
    lightness, chroma = (l1 + l2) / 2, (c1 + c2) / 2
    delta_hue = xp.where(is_grey, 0.0, 2 * xp.sqrt(c1 * c2) * xp.sin(turn / 2))
    shape = (
        1
        - 0.17 * xp.cos(hue - 30 * _DEGREE)
        + 0.24 * xp.cos(2 * hue)
        + 0.32 * xp.cos(3 * hue + 6 * _DEGREE)
        - 0.20 * xp.cos(4 * hue - 63 * _DEGREE)
    )
    square = (lightness - 50) * (lightness - 50)
    off = (hue / _DEGREE - 275) / 25
    rotation = -2 * _saturating(chroma, xp) * xp.sin(60 * _DEGREE * xp.exp(-off * off))
    by_lightness = (l2 - l1) / (1 + 0.015 * square / xp.sqrt(20 + square))
    by_chroma = (c2 - c1) / (1 + 0.045 * chroma)
    by_hue = delta_hue / (1 + 0.015 * chroma * shape)
    total = by_lightness * by_lightness + by_chroma * by_chroma + by_hue * by_hue + rotation * by_chroma * by_hue
    return xp.sqrt(xp.maximum(total, 0.0))


def _saturating(chroma: Values, xp: Namespace) -> Values:
    """√(C⁷/(C⁷ + 25⁷))."""
    ratio = chroma / 25
    square = ratio * ratio
    seventh = square * square * square * ratio
    return xp.sqrt(seventh / (seventh + 1))


def _hue(a: Values, b: Values, xp: Namespace) -> Values:
    """Hue angle from 0 to 2π; 0 for greys."""
    angle = xp.arctan2(b, a)
    return xp.where(angle < 0, angle + 2 * pi, angle)


def lab(xyz: ArrayLike, white_xyz: ArrayLike) -> NDArray[np.float64]:
    """CIELAB (CIE 15) of XYZ values [..., 3] under a white."""
    ratios = np.asarray(xyz, dtype=np.float64) / np.asarray(white_xyz, dtype=np.float64)
    return np.stack(lab_of((ratios[..., 0], ratios[..., 1], ratios[..., 2])), axis=-1)


def delta_e_ab(lab_a: ArrayLike, lab_b: ArrayLike) -> NDArray[np.float64]:
    """ΔE*ab (CIE 1976) between CIELAB values [..., 3]."""
    return np.linalg.norm(np.asarray(lab_a) - np.asarray(lab_b), axis=-1)


def delta_e_2000(lab_a: ArrayLike, lab_b: ArrayLike) -> NDArray[np.float64]:
    """ΔE2000 (CIE 142-2001) between CIELAB values [..., 3]."""
    first, second = (np.moveaxis(np.asarray(each, dtype=np.float64), -1, 0) for each in (lab_a, lab_b))
    return np.asarray(delta_e_2000_of(tuple(first), tuple(second)))
