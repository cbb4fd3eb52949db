"""How well a stream of events agrees with a true one, pixel by pixel: times, missed events, and still pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.units import US_PER_S


def nearest_us(asked: NDArray, given: NDArray, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Time from each event to the nearest one of another stream in the same pixel and of the same polarity.

    Parameters
    ----------
    asked, given : structured arrays of `EVENT_DTYPE`, in any order.
    shape : rows and columns of the event grid.

    Returns
    -------
    [event of `asked`], µs: positive where the nearest one is later; infinite where there is none.
    """
    if len(given) == 0 or len(asked) == 0:
        return np.full(len(asked), np.inf)
    begin = int(min(asked["t_us"].min(), given["t_us"].min()))
    span = int(max(asked["t_us"].max(), given["t_us"].max())) - begin + 1
    keys = np.sort(_place(given, shape) * span + (given["t_us"] - begin))
    place, time = _place(asked, shape), asked["t_us"] - begin
    after = np.searchsorted(keys, place * span + time)
    offset_us = np.full((2, len(asked)), np.inf)
    for row, index in enumerate((after - 1, after)):
        inside = (index >= 0) & (index < len(keys))
        key = keys[np.clip(index, 0, len(keys) - 1)]
        same = inside & (key // span == place)
        offset_us[row, same] = (key % span - time)[same]
    return np.where(np.abs(offset_us[0]) < np.abs(offset_us[1]), offset_us[0], offset_us[1])


def _place(events: NDArray, shape: tuple[int, int]) -> NDArray[np.int64]:
    """Number of the pixel and polarity of each event."""
    pixel = events["y"].astype(np.int64) * shape[1] + events["x"]
    return 2 * pixel + (events["polarity"] > 0)


def timing(events: NDArray, truth: NDArray, shape: tuple[int, int], match_us: float) -> dict[str, float]:
    """Errors of the times of events, and shares of missed and extra ones.

    Each true event is compared with the nearest event of its pixel and polarity, which can be that of several.

    Parameters
    ----------
    events, truth : structured arrays of `EVENT_DTYPE`.
    shape : rows and columns of the event grid.
    match_us : events farther apart are not the same event, µs.

    Returns
    -------
    ``delay_us``: median of the difference of times; ``timing_us`` and ``timing_90_us``: median and 90 % quantile of its
    absolute value; ``missed``: share of true events without an event near; ``extra``: share of events without a true
    one near. NaN where there is nothing to compare.
    """
    late = nearest_us(truth, events, shape)
    early = nearest_us(events, truth, shape)
    matched = late[np.abs(late) <= match_us]
    nan = float("nan")
    figures = {
        "missed": 1 - len(matched) / len(late) if len(late) else nan,
        "extra": float(np.mean(np.abs(early) > match_us)) if len(early) else nan,
        "delay_us": nan, "timing_us": nan, "timing_90_us": nan,
    }  # fmt: skip
    if len(matched):
        figures["delay_us"] = float(np.median(matched))
        figures["timing_us"], figures["timing_90_us"] = map(float, np.quantile(np.abs(matched), [0.5, 0.9]))
    return figures


def quiet_rates(events: NDArray, truth: NDArray, shape: tuple[int, int], duration_us: float) -> dict[str, float]:
    """Rates of events where there should be none: in pixels without a true event in them or in their 8 neighbours.

    Parameters
    ----------
    events, truth : structured arrays of `EVENT_DTYPE`.
    shape : rows and columns of the event grid.
    duration_us : length of both streams, µs.

    Returns
    -------
    ``quiet_on_hz``, ``quiet_off_hz``: events per pixel and second, NaN without such pixels; ``quiet_pixels``: how many.
    """
    from scipy.ndimage import binary_dilation

    busy = np.zeros(shape, dtype=bool)
    busy[truth["y"], truth["x"]] = True
    quiet = ~binary_dilation(busy, np.ones((3, 3), bool))
    count = int(np.count_nonzero(quiet))
    there = quiet[events["y"], events["x"]]
    rates: dict[str, float] = {"quiet_pixels": count}
    for name, sign in (("quiet_on_hz", 1), ("quiet_off_hz", -1)):
        total = np.count_nonzero(there & (events["polarity"] == sign))
        rates[name] = total / (count * duration_us / US_PER_S) if count else float("nan")
    return rates
