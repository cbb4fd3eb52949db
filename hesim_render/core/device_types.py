"""Names for the types of values on the device, for annotations.

The types themselves come from `hesim_render.core.backend.jit` at run time: of the LLVM or of the CUDA backend, which is
known only after a library was probed. To a type checker these names are therefore `Any`. They tell a reader the kind
of an array's entries, which Dr.Jit checks. All arrays are flat; a docstring names the index of the entries
(``[pixel]``, ``[ray]``). An array of one entry stands for a number that all entries share.

A `Namespace` has the array functions that a formula may use, so that one implementation serves NumPy and Dr.Jit.
`+`, `-`, `*`, `/` and comparisons are those of the arrays themselves. Formulas that take a `Namespace` are in
`pixels.aps.formulas`, `pixels.evs.formulas` and `spectral.colorimetry`. The simulator calls them with
`device_namespace()`, the calibration with `NUMPY`, for which neither Dr.Jit nor Mitsuba needs to be installed.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeAlias

import numpy as np

#: Array of 32-bit floats.
Float: TypeAlias = Any
#: Array of 64-bit floats.
Float64: TypeAlias = Any
#: Array of unsigned whole numbers of 32 bits: indices, DN, random words, seeds of rays.
UInt32: TypeAlias = Any
#: Array of unsigned whole numbers of 64 bits: keys of generators.
UInt64: TypeAlias = Any
#: Array of booleans: True for entries that take part.
Mask: TypeAlias = Any
#: Two or three Floats: a position on the sensor; a position, direction or normal in space; a colour.
Point2: TypeAlias = Any
Point3: TypeAlias = Any
Vector3: TypeAlias = Any
#: An array of a kind that the caller chooses.
DeviceArray: TypeAlias = Any
#: A counter-based generator of random words, ``Philox4x32``.
Generator: TypeAlias = Any
#: A number, a NumPy array, or an array on the device: what a formula takes.
Values: TypeAlias = Any

#: Both halves of an estimate, from independent rays: their mean is the value, half their difference its error.
Halves: TypeAlias = tuple[Float, Float]
#: State of a symbolic loop or branch.
LoopState: TypeAlias = tuple[Any, ...]

# Of Mitsuba, which only `sources.render` imports:

#: The module of the variant in use.
MitsubaModule: TypeAlias = Any
#: A scene, shape, emitter, surface, integrator, or their parameters.
MitsubaObject: TypeAlias = Any
#: ``Ray3f``: origin, direction, ``maxt``, wavelengths; one ray a lane.
Ray: TypeAlias = Any
#: ``Interaction3f``, ``SurfaceInteraction3f`` or ``PreliminaryIntersection3f``: hit points of rays.
Interaction: TypeAlias = Any
#: One Float for each of the four wavelengths of a ray.
Bands: TypeAlias = Any


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
