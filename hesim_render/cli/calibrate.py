"""Captures and calibrations: ``calibrate lab``, ``aps``, ``evs``, ``recording`` and ``twin``."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from hesim_render.cli.console import Console, DryRun, Json, Quiet
from hesim_render.cli.exit_status import ExitStatus
from hesim_render.cli.options import (
    SENSOR_HELP,
    HelpAll,
    Overwrite,
    SensorKeys,
    Without,
    cropped,
    names_of,
    place_of,
    sensor_keys_only,
)
from hesim_render.cli.terminal import parse_exposures, parse_size, split_overrides
from hesim_render.core.errors import ConflictError, RangeError
from hesim_render.core.output import check_target, free_place
from hesim_render.core.region import parse_roi

app = typer.Typer(
    no_args_is_help=True, help="Noise parameters of a sensor from captures, real or simulated.", rich_markup_mode=None
)
_Captures = Annotated[Path, typer.Argument(help="folder of a capture set")]
_Out = Annotated[Path, typer.Option(help="calibration to write or add to, such as calibration.yaml")]
_Report = Annotated[Path | None, typer.Option(help="HTML report of all that the calibration holds")]


@app.command()
def lab(
    sensor: Annotated[str, typer.Argument(help=SENSOR_HELP, autocompletion=names_of("sensors"))],
    out: Annotated[Path | None, typer.Option(help="folder to write the capture set to")] = None,
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
    illuminant: Annotated[str, typer.Option(help="light on the target (see 'info illuminants')")] = "D65",
    parts: Annotated[
        int,
        typer.Option(
            help="parts of dark ticks (bright trials) counted separately as well, to find flickering pixels",
            hidden=True,
        ),
    ] = 0,
    seed: Annotated[int, typer.Option(help="of all temporal noise", hidden=True)] = 7,
    set_: SensorKeys = None,
    without: Without = None,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
    json_: Json = False,
    quiet: Quiet = False,
    help_all: HelpAll = False,
) -> None:
    """Simulate dark and lit captures to calibrate from."""
    scene_changes, changes = split_overrides(set_ or [])
    sensor_keys_only(scene_changes, "sensor.aps.read_noise_e")
    dark_us, lit_us = parse_exposures(dark_ms), parse_exposures(lit_ms)
    place = place_of(out, dry_run)
    check_target(place, "capture.yaml", overwrite)
    console = Console(json_, quiet, dry_run)
    with console.stop_at_estimate(), console.progress(f"lab {sensor}") as progress:
        from hesim_render.capture.lab import write_captures
        from hesim_render.sensor.sensor import load_sensor

        loaded = cropped(load_sensor(sensor, changes), None if roi == "full" else roi)
        folder = write_captures(
            loaded, place, frames=frames, ticks=ticks, trials=trials, parts=parts, seed=seed, without=without or (),
            illuminant=illuminant, overwrite=overwrite, progress=progress,
            dark_exposures_us=dark_us, lit_exposures_us=lit_us, on_estimate=console.estimated(progress),
        )  # fmt: skip
    sizes = {file.name: file.stat().st_size for file in sorted(folder.iterdir())}
    lines = [f"{size / 1e6:10.1f} MB  {place / name}" for name, size in sizes.items()]
    console.result("\n".join(lines), {"captures": folder, "files_bytes": sizes})


@app.command()
def aps(
    captures: Annotated[Path, typer.Argument(help="folder of a capture set, or of EMVA 1288 captures, or their list")],
    out: _Out,
    report: _Report = None,
    sensor_file: Annotated[
        Path | None, typer.Option(help="sensor file that goes with the calibration (of EMVA 1288 captures)")
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="replace a report of another calibration, or a sensor file")
    ] = False,
    json_: Json = False,
    quiet: Quiet = False,
    help_all: HelpAll = False,
) -> None:
    """Find the noise of frame pixels from captures.

    A sensor file can point at the file that is written.
    """
    from hesim_render.calibrate import calibrate_aps
    from hesim_render.recording.pair_set import is_pair_set

    console = Console(json_, quiet)
    if sensor_file is None:
        with console.progress("calibrate aps") as move:
            calibrate_aps(captures, out, report, move.part, overwrite=overwrite)
    else:
        if captures.exists() and not is_pair_set(captures):
            raise RangeError("--sensor-file", str(sensor_file), "none: captures of EMVA 1288 alone tell a whole sensor")
        free_place(sensor_file, overwrite)
        from hesim_render.calibrate.aps.pairs_output import calibrate_pairs
        from hesim_render.calibrate.aps.sensor_file import write_sensor

        with console.progress("calibrate aps") as move:
            pairs = calibrate_pairs(captures, out, report, move.part, overwrite)
            write_sensor(sensor_file, out, pairs)
    _show(console, "aps", out, report, sensor_file)


@app.command()
def evs(
    captures: _Captures,
    out: _Out,
    report: _Report = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace a report of another calibration")] = False,
    json_: Json = False,
    quiet: Quiet = False,
    help_all: HelpAll = False,
) -> None:
    """Find thresholds and noise of event pixels.

    A sensor file can point at the file that is written.
    """
    from hesim_render.calibrate import calibrate_evs

    console = Console(json_, quiet)
    with console.progress("calibrate evs") as move:
        calibrate_evs(captures, out, report, move.part, overwrite=overwrite)
    _show(console, "evs", out, report)


def _show(console: Console, part: str, out: Path, report: Path | None, sensor_file: Path | None = None) -> None:
    """The figures of a calibration, and where they are."""
    from hesim_render.calibrate import read_calibration
    from hesim_render.calibrate.summary import summary_lines

    lines = summary_lines(read_calibration(out), part)
    written = {"report": report, "sensor file": sensor_file}
    where = [f"in {out}", *(f"{name}: {file}" for name, file in written.items() if file is not None)]
    facts = {"calibration": out, "report": report, "sensor_file": sensor_file, "part": part, "summary": lines}
    console.result("\n".join([*lines, *where]), facts)


#: Figures of a recording and of all together, as the command prints them.
_OF_ONE = {
    "on_rate_hz": "ON events", "off_rate_hz": "OFF events", "leak_rate_hz": "leak",
    "on_rate_spread_rel": "spread of ON rates", "off_rate_spread_rel": "spread of OFF rates",
    "on_local_variation": "local variation",
}  # fmt: skip
_OF_ALL = {
    "theta_on": "θ₊", "theta_off": "θ₋", "threshold_ratio": "θ₋/θ₊", "threshold_mismatch_rel": "threshold mismatch",
    "leak_dark_hz": "leak in the dark", "leak_growth_hz_per_lux": "growth of the leak", "hot_share": "hot pixels",
    "silent_share": "silent pixels", "dead_time_us": "dead time", "readout_limit_events_per_s": "read-out limit",
}  # fmt: skip
#: Keys of ``evs.noise_spread``.
_OF_NOISE = {
    "bandwidth_rel": "spread of bandwidth", "odd_rows_rel": "bandwidth, odd rows", "odd_cols_rel": "odd columns",
}  # fmt: skip


def recording(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="recordings of still scenes, one for each light")
    ],
    out: Annotated[Path | None, typer.Option(help="YAML file of the figures")] = None,
    lux: Annotated[
        str | None, typer.Option(help="illuminance on the sensor of each recording, lx, such as 0.1,161,3000")
    ] = None,
    target: Annotated[
        Path | None, typer.Option(help="recording of a target of two grey levels that moves through the picture")
    ] = None,
    contrast: Annotated[
        float | None, typer.Option(help="light of the target's bright parts over that of its dark ones")
    ] = None,
    target_hz: Annotated[
        float | None, typer.Option(help="bright-dark cycles a pixel sees per second; default as recorded", hidden=True)
    ] = None,
    size: Annotated[str | None, typer.Option(help="WIDTHxHEIGHT of the sensor, if files do not state it")] = None,
    roi: Annotated[
        str | None, typer.Option(help="WIDTHxHEIGHT+X+Y of recordings that count the pixels of a crop from 0")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the file of figures")] = False,
    json_: Json = False,
    quiet: Quiet = False,
    help_all: HelpAll = False,
) -> None:
    """Noise and thresholds of event pixels from recordings.

    Still scenes at two lights or more and, for the thresholds, a moving target of known contrast.
    """
    from hesim_render.calibrate.recordings import calibrate_recordings

    shape, levels, first = None if size is None else parse_size(size), None if lux is None else _levels(lux), (0, 0)
    if roi is not None:
        width, height, x, y = parse_roi(roi)
        if shape is not None or x is None or y is None:
            raise ConflictError("--roi", roi, "--roi must be WIDTHxHEIGHT+X+Y, and stands in place of --size")
        shape, first = (height, width), (y, x)
    console = Console(json_, quiet)
    with console.progress("calibrate recording") as move:
        result = calibrate_recordings(
            files, out, lux=levels, target_file=target, target_contrast=contrast, target_hz=target_hz, shape=shape,
            first=first, overwrite=overwrite, progress=move.part,
        )  # fmt: skip
    lines = []
    for one in result["recordings"]:
        light = "" if one["lux"] is None else f", {one['lux']:g} lx"
        lines.append(f"{one['file']}{light}: {one['events']} events in {one['seconds']:.4g} s")
        lines += [f"  {_line(text, one[name])}" for name, text in _OF_ONE.items()]
    lines += [_line(text, result[name]) for name, text in _OF_ALL.items()]
    lines += [_line(text, result["noise_spread"][name]) for name, text in _OF_NOISE.items()]
    lines += [f"look at: {finding['file']}: {finding['text']}" for finding in result["findings"]]
    lines += [] if out is None else [f"in {out}"]
    console.result("\n".join(lines), {"calibration": out, **result})


def _levels(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise RangeError("--lux", text, "numbers with commas, such as 0.1,161,3000") from None


def _line(text: str, item: Mapping[str, Any]) -> str:
    if item["value"] is None:
        return f"{text:<20} not identifiable: {item['reason']}"
    interval, limit = item.get("interval_95"), item.get("upper_limit")
    between = f" ({interval[0]:.5g} to {interval[1]:.5g})" if interval else f" (below {limit:.5g})" if limit else ""
    return " ".join([f"{text:<20} {item['value']:.5g}{between}", item.get("unit", ""), item.get("note", "")]).rstrip()


def twin(
    captures: Annotated[Path, typer.Argument(help="folder of EMVA 1288 captures")],
    out: Annotated[Path, typer.Option(help="folder to write: calibration, sensor file, page and figures of the twin")],
    seed: Annotated[int, typer.Option(help="of the simulated noise")] = 7,
    overwrite: Overwrite = False,
    json_: Json = False,
    quiet: Quiet = False,
    help_all: HelpAll = False,
) -> None:
    """Calibrate on half of the captures, test on the rest.

    The other half is simulated, and each statistic passes or fails.
    """
    from hesim_render.twin import make_twin
    from hesim_render.twin.page import check_line

    console = Console(json_, quiet)
    with console.progress("twin") as move:
        result = make_twin(captures, out, seed=seed, overwrite=overwrite, progress=move.part)
    lines = [check_line(check) for check in result.checks]
    passed = sum(check.passed for check in result.checks)
    looks = [f"look at: {finding.check}: {finding.text}" for finding in result.findings]
    text = "\n".join([*lines, *looks, f"{passed} of {len(lines)} pass", f"in {out}"])
    facts = {"twin": result.folder, "passed": result.passed, "checks": {c.name: c.passed for c in result.checks},
             "findings": [finding.described() for finding in result.findings]}  # fmt: skip
    console.result(text, facts, ExitStatus.DONE if result.passed else ExitStatus.NOT_MET)


app.command()(recording)
app.command()(twin)
