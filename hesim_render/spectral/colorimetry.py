"""Colorimetry for pictures: tristimulus values and linear sRGB."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.spectral.spectrum import Spectrum, colour_matching_functions
from hesim_render.spectral.transfer import encode_exactly

#: XYZ (D65 white, Y = 1) to linear sRGB, IEC 61966-2-1:1999.
_XYZ_TO_SRGB = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
#: Sharpened cone responses of the Bradford adaptation ([lam1985], as in ICC.1).
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])


#: Grid of the sums below, fine enough for pictures (radiometry integrates in `spectrum`).
_GRID_NM = np.arange(360.0, 831.0, 1.0)


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


def _srgb_table() -> NDArray[np.uint8]:
    return np.rint(255 * encode_exactly(np.linspace(0.0, 1.0, 4096) ** 2, "srgb")).astype(np.uint8)


_SRGB_TABLE = _srgb_table()
