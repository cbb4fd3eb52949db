"""The calibration report: one HTML file that needs no other file."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

from hesim_render.calibrate.report.asynchronous import asynchronous_section
from hesim_render.calibrate.report.drawing import report_style
from hesim_render.calibrate.report.events import evs_section
from hesim_render.calibrate.report.frames import aps_section
from hesim_render.calibrate.report.parts import plain_text, table
from hesim_render.calibrate.result import check_report, read_calibration, read_maps, report_beginning
from hesim_render.core.output import alone_in, replacing
from hesim_render.specs.calibration import as_written
from hesim_render.specs.calibration_spec import SECTIONS

_STYLE = """
body{font:15px/1.5 system-ui,sans-serif;color:#1b1b1b;max-width:1320px;margin:2rem auto;padding:0 1rem}
h1{font-size:1.6rem}h2{font-size:1.25rem;margin-top:2.2rem;border-bottom:1px solid #ccc}
.row{display:flex;flex-wrap:wrap;gap:18px;align-items:flex-start}figure{margin:0}
figcaption{font-size:.85rem;color:#555;max-width:52rem}
table{border-collapse:collapse;font-size:.85rem;margin:.6rem 0}
td,th{padding:.15rem .6rem;border-bottom:1px solid #ddd;text-align:left;font-variant-numeric:tabular-nums}
svg{stroke-linejoin:round;stroke-linecap:butt}
.findings{border-left:4px solid #d55e00;background:#fdf3ec;padding:.3rem .9rem;margin:.8rem 0}
"""


def write_report(calibration: str | Path, report: str | Path, overwrite: bool = False) -> Path:
    """Draw every section of a ``calibration.yaml`` into one HTML file.

    Parameters
    ----------
    overwrite : replace a report that is there.

    Raises
    ------
    SpecError
        If the calibration or its maps cannot be read.
    OutputError
        If the report cannot be written, or something is there that must not be replaced.
    """
    path = check_report(calibration, report, overwrite)
    with as_written(calibration), alone_in(Path(calibration).absolute().parent):
        data = read_calibration(calibration)
        maps = {section: read_maps(calibration, section, data) for section in SECTIONS if section in data}
    with as_written(calibration), report_style():
        parts = [_introduction(data)]
        if "aps" in data:
            parts.append(aps_section(data["aps"], maps["aps"]))
        if "evs" in data:
            draw = asynchronous_section if data["evs"].get("reference") == "last_event" else evs_section
            parts.append(draw(data["evs"], maps["evs"]))
    body = "\n".join(parts)
    page = (
        f'{report_beginning(calibration)}"><title>Noise calibration</title>'
        f"<style>{_STYLE}</style></head><body>{body}</body></html>\n"
    )
    with replacing(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return Path(report)


def _introduction(data: dict[str, Any]) -> str:
    capture = data["capture"]
    rows = [(key, plain_text(value)) for key, value in capture.items() if value not in (None, "")]
    of = f" of {escape(capture['sensor'])}" if "sensor" in capture else ""
    return f"<h1>Noise calibration{of}</h1>{table(('capture', ''), rows)}"
