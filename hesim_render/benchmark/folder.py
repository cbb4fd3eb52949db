"""The folder of a benchmark: its plan, its clips, and the manifest of the finished whole."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from hesim_render.benchmark.clip import CLIP_FILE, RECORDING, SCENE
from hesim_render.benchmark.colour_truth import COLOURS_FILE, ColourTruth
from hesim_render.benchmark.generator import SCENE_FILE
from hesim_render.benchmark.sharp import SHARP_FILE, SharpImages
from hesim_render.core.errors import SpecError
from hesim_render.core.guard import inside, read_text, reading
from hesim_render.recording.recording import Recording

PLAN_FILE, MANIFEST_FILE, CARD_FILE = "plan.json", "benchmark.json", "README.md"
SCHEMA = 1


class _FileEntry(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)
    sha256: str
    bytes: int


class _ClipContent(BaseModel):
    """What every `clip.json` must have; other keys are for readers."""

    model_config = ConfigDict(extra="allow")
    schema_version: int
    name: str
    split: str
    scene: int
    parts: list[str]
    files: dict[str, _FileEntry]


class _ManifestEntry(BaseModel):
    model_config = ConfigDict(extra="allow")
    name: str
    split: str
    sha256: str


class _Manifest(BaseModel):
    model_config = ConfigDict(extra="allow")
    schema_version: int
    name: str
    clips: list[_ManifestEntry]


def read_json(path: Path, model: type[BaseModel]) -> dict[str, Any]:
    """A JSON file whose content fits a model.

    Raises
    ------
    SpecError
        If it is missing, damaged, or of another version.
    """
    if not path.is_file():
        raise SpecError("no such file", file=path)
    text = read_text(path)
    with reading(path, "as JSON"):
        content = json.loads(text)
        model.model_validate(content)
    if content["schema_version"] != SCHEMA:
        raise SpecError(f"schema_version {content['schema_version']}; this version reads {SCHEMA}", file=path)
    return content


def read_clip(folder: Path) -> dict[str, Any]:
    """The description of a built clip."""
    return read_json(folder / CLIP_FILE, _ClipContent)


@dataclass(frozen=True)
class BenchmarkClip:
    """A clip of a built benchmark; everything is read when it is asked for.

    Parameters
    ----------
    folder : of the clip.
    """

    folder: Path

    @cached_property
    def content(self) -> dict[str, Any]:
        """What ``clip.json`` holds: split, numbers on the axes, figures, parts, hashes."""
        return read_clip(self.folder)

    @property
    def name(self) -> str:
        return str(self.content["name"])

    @property
    def split(self) -> str:
        return str(self.content["split"])

    @cached_property
    def recording(self) -> Recording:
        """Frames, events and truth."""
        return Recording.load(self.folder / RECORDING)

    @cached_property
    def sharp(self) -> SharpImages | None:
        """Sharp images; None where the benchmark has none."""
        return SharpImages(inside(self.folder, SHARP_FILE)) if (self.folder / SHARP_FILE).is_file() else None

    @cached_property
    def colours(self) -> ColourTruth | None:
        """Full-colour truth; None where the benchmark has none."""
        return ColourTruth(inside(self.folder, COLOURS_FILE)) if (self.folder / COLOURS_FILE).is_file() else None

    @property
    def scene_file(self) -> Path | None:
        """The generated scene; None for a given one."""
        file = self.folder / SCENE / SCENE_FILE
        return file if file.is_file() else None


class Benchmark:
    """A built benchmark.

    Parameters
    ----------
    root : its folder.

    Raises
    ------
    SpecError
        If the folder is no benchmark, or its build has not ended.
    """

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root).expanduser().resolve()
        if not (self.root / MANIFEST_FILE).is_file():
            begun = (self.root / PLAN_FILE).is_file()
            what = "its build has not ended; run 'benchmark build' again" if begun else "no benchmark"
            raise SpecError(what, file=root)
        #: What ``benchmark.json`` holds.
        self.manifest = read_json(self.root / MANIFEST_FILE, _Manifest)

    def clips(self, split: str | None = None) -> Iterator[BenchmarkClip]:
        """All clips, or those of a split, in the order of the manifest.

        Parameters
        ----------
        split : ``train``, ``val``, ``test``, or None.

        Yields
        ------
        The clips; nothing of them is read before it is asked for.

        Raises
        ------
        SpecError
            If the manifest names a folder outside of the benchmark.
        """
        for entry in self.manifest["clips"]:
            if split is None or entry["split"] == split:
                folder = self.root / "clips" / entry["name"]
                if not folder.resolve().is_relative_to(self.root):
                    raise SpecError(f"{entry['name']!r} leads out of the folder", file=self.root / MANIFEST_FILE)
                yield BenchmarkClip(folder)
