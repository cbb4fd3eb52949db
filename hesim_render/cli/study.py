"""Studies of filter sets: ``study``."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from hesim_render.cli.options import Overwrite
from hesim_render.cli.terminal import say
from hesim_render.core.output import check_target
from hesim_render.core.progress import progress_report

#: Columns of the summary on the terminal.
_SHOWN = {
    "filter_set": "filter set", "delta_e_mean": "ΔE2000", "smi": "SMI", "vora": "Vora", "noise_amplification": "ampl.",
    "ysnr": "YSNR", "snr10_lux": "SNR10 lx", "event_contrast_on": "event contrast", "event_seen": "steps seen",
}  # fmt: skip
#: Most rows of the summary.
_MOST = 40


class StudyKind(StrEnum):
    """What can be studied."""

    cfa = "cfa"


def study(
    kind: Annotated[StudyKind, typer.Argument(help="cfa (colour filter arrays)")],
    spec: Annotated[str, typer.Argument(metavar="SPEC", help="name of a shipped study, or the path of its file")],
    out: Annotated[Path, typer.Option(help="folder to write tables and report to")],
    overwrite: Overwrite = False,
) -> None:
    """Compare filter sets: colour, noise and event figures, as tables and a report."""
    from hesim_render.studies.run import MARKER

    check_target(out, MARKER, overwrite)
    import hesim_render as hr

    with progress_report(f"study {kind.value}") as progress:
        table = hr.study(spec, out=out, overwrite=overwrite, progress=progress)
    shown = {name: title for name, title in _SHOWN.items() if name in table.columns}
    keys = [name for name in ("illuminant", "illuminance_lux", "equal") if len({row[name] for row in table}) > 1]
    lines = [[*keys, *shown.values()]]
    for row in list(table)[:_MOST]:
        lines.append([_text(row[name]) for name in (*keys, *shown)])
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    say(
        "\n".join(
            "  ".join(f"{cell:<{width}}" for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines
        )
    )
    if len(table) > _MOST:
        say(f"and {len(table) - _MOST} more rows")
    say(f"{len(table)} rows in {out / 'results.csv'}; report: {out / 'report.html'}")


def _text(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, int | float) else str(value)
