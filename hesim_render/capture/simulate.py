"""Render a scene, expose a sensor to it, and record frames and events."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hesim_render.capture.exact_estimate import estimate_exact
from hesim_render.capture.loop import Capture
from hesim_render.capture.noise_terms import TERMS, noise_models
from hesim_render.capture.overheads import with_overheads
from hesim_render.capture.stated_verdict import stated_verdict
from hesim_render.core import backend
from hesim_render.core.errors import ConflictError, RangeError, SpecError, TooLongError
from hesim_render.core.journal import Journal
from hesim_render.core.progress import Progress, ProgressReport, shown
from hesim_render.core.units import US_PER_S
from hesim_render.mosaic.schedule import BlockSample, require_countable
from hesim_render.recording.exposure import warn_of_exposure
from hesim_render.recording.recording import Recording
from hesim_render.recording.truth_kinds import EVENTS, truth_kinds
from hesim_render.recording.writer import RecordingWriter
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.flicker import flickering
from hesim_render.sources.render.audit.audit import STRETCHES, Audit
from hesim_render.sources.render.audit.units import NotedFlux
from hesim_render.sources.render.change_driven.flux import QUALITY, ChangeDrivenFlux
from hesim_render.sources.render.change_driven.forecast import Estimate, forecast
from hesim_render.sources.render.exact import RenderedFlux
from hesim_render.sources.render.framing import warn_if_unseen
from hesim_render.sources.render.light_level import in_absolute_light
from hesim_render.sources.render.transport.needs_exact import NeedsExactMode
from hesim_render.sources.render.truth.scene_truth import SceneTruth
from hesim_render.sources.scene import Scene, scene_and_sensor
from hesim_render.specs.lens import LENS_TERMS
from hesim_render.spectral.waveform import Waveform

#: Default rays per pixel in the exact mode. A static scene is rendered once for the whole run,
#: a moving one once per slice.
STATIC_SAMPLES = 64
MOVING_SAMPLES = 16


def simulate(
    scene: Scene | str | Path,
    sensor: Sensor | str | Path,
    *,
    duration_s: float = 0.1,
    seed: int = 7,
    clean: bool = False,
    without: Sequence[str] = (),
    quality: float | None = None,
    samples: int | None = None,
    exact: bool = False,
    max_minutes: float | None = None,
    truth: str | Sequence[str] = (),
    truth_every_us: int | None = None,
    audit: bool = True,
    renderer: tuple[Any, dict[str, Any]] | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress | Literal[False] | None = None,
    on_estimate: Callable[[Estimate], None] | None = None,
    resume: bool = False,
) -> Recording:
    """Simulate a sensor in front of a scene: RAW frames, events, and their noise-free truth.

    Parameters
    ----------
    scene, sensor : from `load_scene` and `load_sensor` (crop the sensor for a region of interest), or names or paths.
    duration_s : simulated time from 0, s.
    seed : seed of the temporal noise and of the render's samples. The fixed maps of the device come from the
        device seed of the sensor file.
    clean : switch every noise term off.
    without : names of noise terms and of effects of the lens to switch off, such as ``aps.read`` or
        ``lens.distortion``.
    quality : wanted error of the render, as a fraction of the sensor's own noise; default 0.5. Each pixel gets as
        many rays as this error needs, and only pixels that change are rendered again. An audit measures what this
        misses.
    samples : rays per pixel and slice, even. Selects the exact mode, in place of `quality`.
    exact : render every pixel of every slice with the same number of rays; default 64 for a static scene, 16
        for a moving one.
    max_minutes : refuse a run whose estimated time is longer, min; None sets no limit.
    truth : kinds of geometric truth to write into the recording (`TRUTH_KINDS`, or ``all``): ``depth``, ``flow``, …
        Without `out`, `Recording.truth` computes them when they are asked for.
    truth_every_us : interval between the times at which event pixels are described, µs; default: the middle of each
        frame, or every 10 ms where there are none.
    audit : measure the error of the render with random numbers of its own. Without it the run is shorter, all else is
        the same to the bit, and ``settings.render`` has no audit.
    renderer : from `flux_source` with the same scene, sensor, seed and quality, fresh; it can be used again afterwards.
        None makes one. What a renderer has rendered decides no value, it only saves time later.
    out : folder to stream the recording into; None keeps it in memory.
    overwrite : replace an existing recording in `out`.
    progress : called with (done, total, what). None shows a bar in notebooks only, False never shows one.
    on_estimate : called with the estimate of time and memory before the run begins; an exception that it raises ends
        the run before anything is written.
    resume : keep what is rendered in a file beside `out`, until the recording is complete. The same call goes on from
        what an interrupted one has left there, and gives the same bytes.

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
        If duration, seed, quality, sample count, noise term or kind of truth is out of range.
    ConflictError
        If `quality` comes with `exact` or `samples`, or scene and sensor are swapped.
    TooLongError
        If the run would take longer than `max_minutes`.
    SpecError
        If scene and sensor do not fit together (a spectrum that does not cover the response).
    OutputError
        If `out` exists or cannot be written, or, with `resume`, if another run was interrupted there. No partial
        output is left.
    """
    scene, sensor = scene_and_sensor(scene, sensor)
    duration_us = _duration_us(duration_s)
    if not 0 <= seed < 2**64:
        raise RangeError("seed", seed, "0 to 2^64 - 1")
    if quality is not None and (exact or samples is not None):
        other = "samples" if samples is not None else "exact"
        raise ConflictError(
            "quality",
            quality,
            f"give --quality or --{other} (quality, {other}), not both: --quality asks for an error and gives each "
            f"pixel the rays that takes, --{other} belongs to the exact mode, which gives all pixels the same number",
        )
    kinds = truth_kinds(truth)
    if truth_every_us is not None and not 1 <= truth_every_us <= duration_us:
        raise RangeError("truth_every_us", truth_every_us, f"1 to {duration_us} µs, the length of the run")
    require_countable(sensor.spec.aps, sensor.spec.evs, duration_us)
    backend.jit()
    noise = noise_models(sensor, clean, without, TERMS)
    sensor = sensor.without([term for term in without if term in LENS_TERMS])
    settings: dict[str, Any] = {"clean": clean, "without": list(without)}
    if kinds:
        settings["truth"] = {"kinds": list(kinds), "every_us": truth_every_us}
    with shown(progress, f"{scene.name} → {sensor.name}") as told:
        if told is not None:
            told(0, 1, "preparation")
        seen, level = in_absolute_light(scene)
        flux, mode = renderer or flux_source(seen, sensor, seed, quality, samples, exact, told)
        warn_if_unseen(scene.spec, flux.view, duration_us)
        settings |= mode
        if level is not None:
            settings["light_level"] = level.as_dict()
        settings |= {"backend": backend.select().label, "camera": _camera_used(flux)}
        rendering = _change_driven_parts(flux)
        wanted = rendering[0].quality if rendering else None
        labels = EVENTS in kinds
        plain = Capture(flux, flux.sensor, *noise, duration_us, seed, labels=labels and not rendering)
        sample = plain.sample_of_event_blocks() if rendering and not flux.is_static else BlockSample([], 1.0)
        expected: Estimate | None = None
        is_asked = told is not None or on_estimate is not None or max_minutes is not None
        if rendering and is_asked:  # it takes as long as a short run, and changes nothing
            expected = forecast(rendering, plain.event_pixels, sample, *plain.frame_exposures, progress=told)
        elif on_estimate is not None or max_minutes is not None:
            expected = estimate_exact(flux, plain, settings["samples"])
            sample = BlockSample([], 1.0) if flux.is_static else plain.sample_of_event_blocks()
        if expected is not None:
            expected = with_overheads(
                expected, flux.sensor, duration_us, sample.windows, len(plain.frame_exposures[1]),
                audited=bool(rendering) and audit, rests=flux.is_static,
            )  # fmt: skip
            if on_estimate is not None:
                on_estimate(expected)
            if max_minutes is not None and expected.seconds > 60 * max_minutes:
                raise TooLongError(
                    "max_minutes",
                    max_minutes,
                    f"this run takes {expected}, and one of more than {max_minutes:g} min has to be wanted: add --yes "
                    "(max_minutes=None), or ask for less: a shorter --duration, a smaller --roi, or "
                    + _cheaper(settings),
                )
            if isinstance(told, ProgressReport):
                told.expect(expected.seconds)
            if rendering and flux.is_static:
                rendering[0].progress = _share_progress(expected.rays, told)
        noted = _noted(flux, plain, round(sample.windows), seed) if rendering and audit else None
        capture = plain
        if rendering:
            seen_by = flux if noted is None else noted
            capture = Capture(seen_by, flux.sensor, *noise, duration_us, seed, labels=labels)
        with RecordingWriter(
            out, flux.sensor, scene=scene.spec, seed=seed, duration_us=duration_us, settings=settings,
            overwrite=overwrite,
        ) as writer, _journal(resume and renderer is None, out, writer, overwrite) as journal:  # fmt: skip
            if journal is not None:
                go_on(flux, journal)
            capture.record(writer, told)
            render: dict[str, Any] = {
                "error_noise": {name: meter.as_dict(wanted) for name, meter in capture.errors.items()},
            }
            if rendering:
                render |= _work_done(rendering)
            else:
                render["audit"] = stated_verdict(capture.errors, settings["samples"], QUALITY)
            if noted is not None:
                if told is not None:
                    told(0, 1, "audit")
                model = flux.sensor.evs if flux.sensor.spec.evs is not None else None
                render["audit"] = Audit(noted, flux, rendering[0].quality, model, capture.event_pixels, seed).run()
            writer.add_settings({"render": render})
            if set(kinds) - {EVENTS}:
                step = None if told is None else lambda done, total: told(done, total, "truth")
                writer.write_truth(SceneTruth(scene, sensor), step)
            if labels:
                try:
                    writer.write_event_objects(SceneTruth(scene, sensor))
                except SpecError as error:  # its events have causes all the same
                    warnings.warn(f"objects of events are not written: {error}", stacklevel=2)
            return warn_of_exposure(writer.finish())


def _cheaper(settings: Mapping[str, Any]) -> str:
    """What takes less time than these settings, in words."""
    if "quality" in settings:
        return f"a larger error, such as --quality {2 * settings['quality']:g}"
    return f"fewer rays, such as --samples {max(2, settings['samples'] // 4 * 2)}"


def _camera_used(flux: Any) -> dict[str, Any]:
    """Pose at rest and field of view of the camera in use, as plain values, whether scene or sensor set them."""
    view = flux.view
    left, right, top, bottom = view.region_mm
    ends = (view.direction(x, (top + bottom) / 2) for x in (left, right))
    across = np.diff([np.arctan(x / -z) for x, _, z in ends])[0]
    pose = view.camera_to_world
    return {
        "origin_m": pose[:3, 3].tolist(),
        "forward": (-pose[:3, 2]).tolist(),
        "up": pose[:3, 1].tolist(),
        "horizontal_fov_deg": float(np.degrees(across)),
        "near_m": float(view.near_m),
    }


def flux_source(
    scene: Scene,
    sensor: Sensor,
    seed: int,
    quality: float | None,
    samples: int | None,
    exact: bool,
    progress: Progress | None,
) -> tuple[Any, dict[str, Any]]:
    """The renderer that was asked for, or that the scene needs, and its settings for the manifest.

    Parameters
    ----------
    scene : with lights in absolute units (`in_absolute_light`).
    sensor, seed, quality, samples, exact, progress : as for `simulate`.
    """
    settings: dict[str, Any] = {}
    window_us = sensor.spec.evs.window_us if sensor.spec.evs is not None else 1.0
    if not exact and samples is None:
        wanted = QUALITY if quality is None else quality

        def make(part: Scene, light: Waveform | None) -> ChangeDrivenFlux:
            return ChangeDrivenFlux(part, sensor, wanted, seed=seed, light=light)

        try:
            return flickering(scene, make, window_us), {"mode": "change-driven", "quality": wanted}
        except NeedsExactMode as error:
            if quality is not None:
                raise
            settings["exact_because"] = str(error)
    default = MOVING_SAMPLES if scene.spec.moves else STATIC_SAMPLES
    rays = default if samples is None else samples
    told = _ray_progress(scene, sensor, rays, progress)
    flux = flickering(
        scene, lambda part, _: RenderedFlux(part, sensor, samples=rays, seed=seed, progress=told), window_us
    )
    return flux, settings | {"mode": "exact", "samples": rays}


def _change_driven_parts(flux: Any) -> list[ChangeDrivenFlux]:
    """The change-driven renderers of a source, one per waveform of its lights; none in the exact mode."""
    return [part for part in _renderers(flux) if isinstance(part, ChangeDrivenFlux)]


def _renderers(flux: Any) -> tuple[Any, ...]:
    """The renderers of a source, one per waveform of its lights."""
    return getattr(flux, "sources", (flux,))


def go_on(flux: Any, journal: Journal) -> None:
    """Let the renderers of a source keep what they trace in a journal, and take from it what is there already."""
    for number, part in enumerate(_renderers(flux)):
        part.go_on(journal, number)


def _journal(
    is_kept: bool, out: str | Path | None, writer: RecordingWriter, overwrite: bool
) -> AbstractContextManager[Journal | None]:
    """The journal of a run whose recording goes to `out`; nothing where none is kept."""
    if not is_kept or out is None:
        return nullcontext()
    return Journal(out, writer.run, overwrite)


def _noted(flux: Any, capture: Capture, windows: int, seed: int) -> NotedFlux:
    """The source, wrapped so that units of the audit are noted during the run."""
    spec = flux.sensor.spec.evs
    stretch = STRETCHES[spec.reference] if spec is not None else (0, 1, 0)
    frames = 1 if flux.is_static else max(1, len(capture.frame_exposures[1]))
    return NotedFlux(flux, capture.event_pixels, windows, frames, *stretch, seed)


def _work_done(parts: list[ChangeDrivenFlux]) -> dict[str, Any]:
    """Total rays and pairs of all parts, as plain values."""
    total = {name: sum(getattr(part.counts, name) for part in parts) for name in vars(parts[0].counts)}
    return {"quality": parts[0].quality, "renders": len(parts), **total}


def _share_progress(total: float, progress: Progress | None) -> Callable[[int], None] | None:
    """Progress of a static scene, which is one long render: rays done out of the forecast number."""
    if progress is None or total <= 0:
        return None
    return lambda rays: progress(min(rays, total), total, "rays")


def _ray_progress(
    scene: Scene, sensor: Sensor, samples: int, progress: Progress | None
) -> Callable[[int], None] | None:
    """Progress of a static scene, which is one long render: rays done out of all rays."""
    if progress is None or scene.spec.moves:
        return None
    wanted = sensor.layout.aps_mask.copy()
    wanted.ravel()[sensor.layout.evs_pixel.ravel()] = True
    total = float(np.count_nonzero(wanted) * samples)
    return lambda rays: progress(min(rays, total), total, "rays")


def _duration_us(duration_s: float) -> int:
    if not 0 < duration_s < float("inf"):
        raise RangeError("duration_s", duration_s, "a time above 0, in seconds")
    duration_us = round(duration_s * US_PER_S)
    if duration_us < 1:
        raise RangeError("duration_s", duration_s, "at least one microsecond")
    return duration_us
