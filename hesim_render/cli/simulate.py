"""Scenes into recordings: ``simulate`` and ``demo``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hesim_render.cli.exit_status import ExitStatus
from hesim_render.cli.options import (
    LONG_MINUTES,
    AllowOutside,
    Clean,
    Overwrite,
    Region,
    SensorFile,
    Truth,
    Without,
    Yes,
    check_duration,
    check_output,
    cropped,
    listed,
    names_of,
)
from hesim_render.cli.terminal import split_overrides, summary
from hesim_render.cli.told import DryRun, Json, Quiet, Told, recording_facts
from hesim_render.core.errors import ConflictError
from hesim_render.core.guard import printable
from hesim_render.core.output import free_place, replacing

if TYPE_CHECKING:
    from hesim_render.recording.recording import Recording

_DEMO_RUNS = (("colorchecker", "eiger"), ("rotating-star", "gen2"))


def simulate(
    scene: Annotated[
        str,
        typer.Argument(
            help="a name (see 'list scenes') or the path of a scene file", autocompletion=names_of("scenes")
        ),
    ],
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
    yes: Yes = False,
    truth: Truth = None,
    truth_every_us: Annotated[
        int | None,
        typer.Option(help="with --truth: interval between descriptions of event pixels (default: one for each frame)"),
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="change a key of the scene file, or with sensor. of the sensor file"
        ),
    ] = None,
    clean: Clean = False,
    without: Without = None,
    allow_outside: AllowOutside = False,
    look: Annotated[
        bool, typer.Option("--look", help="only show the framing: a quick picture without light, OUT.png")
    ] = False,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
    json_: Json = False,
    quiet: Quiet = False,
) -> None:
    """Render a scene and record it: RAW frames, events and their ground truth.

    Ends with status 3 where the audit finds that the recording is worse than --quality asks for.
    """
    check_duration(duration)
    scene_changes, sensor_changes = split_overrides(set_ or [])
    told = Told(json_, quiet, dry_run)
    if look:
        if dry_run:
            raise ConflictError("--look", look, "give --look or --dry-run, not both")
        _look(told, scene, sensor, out, scene_changes, sensor_changes, roi, allow_outside, overwrite)
        return
    recording = _simulate(
        told, scene, sensor, out, scene_changes=scene_changes, sensor_changes=sensor_changes, roi=roi,
        overwrite=overwrite, duration_s=duration, seed=seed, quality=quality, exact=exact, samples=samples,
        max_minutes=None if yes else LONG_MINUTES,
        clean=clean, without=without or (), allow_outside=allow_outside,
        truth=listed(truth), truth_every_us=truth_every_us,
    )  # fmt: skip
    tell_recording(told, recording)


def tell_recording(told: Told, recording: Recording, more: str = "", facts: Mapping[str, Any] | None = None) -> None:
    """The result of a run: its recording, with the status that the audit gives."""
    from hesim_render.recording.quality import is_short_of_wish

    short = is_short_of_wish(recording.manifest["settings"].get("render", {}).get("audit"))
    status = ExitStatus.NOT_MET if short else ExitStatus.DONE
    told.result(summary(recording) + more, {**recording_facts(recording), **(facts or {})}, status)


def _look(
    told: Told,
    scene: str,
    sensor: str,
    out: Path,
    scene_changes: dict[str, Any],
    sensor_changes: dict[str, Any],
    roi: str | None,
    allow_outside: bool,
    overwrite: bool,
) -> None:
    """Write the picture of ``--look``."""
    target = out if out.suffix == ".png" else out.with_name(f"{out.name}.png")
    free_place(target, overwrite)
    from PIL import Image

    import hesim_render as hr
    from hesim_render.sources.render.look import look

    loaded = hr.load_scene(scene, scene_changes, allow_outside=allow_outside)
    found = look(loaded, cropped(hr.load_sensor(sensor, sensor_changes), roi))
    with replacing(target) as unfinished:
        Image.fromarray(found.picture).save(unfinished, format="PNG")
    for name, materials in found.materials.items():
        told.text(f"materials of {name}:")
        for material in materials:
            told.text(f"  {printable(str(material))}")
    told.result(
        f"{found.target or 'the scene has no target'}\nframing in {target}",
        {
            "picture": target, "target": None if found.target is None else str(found.target),
            "materials": {name: [str(one) for one in materials] for name, materials in found.materials.items()},
        },
    )  # fmt: skip


def rerun(
    recording: Annotated[Path, typer.Argument(help="folder of a recording of a scene")],
    out: Annotated[Path, typer.Option(help="folder to write the new recording to")],
    scene: Annotated[
        str | None, typer.Option(help="the scene file, if it needs files that the recording does not hold")
    ] = None,
    yes: Yes = False,
    allow_outside: AllowOutside = False,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
    json_: Json = False,
    quiet: Quiet = False,
) -> None:
    """Make a recording again from its recording.json: the same bytes, on the same versions and backend."""
    check_output(out, overwrite)
    told = Told(json_, quiet, dry_run)
    with told.stop_at_estimate(), told.progress(f"{recording} again") as progress:
        from hesim_render.capture.again import simulate_again
        from hesim_render.recording.recording import Recording
        from hesim_render.sources.scene import load_scene

        loaded = Recording.load(recording)
        given = None if scene is None else load_scene(scene, allow_outside=allow_outside)
        again = simulate_again(
            loaded, out, given, overwrite=overwrite, progress=progress, on_estimate=told.estimated(progress),
            max_minutes=None if yes else LONG_MINUTES, resume=True,
        )  # fmt: skip
    tell_recording(told, again)


def demo(
    out: Annotated[Path, typer.Option(help="folder for the two recordings (replaced if already there)")] = Path("demo"),
) -> None:
    """Two small recordings with pictures: a ColorChecker, and a moving scene."""
    from hesim_render.recording.quality import is_short_of_wish

    told = Told()
    runs = {out / f"{scene}-{sensor}": (scene, sensor) for scene, sensor in _DEMO_RUNS}
    for target in runs:
        check_output(target, overwrite=True)
    audits = {}
    for target, (scene, sensor) in runs.items():
        recording = _simulate(told, scene, sensor, target, roi="512x384", overwrite=True, duration_s=0.1, seed=7)
        audits[target.name] = recording.manifest["settings"].get("render", {}).get("audit")
        told.text(summary(recording) + "\n")
    still, moving = runs
    told.text(f"Look at {still / 'preview.png'} (24 measured patches)")
    status = ExitStatus.NOT_MET if any(map(is_short_of_wish, audits.values())) else ExitStatus.DONE
    told.result(f"    and {moving / 'preview.gif'} (events of a moving scene).", {}, status)


def _simulate(
    told: Told,
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
    check_output(out, overwrite)
    with told.stop_at_estimate(), told.progress(f"{scene} → {sensor}") as progress:
        import hesim_render as hr

        loaded_sensor = cropped(hr.load_sensor(sensor, sensor_changes), roi)
        loaded_scene = hr.load_scene(scene, scene_changes, allow_outside=allow_outside)
        return hr.simulate(
            loaded_scene, loaded_sensor, out=out, overwrite=overwrite, progress=progress,
            on_estimate=told.estimated(progress), resume=True, **options,
        )  # fmt: skip
