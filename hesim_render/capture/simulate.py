"""Render a scene, expose a sensor to it, and record frames and events."""

import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Literal, Unpack

from hesim_render.capture.run_settings import TERMS, RunOptions, RunSettings, noise_models
from hesim_render.capture.scene_renderer import camera_used, scene_renderer
from hesim_render.capture.scene_run import SceneRun
from hesim_render.core import backend
from hesim_render.core.errors import ConflictError, HesimWarning
from hesim_render.core.journal import Journal
from hesim_render.core.progress import Progress, expect, shown
from hesim_render.core.workers import checked_processes
from hesim_render.mosaic.schedule import require_countable
from hesim_render.recording.recording import Recording, warn_of_exposure
from hesim_render.recording.writer import RecordingWriter
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.render.change_driven.part_worker import start
from hesim_render.sources.render.framing import warn_if_unseen
from hesim_render.sources.render.light_level import in_absolute_light
from hesim_render.sources.render.renderer import SceneRenderer
from hesim_render.sources.renderer import Estimate
from hesim_render.sources.scene import Scene, scene_and_sensor
from hesim_render.specs.lens import LENS_TERMS


def simulate(
    scene: Scene | str | Path,
    sensor: Sensor | str | Path,
    *,
    renderer: SceneRenderer | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress | Literal[False] | None = None,
    on_estimate: Callable[[Estimate], None] | None = None,
    resume: bool = False,
    live: bool = False,
    workers: int = 1,
    **settings: Unpack[RunOptions],
) -> Recording:
    """Simulate a sensor in front of a scene: RAW frames, events, and their noise-free truth.

    Parameters
    ----------
    scene, sensor : from `load_scene` and `load_sensor` (crop the sensor for a region of interest), or names or paths.
    renderer : from `scene_renderer` with the same scene, sensor, seed and quality, fresh; it can be used again
        afterwards. None makes one. What a renderer has rendered decides no value, it only saves time later.
    out : folder to stream the recording into; None keeps it in memory.
    overwrite : replace an existing recording in `out`.
    progress : called with (done, total, what). None shows a bar in notebooks only, False never shows one.
    on_estimate : called with the estimate of time and memory before the run begins; an exception that it raises ends
        the run before anything is written.
    resume : keep what is rendered in a file beside `out`, until the recording is complete. The same call goes on from
        what an interrupted one has left there, and gives the same bytes.
    live : show frames and events while the run goes on: in the viewer rerun or, without a display, in ``live.rrd`` of
        the unfinished folder, which rerun can open.
    workers : number of processes that render, each its own rows of the sensor; 1 renders in this process. The recording
        is the same to the byte, but for the number of rays. A few times sooner on machines with many cores or a GPU;
        each process takes its own memory. The exact mode renders in this process.
    settings : fields of `RunSettings`, which says what each of them does: ``duration_s`` (0.1), ``seed`` (7), ``clean``
        and ``without`` (noise terms that are off), ``quality`` (0.5: wanted error of the render over the noise), or
        ``samples`` and ``exact`` for the exact mode, ``max_minutes``, ``truth``, ``truth_every_us``, ``audit``.

    Examples
    --------
    The mean of a clean frame is its electrons times the gain, above the black level, to half a DN of rounding:

    >>> import hesim_render as hr
    >>> sensor = hr.load_sensor("reference-mono").crop(32, 24)
    >>> rec = hr.simulate(hr.load_scene("flat-field"), sensor, duration_s=0.02, samples=4, clean=True)
    >>> frame, aps = rec.frames[0], sensor.spec.aps
    >>> signal = frame.electrons_mean.mean() * aps.system_gain_dn_per_e
    >>> bool(abs(frame.raw.mean() - aps.black_level_dn - signal) < 0.5)
    True

    Returns
    -------
    Recording
        Frames whose last row is exposed within the run, events, and their truth with standard
        errors from two independent halves of the render. ``settings.render`` of its manifest states the
        error that was reached.

    Raises
    ------
    RangeError
        If duration, seed, quality, sample count, noise term, kind of truth or number of workers is out of range.
    ConflictError
        If `quality` or `workers` comes with `exact` or `samples`, `workers` with a `renderer`, or scene and sensor are
        swapped.
    TooLongError
        If the run would take longer than `max_minutes`.
    SpecError
        If scene and sensor do not fit together (a spectrum that does not cover the response), or `live` is asked for
        and rerun is not installed.
    OutputError
        If `out` exists or cannot be written, or, with `resume`, if another run was interrupted there. No partial
        output is left.
    BackendError
        If workers cannot be started, or one of them ends.
    """
    scene, sensor = scene_and_sensor(scene, sensor)
    run_settings = RunSettings(**settings)
    duration_us, seed = run_settings.duration_us, run_settings.seed
    workers = checked_processes(workers)
    if workers > 1 and renderer is not None:
        raise ConflictError("workers", workers, "a renderer that is given renders in this process; give no workers")
    if workers > 1 and (run_settings.exact or run_settings.samples is not None):
        raise ConflictError(
            "workers",
            workers,
            "the exact mode renders in one process: give no --workers (workers) or no --exact, --samples",
        )
    # what can be refused without a renderer is refused before it compiles anything
    require_countable(sensor.spec.aps, sensor.spec.evs, duration_us)
    backend.jit()
    noise = noise_models(sensor, run_settings.clean, run_settings.without, TERMS)
    sensor = sensor.without([term for term in run_settings.without if term in LENS_TERMS])
    shared = start(workers) if workers > 1 else nullcontext()
    with shown(progress, f"{scene.name} → {sensor.name}") as report, shared as processes:
        if report is not None:
            report(0, 1, "preparation")
        # the renderer sees lights in absolute units; the recording keeps the scene as it is written
        seen, level = in_absolute_light(scene)
        asked = run_settings.quality, run_settings.samples, run_settings.exact
        source = renderer or scene_renderer(seen, sensor, seed, *asked, processes)
        warn_if_unseen(scene.spec, source.view, duration_us)
        # all that decides the bits of the recording; it is also the name of the journal that a later call goes on from
        stated = run_settings.as_dict() | source.settings
        if level is not None:
            stated["light_level"] = level.as_dict()
        stated |= {"backend": backend.select().label, "camera": camera_used(source.view)}
        # the estimate may end the run: nothing is written before it
        if workers > 1 and source.samples is not None:
            warnings.warn(
                "the scene needs the exact mode, which renders in one process: --workers (workers) changes nothing",
                HesimWarning,
                stacklevel=2,
            )
        run = SceneRun(source, noise, run_settings, report, workers if source.samples is None else 1)
        expected = run.expect(on_estimate)
        if expected is not None:
            expect(report, expected.seconds)
        with RecordingWriter(
            out, source.sensor, scene=scene.spec, seed=seed, duration_us=duration_us, settings=stated,
            overwrite=overwrite, live=live,
        ) as writer, _journal(resume and renderer is None, out, writer, overwrite) as journal:  # fmt: skip
            # traced pairs are taken from the journal of an interrupted run, and kept there for the next one
            if journal is not None:
                source.go_on(journal)
            run.record(writer)
            # the audit renders again what the run noted, so it comes after the run
            writer.add_settings({"render": run.verdict()})
            run.write_truth(writer, scene, sensor)
            return warn_of_exposure(writer.finish())


def _journal(
    is_kept: bool, out: str | Path | None, writer: RecordingWriter, overwrite: bool
) -> AbstractContextManager[Journal | None]:
    """The journal of a run whose recording goes to `out`; nothing where none is kept."""
    if not is_kept or out is None:
        return nullcontext()
    return Journal(out, writer.run, overwrite)
