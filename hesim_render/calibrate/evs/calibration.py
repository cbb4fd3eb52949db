"""EVS calibration: from counts of events to the parameters of the event pixels."""

from pathlib import Path

from hesim_render.calibrate.aps.calibration import described_captures
from hesim_render.calibrate.asynchronous import output as trials_output
from hesim_render.calibrate.asynchronous.analysis import analyse_trials
from hesim_render.calibrate.asynchronous.trials import is_asynchronous
from hesim_render.calibrate.evs import output
from hesim_render.calibrate.evs.analysis import analyse
from hesim_render.calibrate.evs.counts import event_tile, read_static
from hesim_render.calibrate.moments import Progress
from hesim_render.calibrate.report.page import write_report
from hesim_render.calibrate.result import check_calibration, check_report, write_section
from hesim_render.recording.capture_set import read_captures


def calibrate_evs(
    folder: str | Path,
    out: str | Path,
    report: str | Path | None = None,
    progress: Progress | None = None,
    seed: int = 0,
    overwrite: bool = False,
) -> Path:
    """Calibrate the events of a capture set and write (or update) a ``calibration.yaml``.

    Parameters
    ----------
    folder : capture set with ``capture.yaml``, ``evs_static.npz`` and, for θ, ``evs_steps.npz``; of an asynchronous
        sensor ``evs_noise_rate.npz`` and ``evs_s_curve.npz``.
    out : the calibration; its section ``evs`` is written, others are kept. Where ``evs_static.npz`` has no
        ``signal_dn``, the composite in its section ``aps`` is the signal: frames of the same scene.
    report : HTML file, if wanted; it covers every section of `out`, and an earlier report of `out` is replaced.
    progress : called with a text that names the current work and the fraction done.
    seed : seed of the multi-start study.
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
    captures = read_captures(folder)
    check_calibration(out, described_captures(captures))
    if report is not None:
        check_report(out, report, overwrite)
    tell = progress or (lambda what, fraction: None)
    tell("reading event counts", 0.0)
    if is_asynchronous(captures):
        trials = analyse_trials(captures, seed, tell)
        event_tile(captures, trials.steps.shape)
        section, maps = trials_output.content(trials), trials_output.maps(trials)
    else:
        counts = analyse(captures, read_static(captures, out), seed, tell)
        section, maps = output.content(captures, counts), output.maps(captures, counts)
    tell("writing", 0.95)
    write_section(out, "evs", described_captures(captures), section, maps)
    if report is not None:
        write_report(out, report, overwrite)
    tell("done", 1.0)
    return Path(out)
