"""EVS calibration: from counts of events to the parameters of the event pixels."""

from __future__ import annotations

from pathlib import Path

from hesim_render.calibrate.aps.calibration import describe
from hesim_render.calibrate.evs.analysis import analyse, bootstrap_errors
from hesim_render.calibrate.evs.counts import read_static
from hesim_render.calibrate.moments import Progress
from hesim_render.recording.capture_set import read_captures


def calibrate_evs(
    folder: str | Path,
    out: str | Path,
    report: str | Path | None = None,
    progress: Progress | None = None,
    bootstrap: int = 0,
    seed: int = 0,
    overwrite: bool = False,
) -> Path:
    """Calibrate the events of a capture set and write (or update) a ``calibration.yaml``.

    Parameters
    ----------
    folder : capture set with ``capture.yaml``, ``evs_static.npz`` and, for θ, ``evs_steps.npz``.
    out : the calibration; its section ``evs`` is written, others are kept. Where ``evs_static.npz`` has no
        ``signal_dn``, the composite in its section ``aps`` is the signal: frames of the same scene.
    report : HTML file, if one is wanted; it covers every section of `out`, and a report of `out` is replaced.
    progress : called with what is being done and the fraction done.
    bootstrap : number of resamplings of the pixels for a second opinion on the standard errors.
    seed : of the multi-start study and the bootstrap.
    overwrite : replace a report of another calibration.

    Returns
    -------
    Path of the calibration.

    Raises
    ------
    SpecError
        If the captures cannot be used; the message says what to capture instead.
    OutputError
        If a result cannot be written.
    """
    from hesim_render.calibrate.evs.output import content, maps
    from hesim_render.calibrate.result import check_calibration, check_report, write_section

    captures = read_captures(folder)
    check_calibration(out, describe(captures))
    if report is not None:
        check_report(out, report, overwrite)
    tell = progress or (lambda what, fraction: None)
    tell("reading event counts", 0.0)
    static = read_static(captures, out)
    result = analyse(captures, static, seed, tell)
    errors = bootstrap_errors(result, bootstrap, seed) if bootstrap else None
    tell("writing", 0.95)
    write_section(out, "evs", describe(captures), content(captures, result, errors), maps(result))
    if report is not None:
        from hesim_render.calibrate.report.page import write_report

        write_report(out, report, overwrite)
    tell("done", 1.0)
    return Path(out)
