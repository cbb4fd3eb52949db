"""Studies of filter sets: ``study``."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from hesim_render.cli.options import Overwrite
from hesim_render.cli.told import Json, Quiet, Told
from hesim_render.core.errors import RangeError
from hesim_render.core.output import check_target

#: Columns of the summary on the terminal.
_SHOWN = {
    "filter_set": "filter set", "ysnr_noise_aware": "YSNR noise-aware", "snr10_lux_noise_aware": "SNR10 lx noise-aware",
    "delta_e_mean_noise_aware": "ΔE2000 noise-aware", "white_saturation": "white / saturation",
    "ysnr": "YSNR noise-free matrix", "delta_e_mean": "ΔE2000 noise-free", "smi": "SMI", "vora": "Vora",
    "event_contrast_on": "event contrast", "event_seen": "steps seen",
}  # fmt: skip
#: Most rows of the summary.
_MOST = 40


class StudyKind(StrEnum):
    """What can be studied."""

    cfa = "cfa"
    design = "design"


def study(
    kind: Annotated[StudyKind, typer.Argument(help="cfa (compare colour filter arrays) or design (of filters)")],
    spec: Annotated[str, typer.Argument(metavar="SPEC", help="name of a shipped study or design, or a file")],
    out: Annotated[Path, typer.Option(help="folder to write tables and report to")],
    surfaces: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME or FILE", help="what cfa looks at, in place of the study's own: a scene, a cube, patches"
        ),
    ] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="change a key of the file; repeatable")
    ] = None,
    overwrite: Overwrite = False,
    json_: Json = False,
    quiet: Quiet = False,
) -> None:
    """Compare filter sets, or design filters: colour, noise and event figures, as tables and a report."""
    from hesim_render.specs.files import parse_override
    from hesim_render.specs.study import read_study, surfaces_of

    keys = dict(map(parse_override, set_ or []))
    if kind is StudyKind.design:
        if surfaces:
            raise RangeError("--surfaces", ", ".join(surfaces), "none in a design, which has fit and judge in its file")
        _design(Told(json_, quiet), spec, out, keys, overwrite)
        return
    if surfaces:
        keys["surfaces"] = [surfaces_of(text) for text in surfaces]
    chosen = read_study(spec, keys)
    from hesim_render.studies.headings import NOTE, level_text
    from hesim_render.studies.run import MARKER

    check_target(out, MARKER, overwrite)
    import hesim_render as hr

    told = Told(json_, quiet)
    with told.progress(f"study {kind.value}") as progress:
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
    told.text(
        "\n".join(
            "  ".join(f"{cell:<{width}}" for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines
        )
    )
    if len(table) > _MOST:
        told.text(f"and {len(table) - _MOST} more rows")
    if "ysnr_noise_aware" in shown:
        told.text(NOTE)
    told.result(
        f"{len(table)} rows in {out / 'results.csv'}; report: {out / 'report.html'}",
        {"results": out / "results.csv", "report": out / "report.html", "rows": list(table)},
    )


def _text(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, int | float) else str(value)


def _design(told: Told, spec: str, out: Path, keys: dict[str, Any], overwrite: bool) -> None:
    from hesim_render.specs.design import read_design
    from hesim_render.studies.design_run import MARKER, design

    chosen = read_design(spec, keys)
    check_target(out, MARKER, overwrite)
    with told.progress("study design") as progress:
        found = design(chosen, out=out, overwrite=overwrite, progress=progress)
    costs = found.result.costs
    told.text(f"cost of {len(costs)} starts: " + ", ".join(f"{before:.3g} -> {after:.3g}" for before, after in costs))
    for verdict in found.verdicts:
        aware, free = (
            ", ".join(
                f"{value:.3f} at {key.split('_')[-2]} lx" for key, value in verdict.items() if key.startswith(start)
            )
            for start in ("ysnr_noise_aware_ratio", "ysnr_ratio")
        )
        told.text(
            f"against {verdict['against']}: cost {verdict['cost']:.3f} in place of {verdict['cost_against']:.3f} "
            f"(difference {verdict['cost_difference_low']:.3f} to {verdict['cost_difference_high']:.3f}), noise-aware "
            f"YSNR times {aware}; noise-free: mean ΔE2000 {verdict['delta_e_mean']:.3f} in place of "
            f"{verdict['delta_e_mean_against']:.3f}, YSNR with the matrix of colour times {free}"
        )
    told.result(
        f"sensor file: {out / 'sensor.yaml'}; report: {out / 'report.html'}",
        {"sensor": out / "sensor.yaml", "report": out / "report.html", "costs": costs, "verdicts": found.verdicts},
    )
