"""Learned measures of pictures, and measures of events against a truth.

The agreement of a stream of events with a true one is measured pixel by pixel: times, missed events, and still pixels.
"""

import importlib.util
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.units import US_PER_S

#: Largest number of events of each side in a chamfer distance; more are thinned evenly.
MOST_POINTS = 200_000


def learned_measures() -> list[str]:
    """Names of measures that need a network and can be computed here: those of pyiqa, if it is installed."""
    return ["lpips", "niqe", "musiq"] if importlib.util.find_spec("pyiqa") else []


def learned(name: str, picture: NDArray, truth: NDArray) -> float:
    """A measure of pyiqa, with its own weights.

    Parameters
    ----------
    name : from `learned_measures`; ``lpips`` compares with the truth, the others look at the picture alone.
    picture, truth : [row, col, 3], encoded sRGB in [0, 1].
    """
    import pyiqa
    import torch

    def tensor(image: NDArray) -> Any:
        values = np.ascontiguousarray(np.clip(image, 0, 1), dtype=np.float32)
        return torch.from_numpy(values).permute(2, 0, 1)[None]

    measure = pyiqa.create_metric(name)
    given = (tensor(picture), tensor(truth)) if name == "lpips" else (tensor(picture),)
    return float(measure(*given).item())


# ---- events -------------------------------------------------------------------------------------------


def count_error(events: NDArray, truth: NDArray) -> float:
    """(number of events − number of true ones) / number of true ones; infinite where there are only false ones."""
    if len(truth) == 0:
        return 0.0 if len(events) == 0 else float("inf")
    return (len(events) - len(truth)) / len(truth)


def rate_maps(events: NDArray, shape: tuple[int, int], duration_us: float) -> NDArray[np.float64]:
    """Rate of each pixel and polarity, [polarity, y, x], Hz: ON first.

    Parameters
    ----------
    events : structured array of `EVENT_DTYPE`.
    shape : rows and columns of the event grid.
    duration_us : length of the recording, µs.
    """
    rows, cols = shape
    off = (events["polarity"] < 0).astype(np.int64)
    place = (off * rows + events["y"]) * cols + events["x"]
    return np.bincount(place, minlength=2 * rows * cols).reshape(2, rows, cols) / (duration_us * 1e-6)


def rate_error(events: NDArray, truth: NDArray, shape: tuple[int, int], duration_us: float) -> float:
    """Root mean square over pixels and polarities of the difference of rates, Hz."""
    difference = rate_maps(events, shape, duration_us) - rate_maps(truth, shape, duration_us)
    return float(np.sqrt(np.mean(difference**2)))


def chamfer(events: NDArray, truth: NDArray, us_per_px: float = 1000.0) -> float:
    """Chamfer distance of two clouds of events in (x, y, t), px: polarities are compared each with its own.

    The mean distance from an event to the nearest true one, plus that from a true one to the nearest event, half of
    each. A time of `us_per_px` counts as one pixel. Beyond 200,000 events of a side, every k-th one is taken.

    Parameters
    ----------
    events, truth : structured arrays of `EVENT_DTYPE`.
    us_per_px : time that counts as one pixel, µs.

    Returns
    -------
    px; NaN where a polarity is empty on one side only, 0 where both are empty.
    """
    from scipy.spatial import cKDTree

    def cloud(given: NDArray, sign: int) -> NDArray[np.float64]:
        part = given[given["polarity"] == sign]
        part = part[:: max(1, -(-len(part) // MOST_POINTS))]
        return np.column_stack([part["x"], part["y"], part["t_us"] / us_per_px]).astype(np.float64)

    total, count = 0.0, 0
    for sign in (1, -1):
        a, b = cloud(events, sign), cloud(truth, sign)
        if len(a) == 0 and len(b) == 0:
            continue
        if len(a) == 0 or len(b) == 0:
            return float("nan")
        forth, back = cKDTree(b).query(a)[0], cKDTree(a).query(b)[0]
        total += 0.5 * (forth.mean() + back.mean()) * (len(a) + len(b))
        count += len(a) + len(b)
    return total / count if count else 0.0


def denoising_scores(kept: NDArray[np.bool_], is_signal: NDArray[np.bool_]) -> dict[str, float]:
    """How well a filter separates signal from noise.

    Parameters
    ----------
    kept, is_signal : [event], what the filter keeps, and what the truth says.

    Returns
    -------
    ``signal_kept`` and ``noise_kept``: shares; ``precision``: share of signal among the kept ones; ``f1``.
    """
    hit = int(np.count_nonzero(kept & is_signal))
    signal, given = int(np.count_nonzero(is_signal)), int(np.count_nonzero(kept))
    noise = len(kept) - signal

    def ratio(part: float, whole: float) -> float:
        return part / whole if whole else float("nan")

    return {
        "signal_kept": ratio(hit, signal),
        "noise_kept": ratio(given - hit, noise),
        "precision": ratio(hit, given),
        "f1": ratio(2 * hit, signal + given),
    }


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
    # pixel, polarity and time in one number, so that one sort serves all pixels
    keys = np.sort(_place(given, shape) * span + (given["t_us"] - begin))
    place, time = _place(asked, shape), asked["t_us"] - begin
    after = np.searchsorted(keys, place * span + time)
    offset_us = np.full((2, len(asked)), np.inf)
    # the neighbours before and after, where they are of the same pixel and polarity
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
