"""Learned measures of pictures, and measures of events against a truth."""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
