"""Parameters that are one number, or one value per pixel, on the device."""

from __future__ import annotations

from typing import Any

import numpy as np

from hesim_render.backend import jit


def to_device(value: Any) -> Any:
    """A number as an opaque Dr.Jit Float (a new one compiles nothing), an array as a flat Float."""
    import drjit as dr

    types = jit()
    if np.ndim(value):
        return types.Float(np.ascontiguousarray(value, dtype=np.float32).ravel())
    return dr.opaque(types.Float, float(value))


def take(value: Any, index: Any) -> Any:
    """Entries `index` of a device array; a number stays a number."""
    import drjit as dr

    return value if dr.width(value) == 1 else dr.gather(type(value), value, index)
