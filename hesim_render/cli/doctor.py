"""State of the installation, and available names: ``doctor`` and ``list``."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated, Any

import typer

from hesim_render.cli.terminal import complain, say


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
    study_specs = "study_specs"
    design_specs = "design_specs"
    sweep_specs = "sweep_specs"


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
        complain(f"no Dr.Jit backend works on this machine: {backend.INSTALL_HINT}")
        raise typer.Exit(2)
    say(f"{'backend':<14}{chosen.describe()}, Mitsuba variant {chosen.backend}_ad_spectral")


def list_(
    kind: Annotated[
        Kind | None,
        typer.Argument(help="one of the kinds; default all"),
    ] = None,
) -> None:
    """List the names that can be used."""
    if kind is not None:
        say("\n".join(_lines_of(kind)))
        return
    for each in Kind:
        say("\n".join([f"{each.value}:", *(f"  {line}" for line in _lines_of(each))]))


def _lines_of(kind: Kind) -> list[str]:
    """One line for each name of a kind, with a description if its file has one."""
    if kind is Kind.illuminants:
        from hesim_render.spectral.spectrum import illuminant_names

        return illuminant_names()
    if kind is Kind.noise:
        from hesim_render.capture.noise_terms import NOISE_TERMS

        return list(NOISE_TERMS)
    if kind is Kind.lens:
        from hesim_render.specs.lens import LENS_TERMS

        return list(LENS_TERMS)
    if kind is Kind.truth:
        from hesim_render.recording.truth_kinds import TRUTH_KINDS

        return list(TRUTH_KINDS)
    from hesim_render.specs.files import data_folder, list_names, load_yaml

    names = list_names(kind.value)
    files = [load_yaml(data_folder(kind.value) / f"{name}.yaml") for name in names]
    columns = [
        [name, *(_sensor_columns(file) if kind is Kind.sensors else ())]
        for name, file in zip(names, files, strict=True)
    ]
    widths = [max(map(len, column)) for column in zip(*columns, strict=True)]
    return [
        "  ".join([*(text.ljust(width) for text, width in zip(row, widths, strict=True)), file.get("description", "")])
        for row, file in zip(columns, files, strict=True)
    ]


def _sensor_columns(file: Mapping[str, Any]) -> tuple[str, str, str]:
    """Pixels that give frames, pixels that give events, and pitch of a shipped sensor."""
    geometry, tile = file["geometry"], file["tile"].split()
    roles = [file["pixels"][letter]["roles"] for letter in "".join(tile)]
    frames = f"frames {geometry['cols']}x{geometry['rows']}" if any("aps" in role for role in roles) else "no frames"
    if grid := file.get("evs_grid"):
        rows = len(file["tile"].strip().splitlines())
        cols = len("".join(tile)) // rows
        size = geometry["cols"] // cols * grid["cols_per_tile"], geometry["rows"] // rows * grid["rows_per_tile"]
        return frames, f"events {size[0]}x{size[1]}", f"{geometry['pitch_um']:>5g} µm"
    return frames, "no events", f"{geometry['pitch_um']:>5g} µm"
