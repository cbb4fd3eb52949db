"""Comparisons of filter sets, designs of filters, and sweeps: ``study``."""

from pathlib import Path
from typing import Annotated, Any

import typer

from hesim_render.cli.console import Console, DryRun, Json, Quiet
from hesim_render.cli.exit_status import ExitStatus
from hesim_render.cli.options import FileKeys, HelpAll, Overwrite, names_of
from hesim_render.core.errors import ConflictError
from hesim_render.core.output import check_target
from hesim_render.core.progress import counted

#: Columns of the summary on the terminal.
_SHOWN = {
    "filter_set": "filter set", "ysnr_noise_aware": "YSNR noise-aware", "snr10_lux_noise_aware": "SNR10 lx noise-aware",
    "delta_e_mean_noise_aware": "ΔE2000 noise-aware", "white_saturation": "white / saturation",
    "ysnr": "YSNR noise-free matrix", "delta_e_mean": "ΔE2000 noise-free", "smi": "SMI", "vora": "Vora",
    "event_contrast_on": "event contrast", "event_seen": "steps seen",
}  # fmt: skip
#: Most rows of the summary.
_MOST = 40


def study(
    spec: Annotated[
        str,
        typer.Argument(
            metavar="SPEC",
            help="a comparison of filter sets, a design of filters or a sweep: a name (see 'info studies') or a file",
            autocompletion=names_of("studies"),
        ),
    ],
    out: Annotated[Path, typer.Option(help="folder of tables and report; an interrupted sweep continues there")],
    surfaces: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME or FILE",
            help="surfaces of a comparison, in place of its own: a scene, a cube, patches; repeatable",
        ),
    ] = None,
    set_: FileKeys = None,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
    json_: Json = False,
    quiet: Quiet = False,
    help_all: HelpAll = False,
) -> None:
    """Compare filter sets, design filters, or vary any keys.

    The kind is that of the file. Results are tables and, but for sweeps, a report.

    Ends with status 3 where the audits find runs of a sweep that are worse than it asks for.
    """
    from hesim_render.specs.files import parse_override
    from hesim_render.specs.run import StudyKind, study_kind
    from hesim_render.specs.study import surfaces_of

    kind = study_kind(spec)
    for name, value, taken in (
        ("--surfaces", surfaces, kind is StudyKind.comparison),
        ("--overwrite", overwrite, kind is not StudyKind.sweep),
        ("--dry-run", dry_run, kind is StudyKind.sweep),
    ):
        if value and not taken:
            raise ConflictError(name, value, f"{name}: not for a {kind.value}, which {spec} is")
    keys = dict(map(parse_override, set_ or []))
    console = Console(json_, quiet, dry_run)
    if kind is StudyKind.sweep:
        _sweep(console, spec, out, keys)
    elif kind is StudyKind.design:
        _design(console, spec, out, keys, overwrite)
    else:
        if surfaces:
            keys["surfaces"] = [surfaces_of(text) for text in surfaces]
        _compare(console, spec, out, keys, overwrite)


def _compare(console: Console, spec: str, out: Path, keys: dict[str, Any], overwrite: bool) -> None:
    """Figures of filter sets."""
    from hesim_render.specs.files import read_spec
    from hesim_render.specs.study import StudySpec

    chosen = read_spec(StudySpec, spec, "studies", keys)
    from hesim_render.studies.run import MARKER
    from hesim_render.studies.table import NOTE, level_text

    check_target(out, MARKER, overwrite)
    import hesim_render as hr

    with console.progress(chosen.name) as progress:
        table = hr.study(chosen, out=out, overwrite=overwrite, progress=progress)
    shown = {name: title for name, title in _SHOWN.items() if name in table.columns}
    every = ("surfaces", "illuminant", "illuminance_lux", "sensor", "crosstalk", "equal")
    varied = [name for name in every if len({row[name] for row in table}) > 1]
    lines = [[*varied, *shown.values()]]
    for row in list(table)[:_MOST]:
        cells = {name: _text(row[name]) for name in (*varied, *shown)}
        if "white_saturation" in cells:
            cells["white_saturation"] = level_text(row, cells["white_saturation"])
        lines.append(list(cells.values()))
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    console.text(
        "\n".join(
            "  ".join(f"{cell:<{width}}" for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines
        )
    )
    if len(table) > _MOST:
        console.text(f"and {len(table) - _MOST} more rows")
    if "ysnr_noise_aware" in shown:
        console.text(NOTE)
    from hesim_render.studies.verdict import ranking

    verdicts = ranking(table)
    console.text("\n".join(verdicts))
    console.result(
        f"{len(table)} rows in {out / 'results.csv'}; report: {out / 'report.html'}",
        {"results": out / "results.csv", "report": out / "report.html", "rows": list(table), "verdicts": verdicts},
    )


def _text(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, int | float) else str(value)


def _design(console: Console, spec: str, out: Path, keys: dict[str, Any], overwrite: bool) -> None:
    from hesim_render.specs.design import DesignSpec
    from hesim_render.specs.files import read_spec
    from hesim_render.studies.design_run import MARKER, design
    from hesim_render.studies.verdict import design_verdict

    chosen = read_spec(DesignSpec, spec, "studies", keys)
    check_target(out, MARKER, overwrite)
    with console.progress(chosen.name) as progress:
        result = design(chosen, out=out, overwrite=overwrite, progress=progress)
    costs = result.result.costs
    console.text(
        f"cost of {len(costs)} starts: " + ", ".join(f"{before:.3g} -> {after:.3g}" for before, after in costs)
    )
    for verdict in result.verdicts:
        console.text(" ".join(design_verdict(verdict)))
    console.result(
        f"sensor file: {out / 'sensor.yaml'}; report: {out / 'report.html'}",
        {"sensor": out / "sensor.yaml", "report": out / "report.html", "costs": costs, "verdicts": result.verdicts},
    )


def _sweep(console: Console, spec: str, out: Path, keys: dict[str, Any]) -> None:
    """Every combination of varied keys; runs that are there are not repeated."""
    from hesim_render.recording.quality import is_short_of_wish, verdict_lines
    from hesim_render.specs.files import read_spec
    from hesim_render.specs.sweep import SweepSpec
    from hesim_render.studies.sweep import VERDICT, check_sweep, sweep

    chosen = read_spec(SweepSpec, spec, "studies", keys)
    if console.dry_run:
        total, missing = check_sweep(chosen, out)
        text = f"{total} runs, {missing} of them not yet made; nothing was written (--dry-run)"
        console.result(text, {"dry_run": True, "runs": total, "missing": missing})
        return
    with console.progress(chosen.name) as progress:
        table = sweep(chosen, out=out, progress=progress)
    verdicts = table[VERDICT].tolist() if VERDICT in table.columns else []
    audits: dict[str, dict[str, object] | None] = {f"row {k + 1}": {"verdict": each} for k, each in enumerate(verdicts)}
    short = [name for name, audit in audits.items() if is_short_of_wish(audit)]
    lines = [
        f"{counted(len(table), 'run')} in {out / 'results.csv'}",
        *(f"  {line}" for line in verdict_lines(audits, "runs")),
    ]
    facts = {"results": out / "results.csv", "runs": len(table), "not_met": short}
    console.result("\n".join(lines), facts, ExitStatus.NOT_MET if short else ExitStatus.DONE)
