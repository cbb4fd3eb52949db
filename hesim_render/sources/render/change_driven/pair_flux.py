"""Results of tracing pairs of a pixel and a window: flux, and the statistics of a pilot pass."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.journal import Journal, key_of
from hesim_render.sources.render.change_driven.aim import PairAims
from hesim_render.sources.render.change_driven.windows import Windows


@dataclass(frozen=True)
class PairFlux:
    """Flux of pairs, one entry per pair.

    Parameters
    ----------
    half_a, half_b : two independent estimates of the mean flux, e⁻/s, float32.
    met : True if any path came through the box of a moving object.
    """

    half_a: NDArray[np.float32]
    half_b: NDArray[np.float32]
    met: NDArray[np.bool_]

    @property
    def mean(self) -> NDArray[np.float32]:
        return np.float32(0.5) * (self.half_a + self.half_b)


@dataclass(frozen=True)
class PilotFlux:
    """Statistics of a few rays of each pair, one entry per pair, for both estimators of `MattIntegrator`.

    Parameters
    ----------
    lit, hidden : mean flux, e⁻/s, float32.
    lit_scatter, hidden_scatter : scatter of single rays, e⁻/s, float32: the root of the mean fourth power of deviations
        over their mean square. It equals the standard deviation if half of the rays give one value and half another.
        It is larger if few rays deviate, because stratification then gains less.
    unshadowed : flux if nothing hid any light, e⁻/s, float32.
    met : see `PairFlux`.
    """

    lit: NDArray[np.float32]
    hidden: NDArray[np.float32]
    unshadowed: NDArray[np.float32]
    lit_scatter: NDArray[np.float32]
    hidden_scatter: NDArray[np.float32]
    met: NDArray[np.bool_]


def remembered(
    journal: Journal | None,
    inputs: tuple[object, ...],
    out: PairFlux | PilotFlux,
    part: slice | NDArray[np.int64],
    trace: Callable[[], None],
) -> None:
    """Put the results of some pairs into `out`: those of an interrupted run, or new ones, which the journal keeps.

    Parameters
    ----------
    journal : None where none is written.
    inputs : all that the results depend on.
    out, part : results of all pairs, and which of them are meant.
    trace : puts new ones into `out`.
    """
    if journal is None:
        trace()
        return
    every = [getattr(out, each.name) for each in fields(out)]
    key, found = key_of(*inputs), [values[part].copy() for values in every]
    if journal.recall(key, found):
        for values, known in zip(every, found, strict=True):
            values[part] = known
    else:
        trace()
        journal.keep(key, [values[part] for values in every])


def told_of(windows: Windows, span_us: tuple[float, float] | None, aims: PairAims | None) -> tuple[object, ...]:
    """What the flux of pairs depends on besides the pairs themselves."""
    aimed = () if aims is None else (aims.first, aims.count, aims.group)
    return windows.begin_us, windows.end_us, span_us, *aimed
