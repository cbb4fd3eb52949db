"""Bandwidth of the noise of asynchronous event pixels where it differs from pixel to pixel.

With f_c the ``photoreceptor_cutoff_hz``, z a normal deviate of the pixel, r and c of `NoiseSpreadSpec`::

    f = f_c · exp(bandwidth_rel · z) · (1 ± r)(1 ± c)

with plus in odd rows and columns of the event grid of the full sensor. The noise keeps its variance.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.rng import Stream, device_normal
from hesim_render.pixels.evs.model import EvsNoise


def most_bandwidth(noise: EvsNoise) -> float:
    """Largest bandwidth of a pixel's noise over photoreceptor_cutoff_hz."""
    spread = noise.spec.noise_spread
    return 1.0 if spread is None or "mismatch" in noise.off else spread.most


def bandwidth_map(noise: EvsNoise) -> NDArray[np.float32] | None:
    """Bandwidth of each event pixel's noise over photoreceptor_cutoff_hz, row-major; None where all are alike."""
    spread, layout = noise.spec.noise_spread, noise.layout
    if spread is None or "mismatch" in noise.off:
        return None
    index = layout.full_index.ravel()[layout.evs_pixel.ravel()]
    places = np.divmod(index.astype(np.int64), layout.spec.geometry.cols)
    factor = np.exp(spread.bandwidth_rel * device_normal(noise.device_seed, Stream.NOISE_SPREAD, index))
    for axis, part in enumerate((spread.odd_rows_rel, spread.odd_cols_rel)):
        # row, or column, of the event grid of the full sensor
        size = layout.tile_shape[axis]
        inside = np.unique([position[axis] for position in layout.spec.positions("evs")])
        line = places[axis] // size * inside.size + np.searchsorted(inside, places[axis] % size)
        factor = factor * (1 + part * (2 * (line % 2) - 1))
    return np.minimum(factor, spread.most).astype(np.float32)
