"""State of the installation, and available names: ``doctor`` and ``list``."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated, Any

import typer

from hesim_render.cli.exit_status import ExitStatus
from hesim_render.cli.terminal import complain, say
from hesim_render.cli.told import Json, Told

#: Keys of a sensor file that its line needs.
_SENSOR_KEYS = ("geometry", "tile", "pixels", "evs_grid")


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


def doctor() -> None:
    """Say what this machine can run, and what to install where it can run nothing."""
    from hesim_render.core import backend
    from hesim_render.recording.manifest import software_versions

    for name, version in software_versions().items():
        say(f"{name:<14}{version}")
    found = [backend.probe(candidate) for candidate in backend.candidates()]
    for candidate in found:
        verdict = "works" if candidate.works else f"does not work: {candidate.reason}"
        say(f"{'candidate':<14}{candidate.describe()} - {verdict}")
    chosen = next((candidate for candidate in found if candidate.works), None)
    if chosen is None:
        say(f"{'backend':<14}none")
        complain(f"no Dr.Jit backend works on this machine: {backend.install_hint()}")
        raise typer.Exit(int(ExitStatus.REFUSED))
    say(f"{'backend':<14}{chosen.describe()}, Mitsuba variant {chosen.backend}_ad_spectral")


def list_(
    kind: Annotated[
        Kind | None,
        typer.Argument(help="one of the kinds; default all"),
    ] = None,
    json_: Json = False,
) -> None:
    """List the names that can be used."""
    kinds = list(Kind) if kind is None else [kind]
    rows = {each.value: _rows_of(each) for each in kinds}
    if json_:
        Told(as_json=True).result("", rows)
    elif kind is not None:
        say("\n".join(_lines(rows[kind.value])))
    else:
        for name, found in rows.items():
            say("\n".join([f"{name}:", *(f"  {line}" for line in _lines(found))]))


def _rows_of(kind: Kind) -> list[dict[str, Any]]:
    """The names of a kind, with what their files say of them."""
    if kind is Kind.illuminants:
        from hesim_render.spectral.spectrum import illuminant_names

        return [{"name": name} for name in illuminant_names()]
    if kind is Kind.noise:
        from hesim_render.capture.noise_terms import NOISE_TERMS

        return [{"name": name} for name in NOISE_TERMS]
    if kind is Kind.lens:
        from hesim_render.specs.lens import LENS_TERMS

        return [{"name": name} for name in LENS_TERMS]
    if kind is Kind.truth:
        from hesim_render.recording.truth_kinds import TRUTH_KINDS

        return [{"name": name} for name in TRUTH_KINDS]
    from hesim_render.core.shipped import data_folder, list_names, read_keys

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
    told = [f"no {noun}" if size is None else f"{noun} {size[0]}x{size[1]}" for noun, size in sizes]
    return [*told, f"{row['pitch_um']:>5g} µm"]
