"""Tables that kernels read: kept where they are in memory, they would compile kernels anew."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def table(kind: Any, values: ArrayLike) -> Any:
    """Numbers on the device, one after the other.

    Dr.Jit takes an array of the host where it is. Whether it is aligned there decides how a kernel fetches four numbers
    at a time, so that the same kernel would be another one in the next process, or for the next array.
    """
    import drjit as dr

    host = kind(np.ravel(values))
    index = dr.opaque(dr.uint32_array_t(kind), 0) + dr.arange(dr.uint32_array_t(kind), len(host))
    found = dr.gather(kind, host, index)
    dr.eval(found)
    return found


def spread_out(kind: Any, table: NDArray, lane: Any) -> Any:
    """Entries of a table on the host, by lane.

    One kernel serves all lengths and places in memory: a table of one entry would be a constant in it, and one that
    is read in order may be aligned or not. Both compile anew.
    """
    import drjit as dr

    return dr.gather(kind, kind(np.append(table, table[-1:])), lane)
