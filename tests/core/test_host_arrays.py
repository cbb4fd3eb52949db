"""Arrays of the host: every value arrives, and kernels read nothing but what is there."""

import ast
import subprocess
import sys
from pathlib import Path

import drjit as dr
import numpy as np
import pytest

import hesim_render
from hesim_render.core.backend import jit
from hesim_render.core.host_arrays import from_host, spread_out

PACKAGE = Path(hesim_render.__file__).parent
KINDS = ["Float", "Float64", "UInt32", "Int32", "UInt64", "Bool", "Int8", "UInt8"]

# Memory that ends where a page begins that may not be read, and a kernel that reads a number in order. With "direct",
# Dr.Jit gets the memory itself.
GUARDED = """
import ctypes, mmap, resource, sys
import numpy as np
from hesim_render.core import host_arrays
from hesim_render.core.backend import jit
from hesim_render.core.device import dr
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
kind, count = getattr(jit(), sys.argv[2]), int(sys.argv[3])
page, kept = mmap.PAGESIZE, []
def guarded(size, dtype):
    size *= np.dtype(dtype).itemsize
    pages = mmap.mmap(-1, 3 * page)
    whole = np.frombuffer(pages, np.uint8)
    kept.append((pages, whole))
    ctypes.CDLL(None).mprotect(ctypes.c_void_p(whole.ctypes.data + 2 * page), page, 0)
    return whole[2 * page - size : 2 * page].view(dtype)
class Guarded:
    empty = staticmethod(guarded)
    def __getattr__(self, name):
        return getattr(np, name)
numbers = np.arange(count) % 2 + 1
if sys.argv[1] == "direct":
    own = guarded(count, host_arrays._dtype_of(kind))
    own[...] = numbers
    values = kind(own)
else:
    host_arrays.np = Guarded()
    values = host_arrays.from_host(kind, numbers)
    assert len(kept) == 1
twice = values + values
dr.eval(twice)
np.testing.assert_array_equal(np.array(twice), 2 * numbers)
print("read")
"""


@pytest.mark.parametrize("name", KINDS)
def test_every_value_arrives_in_order_as_astype_casts_it(name):
    kind = getattr(jit(), name)
    values = np.random.default_rng(4).uniform(1.3, 99.7, (7, 3))
    for given in (values, values.T, values[::2, 1:], values[0, 0], values[:0], np.asfortranarray(values), [[2, 0, 5]]):
        result = from_host(kind, given)
        assert type(result) is kind
        expected = np.asarray(given).astype(np.array(dr.zeros(kind, 2)).dtype).ravel()
        np.testing.assert_array_equal(np.array(result), expected)


def test_what_is_written_later_does_not_show():
    """The array of the caller may be used again."""
    values = np.arange(3.0, 24, dtype=np.float32)
    on_device = from_host(jit().Float, values)
    values[:] = 0
    np.testing.assert_array_equal(np.array(on_device + 0.5), np.arange(3.5, 24))


def test_entries_by_lane():
    lane = from_host(jit().UInt32, [2, 0, 1, 2, 2])
    np.testing.assert_array_equal(
        np.array(spread_out(jit().Float, np.array([5.0, 7, 11.5]), lane)), [11.5, 5, 7, 11.5, 11.5]
    )
    np.testing.assert_array_equal(np.array(spread_out(jit().Float, np.array([3.5]), lane * 0)), [3.5] * 5)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="pages are guarded by Linux' mprotect")
@pytest.mark.parametrize(("name", "count"), [("Float64", 5), ("Float", 17), ("UInt32", 3), ("Int8", 21)])
def test_kernels_read_nothing_behind_the_end(name, count):
    def run(way):
        command = [sys.executable, "-c", GUARDED, way, name, str(count)]
        return subprocess.run(command, capture_output=True, text=True, timeout=120)

    result = run("copied")
    assert (result.returncode, result.stdout) == (0, "read\n"), result.stderr
    # what Dr.Jit 1.5 does with the memory itself is why there is a copy
    if name == "Float64" and dr.__version__.startswith("1.5") and "llvm" in jit().__name__:
        assert run("direct").returncode < 0


def test_one_kernel_serves_arrays_at_any_place():
    if "llvm" not in jit().__name__:
        pytest.skip("arrays are copied to the GPU")
    room, places = np.arange(400.0, dtype=np.float32), set()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        hashes = set()
        for first in range(7):
            values = room[first : first + 37]
            places.add(values.ctypes.data % 64)
            dr.kernel_history_clear()
            on_device = from_host(jit().Float, values)
            dr.eval(on_device * dr.opaque(jit().Float, 1.25))
            hashes |= {entry["hash"] for entry in dr.kernel_history() if "hash" in entry}
    assert len(places) == 7 and len(hashes) == 1


def test_no_array_of_numpy_is_given_to_dr_jit_as_it_is():
    """As far as the text shows: numbers that a call of NumPy makes, or that one of its methods does."""
    offenders = []
    for file in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text())):
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in KINDS):
                continue
            owner = node.func.value
            if not (isinstance(owner, ast.Call) or (isinstance(owner, ast.Name) and owner.id in ("types", "mi"))):
                continue
            inner = [part for argument in node.args for part in ast.walk(argument)]
            calls = [part.func for part in inner if isinstance(part, ast.Call) and isinstance(part.func, ast.Attribute)]
            by_numpy = [call for call in calls if isinstance(call.value, ast.Name) and call.value.id == "np"]
            if by_numpy or any(call.attr in ("astype", "ravel", "reshape", "flatten") for call in calls):
                offenders.append(f"{file.relative_to(PACKAGE)}:{node.lineno}")
    assert offenders == []
