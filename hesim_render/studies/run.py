"""Run a study from its file, and write its results."""

import json
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any, Literal

from hesim_render.core.output import OutputFolder, output_errors
from hesim_render.core.progress import Progress, shown
from hesim_render.specs.files import read_spec
from hesim_render.specs.study import StudySpec
from hesim_render.studies.cfa import run_study
from hesim_render.studies.report import report_page
from hesim_render.studies.table import Table, has_parquet
from hesim_render.studies.verdict import ranking

#: File that marks the folder of a study.
MARKER = "results.json"


def study(
    spec: str | Path | Mapping[str, Any] | StudySpec,
    *,
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress | Literal[False] | None = None,
) -> Table:
    """Compare filter sets: colour, noise and event figures of every combination that a study names.

    Parameters
    ----------
    spec : name of a shipped study, path of a file, or its content as a dictionary (``docs/studies.md``).
    out : folder for ``results.csv``, ``results.json``, ``results.parquet`` (if pyarrow is installed) and
        ``report.html``; None writes nothing.
    overwrite : replace the results of another study in `out`.
    progress : called with (done, total, what). None shows a bar in notebooks only, False never shows one.

    Examples
    --------
    >>> import hesim_render as hr
    >>> sets = ["rggb", "ryyb"]
    >>> table = hr.study({"schema_version": 1, "name": "two", "sensors": ["reference-bayer"], "filter_sets": sets})
    >>> table["filter_set"].tolist(), bool(table["ysnr"][1] > table["ysnr"][0])
    (['rggb', 'ryyb'], True)

    Returns
    -------
    A row for each combination; columns are described in ``docs/studies.md``.

    Raises
    ------
    SpecError
        If a file is not valid, or parts of the study do not fit together.
    RangeError
        If the chart of a noisy simulation is larger than the sensor.
    OutputError
        If `out` exists or cannot be written. No partial output is left.
    """
    read = read_spec(StudySpec, spec, "studies")
    with nullcontext() if out is None else OutputFolder(out, MARKER, overwrite) as folder:
        with shown(progress, read.name) as report:
            result = run_study(read, report)
        if folder is not None:
            with output_errors(folder.target):
                result.table.write(folder.path / "results.csv")
                if has_parquet():
                    result.table.write(folder.path / "results.parquet")
                content = json.loads(read.model_dump_json())
                text = result.table.to_json(study=content, schema_version=1, verdicts=ranking(result.table))
                (folder.path / MARKER).write_text(text, encoding="utf-8")
                (folder.path / "report.html").write_text(report_page(read, result), encoding="utf-8")
    return result.table
