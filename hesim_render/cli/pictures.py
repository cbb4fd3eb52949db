"""Pictures in place of a recording: the framing of a scene, and what moves in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hesim_render.cli.console import Console
from hesim_render.cli.options import cropped
from hesim_render.core.guard import printable
from hesim_render.core.output import free_place, replacing


def write_framing(
    console: Console,
    scene: str,
    sensor: str,
    out: Path,
    scene_keys: dict[str, Any],
    sensor_keys: dict[str, Any],
    roi: str | None,
    allow_outside: bool,
    overwrite: bool,
) -> None:
    """Write the picture of ``--framing``.

    Parameters
    ----------
    console : where results are said.
    scene, sensor : names or files.
    out : picture to write.
    scene_keys, sensor_keys : changed keys.
    roi, allow_outside, overwrite : options of the command.
    """
    target = _picture_place(out, overwrite)
    from PIL import Image

    import hesim_render as hr
    from hesim_render.sources.render.look import look

    loaded = hr.load_scene(scene, scene_keys, allow_outside=allow_outside)
    outcome = look(loaded, cropped(hr.load_sensor(sensor, sensor_keys), roi))
    with replacing(target) as unfinished:
        Image.fromarray(outcome.picture).save(unfinished, format="PNG")
    for name, materials in outcome.materials.items():
        console.text(f"materials of {name}:")
        for material in materials:
            console.text(f"  {printable(str(material))}")
    console.result(
        f"{outcome.target or 'the scene has no target'}\nframing in {target}",
        {
            "picture": target, "target": None if outcome.target is None else str(outcome.target),
            "materials": {name: [str(one) for one in materials] for name, materials in outcome.materials.items()},
        },
    )  # fmt: skip


def write_look(
    console: Console,
    scene: str,
    sensor: str,
    out: Path,
    scene_keys: dict[str, Any],
    sensor_keys: dict[str, Any],
    roi: str | None,
    allow_outside: bool,
    overwrite: bool,
    look_s: float,
    duration_s: float | None,
) -> None:
    """Write the picture of ``--look``, and print what moves.

    Parameters
    ----------
    console, scene, sensor, out, scene_keys, sensor_keys, roi, allow_outside, overwrite : see `write_framing`.
    look_s : middle of the look, s.
    duration_s : length of the run that the forecast is for, s; None for the default.
    """
    target = _picture_place(out, overwrite)
    from hesim_render.capture.run_settings import RunSettings, whole_us
    from hesim_render.core.units import US_PER_S
    from hesim_render.describe import motion_figures, motion_lines, write_motion
    from hesim_render.sensor.sensor import load_sensor
    from hesim_render.sources.render.truth.motion_look import motion_look
    from hesim_render.sources.scene import load_scene

    duration_us = RunSettings().duration_us if duration_s is None else whole_us(duration_s)
    with console.progress(f"look at {scene}"):
        loaded = cropped(load_sensor(sensor, sensor_keys), roi)
        outcome = motion_look(
            load_scene(scene, scene_keys, allow_outside=allow_outside), loaded, look_s * US_PER_S, duration_us
        )
        write_motion(outcome, loaded, look_s * US_PER_S, target)
    figures = motion_figures(outcome, loaded, duration_us)
    text = "\n".join([*motion_lines(figures, loaded, duration_us), f"look in {target}"])
    console.result(text, {"picture": target, **figures})


def _picture_place(out: Path, overwrite: bool) -> Path:
    """Place of a picture in place of a recording."""
    target = out if out.suffix == ".png" else out.with_name(f"{out.name}.png")
    free_place(target, overwrite)
    return target
