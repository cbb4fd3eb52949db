"""Hyperspectral cubes into recordings: ``expose``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from hesim_render.cli.cube import parse_bands
from hesim_render.cli.options import (
    Clean,
    Overwrite,
    Region,
    SensorFile,
    SensorKeys,
    Without,
    check_duration,
    check_output,
    cropped,
    sensor_keys_only,
)
from hesim_render.cli.simulate import tell_recording
from hesim_render.cli.terminal import split_overrides
from hesim_render.cli.told import DryRun, Json, Quiet, Told
from hesim_render.core.errors import RangeError


def expose(
    cube: Annotated[Path, typer.Argument(help="hyperspectral cube: .hdr, .mat, .h5, .exr, .npy, or a folder of CAVE")],
    sensor: SensorFile,
    out: Annotated[Path, typer.Option(help="folder to write the recording to")],
    duration: Annotated[float, typer.Option(help="simulated time, s")] = 0.1,
    lux: Annotated[float | None, typer.Option(help="illuminance of reflectances, lx")] = None,
    radiance: Annotated[bool, typer.Option("--radiance", help="the cube holds radiance, no reflectance")] = False,
    luminance: Annotated[float | None, typer.Option(help="mean luminance of a radiance of unknown unit, cd/m²")] = None,
    scale: Annotated[float | None, typer.Option(help="multiplies the values of the cube")] = None,
    illuminant: Annotated[str | None, typer.Option(help="light on reflectances (default D65)")] = None,
    bands: Annotated[
        str | None, typer.Option(metavar="FIRST:LAST:STEP", help="wavelengths of a file that has none, nm")
    ] = None,
    hold: Annotated[bool, typer.Option("--hold", help="first and last plane hold beyond their wavelengths")] = False,
    fit: Annotated[str | None, typer.Option(help="cover (default), stretch or pixel")] = None,
    pan: Annotated[str | None, typer.Option(metavar="X,Y", help="velocity of the image, px/s")] = None,
    zoom: Annotated[float | None, typer.Option(help="growth of the image in a second, a factor")] = None,
    rotate: Annotated[float | None, typer.Option(help="turn of the image, degrees per second, clockwise")] = None,
    roi: Region = None,
    seed: Annotated[int, typer.Option(help="of all noise")] = 7,
    set_: SensorKeys = None,
    clean: Clean = False,
    without: Without = None,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
    json_: Json = False,
    quiet: Quiet = False,
) -> None:
    """Put a hyperspectral image in front of a sensor, still or moving, and record it."""
    check_duration(duration)
    scene_changes, sensor_changes = split_overrides(set_ or [])
    sensor_keys_only(scene_changes, "sensor.aps.exposure_us")
    check_output(out, overwrite)
    options: dict[str, Any] = {
        "illuminance_lux": lux, "mean_luminance_cd_m2": luminance, "scale": scale, "illuminant": illuminant,
        "wavelength_nm": None if bands is None else parse_bands(bands), "fit": fit,
        "pan_px_per_s": None if pan is None else _pair(pan), "zoom_per_s": zoom, "rotation_deg_per_s": rotate,
        "quantity": "radiance" if radiance else None, "beyond": "hold" if hold else None,
    }  # fmt: skip
    told = Told(json_, quiet, dry_run)
    with told.stop_at_estimate(), told.progress(f"{cube.name} → {sensor}") as progress:
        import hesim_render as hr

        loaded = cropped(hr.load_sensor(sensor, sensor_changes), roi)
        recording = hr.simulate_cube(
            cube, loaded, out=out, overwrite=overwrite, progress=progress, duration_s=duration, seed=seed, clean=clean,
            without=without or (), on_estimate=told.estimated(progress),
            **{key: value for key, value in options.items() if value is not None},
        )  # fmt: skip
    tell_recording(told, recording)


def _pair(text: str) -> tuple[float, float]:
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise RangeError("--pan", text, "two velocities in px/s, such as 200,0") from None
    return x, y
