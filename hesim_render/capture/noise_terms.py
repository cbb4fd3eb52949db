"""Noise models of a run: those of the sensor, with terms switched off by name."""

from __future__ import annotations

from collections.abc import Sequence

from hesim_render.core.errors import RangeError, did_you_mean
from hesim_render.pixels.aps.model import APS_TERMS, ApsNoise
from hesim_render.pixels.evs.model import EVS_TERMS, EvsNoise
from hesim_render.sensor.sensor import Sensor
from hesim_render.specs.lens import LENS_TERMS

#: Models of frame pixels and of event pixels; None for the kind that a sensor lacks.
Noise = tuple[ApsNoise | None, EvsNoise | None]
#: Names of all noise terms that can be switched off.
NOISE_TERMS = (*(f"aps.{term}" for term in APS_TERMS), *(f"evs.{term}" for term in EVS_TERMS))
#: Names of all that can be switched off in a render: noise terms, and effects of the lens.
TERMS = (*NOISE_TERMS, *LENS_TERMS)


def noise_models(
    sensor: Sensor, clean: bool = False, without: Sequence[str] = (), terms: Sequence[str] = NOISE_TERMS
) -> Noise:
    """Both noise models of a sensor, with terms switched off.

    Parameters
    ----------
    sensor : the sensor; the model of a pixel kind that it lacks is None.
    clean : switch all terms off.
    without : names of terms to switch off, such as ``aps.read`` or ``evs.leak``; see `NOISE_TERMS`.
    terms : names that may stand in `without`; those of a lens are no noise.

    Returns
    -------
    aps, evs : models of frame pixels and of event pixels.

    Raises
    ------
    RangeError
        For a name that is not a term.
    """
    for name in without:
        if name not in terms:
            raise RangeError("noise term", name, f"one of {', '.join(terms)}{did_you_mean(name, terms)}")
    aps = sensor.aps if sensor.spec.aps is not None else None
    evs = sensor.evs if sensor.spec.evs is not None else None
    if aps is not None:
        aps = aps.clean() if clean else aps.without(*[n[4:] for n in without if n.startswith("aps.")])
    if evs is not None:
        evs = evs.clean() if clean else evs.without(*[n[4:] for n in without if n.startswith("evs.")])
    return aps, evs
