"""Recordings as pictures and pages: ``isp`` and ``view``."""

from pathlib import Path
from typing import Annotated

import typer

from hesim_render.cli.console import Console, Json, Quiet, recording_facts
from hesim_render.cli.options import HelpAll, Overwrite
from hesim_render.cli.terminal import summary
from hesim_render.core.errors import ConflictError
from hesim_render.core.guard import WholeFile
from hesim_render.core.output import free_place, output_errors, replacing


def isp(
    recording: Annotated[Path, typer.Argument(help="folder of a recording")],
    out: Annotated[Path | None, typer.Option(help="folder of the pictures; default NAME-pictures beside it")] = None,
    pipeline: Annotated[Path | None, typer.Option(help="YAML file that changes the steps (docs/isp.md)")] = None,
    no_denoise: Annotated[bool, typer.Option("--no-denoise", help="leave noise and row offsets as they are")] = False,
    calibration: Annotated[
        Path | None, typer.Option(help="calibration.yaml of a calibrated sensor, for its maps")
    ] = None,
    overwrite: Overwrite = False,
    json_: Json = False,
    quiet: Quiet = False,
    help_all: HelpAll = False,
) -> None:
    """Develop the RAW frames of a recording into pictures."""
    from hesim_render.isp import DENOISED_PICTURE, develop_recording, load_pipeline
    from hesim_render.isp.develop import MARKER

    steps = DENOISED_PICTURE if pipeline is None else load_pipeline(pipeline)
    if no_denoise:
        steps = steps.without("denoise")
    console = Console(json_, quiet)
    with console.progress(f"developing {recording}") as progress:
        folder = develop_recording(recording, out, steps, progress, overwrite, calibration)
    text = f"pictures in {folder}"
    noise = WholeFile(folder / MARKER).json()["noise"]
    if noise is not None and noise["maps"] == "unknown":
        text += "\nthe maps of the sensor's calibration are not in a recording: --calibration FILE takes them out"
    console.result(text, {"pictures": folder, "noise": noise})


def view(
    recording: Annotated[Path, typer.Argument(help="folder of a recording")],
    rrd: Annotated[
        Path | None, typer.Option(help="write a file for the viewer rerun, and do not open it; for headless machines")
    ] = None,
    viewer: Annotated[
        bool | None,
        typer.Option("--viewer/--no-viewer", help="open rerun; default where it is installed and there is a display"),
    ] = None,
    overwrite: Overwrite = False,
    json_: Json = False,
    quiet: Quiet = False,
    help_all: HelpAll = False,
) -> None:
    """Show a recording: summary, previews, page, rerun.

    Previews and recording.html are written into its folder; rerun opens where it is installed.
    """
    from hesim_render.recording import rerun_view
    from hesim_render.recording.page import write_page
    from hesim_render.recording.recording import Recording
    from hesim_render.recording.showcase import write_previews

    if rrd is not None and viewer:
        raise ConflictError("--rrd", str(rrd), "give --rrd or --viewer, not both")
    if rrd is not None:
        free_place(rrd, overwrite, (".rrd",))
    console, loaded = Console(json_, quiet), Recording.load(recording)
    assert loaded.path is not None
    with output_errors(loaded.path):
        write_previews(loaded, loaded.path)
        page = write_page(loaded, loaded.path)
    more = f"\n  page: {page}"
    with console.progress(f"viewing {recording}") as progress:
        if rrd is not None:
            with replacing(rrd) as unfinished:
                rerun_view.write_rrd(loaded, unfinished, progress)
            more += f"\n  for rerun: {rrd}"
        elif viewer or (viewer is None and rerun_view.can_show()):
            rerun_view.show(loaded, progress)
    # a recording that misses its quality is shown all the same, with the line that says so
    console.result(summary(loaded) + more, {**recording_facts(loaded), "page": page, "rrd": rrd})
