"""Files of other programs: ``export`` and ``import``."""

from pathlib import Path
from typing import Annotated

import typer

from hesim_render.cli.console import Console, Json, Quiet
from hesim_render.cli.options import SENSOR_HELP, HelpAll, Overwrite, Region, check_output, cropped, names_of
from hesim_render.cli.simulate import show_recording
from hesim_render.cli.terminal import parse_size
from hesim_render.core.errors import ConflictError
from hesim_render.core.progress import counted


def _complete_export(incomplete: str) -> list[str]:
    from hesim_render.recording.exports import every_format

    return [name for name in every_format() if name.startswith(incomplete)]


def _complete_import(incomplete: str) -> list[str]:
    from hesim_render.exchange.formats import READABLE

    return [name for name in READABLE if name.startswith(incomplete)]


def export(
    recording: Annotated[Path, typer.Argument(help="folder of a recording")],
    format: Annotated[
        str,
        typer.Option(help="of events, such as evt3 or dsec; frames, such as tiff; both, such as mcap; geometric truth, "
                     "such as exr or coco. An unknown name prints them all (docs/formats.md)",
                     autocompletion=_complete_export),
    ],
    out: Annotated[Path, typer.Option(help="file of the events, or folder of the frames or of the truth")],
    every_us: Annotated[
        int | None, typer.Option(help="interval of flow (default 100000), poses (1000) or boxes (50000), µs")
    ] = None,
    scene: Annotated[
        str | None, typer.Option(help="for truth, the scene file, if it needs files that the recording does not hold")
    ] = None,
    overwrite: Overwrite = False,
    json_: Json = False,
    quiet: Quiet = False,
    help_all: HelpAll = False,
) -> None:  # fmt: skip
    """Write a recording in the format of another program.

    Its events, its RAW frames or its geometric truth.
    """
    from hesim_render.recording.exports import WHOLE_FORMATS, check_name
    from hesim_render.recording.recording import Recording
    from hesim_render.recording.truth_export import FORMATS, export_truth

    loaded, console = Recording.load(recording), Console(json_, quiet)
    if format in FORMATS:
        check_name(format, out)
        if scene is not None:
            from hesim_render.sources.scene import load_scene

            loaded.truth = loaded.truth_with(load_scene(scene))
        written = export_truth(loaded, format, out, every_us=every_us, overwrite=overwrite)
        console.result(f"{format} in {written}", {"format": format, "written": written})
        return
    for name, value in (("--every-us", every_us), ("--scene", scene)):
        if value is not None:
            raise ConflictError(name, value, f"only formats of geometric truth take it: {', '.join(FORMATS)}")
    written = loaded.export(format, out, overwrite)
    counts = loaded.manifest["counts"]
    if format in WHOLE_FORMATS:
        facts = {"format": format, "written": written, "events": counts["events"], "frames": counts["frames"]}
        console.result(
            f"{format} of {counted(counts['frames'], 'frame')} and {counted(counts['events'], 'event')} in {written}",
            facts,
        )
        return
    noun = "frame" if written.is_dir() else "event"
    count = counts[f"{noun}s"]
    facts = {"format": format, "written": written, f"{noun}s": count}
    console.result(f"{counted(count, noun)} in {written}", facts)


def import_(
    sources: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...",
            help="an event file (EVT2, EVT3 RAW, DAT, AEDAT4, HDF5 of DSEC or Prophesee, .npz, MCAP, text); with "
            "--sensor also frames",
        ),
    ],
    out: Annotated[Path, typer.Option(help="HDF5 file to write; with --sensor the folder of the recording")],
    format: Annotated[
        str | None,
        typer.Option(
            help="of the event file, such as evt3; default: as the file states", autocompletion=_complete_import
        ),
    ] = None,
    size: Annotated[str | None, typer.Option(help="WIDTHxHEIGHT of the sensor, if the file does not state it")] = None,
    sensor: Annotated[
        str | None,
        typer.Option(help=f"make a recording of this sensor: {SENSOR_HELP}", autocompletion=names_of("sensors")),
    ] = None,
    roi: Region = None,
    trigger_channel: Annotated[
        int | None,
        typer.Option(min=0, help="line of the event file whose triggers are the exposures of the frames"),
    ] = None,
    from_zero: Annotated[
        bool,
        typer.Option("--from-zero", help="with --sensor: count times from its begin, not by the camera's clock"),
    ] = False,
    overwrite: Overwrite = False,
    json_: Json = False,
    quiet: Quiet = False,
    help_all: HelpAll = False,
) -> None:
    """Read files of another program, or of a real sensor.

    Events are written in the layout of events.h5; with --sensor, a capture of a real sensor becomes a recording.
    """
    from hesim_render.exchange import is_event_file, open_events

    console = Console(json_, quiet)
    if sensor is None:
        from hesim_render.recording.exports import import_events

        if len(sources) > 1 or roi is not None or trigger_channel is not None or from_zero:
            problem = "more than one file, --roi, --trigger-channel or --from-zero needs --sensor"
            raise ConflictError("FILE", len(sources), problem)
        shape = None if size is None else parse_size(size)
        written = import_events(sources[0], out, format=format, shape=shape, overwrite=overwrite)
        stream = open_events(written)
        on = count = 0
        for block in stream:
            count, on = count + block.size, on + int((block["polarity"] > 0).sum())
        rows, cols = stream.shape
        console.result(
            f"{counted(count, 'event')} ({on} ON, {count - on} OFF) of {cols}x{rows} px in {written}",
            {"written": written, "events": count, "events_on": on, "events_off": count - on,
             "event_grid": {"width": cols, "height": rows}},
        )  # fmt: skip
        return
    if size is not None:
        raise ConflictError("--size", size, "with --sensor, the size is that of the sensor; --roi takes a part of it")
    events = [file for file in sources if is_event_file(file)]
    frames = [file for file in sources if file not in events]
    if len(events) > 1:
        raise ConflictError("FILE", str(events[1]), f"{events[1]} is a second event file; one is taken")
    check_output(out, overwrite)
    import hesim_render as hr
    from hesim_render.recording.imports import import_recording

    loaded = cropped(hr.load_sensor(sensor), roi)
    made = import_recording(
        out, loaded, events=events[0] if events else None, frames=frames, format=format,
        trigger_channel=trigger_channel, from_zero=from_zero, overwrite=overwrite,
    )  # fmt: skip
    show_recording(console, made)
