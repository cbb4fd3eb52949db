"""Events per second over time."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import RangeError
from hesim_render.core.units import US_PER_S
from hesim_render.events.grids import check_form, interval, within

#: Largest number of intervals.
_MOST_INTERVALS = 10_000_000


class EventRate(NamedTuple):
    """Rates of all pixels together.

    Parameters
    ----------
    t_us : [n], begins of the intervals, µs.
    on_per_s, off_per_s : [n], events per second.
    """

    t_us: NDArray[np.float64]
    on_per_s: NDArray[np.float64]
    off_per_s: NDArray[np.float64]


def event_rate(
    events: NDArray, interval_us: float, begin_us: float | None = None, end_us: float | None = None
) -> EventRate:
    """Events per second in successive intervals.

    Parameters
    ----------
    events : structured array [event] of `EVENT_DTYPE`.
    interval_us : length of an interval, µs; the last one may be shorter.
    begin_us, end_us : time that is divided, µs; default that of the events.

    Examples
    --------
    >>> import numpy as np
    >>> import hesim_render as hr
    >>> events = np.array([(5, 0, 0, 1), (15, 0, 0, 1), (17, 0, 0, -1)], hr.events.EVENT_DTYPE)
    >>> rate = hr.events.event_rate(events, 10, begin_us=0, end_us=20)
    >>> rate.on_per_s.tolist(), rate.off_per_s.tolist()
    ([100000.0, 100000.0], [0.0, 100000.0])

    Returns
    -------
    The rates.

    Raises
    ------
    RangeError
        If the interval is not positive, or there are more than ten million of them.
    """
    check_form(events, (1, 1))
    begin, end = interval(events, begin_us, end_us)
    if not interval_us > 0 or (end - begin) / interval_us > _MOST_INTERVALS:
        raise RangeError("interval_us", interval_us, f"above 0, at most {_MOST_INTERVALS} intervals")
    number = int(np.ceil((end - begin) / interval_us - 1e-9))
    edges = np.minimum(begin + interval_us * np.arange(number + 1), end)
    some = within(events, begin, end)
    where = np.minimum(((some["t_us"] - begin) / interval_us).astype(np.intp), number - 1)
    on = some["polarity"] > 0
    length_us = np.diff(edges)
    counts = (np.bincount(where[which], minlength=number) for which in (on, ~on))
    return EventRate(edges[:-1], *(count * US_PER_S / length_us for count in counts))
