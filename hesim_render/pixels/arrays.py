"""Device parameters that are one number or one value per pixel, and the state of an object as plain values.

Noise terms that can be switched off by name.
"""

from collections.abc import Iterable
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import DeviceArray, Float, UInt32
from hesim_render.core.errors import RangeError
from hesim_render.core.host_arrays import from_host

#: State of an object between two calls, by name: plain values, NumPy arrays, and tuples and states of these.
SavedState: TypeAlias = dict[str, Any]


def to_device(value: float | NDArray) -> Float:
    """Copy a value to the device: a number as an opaque Dr.Jit Float (a new one compiles nothing), an array as a flat
    Float.
    """
    types = jit()
    if np.ndim(value):
        return from_host(types.Float, value)
    return dr.opaque(types.Float, float(value))


def take(value: DeviceArray, index: UInt32) -> DeviceArray:
    """Entries `index` of a device array; a number stays a number."""
    return value if dr.width(value) == 1 else dr.gather(type(value), value, index)


def saved(part: Any) -> SavedState:
    """State of an object between two calls, as plain values and NumPy arrays: the attributes named in its `STATE`."""
    return {name: _off_device(getattr(part, name)) for name in part.STATE}


def restore(part: Any, state: SavedState) -> None:
    """Put the result of `saved` back into an object made from the same parameters."""
    for name in part.STATE:
        own = getattr(part, name)
        if hasattr(own, "STATE"):
            restore(own, state[name])
        else:
            setattr(part, name, _on_device(state[name]))


def _off_device(value: Any) -> Any:
    if hasattr(value, "STATE"):
        return saved(value)
    if isinstance(value, tuple):
        return tuple(_off_device(entry) for entry in value)
    return (type(value), np.array(value)) if dr.is_array_v(value) else value


def _on_device(value: Any) -> Any:
    if isinstance(value, tuple):
        if len(value) == 2 and isinstance(value[1], np.ndarray):
            kind, entries = value
            return from_host(kind, entries)
        return tuple(_on_device(entry) for entry in value)
    return value


def switched_off(already: frozenset[str], terms: Iterable[str], known: tuple[str, ...]) -> frozenset[str]:
    """`already` and `terms` together.

    Raises
    ------
    RangeError
        If a name is not among `known`; the message lists them.
    """
    for term in terms:
        if term not in known:
            raise RangeError("noise term", term, f"one of {', '.join(known)}")
    return already | frozenset(terms)
