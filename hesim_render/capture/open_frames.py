"""Frames during their exposure, and the pieces in which they are exposed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import pairwise

from hesim_render.core.device_types import Float
from hesim_render.mosaic.schedule import Exposure
from hesim_render.sources.protocol import FluxSource


@dataclass
class OpenFrame:
    """A frame during its exposure: both halves of its electrons, per frame pixel; None before the first piece."""

    STATE = ("half_a", "half_b")

    exposure: Exposure
    half_a: Float = None
    half_b: Float = None


@dataclass(frozen=True)
class Piece:
    """Part of an exposure during which the source is in one state."""

    frame: OpenFrame
    begin_us: float
    end_us: float


def pieces_of(exposures: Iterable[Exposure], source: FluxSource, begun: Mapping[int, OpenFrame]) -> Iterator[Piece]:
    """Exposures, cut where the source changes its state, in order of their ends.

    Parameters
    ----------
    exposures : in order of time.
    source : asked for its edges only.
    begun : frames of which pieces have been exposed already, by index; the other ones are new.
    """
    waiting: list[tuple[float, int, Piece]] = []
    for exposure in exposures:
        # no piece of this exposure ends before the exposure begins
        while waiting and waiting[0][0] <= exposure.start_us:
            yield heappop(waiting)[2]
        frame = begun.get(exposure.index) or OpenFrame(exposure)
        edges = source.slice_edges_us(exposure.start_us, exposure.end_us)
        for begin, end in pairwise([float(exposure.start_us), *edges, exposure.end_us]):
            heappush(waiting, (end, exposure.index, Piece(frame, begin, end)))
    while waiting:
        yield heappop(waiting)[2]
