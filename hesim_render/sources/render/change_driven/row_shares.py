"""Rows of a sensor that are dealt out to worker processes, each of which renders its own rows.

Values are pure functions of place and time, so they are the same bits as those of one process. Each worker gets several
strips of rows in turn, since things that move are seldom spread evenly over the picture. Neighbours beyond a strip are
looked at by two workers.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.journal import Journal
from hesim_render.core.workers import Ticket, Workers
from hesim_render.mosaic.schedule import Block
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.render.change_driven.estimates import Counts, Flux
from hesim_render.sources.render.change_driven.event_blocks import BlockFlux, with_next

#: Largest number of strips of a worker, and least number of rows of a strip, where there is more than one.
_STRIPS, _LEAST_ROWS = 4, 16
#: Number of blocks that the workers may be ahead of the one that is used.
_AHEAD = 2


class RowShares:
    """The rows of a sensor and the workers that render them.

    Parameters
    ----------
    workers : processes that run `part_worker`.
    part : number of this part of the light.
    sensor : region read out.
    on_answer : called after each answer.
    made : arguments of `ChangeDrivenFlux`, by name.

    Attributes
    ----------
    counts, rays_done : work that the workers have done so far, and rays that they have traced.
    """

    def __init__(
        self, workers: Workers, part: int, sensor: Sensor, on_answer: Callable[[], None], made: dict[str, Any]
    ) -> None:
        self._workers, self._part, self._cols, self._on_answer = workers, part, sensor.cols, on_answer
        strips = min(_STRIPS, max(1, sensor.rows // (_LEAST_ROWS * workers.count))) * workers.count
        #: Worker of each row.
        self._owner = np.arange(sensor.rows) * strips // sensor.rows % workers.count
        self._work = [(0, Counts()) for _ in range(workers.count)]
        self._journal: Journal | None = None
        #: What the workers are to make before their first call: estimates of time are measured before they start.
        self._to_make: dict[str, Any] | None = made

    @property
    def rays_done(self) -> int:
        return sum(rays for rays, _ in self._work)

    @property
    def counts(self) -> Counts:
        return Counts.sum([counts for _, counts in self._work])

    def go_on(self, journal: Journal, part: int) -> None:
        """See `Renderer.go_on`; workers read the journal, and send what it is to keep with their answers."""
        self._journal = journal
        for number in range(self._workers.count):
            self.ask(number, "go_on", str(journal.path), journal.run, part)

    def places(self, pixel: NDArray[np.uint32]) -> list[NDArray[np.int64]]:
        """Places in a list of mosaic indices [n] of the pixels of each worker."""
        owner = self._owner[pixel // self._cols]
        return [np.flatnonzero(owner == number) for number in range(self._workers.count)]

    def ask(self, worker: int, name: str, *given: Any) -> Ticket:
        """See `Workers.ask`."""
        if self._to_make is not None:
            made, self._to_make = self._to_make, None
            for number in range(self._workers.count):
                self.ask(number, "make", made)
        return self._workers.ask(worker, name, self._part, *given)

    def answer(self, ticket: Ticket) -> Any:
        """See `Workers.answer`; the work behind it is noted."""
        answer, rays, counts, kept = self._workers.answer(ticket)
        self._work[ticket.worker] = rays, counts
        if self._journal is not None:
            for key, values in kept:
                self._journal.keep(key, [np.frombuffer(values, np.uint8)])
        self._on_answer()
        return answer

    def of_pixels(self, name: str, pixel: NDArray[np.uint32], *given: NDArray[Any], **others: Any) -> NDArray[Any]:
        """Results of a method of `ChangeDrivenFlux` for listed pixels, each from the worker of its row, [..., n].

        Parameters
        ----------
        name : of the method.
        pixel : [n], mosaic indices, at least one.
        given : [..., n], arguments of each pixel.
        others : all other arguments, by name.
        """
        asked = [
            (place, self.ask(number, "call", name, (pixel[place], *(each[..., place] for each in given)), others))
            for number, place in enumerate(self.places(pixel))
            if place.size
        ]
        place, values = zip(*((place, self.answer(ticket)) for place, ticket in asked), strict=True)
        # put back in the order of the list
        return np.concatenate(values, axis=-1)[..., np.argsort(np.concatenate(place))]


class SharedBlocks:
    """A list of event pixels over successive blocks, each pixel by the worker of its row; see `Blocks`.

    Parameters
    ----------
    shares : the workers.
    pixel : [n], mosaic indices.
    first : the first block.

    Attributes
    ----------
    alive, own, base : see `Blocks`.
    """

    def __init__(self, shares: RowShares, pixel: NDArray[np.uint32], first: Block) -> None:
        self._shares, places = shares, shares.places(pixel)
        self._workers = [number for number, place in enumerate(places) if place.size]
        begun = [shares.ask(number, "begin", pixel[places[number]], first) for number in self._workers]
        alive, own, self.base, given = [], [], Flux.zeros(1, pixel.size), 0
        for number, ticket in zip(self._workers, begun, strict=True):
            its_alive, its_own, its_base, count = shares.answer(ticket)
            self.base.put(places[number], its_base)
            alive.append(places[number][its_alive])
            own.append(given + its_own)
            given += count
        self.alive, self.own = np.concatenate(alive), np.concatenate(own)

    def through(self, blocks: Iterable[Block]) -> Iterator[tuple[Block, BlockFlux]]:
        """See `Blocks.through`. The workers begin with the next blocks while one is used."""
        asked: deque[tuple[Block, list[Ticket]]] = deque()
        for block, following in with_next(blocks):
            asked.append((block, [self._shares.ask(number, "take", block, following) for number in self._workers]))
            if len(asked) > _AHEAD:
                yield self._joined(*asked.popleft())
        while asked:
            yield self._joined(*asked.popleft())

    def _joined(self, block: Block, tickets: list[Ticket]) -> tuple[Block, BlockFlux]:
        return block, BlockFlux.joined([self._shares.answer(ticket) for ticket in tickets])
