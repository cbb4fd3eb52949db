"""A video in front of a sensor: RAW frames and events from pictures instead of a rendered scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hesim_render import backend, spectra
from hesim_render.capture import Capture, noise_models
from hesim_render.errors import RangeError, SpecError
from hesim_render.mosaic import Mosaic, describe
from hesim_render.progress import Progress, shown
from hesim_render.recording import Recording, RecordingWriter
from hesim_render.sensor import Sensor
from hesim_render.units import S_PER_US, US_PER_S
from hesim_render.video import VideoFlux, VideoOptions
from hesim_render.video.flux import Source

#: Slack of a duration given in decimals of the video's length, µs.
_SLACK_US = 1.0


def simulate_video(
    source: Source,
    sensor: Sensor,
    *,
    duration_s: float | None = None,
    seed: int = 7,
    clean: bool = False,
    without: Sequence[str] = (),
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress | Literal[False] | None = None,
    **options: Any,
) -> Recording:
    """RAW frames and events of a video, with the electrons behind them.

    Parameters
    ----------
    source : path of a video file, of a folder of numbered pictures or of a ``.npy`` file, or an array
        [time, row, col] or [time, row, col, channel].
    sensor : from `load_sensor` (crop it for a region of interest).
    duration_s : simulated time from the video's first picture, s; default all of it.
    seed, clean, without, out, overwrite, progress : as in `simulate`.
    options : of `hesim_render.video.VideoOptions`: ``fps``, ``slow_motion``, ``duty``, ``interpolation``, colour
        tags, ``mode``, ``white_lux`` or ``white_e_per_s`` with ``white_filter``, ``fit``, ``lens_shading``, …

    Returns
    -------
    Recording
        As of `simulate`; the standard errors of the truth are 0. ``settings.video`` of its manifest holds the
        input's hash and all that was done with it.

    Raises
    ------
    SpecError
        If the video cannot be read, is damaged or lacks colour tags or a clock.
    RangeError
        For a value out of range, or a duration longer than the video.
    OutputError
        If `out` exists or cannot be written; nothing half-written is left.
    """
    if not 0 <= seed < 2**64:
        raise RangeError("seed", seed, "0 to 2^64 - 1")
    aps, evs = noise_models(sensor, clean, without)
    flux = VideoFlux(source, sensor, VideoOptions.of(**options))
    try:
        name = "array" if isinstance(source, np.ndarray) else str(source)
        duration_us = _duration_us(duration_s, flux, name)
        settings = {
            "clean": clean,
            "without": list(without),
            "video": flux.describe(),
            "backend": backend.select().describe(),
        }
        capture = Capture(flux, sensor, aps, evs, duration_us, seed)
        with RecordingWriter(
            out,
            sensor,
            seed=seed,
            duration_us=duration_us,
            settings=settings,
            overwrite=overwrite,
            mosaic=_mosaic(sensor, flux.options),
        ) as writer:
            with shown(progress, f"{Path(name).name} → {sensor.name}") as told:
                capture.record(writer, told)
            return writer.finish()
    finally:
        flux.close()


def _duration_us(duration_s: float | None, flux: VideoFlux, name: str) -> int:
    """Length of the run in whole µs, within the video."""
    length_us = flux.clock.end_us
    if duration_s is None:
        if flux.cut_short:
            raise SpecError(
                f"ends after {length_us * S_PER_US:.6g} s, but it once was longer ({flux.cut_short}): copy it anew, or "
                "give a duration that is there",
                file=name,
            )
        duration_us = int(length_us + 1e-3)
        if duration_us < 1:
            raise SpecError(f"lasts {length_us:g} µs, less than one", file=name)
        return duration_us
    if not duration_s > 0:
        raise RangeError("duration_s", duration_s, "a time above 0, in seconds")
    duration_us = round(duration_s * US_PER_S)
    if duration_us < 1 or duration_us > length_us + _SLACK_US:
        raise RangeError("duration_s", duration_s, f"at most the video's {length_us * S_PER_US:.6g} s")
    return duration_us


def _mosaic(sensor: Sensor, options: VideoOptions) -> Mosaic:
    """The sensor's mosaic under the video's light, with the balance and matrix of a camera that was given."""
    mosaic = describe(sensor, spectra.illuminant(options.illuminant))
    camera = options.camera
    if camera is None or sorted(camera.channels) != sorted(mosaic.channels):
        return mosaic
    order = [camera.channels.index(name) for name in mosaic.channels]
    neutral = 1 / np.array(camera.white_balance)[order]
    return mosaic.model_copy(
        update={
            "neutral": (neutral / neutral.max()).tolist(),
            "camera_to_srgb": np.array(camera.matrix)[:, order].tolist(),
        }
    )
