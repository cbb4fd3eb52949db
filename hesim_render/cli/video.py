"""Videos into recordings: ``video``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hesim_render.cli.options import (
    LONG_MINUTES,
    Clean,
    Overwrite,
    Region,
    SensorFile,
    SensorKeys,
    Without,
    Yes,
    check_duration,
    check_output,
    cropped,
    sensor_keys_only,
)
from hesim_render.cli.simulate import tell_recording
from hesim_render.cli.terminal import split_overrides
from hesim_render.cli.told import DryRun, Json, Quiet, Told


def video(
    source: Annotated[
        str, typer.Argument(metavar="INPUT", help="a video file, a folder of numbered pictures, or a .npy file")
    ],
    sensor: SensorFile,
    out: Annotated[Path, typer.Option(help="folder to write the recording to")],
    duration: Annotated[float | None, typer.Option(help="simulated time, s; default the whole video")] = None,
    roi: Region = None,
    seed: Annotated[int, typer.Option(help="of all noise")] = 7,
    fps: Annotated[
        float | None, typer.Option(help="pictures per second; for folders and .npy, else instead of time stamps")
    ] = None,
    slow_motion: Annotated[
        float | None, typer.Option(help="how much slower the video plays than the scene was")
    ] = None,
    duty: Annotated[float | None, typer.Option(help="part of a picture's time the shutter was open, 0 to 1")] = None,
    interpolation: Annotated[str | None, typer.Option(help="none (default), linear or motion")] = None,
    motion_factor: Annotated[int | None, typer.Option(help="pictures made of one by interpolation motion")] = None,
    transfer: Annotated[str | None, typer.Option(help="srgb, bt709, gamma, linear, pq or hlg")] = None,
    gamma: Annotated[float | None, typer.Option(help="exponent of transfer gamma")] = None,
    primaries: Annotated[str | None, typer.Option(help="bt709 (sRGB), bt2020, p3, smpte170m or bt470bg")] = None,
    matrix: Annotated[str | None, typer.Option(help="of YUV: bt709, bt601, bt2020 or smpte240m")] = None,
    range_: Annotated[str | None, typer.Option("--range", help="limited or full")] = None,
    bit_depth: Annotated[int | None, typer.Option(help="of integer values in .npy and TIFF files")] = None,
    mode: Annotated[str | None, typer.Option(help="matrix (default) or spectral")] = None,
    others: Annotated[
        str | None, typer.Option(help="filters outside the matrix see: luma (default) or spectral")
    ] = None,
    camera: Annotated[Path | None, typer.Option(help="camera file whose matrix and white balance are undone")] = None,
    illuminant: Annotated[str | None, typer.Option(help="light on white (default D65)")] = None,
    white_lux: Annotated[float | None, typer.Option(help="illuminance of white, lux (default 1000)")] = None,
    white_e_per_s: Annotated[float | None, typer.Option(help="or photo-electrons per second of white")] = None,
    white_filter: Annotated[str | None, typer.Option(help="behind this filter")] = None,
    fit: Annotated[str | None, typer.Option(help="cover (default), stretch or pixel")] = None,
    lens_shading: Annotated[
        bool, typer.Option("--lens-shading", help="apply the sensor's relative illumination")
    ] = False,
    yes: Yes = False,
    set_: SensorKeys = None,
    clean: Clean = False,
    without: Without = None,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
    json_: Json = False,
    quiet: Quiet = False,
) -> None:
    """Put a video in front of a sensor and record it: RAW frames, events and their ground truth."""
    if duration is not None:
        check_duration(duration)
    scene_changes, sensor_changes = split_overrides(set_ or [])
    sensor_keys_only(scene_changes, "sensor.aps.exposure_us")
    check_output(out, overwrite)
    told = Told(json_, quiet, dry_run)
    with told.stop_at_estimate(), told.progress(f"{Path(source).name} → {sensor}") as progress:
        import hesim_render as hr
        from hesim_render.mosaic.colour_profile import load_camera

        loaded_sensor = cropped(hr.load_sensor(sensor, sensor_changes), roi)
        recording = hr.simulate_video(
            source, loaded_sensor, out=out, overwrite=overwrite, progress=progress, duration_s=duration, seed=seed,
            max_minutes=None if yes else LONG_MINUTES, on_estimate=told.estimated(progress),
            clean=clean, without=without or (), fps=fps, slow_motion=slow_motion, duty=duty,
            interpolation=interpolation, motion_factor=motion_factor, transfer=transfer, gamma=gamma,
            primaries=primaries, matrix=matrix, range=range_, bit_depth=bit_depth, mode=mode, others=others,
            camera=None if camera is None else load_camera(camera), illuminant=illuminant, white_lux=white_lux,
            white_e_per_s=white_e_per_s, white_filter=white_filter, fit=fit, lens_shading=lens_shading, resume=True,
        )  # fmt: skip
    notes = recording.manifest["settings"]["video"]["notes"]
    tell_recording(told, recording, "".join(f"\nnote: {text}" for text in notes))
