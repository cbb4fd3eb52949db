"""Common parts of the sections of the calibration report: rows of figures, lines of tables, findings."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Any

from hesim_render.core.html import number


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
