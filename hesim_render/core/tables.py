"""Tables that kernels read, copied so that their place in memory does not make Dr.Jit compile kernels again."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.device import dr


def table(kind: Any, values: ArrayLike) -> Any:
    """Numbers on the device, in one contiguous copy.

    Dr.Jit would use an array of the host in place. Its alignment there decides how a kernel fetches four numbers
    at a time, so the kernel would differ in the next process, or for the next array.
    """
    host = kind(np.ravel(values))
    index = dr.opaque(dr.uint32_array_t(kind), 0) + dr.arange(dr.uint32_array_t(kind), len(host))
    result = dr.gather(kind, host, index)
    dr.eval(result)
    return result


def spread_out(kind: Any, table: NDArray, lane: Any) -> Any:
    """Entries of a host table, by lane.

    One kernel serves all lengths and places in memory. Without this, a table of one entry would be a constant in the
    kernel, and a table that is read in order might be aligned or not; both would compile again.
    """
    return dr.gather(kind, kind(np.append(table, table[-1:])), lane)
