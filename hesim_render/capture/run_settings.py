"""How a scene is simulated: the settings of a run, checked, and the sensor's noise with terms switched off by name."""

import operator
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypedDict

from hesim_render.core.errors import ConflictError, RangeError, did_you_mean
from hesim_render.core.plain import require_list, settle_numbers
from hesim_render.core.units import US_PER_S
from hesim_render.pixels.aps.model import APS_TERMS, ApsNoise
from hesim_render.pixels.evs.model import EVS_TERMS, EvsNoise
from hesim_render.recording.truth_file import truth_kinds
from hesim_render.sensor.sensor import Sensor
from hesim_render.specs.lens import LENS_TERMS

#: Models of frame pixels and of event pixels; None for the kind that a sensor lacks.
Noise = tuple[ApsNoise | None, EvsNoise | None]
#: Names of all noise terms that can be switched off.
NOISE_TERMS = (*(f"aps.{term}" for term in APS_TERMS), *(f"evs.{term}" for term in EVS_TERMS))
#: Names of all that can be switched off in a render: noise terms, and effects of the lens.
TERMS = (*NOISE_TERMS, *LENS_TERMS)


class RunOptions(TypedDict, total=False):
    """The fields of `RunSettings`, as keywords of `simulate`."""

    duration_s: float
    seed: int
    clean: bool
    without: Sequence[str]
    quality: float | None
    samples: int | None
    exact: bool
    max_minutes: float | None
    truth: str | Sequence[str]
    truth_every_us: int | None
    audit: bool


@dataclass(frozen=True)
class RunSettings:
    """Settings of a run.

    Parameters
    ----------
    duration_s : simulated time from 0, s.
    seed : seed of the temporal noise and of the render's samples. The fixed maps of the device come from the
        device seed of the sensor file.
    clean : switch every noise term off.
    without : names of noise terms and of effects of the lens to switch off, such as ``aps.read`` or
        ``lens.distortion``.
    quality : wanted error of the render, as a fraction of the sensor's own noise; default 0.5. Each pixel gets as
        many rays as this error needs, and only pixels that change are rendered again. An audit measures what this
        misses.
    samples : rays per pixel and slice, even. Selects the exact mode, in place of `quality`.
    exact : render every pixel of every slice with the same number of rays; default 64 for a static scene, 16
        for a moving one.
    max_minutes : refuse a run whose estimated time is longer, min; None sets no limit.
    truth : kinds of geometric truth to write into the recording (`TRUTH_KINDS`, or ``all``): ``depth``, ``flow``, …
        Without `out`, `Recording.truth` computes them when they are asked for.
    truth_every_us : interval between the times at which event pixels are described, µs; default: the middle of each
        frame, or every 10 ms where there are none.
    audit : measure the error of the render with random numbers of its own. Without it the run is shorter, all else is
        the same to the bit, and ``settings.render`` has no audit.

    Raises
    ------
    RangeError
        If duration, seed or kind of truth is out of range, or text stands for a number.
    ConflictError
        If `quality` comes with `exact` or `samples`.
    """

    duration_s: float = 0.1
    seed: int = 7
    clean: bool = False
    without: Sequence[str] = ()
    quality: float | None = None
    samples: int | None = None
    exact: bool = False
    max_minutes: float | None = None
    truth: str | Sequence[str] = ()
    truth_every_us: int | None = None
    audit: bool = True

    def __post_init__(self) -> None:
        settle_numbers(self, ("duration_s", "quality", "samples", "max_minutes", "truth_every_us"))
        duration_us = whole_us(self.duration_s)
        object.__setattr__(self, "seed", checked_seed(self.seed))
        if self.quality is not None and (self.exact or self.samples is not None):
            other = "samples" if self.samples is not None else "exact"
            raise ConflictError(
                "quality",
                self.quality,
                f"give --quality or --{other} (quality, {other}), not both: --quality asks for an error and gives each "
                f"pixel the rays that takes, --{other} belongs to the exact mode, which gives all pixels the same "
                "number",
            )
        truth_kinds(self.truth)
        if self.truth_every_us is not None and not 1 <= self.truth_every_us <= duration_us:
            raise RangeError("truth_every_us", self.truth_every_us, f"1 to {duration_us} µs, the length of the run")

    @property
    def duration_us(self) -> int:
        """Length of the run, µs."""
        return whole_us(self.duration_s)

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of geometric truth that are written."""
        return tuple(truth_kinds(self.truth))

    def as_dict(self) -> dict[str, object]:
        """For the manifest, but what the renderer says of itself."""
        result: dict[str, object] = {"clean": self.clean, "without": list(self.without)}
        if self.kinds:
            result["truth"] = {"kinds": list(self.kinds), "every_us": self.truth_every_us}
        return result


def whole_us(duration_s: float) -> int:
    """A duration in whole µs.

    Raises
    ------
    RangeError
        If it is not finite, or shorter than half of one.
    """
    if not 0 < duration_s < float("inf"):
        raise RangeError("duration_s", duration_s, "a time above 0, in seconds")
    duration_us = round(duration_s * US_PER_S)
    if duration_us < 1:
        raise RangeError("duration_s", duration_s, "at least one microsecond")
    return duration_us


def checked_seed(seed: int) -> int:
    """A seed, also one of NumPy's integers, as an integer of Python.

    Raises
    ------
    RangeError
        If it is not whole, or not one that the generator takes.
    """
    try:
        result = operator.index(seed)
    except TypeError:
        raise RangeError("seed", seed, "a whole number, 0 to 2^64 - 1") from None
    if not 0 <= result < 2**64:
        raise RangeError("seed", seed, "0 to 2^64 - 1")
    return result


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
        For a name that is not a term, or a text in place of a list.
    """
    require_list("without", without)
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
