"""Common parts of the sections of the calibration report: rows of figures, lines of tables, findings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

#: Style of an HTML report.
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


def findings(section: Mapping[str, Any]) -> str:
    """The findings of a section, one line each; empty for a calibration without checks."""
    if "findings" not in section:
        return ""
    found = section["findings"]
    if not found:
        return "<p>Checks of the captures: nothing was found that is not as the noise model supposes.</p>"
    lines = "".join(f"<li><b>{escape(f['check'])}</b>{_chance(f['p_value'])}: {escape(f['text'])}</li>" for f in found)
    return f'<div class="findings">Look at this first; figures below may be off:<ul>{lines}</ul></div>'


def _chance(p_value: float | None) -> str:
    text = p_text(p_value)
    return f" (p {text if text[:1] == '<' else '= ' + text})" if text else ""


def plain_text(value: Any) -> str:
    """A value of ``capture.yaml``, groups and lists as words and commas."""
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {plain_text(item)}" for key, item in value.items() if item is not None)
    if isinstance(value, list | tuple):
        return ", ".join(plain_text(item) for item in value)
    return str(value)


def p_text(p_value: float | None) -> str:
    """A p-value for a table."""
    if p_value is None:
        return ""
    return f"{p_value:.2g}" if p_value >= 1e-300 else "< 1e-300"


def row_of(*figures: str) -> str:
    """Drawings side by side, as many as fit in a row; empty ones are left out."""
    return '<div class="row">' + "".join(f"<figure>{f}</figure>" for f in figures if f) + "</div>"


def parameter_row(name: str, item: Any) -> tuple[str, str, str, str]:
    """Name, value, interval and unit (or why there is no value) of one parameter, as texts for a table.

    Parameters
    ----------
    item : a number, or what `estimated` and `not_identifiable` give.
    """
    if not isinstance(item, dict):
        return name, number(item), "", ""
    if item["value"] is None:
        return name, "not identifiable", "", item["reason"]
    interval = item.get("interval_95")
    note = item.get("note", "")
    between = f"{interval[0]:.5g} to {interval[1]:.5g}" if interval else ""
    return name, f"{item['value']:.5g}", between, " ".join(t for t in (item.get("unit", ""), note) if t)


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
