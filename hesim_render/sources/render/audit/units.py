"""Units of the audit: values that a source gives for random pixels, noted while they are passed on."""

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Halves
from hesim_render.core.host_arrays import from_host
from hesim_render.mosaic.schedule import Block
from hesim_render.sources.protocol import FluxSource, Sample

#: Approximate number of units noted in a run.
_UNITS = 200_000
_OF_UNITS = ("begin_us", "end_us", "flux", "difference", "error")
_OF_BASE = ("base_begin_us", "base_end_us", "base_flux", "base_difference")


@dataclass(frozen=True)
class Units:
    """Stretches of successive windows of some pixels, arrays [window, unit].

    Fluxes and errors are float32 while a run notes them, as the source gives them; those that are judged (`at`) are
    float64.

    Parameters
    ----------
    pixel : [unit], mosaic indices.
    begin_us, end_us : windows of each unit, µs.
    core : [window], windows that are judged; the others lie before and after them.
    flux : flux that the source gave, e⁻/s.
    difference : half the difference of the two halves, e⁻/s; it has the distribution of the flux's own error.
    error : standard error that the source states, e⁻/s; 0 where it states none.
    base_begin_us, base_end_us, base_flux, base_difference : [1, unit], the same of the window that changes are counted
        from: the first one of the block in which the unit begins. Of frames, the window itself.
    """

    pixel: NDArray[np.uint32]
    begin_us: NDArray[np.float64]
    end_us: NDArray[np.float64]
    core: NDArray[np.bool_]
    flux: NDArray[Any]
    difference: NDArray[Any]
    error: NDArray[Any]
    base_begin_us: NDArray[np.float64]
    base_end_us: NDArray[np.float64]
    base_flux: NDArray[Any]
    base_difference: NDArray[Any]

    def at(self, place: NDArray) -> "Units":
        """Some of the units."""
        values = {name: getattr(self, name)[:, place].astype(np.float64, copy=False) for name in _OF_UNITS + _OF_BASE}
        return Units(pixel=self.pixel[place], core=self.core, **values)

    @property
    def noisy(self) -> NDArray[Any]:
        """Flux with an error as large as its own, [window, unit], e⁻/s."""
        return self.flux + self.difference

    def with_base(self) -> "Units":
        """The units with the window that changes are counted from in front; it states no error and is not judged."""
        own = {name: getattr(self, name) for name in _OF_UNITS}
        base = dict(zip(_OF_UNITS, (*(getattr(self, name) for name in _OF_BASE), 0 * self.base_flux), strict=True))
        values = {name: np.concatenate([base[name], own[name]]) for name in _OF_UNITS}
        return replace(self, core=np.append(False, self.core), **values)

    @classmethod
    def joined(cls, parts: "Sequence[Units]") -> "Units":
        """Join units of the same shape."""
        names = _OF_UNITS + _OF_BASE
        values = {name: np.concatenate([getattr(part, name) for part in parts], axis=1) for name in names}
        return cls(pixel=np.concatenate([part.pixel for part in parts]), core=parts[0].core, **values)


#: Units grouped by shape, with their places in a random order.
Batch: TypeAlias = list[tuple[NDArray[np.int64], Units]]


def in_random_order(noted: Sequence[Units], rng: np.random.Generator, least: int, most: int) -> Iterator[Batch]:
    """All units in random order, in batches of `least` to `most` units, each twice as large as the one before it.

    A batch is made when it is asked for, because an audit stops long before the last one.
    """
    size_of = np.array([units.pixel.size for units in noted])
    which, begins = np.repeat(np.arange(len(noted)), size_of), np.cumsum(size_of) - size_of
    order, first, size = rng.permutation(which.size), 0, least
    while first < order.size:
        chosen = order[first : first + size]
        here = np.argsort(which[chosen], kind="stable")  # list by list
        # units of one shape are put together
        shapes: dict[bytes, list[tuple[NDArray[np.int64], Units]]] = {}
        for place in np.split(here, np.flatnonzero(np.diff(which[chosen[here]])) + 1):
            number = which[chosen[place[0]]]
            units = noted[number].at(chosen[place] - begins[number])
            shapes.setdefault(units.core.tobytes(), []).append((first + place, units))
        parts = (zip(*members, strict=True) for members in shapes.values())
        yield [(np.concatenate(places), Units.joined(units)) for places, units in parts]
        first, size = first + chosen.size, min(2 * size, most)


def first_units(batch: Batch, end: float) -> Batch:
    """The units of a batch that come before a place in the random order."""
    return [(place[place < end], units.at(np.flatnonzero(place < end))) for place, units in batch]


@dataclass
class _Open:
    """Units that are still being noted: places in the list, windows left until they are full, and values so far.

    `skipped` is the number of windows of a unit that lie before the first window of the run; `base` is the window that
    its changes are counted from, with its flux and half the difference of its halves.
    """

    place: NDArray[np.int64]
    skipped: int
    base: "tuple[tuple[float, float], NDArray[np.float32]] | None" = None
    windows: list[tuple[float, float]] = field(default_factory=list)
    halves: list[NDArray[np.float32]] = field(default_factory=list)
    error: list[NDArray[np.float32]] = field(default_factory=list)


class NotedFlux:
    """Wraps a source and notes values of random units; implements `FluxSource`.

    Units are drawn uniformly over the pixels of each stretch or frame, independently of each other and of all values.

    Parameters
    ----------
    source : the wrapped source.
    event_pixel : [n], mosaic indices of the event pixels.
    samples, frames : approximate number of windows for event pixels, and of calls for frames.
    before, core, after : numbers of windows of a unit: before the judged ones, judged, after them.
    seed : seed of the random choices.

    Attributes
    ----------
    events, frames : units noted so far; units of frames have one window.
    """

    def __init__(
        self,
        source: FluxSource,
        event_pixel: NDArray[np.uint32],
        samples: int,
        frames: int,
        before: int,
        core: int,
        after: int,
        seed: int,
    ) -> None:
        self.source, self._event_pixel = source, event_pixel
        self._before, self._core, self._after = before, core, after
        self.is_static = source.is_static
        self._rng = np.random.Generator(np.random.Philox(key=[seed % 2**64, 1]))
        self._of_events = -(-_UNITS // max(1, -(-samples // core)))
        self._of_frames = -(-_UNITS // max(1, frames))
        self.events: list[Units] = []
        self.frames: list[Units] = []

    def slice_edges_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        return self.source.slice_edges_us(begin_us, end_us)

    def sample_times_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        return self.source.sample_times_us(begin_us, end_us)

    def sample_blocks(self, window_us: int, begin_us: int, end_us: int) -> Iterator[Block]:
        return self.source.sample_blocks(window_us, begin_us, end_us)

    def mean_flux(self, pixel: NDArray[np.uint32], begin_us: ArrayLike, end_us: ArrayLike) -> Halves:
        """See `FluxSource.mean_flux`."""
        halves = self.source.mean_flux(pixel, begin_us, end_us)
        count = len(pixel)
        if count:
            place = self._rng.integers(0, count, self._of_frames)
            begin, end = (np.broadcast_to(np.asarray(t, np.float64), (count,))[place][None] for t in (begin_us, end_us))
            flux, difference = _mean_and_difference(halves, place)
            self.frames.append(
                Units(
                    np.asarray(pixel)[place],
                    *(begin, end, np.ones(1, np.bool_)),
                    *(flux[None], difference[None], 0 * flux[None]),
                    *(begin, end, flux[None], difference[None]),
                )
            )
        return halves

    def flux_of_blocks(self, pixel: NDArray[np.uint32], blocks: Iterable[Block]) -> Iterator[Sample]:
        """See `FluxSource.flux_of_blocks`."""
        among = np.flatnonzero(np.isin(pixel, self._event_pixel))
        times: deque[tuple[float, float]] = deque()
        #: Of each window to come: is it the first wanted one of its block, and does the block begin there?
        begins: deque[tuple[bool, bool]] = deque()

        def noted(blocks: Iterable[Block]) -> Iterator[Block]:
            for block in blocks:
                wanted = np.flatnonzero(block.wanted)
                times.extend(zip(block.begin_us[wanted].tolist(), block.end_us[wanted].tolist(), strict=True))
                begins.extend((k == wanted[0], k == 0) for k in wanted.tolist())
                yield block

        units: deque[_Open] = deque()
        base: tuple[tuple[float, float], Halves] | None = None
        last: tuple[tuple[float, float], Halves] | None = None
        if among.size:
            # units at the begin of the run have fewer windows before the judged ones
            units.extend(self._open(among, skipped) for skipped in range(self._before, 0, -self._core))
        for number, sample in enumerate(self.source.flux_of_blocks(pixel, noted(blocks))):
            window, (is_first, is_own) = times.popleft(), begins.popleft()
            halves = sample.half_a, sample.half_b
            if is_first or base is None:
                # the first window of a block is the last one of the block before, where there was one
                base = (window, halves) if is_own or last is None else last
            if among.size and (number + self._before) % self._core == 0:
                units.append(self._open(among, 0))
            for one in units:
                if one.base is None:
                    one.base = base[0], _mean_and_difference(base[1], one.place)
                one.windows.append(window)
                one.halves.append(_mean_and_difference(halves, one.place))
                nothing = np.zeros(one.place.size, np.float32)
                one.error.append(nothing if sample.error is None else sample.error[one.place].astype(np.float32))
            while units and len(units[0].halves) + units[0].skipped == self._before + self._core + self._after:
                self._close(pixel, units.popleft())
            last = window, halves
            yield sample
        for one in units:
            self._close(pixel, one)

    def _open(self, among: NDArray[np.int64], skipped: int) -> _Open:
        return _Open(self._rng.choice(among, self._of_events), skipped)

    def _close(self, pixel: NDArray[np.uint32], one: _Open) -> None:
        # number of each window within the unit: before, judged or after
        number = np.arange(len(one.halves)) + one.skipped
        core = (number >= self._before) & (number < self._before + self._core)
        if core.any():
            # all pixels of a stretch have its windows, which are held once
            shape = number.size, one.place.size
            begin, end = (np.broadcast_to(time[:, None], shape) for time in np.array(one.windows).T)
            flux, difference = np.array(one.halves).swapaxes(0, 1)
            assert one.base is not None
            (base_begin, base_end), of_base = one.base
            base_us = (np.broadcast_to(time, (1, one.place.size)) for time in (base_begin, base_end))
            base = *base_us, of_base[:1], of_base[1:]
            given = pixel[one.place], begin, end, core, flux, difference, np.array(one.error)
            self.events.append(Units(*given, *base))


def _mean_and_difference(halves: Halves, place: NDArray[np.int64]) -> NDArray[np.float32]:
    """Mean and half the difference of both halves at some places, [2, k]."""
    types = jit()
    index = from_host(types.UInt32, place)
    one, other = (np.array(dr.gather(types.Float, half, index), np.float64) for half in halves)
    return (np.stack([one + other, one - other]) / 2).astype(np.float32)
