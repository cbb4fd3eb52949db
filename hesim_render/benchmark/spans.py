"""Spans of a long clip: several workers render its light side by side, and the clip is made from what they kept.

The flux of a window is a pure function of the window, so a span can be rendered without those before it. Its journal,
in a hidden folder beside the clip, holds what it has traced. The clip itself is the last unit of work: it goes through
the whole time, takes the light from these journals, traces what is in none of them, and makes events, noise and files.
Its bytes are therefore those of a clip without spans, also where a span is missing or was rendered twice.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hesim_render.core.journal import Journal, key_of
from hesim_render.core.output import output_errors, short_name

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
    """Where the journals of the spans of a clip are, and their scenes while they are rendered.

    Parameters
    ----------
    folder : of the clip.
    """
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
