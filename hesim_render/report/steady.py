"""Background rate of event pixels against light and temperature, from recordings of steady light."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from hesim_render.calibrate.estimate import not_identifiable
from hesim_render.calibrate.recordings import still, stillness
from hesim_render.report.bench import EventBench
from hesim_render.report.estimates import log_estimated

#: Temperatures that differ by less are the same, °C.
_SAME_C = 2.0
#: Mean of a Poisson law that gives no event in 5 of 100 cases, −ln 0.05.
_MOST_OF_NONE = 3.0


@dataclass(frozen=True)
class Background:
    """Background of one recording.

    Parameters
    ----------
    lux, temperature_c, seconds : of the recording; the temperature where it is stated.
    rates : entries of the report, ON and OFF events.
    pixels : number of pixels.
    finding : a sign that the light was not steady, or None.
    """

    lux: float
    temperature_c: float | None
    seconds: float
    rates: tuple[dict[str, Any], dict[str, Any]]
    pixels: int
    finding: str | None


def background(bench: EventBench) -> list[Background]:
    """Background of each recording of steady light, in order of temperature and light."""
    outcome = []
    for one in bench.spec.steady:
        tally = bench.tally(one.file)
        rates = still.group_rates(tally)
        seconds = tally.pixels * tally.seconds
        entries = _rate(still.rate(rates, 0), seconds), _rate(still.rate(rates, 1), seconds)
        problem = stillness.not_still(tally)
        outcome.append(
            Background(
                one.lux, bench.temperature_c(one), tally.seconds, entries, tally.pixels,
                None if problem is None else f"{one.file}: {problem}",
            )
        )  # fmt: skip
    return sorted(outcome, key=lambda one: (one.temperature_c or 0.0, one.lux))


def _rate(entry: dict[str, Any], seconds: float) -> dict[str, Any]:
    """A rate is not below 0; without an event, it is less than 3 in the time of all pixels, in 95 of 100 cases."""
    if entry["value"] == 0:
        return entry | {"upper_limit": _MOST_OF_NONE / seconds}
    low, high = entry["interval_95"]
    return entry | {"interval_95": [max(low, 0.0), high]}


def doubling(backgrounds: list[Background], polarity: int, simulated: bool) -> dict[str, Any]:
    """Rise of temperature that doubles the background, °C, at the light with the largest range of temperatures.

    A line through the logarithms of the rates, weighted by their errors. Pixels of a `simulated` sensor do not know
    their temperature.
    """
    best: list[Background] = []
    widest = _SAME_C
    for lux in sorted({one.lux for one in backgrounds}):
        here = [one for one in backgrounds if one.lux == lux and one.temperature_c is not None]
        if here and (width := np.ptp([one.temperature_c or 0.0 for one in here])) > widest:
            best, widest = here, float(width)
    if not best and simulated:
        return not_identifiable("not modelled: simulated event pixels have no temperature")
    if not best:
        known = sorted({one.temperature_c for one in backgrounds if one.temperature_c is not None})
        stated = f"all recordings are at {known[0]:g} °C" if known else "no temperature is stated"
        return not_identifiable(f"{stated}; two at one light are needed")
    rates = [one.rates[polarity] for one in best]
    if any(not rate.get("standard_error") or rate["value"] <= 0 for rate in rates):
        return not_identifiable("a recording has no event of this polarity")
    value, error = (np.array([rate[key] for rate in rates]) for key in ("value", "standard_error"))
    weight = (value / error) ** 2
    celsius = np.array([one.temperature_c for one in best], np.float64)
    middle = np.average(celsius, weights=weight)
    total = float(np.sum(weight * (celsius - middle) ** 2))
    slope = float(np.sum(weight * (celsius - middle) * np.log(value))) / total
    slope_error = float(np.sqrt(1 / total))
    if slope < 2 * slope_error:
        return not_identifiable(f"the rate does not grow over {widest:g} °C")
    return log_estimated(float(np.log(np.log(2) / slope)), slope_error / slope, "°C") | {
        "note": f"at {best[0].lux:g} lx"
    }
