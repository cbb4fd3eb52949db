"""A worker process of a run: it renders the pixels that `row_shares` asks it for, with renderers of its own."""

import sys
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core import backend
from hesim_render.core.bands import processors
from hesim_render.core.device import dr
from hesim_render.core.journal import Journal
from hesim_render.core.workers import Workers, serve
from hesim_render.sources.render.change_driven.estimates import Counts
from hesim_render.sources.render.change_driven.event_blocks import Blocks
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux

_PROGRAM = f"from {__name__} import main; main()"


def start(count: int) -> Workers:
    """Start worker processes for a run, which divide the processors among them.

    Parameters
    ----------
    count : number of processes.
    """
    return Workers(_PROGRAM, count, max(1, processors() // count))


class _Relay(Journal):
    """The journal of the run, which this process reads; what is to be kept is sent to the process that writes it."""

    def __init__(self, path: str, run: dict[str, Any]) -> None:
        # the file of its own never appears
        super().__init__(f"{path}-", run, others=[Path(path)])
        self.kept: list[tuple[bytes, bytes]] = []

    def keep(self, key: bytes, values: Iterable[NDArray[Any]]) -> None:
        """See `Journal.keep`."""
        self.kept.append((key, b"".join(np.ascontiguousarray(value).tobytes() for value in values)))


class _Renderers:
    """The renderers of this process, one for each part of the light."""

    def __init__(self) -> None:
        self._flux: dict[int, ChangeDrivenFlux] = {}
        self._blocks: dict[int, Blocks] = {}
        self._journal: _Relay | None = None

    def answer(self, name: str, part: int, *given: Any) -> tuple[Any, int, Counts, list[tuple[bytes, bytes]]]:
        """The answer to a call, rays and work of this part of the light up to now, and what its journal is to keep."""
        result = getattr(self, f"_{name}")(part, *given)
        flux, kept = self._flux[part], []
        if self._journal is not None:
            kept, self._journal.kept = self._journal.kept, []
        return result, flux.rays_traced, flux.counts, kept

    def _make(self, part: int, made: dict[str, Any]) -> None:
        self._flux[part] = ChangeDrivenFlux(**made)

    def _go_on(self, part: int, path: str, run: dict[str, Any], number: int) -> None:
        self._journal = self._journal or _Relay(path, run)
        self._flux[part].go_on(self._journal, number)

    def _call(self, part: int, name: str, given: tuple[Any, ...], others: dict[str, Any]) -> Any:
        return getattr(self._flux[part], name)(*given, **others)

    def _begin(self, part: int, *given: Any) -> tuple[Any, ...]:
        blocks = self._blocks[part] = self._flux[part].blocks(*given)
        return blocks.alive, blocks.own, blocks.base, blocks.count

    def _take(self, part: int, *given: Any) -> Any:
        return self._blocks[part].take(*given)


def main() -> None:
    """Answer calls until the run ends; its second argument is the number of threads."""
    warnings.simplefilter("ignore")  # the run warns of the same itself
    backend.jit()
    dr.set_thread_count(int(sys.argv[2]))
    serve(_Renderers().answer)
