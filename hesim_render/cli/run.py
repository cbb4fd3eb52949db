"""Whole runs from a file: ``run``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hesim_render.cli.exit_status import ExitStatus
from hesim_render.cli.options import LONG_MINUTES, AllowOutside, Overwrite, Yes
from hesim_render.cli.terminal import summary
from hesim_render.cli.told import DryRun, Json, Quiet, Told, recording_facts


def run(
    file: Annotated[Path, typer.Argument(metavar="RUN.yaml", help="file of the run (docs/cli.md)")],
    out: Annotated[Path, typer.Option(help="folder of all results; a run that was ended goes on there")],
    yes: Yes = False,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="change a key of the file of the run")
    ] = None,
    allow_outside: AllowOutside = False,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
    json_: Json = False,
    quiet: Quiet = False,
) -> None:
    """Do a whole run from one file: record a scene, video or cube, then develop, export and view it."""
    told = Told(json_, quiet, dry_run)
    with told.stop_at_estimate(), told.progress(file.name) as progress:
        from hesim_render.capture.run_file import run as run_all
        from hesim_render.recording.quality import is_short_of_wish
        from hesim_render.specs.files import parse_override

        changes = dict(map(parse_override, set_ or []))
        made = run_all(
            file, out, overrides=changes, allow_outside=allow_outside, overwrite=overwrite, progress=progress,
            on_estimate=told.estimated(progress), max_minutes=None if yes else LONG_MINUTES,
        )  # fmt: skip
    short = is_short_of_wish(made.recording.manifest["settings"].get("render", {}).get("audit"))
    lines = [summary(made.recording), *(f"  {name}: {path}" for name, path in list(made.written.items())[1:])]
    if made.kept:
        lines.append(f"  made by an earlier run: {', '.join(made.kept)}")
    told.result(
        "\n".join(lines),
        {**recording_facts(made.recording), "written": made.written, "kept": list(made.kept)},
        ExitStatus.NOT_MET if short else ExitStatus.DONE,
    )
