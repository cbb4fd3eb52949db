"""Recordings: ``simulate`` of a scene, video, cube, run file or recording, and ``demo``."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hesim_render.cli.console import Console, DryRun, Json, Quiet, recording_facts
from hesim_render.cli.exit_status import ExitStatus
from hesim_render.cli.inputs import InputKind, Inputs, check_options, input_kind, was_given, with_values
from hesim_render.cli.options import (
    LONG_MINUTES,
    SENSOR_HELP,
    AllowOutside,
    Clean,
    HelpAll,
    Overwrite,
    Region,
    Truth,
    Without,
    Yes,
    check_duration,
    check_output,
    listed,
    names_of,
    place_of,
)
from hesim_render.cli.pictures import picture_place, write_framing, write_look
from hesim_render.cli.terminal import split_overrides, summary
from hesim_render.core.errors import ConflictError

if TYPE_CHECKING:
    from hesim_render.recording.recording import Recording

_DEMO_RUNS = (("colorchecker", "eiger"), ("rotating-star", "gen2"))


def simulate(
    given: Annotated[
        str,
        typer.Argument(
            metavar="INPUT",
            help="a scene (a name, see 'info scenes', or a file), a video (a file, a folder of numbered pictures, "
            ".npy), a hyperspectral cube (.hdr, .mat, .h5, .exr, .npy, a folder of CAVE), a run file, or a recording "
            "of a scene to make again",
            autocompletion=names_of("scenes"),
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(help="folder to write to; the same command continues an interrupted run")
    ] = None,
    sensor: Annotated[str | None, typer.Option(help=SENSOR_HELP, autocompletion=names_of("sensors"))] = None,
    duration: Annotated[float | None, typer.Option(help="simulated time, s; default 0.1, of a video all of it")] = None,
    roi: Region = None,
    seed: Annotated[int | None, typer.Option(help="of all noise and of the render; default 7")] = None,
    quality: Annotated[
        float | None, typer.Option(help="error of the render as a fraction of the sensor's noise (default 0.5)")
    ] = None,
    exact: Annotated[
        bool,
        typer.Option("--exact", help="every pixel of every slice, with equally many rays", hidden=True),
    ] = False,
    samples: Annotated[
        int | None, typer.Option(help="with --exact: rays per pixel and slice of time", hidden=True)
    ] = None,
    truth: Truth = None,
    truth_every_us: Annotated[
        int | None,
        typer.Option(
            help="with --truth: interval between descriptions of event pixels (default: one for each frame)",
            hidden=True,
        ),
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="change a key of the input (docs/cli.md), or with sensor. of the sensor file; repeatable",
        ),
    ] = None,
    clean: Clean = False,
    without: Without = None,
    allow_outside: AllowOutside = False,
    scene_file: Annotated[
        str | None,
        typer.Option("--scene", help="of a recording: the scene file, if it needs files that it lacks", hidden=True),
    ] = None,
    framing: Annotated[
        bool,
        typer.Option("--framing", help="only show the framing: a quick picture without light, OUT.png", hidden=True),
    ] = False,
    look: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS",
            help="only look: the scene at this time, trails of what moves and density of events without light, OUT.png",
            hidden=True,
        ),
    ] = None,
    live: Annotated[
        bool,
        typer.Option(
            "--live", help="show the run in rerun while it goes on; without a display, in OUT/live.rrd", hidden=True
        ),
    ] = False,
    workers: Annotated[
        int | None,
        typer.Option(
            help="processes that render, each its own rows of the sensor; the recording is the same (default 1)",
            hidden=True,
        ),
    ] = None,
    yes: Yes = False,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
    json_: Json = False,
    quiet: Quiet = False,
    help_all: HelpAll = False,
) -> None:
    """Record a scene, a video or a hyperspectral cube.

    The recording has RAW frames, events and their ground truth. A run file also develops, exports and shows it. A
    recording is made again from its recording.json.

    Ends with status 3 where the audit finds that the recording is worse than --quality asks for.
    """
    keys, sensor_keys = split_overrides(set_ or [])
    kind = input_kind(given, keys)
    check_options(kind, {
        "--sensor": sensor, "--duration": duration, "--roi": roi, "--seed": seed, "--quality": quality,
        "--exact": exact, "--samples": samples, "--truth": truth, "--truth-every-us": truth_every_us, "--set": set_,
        "--clean": clean, "--without": without, "--allow-outside": allow_outside, "--scene": scene_file,
        "--framing": framing, "--look": look, "--live": live, "--workers": workers,
    })  # fmt: skip
    if duration is not None:
        check_duration(duration)
    console = Console(json_, quiet, dry_run)
    limits: dict[str, Any] = {"max_minutes": None if yes else LONG_MINUTES, "overwrite": overwrite}
    common = _given(seed=seed, clean=clean, without=without or [], duration_s=duration, live=live)
    rendered = _given(quality=quality, exact=exact, samples=samples, truth=listed(truth), truth_every_us=truth_every_us)
    place = place_of(out, dry_run)
    if live and not dry_run:
        _tell_live_file(console, place)
    if kind is InputKind.recording:
        _again(console, Path(given), place, scene_file, allow_outside, limits)
    elif kind is InputKind.run:
        changes = keys | common | rendered | _given(sensor=sensor, roi=roi)
        _run(console, Path(given), place, changes, sensor_keys, allow_outside, limits)
    elif sensor is None:
        raise ConflictError("--sensor", None, "Missing option '--sensor': the name or the file of one (info sensors)")
    elif framing or look is not None:
        if sum((framing, look is not None, dry_run)) > 1:
            raise ConflictError("--framing", framing, "give one of --framing, --look and --dry-run")
        inputs, target = Inputs(given, sensor, keys, sensor_keys, roi, allow_outside), picture_place(place, overwrite)
        if look is None:
            write_framing(console, inputs, target)
        else:
            write_look(console, inputs, target, look, duration)
    else:
        inputs = Inputs(given, sensor, keys, sensor_keys, roi, allow_outside)
        if kind is InputKind.scene:
            rendered |= _given(workers=workers)
            show_recording(console, _scene(console, inputs, place, **limits, **common, **rendered))
        else:
            _pictures(console, kind, inputs, place, {**limits, **common})


def _tell_live_file(console: Console, out: Path) -> None:
    """Say where the live view is while the run goes on."""
    from hesim_render.core.output import unfinished_place
    from hesim_render.recording.live_view import live_file

    file = live_file(unfinished_place(out.expanduser().resolve()))
    console.text("live view: rerun" if file is None else f"live view: rerun {file}")


def _given(**options: Any) -> dict[str, Any]:
    """The options that were given, so that the others keep their defaults."""
    return {name: value for name, value in options.items() if was_given(value)}


def show_recording(
    console: Console, recording: "Recording", more: str = "", facts: Mapping[str, Any] | None = None
) -> None:
    """The result of a run: its recording, with the status that the audit gives."""
    from hesim_render.recording.quality import is_short_of_wish

    short = is_short_of_wish(recording.manifest["settings"].get("render", {}).get("audit"))
    status = ExitStatus.NOT_MET if short else ExitStatus.DONE
    console.result(summary(recording) + more, {**recording_facts(recording), **(facts or {})}, status)


def _scene(console: Console, inputs: Inputs, out: Path, overwrite: bool = False, **options: Any) -> "Recording":
    """The recording of a scene."""
    check_output(out, overwrite)
    with console.stop_at_estimate(), console.progress(f"{inputs.name} → {inputs.sensor}") as progress:
        import hesim_render as hr

        sensor, scene = inputs.load_sensor(), inputs.load_scene()
        return hr.simulate(
            scene, sensor, out=out, overwrite=overwrite, progress=progress,
            on_estimate=console.estimated(progress), resume=True, **options,
        )  # fmt: skip


def _pictures(console: Console, kind: InputKind, inputs: Inputs, out: Path, options: dict[str, Any]) -> None:
    """Record a video or a hyperspectral cube."""
    check_output(out, options["overwrite"])
    with console.stop_at_estimate(), console.progress(f"{Path(inputs.name).name} → {inputs.sensor}") as progress:
        import hesim_render as hr

        loaded = inputs.load_sensor()
        options |= with_values(inputs.keys)
        options |= {"out": out, "progress": progress, "on_estimate": console.estimated(progress)}
        if kind is InputKind.video:
            recording = hr.simulate_video(inputs.name, loaded, resume=True, **options)
        else:
            del options["max_minutes"]  # a cube takes no rays
            recording = hr.simulate_cube(inputs.name, loaded, **options)
    notes = recording.manifest["settings"].get("video", {}).get("notes", [])
    show_recording(console, recording, "".join(f"\nnote: {text}" for text in notes))


def _run(
    console: Console,
    file: Path,
    out: Path,
    changes: dict[str, Any],
    sensor_keys: dict[str, Any],
    allow_outside: bool,
    limits: dict[str, Any],
) -> None:
    """Do what the file of a run asks for, with other values of its keys and of those of the sensor file."""
    with console.stop_at_estimate(), console.progress(file.name) as progress:
        from hesim_render.capture.run_file import run
        from hesim_render.core.yaml_file import read_yaml

        if sensor_keys:
            of_file = changes.get("set", read_yaml(file).get("set")) or {}
            changes["set"] = {**of_file, **{f"sensor.{key}": value for key, value in sensor_keys.items()}}
        made = run(
            file, out, overrides=changes, allow_outside=allow_outside, progress=progress,
            on_estimate=console.estimated(progress), **limits,
        )  # fmt: skip
    files = "".join(f"\n  {name}: {path}" for name, path in list(made.written.items())[1:])
    kept = f"\n  made by an earlier run: {', '.join(made.kept)}" if made.kept else ""
    show_recording(console, made.recording, files + kept, {"written": made.written, "kept": list(made.kept)})


def _again(
    console: Console, recording: Path, out: Path, scene: str | None, allow_outside: bool, limits: dict[str, Any]
) -> None:
    """Make a recording again: the same bytes, on the same versions and backend."""
    check_output(out, limits["overwrite"])
    with console.stop_at_estimate(), console.progress(f"{recording} again") as progress:
        from hesim_render.capture.again import simulate_again
        from hesim_render.recording.recording import Recording
        from hesim_render.sources.scene import load_scene

        loaded = Recording.load(recording)
        given = None if scene is None else load_scene(scene, allow_outside=allow_outside)
        again = simulate_again(
            loaded, out, given, progress=progress, on_estimate=console.estimated(progress), resume=True, **limits
        )
    show_recording(console, again)


def demo(
    out: Annotated[Path, typer.Option(help="folder for the two recordings (replaced if already there)")] = Path("demo"),
) -> None:
    """Make two small recordings with pictures.

    A ColorChecker, and a moving scene.
    """
    from hesim_render.recording.quality import is_short_of_wish

    console = Console()
    runs = {out / f"{scene}-{sensor}": (scene, sensor) for scene, sensor in _DEMO_RUNS}
    for target in runs:
        check_output(target, overwrite=True)
    audits = {}
    for target, (scene, sensor) in runs.items():
        recording = _scene(
            console, Inputs(scene, sensor, roi="512x384"), target, overwrite=True, duration_s=0.1, seed=7
        )
        audits[target.name] = recording.manifest["settings"].get("render", {}).get("audit")
        console.text(summary(recording) + "\n")
    still, moving = runs
    console.text(f"Look at {still / 'preview.png'} (24 measured patches)")
    status = ExitStatus.NOT_MET if any(map(is_short_of_wish, audits.values())) else ExitStatus.DONE
    console.result(f"    and {moving / 'preview.gif'} (events of a moving scene).", {}, status)
