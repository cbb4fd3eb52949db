"""Sensors: ``sensor describe`` and ``sensor new``."""

from __future__ import annotations

import json
import math
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from hesim_render.cli.options import SENSOR_HELP, Overwrite, SensorKeys, names_of, sensor_keys_only
from hesim_render.cli.terminal import say, split_overrides
from hesim_render.cli.told import Json
from hesim_render.core.errors import OutputError
from hesim_render.core.output import free_place, replacing

app = typer.Typer(no_args_is_help=True, help="Show what a sensor does, or begin a sensor file.", rich_markup_mode=None)


class Like(StrEnum):
    """Kinds of sensors to begin with."""

    frames = "frames"
    events = "events"
    hybrid = "hybrid"


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
        free_place(out, overwrite)
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
    like: Annotated[Like, typer.Option(help="pixels for frames, for events, or for both")] = Like.hybrid,
    overwrite: Overwrite = False,
) -> None:
    """Write a sensor file to begin with, in which comments explain every key."""
    if out.suffix not in (".yaml", ".yml"):
        raise OutputError(f"{out}: give a name that ends in .yaml")
    free_place(out, overwrite)
    from hesim_render.specs.sensor_template import sensor_template

    with replacing(out) as unfinished:
        unfinished.write_text(sensor_template(out.stem, like.value), encoding="utf-8")
    say(f"{out}: a sensor file; look at it with 'hesim-render sensor describe {out}'")
