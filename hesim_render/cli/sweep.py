"""Sweeps over keys of scenes and sensors: ``sweep``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hesim_render.cli.exit_status import ExitStatus
from hesim_render.cli.told import DryRun, Json, Quiet, Told


def sweep(
    spec: Annotated[str, typer.Argument(metavar="SPEC", help="path of the sweep's file")],
    out: Annotated[Path, typer.Option(help="folder for the table; a sweep that was ended goes on there")],
    dry_run: DryRun = False,
    json_: Json = False,
    quiet: Quiet = False,
) -> None:
    """Simulate every combination of varied keys, and tabulate figures of each run; can be resumed.

    Ends with status 3 where the audits find runs that are worse than the sweep asks for.
    """
    from hesim_render.recording.quality import is_short_of_wish, verdict_lines
    from hesim_render.studies.sweep import VERDICT, check_sweep
    from hesim_render.studies.sweep import sweep as run

    told = Told(json_, quiet, dry_run)
    if dry_run:
        total, missing = check_sweep(spec, out)
        text = f"{total} runs, {missing} of them not yet made; nothing was written (--dry-run)"
        told.result(text, {"dry_run": True, "runs": total, "missing": missing})
        return
    with told.progress("sweep") as progress:
        table = run(spec, out=out, progress=progress)
    verdicts = table[VERDICT].tolist() if VERDICT in table.columns else []
    audits: dict[str, dict[str, object] | None] = {f"row {k + 1}": {"verdict": each} for k, each in enumerate(verdicts)}
    short = [name for name, audit in audits.items() if is_short_of_wish(audit)]
    told.result(
        "\n".join(
            [f"{len(table)} runs in {out / 'results.csv'}", *(f"  {line}" for line in verdict_lines(audits, "runs"))]
        ),
        {"results": out / "results.csv", "runs": len(table), "not_met": short},
        ExitStatus.NOT_MET if short else ExitStatus.DONE,
    )
