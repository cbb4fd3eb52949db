"""The command line. Heavy modules are imported inside the commands, so that ``--help`` is quick."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hesim_render import __version__
from hesim_render.errors import HesimError, RangeError
from hesim_render.guard import printable
from hesim_render.output import check_target, discard_unfinished, output_errors
from hesim_render.terminal import (
    Interrupts,
    is_short_of_wish,
    parse_exposures,
    parse_roi,
    progress_bar,
    split_overrides,
    summary,
)

if TYPE_CHECKING:
    from hesim_render.recording import Recording

#: Runs that take longer, by estimate, ask to be wanted.
LONG_MINUTES = 30

app = typer.Typer(
    name="hesim-render",
    help="Render a scene, or turn a video, into RAW frames and events of a hybrid event-frame sensor.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

# typer carries its own copy of click in newer versions; this is the base of its usage errors in all
_ClickError: Any = next(kind for kind in typer.BadParameter.__mro__ if kind.__name__ == "ClickException")


#: Options that several commands share.
SensorFile = Annotated[str, typer.Option(help="a name (see 'list sensors') or the path of a sensor file")]
Region = Annotated[str | None, typer.Option(help="part of the sensor read out: WIDTHxHEIGHT or ...+X+Y, px")]
SensorKeys = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="sensor.KEY=VALUE", help="change a key of the sensor file; repeatable"),
]
Clean = Annotated[bool, typer.Option("--clean", help="no noise at all")]
Without = Annotated[
    list[str] | None, typer.Option(metavar="TERM", help="switch one noise term off, as aps.read; repeatable")
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="replace what is there")]

_NOT_MET = 3  # a recording is there, but worse than the quality that was asked for
_INTERRUPTED = 130  # 128 + SIGINT, as shells have it

_DEMO_RUNS = (("colorchecker", "eiger"), ("rotating-star", "gen2"))


class Kind(StrEnum):
    """What can be listed."""

    scenes = "scenes"
    sensors = "sensors"
    illuminants = "illuminants"


class Part(StrEnum):
    """What of a sensor is calibrated."""

    aps = "aps"
    evs = "evs"


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"hesim-render {__version__}")
        raise typer.Exit


@app.callback()
def _app(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Say which.")] = False,
) -> None:
    pass


@app.command()
def doctor() -> None:
    """Say what this machine can run, and what to install where it can run nothing."""
    from hesim_render import backend
    from hesim_render.manifest import software_versions

    for name, version in software_versions().items():
        typer.echo(f"{name:<14}{version}")
    found = [backend.probe(candidate) for candidate in backend.candidates()]
    for candidate in found:
        verdict = "works" if candidate.works else f"does not work: {candidate.reason}"
        typer.echo(f"{'candidate':<14}{candidate.describe()} - {verdict}")
    chosen = next((candidate for candidate in found if candidate.works), None)
    if chosen is None:
        typer.echo(f"{'backend':<14}none")
        typer.echo(f"no Dr.Jit backend works on this machine: {backend.INSTALL_HINT}", err=True)
        raise typer.Exit(2)
    typer.echo(f"{'backend':<14}{chosen.describe()}, Mitsuba variant {chosen.backend}_ad_spectral")


@app.command("list")
def list_(kind: Annotated[Kind, typer.Argument(help="scenes, sensors or illuminants")]) -> None:
    """List the names that can be used."""
    if kind is Kind.illuminants:
        from hesim_render.spectra import illuminant_names

        typer.echo("\n".join(illuminant_names()))
        return
    from hesim_render.specs.files import data_folder, list_names, load_yaml

    names = list_names(kind.value)
    width = max((len(name) for name in names), default=0)
    for name in names:
        description = load_yaml(data_folder(kind.value) / f"{name}.yaml").get("description", "")
        typer.echo(f"{name:<{width}}  {description}")


@app.command()
def simulate(
    scene: Annotated[str, typer.Argument(help="a name (see 'list scenes') or the path of a scene file")],
    sensor: SensorFile,
    out: Annotated[Path, typer.Option(help="folder to write the recording to")],
    duration: Annotated[float, typer.Option(help="simulated time, s")] = 0.1,
    roi: Region = None,
    seed: Annotated[int, typer.Option(help="of all noise and of the render")] = 7,
    quality: Annotated[
        float | None, typer.Option(help="error of the render as a part of the sensor's noise (default 0.5)")
    ] = None,
    exact: Annotated[bool, typer.Option("--exact", help="render every pixel of every slice, all alike")] = False,
    samples: Annotated[int | None, typer.Option(help="with --exact: rays per pixel and slice of time")] = None,
    yes: Annotated[bool, typer.Option("--yes", help=f"also where it takes more than {LONG_MINUTES} minutes")] = False,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="change a key of the scene file, or with sensor. of the sensor file"
        ),
    ] = None,
    clean: Clean = False,
    without: Without = None,
    allow_outside: Annotated[
        bool, typer.Option("--allow-outside", help="let the scene name files outside of its folder")
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """Render a scene and record it: RAW frames, events and their ground truth.

    Ends with status 3 where the audit finds that the recording is worse than --quality asks for.
    """
    _check_duration(duration)
    scene_changes, sensor_changes = split_overrides(set_ or [])
    recording = _simulate(
        scene, sensor, out, scene_changes=scene_changes, sensor_changes=sensor_changes, roi=roi,
        overwrite=overwrite, duration_s=duration, seed=seed, quality=quality, exact=exact, samples=samples,
        max_minutes=None if yes else LONG_MINUTES, on_estimate=lambda expected: typer.echo(f"estimate: {expected}"),
        clean=clean, without=without or (), allow_outside=allow_outside,
    )  # fmt: skip
    typer.echo(summary(recording))
    if is_short_of_wish(recording.manifest["settings"].get("render", {}).get("audit")):
        raise typer.Exit(_NOT_MET)


@app.command()
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
    set_: SensorKeys = None,
    clean: Clean = False,
    without: Without = None,
    overwrite: Overwrite = False,
) -> None:
    """Put a video in front of a sensor and record it: RAW frames, events and their ground truth."""
    if duration is not None:
        _check_duration(duration)
    scene_changes, sensor_changes = split_overrides(set_ or [])
    for key in scene_changes:
        raise RangeError("--set", key, "a key of the sensor file, as sensor.aps.exposure_us")
    _check_output(out, overwrite)
    import hesim_render as hr
    from hesim_render.camera import load_camera

    loaded_sensor = hr.load_sensor(sensor, sensor_changes)
    if roi is not None:
        loaded_sensor = loaded_sensor.crop(*parse_roi(roi))
    with progress_bar(f"{Path(source).name} → {sensor}") as progress:
        recording = hr.simulate_video(
            source, loaded_sensor, out=out, overwrite=overwrite, progress=progress, duration_s=duration, seed=seed,
            clean=clean, without=without or (), fps=fps, slow_motion=slow_motion, duty=duty,
            interpolation=interpolation, motion_factor=motion_factor, transfer=transfer, gamma=gamma,
            primaries=primaries, matrix=matrix, range=range_, bit_depth=bit_depth, mode=mode, others=others,
            camera=None if camera is None else load_camera(camera), illuminant=illuminant, white_lux=white_lux,
            white_e_per_s=white_e_per_s, white_filter=white_filter, fit=fit, lens_shading=lens_shading,
        )  # fmt: skip
    typer.echo(
        "\n".join([summary(recording), *(f"note: {text}" for text in recording.manifest["settings"]["video"]["notes"])])
    )


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="folder for the two recordings (replaced if already there)")] = Path("demo"),
) -> None:
    """Two small recordings with pictures: a ColorChecker, and a moving scene."""
    runs = {out / f"{scene}-{sensor}": (scene, sensor) for scene, sensor in _DEMO_RUNS}
    for target in runs:
        _check_output(target, overwrite=True)
    for target, (scene, sensor) in runs.items():
        recording = _simulate(scene, sensor, target, roi="512x384", overwrite=True, duration_s=0.1, seed=7)
        typer.echo(summary(recording) + "\n")
    still, moving = runs
    typer.echo(f"Look at {still / 'preview.png'} (24 measured patches)")
    typer.echo(f"    and {moving / 'preview.gif'} (events of a moving scene).")


@app.command()
def lab(
    sensor: Annotated[str, typer.Argument(help="a name (see 'list sensors') or the path of a sensor file")],
    out: Annotated[Path, typer.Option(help="folder to write the capture set to")],
    roi: Annotated[
        str, typer.Option(help="WIDTHxHEIGHT or ...+X+Y, px, or 'full' (gigabytes of frames for a large sensor)")
    ] = "256x256",
    frames: Annotated[int, typer.Option(help="frames per exposure, dark and lit")] = 64,
    ticks: Annotated[int, typer.Option(help="event comparisons on the static target, and in the dark")] = 20000,
    dark_ms: Annotated[str, typer.Option(help="dark exposures, ms")] = "1,5,20,50,80",
    lit_ms: Annotated[str, typer.Option(help="lit exposures, ms")] = "1,2,5,10,20,40,50,80",
    illuminant: Annotated[str, typer.Option(help="light on the target (see 'list illuminants')")] = "D65",
    seed: Annotated[int, typer.Option(help="of all temporal noise")] = 7,
    set_: SensorKeys = None,
    without: Without = None,
    overwrite: Overwrite = False,
) -> None:
    """A virtual calibration session: dark and lit captures to calibrate from."""

    scene_changes, changes = split_overrides(set_ or [])
    for key in scene_changes:
        raise RangeError("--set", key, "a key of the sensor file, as sensor.aps.read_noise_e")
    exposures = {"dark_exposures_us": parse_exposures(dark_ms), "lit_exposures_us": parse_exposures(lit_ms)}
    check_target(out, "capture.yaml", overwrite)
    from hesim_render.lab import write_captures
    from hesim_render.sensor import load_sensor

    loaded = load_sensor(sensor, changes)
    if roi != "full":
        loaded = loaded.crop(*parse_roi(roi))
    if loaded.spec.evs is not None and loaded.spec.evs.reference == "last_event":
        typer.echo(
            "frames only: events of reference 'last_event' have no fixed comparisons to count, and their "
            "calibration is not covered"
        )
    with progress_bar(f"lab {sensor}") as progress:
        folder = write_captures(
            loaded, out, frames=frames, ticks=ticks, seed=seed, without=without or (), illuminant=illuminant,
            overwrite=overwrite, progress=progress, **exposures,
        )  # fmt: skip
    for file in sorted(folder.iterdir()):
        typer.echo(f"{file.stat().st_size / 1e6:10.1f} MB  {out / file.name}")


@app.command()
def calibrate(
    part: Annotated[Part, typer.Argument(help="aps (frames) or evs (events)")],
    captures: Annotated[Path, typer.Argument(help="folder of a capture set")],
    out: Annotated[Path, typer.Option(help="calibration to write or add to, such as calibration.yaml")],
    report: Annotated[Path | None, typer.Option(help="HTML report of all that the calibration holds")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace a report of another calibration")] = False,
) -> None:
    """Noise parameters from captures, into a file that a sensor file can point at."""
    from hesim_render.calibrate import calibrate_aps, calibrate_evs, read_calibration
    from hesim_render.calibrate.summary import summary_lines

    run = calibrate_aps if part is Part.aps else calibrate_evs
    with progress_bar(f"calibrate {part.value}") as move:
        tell = None if move is None else lambda what, fraction: move(fraction, 1.0, what)
        run(captures, out, report, tell, overwrite=overwrite)
    lines = summary_lines(read_calibration(out), part.value)
    where = [f"in {out}"] if report is None else [f"in {out}", f"report: {report}"]
    typer.echo("\n".join([*lines, *where]))


@app.command()
def isp(
    recording: Annotated[Path, typer.Argument(help="folder of a recording")],
    out: Annotated[Path | None, typer.Option(help="folder of the pictures; default NAME-pictures beside it")] = None,
    pipeline: Annotated[Path | None, typer.Option(help="YAML file that changes the steps (docs/isp.md)")] = None,
    no_denoise: Annotated[bool, typer.Option("--no-denoise", help="leave noise and row offsets as they are")] = False,
    calibration: Annotated[
        Path | None, typer.Option(help="calibration.yaml of a calibrated sensor, for its maps")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Develop the RAW frames of a recording into pictures."""
    from hesim_render.isp import DENOISED_PICTURE, develop_recording, load_pipeline
    from hesim_render.isp.develop import MARKER

    steps = DENOISED_PICTURE if pipeline is None else load_pipeline(pipeline)
    if no_denoise:
        steps = steps.without("denoise")
    with progress_bar(f"developing {recording}") as progress:
        folder = develop_recording(recording, out, steps, progress, overwrite, calibration)
    typer.echo(f"pictures in {folder}")
    noise = json.loads((folder / MARKER).read_text(encoding="utf-8"))["noise"]
    if noise is not None and noise["maps"] == "unknown":
        typer.echo("the maps of the sensor's calibration are not in a recording: --calibration FILE takes them out")


@app.command()
def view(recording: Annotated[Path, typer.Argument(help="folder of a recording")]) -> None:
    """Summarise a recording and write its previews anew."""
    from hesim_render.recording import Recording
    from hesim_render.showcase import write_previews

    loaded = Recording.load(recording)
    assert loaded.path is not None
    with output_errors(loaded.path):
        write_previews(loaded, loaded.path)
    typer.echo(summary(loaded))


def _check_duration(duration_s: float) -> None:
    if not 0 < duration_s < float("inf"):
        raise RangeError("--duration", duration_s, "a time above 0, in seconds")


def _check_output(out: Path, overwrite: bool) -> None:
    """Refuse a bad output folder before anything is rendered."""
    from hesim_render.manifest import MANIFEST_NAME

    check_target(out, MANIFEST_NAME, overwrite)


def _simulate(
    scene: str,
    sensor: str,
    out: Path,
    *,
    scene_changes: dict[str, Any] | None = None,
    sensor_changes: dict[str, Any] | None = None,
    roi: str | None = None,
    overwrite: bool = False,
    allow_outside: bool = False,
    **options: Any,
) -> Recording:
    _check_output(out, overwrite)
    import hesim_render as hr

    loaded_sensor = hr.load_sensor(sensor, sensor_changes)
    if roi is not None:
        loaded_sensor = loaded_sensor.crop(*parse_roi(roi))
    loaded_scene = hr.load_scene(scene, scene_changes, allow_outside=allow_outside)
    with progress_bar(f"{scene} → {sensor}") as progress:
        return hr.simulate(loaded_scene, loaded_sensor, out=out, overwrite=overwrite, progress=progress, **options)


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point. Exit status 0; 2 with one line on stderr where the user can help it; 130 when interrupted.

    3 where a recording is complete, but worse than the quality that was asked for.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    with Interrupts() as interrupts:
        try:
            status = app(args=given or ["--help"], standalone_mode=False)
        except (KeyboardInterrupt, typer.Abort):
            status = _INTERRUPTED
        except BrokenPipeError:
            sys.stderr.close()
            sys.exit(0)
        except Exception as error:
            if interrupts.happened:
                status = _INTERRUPTED
            elif isinstance(error, HesimError):
                _fail(str(error))
            elif isinstance(error, _ClickError):
                _fail(error.format_message().replace("Value error, ", ""))
            else:
                raise
    if status == _INTERRUPTED:  # newer typer turns the exception into this status itself
        discard_unfinished()
        sys.stderr.write("hesim-render: interrupted\n")
    sys.exit(status if isinstance(status, int) else 0)


def _fail(message: str) -> None:
    sys.stderr.write(f"hesim-render: {printable(' '.join(message.split()))}\n")
    sys.exit(2)


if __name__ == "__main__":
    main()
