"""The test report of a sensor: ``report``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hesim_render.cli.console import Console, Json, Quiet
from hesim_render.cli.options import HelpAll, Overwrite
from hesim_render.cli.terminal import parse_size


def report(
    captures: Annotated[
        list[str],
        typer.Argument(
            metavar="SENSOR|CAPTURES...",
            help="a sensor, whose captures are simulated; or folders of captures: of event pixels (with bench.yaml), "
            "of frames (EMVA 1288), or one of each",
        ),
    ],
    out: Annotated[Path, typer.Option(help="folder to write: report.html, report.pdf, report.json")],
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT of the simulated pixels of each kind")] = "64x64",
    seed: Annotated[int, typer.Option(help="of the simulated noise", hidden=True)] = 7,
    overwrite: Overwrite = False,
    json_: Json = False,
    quiet: Quiet = False,
    help_all: HelpAll = False,
) -> None:
    """Write the test report of a sensor, real or simulated.

    EMVA 1288 figures of frames; thresholds, latency, background, dynamic range, bandwidth and limits of event pixels.
    """
    from hesim_render.report import make_report
    from hesim_render.report.texts import event_tables, frame_tables

    shape = parse_size(size)
    console = Console(json_, quiet)
    with console.progress("report") as move:
        result = make_report(
            captures, out, size=shape, seed=seed, overwrite=overwrite,
            progress=move.part,
        )  # fmt: skip
    tables = [] if result.events is None else event_tables(result.events)[:1]
    tables += [] if result.frames is None else frame_tables(result.frames)[:1]
    rows = [row for table in tables for row in table.rows]
    widest = max(len(row[0]) for row in rows)
    lines = [f"{name:<{widest}} {value:>10}  {between:<24} {unit}" for name, value, between, unit, *_ in rows]
    files = {kind: result.folder / f"report.{kind}" for kind in ("html", "pdf", "json")}
    lines.append(f"in {out}: {', '.join(file.name for file in files.values())}")
    console.result(
        "\n".join(line.rstrip() for line in lines), {"report": result.folder, "pages": result.pages, **files}
    )
