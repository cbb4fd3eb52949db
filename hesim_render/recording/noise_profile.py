"""The noise of a sensor's frames in the two numbers that DNG has for it (tag NoiseProfile)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from hesim_render.sensor.sensor import Sensor

#: Signals between black and white at which the variance is fitted.
_SIGNALS = 65


def noise_profile(sensor: Sensor, without: Sequence[str] = ()) -> tuple[float, float] | None:
    """S and O of the temporal variance S·x + O of a pixel, where x is 0 at the black level and 1 at the white level.

    The law of the frame noise is fitted by least squares, each signal relative to its own variance, so that dark and
    light count alike. Light alone gives S = gain / (white - black), exactly. Rounding to whole DN is in it; fixed
    patterns are not.

    Parameters
    ----------
    sensor : the sensor, with the exposure of its file.
    without : names of noise terms that are switched off, such as ``aps.read``.

    Returns
    -------
    S and O, without unit; None where there are no frames, or no noise but rounding.
    """
    aps = sensor.spec.aps
    if aps is None:
        return None
    model = sensor.aps.without(*[name[4:] for name in without if name.startswith("aps.")])
    white = min(2**aps.bit_depth - 1, round(aps.black_level_dn + aps.system_gain_dn_per_e * aps.full_well_e))
    span = white - aps.black_level_dn
    x = np.linspace(0.0, 1.0, _SIGNALS)
    electrons = x * span / aps.system_gain_dn_per_e
    variance = np.array([float(model.variance_dn2(float(e), aps.exposure_us, adc=True)) for e in electrons]) / span**2
    (slope, offset), *_ = np.linalg.lstsq(np.stack([x, np.ones_like(x)], 1) / variance[:, None], np.ones(_SIGNALS),
                                          rcond=None)  # fmt: skip
    return (_rounded(slope), _rounded(offset)) if slope > 0 and offset > 0 else None


def _rounded(value: float) -> float:
    """Six significant digits: the last ones of a fit depend on the build of NumPy, and with them the bytes of files."""
    return float(f"{value:.6g}")
