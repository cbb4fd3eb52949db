"""Arrays of the host that kernels read, copied to where kernels may read them."""

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.device import dr

#: At least the longest packet of entries that a kernel reads at once, bytes.
_PACKET_BYTES = 256


@cache
def _dtype_of(kind: Any) -> np.dtype:
    return np.dtype(dr.type_v(kind).name.lower())


def from_host(kind: Any, values: ArrayLike) -> Any:
    """Copy an array of the host to the device.

    On the CPU, Dr.Jit would use NumPy's memory in place. Its kernels read whole packets of entries, beyond the end of
    an array whose size is no multiple of a packet: the process dies where the next page of memory does not exist
    (Dr.Jit 1.5). And the place of the array decides how a kernel fetches it, so the kernel would differ in the next
    process, or for the next array. The copy therefore begins at a multiple of a packet and has room for one behind it.

    Parameters
    ----------
    kind : flat type of Dr.Jit, as ``jit().Float``.
    values : of any shape and type; numbers become those of `kind` as by `numpy.ndarray.astype`.

    Returns
    -------
    All values in a row.
    """
    dtype, given = _dtype_of(kind), np.asarray(values)
    if dr.backend_v(kind) != dr.JitBackend.LLVM:
        return kind(np.ascontiguousarray(given, dtype).ravel())
    size = given.size * dtype.itemsize
    room = np.empty(size + 2 * _PACKET_BYTES, np.uint8)
    begin = -room.ctypes.data % _PACKET_BYTES
    own = room[begin : begin + size].view(dtype)
    own.reshape(given.shape)[...] = given
    return kind(own)


def spread_out(kind: Any, values: NDArray, lane: Any) -> Any:
    """Entries of an array of the host, by lane.

    One kernel serves all lengths: an array of one entry would stand for a number that all lanes share.
    """
    return dr.gather(kind, from_host(kind, np.append(values, values[-1:])), lane)
