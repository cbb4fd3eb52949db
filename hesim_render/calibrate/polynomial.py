"""The variance polynomial β of the paper: temporal variance against signal and exposure."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def polynomial(beta: NDArray, signal_dn: NDArray, exposure_s: NDArray | float) -> NDArray:
    """Temporal variance in DN² without the ADC's; `beta` has the six terms on its last axis."""
    b = np.moveaxis(np.asarray(beta), -1, 0)
    return b[0] + b[2] * exposure_s + b[5] * exposure_s**2 + signal_dn * (b[1] + b[4] * exposure_s + b[3] * signal_dn)
