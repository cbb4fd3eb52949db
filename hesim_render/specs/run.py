"""The file of a whole run: what is recorded, and the steps that follow on the recording.

The kind of a YAML file by its keys: of a study (comparison, design, sweep), and a whole run or a scene.
"""

from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, Field, field_validator, model_validator

from hesim_render.core.names import FileName
from hesim_render.core.region import parse_roi
from hesim_render.core.yaml_file import read_yaml
from hesim_render.specs.design import DesignSpec
from hesim_render.specs.files import Strict, locate
from hesim_render.specs.scene import SceneSpec
from hesim_render.specs.study import NamesFiles, StudySpec, TaskFile
from hesim_render.specs.sweep import SweepSpec

#: What a run's folder holds besides exports.
RECORDING, PICTURES, STATE = "recording", "pictures", "run.json"


class FileInput(NamesFiles):
    """A video or a hyperspectral cube in front of the sensor."""

    file: str = Field(min_length=1, description="relative to the file of the run")
    options: dict[str, Any] = Field({}, description="as the options of `simulate_video` or `simulate_cube`")


class IspStep(NamesFiles):
    """Develop the RAW frames."""

    pipeline: str | None = Field(None, description="file of steps, relative to the file of the run")
    denoise: bool = True
    calibration: str | None = Field(None, description="calibration.yaml of a calibrated sensor")

    @model_validator(mode="before")
    @classmethod
    def _shorthand(cls, data: Any) -> Any:
        return {} if data is True else data


class ExportStep(Strict):
    """Write the recording in the format of another program."""

    format: str
    out: FileName = Field(description="name of the file or folder, in the folder of the run")

    @field_validator("out")
    @classmethod
    def _other(cls, value: str) -> str:
        if value in (RECORDING, PICTURES, STATE):
            raise ValueError(f"expected a name other than {RECORDING}, {PICTURES}, {STATE}")
        return value


class RunSpec(TaskFile):
    """A whole run."""

    scene: str | None = Field(None, description="name or file of a scene")
    video: FileInput | None = None
    cube: FileInput | None = None
    sensor: str = Field(description="name or file of a sensor")
    set: dict[str, Any] = Field({}, description="keys to change as in --set: light.illuminance_lux, sensor.aps.…")
    roi: str | None = Field(None, description="part of the sensor: WIDTHxHEIGHT or WIDTHxHEIGHT+X+Y, px")
    duration_s: float | None = Field(None, gt=0, le=1e6, description="default 0.1; of a video all of it")
    seed: int = Field(7, ge=0, lt=2**64)
    clean: bool = False
    without: list[str] = []
    quality: float | None = Field(None, gt=0)
    exact: bool = False
    samples: int | None = Field(None, ge=2)
    truth: list[str] = []
    truth_every_us: int | None = Field(None, ge=1)
    isp: IspStep | None = None
    export: list[ExportStep] = []
    view: bool = Field(False, description="write recording.html")

    @field_validator("roi")
    @classmethod
    def _region(cls, value: str | None) -> str | None:
        if value is not None:
            parse_roi(value, "roi")
        return value

    @field_validator("isp", mode="before")
    @classmethod
    def _off(cls, value: Any) -> Any:
        return None if value is False else value

    @model_validator(mode="after")
    def _fits(self) -> "RunSpec":
        if sum(given is not None for given in (self.scene, self.video, self.cube)) != 1:
            raise ValueError("a run is of a 'scene', a 'video' or a 'cube'")
        if self.scene is None:
            given = [name for name in ("quality", "samples", "truth_every_us") if getattr(self, name) is not None]
            given += [name for name in ("exact", "truth") if getattr(self, name)]
            if given:
                raise ValueError(f"{given[0]}: only a run of a scene takes it")
            for key in self.set:
                if not key.startswith("sensor."):
                    raise ValueError(f"set: {key!r} is no key of the sensor file, which begin with 'sensor.'")
        if self.quality is not None and (self.exact or self.samples is not None):
            raise ValueError("quality: give it, or exact or samples, not both")
        names = [step.out for step in self.export]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"export: {name!r} is written twice")
        return self


class StudyKind(StrEnum):
    """Kinds of studies."""

    comparison = "comparison"
    design = "design"
    sweep = "sweep"


_STUDIES: dict[StudyKind, type[BaseModel]] = {
    StudyKind.comparison: StudySpec,
    StudyKind.design: DesignSpec,
    StudyKind.sweep: SweepSpec,
}
Kind = TypeVar("Kind")


def _kind_of(file: Path, models: Mapping[Kind, type[BaseModel]]) -> Kind:
    """The kind whose model has most of the file's keys, so that a misspelt key does not change it."""
    keys = set(read_yaml(file))
    return max(models, key=lambda kind: len(keys & set(models[kind].model_fields)))


def study_kind(name_or_path: str | Path) -> StudyKind:
    """The kind of a study, by shipped name or path.

    Raises
    ------
    SpecError
        If there is no such file, or it is no YAML mapping.
    """
    return _kind_of(locate(name_or_path, "studies"), _STUDIES)


def is_run_file(file: Path) -> bool:
    """True for the file of a whole run, False for a scene.

    Raises
    ------
    SpecError
        If the file is no YAML mapping.
    """
    return _kind_of(file, {False: SceneSpec, True: RunSpec})
