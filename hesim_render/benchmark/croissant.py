"""What hubs of data sets read of a benchmark: metadata in Croissant 1.1 (JSON-LD), and the header of the card.

Neither has a date or a licence, which a benchmark does not know: who publishes it adds them.
"""

from __future__ import annotations

import hashlib
import json
from typing import Any

from hesim_render.specs.benchmark import SPLITS

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
