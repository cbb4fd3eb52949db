"""Sensors: ``sensor describe`` and ``sensor new``."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated

import typer

from hesim_render.cli.options import SENSOR_HELP, Overwrite, SensorKeys, names_of, sensor_keys_only
from hesim_render.cli.terminal import say, split_overrides
from hesim_render.cli.told import Json
from hesim_render.core.errors import RangeError, did_you_mean
from hesim_render.core.output import free_place, replacing
from hesim_render.core.shipped import list_names

app = typer.Typer(no_args_is_help=True, help="Show what a sensor does, or begin a sensor file.", rich_markup_mode=None)


#: Kinds of sensors that there is a template for.
_KINDS = ("frames", "events", "hybrid")


def _kinds_and_names(incomplete: str) -> list[str]:
    return [kind for kind in _KINDS if kind.startswith(incomplete)] + names_of("sensors")(incomplete)


@app.command()
def describe(
    sensor: Annotated[str, typer.Argument(help=SENSOR_HELP, autocompletion=names_of("sensors"))],
    out: Annotated[
        Path | None, typer.Option(help="picture of the curves to write, .png, .svg or .pdf; default none")
    ] = None,
    json_: Json = False,
    set_: SensorKeys = None,
    overwrite: Overwrite = False,
) -> None:
    """Figures of a sensor, and curves of noise, latency and S-curves against light, photon transfer and spectra."""
    scene_changes, changes = split_overrides(set_ or [])
    sensor_keys_only(scene_changes, "sensor.aps.read_noise_e")
    if out is not None:
        free_place(out, overwrite, (".png", ".svg", ".pdf"))
    from hesim_render.describe import figures_of, table_lines, write_picture
    from hesim_render.sensor.sensor import load_sensor

    loaded = load_sensor(sensor, changes)
    figures = figures_of(loaded)
    if json_:
        rows = {
            section: [
                {"name": row.name, "value": None if math.isnan(row.value) else row.value, "unit": row.unit}
                | ({} if row.stated is None else {"data_sheet": row.stated})
                for row in found
            ]
            for section, found in figures.items()
        }
        head = {"name": loaded.name, "description": loaded.spec.description}
        say(json.dumps(head | {"figures": rows}, ensure_ascii=False, indent=2))
    else:
        say("\n".join([f"{loaded.name}: {loaded.spec.description}", *table_lines(figures)]))
    if out is not None:
        write_picture(loaded, out)
        if not json_:
            say(f"curves in {out}")


@app.command()
def new(
    out: Annotated[Path, typer.Argument(help="sensor file to write, such as mine.yaml")],
    like: Annotated[
        str,
        typer.Option(
            help=f"a template with comments for {', '.join(_KINDS)}, or a shipped sensor to copy (see 'list sensors')",
            autocompletion=_kinds_and_names,
        ),
    ] = "hybrid",
    overwrite: Overwrite = False,
) -> None:
    """Write a sensor file to begin with: a template in which comments explain every key, or a copy of a shipped one."""
    free_place(out, overwrite, (".yaml", ".yml"))
    from hesim_render.sensor.template import sensor_copy, sensor_template

    if like in _KINDS:
        text = sensor_template(out.stem, like)
    elif like in list_names("sensors"):
        text = sensor_copy(out.stem, like)
    else:
        known = (*_KINDS, *list_names("sensors"))
        raise RangeError("--like", like, f"one of {', '.join(known)}{did_you_mean(like, known)}")
    with replacing(out) as unfinished:
        unfinished.write_text(text, encoding="utf-8")
    say(f"{out}: a sensor file; look at it with 'hesim-render sensor describe {out}'")
