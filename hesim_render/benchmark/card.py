"""The card of a benchmark: what it holds, how its clips differ, and how good its render is.

What hubs of data sets read of a benchmark: metadata in Croissant 1.1 (JSON-LD), and the header of the card.

Neither has a date or a licence, which a benchmark does not know: who publishes it adds them.
"""

import hashlib
import io
import json
import re
from collections import Counter
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from hesim_render.benchmark.statistics import FIGURES
from hesim_render.core.guard import printable
from hesim_render.core.output import replacing, write_whole
from hesim_render.core.progress import counted
from hesim_render.specs.benchmark import SPLITS

HISTOGRAM_FILE = "histograms.png"
_BINS = 24
_MARKS = re.compile(r"[\\`*\[\]!|#~]")


def spread(clips: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Smallest, median and largest value of each figure, and the decades between smallest and largest above 0.

    Parameters
    ----------
    clips : contents of ``clip.json``.
    """
    result = {}
    for name in FIGURES:
        given = [clip["figures"].get(name) for clip in clips]
        values = np.array([value for value in given if value is not None], dtype=np.float64)
        positive = values[values > 0]
        if values.size:
            result[name] = {
                "min": float(values.min()), "median": float(np.median(values)), "max": float(values.max()),
                "decades": float(np.log10(positive.max() / positive.min())) if positive.size else 0.0,
                "zero": int(np.count_nonzero(values <= 0)),
            }  # fmt: skip
    return result


def _own_ticks(values: np.ndarray) -> list[float]:
    """Numbers on an axis that spans too few powers of ten to be told by them; none where it spans two or more."""
    low, high = float(values.min()), float(values.max())
    if high >= 100 * low:
        return []
    return [low, high] if high > 2 * low else [float(np.sqrt(low * high))]


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
            ticks = _own_ticks(values)
            if ticks:
                axes.set_xticks(ticks, [f"{tick:.3g}" for tick in ticks])
                axes.xaxis.set_minor_formatter("")
        axes.set_xlabel(name)
        axes.set_ylabel("clips")
        axes.yaxis.get_major_locator().set_params(integer=True)
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
        f"{counted(len(clips), 'clip')} of {spec['duration_s']:g} s, {size / 1e9:.3g} GB, rendered by hesim_render "
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
    with replacing(path.with_name(HISTOGRAM_FILE)) as unfinished:
        unfinished.write_bytes(histograms(clips))
    write_whole(path, card_header(manifest) + "\n" + card(manifest, clips))


CROISSANT_FILE = "croissant.json"
_VERSION = "1.0.0"
#: Terms of Croissant, of its specification.
_CONTEXT: dict[str, Any] = {
    "@language": "en", "@vocab": "https://schema.org/", "arrayShape": "cr:arrayShape", "citeAs": "cr:citeAs",
    "column": "cr:column", "conformsTo": "dct:conformsTo", "containedIn": "cr:containedIn",
    "cr": "http://mlcommons.org/croissant/", "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"}, "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/", "description": {"@container": "@language"},
    "equivalentProperty": "cr:equivalentProperty", "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract", "field": "cr:field", "fileProperty": "cr:fileProperty", "fileObject": "cr:fileObject",
    "fileSet": "cr:fileSet", "format": "cr:format", "includes": "cr:includes", "isArray": "cr:isArray",
    "isLiveDataset": "cr:isLiveDataset", "jsonPath": "cr:jsonPath", "key": "cr:key", "md5": "cr:md5",
    "name": {"@container": "@language"}, "parentField": "cr:parentField", "path": "cr:path",
    "recordSet": "cr:recordSet", "references": "cr:references", "regex": "cr:regex", "repeated": "cr:repeated",
    "replace": "cr:replace", "samplingRate": "cr:samplingRate", "sc": "https://schema.org/",
    "separator": "cr:separator", "source": "cr:source", "subField": "cr:subField", "transform": "cr:transform",
}  # fmt: skip
_MANIFEST, _HDF5 = "benchmark.json", "application/x-hdf5"
#: Sets of files of the clips: name, pattern, type, content.
_FILES = (
    ("frames", "clips/*/recording/frames/*.dng", "image/x-adobe-dng", "RAW frames, exact DN"),
    ("events", "clips/*/recording/events.h5", _HDF5, "events in the layout of DSEC"),
    ("truth", "clips/*/recording/truth/*", _HDF5, "geometric truth, causes and objects of events"),
    (
        "recordings",
        "clips/*/recording/recording.json",
        "application/json",
        "scene, sensor, seed and times of each clip",
    ),
    ("sharp", "clips/*/sharp.h5", _HDF5, "sharp images, noise-free"),
    ("colours", "clips/*/colours.h5", _HDF5, "the light through every filter at every pixel"),
)
#: Fields of a clip in the manifest, and their types.
_FIELDS = {"name": "Text", "split": "Text", "scene": "Integer", "sensor": "Text", "noise": "Text", "seed": "Integer",
           "sha256": "Text"}  # fmt: skip
#: Words by which hubs find a benchmark.
TAGS = ["event-camera", "raw-image", "synthetic", "hesim_render"]
#: Tasks of hubs by what a benchmark must have for them.
_TASKS = {"sharp": "image-to-image", "depth": "depth-estimation", "ids": "image-segmentation",
          "boxes": "object-detection"}  # fmt: skip
_SPLIT_NAMES = {"val": "validation"}
_SIZES = ((1000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))


def croissant(manifest: dict[str, Any], manifest_text: str) -> str:
    """Metadata of a benchmark, JSON-LD.

    Parameters
    ----------
    manifest : content of ``benchmark.json``.
    manifest_text : the same as it is in the file.
    """
    spec = manifest["spec"]
    absent = {name for name, has in (("sharp", spec["sharp"]), ("colours", spec.get("colours"))) if not has}
    distribution: list[dict[str, Any]] = [{
        "@type": "cr:FileObject", "@id": "manifest", "name": "manifest", "description": "all clips with their figures",
        "contentUrl": _MANIFEST, "encodingFormat": "application/json",
        "sha256": hashlib.sha256(manifest_text.encode()).hexdigest(),
    }]  # fmt: skip
    distribution += [
        {
            "@type": "cr:FileSet",
            "@id": name,
            "name": name,
            "description": description,
            "encodingFormat": kind,
            "includes": files,
        }
        for name, files, kind, description in _FILES
        if name not in absent
    ]
    fields = [
        {
            "@type": "cr:Field", "@id": f"clips/{name}", "name": name, "dataType": f"sc:{kind}",
            "source": {"fileObject": {"@id": "manifest"}, "extract": {"jsonPath": f"$.clips[*].{name}"}},
        }
        for name, kind in _FIELDS.items()
    ]  # fmt: skip
    fields[1]["references"] = {"field": {"@id": "splits/name"}}
    splits = [name for name in SPLITS if any(clip["split"] == name for clip in manifest["clips"])]
    content = {
        "@context": _CONTEXT, "@type": "sc:Dataset", "conformsTo": "http://mlcommons.org/croissant/1.1",
        "name": manifest["name"], "description": spec["description"], "version": _VERSION, "isLiveDataset": False,
        "keywords": [*TAGS, *tasks(spec)],
        "distribution": distribution,
        "recordSet": [
            {
                "@type": "cr:RecordSet", "@id": "splits", "name": "splits", "dataType": "cr:Split",
                "key": {"@id": "splits/name"}, "description": "parts of the benchmark",
                "field": [{"@type": "cr:Field", "@id": "splits/name", "name": "name", "dataType": "sc:Text"}],
                "data": [{"splits/name": name} for name in splits],
            },
            {"@type": "cr:RecordSet", "@id": "clips", "name": "clips", "key": {"@id": "clips/name"},
             "description": "one record for each clip, whose files are in clips/NAME", "field": fields},
        ],
    }  # fmt: skip
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"


def tasks(spec: dict[str, Any]) -> list[str]:
    """Names of hubs for tasks that a benchmark has truth for."""
    has = {*spec["truth"], *(["sharp"] if spec["sharp"] else [])}
    if "ids" in has:
        has.add("boxes")  # `Recording` makes them of the numbers of the objects
    if "all" in has:
        has |= set(_TASKS) - {"sharp"}
    return [task for name, task in _TASKS.items() if name in has]


def card_header(manifest: dict[str, Any], files: dict[str, str] | None = None) -> str:
    """The YAML block with which a card begins; each value is JSON, which is YAML.

    Parameters
    ----------
    manifest : content of ``benchmark.json``.
    files : pattern of the files of each split, where hubs can load them.
    """
    count = len(manifest["clips"])
    size = next((name for most, name in _SIZES if count < most), "n>1M")
    values = {
        "pretty_name": manifest["name"], "tags": TAGS, "task_categories": tasks(manifest["spec"]),
        "size_categories": [size], "annotations_creators": ["machine-generated"],
    }  # fmt: skip
    if files:
        splits = [{"split": _SPLIT_NAMES.get(split, split), "path": pattern} for split, pattern in files.items()]
        values["configs"] = [{"config_name": "default", "data_files": splits}]
    lines = [f"{key}: {json.dumps(value, ensure_ascii=True)}" for key, value in values.items() if value]
    return "\n".join(["---", *lines, "---", ""])
