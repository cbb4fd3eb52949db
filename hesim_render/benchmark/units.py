"""Units of work of a build: clips, and spans of long clips, which come before them."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from hesim_render.benchmark.plan import Clip
from hesim_render.benchmark.spans import Span
from hesim_render.core.units import S_PER_US


@dataclass(frozen=True)
class Unit:
    """A clip, or a span of one.

    Parameters
    ----------
    clip : the clip.
    span : of its light alone, µs; None: all of it.
    """

    clip: Clip
    span: Span | None = None

    def as_dict(self) -> dict[str, Any]:
        """Fields of the clip, and ``span``, as plain values."""
        return self.clip.as_dict() | ({} if self.span is None else {"span": list(self.span)})

    @classmethod
    def of(cls, fields: dict[str, Any]) -> Unit:
        """The unit with such fields (`as_dict`)."""
        span = fields.get("span")
        return cls(Clip(**{k: v for k, v in fields.items() if k != "span"}), None if span is None else tuple(span))

    def __str__(self) -> str:
        if self.span is None:
            return self.clip.name
        return f"{self.clip.name}, {self.span[0] * S_PER_US:g} to {self.span[1] * S_PER_US:g} s"


class Waiting:
    """Units in the order in which they are begun: the spans of each clip, then the clip, once all of them are done.

    Parameters
    ----------
    clips : the clips.
    spans : of each clip.
    """

    def __init__(self, clips: Iterable[Clip], spans: Sequence[Span] = ()) -> None:
        self._units = deque(Unit(clip, span) for clip in clips for span in (*spans, None))
        #: Spans of each clip that are not done.
        self._open = {unit.clip.name: len(spans) for unit in self._units}

    def __len__(self) -> int:
        return len(self._units)

    def take(self) -> Unit | None:
        """The next unit that can begin; None where there is none, or all others wait for spans."""
        for place, unit in enumerate(self._units):
            if unit.span is not None or not self._open[unit.clip.name]:
                del self._units[place]
                return unit
        return None

    def done(self, unit: Unit) -> None:
        """Note that a unit is done."""
        if unit.span is not None:
            self._open[unit.clip.name] -= 1

    def again(self, unit: Unit) -> None:
        """Let a unit wait once more: the worker that had it is dead."""
        self._units.append(unit)

    def drop(self, clip: Clip) -> None:
        """Let nothing of a clip wait, because it cannot be built."""
        self._units = deque(unit for unit in self._units if unit.clip != clip)
