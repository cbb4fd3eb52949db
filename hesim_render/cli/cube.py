"""Spectral cubes of scenes: ``cube``."""

import math
import re
from pathlib import Path
from typing import Annotated

import typer

from hesim_render.cli.options import AllowOutside, HelpAll, Overwrite, Region, SensorFile, cropped, names_of
from hesim_render.cli.terminal import say, split_overrides
from hesim_render.core.errors import RangeError
from hesim_render.core.output import free_place

#: Largest number of bands.
_MOST_BANDS = 1000


def cube(
    scene: Annotated[
        str,
        typer.Argument(
            help="a name (see 'info scenes') or the path of a scene file", autocompletion=names_of("scenes")
        ),
    ],
    sensor: SensorFile,
    out: Annotated[Path, typer.Option(help="spectral EXR file to write")],
    bands: Annotated[
        str, typer.Option(metavar="FIRST:LAST:STEP", help="wavelengths, nm; or a list with commas")
    ] = "400:700:10",
    begin_us: Annotated[float, typer.Option(help="the instant, or begin of the window, µs")] = 0.0,
    end_us: Annotated[float | None, typer.Option(help="end of the window, µs; default: an instant")] = None,
    samples: Annotated[int, typer.Option(help="rays per pixel, four bands and slice of time")] = 64,
    roi: Region = None,
    seed: Annotated[int, typer.Option(help="of the render", hidden=True)] = 7,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="change a key of the scene file, or with sensor. of the sensor file"
        ),
    ] = None,
    allow_outside: AllowOutside = False,
    overwrite: Overwrite = False,
    help_all: HelpAll = False,
) -> None:
    """Render the spectral radiance on a sensor's pixels.

    At an instant, or the mean over a window of time.
    """
    wavelengths = parse_bands(bands)
    free_place(out, overwrite, (".exr",))
    import hesim_render as hr

    scene_changes, sensor_changes = split_overrides(set_ or [])
    loaded_sensor = cropped(hr.load_sensor(sensor, sensor_changes), roi)
    loaded_scene = hr.load_scene(scene, scene_changes, allow_outside=allow_outside)
    result, radiance, stderr = hr.render_cube(
        loaded_scene, loaded_sensor, wavelengths, samples, begin_us, end_us=end_us, seed=seed
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    hr.write_spectral_exr(out, radiance, result)
    mean = float(radiance.mean())
    share = math.sqrt(float((stderr.astype("f8") ** 2).mean())) / mean if mean > 0 else 0.0
    say(f"{result.size} bands of {radiance.shape[1]}x{radiance.shape[0]} px, mean {mean:.4g} W m^-2 sr^-1 nm^-1, "
        f"standard error of a pixel {100 * share:.2g} % of it (rms), in {out}")  # fmt: skip


def parse_bands(text: str, name: str = "--bands") -> list[float]:
    """Wavelengths of ``400:700:10`` or ``450,550,650``, nm."""
    expected = "FIRST:LAST:STEP or a list with commas, in nm, such as 400:700:10"
    if re.fullmatch(r"[0-9.:,eE+ -]+", text) is None:
        raise RangeError(name, text, expected)
    try:
        if ":" not in text:
            return [float(part) for part in text.split(",")]
        first, last, step = (float(part) for part in text.split(":"))
    except ValueError:
        raise RangeError(name, text, expected) from None
    if not (step > 0 and last >= first and (last - first) / step < _MOST_BANDS):
        raise RangeError(name, text, f"{expected}, at most {_MOST_BANDS} bands")
    count = math.floor((last - first) / step + 1e-9) + 1
    return [first + step * number for number in range(count)]
