"""One form for every number of a calibration: value, standard error and interval, or the reason why not."""

from __future__ import annotations

from typing import Any

import numpy as np

#: Half width of a 95 % interval of a normal law, in standard errors.
Z_95 = 1.959963984540054


def estimated(value: float, standard_error: float, unit: str = "") -> dict[str, Any]:
    """A parameter with its 95 % interval; not identifiable where either number is not finite."""
    if not (np.isfinite(value) and np.isfinite(standard_error)):
        return not_identifiable("the estimate is not finite")
    value, standard_error = float(value), float(standard_error)
    return {
        "value": value,
        "standard_error": standard_error,
        "interval_95": [value - Z_95 * standard_error, value + Z_95 * standard_error],
        "unit": unit,
    }


def not_identifiable(reason: str) -> dict[str, Any]:
    """A parameter the data do not tell."""
    return {"value": None, "reason": reason}
