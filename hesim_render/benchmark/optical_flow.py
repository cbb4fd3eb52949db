"""Baselines of optical flow, from two pictures and from events, and how flow is measured."""

import importlib.util
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Side of the window in which a plane is fitted to the times of events, px; fewest events in it; largest rms
#: residual of the plane over the spread of its times, and largest speed, px per µs.
_SIDE, _FEWEST, _MOST_RESIDUAL, _FASTEST = 5, 8, 0.5, 0.05


def flow_scores(flow: NDArray, truth: NDArray, valid: NDArray[np.bool_]) -> dict[str, float]:
    """Measures of a flow field over the pixels whose point is seen again.

    Parameters
    ----------
    flow, truth : [row, col, 2], px to the right and downwards; a flow that is not finite counts as 0.
    valid : [row, col], pixels that count.

    Returns
    -------
    ``epe_px``: mean end-point error; ``outliers``: share of pixels off by more than 3 px and more than 5 % of the true
    flow, as KITTI has it [geiger2012]; ``angle_deg``: mean angle between (u, v, 1) and the true one [barron1994];
    ``density``: share of pixels with a flow. NaN without valid pixels.
    """
    if not valid.any():
        return dict.fromkeys(("epe_px", "outliers", "angle_deg", "density"), float("nan"))
    given = np.isfinite(flow).all(axis=-1)[valid]
    a = np.nan_to_num(flow[valid].astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    b = truth[valid].astype(np.float64)
    error, length = np.hypot(*(a - b).T), np.hypot(*b.T)
    cosine = (1 + (a * b).sum(axis=1)) / np.sqrt((1 + (a**2).sum(axis=1)) * (1 + (b**2).sum(axis=1)))
    return {
        "epe_px": float(error.mean()),
        "outliers": float(np.mean((error > 3) & (error > 0.05 * length))),
        "angle_deg": float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean()),
        "density": float(given.mean()),
    }


def picture_methods() -> list[str]:
    """Names of methods that need two pictures and can be computed here: those of OpenCV, if it is installed."""
    return ["farneback", "dis"] if importlib.util.find_spec("cv2") else []


def of_pictures(method: str, first: NDArray[np.uint8], second: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Dense flow of OpenCV from one grey picture to the next, [row, col, 2], px.

    Parameters
    ----------
    method : ``farneback`` [farneback2003] (three levels, window of 15 px) or ``dis`` [kroeger2016] (preset medium).
    first, second : [row, col], 8 bit.
    """
    import cv2

    library: Any = cv2  # its stubs lack the second method
    if method == "farneback":
        start = np.zeros((*first.shape, 2), np.float32)
        return library.calcOpticalFlowFarneback(first, second, start, 0.5, 3, 15, 3, 7, 1.5, 0)
    return library.DISOpticalFlow_create(library.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(first, second, None)


def plane_fit(events: NDArray, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Normal flow from events: a plane through the times of the last events around each pixel [benosman2014].

    The plane t = a x + b y + c is the least-squares fit in a window of 5×5 px; the velocity across the edge is
    (a, b) / (a² + b²). Each polarity has planes of its own, of which that with more events counts.

    Parameters
    ----------
    events : structured array of `EVENT_DTYPE`, in order of time.
    shape : rows and columns of the event grid.

    Returns
    -------
    [y, x, 2], px per µs to the right and downwards; NaN without events, or where they lie in no plane.
    """
    result = np.full((*shape, 2), np.nan)
    best = np.zeros(shape)
    for sign in (1, -1):
        part = events[events["polarity"] == sign]
        time = np.full(shape, np.nan)
        time[part["y"], part["x"]] = part["t_us"]  # later events replace earlier ones
        velocity, count = _planes(time)
        better = (count > best) & np.isfinite(velocity[..., 0])
        result[better], best[better] = velocity[better], count[better]
    return result


def _planes(time: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Velocity of the plane around each pixel, [y, x, 2], and the number of times in its window."""
    from scipy.ndimage import uniform_filter

    there = np.isfinite(time)
    if not there.any():
        return np.full((*time.shape, 2), np.nan), np.zeros(time.shape)
    y, x = (np.asarray(index, dtype=np.float64) for index in np.indices(time.shape))
    t = np.where(there, time - time[there].mean(), 0.0)

    def total(values: Any) -> NDArray[np.float64]:
        return uniform_filter(np.where(there, values, 0.0), _SIDE, mode="constant") * _SIDE**2

    n, sx, sy, st = total(np.ones_like(t)), total(x), total(y), total(t)
    count = np.maximum(n, 1)
    xx, yy, tt = total(x * x) - sx * sx / count, total(y * y) - sy * sy / count, total(t * t) - st * st / count
    xy, xt, yt = total(x * y) - sx * sy / count, total(x * t) - sx * st / count, total(y * t) - sy * st / count
    det = xx * yy - xy * xy
    good = there & (n > _FEWEST - 0.5) & (det > 1e-6 * np.maximum(xx * yy, 1))
    det = np.where(good, det, 1.0)
    a, b = (xt * yy - yt * xy) / det, (yt * xx - xt * xy) / det
    residual = np.maximum(tt - a * xt - b * yt, 0)
    square = a * a + b * b
    good &= (residual <= _MOST_RESIDUAL**2 * np.maximum(tt, 1e-12)) & (square >= _FASTEST**-2)
    square = np.where(good, square, 1.0)
    velocity = np.stack([a, b], axis=-1) / square[..., None]
    return np.where(good[..., None], velocity, np.nan), np.where(good, n, 0.0)
