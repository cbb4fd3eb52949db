"""Standard normal deviates from raw 32-bit random words."""

from __future__ import annotations

import math

from hesim_render.core.backend import jit
from hesim_render.core.device_types import Float, UInt32


def normal_pair(radius_word: UInt32, angle_word: UInt32) -> tuple[Float, Float]:
    """Two independent N(0, 1) deviates from two UInt32 words [box1958].

    Dr.Jit's own normal generator uses 23 bits for the radius, which makes its tail coarse beyond 5 standard deviations.
    Event thresholds lie there. All 32 bits are used here. The radius word is mapped to the open interval (0, 1), where
    floats are densest at 0: the tail ends at 6.66.

    Parameters
    ----------
    radius_word, angle_word : UInt32, random words.

    Returns
    -------
    first, second : Float, as many as there are words. An unused one costs nothing.
    """
    import drjit as dr

    types = jit()
    uniform = dr.fma(types.Float(radius_word), 2.0**-32, 2.0**-33)
    sine, cosine = dr.sincos(types.Float(angle_word) * (math.tau * 2.0**-32))
    radius = dr.sqrt(-2.0 * dr.log(uniform))
    return radius * cosine, radius * sine
