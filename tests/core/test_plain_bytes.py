"""Plain values as bytes: what comes back is what went in, with its types and bits."""

import json
from pathlib import Path

import numpy as np
import pytest

from hesim_render.core.backend import jit
from hesim_render.core.plain import as_plain, from_bytes, to_bytes

EVENTS = np.array([(2**40, 3, 4, -1)], np.dtype([("t_us", "i8"), ("x", "u2"), ("y", "u2"), ("polarity", "i1")]))
VALUES = [
    None, True, -3, 2**70, 0.1, -0.0, float("inf"), "µ", (), ((1, None), "x"), {}, {"a": {"b": (1.5,)}, "c": 2},
    np.float64(0.1), np.int32(4), np.bool_(True), np.arange(6, dtype=np.float32).reshape(2, 3), np.empty(0, np.uint8),
    np.asfortranarray(np.arange(6.0).reshape(2, 3)), np.array(3.0), np.array([np.nan, -0.0], np.float32), EVENTS,
]  # fmt: skip


def same(one, other):
    assert type(one) is type(other)
    if isinstance(one, tuple):
        assert len(one) == len(other)
        return all(map(same, one, other))
    if isinstance(one, dict):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, np.ndarray | np.generic):
        return one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
    return repr(one) == repr(other)


@pytest.mark.parametrize("value", [*VALUES, tuple(VALUES)], ids=lambda value: repr(value)[:30])
def test_what_comes_back_is_what_went_in(value):
    assert same(from_bytes(to_bytes(value)), value)


def test_arrays_can_be_written_to():
    found = from_bytes(to_bytes({"sum": np.zeros(3)}))
    found["sum"] += 1
    assert found["sum"].sum() == 3


def test_types_of_arrays_are_those_of_the_backend():
    types = jit()
    assert from_bytes(to_bytes((types.Float, types.UInt32, types.Float64))) == (
        types.Float,
        types.UInt32,
        types.Float64,
    )


@pytest.mark.parametrize(
    "value", [object(), [1], {1, 2}, np.array([object()])], ids=["an object", "a list", "a set", "objects"]
)
def test_other_values_are_refused(value):
    with pytest.raises(TypeError):
        to_bytes(value)


@pytest.mark.parametrize("name", ["__loader__", "__class__", "Nothing"])
def test_bytes_name_no_other_type_than_those_of_arrays(name):
    with pytest.raises(TypeError, match=name):
        from_bytes(to_bytes(type(name, (), {})))


def test_values_for_files_keep_every_bit_and_have_no_number_that_json_lacks():
    given = {"a": (1 / 3, np.float32(0.1)), "b": [np.inf, -np.nan], 3: Path("x") / "y", "c": np.array([2, 5], np.uint8)}
    expected = {"a": [1 / 3, 0.10000000149011612], "b": [None, None], 3: "x/y", "c": [2, 5]}
    assert as_plain(given) == expected and json.loads(json.dumps(as_plain(given)["a"])) == expected["a"]
    assert as_plain(np.pi, 5) == 3.1416 and as_plain(np.True_) is True and as_plain({np.str_("k"): None}) == {"k": None}
