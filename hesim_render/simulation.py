"""The main job: render a scene, expose a sensor to it, and record what comes out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from hesim_render import backend
from hesim_render.capture import Capture, Progress, noise_models
from hesim_render.errors import RangeError
from hesim_render.recording import Recording, RecordingWriter
from hesim_render.renderer.flux import RenderedFlux
from hesim_render.scene import Scene
from hesim_render.sensor import Sensor
from hesim_render.units import US_PER_S

#: Samples per pixel where the user names none. A static scene is rendered once for the whole run, a
#: moving one once per slice.
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
    samples: int | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
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
    samples : rays per pixel and slice, even; default 64 for a static scene, 16 for a moving one.
    out : folder to stream the recording into; None keeps it in memory.
    overwrite : replace an existing recording in `out`.
    progress : called with (done, total, what).

    Returns
    -------
    Recording
        Frames whose last row is exposed within the run, events, and their truth with standard
        errors from two independent halves of the render.

    Raises
    ------
    RangeError
        For a duration, seed, sample count or noise term out of range.
    SpecError
        If scene and sensor do not fit together (a spectrum that does not cover the response).
    OutputError
        If `out` exists or cannot be written; nothing half-written is left.
    """
    duration_us = _duration_us(duration_s)
    if not 0 <= seed < 2**64:
        raise RangeError("seed", seed, "0 to 2^64 - 1")
    aps, evs = noise_models(sensor, clean, without)
    default = MOVING_SAMPLES if scene.spec.motion else STATIC_SAMPLES
    rays = default if samples is None else samples
    flux = RenderedFlux(scene, sensor, samples=rays, seed=seed, progress=_ray_progress(scene, sensor, rays, progress))
    settings = {
        "clean": clean,
        "without": list(without),
        "samples": rays,
        "backend": backend.select().describe(),
    }
    capture = Capture(flux, flux.sensor, aps, evs, duration_us, seed)
    with RecordingWriter(
        out,
        flux.sensor,
        scene=scene.spec,
        seed=seed,
        duration_us=duration_us,
        settings=settings,
        overwrite=overwrite,
    ) as writer:
        for item in capture.run(progress):
            if isinstance(item, np.ndarray):
                writer.add_events(item)
            else:
                writer.add_frame(item)
        if evs is not None:
            truth = capture.event_flux
            writer.set_event_truth(truth.mean_e_per_s(), truth.stderr_e_per_s())
            writer.set_events_dropped(capture.events_dropped)
        return writer.finish()


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
