"""A calibrated sensor beside captures that it was not fitted on: ``calibrate twin``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hesim_render.cli.console import Console, Json, Quiet
from hesim_render.cli.exit_status import ExitStatus
from hesim_render.cli.options import HelpAll, Overwrite


def twin(
    captures: Annotated[Path, typer.Argument(help="folder of EMVA 1288 captures")],
    out: Annotated[Path, typer.Option(help="folder to write: calibration, sensor file, page and figures of the twin")],
    seed: Annotated[int, typer.Option(help="of the simulated noise")] = 7,
    overwrite: Overwrite = False,
    json_: Json = False,
    quiet: Quiet = False,
    help_all: HelpAll = False,
) -> None:
    """Calibrate on half of the captures, test on the rest.

    The other half is simulated, and each statistic passes or fails.
    """
    from hesim_render.twin import make_twin
    from hesim_render.twin.page import check_line

    console = Console(json_, quiet)
    with console.progress("twin") as move:
        found = make_twin(
            captures, out, seed=seed, overwrite=overwrite, progress=lambda what, fraction: move(fraction, 1.0, what)
        )
    lines = [check_line(check) for check in found.checks]
    passed = sum(check.passed for check in found.checks)
    text = "\n".join([*lines, f"{passed} of {len(lines)} pass", f"in {out}"])
    facts = {"twin": found.folder, "passed": found.passed, "checks": {c.name: c.passed for c in found.checks}}
    console.result(text, facts, ExitStatus.DONE if found.passed else ExitStatus.NOT_MET)
