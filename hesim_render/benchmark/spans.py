"""Spans of a long clip: several workers render its light side by side, and the clip is made from what they kept.

The flux of a window is a pure function of the window, so a span can be rendered without those before it. Its journal,
in a hidden folder beside the clip, holds what it has traced. The clip itself is the last unit of work: it goes through
the whole time, takes the light from these journals, traces what is in none of them, and makes events, noise and files.
Its bytes are therefore those of a clip without spans, also where a span is missing or was rendered twice.

Units of work of a build: clips, and spans of long clips, which come before them.
"""

import shutil
import tempfile
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hesim_render.benchmark.plan import Clip
from hesim_render.core.journal import Journal, key_of
from hesim_render.core.output import output_errors, short_name
from hesim_render.core.units import S_PER_US

#: Begin and end, µs.
Span = tuple[int, int]
#: Clips that last longer have spans.
SPAN_S = 1.0


def spans_of(duration_us: int, span_us: int) -> tuple[Span, ...]:
    """Equal spans of a clip, none longer than `span_us`; none at all where one would do, or `span_us` is 0."""
    count = -(-duration_us // span_us) if span_us else 1
    edges = [round(k * duration_us / count) for k in range(count + 1)]
    return tuple(zip(edges[:-1], edges[1:], strict=True)) if count > 1 else ()


def spans_folder(folder: Path) -> Path:
    """Where the journals of the spans of a clip are, and their scenes while they are rendered."""
    return folder.with_name(f".{short_name(folder)}.spans")


def journals_in(folder: Path) -> list[Path]:
    """The journals of all spans of a clip that were begun."""
    place = spans_folder(folder)
    return sorted(path for path in place.iterdir() if path.is_file()) if place.is_dir() else []


def span_journal(folder: Path, span: Span, run: dict[str, object]) -> Journal:
    """The journal of a span, which knows what other spans have traced up to now.

    Parameters
    ----------
    folder, span : the clip's folder, and the span.
    run : all that the light of the clip depends on.
    """
    name = f"{span[0]:012d}-{span[1]:012d}"
    given = {"overwrite": True, "shared": True, "others": journals_in(folder), "stays": True}
    return Journal(spans_folder(folder) / name, run, **given)  # type: ignore[arg-type]


def is_rendered(journal: Journal, span: Span) -> bool:
    """True if the journal of a span holds all of it, and so ends with an entry that says so."""
    return journal.recall(key_of("span", *span), [])


def note_rendered(journal: Journal, span: Span) -> None:
    """Write into the journal of a span that it holds all of it."""
    journal.keep(key_of("span", *span), [])


@contextmanager
def scratch(folder: Path) -> Iterator[Path]:
    """A folder for the scene of a span. What a killed process leaves there goes with the finished clip."""
    place = spans_folder(folder)
    with output_errors(place):
        place.mkdir(parents=True, exist_ok=True)
        made = tempfile.mkdtemp(dir=place)
    try:
        yield Path(made)
    finally:
        shutil.rmtree(made, ignore_errors=True)


def discard_spans(folder: Path) -> None:
    """Remove all that spans of a clip have left."""
    shutil.rmtree(spans_folder(folder), ignore_errors=True)


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
    def of(cls, fields: dict[str, Any]) -> "Unit":
        """The unit with such fields (`as_dict`)."""
        span = fields.get("span")
        return cls(Clip(**{k: v for k, v in fields.items() if k != "span"}), None if span is None else tuple(span))

    def __str__(self) -> str:
        if self.span is None:
            return self.clip.name
        return f"{self.clip.name}, {self.span[0] * S_PER_US:g} to {self.span[1] * S_PER_US:g} s"


class Waiting:
    """Units in the order in which they are begun: the spans of each clip, then the clip, once all of them are done."""

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
