"""The main job: render a scene, expose a sensor to it, and record what comes out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hesim_render import backend
from hesim_render.capture import Capture, Progress, noise_models
from hesim_render.errors import RangeError
from hesim_render.flicker import flickering
from hesim_render.recording import Recording, RecordingWriter
from hesim_render.renderer.coherent import QUALITY, CoherentFlux
from hesim_render.renderer.estimate import Estimate, estimate
from hesim_render.renderer.flux import RenderedFlux
from hesim_render.renderer.moving import NeedsExactMode
from hesim_render.scene import Scene
from hesim_render.sensor import Sensor
from hesim_render.units import US_PER_S

#: Rays per pixel in the exact mode where the user names none. A static scene is rendered once for the whole run,
#: a moving one once per slice.
STATIC_SAMPLES = 64
MOVING_SAMPLES = 16


def simulate(
    scene: Scene,
    sensor: Sensor,
    *,
    duration_s: float = 0.1,
    seed: int = 7,
    clean: bool = False,
    without: Sequence[str] = (),
    quality: float | None = None,
    samples: int | None = None,
    exact: bool = False,
    max_minutes: float | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    on_estimate: Callable[[Estimate], None] | None = None,
) -> Recording:
    """RAW frames and events of a scene, with the electrons behind them.

    Parameters
    ----------
    scene, sensor : from `load_scene` and `load_sensor` (crop the sensor for a region of interest).
    duration_s : simulated time from 0, s.
    seed : of the temporal noise and of the render's samples; the device's own maps come from the
        sensor file's device seed.
    clean : switch every noise term off.
    without : noise terms to switch off by name, such as ``aps.read`` or ``evs.leak``.
    quality : error of the render as a part of the sensor's own noise, default 0.5: each pixel gets as many
        rays as that takes, and only what changes is rendered again. An audit states what that has missed.
    samples : rays per pixel and slice, even, in place of `quality`; asks for the exact mode.
    exact : render every pixel of every slice with the same number of rays, default 64 for a static scene, 16
        for a moving one.
    max_minutes : refuse a run whose estimate is longer; None does not.
    out : folder to stream the recording into; None keeps it in memory.
    overwrite : replace an existing recording in `out`.
    progress : called with (done, total, what).
    on_estimate : called with what the run will take, before it begins; not in the exact mode.

    Returns
    -------
    Recording
        Frames whose last row is exposed within the run, events, and their truth with standard
        errors from two independent halves of the render. ``settings.render`` of its manifest tells what
        was reached.

    Raises
    ------
    RangeError
        For a duration, seed, quality, sample count or noise term out of range, or a run that would take too long.
    SpecError
        If scene and sensor do not fit together (a spectrum that does not cover the response).
    OutputError
        If `out` exists or cannot be written; nothing half-written is left.
    """
    duration_us = _duration_us(duration_s)
    if not 0 <= seed < 2**64:
        raise RangeError("seed", seed, "0 to 2^64 - 1")
    if quality is not None and (exact or samples is not None):
        raise RangeError("quality", quality, "no exact mode and no samples beside it: they are another way")
    aps, evs = noise_models(sensor, clean, without)
    flux, settings = _source(scene, sensor, seed, quality, samples, exact, progress)
    settings |= {"clean": clean, "without": list(without), "backend": backend.select().describe()}
    capture = Capture(flux, flux.sensor, aps, evs, duration_us, seed)
    rendering = _coherent_parts(flux)
    if rendering:
        parts = [estimate(part, *capture.event_windows, *capture.frame_exposures) for part in rendering]
        expected = Estimate(*(sum(getattr(p, name) for p in parts) for name in ("seconds", "peak_bytes", "rays")))
        if on_estimate is not None:
            on_estimate(expected)
        if max_minutes is not None and expected.seconds > 60 * max_minutes:
            raise RangeError(
                "quality", rendering[0].quality,
                f"a larger one: this run takes {expected}, more than {max_minutes:g} min (--yes, max_minutes=None)",
            )  # fmt: skip
        if flux.is_static:
            rendering[0].progress = _share_progress(expected.rays, progress)
    with RecordingWriter(
        out,
        flux.sensor,
        scene=scene.spec,
        seed=seed,
        duration_us=duration_us,
        settings=settings,
        overwrite=overwrite,
    ) as writer:
        capture.record(writer, progress)
        if rendering:
            writer.add_settings({"render": _report(rendering)})
        return writer.finish()


def _source(
    scene: Scene,
    sensor: Sensor,
    seed: int,
    quality: float | None,
    samples: int | None,
    exact: bool,
    progress: Progress | None,
) -> tuple[Any, dict[str, Any]]:
    """The renderer that was asked for, or that the scene needs, and what the manifest says of it."""
    settings: dict[str, Any] = {}
    window_us = sensor.spec.evs.window_us if sensor.spec.evs is not None else 1.0
    if not exact and samples is None:
        wanted = QUALITY if quality is None else quality
        try:
            flux = flickering(scene, lambda part: CoherentFlux(part, sensor, wanted, seed=seed), window_us)
            return flux, {"mode": "coherent", "quality": wanted}
        except NeedsExactMode as error:
            if quality is not None:
                raise
            settings["exact_because"] = str(error)
    default = MOVING_SAMPLES if scene.spec.motion else STATIC_SAMPLES
    rays = default if samples is None else samples
    told = _ray_progress(scene, sensor, rays, progress)
    flux = flickering(scene, lambda part: RenderedFlux(part, sensor, samples=rays, seed=seed, progress=told), window_us)
    return flux, settings | {"mode": "exact", "samples": rays}


def _coherent_parts(flux: Any) -> list[CoherentFlux]:
    """The change-driven renderers of a source: one for each waveform of its lights; none in the exact mode."""
    return [part for part in getattr(flux, "sources", (flux,)) if isinstance(part, CoherentFlux)]


def _report(parts: list[CoherentFlux]) -> dict[str, Any]:
    """What was reached; where lights flicker apart, of the part that is worst."""
    reports = [part.report() for part in parts]
    worst = max(reports, key=lambda report: report["audit"]["exceeding_fraction_at_most"])
    return worst if len(reports) == 1 else {**worst, "rays": sum(r["rays"] for r in reports), "renders": len(reports)}


def _share_progress(total: float, progress: Progress | None) -> Callable[[int], None] | None:
    """A static scene is one long render: tell how much of what was expected is done."""
    if progress is None or total <= 0:
        return None
    return lambda rays: progress(min(rays, total), total, "rays")


def _ray_progress(
    scene: Scene, sensor: Sensor, samples: int, progress: Progress | None
) -> Callable[[int], None] | None:
    """A static scene is one long render: tell how many of its rays are done."""
    if progress is None or scene.spec.motion:
        return None
    wanted = sensor.layout.aps_mask.copy()
    wanted.ravel()[sensor.layout.evs_pixel.ravel()] = True
    total = float(np.count_nonzero(wanted) * samples)
    return lambda rays: progress(min(rays, total), total, "rays")


def _duration_us(duration_s: float) -> int:
    if not duration_s > 0 or duration_s > 1e6:
        raise RangeError("duration_s", duration_s, "a time above 0, in seconds")
    duration_us = round(duration_s * US_PER_S)
    if duration_us < 1:
        raise RangeError("duration_s", duration_s, "at least one microsecond")
    return duration_us
