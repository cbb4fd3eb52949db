"""Measuring on recordings: ``measure``, ``compare`` for two recordings of events, and the test report (``report``)."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from hesim_render.cli.console import Console, Json, Quiet
from hesim_render.cli.options import HelpAll, Overwrite
from hesim_render.cli.terminal import parse_size, say
from hesim_render.core.errors import RangeError
from hesim_render.core.region import parse_roi


class Quantity(StrEnum):
    """What can be measured."""

    mtf = "mtf"


class SignalKind(StrEnum):
    """Values to measure on."""

    raw = "raw"
    electrons = "electrons"


def measure(
    quantity: Annotated[Quantity, typer.Argument(help="mtf (spatial frequency response on a slanted edge)")],
    recording: Annotated[Path, typer.Argument(help="folder of a recording")],
    roi: Annotated[
        str | None, typer.Option(help="part of the frame with one edge: WIDTHxHEIGHT+X+Y, px; default all")
    ] = None,
    frame: Annotated[int, typer.Option(help="number of the frame")] = 0,
    signal: Annotated[
        SignalKind, typer.Option(help="RAW values, or the noise-free electrons of the truth")
    ] = SignalKind.raw,
    filter_: Annotated[
        str | None, typer.Option("--filter", help="of a mosaic: measure on pixels of this filter")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="CSV file of frequency and response")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace an existing file")] = False,
) -> None:
    """Measure the MTF of a recording on a slanted edge.

    MTF is the spatial frequency response.
    """
    from hesim_render.core.output import free_place, replacing
    from hesim_render.measure import measure_mtf
    from hesim_render.recording.recording import Recording

    region = None if roi is None else _region(roi)
    if out is not None:
        free_place(out, overwrite, (".csv",))
    result = measure_mtf(Recording.load(recording), frame, region, signal=signal.value, filter_name=filter_)
    if signal is SignalKind.raw:
        say("of RAW values, noise included")
    else:
        say("of the noise-free electrons of the truth, which no camera gives")
    if result.clipped:
        say("CLIPPED: RAW values of this part are saturated, and the electrons are not; use less light or exposure")
    for frequency in (0.125, 0.25, 0.5):
        value = result.mtf[abs(result.frequency_cy_per_px - frequency).argmin()]
        say(f"MTF at {frequency:g} cycles per pixel: {value:.3f}")
    say(f"MTF50: {result.frequency_at(0.5):.3f} cycles per pixel; edge {result.angle_deg:.2f}° from the vertical")
    if out is not None:
        rows = zip(result.frequency_cy_per_px, result.mtf, strict=True)
        table = "".join(f"{frequency:.6g},{value:.6g}\n" for frequency, value in rows)
        with replacing(out) as unfinished:
            unfinished.write_text(f"frequency_cy_per_px,mtf\n{table}", encoding="utf-8")
        say(f"in {out}")


def _region(roi: str) -> tuple[int, int, int, int]:
    width, height, x, y = parse_roi(roi)
    if x is None or y is None:
        raise RangeError("--roi", roi, "WIDTHxHEIGHT+X+Y, with the first column and row of the part")
    return x, y, width, height


def compare(
    first: Annotated[
        Path,
        typer.Argument(metavar="RECORDING", help="event file, such as that of a real camera, or folder of a recording"),
    ],
    second: Annotated[Path, typer.Argument(metavar="RECORDING", help="another of a similar scene")],
    size: Annotated[str | None, typer.Option(help="WIDTHxHEIGHT of the sensor, if files do not state it")] = None,
    json_: Json = False,
    quiet: Quiet = False,
    help_all: HelpAll = False,
) -> None:
    """Compare the events of two recordings of similar scenes.

    Rates, intervals, correlations, polarity, hot pixels and bursts, each as a distance with an interval.
    """
    from hesim_render.exchange import open_events
    from hesim_render.measure.event_distance import event_distances
    from hesim_render.measure.event_statistics import PARTS, event_statistics, of_equal_time

    shape = None if size is None else parse_size(size)
    console = Console(json_, quiet)
    with console.progress("compare") as move:
        streams = of_equal_time(*(open_events(file, shape=shape, keep_stated=True) for file in (first, second)))
        statistics = []
        for k, (file, stream) in enumerate(zip((first, second), streams, strict=True)):
            move(0.4 * k, 1.0, f"read {file.name}")
            statistics.append(event_statistics(stream))
        move(0.8, 1.0, "compare")
        result = event_distances(statistics[0], statistics[1])
    lines = [f"{'':<11} {'distance':>9} {'95 % interval':>19} {'within first':>12}  {'first':>9} {'second':>9}"]
    for one in result:
        low, high = one.interval_95
        numbers = "" if one.first is None else f"{one.first:>9.4g} {one.second:>9.4g}"
        mark = "differs" if one.differs else ""
        between = f"{low:.4g} to {high:.4g}"
        lines.append(
            f"{one.name:<11} {one.value:>9.4g} {between:>19} {one.within:>12.4g}  {numbers:<19} {mark}".rstrip()
        )
    sizes = [f"{one.shape[1]}x{one.shape[0]}" for one in statistics]
    if sizes[0] != sizes[1]:
        lines.append(f"of {sizes[0]} and {sizes[1]} px, compared pixel by pixel: one should show what the other does")
    seconds = PARTS * statistics[0].seconds
    lines.append(f"over the first {seconds:.4g} s of each, which is all of the shorter one")
    lines += [f"{one.name}: {one.definition}" for one in result]
    console.result("\n".join(lines), {"seconds": seconds, "distances": [one.described() for one in result]})


def report(
    captures: Annotated[
        list[str],
        typer.Argument(
            metavar="SENSOR|CAPTURES...",
            help="a sensor, whose captures are simulated; or folders of captures: of event pixels (with bench.yaml), "
            "of frames (EMVA 1288), or one of each",
        ),
    ],
    out: Annotated[Path, typer.Option(help="folder to write: report.html, report.pdf, report.json")],
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT of the simulated pixels of each kind")] = "64x64",
    seed: Annotated[int, typer.Option(help="of the simulated noise", hidden=True)] = 7,
    overwrite: Overwrite = False,
    json_: Json = False,
    quiet: Quiet = False,
    help_all: HelpAll = False,
) -> None:
    """Write the test report of a sensor, real or simulated.

    EMVA 1288 figures of frames; thresholds, latency, background, dynamic range, bandwidth and limits of event pixels.
    """
    from hesim_render.report import make_report
    from hesim_render.report.texts import event_tables, frame_tables

    shape = parse_size(size)
    console = Console(json_, quiet)
    with console.progress("report") as move:
        result = make_report(
            captures, out, size=shape, seed=seed, overwrite=overwrite,
            progress=move.part,
        )  # fmt: skip
    tables = [] if result.events is None else event_tables(result.events)[:1]
    tables += [] if result.frames is None else frame_tables(result.frames)[:1]
    rows = [row for table in tables for row in table.rows]
    widest = max(len(row[0]) for row in rows)
    lines = [f"{name:<{widest}} {value:>10}  {between:<24} {unit}" for name, value, between, unit, *_ in rows]
    files = {kind: result.folder / f"report.{kind}" for kind in ("html", "pdf", "json")}
    lines.append(f"in {out}: {', '.join(file.name for file in files.values())}")
    console.result(
        "\n".join(line.rstrip() for line in lines), {"report": result.folder, "pages": result.pages, **files}
    )
