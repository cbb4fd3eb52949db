"""Textures by seed: pictures of reflectance between two values."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hesim_render.spectral.transfer import encode_exactly
from hesim_render.targets.leaves import leaves_picture

#: Side of a texture, texels.
SIDE = 256
_CELLS = (12, 160)


def _grid() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    y, x = np.mgrid[:SIDE, :SIDE] / SIDE
    return x, y


def _leaves(rng: np.random.Generator) -> NDArray[np.float64]:
    """Discs that cover each other, as in natural pictures [cao2010]."""
    return leaves_picture(SIDE, SIDE, 3.0, 90.0, (0.0, 1.0), int(rng.integers(2**31))).astype(np.float64)


def _noise(rng: np.random.Generator) -> NDArray[np.float64]:
    """Noise whose amplitude falls as a power of the frequency."""
    frequency = np.hypot(np.fft.fftfreq(SIDE)[:, None], np.fft.fftfreq(SIDE)[None, :]) * SIDE
    frequency[0, 0] = 1.0
    amplitude = frequency ** -rng.uniform(0.6, 2.0)
    field = np.fft.ifft2(np.fft.fft2(rng.normal(size=(SIDE, SIDE))) * amplitude).real
    low, high = np.percentile(field, [1, 99])
    return np.clip((field - low) / (high - low), 0, 1)


def _stripes(rng: np.random.Generator) -> NDArray[np.float64]:
    """A grating of whole periods, from soft to hard."""
    x, y = _grid()
    periods = rng.integers(-24, 25, 2)
    if not periods.any():
        periods = np.array([8, 0])
    wave = np.sin(2 * np.pi * (periods[0] * x + periods[1] * y + rng.random()))
    return 0.5 + 0.5 * np.tanh(wave * 10 ** rng.uniform(-0.3, 1)) / np.tanh(10.0)


def _checks(rng: np.random.Generator) -> NDArray[np.float64]:
    """Squares of two values."""
    x, y = _grid()
    count = rng.integers(2, 24, 2)
    return ((np.floor(x * count[0]) + np.floor(y * count[1])) % 2).astype(np.float64)


def _cells(rng: np.random.Generator) -> NDArray[np.float64]:
    """Voronoi cells of random values, periodic."""
    from scipy.spatial import cKDTree

    points = rng.random((int(rng.integers(*_CELLS)), 2))
    x, y = _grid()
    _, nearest = cKDTree(points, boxsize=1.0).query(np.stack([x.ravel(), y.ravel()], axis=-1))
    return rng.random(len(points))[nearest].reshape(SIDE, SIDE)


KINDS: dict[str, Callable[[np.random.Generator], NDArray[np.float64]]] = {
    "leaves": _leaves,
    "noise": _noise,
    "stripes": _stripes,
    "checks": _checks,
    "cells": _cells,
}


def texture(rng: np.random.Generator, low: float, high: float) -> NDArray[np.uint8]:
    """A picture of a random kind.

    Parameters
    ----------
    rng : random numbers.
    low, high : its smallest and largest reflectance.

    Returns
    -------
    [row, col, 3], sRGB. The two ends of its scale have slightly different colours, the more the larger their ratio.
    """
    kind = list(KINDS)[int(rng.integers(len(KINDS)))]
    value = KINDS[kind](rng)
    contrast = (high - low) / (high + low)
    ends = np.array([low, high])[:, None] * (1 + 0.5 * contrast * rng.uniform(-1, 1, (2, 3)))
    linear = ends[0] + value[..., None] * (ends[1] - ends[0])
    return np.rint(255 * encode_exactly(np.clip(linear, 0, 0.98))).astype(np.uint8)
