"""Simulate a sensor in front of a hyperspectral cube, still or moving."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

from hesim_render.capture.loop import Capture
from hesim_render.capture.run_settings import checked_seed, noise_models, whole_us
from hesim_render.core import backend
from hesim_render.core.progress import Progress, shown
from hesim_render.mosaic.description import describe
from hesim_render.mosaic.schedule import require_countable
from hesim_render.recording.recording import Recording, warn_of_exposure
from hesim_render.recording.writer import RecordingWriter
from hesim_render.sensor.sensor import Sensor, as_sensor
from hesim_render.sources.cube import CubeFlux, CubeOptions


def simulate_cube(
    cube: str | Path,
    sensor: Sensor | str | Path,
    *,
    duration_s: float = 0.1,
    seed: int = 7,
    clean: bool = False,
    without: Sequence[str] = (),
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress | Literal[False] | None = None,
    on_estimate: Callable[[object], None] | None = None,
    live: bool = False,
    **options: object,
) -> Recording:
    """Simulate a sensor in front of a hyperspectral cube: RAW frames, events, and their noise-free truth.

    Parameters
    ----------
    cube : file or folder of the cube (``docs/studies.md``).
    sensor : from `load_sensor` (crop it for a region of interest), or its name or path.
    duration_s : simulated time, s.
    seed, clean, without, out, overwrite, progress : as for `simulate`.
    on_estimate : called with the work before the run begins, a text, as a cube takes no rays; an exception that it
        raises ends the run before anything is written.
    live : as for `simulate`.
    options : options of `sources.cube.CubeOptions`: ``quantity``, ``illuminance_lux`` or ``mean_luminance_cd_m2``,
        ``illuminant``, ``beyond``, ``fit``, ``pan_px_per_s``, ``zoom_per_s``, ``rotation_deg_per_s``, …

    Examples
    --------
    A grey cube under 500 lx, without noise: no event, and the electrons of a grey card.

    >>> import tempfile
    >>> import numpy as np
    >>> import hesim_render as hr
    >>> sensor = hr.load_sensor("reference-mono").crop(32, 24)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     np.save(f"{folder}/grey.npy", np.full((24, 32, 2), 0.18, np.float32))
    ...     options = {"wavelength_nm": [360, 830], "illuminance_lux": 500, "clean": True}
    ...     rec = hr.simulate_cube(f"{folder}/grey.npy", sensor, duration_s=0.05, **options)
    >>> len(rec.events), bool(rec.frames[0].electrons_mean.min() > 0)
    (0, True)

    Returns
    -------
    Recording
        As from `simulate`; the standard errors of the truth are 0. ``settings.cube`` of its manifest has the options.

    Raises
    ------
    SpecError
        If the cube cannot be read, or does not cover a response.
    RangeError
        If a value is out of range.
    OutputError
        If `out` exists or cannot be written. No partial output is left.
    """
    sensor = as_sensor(sensor)
    seed, clean = checked_seed(seed), bool(clean)
    duration_us = whole_us(duration_s)
    require_countable(sensor.spec.aps, sensor.spec.evs, duration_us)
    chosen = CubeOptions.of(options)
    backend.jit()
    aps, evs = noise_models(sensor, clean, without)
    flux = CubeFlux(cube, sensor, chosen)
    settings = {
        "clean": clean, "without": list(without), "backend": backend.select().describe(), "cube": flux.describe(),
    }  # fmt: skip
    capture = Capture(flux, sensor, aps, evs, duration_us, seed)
    if on_estimate is not None:
        samples = round(capture.sample_of_event_blocks().windows)
        on_estimate(f"{len(capture.frame_exposures[1])} frames and {samples} samples of event pixels; no rays")
    mosaic = describe(sensor, chosen.illuminant.load())
    with RecordingWriter(
        out,
        sensor,
        seed=seed,
        duration_us=duration_us,
        settings=settings,
        overwrite=overwrite,
        mosaic=mosaic,
        live=live,
    ) as writer:
        with shown(progress, f"{Path(cube).name} → {sensor.name}") as report:
            capture.record(writer, report)
        return warn_of_exposure(writer.finish())
