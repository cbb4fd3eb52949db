"""Plain values: dataclasses without their cached values, content of JSON files, and bytes.

Plain values, NumPy arrays and types of Dr.Jit arrays become bytes and come back; nothing in the bytes is ever executed.
"""

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import fields
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.errors import RangeError

#: Length of the JSON text that comes first; the data of the arrays follow it in order.
_LENGTH = struct.Struct("<Q")


class PlainState:
    """Base of a dataclass whose cached properties are left out of pickles and copies.

    They are computed again on first use. Cached values may be large, or arrays on a device. Unpickling these would load
    Dr.Jit before `hesim_render.core.backend` has chosen a library for it.
    """

    def __getstate__(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]


def settle_numbers(record: Any, numbers: Sequence[str]) -> None:
    """Make NumPy's numbers in the fields of a dataclass, also a frozen one, those of Python, which files take.

    Parameters
    ----------
    record : the dataclass.
    numbers : names of fields that hold a number or None.

    Raises
    ------
    RangeError
        If one of these holds something else.
    """
    for field in fields(record):
        value = getattr(record, field.name)
        if isinstance(value, np.generic):
            value = value.item()
            object.__setattr__(record, field.name, value)
        if field.name in numbers and value is not None and not isinstance(value, Real):
            raise RangeError(field.name, value, "a number")


def require_list(name: str, value: object) -> None:
    """Refuse a text in place of a list of texts, whose letters would be taken for these."""
    if isinstance(value, str):
        raise RangeError(name, value, f"a list: [{value!r}]")


def as_plain(value: Any, digits: int = 17) -> Any:
    """A value as JSON and YAML files hold it: NumPy's numbers and arrays as Python's, paths as text, null for a number
    that is not finite.

    Parameters
    ----------
    value : numbers, texts and paths, in mappings, lists, tuples and arrays.
    digits : significant ones of floats; 17 keep every bit.
    """
    if isinstance(value, Mapping):
        return {key if isinstance(key, int) else str(key): as_plain(item, digits) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [as_plain(item, digits) for item in value]
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(f"{value:.{digits}g}") if np.isfinite(value) else None
    return value


def to_bytes(value: Any) -> bytes:
    """Bytes of a value: None, truth values, numbers, text, types of Dr.Jit arrays, NumPy arrays and scalars, and tuples
    and dictionaries of these.

    Parameters
    ----------
    value : the value; keys of dictionaries are text.

    Raises
    ------
    TypeError
        If there is something else in it.
    """
    arrays: list[NDArray] = []
    text = json.dumps(_outline(value, arrays)).encode()
    return b"".join([_LENGTH.pack(len(text)), text, *(array.tobytes() for array in arrays)])


def from_bytes(data: bytes) -> Any:
    """The value that `to_bytes` was given; its arrays may be written to."""
    (length,) = _LENGTH.unpack_from(data)
    begin = _LENGTH.size + length
    value, _ = _filled(json.loads(data[_LENGTH.size : begin]), data, begin)
    return value


def _outline(value: Any, arrays: list[NDArray]) -> Any:
    """The value with an object of one key in place of each part that JSON does not tell apart."""
    if isinstance(value, np.ndarray | np.generic):  # first, as a float64 of NumPy is a float of Python as well
        if value.dtype.hasobject:
            raise TypeError("no plain value: an array of objects")
        arrays.append(np.asarray(value))
        kind = np.lib.format.dtype_to_descr(value.dtype)
        return {"array": [kind, list(value.shape), isinstance(value, np.generic)]}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, type):
        return {"type": value.__name__}
    if isinstance(value, tuple):
        return {"tuple": [_outline(entry, arrays) for entry in value]}
    if isinstance(value, dict):
        return {"dict": [[key, _outline(entry, arrays)] for key, entry in value.items()]}
    raise TypeError(f"no plain value: {type(value).__name__}")


def _filled(outline: Any, data: bytes, begin: int) -> tuple[Any, int]:
    """The value of an outline, and the end of its data."""
    if not isinstance(outline, dict):
        return outline, begin
    ((kind, given),) = outline.items()
    if kind == "type":
        result = getattr(jit(), given, None)
        if not dr.is_array_v(result):  # the bytes may name anything
            raise TypeError(f"no type of Dr.Jit arrays: {given!r}")
        return result, begin
    if kind == "array":
        descr, shape, is_scalar = given
        dtype = np.dtype(descr if isinstance(descr, str) else [tuple(field) for field in descr])
        count = int(np.prod(shape, dtype=np.int64))
        array = np.frombuffer(data, dtype, count, begin).reshape(shape).copy()
        return (array[()] if is_scalar else array), begin + array.nbytes
    entries = []
    for entry in given if kind == "tuple" else [entry for _, entry in given]:
        result, begin = _filled(entry, data, begin)
        entries.append(result)
    if kind == "tuple":
        return tuple(entries), begin
    return dict(zip([key for key, _ in given], entries, strict=True)), begin
