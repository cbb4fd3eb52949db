"""Captures and calibrations: ``lab`` and ``calibrate``."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from hesim_render.cli.options import SENSOR_HELP, Overwrite, SensorKeys, Without, cropped, names_of, sensor_keys_only
from hesim_render.cli.terminal import parse_exposures, split_overrides
from hesim_render.cli.told import DryRun, Json, Quiet, Told
from hesim_render.core.errors import RangeError
from hesim_render.core.output import check_target, free_place


class Part(StrEnum):
    """Part of a sensor to calibrate."""

    aps = "aps"
    evs = "evs"


def lab(
    sensor: Annotated[str, typer.Argument(help=SENSOR_HELP, autocompletion=names_of("sensors"))],
    out: Annotated[Path, typer.Option(help="folder to write the capture set to")],
    roi: Annotated[
        str, typer.Option(help="WIDTHxHEIGHT or ...+X+Y, px, or 'full' (gigabytes of frames for a large sensor)")
    ] = "256x256",
    frames: Annotated[int, typer.Option(help="frames per exposure, dark and lit")] = 64,
    ticks: Annotated[int, typer.Option(help="event comparisons on the static target, and in the dark")] = 20000,
    trials: Annotated[
        int, typer.Option(help="trials after a reset, per light and contrast (asynchronous events)")
    ] = 20,
    dark_ms: Annotated[str, typer.Option(help="dark exposures, ms")] = "1,5,20,50,80",
    lit_ms: Annotated[str, typer.Option(help="lit exposures, ms")] = "1,2,5,10,20,40,50,80",
    illuminant: Annotated[str, typer.Option(help="light on the target (see 'list illuminants')")] = "D65",
    parts: Annotated[
        int, typer.Option(help="parts of the dark ticks (of bright trials) counted too: tells flickering pixels")
    ] = 0,
    seed: Annotated[int, typer.Option(help="of all temporal noise")] = 7,
    set_: SensorKeys = None,
    without: Without = None,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
    json_: Json = False,
    quiet: Quiet = False,
) -> None:
    """A virtual calibration session: dark and lit captures to calibrate from."""
    scene_changes, changes = split_overrides(set_ or [])
    sensor_keys_only(scene_changes, "sensor.aps.read_noise_e")
    dark_us, lit_us = parse_exposures(dark_ms), parse_exposures(lit_ms)
    check_target(out, "capture.yaml", overwrite)
    told = Told(json_, quiet, dry_run)
    with told.stop_at_estimate(), told.progress(f"lab {sensor}") as progress:
        from hesim_render.capture.lab import write_captures
        from hesim_render.sensor.sensor import load_sensor

        loaded = cropped(load_sensor(sensor, changes), None if roi == "full" else roi)
        folder = write_captures(
            loaded, out, frames=frames, ticks=ticks, trials=trials, parts=parts, seed=seed, without=without or (),
            illuminant=illuminant, overwrite=overwrite, progress=progress,
            dark_exposures_us=dark_us, lit_exposures_us=lit_us, on_estimate=told.estimated(progress),
        )  # fmt: skip
    sizes = {file.name: file.stat().st_size for file in sorted(folder.iterdir())}
    lines = [f"{size / 1e6:10.1f} MB  {out / name}" for name, size in sizes.items()]
    told.result("\n".join(lines), {"captures": folder, "files_bytes": sizes})


def calibrate(
    part: Annotated[Part, typer.Argument(help="aps (frames) or evs (events)")],
    captures: Annotated[Path, typer.Argument(help="folder of a capture set, or of EMVA 1288 captures")],
    out: Annotated[Path, typer.Option(help="calibration to write or add to, such as calibration.yaml")],
    report: Annotated[Path | None, typer.Option(help="HTML report of all that the calibration holds")] = None,
    sensor_file: Annotated[
        Path | None, typer.Option(help="sensor file that goes with the calibration (of EMVA 1288 captures)")
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="replace a report of another calibration, or a sensor file")
    ] = False,
    json_: Json = False,
    quiet: Quiet = False,
) -> None:
    """Noise parameters from captures, into a file that a sensor file can point at."""
    from hesim_render.calibrate import calibrate_aps, calibrate_evs, read_calibration
    from hesim_render.calibrate.summary import summary_lines
    from hesim_render.recording.pair_set import is_pair_set

    if sensor_file is not None:
        if part is not Part.aps or not is_pair_set(captures):
            raise RangeError("--sensor-file", str(sensor_file), "none: captures of EMVA 1288 alone tell a whole sensor")
        free_place(sensor_file, overwrite)
    run = calibrate_aps if part is Part.aps else calibrate_evs
    told = Told(json_, quiet)
    with told.progress(f"calibrate {part.value}") as move:

        def show(what: str, fraction: float) -> None:
            move(fraction, 1.0, what)

        if sensor_file is None:
            run(captures, out, report, show, overwrite=overwrite)
        else:
            from hesim_render.calibrate.aps.pairs_output import calibrate_pairs
            from hesim_render.calibrate.aps.sensor_file import write_sensor

            write_sensor(sensor_file, out, calibrate_pairs(captures, out, report, show, overwrite))
    lines = summary_lines(read_calibration(out), part.value)
    where = [f"in {out}"]
    where += [
        f"{name}: {file}" for name, file in (("report", report), ("sensor file", sensor_file)) if file is not None
    ]
    facts = {"calibration": out, "report": report, "sensor_file": sensor_file, "part": part.value, "summary": lines}
    told.result("\n".join([*lines, *where]), facts)
