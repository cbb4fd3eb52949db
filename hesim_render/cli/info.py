"""What there is (``info``): the machine, names to be used, figures of a sensor; and files to begin with (``new``)."""

import math
import os
import shlex
from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from hesim_render.cli.console import Console, Json
from hesim_render.cli.exit_status import ExitStatus
from hesim_render.cli.options import HelpAll, Overwrite, SensorKeys, names_of, sensor_keys_only
from hesim_render.cli.terminal import complain, say, split_overrides
from hesim_render.core.errors import ConflictError, RangeError, did_you_mean
from hesim_render.core.output import free_place, write_whole
from hesim_render.core.shipped import list_names

#: Keys of a sensor file that its line needs.
_SENSOR_KEYS = ("geometry", "tile", "pixels", "evs_grid")
#: Words beside the kinds and the sensors.
_MACHINE, _NAMES = "machine", "names"
#: What the kinds of ground truth are.
_TRUTH = {
    "depth": "distance along the axis, and from the entrance pupil, m",
    "normals": "normal of the surface, in axes of the world",
    "position": "point of the surface in the world, m",
    "ids": "numbers of object, instance and material; boxes and masks follow from them",
    "flow": "displacement to the next and the previous time, px, and what stays visible",
    "mixed": "pixels that show more than one surface",
    "poses": "of camera and objects, every ms",
    "boxes": "around visible pixels and whole objects, and in space",
    "imu": "angular rate and acceleration at the camera",
    "light": "level of each light, every ms",
    "events": "cause and object of each event, lost events, and the events without noise",
}
#: Kinds of sensors that there is a template for.
_KINDS = ("frames", "events", "hybrid")


class Kind(StrEnum):
    """Kinds of names that can be listed."""

    scenes = "scenes"
    sensors = "sensors"
    illuminants = "illuminants"
    noise = "noise"
    lens = "lens"
    truth = "truth"
    filter_sets = "filter_sets"
    palettes = "palettes"
    studies = "studies"


def _complete(incomplete: str) -> list[str]:
    words = [_MACHINE, _NAMES, *(kind.value for kind in Kind)]
    return [word for word in words if word.startswith(incomplete)] + names_of("sensors")(incomplete)


def info(
    what: Annotated[
        str,
        typer.Argument(
            metavar="[WHAT]",
            help=f"'{_MACHINE}' (default): what runs here, and what to install; a kind of names: "
            f"{', '.join(kind.value for kind in Kind)}; '{_NAMES}': all of them; or a sensor, by name or file",
            autocompletion=_complete,
            show_default=False,
        ),
    ] = _MACHINE,
    out: Annotated[
        Path | None, typer.Option(help="of a sensor: picture of its curves to write, .png, .svg or .pdf")
    ] = None,
    set_: SensorKeys = None,
    overwrite: Overwrite = False,
    json_: Json = False,
    help_all: HelpAll = False,
) -> None:
    """Show backends, shipped names, or a sensor.

    What this machine can run, the names that can be used, or the figures and curves of a sensor.
    """
    kinds = [kind.value for kind in Kind]
    if what not in (_MACHINE, _NAMES, *kinds):
        sensors = list_names("sensors")
        if not (what in sensors or os.path.isfile(what) or Path(what).suffix in (".yaml", ".yml")):
            known = (_MACHINE, _NAMES, *kinds, *sensors)
            words = ", ".join((_MACHINE, _NAMES, *kinds))
            raise RangeError("WHAT", what, f"a sensor or one of {words}{did_you_mean(what, known)}")
        _show_sensor(what, out, set_ or [], json_, overwrite)
        return
    for name, value in (("--out", out), ("--set", set_)):
        if value:
            raise ConflictError(name, value, f"{name} is for the figures of a sensor, not for '{what}'")
    console = Console(as_json=json_)
    if what == _MACHINE:
        _show_machine(console)
    elif what == _NAMES:
        rows = {kind.value: _rows_of(kind) for kind in Kind}
        text = [
            line for name, result in rows.items() for line in (f"{name}:", *(f"  {line}" for line in _lines(result)))
        ]
        console.result("\n".join(text), rows)
    else:
        result = _rows_of(Kind(what))
        console.result("\n".join(_lines(result)), {what: result})


def _show_machine(console: Console) -> None:
    """Versions, and which candidates of the backend work."""
    from hesim_render.core import backend
    from hesim_render.recording.manifest import software_versions

    versions = software_versions()
    for name, version in versions.items():
        console.text(f"{name:<14}{version}")
    result = [backend.probe(candidate) for candidate in backend.candidates()]
    for candidate in result:
        verdict = "works" if candidate.works else f"does not work: {candidate.reason}"
        console.text(f"{'candidate':<14}{candidate.describe()} - {verdict}")
    chosen = next((candidate for candidate in result if candidate.works), None)
    facts: dict[str, Any] = {
        "versions": versions,
        "candidates": {candidate.describe(): candidate.works for candidate in result},
        "backend": None if chosen is None else chosen.describe(),
    }
    if chosen is None:
        complain(f"no Dr.Jit backend works on this machine: {backend.install_hint()}")
        console.result(f"{'backend':<14}none", facts, ExitStatus.REFUSED)
        return
    variant = f"{chosen.backend}_ad_spectral"
    console.result(f"{'backend':<14}{chosen.describe()}, Mitsuba variant {variant}", facts | {"variant": variant})


def _show_sensor(sensor: str, out: Path | None, changes: list[str], as_json: bool, overwrite: bool) -> None:
    """Figures of a sensor, and curves of noise, latency and S-curves against light, photon transfer and spectra."""
    scene_changes, sensor_changes = split_overrides(changes)
    sensor_keys_only(scene_changes, "sensor.aps.read_noise_e")
    if out is not None:
        free_place(out, overwrite, (".png", ".svg", ".pdf"))
    from hesim_render.describe import figures_of, table_lines, write_picture
    from hesim_render.sensor.sensor import load_sensor

    loaded = load_sensor(sensor, sensor_changes)
    figures = figures_of(loaded)
    rows = {
        section: [
            {"name": row.name, "value": None if math.isnan(row.value) else row.value, "unit": row.unit}
            | ({} if row.stated is None else {"data_sheet": row.stated})
            for row in result
        ]
        for section, result in figures.items()
    }
    lines = [f"{loaded.name}: {loaded.spec.description}", *table_lines(figures)]
    if out is not None:
        write_picture(loaded, out)
        lines.append(f"curves in {out}")
    facts = {"name": loaded.name, "description": loaded.spec.description, "figures": rows, "curves": out}
    Console(as_json=as_json).result("\n".join(lines), facts)


def _rows_of(kind: Kind) -> list[dict[str, Any]]:
    """The names of a kind, with what their files say of them."""
    if kind is Kind.illuminants:
        from hesim_render.spectral.spectrum import illuminant_names

        return [{"name": name} for name in illuminant_names()]
    if kind is Kind.noise:
        from hesim_render.capture.run_settings import NOISE_TERMS

        return [{"name": name} for name in NOISE_TERMS]
    if kind is Kind.lens:
        from hesim_render.specs.lens import LENS_TERMS

        return [{"name": name} for name in LENS_TERMS]
    if kind is Kind.truth:
        from hesim_render.recording.truth_file import TRUTH_KINDS

        return [{"name": name, "description": _TRUTH[name]} for name in TRUTH_KINDS]
    from hesim_render.core.shipped import data_folder, read_keys

    keys = ("description", *(_SENSOR_KEYS if kind is Kind.sensors else ()))
    rows = []
    for name in list_names(kind.value):
        file = read_keys(data_folder(kind.value) / f"{name}.yaml", keys)
        more = _sensor_facts(file) if kind is Kind.sensors else {}
        rows.append({"name": name, **more, "description": file.get("description", "")})
    return rows


def _sensor_facts(file: Mapping[str, Any]) -> dict[str, Any]:
    """Columns and rows of pixels that give frames, of those that give events, and pitch of a shipped sensor."""
    geometry, tile = file["geometry"], file["tile"].split()
    roles = [file["pixels"][letter]["roles"] for letter in "".join(tile)]
    frames = [geometry["cols"], geometry["rows"]] if any("aps" in role for role in roles) else None
    events = None
    if grid := file.get("evs_grid"):
        rows = len(file["tile"].strip().splitlines())
        cols = len("".join(tile)) // rows
        events = [geometry["cols"] // cols * grid["cols_per_tile"], geometry["rows"] // rows * grid["rows_per_tile"]]
    return {"frames_px": frames, "events_px": events, "pitch_um": geometry["pitch_um"]}


def _lines(rows: list[dict[str, Any]]) -> list[str]:
    """One line for each name, in columns."""
    cells = [[str(row["name"]), *_sensor_cells(row)] for row in rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return [
        "  ".join([*(text.ljust(width) for text, width in zip(line, widths, strict=True)), row["description"]])
        if "description" in row
        else line[0]
        for line, row in zip(cells, rows, strict=True)
    ]


def _sensor_cells(row: Mapping[str, Any]) -> list[str]:
    if "pitch_um" not in row:
        return []
    sizes = [(noun, row[f"{noun}_px"]) for noun in ("frames", "events")]
    sizes_text = [f"no {noun}" if size is None else f"{noun} {size[0]}x{size[1]}" for noun, size in sizes]
    return [*sizes_text, f"{row['pitch_um']:>5g} µm"]


def _kinds_and_names(incomplete: str) -> list[str]:
    return [kind for kind in _KINDS if kind.startswith(incomplete)] + names_of("sensors")(incomplete)


def new(
    out: Annotated[Path, typer.Argument(help="sensor file to write, such as mine.yaml")],
    like: Annotated[
        str,
        typer.Option(
            help=f"a template with comments for {', '.join(_KINDS)}, or a shipped sensor to copy (see 'info sensors')",
            autocompletion=_kinds_and_names,
        ),
    ] = "hybrid",
    overwrite: Overwrite = False,
) -> None:
    """Write a sensor file to start from.

    A template in which comments explain every key, or a copy of a shipped one.
    """
    free_place(out, overwrite, (".yaml", ".yml"))
    from hesim_render.sensor.template import sensor_copy, sensor_template

    if like in _KINDS:
        text = sensor_template(out.stem, like)
    elif like in list_names("sensors"):
        text = sensor_copy(out.stem, like)
    else:
        known = (*_KINDS, *list_names("sensors"))
        raise RangeError("--like", like, f"one of {', '.join(known)}{did_you_mean(like, known)}")
    write_whole(out, text)
    say(f"{out}: a sensor file; look at it with: hesim-render info {shlex.quote(str(out))}")
