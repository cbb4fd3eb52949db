"""Sweeps over keys of scenes and sensors: ``sweep``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hesim_render.cli.terminal import say
from hesim_render.core.progress import progress_report


def sweep(
    spec: Annotated[str, typer.Argument(metavar="SPEC", help="path of the sweep's file")],
    out: Annotated[Path, typer.Option(help="folder for the table; a sweep that was ended goes on there")],
) -> None:
    """Simulate every combination of varied keys, and tabulate figures of each run; can be resumed."""
    from hesim_render.studies.sweep import sweep as run

    with progress_report("sweep") as progress:
        table = run(spec, out=out, progress=progress)
    say(f"{len(table)} runs in {out / 'results.csv'}")
