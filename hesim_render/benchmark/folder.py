"""The folder of a benchmark: its plan, its clips, and the manifest of the finished whole."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError, field_validator

from hesim_render.benchmark.clip import CLIP_FILE, RECORDING, SCENE
from hesim_render.benchmark.generator import SCENE_FILE
from hesim_render.benchmark.sharp import COLOURS_FILE, SHARP_FILE, ColourTruth, SharpImages
from hesim_render.core.errors import SpecError
from hesim_render.core.guard import WholeFile, inside, reading
from hesim_render.core.names import FileName, PathBelow
from hesim_render.recording.recording import Recording
from hesim_render.specs.benchmark import Split
from hesim_render.specs.problems import spec_error

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
    name: FileName
    split: Split
    scene: int
    motion: int
    light: int
    sensor: str
    noise: str
    seed: int
    exposure_us: float | None
    counts: dict[str, int]
    figures: dict[str, Any]
    render: dict[str, Any]
    parts: list[str]
    files: dict[PathBelow, _FileEntry]


class _ManifestEntry(BaseModel):
    model_config = ConfigDict(extra="allow")
    name: FileName
    split: Split
    sha256: str


class _Manifest(BaseModel):
    model_config = ConfigDict(extra="allow")
    schema_version: int
    name: FileName
    clips: list[_ManifestEntry]

    @field_validator("clips")
    @classmethod
    def _once(cls, clips: list[_ManifestEntry]) -> list[_ManifestEntry]:
        if len({clip.name for clip in clips}) != len(clips):
            raise ValueError("names a clip twice")
        return clips


def parsed_json(text: str | bytes, model: type[BaseModel], file: str | Path) -> dict[str, Any]:
    """The content of a JSON text that fits a model; `file` is for errors.

    Raises
    ------
    SpecError
        If it is damaged.
    """
    with reading(file, "as JSON"):
        content = json.loads(text)
        try:
            model.model_validate(content)
        except ValidationError as error:
            raise spec_error(error, model, content, file) from None
    return content


def read_json(path: Path, model: type[BaseModel]) -> dict[str, Any]:
    """A JSON file whose content fits a model.

    Raises
    ------
    SpecError
        If it is missing, damaged, or of another version.
    """
    if not path.is_file():
        raise SpecError("no such file", file=path)
    content = parsed_json(WholeFile(path).text(), model, path)
    if content["schema_version"] != SCHEMA:
        raise SpecError(f"schema_version {content['schema_version']}; this version reads {SCHEMA}", file=path)
    return content


def read_clip(folder: Path) -> dict[str, Any]:
    """The description of a built clip, whose name is that of its folder.

    Raises
    ------
    SpecError
        If it is missing, damaged, or that of another clip.
    """
    content = read_json(folder / CLIP_FILE, _ClipContent)
    if content["name"] != folder.name:
        raise SpecError(f"is of the clip {content['name']!r}; its folder is {folder.name!r}", file=folder / CLIP_FILE)
    return content


@dataclass(frozen=True)
class BenchmarkClip:
    """A clip of a built benchmark; everything is read when it is asked for."""

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
            If a clip is a link.
        """
        for entry in self.manifest["clips"]:
            if split is None or entry["split"] == split:
                folder = self.root / "clips" / entry["name"]
                if folder.resolve() != folder:
                    raise SpecError("is a link; the clips of a benchmark are folders in it", file=folder)
                yield BenchmarkClip(folder)
