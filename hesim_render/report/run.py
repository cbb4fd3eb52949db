"""A test report of a sensor: HTML, PDF and JSON from captures, which are simulated where a sensor is given."""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hesim_render.calibrate.result import plain
from hesim_render.core.drawing import new_figure, report_style, svg
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.html import filled
from hesim_render.core.output import OutputFolder, output_errors
from hesim_render.recording.pair_set import is_pair_set
from hesim_render.report.bench import BENCH_NAME, EventBench
from hesim_render.report.definitions import EVENTS, FRAMES
from hesim_render.report.drawings import Draw, event_drawings, frame_drawings
from hesim_render.report.emva import FrameFigures, frame_figures
from hesim_render.report.figures import EventFigures, event_figures
from hesim_render.report.pdf import Document
from hesim_render.report.texts import ReportTable, event_tables, frame_tables

RESULT_NAME = "report.json"
#: Folders of simulated captures in the report's own.
EVENT_CAPTURES, FRAME_CAPTURES = "captures-events", "captures-frames"
_PANEL_PX = (410, 290)
Progress = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class Report:
    """A report.

    Parameters
    ----------
    folder : holds ``report.html``, ``report.pdf``, ``report.json`` and simulated captures.
    events, frames : the figures; None of a kind that was not captured.
    pages : of the PDF.
    """

    folder: Path
    events: EventFigures | None
    frames: FrameFigures | None
    pages: int


def make_report(
    captures: Sequence[str | Path],
    out: str | Path,
    *,
    size: tuple[int, int] = (64, 64),
    seed: int = 7,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Report:
    """Write the test report of a sensor.

    Parameters
    ----------
    captures : a sensor, by name or file, whose captures are simulated; or folders of captures: one with ``bench.yaml``
        (event pixels), one of EMVA 1288 captures (frames), or both.
    out : folder to write.
    size : rows and columns of the simulated region, px; whole tiles.
    seed : of the simulated noise.
    overwrite : replace an existing report.
    progress : called with a text that names the current work and the fraction done.

    Raises
    ------
    RangeError
        If a number or the kind of a folder is wrong.
    SpecError
        If captures cannot be used.
    OutputError
        If `out` exists or cannot be written.
    """
    stated = progress or (lambda what, part: None)
    if not captures:
        raise RangeError("captures", list(captures), "a sensor, or folders of captures")
    if not 0 <= seed < 2**63:
        raise RangeError("seed", seed, "0 to 2^63 - 1")
    folders = [Path(one) for one in captures]
    simulated = len(folders) == 1 and not folders[0].is_dir()
    if not simulated:
        bench_folder, frame_folder = _sorted(folders)
    with OutputFolder(out, RESULT_NAME, overwrite) as folder, output_errors(folder.target):
        if simulated:
            from hesim_render.report.simulate import simulate_captures

            bench_folder, frame_folder, name = simulate_captures(
                captures[0], folder.path / EVENT_CAPTURES, folder.path / FRAME_CAPTURES, size, seed,
                lambda what, part: stated(what, 0.7 * part),
            )  # fmt: skip
        begin = 0.7 if simulated else 0.0
        bench = None if bench_folder is None else EventBench(bench_folder)
        if not simulated:
            name = bench.spec.sensor if bench is not None else folders[0].resolve().name
            if bench is not None and bench.spec.frames is not None and frame_folder is None:
                frame_folder = bench.path(bench.spec.frames)
        events = None
        if bench is not None and bench.names:
            events = event_figures(bench, lambda what, part: stated(what, begin + (0.9 - begin) * part))
        stated("frames", 0.9)
        frames = None
        if frame_folder is not None:
            try:
                frames = frame_figures(frame_folder)
            except SpecError as error:
                if not simulated or events is None:
                    raise
                events.findings.append(f"frames: {str(error).replace(f'{frame_folder}', FRAME_CAPTURES)}")
        pages = _write(folder.path, name, events, frames)
    return Report(folder.target, events, frames, pages)


def _sorted(folders: Sequence[Path]) -> tuple[Path | None, Path | None]:
    """The folder with recordings of events, and that with frames."""
    outcome: dict[str, Path] = {}
    for folder in folders:
        if not folder.exists():
            raise SpecError("no such folder, and no sensor is to be given beside captures", file=folder)
        kind = "events" if (folder / BENCH_NAME).is_file() else "frames" if is_pair_set(folder) else ""
        if not kind:
            raise SpecError(
                f"holds neither {BENCH_NAME} (recordings of event pixels) nor captures of EMVA 1288 (frames)",
                file=folder,
            )
        if kind in outcome:
            raise SpecError(f"is a second folder of {kind}, beside {outcome[kind]}", file=folder)
        outcome[kind] = folder
    return outcome.get("events"), outcome.get("frames")


def _write(folder: Path, name: str, events: EventFigures | None, frames: FrameFigures | None) -> int:
    """All three files; returns the number of pages of the PDF."""
    sections: list[tuple[list[ReportTable], list[Draw]]] = []
    if events is not None:
        sections.append((event_tables(events), event_drawings(events)))
    if frames is not None:
        sections.append((frame_tables(frames), frame_drawings(frames)))
    findings = [*(events.findings if events is not None else []), *(frames.findings if frames is not None else [])]
    title, about = f"Test report: {name}", _about(events, frames)
    (folder / RESULT_NAME).write_text(_json(name, events, frames, findings), encoding="utf-8")
    with report_style():
        page = filled(
            "report/page.html", title=title, about=about, findings=findings,
            sections=[{"tables": tables, "drawings": [_panel(draw) for draw in draws]} for tables, draws in sections],
        )  # fmt: skip
        (folder / "report.html").write_text(page, encoding="utf-8")
        with (folder / "report.pdf").open("wb") as file:
            document = Document(file, title)
            document.text(title, 15.0, True)
            document.text(about)
            for text in findings:
                document.text(f"Note: {text}")
            for number, (tables, draws) in enumerate(sections):
                if number:
                    document.new_page()
                document.table(tables[0])
                document.drawings(draws)
                if len(sections) == 1 and events is None:
                    document.new_page()
                for table in tables[1:]:
                    document.table(table)
            document.close()
    return document.count


def _panel(draw: Draw) -> str:
    figure = new_figure(_PANEL_PX)
    draw(figure.subplots())
    return svg(figure)


def _about(events: EventFigures | None, frames: FrameFigures | None) -> str:
    texts = []
    if events is not None:
        rows, cols = events.bench.shape
        spec = events.bench.spec
        celsius = "" if spec.temperature_c is None else f", at {spec.temperature_c:g} °C"
        texts.append(f"Event pixels: {len(events.bench.names)} recordings of {cols}x{rows} px{celsius}.")
        if spec.notes:
            texts.append(f"Bench: {spec.notes}.")
    if frames is not None:
        rows, cols = frames.result.pairs.shape
        series = frames.result.pairs
        texts.append(
            f"Frames: {len(series.lit)} lit pairs and two series of {len(series.spatial_lit.files)} frames of "
            f"{cols}x{rows} px."
        )
    return " ".join([*texts, "Intervals hold the truth in 95 of 100 cases."])


def _json(name: str, events: EventFigures | None, frames: FrameFigures | None, findings: list[str]) -> str:
    """The result for programs."""
    whole: dict[str, Any] = {"sensor": name, "findings": findings, "events": None, "frames": None}
    if events is not None:
        whole["events"] = {
            "shape": list(events.bench.shape),
            "figures": [
                {"figure": one.key, "polarity": one.name or None, "lux": one.lux, "contrast": one.contrast,
                 "temperature_c": one.temperature_c, "pixels": one.pixels, **one.value}
                for one in events.entries
            ],
            "s_curves": [
                {"lux": curve.lux, "polarity": polarity, "size_ln": curve.size, "share": curve.share,
                 "standard_error": curve.error}
                for pair in events.curves for curve, polarity in zip(pair, ("ON", "OFF"), strict=True)
            ],
            "found": [
                {"polarity": polarity, "lux": one.lux, "share": one.share, "standard_error": one.error}
                for one, polarity in zip(events.ranges, ("ON", "OFF"), strict=True) if one is not None
            ],
            "definitions": {key: one._asdict() for key, one in EVENTS.items()},
        }  # fmt: skip
        if events.band is not None:
            band = asdict(events.band)
            whole["events"]["swing_of_half"] = {key: band[key] for key in ("lux", "hz", "swing")}
    if frames is not None:
        lights = frames.lights
        whole["frames"] = {
            "shape": list(frames.result.pairs.shape), "pixels": frames.pixels,
            "figures": {key: {**entry, "light": lights[key]} for key, entry in frames.entries.items()},
            "definitions": {key: one._asdict() for key, one in FRAMES.items()},
        }  # fmt: skip
    return json.dumps(plain(whole), indent=1, ensure_ascii=False) + "\n"
