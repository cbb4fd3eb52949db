"""Parts of HTML pages: style, tables, numbers as text, pictures inside a page."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

#: Style of all pages.
PAGE_STYLE = """
body{font:15px/1.5 system-ui,sans-serif;color:#1b1b1b;max-width:1320px;margin:2rem auto;padding:0 1rem}
h1{font-size:1.6rem}h2{font-size:1.25rem;margin-top:2.2rem;border-bottom:1px solid #ccc}
.row{display:flex;flex-wrap:wrap;gap:18px;align-items:flex-start}figure{margin:0}
figcaption{font-size:.85rem;color:#555;max-width:52rem}
table{border-collapse:collapse;font-size:.85rem;margin:.6rem 0}
td,th{padding:.15rem .6rem;border-bottom:1px solid #ddd;text-align:left;font-variant-numeric:tabular-nums}
svg{stroke-linejoin:round;stroke-linecap:butt}
.findings{border-left:4px solid #d55e00;background:#fdf3ec;padding:.3rem .9rem;margin:.8rem 0}
"""


def number(value: float) -> str:
    """A number with few digits."""
    if value == 0:
        return "0"
    if 1e3 <= abs(value) < 1e5:
        return f"{value:.0f}"
    return f"{value:.3g}" if 1e-3 <= abs(value) < 1e5 else f"{value:.1e}".replace("e-0", "e-").replace("e+0", "e")


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """An HTML table; text is escaped."""
    header = "".join(f"<th>{escape(h)}</th>" for h in head)
    body = "".join("<tr>" + "".join(f"<td>{escape(c)}</td>" for c in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{header}</tr></thead><tbody>{body}</tbody></table>"


def tick_text(value: float, _: float) -> str:
    """Text of a number on an axis: the formatter of logarithmic axes, whose own writes mathematics."""
    return number(value).replace(".0e", "e")


def inline_picture(values: NDArray[np.uint8], alt: str) -> str:
    """A picture [row, col] or [row, col, 3] as an HTML element that needs no other file."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(values).save(stream, format="PNG")
    data = base64.b64encode(stream.getvalue()).decode("ascii")
    return f'<img alt="{escape(alt)}" src="data:image/png;base64,{data}">'


def row_of(*figures: str) -> str:
    """Drawings side by side, as many as fit in a row; empty ones are left out."""
    return '<div class="row">' + "".join(f"<figure>{f}</figure>" for f in figures if f) + "</div>"
