"""The array functions that a formula may use, so that one implementation serves NumPy and Dr.Jit.

`+`, `-`, `*`, `/` and comparisons are those of the arrays themselves. Formulas that take a `Namespace` are in
`pixels.aps.formulas`, `pixels.evs.formulas` and `spectral.colour_difference`. The simulator calls them with
`device_namespace()`, the calibration with `NUMPY`, for which neither Dr.Jit nor Mitsuba needs to be installed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from hesim_render.core.device_types import Values


@dataclass(frozen=True)
class Namespace:
    """Elementwise functions of one array library.

    Attributes
    ----------
    clip : takes (values, least, most).
    where : takes (mask, values where it is True, values elsewhere).
    arctan2 : takes (y, x).
    """

    sqrt: Callable[[Values], Values]
    log: Callable[[Values], Values]
    exp: Callable[[Values], Values]
    minimum: Callable[[Values, Values], Values]
    maximum: Callable[[Values, Values], Values]
    clip: Callable[[Values, Values, Values], Values]
    where: Callable[[Values, Values, Values], Values]
    sin: Callable[[Values], Values]
    cos: Callable[[Values], Values]
    arctan2: Callable[[Values, Values], Values]
    cbrt: Callable[[Values], Values]


NUMPY = Namespace(
    np.sqrt, np.log, np.exp, np.minimum, np.maximum, np.clip, np.where, np.sin, np.cos, np.arctan2, np.cbrt
)


@cache
def device_namespace() -> Namespace:
    """The functions of Dr.Jit, which is imported here."""
    from hesim_render.core.backend import jit

    jit()  # chooses a backend before Dr.Jit is imported
    import drjit as dr

    return Namespace(
        dr.sqrt, dr.log, dr.exp, dr.minimum, dr.maximum, dr.clip, dr.select, dr.sin, dr.cos, dr.atan2, dr.cbrt
    )
