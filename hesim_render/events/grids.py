"""Events on the pixel grid: frames, time surfaces and voxel grids.

Checks of event arrays and of intervals of time.
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import RangeError
from hesim_render.pixels.evs.events import EVENT_DTYPE


def check_form(events: NDArray, shape: tuple[int, int]) -> None:
    """Check that these are events and the size of a grid; places are not looked at.

    Raises
    ------
    RangeError
        If the array lacks a field of `EVENT_DTYPE`, or the grid is empty.
    """
    if not isinstance(events, np.ndarray):
        raise RangeError("events", events, "an array of events, such as the events of a recording")
    names = events.dtype.names or ()
    if events.ndim != 1 or not set(EVENT_DTYPE.names or ()) <= set(names):
        raise RangeError(
            "events", f"fields {', '.join(names) or 'none'}", f"a list of {', '.join(EVENT_DTYPE.names or ())}"
        )
    rows, cols = shape
    if not (rows >= 1 and cols >= 1):
        raise RangeError("shape", shape, "rows and columns of the event grid, 1 or more")


def checked(events: NDArray, shape: tuple[int, int]) -> NDArray[np.intp]:
    """Places of events on the grid, row-major.

    Raises
    ------
    RangeError
        If the array lacks a field of `EVENT_DTYPE`, or an event is outside the grid or between its pixels.
    """
    check_form(events, shape)
    rows, cols = shape
    for name in ("y", "x"):
        if events.size and (events[name].dtype.kind not in "ui" or int(events[name].min()) < 0):
            raise RangeError(f"events[{name!r}]", events[name].min(), "whole numbers, 0 or more")
    if events.size and (int(events["y"].max()) >= rows or int(events["x"].max()) >= cols):
        raise RangeError(
            "shape", shape, f"at least {int(events['y'].max()) + 1} rows and {int(events['x'].max()) + 1} columns, "
            "where these events are"
        )  # fmt: skip
    return events["y"].astype(np.intp) * cols + events["x"]


def interval(events: NDArray, begin_us: float | None, end_us: float | None) -> tuple[float, float]:
    """Begin and end of an interval, µs; by default that of the events, the last one included.

    Raises
    ------
    RangeError
        If the interval is empty.
    """
    times = events["t_us"]
    begin = float(begin_us) if begin_us is not None else float(times.min()) if events.size else 0.0
    end = float(end_us) if end_us is not None else float(times.max()) + 1.0 if events.size else begin + 1.0
    if not (np.isfinite(begin) and np.isfinite(end) and end > begin):
        raise RangeError("end_us", end, f"a time after the begin, {begin:g} µs")
    return begin, end


def within(events: NDArray, begin_us: float, end_us: float) -> NDArray:
    """Events with begin_us <= t_us < end_us."""
    times = events["t_us"]
    inside = (times >= begin_us) & (times < end_us)
    return events if inside.all() else events[inside]


#: Largest number of values of one array.
_MOST_VALUES = 2**31


def event_frame(
    events: NDArray,
    shape: tuple[int, int],
    begin_us: float | None = None,
    end_us: float | None = None,
    kind: Literal["sum", "counts", "last"] = "sum",
) -> NDArray[np.int32]:
    """Events of an interval as one picture.

    Parameters
    ----------
    events : structured array [event] of `EVENT_DTYPE`, in order of time.
    shape : rows and columns of the event grid.
    begin_us, end_us : the interval begin_us <= t_us < end_us, µs; by default all events.
    kind : ``sum``, ON less OFF events; ``counts``, both apart; ``last``, polarity of the last event.

    Examples
    --------
    >>> import numpy as np
    >>> import hesim_render as hr
    >>> events = np.array([(5, 0, 0, 1), (6, 1, 0, -1), (7, 1, 0, -1)], hr.events.EVENT_DTYPE)
    >>> hr.events.event_frame(events, (1, 3)).tolist()
    [[1, -2, 0]]
    >>> hr.events.event_frame(events, (1, 3), kind="counts").tolist()
    [[[1, 0, 0]], [[0, 2, 0]]]

    Returns
    -------
    [y, x]; for ``counts`` [2, y, x], ON first. 0 where there is no event.

    Raises
    ------
    RangeError
        If an event is outside the grid, the interval is empty, or the kind unknown.
    """
    check_form(events, shape)
    begin, end = interval(events, begin_us, end_us)
    return event_frames(events, shape, end - begin, begin, end, kind)[0]


def event_frames(
    events: NDArray,
    shape: tuple[int, int],
    period_us: float,
    begin_us: float | None = None,
    end_us: float | None = None,
    kind: Literal["sum", "counts", "last"] = "sum",
) -> NDArray[np.int32]:
    """Events as successive pictures of equal length.

    Parameters
    ----------
    events, shape, begin_us, end_us, kind : as for `event_frame`.
    period_us : length of a picture, µs; the last one ends where the interval ends.

    Examples
    --------
    >>> import numpy as np
    >>> import hesim_render as hr
    >>> events = np.array([(5, 0, 0, 1), (15, 0, 0, 1), (17, 0, 0, 1)], hr.events.EVENT_DTYPE)
    >>> hr.events.event_frames(events, (1, 1), 10, begin_us=0, end_us=30).ravel().tolist()
    [1, 2, 0]

    Returns
    -------
    [picture, y, x]; for ``counts`` [picture, 2, y, x], ON first.

    Raises
    ------
    RangeError
        As for `event_frame`, if the period is not positive, or for more than 2³¹ values.
    """
    if kind not in ("sum", "counts", "last"):
        raise RangeError("kind", kind, "sum, counts or last")
    check_form(events, shape)
    begin, end = interval(events, begin_us, end_us)
    if not period_us > 0:
        raise RangeError("period_us", period_us, "a length above 0")
    # a last picture of a billionth of a period would come from rounding
    number = int(np.ceil((end - begin) / period_us - 1e-9))
    pixels, planes = shape[0] * shape[1], 2 if kind == "counts" else 1
    if number * planes * pixels > _MOST_VALUES:
        raise RangeError(
            "period_us", period_us, f"at most {_MOST_VALUES // (planes * pixels)} pictures in the interval"
        )
    some = within(events, begin, end)
    place = checked(some, shape)
    picture = np.minimum(((some["t_us"] - begin) / period_us).astype(np.intp), number - 1)
    on = some["polarity"] > 0
    if kind == "last":
        _require_order(some)
        frames = np.zeros(number * pixels, np.int32)
        frames[picture * pixels + place] = np.where(on, 1, -1)  # of repeated places the last one stays
        return frames.reshape(number, *shape)
    total = number * pixels
    # one count over picture and pixel together, for each polarity
    count_on, count_off = (
        np.bincount((picture * pixels + place)[which], minlength=total).astype(np.int32) for which in (on, ~on)
    )
    if kind == "sum":
        return (count_on - count_off).reshape(number, *shape)
    return np.stack([count_on.reshape(number, *shape), count_off.reshape(number, *shape)], axis=1)


def time_surface(
    events: NDArray,
    shape: tuple[int, int],
    t_us: float | None = None,
    tau_us: float = 30_000.0,
    decay: Literal["exponential", "linear"] = "exponential",
) -> NDArray[np.float32]:
    """How recent the last event of each pixel is [lagorce2017].

    Parameters
    ----------
    events : structured array [event] of `EVENT_DTYPE`, in order of time.
    shape : rows and columns of the event grid.
    t_us : time of the surface, µs; later events are left out. Default the time of the last event.
    tau_us : time constant of the decay, or time after which a linear one reaches 0, µs.
    decay : exp(−Δt/τ), or max(1 − Δt/τ, 0).

    Examples
    --------
    >>> import numpy as np
    >>> import hesim_render as hr
    >>> events = np.array([(0, 0, 0, 1), (500, 1, 0, -1)], hr.events.EVENT_DTYPE)
    >>> hr.events.time_surface(events, (1, 3), t_us=1000, tau_us=1000, decay="linear").tolist()
    [[[0.0, 0.0, 0.0]], [[0.0, 0.5, 0.0]]]

    Returns
    -------
    [2, y, x], of ON and of OFF events, between 0 (no event) and 1 (an event at this time).

    Raises
    ------
    RangeError
        If an event is outside the grid, events are not in order of time, τ is not positive, or the decay unknown.
    """
    if decay not in ("exponential", "linear"):
        raise RangeError("decay", decay, "exponential or linear")
    check_form(events, shape)
    if not tau_us > 0:
        raise RangeError("tau_us", tau_us, "a time above 0")
    if t_us is not None:
        events = events[events["t_us"] <= t_us]
    place = checked(events, shape)
    _require_order(events)
    now = float(t_us) if t_us is not None else float(events["t_us"][-1]) if events.size else 0.0
    # in order of time the last event of a pixel is the one that stays; none is infinitely old
    last = np.full((2, shape[0] * shape[1]), -np.inf)
    last[(events["polarity"] <= 0).astype(np.intp), place] = events["t_us"]
    age = (now - last) / tau_us
    surface = np.exp(-age) if decay == "exponential" else np.maximum(1 - age, 0.0)
    return surface.reshape(2, *shape).astype(np.float32)


def voxel_grid(
    events: NDArray,
    shape: tuple[int, int],
    bins: int = 5,
    begin_us: float | None = None,
    end_us: float | None = None,
    *,
    split: bool = False,
    normalise: bool = False,
) -> NDArray[np.float32]:
    """Events spread over bins of time, each between the two nearest bins [zhu2019].

    With t* = (bins − 1)(t − t₀)/(t₁ − t₀), an event of polarity p adds p·max(0, 1 − |b − t*|) to bin b.

    Parameters
    ----------
    events : structured array [event] of `EVENT_DTYPE`.
    shape : rows and columns of the event grid.
    bins : number of bins.
    begin_us, end_us : t₀ and t₁, µs, events at both included; default the times of the first and the last event, as in
        E2VID.
    split : ON and OFF events in bins of their own, both positive.
    normalise : mean 0 and standard deviation 1 of all values that are not 0, as E2VID wants its input.

    Examples
    --------
    >>> import numpy as np
    >>> import hesim_render as hr
    >>> events = np.array([(0, 0, 0, 1), (25, 0, 0, 1), (100, 0, 0, -1)], hr.events.EVENT_DTYPE)
    >>> hr.events.voxel_grid(events, (1, 1), bins=3).ravel().tolist()
    [1.5, 0.5, -1.0]

    Returns
    -------
    [bins, y, x]; with `split` [2, bins, y, x], ON first.

    Raises
    ------
    RangeError
        If an event is outside the grid, the number of bins is below 1, t₁ is before t₀, or for more than 2³¹ values.
    """
    check_form(events, shape)
    pixels, planes = shape[0] * shape[1], 2 if split else 1
    if bins < 1 or bins * planes * pixels > _MOST_VALUES:
        raise RangeError("bins", bins, f"1 to {_MOST_VALUES // max(planes * pixels, 1)}")
    times = events["t_us"]
    first = float(begin_us) if begin_us is not None else float(times.min()) if events.size else 0.0
    last = float(end_us) if end_us is not None else float(times.max()) if events.size else first
    if not last >= first:
        raise RangeError("end_us", last, f"a time from the begin on, {first:g} µs")
    some = events[(times >= first) & (times <= last)]
    place = checked(some, shape)
    scaled = (some["t_us"] - first) * ((bins - 1) / (last - first) if last > first else 0.0)
    # the bin before the event, and how far the event is on the way to the next; the last event falls into the last bin
    low = np.minimum(scaled.astype(np.intp), max(bins - 2, 0))
    part = scaled - low
    on = some["polarity"] > 0
    plane = np.where(on, 0, bins) if split else 0
    weight = np.ones(some.size) if split else np.where(on, 1.0, -1.0)
    grid = np.bincount((plane + low) * pixels + place, weight * (1 - part), minlength=planes * bins * pixels)
    if bins > 1:
        grid += np.bincount((plane + low + 1) * pixels + place, weight * part, minlength=planes * bins * pixels)
    if normalise and np.any(grid):
        filled = grid != 0
        values = grid[filled]
        spread = float(values.std())
        grid[filled] = (values - values.mean()) / spread if spread > 0 else values - values.mean()
    return grid.reshape(*((2,) if split else ()), bins, *shape).astype(np.float32)


def _require_order(events: NDArray) -> None:
    if events.size and not np.all(events["t_us"][1:] >= events["t_us"][:-1]):
        raise RangeError("events", "times that go back", "events in order of time")
