"""Pictures in place of a recording: the framing of a scene, and what moves in it."""

from pathlib import Path

from hesim_render.cli.console import Console
from hesim_render.cli.inputs import Inputs
from hesim_render.core.guard import printable
from hesim_render.core.output import free_place, replacing


def write_framing(console: Console, inputs: Inputs, target: Path) -> None:
    """Write the picture of ``--framing``."""
    from PIL import Image

    from hesim_render.sources.render.look import look

    framing = look(inputs.load_scene(), inputs.load_sensor())
    with replacing(target) as unfinished:
        Image.fromarray(framing.picture).save(unfinished, format="PNG")
    for name, materials in framing.materials.items():
        console.text(f"materials of {name}:")
        for material in materials:
            console.text(f"  {printable(str(material))}")
    console.result(
        f"{framing.target or 'the scene has no target'}\nframing in {target}",
        {
            "picture": target, "target": None if framing.target is None else str(framing.target),
            "materials": {name: [str(one) for one in materials] for name, materials in framing.materials.items()},
        },
    )  # fmt: skip


def write_look(console: Console, inputs: Inputs, target: Path, look_s: float, duration_s: float | None) -> None:
    """Write the picture of ``--look``, and print what moves.

    Parameters
    ----------
    look_s : middle of the look, s.
    duration_s : length of the run that the forecast is for, s; None for the default.
    """
    from hesim_render.capture.run_settings import RunSettings, whole_us
    from hesim_render.core.units import US_PER_S
    from hesim_render.describe import motion_figures, motion_lines, write_motion
    from hesim_render.sources.render.truth.motion_look import motion_look

    duration_us = RunSettings().duration_us if duration_s is None else whole_us(duration_s)
    with console.progress(f"look at {inputs.name}"):
        loaded = inputs.load_sensor()
        motion = motion_look(inputs.load_scene(), loaded, look_s * US_PER_S, duration_us)
        write_motion(motion, loaded, look_s * US_PER_S, target)
    figures = motion_figures(motion, loaded, duration_us)
    text = "\n".join([*motion_lines(figures, loaded, duration_us), f"look in {target}"])
    console.result(text, {"picture": target, **figures})


def picture_place(out: Path, overwrite: bool) -> Path:
    """Place of a picture in place of a recording."""
    target = out if out.suffix == ".png" else out.with_name(f"{out.name}.png")
    free_place(target, overwrite)
    return target
