"""Two recordings of events of similar scenes: ``compare``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hesim_render.cli.console import Console, Json, Quiet
from hesim_render.cli.options import HelpAll
from hesim_render.cli.terminal import parse_size


def compare(
    first: Annotated[Path, typer.Argument(metavar="RECORDING", help="event file, such as that of a real camera")],
    second: Annotated[Path, typer.Argument(metavar="RECORDING", help="event file of a similar scene")],
    size: Annotated[str | None, typer.Option(help="WIDTHxHEIGHT of the sensor, if files do not state it")] = None,
    json_: Json = False,
    quiet: Quiet = False,
    help_all: HelpAll = False,
) -> None:
    """Compare the events of two recordings of similar scenes.

    Rates, intervals, correlations, polarity, hot pixels and bursts, each as a distance with an interval.
    """
    from hesim_render.exchange import open_events
    from hesim_render.measure.event_distance import event_distances, event_statistics

    shape = None if size is None else parse_size(size)
    console = Console(json_, quiet)
    with console.progress("compare") as move:
        statistics = []
        for k, file in enumerate((first, second)):
            move(0.4 * k, 1.0, f"read {file.name}")
            statistics.append(event_statistics(open_events(file, shape=shape, keep_stated=True)))
        move(0.8, 1.0, "compare")
        result = event_distances(statistics[0], statistics[1])
    lines = [f"{'':<11} {'distance':>9} {'95 % interval':>19} {'within first':>12}  {'first':>9} {'second':>9}"]
    for one in result:
        low, high = one.interval_95
        numbers = "" if one.first is None else f"{one.first:>9.4g} {one.second:>9.4g}"
        mark = "differs" if one.differs else ""
        between = f"{low:.4g} to {high:.4g}"
        lines.append(
            f"{one.name:<11} {one.value:>9.4g} {between:>19} {one.within:>12.4g}  {numbers:<19} {mark}".rstrip()
        )
    lines += [f"{one.name}: {one.definition}" for one in result]
    console.result("\n".join(lines), {"distances": [one.described() for one in result]})
