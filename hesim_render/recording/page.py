"""A recording as a web page: ``recording.html`` beside its files, and short tables for notebooks.

Plots of a recording: its pictures, events over time, and the distribution of RAW values.
"""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hesim_render.core.drawing import COLOURS, new_figure, report_style, svg
from hesim_render.core.guard import printable
from hesim_render.core.html import filled, inline_picture, table, tick_text
from hesim_render.core.output import write_whole
from hesim_render.core.units import US_PER_S
from hesim_render.core.yaml_file import yaml_text
from hesim_render.events import event_rate
from hesim_render.recording.outline import parameters, scene_name
from hesim_render.recording.quality import render_lines
from hesim_render.recording.recorded import Recorded
from hesim_render.recording.showcase import contact_sheet, middle_views

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Intervals of the curve of event rates.
_INTERVALS = 200
_PANEL_PX = (460, 320)
_TINTS = {"red": "#d62728", "green": "#2ca02c", "blue": "#1f77b4"}


def figure_of(recording: Recorded) -> "Figure":
    """`Recording.plot`."""
    draws: list[Callable[[Recorded, Axes], None]] = []
    pictures = middle_views(recording)
    if min(recording.event_shape) > 0:
        draws.append(draw_rates)
    if len(recording.frames):
        draws.append(draw_histogram)
    number = max(1, len(pictures) + len(draws))
    columns = min(2, number)
    rows = -(-number // columns)
    with report_style():
        figure = new_figure((columns * _PANEL_PX[0], rows * _PANEL_PX[1]))
        every = list(np.atleast_1d(figure.subplots(rows, columns)).ravel())
        for panel in pictures:
            axes = every.pop(0)
            axes.imshow(panel.picture)
            axes.set_axis_off()
            axes.set_title(panel.caption, fontsize=9)
        for draw in draws:
            draw(recording, every.pop(0))
        for axes in every:
            axes.set_axis_off()
        figure.suptitle(repr(recording)[1:-1], fontsize=10)
    return figure


def draw_rates(recording: Recorded, axes: "Axes") -> None:
    """ON and OFF events per second over the recording; from disk, one interval at a time is read."""
    time = recording.manifest["time"]
    evs = recording.manifest["sensor"]["spec"].get("evs") or {}
    tick_us = evs.get("tick_us") or 1  # whole ticks: otherwise intervals with one more would stand out
    step_us = tick_us * max(1, -(-(time["end_us"] - time["begin_us"]) // (_INTERVALS * tick_us)))
    # a time stamp is the end of a window: an event at the end belongs to what is before
    edges = np.append(np.arange(time["begin_us"] + 1, time["end_us"], step_us), time["end_us"] + 1)
    rates = [
        event_rate(recording.event_slice(int(a), int(b)), float(b - a), float(a), float(b))
        for a, b in zip(edges[:-1], edges[1:], strict=True)
    ]
    on, off = (np.array([getattr(rate, name)[0] for rate in rates]) for name in ("on_per_s", "off_per_s"))
    edges_s = (edges - time["begin_us"]) / US_PER_S
    axes.stairs(on, edges_s, color=COLOURS[1], label="ON")
    axes.stairs(off, edges_s, color=COLOURS[0], label="OFF")
    begin = f" after {time['begin_us'] / US_PER_S} s" if time["begin_us"] else ""
    axes.set(title="Events", xlabel=f"time, s{begin}", ylabel="events per s, all pixels")
    axes.set_ylim(bottom=0)
    axes.legend(frameon=False)


def draw_histogram(recording: Recorded, axes: "Axes") -> None:
    """RAW values of the middle frame, of each filter."""
    frame, mosaic = recording.frames[len(recording.frames) // 2], recording.mosaic
    channel = mosaic.tiled(mosaic.tile_channel, frame.raw.shape)
    largest = 2**mosaic.bit_depth - 1
    values = frame.raw[frame.valid]
    low, high = (float(v) for v in np.quantile(values, [0.0, 1.0])) if values.size else (0.0, float(largest))
    step = max(1.0, np.ceil((high - low + 1) / 120))
    edges = low - 0.5 + step * np.arange(np.ceil((high - low + 1) / step) + 1)
    for number, name in enumerate(mosaic.channels):
        counts, _ = np.histogram(frame.raw[frame.valid & (channel == number)], edges)
        axes.stairs(counts, edges, color=_TINTS.get(str(name), COLOURS[number % len(COLOURS)]),
                    label=str(name))  # fmt: skip
    axes.axvline(mosaic.black_level_dn, color=COLOURS[6], linestyle="--", linewidth=1, label="black level")
    axes.set(title=f"RAW values of frame {frame.index}", xlabel="DN", ylabel="pixels", yscale="symlog")
    axes.yaxis.set_major_formatter(tick_text)
    axes.legend(frameon=False)


PAGE = "recording.html"
#: Longest lists of numbers that the page shows in full.
_LONGEST_LIST = 24
_THUMBNAIL_PX = 480


def write_page(recording: Recorded, folder: Path) -> Path:
    """Write ``recording.html``: parameters, pictures (those of the folder) and plots. Returns its path.

    Parameters
    ----------
    recording : the recording.
    folder : where its files and previews are.
    """
    name = f"{scene_name(recording)} seen by {recording.manifest['sensor']['name']}"
    pictures = [file for file in ("preview.gif", "preview.png") if (folder / file).is_file()]
    with report_style():
        plots = []
        for draw, wanted in ((draw_rates, min(recording.event_shape) > 0), (draw_histogram, len(recording.frames) > 0)):
            if wanted:
                figure = new_figure((520, 320))
                draw(recording, figure.subplots())
                plots.append(svg(figure))
    manifest = recording.manifest
    specifications = [
        (title, _as_yaml(_short(entry.get("spec", entry))))
        for key, title in (("scene", "Scene"), ("sensor", "Sensor"))
        if (entry := manifest.get(key))
    ]
    page = filled(
        "recording/page.html", title=name, parameters=parameters(recording), pictures=pictures, plots=plots,
        **_render(manifest["settings"].get("render")),
        details=[*specifications, ("Versions", _as_yaml(manifest.get("software", {})))],
    )  # fmt: skip
    target = folder / PAGE
    # names in a recording from elsewhere may hold anything
    write_whole(target, "\n".join(map(printable, page.split("\n"))))
    return target


def html_summary(recording: Recorded) -> str:
    """`Recording._repr_html_`."""
    sheet = contact_sheet(recording).convert("RGB")
    sheet.thumbnail((2 * _THUMBNAIL_PX, 2 * _THUMBNAIL_PX))
    return table(("", ""), parameters(recording)) + inline_picture(np.asarray(sheet), "contact sheet")


def _render(render: dict[str, Any] | None) -> dict[str, object]:
    """The stated error of a render, over the sensor's noise, and what its audit found, in the words of the commands."""
    errors = [
        (name, *(f"{error[key]:.2g}" for key in ("rms", "p95", "p99")))
        for name, error in ((render or {}).get("error_noise") or {}).items()
        if error is not None
    ]
    verdicts = [line for line in render_lines(render) if not line.startswith("render,")] if errors else []
    return {"errors": errors, "audit": verdicts or ["No audit: nothing was rendered again to compare with."]}


def _short(node: Any) -> Any:
    """The content without empty values and with long lists cut."""
    if isinstance(node, dict):
        return {key: _short(value) for key, value in node.items() if value not in (None, [], {}, "")}
    if isinstance(node, list) and len(node) > _LONGEST_LIST:
        return [*map(_short, node[: _LONGEST_LIST // 2]), f"… {len(node) - _LONGEST_LIST // 2} more"]
    return [_short(value) for value in node] if isinstance(node, list) else node


def _as_yaml(node: Any) -> str:
    return yaml_text(node, is_sorted=True) if node else ""
