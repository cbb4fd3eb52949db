"""Files of other programs: ``export`` and ``import``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hesim_render.cli.options import Overwrite
from hesim_render.cli.terminal import parse_size, say

_EXPORTS = ("evt2", "evt3", "aedat4", "dsec", "npz", "txt", "nmnist", "tiff", "png", "npy", "mipi")
_IMPORTS = ("evt2", "evt3", "aedat4", "dsec", "npz")


def _complete_export(incomplete: str) -> list[str]:
    return [name for name in _EXPORTS if name.startswith(incomplete)]


def _complete_import(incomplete: str) -> list[str]:
    return [name for name in _IMPORTS if name.startswith(incomplete)]


def export(
    recording: Annotated[Path, typer.Argument(help="folder of a recording")],
    format: Annotated[
        str,
        typer.Option(help=f"events: {', '.join(_EXPORTS[:7])}; frames: {', '.join(_EXPORTS[7:])}",
                     autocompletion=_complete_export),
    ],
    out: Annotated[Path, typer.Option(help="file of the events, or folder of the frames")],
    overwrite: Overwrite = False,
) -> None:  # fmt: skip
    """Write the events or the RAW frames of a recording in the format of another program."""
    from hesim_render.recording.recording import Recording

    loaded = Recording.load(recording)
    written = loaded.export(format, out, overwrite)
    counts = loaded.manifest["counts"]
    what = f"{counts['frames']} frames" if written.is_dir() else f"{counts['events']} events"
    say(f"{what} in {written}")


def import_(
    source: Annotated[Path, typer.Argument(metavar="FILE", help="EVT2 or EVT3 RAW, AEDAT4, DSEC HDF5, or .npz file")],
    out: Annotated[Path, typer.Option(help="HDF5 file to write")],
    format: Annotated[
        str | None,
        typer.Option(help=f"{', '.join(_IMPORTS)}; default: what the file says", autocompletion=_complete_import),
    ] = None,
    size: Annotated[str | None, typer.Option(help="WIDTHxHEIGHT of the sensor, where the file does not say it")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Write the events of another program's file in the layout of a recording's events.h5."""
    from hesim_render.recording.exports import import_events

    shape = None if size is None else parse_size(size)
    say(f"events in {import_events(source, out, format=format, shape=shape, overwrite=overwrite)}")
