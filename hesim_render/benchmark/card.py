"""The card of a benchmark: what it holds, how its clips differ, and how good its render is."""

from __future__ import annotations

import io
import re
from collections import Counter
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from hesim_render.benchmark.croissant import card_header
from hesim_render.benchmark.statistics import FIGURES
from hesim_render.core.guard import printable
from hesim_render.specs.benchmark import SPLITS

HISTOGRAM_FILE = "histograms.png"
_BINS = 24
_MARKS = re.compile(r"[\\`*\[\]!|#~]")


def _decades(values: np.ndarray) -> float:
    positive = values[values > 0]
    return float(np.log10(positive.max() / positive.min())) if positive.size else 0.0


def spread(clips: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Smallest, median and largest value of each figure, and the decades between smallest and largest above 0.

    Parameters
    ----------
    clips : contents of ``clip.json``.
    """
    found = {}
    for name in FIGURES:
        given = [clip["figures"].get(name) for clip in clips]
        values = np.array([value for value in given if value is not None], dtype=np.float64)
        if values.size:
            found[name] = {
                "min": float(values.min()), "median": float(np.median(values)), "max": float(values.max()),
                "decades": _decades(values), "zero": int(np.count_nonzero(values <= 0)),
            }  # fmt: skip
    return found


def histograms(clips: list[dict[str, Any]]) -> bytes:
    """A PNG of the histograms of all figures over the clips, with logarithmic axes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 2.6), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    for axes, name in zip(figure.subplots(1, len(FIGURES)), FIGURES, strict=True):
        values = np.array([clip["figures"].get(name) or 0 for clip in clips], dtype=np.float64)
        values = values[values > 0]
        if values.size:
            low, high = values.min() / 1.1, values.max() * 1.1
            axes.hist(values, bins=np.geomspace(low, high, _BINS), color="0.35")
            axes.set_xscale("log")
        axes.set_xlabel(name)
        axes.set_ylabel("clips")
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()


def card(manifest: dict[str, Any], clips: list[dict[str, Any]]) -> str:
    """Text of the card, Markdown.

    Parameters
    ----------
    manifest : content of ``benchmark.json``.
    clips : contents of ``clip.json``.
    """
    spec = manifest["spec"]
    splits = Counter(clip["split"] for clip in clips)
    scenes = {split: len({c["scene"] for c in clips if c["split"] == split}) for split in SPLITS}
    size = sum(entry["bytes"] for clip in clips for entry in clip["files"].values())
    verdicts = Counter(clip["render"].get("audit", {}).get("verdict", "not audited") for clip in clips)
    kinds = _escaped(", ".join(spec["truth"])) or "none"
    lines = [
        f"# {_escaped(manifest['name'])}", "", _escaped(spec["description"]), "",
        f"{len(clips)} clips of {spec['duration_s']:g} s, {size / 1e9:.3g} GB, rendered by hesim_render "
        f"{manifest['versions']['hesim_render']}. Every number can be made again from `plan.json`; "
        "`hesim-render benchmark verify` compares all files with their SHA-256.", "",
        "| Split | Clips | Scenes |", "|---|---|---|",
        *(f"| {split} | {splits[split]} | {scenes[split]} |" for split in SPLITS), "",
        "Splits share no part: solids, meshes, textures, materials, motions and lamps of a scene occur in one split "
        "only.", "",
        "| Axis | Values |", "|---|---|",
        f"| sensors | {_escaped(', '.join(sorted({clip['sensor'] for clip in clips})))} |",
        f"| exposures, µs | {_limits([clip['exposure_us'] for clip in clips])} |",
        f"| noise | {_escaped(', '.join(sorted({clip['noise'] for clip in clips})))} |",
        f"| seeds | {', '.join(str(seed) for seed in sorted({clip['seed'] for clip in clips}))} |",
        f"| truth | {kinds} |", "",
        f"![Histograms of the clips]({HISTOGRAM_FILE})", "",
        "| Figure | smallest | median | largest | decades | |", "|---|---|---|---|---|---|",
    ]  # fmt: skip
    for name, values in spread(clips).items():
        zero = f", {values['zero']} clips with 0" if values["zero"] else ""
        lines.append(
            f"| `{name}` | {values['min']:.3g} | {values['median']:.3g} | {values['max']:.3g} | "
            f"{values['decades']:.1f} | {FIGURES[name]}{zero} |"
        )
    audits_text = ", ".join(f"{count} {verdict}" for verdict, count in sorted(verdicts.items()))
    lines += [
        "", f"{_render(spec)}. Audits: {audits_text}.", "",
        "| Folder of a clip | |", "|---|---|",
        "| `clip.json` | numbers on the axes, figures, parts, error and audit, units, versions, hashes |",
        "| `recording/` | RAW frames with blur, events, their truth and labels |",
        "| `sharp.h5` | sharp flux and noise-free RAW at given times, if the plan asks for them |",
        "| `colours.h5` | the same light through every filter at every pixel, if the plan asks for it |",
        "| `scene/` | the generated scene with its meshes and textures |", "",
    ]  # fmt: skip
    return "\n".join(lines)


def _escaped(text: str) -> str:
    """A text of others as Markdown that shows it as it is: no element of HTML, link, picture or cell of a table."""
    lines = (escape(printable(line), quote=False) for line in text.split("\n"))
    return "\n".join(_MARKS.sub(r"\\\g<0>", line) for line in lines)


def _render(spec: dict[str, Any]) -> str:
    if spec.get("samples") is not None:
        return f"Exact mode: {spec['samples']} rays per pixel and slice, whose noise is not bounded"
    return f"Quality of the render (error over the sensor's noise): {spec['quality']:g}"


def _limits(values: list[float | None]) -> str:
    given = sorted({value for value in values if value is not None})
    if not given:
        return "the sensors' own"
    return f"{given[0]:g}" if len(given) == 1 else f"{given[0]:g} to {given[-1]:g}"


def write_card(path: Path, manifest: dict[str, Any], clips: list[dict[str, Any]]) -> None:
    """Write the card, with the header that hubs read, and its histograms.

    Parameters
    ----------
    path : of the card; the histograms lie beside it.
    manifest, clips : as for `card`.
    """
    from hesim_render.core.output import replacing

    with replacing(path.with_name(HISTOGRAM_FILE)) as unfinished:
        unfinished.write_bytes(histograms(clips))
    with replacing(path) as unfinished:
        unfinished.write_text(card_header(manifest) + "\n" + card(manifest, clips), encoding="utf-8")
