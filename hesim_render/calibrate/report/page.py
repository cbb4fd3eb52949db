"""The calibration report: one HTML file that needs no other file."""

from pathlib import Path
from typing import Any

from markupsafe import Markup

from hesim_render.calibrate.report.events import asynchronous_section, evs_section
from hesim_render.calibrate.report.frames import aps_section
from hesim_render.calibrate.report.parts import plain_text
from hesim_render.calibrate.result import check_report, read_calibration, read_maps, report_beginning
from hesim_render.calibration.file import as_written
from hesim_render.calibration.spec import SECTIONS
from hesim_render.core.drawing import report_style
from hesim_render.core.html import filled
from hesim_render.core.output import alone_in, write_whole


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
        data = _with_truth(read_calibration(calibration))
        maps = {section: read_maps(calibration, section, data) for section in SECTIONS if section in data}
    with as_written(calibration), report_style():
        sections = []
        if "aps" in data:
            sections.append(aps_section(data["aps"], maps["aps"]))
        if "evs" in data:
            draw = asynchronous_section if data["evs"].get("reference") == "last_event" else evs_section
            sections.append(draw(data["evs"], maps["evs"]))
        capture = data["capture"]
        page = filled(
            "calibrate/report/page.html", beginning=Markup(report_beginning(calibration)), sections=sections,
            sensor=capture.get("sensor"),
            capture=[
                (key, plain_text(value)) for key, value in capture.items() if value not in (None, "") and key != "truth"
            ],
        )  # fmt: skip
    write_whole(path, page)
    return Path(report)


def _with_truth(data: dict[str, Any]) -> dict[str, Any]:
    """A calibration whose estimates have the truth of a virtual session beside them."""
    truth = data["capture"].get("truth") or {}
    return data | {
        name: data[name] | {
            key: data[name][key] | {"truth": value}
            for key, value in truth.get(name, {}).items() if isinstance(data[name].get(key), dict)
        }
        for name in SECTIONS if name in data
    }  # fmt: skip
