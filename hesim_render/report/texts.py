"""Tables of the report, as texts: the same for the page and the PDF."""

from typing import Any, NamedTuple

from hesim_render.report.definitions import EVENTS, FRAMES, Definition
from hesim_render.report.emva import FrameFigures
from hesim_render.report.estimates import figure
from hesim_render.report.figures import POLARITIES, EventFigures
from hesim_render.report.limits import DynamicRange

#: Figures that have a row for each light.
_AGAINST_LIGHT = ("latency", "jitter", "background")

#: Light of figures that follow from recordings of several.
_LIGHTS = {"dead_time": "all recordings", "readout_limit": "all recordings", "hot": "steady, all",
           "doubling": "steady, all", "dead": "largest steps"}  # fmt: skip


class ReportTable(NamedTuple):
    """A table.

    Parameters
    ----------
    title : of the section that begins with it.
    head, rows : texts.
    widths : relative widths of the columns, for the PDF.
    """

    title: str
    head: tuple[str, ...]
    rows: list[tuple[str, ...]]
    widths: tuple[float, ...]


def _value(entry: dict[str, Any]) -> tuple[str, str, str]:
    """Value, interval, and unit or the reason why there is none."""
    if entry["value"] is None:
        return "–", "", entry["reason"]
    if "upper_limit" in entry:
        return f"< {figure(entry['upper_limit'], 3)}", "", _joined(entry.get("unit", ""), entry.get("note", ""))
    between = entry.get("interval_95")
    interval = f"{figure(between[0])} to {figure(between[1])}" if between else ""
    return figure(entry["value"]), interval, _joined(entry.get("unit", ""), entry.get("note", ""))


def _joined(unit: str, note: str) -> str:
    return "; ".join(text for text in (unit, note) if text)


def _light(lux: float | None, contrast: float | None, celsius: float | None) -> str:
    texts = [
        "" if lux is None else f"{lux:g} lx",
        "" if contrast is None else f"steps of {100 * contrast:.3g} %",
        "" if celsius is None else f"{celsius:g} °C",
    ]
    return ", ".join(text for text in texts if text)


def event_tables(measured: EventFigures) -> list[ReportTable]:
    """Figures of event pixels, those against light, and definitions."""
    rows: list[tuple[str, ...]] = [
        (
            " ".join(text for text in (EVENTS[one.key].title, one.name) if text), *_value(one.value),
            _light(one.lux, one.contrast, one.temperature_c) or _LIGHTS.get(one.key, ""), str(one.pixels),
        )
        for one in measured.entries
        if one.key not in _AGAINST_LIGHT or (one.value["value"] is None and one.lux is None)
    ]  # fmt: skip
    figures = ReportTable(
        "Event pixels", ("figure", "value", "95 % interval", "unit, or why not", "light", "pixels"), rows,
        (0.25, 0.1, 0.17, 0.25, 0.15, 0.08),
    )  # fmt: skip
    return [figures, *_against_light(measured), _definitions("What the figures of event pixels are", EVENTS)]


def _against_light(measured: EventFigures) -> list[ReportTable]:
    """One row a light (and temperature), with the interval of each value."""
    places = sorted(
        {(one.temperature_c, one.lux) for one in measured.latencies[0]}
        | {(one.temperature_c, one.lux) for one in measured.backgrounds},
        key=lambda place: (place[0] or 0.0, place[1]),
    )
    if not places:
        return []
    several = len({celsius for celsius, _ in places}) > 1
    answers = [{(one.temperature_c, one.lux): one for one in every} for every in measured.latencies]
    steady = {(one.temperature_c, one.lux): one for one in measured.backgrounds}
    rows = []
    for place in places:
        cells = [f"{place[1]:g}" + (f", {place[0]:g} °C" if several and place[0] is not None else "")]
        for k in (0, 1):
            cells.append(_cell(steady[place].rates[k]) if place in steady else "")
        for k in (0, 1):
            one = answers[k].get(place)
            cells += ["", ""] if one is None else [_cell(one.latency), _cell(one.jitter)]
        cells += [_share(one, place[1]) for one in measured.ranges]
        rows.append(tuple(cells))
    contrast = f"{100 * measured.latencies[0][0].contrast:.3g} %" if measured.latencies[0] else ""
    head = (
        "lx", *(f"background {name}, Hz" for name in POLARITIES),
        *(f"{what} {name}, µs" for name in POLARITIES for what in ("latency", "jitter")),
        *(f"2θ {name} found, %" for name in POLARITIES),
    )  # fmt: skip
    title = "Against light" + (f" (latency of steps of {contrast})" if contrast else "")
    return [ReportTable(title, head, rows, (0.08, *(8 * (0.115,))))]


def _cell(entry: dict[str, Any]) -> str:
    if entry["value"] is None or "upper_limit" in entry:
        return _value(entry)[0]
    between = entry.get("interval_95")
    interval = f" ({figure(between[0], 3)} to {figure(between[1], 3)})" if between else ""
    return figure(entry["value"], 3) + interval


def _share(one: DynamicRange | None, lux: float) -> str:
    if one is None or lux not in one.lux:
        return ""
    k = int((one.lux == lux).argmax())
    return f"{100 * one.share[k]:.3g} ± {196 * one.error[k]:.2g}"


def frame_tables(measured: FrameFigures) -> list[ReportTable]:
    """Figures of frames, and definitions."""
    lights = measured.lights
    rows: list[tuple[str, ...]] = [
        (FRAMES[key].title, *_value(measured.entries[key]), lights[key], str(measured.pixels))
        for key in FRAMES
        if key in measured.entries
    ]
    figures = ReportTable(
        "Frames, by EMVA 1288 (Release 4.0 linear)",
        ("figure", "value", "95 % interval", "unit, or why not", "light", "pixels"), rows,
        (0.23, 0.1, 0.17, 0.21, 0.2, 0.09),
    )  # fmt: skip
    return [figures, _definitions("What the figures of frames are", FRAMES)]


def _definitions(title: str, every: dict[str, Definition]) -> ReportTable:
    rows: list[tuple[str, ...]] = [(one.title, one.sentence, one.formula, one.method) for one in every.values()]
    return ReportTable(title, ("figure", "what it is", "formula", "method"), rows, (0.15, 0.36, 0.25, 0.24))
