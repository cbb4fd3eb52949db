"""A recording as a web page: ``recording.html`` beside its files, and short tables for notebooks."""

from __future__ import annotations

import io
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from ruamel.yaml import YAML

from hesim_render.core.drawing import new_figure, report_style, svg
from hesim_render.core.guard import printable
from hesim_render.core.html import PAGE_STYLE, inline_picture, table
from hesim_render.core.output import replacing
from hesim_render.recording.outline import parameters, scene_name
from hesim_render.recording.plots import draw_histogram, draw_rates
from hesim_render.recording.quality import render_lines
from hesim_render.recording.showcase import contact_sheet

if TYPE_CHECKING:
    from hesim_render.recording.recording import Recording

PAGE = "recording.html"
#: Longest lists of numbers that the page shows in full.
_LONGEST_LIST = 24
_THUMBNAIL_PX = 480
#: The page takes the whole window; its parts stand side by side where there is room, and fill their places.
_STYLE = """
body{max-width:none;margin:1.5rem 2.5vw}h2{margin-top:.6rem}
.parts{display:grid;grid-template-columns:repeat(auto-fit,minmax(520px,1fr));gap:18px;align-items:start}
@media(max-width:560px){.parts{display:block}}
.parts img,.parts svg{width:100%;height:auto}.pixels{image-rendering:pixelated}
"""


def write_page(recording: Recording, folder: Path) -> Path:
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
                plots.append(f"<figure>{svg(figure)}</figure>")
    parts = [
        f"<h1>{escape(name)}</h1>",
        f'<div class="parts">{table(("", ""), parameters(recording))}',
        f"<div>{''.join(_render(recording.manifest['settings'].get('render')))}</div></div>",
        f'<div class="parts">{"".join(map(_picture, pictures))}{"".join(plots)}</div>',
        *(
            _specification(title, recording.manifest.get(key))
            for key, title in (("scene", "Scene"), ("sensor", "Sensor"))
        ),
        _details("Versions", _as_yaml(recording.manifest.get("software", {}))),
    ]
    target = folder / PAGE
    page = (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">'
        f"<title>{escape(name)}</title><style>{PAGE_STYLE}{_STYLE}</style></head><body>{''.join(parts)}</body></html>\n"
    )
    with replacing(target) as unfinished:
        # names in a recording from elsewhere may hold anything
        unfinished.write_text("\n".join(map(printable, page.split("\n"))), encoding="utf-8")
    return target


def html_summary(recording: Recording) -> str:
    """`Recording._repr_html_`."""
    sheet = contact_sheet(recording).convert("RGB")
    sheet.thumbnail((2 * _THUMBNAIL_PX, 2 * _THUMBNAIL_PX))
    return f"{table(('', ''), parameters(recording))}{inline_picture(np.asarray(sheet), 'contact sheet')}"


def _picture(file: str) -> str:
    """A picture as wide as its place; the pixels of an animation stay squares where it is magnified."""
    style = ' class="pixels"' if file.endswith(".gif") else ""
    return f'<figure><a href="{file}"><img alt="{file}" src="{file}"{style}></a></figure>'


def _render(render: dict[str, Any] | None) -> list[str]:
    """The stated error of a render, over the sensor's noise, and what its audit found, in the words of the commands."""
    rows = [
        (name, *(f"{error[key]:.2g}" for key in ("rms", "p95", "p99")))
        for name, error in ((render or {}).get("error_noise") or {}).items()
        if error is not None
    ]
    head = ("", "rms", "95 % below", "99 % below")
    if not rows:
        return []
    verdicts = [line for line in render_lines(render) if not line.startswith("render,")]
    verdicts = verdicts or ["No audit: nothing was rendered again to compare with."]
    return [
        "<h2>Error of the render, over the sensor's noise</h2>",
        table(head, rows),
        *(f"<p{' class=findings' if line.startswith('NOT MET') else ''}>{escape(line)}</p>" for line in verdicts),
    ]


def _specification(title: str, entry: dict[str, Any] | None) -> str:
    return _details(title, _as_yaml(_short(entry.get("spec", entry)))) if entry else ""


def _details(title: str, text: str) -> str:
    return f"<details><summary>{escape(title)}</summary><pre>{escape(text)}</pre></details>" if text.strip() else ""


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
