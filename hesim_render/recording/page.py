"""A recording as a web page: ``recording.html`` beside its files, and short tables for notebooks."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from ruamel.yaml import YAML

from hesim_render.core.drawing import new_figure, report_style, svg
from hesim_render.core.guard import printable
from hesim_render.core.html import filled, inline_picture, table
from hesim_render.core.output import replacing
from hesim_render.recording.outline import parameters, scene_name
from hesim_render.recording.plots import draw_histogram, draw_rates
from hesim_render.recording.quality import render_lines
from hesim_render.recording.showcase import contact_sheet

if TYPE_CHECKING:
    from hesim_render.recording.recorded import Recorded

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
    with replacing(target) as unfinished:
        # names in a recording from elsewhere may hold anything
        unfinished.write_text("\n".join(map(printable, page.split("\n"))), encoding="utf-8")
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
    stream, yaml = io.StringIO(), YAML(typ="safe", pure=True)
    yaml.default_flow_style, yaml.allow_unicode, yaml.width = None, True, 110
    yaml.dump(node, stream)
    return "" if not node else stream.getvalue()
