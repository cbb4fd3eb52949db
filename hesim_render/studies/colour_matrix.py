"""Matrices that a study uses besides the best one: to sRGB, and against noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.spectral.colorimetry import xyz_to_linear_srgb
from hesim_render.studies.colour_noise import ChannelNoise
from hesim_render.studies.colour_samples import ColourSamples


def to_srgb(matrix: ArrayLike, white_xyz: ArrayLike) -> NDArray[np.float64]:
    """A matrix to linear sRGB in place of XYZ; the white of the light becomes (1, 1, 1) (Bradford).

    Parameters
    ----------
    matrix : [3, channel], to XYZ.
    white_xyz : [3].
    """
    return xyz_to_linear_srgb(np.asarray(matrix).T, white_xyz).T


def noise_aware_matrix(samples: ColourSamples, white_e: ArrayLike, noise: ChannelNoise) -> NDArray[np.float64]:
    """The matrix to XYZ with the least squared error over surfaces, noise included (Wiener's filter).

    M = (Σ x cᵀ)(Σ c cᵀ + Σ diag Var c)⁻¹ over the surfaces: it gives up colour where noise would cost more. Its second
    row is the best estimate of the luminance, also of cameras that see no colour.

    Parameters
    ----------
    samples : the surfaces.
    white_e : [channel], electrons of one pixel on a perfect white.
    noise : of the channels.

    Returns
    -------
    [3, channel].
    """
    white = np.asarray(white_e, dtype=np.float64)
    variance = noise.variance_e2(np.maximum(samples.camera, 0) * white) / white**2
    normal = samples.camera.T @ samples.camera + np.diag(variance.sum(axis=0))
    return np.asarray(np.linalg.solve(normal, samples.camera.T @ samples.xyz).T, dtype=np.float64)
