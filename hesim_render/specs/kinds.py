"""The kind of a YAML file by its keys: of a study (comparison, design, sweep), and a whole run or a scene."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel

from hesim_render.specs.design import DesignSpec
from hesim_render.specs.files import load_yaml, locate
from hesim_render.specs.run import RunSpec
from hesim_render.specs.scene import SceneSpec
from hesim_render.specs.study import StudySpec
from hesim_render.specs.sweep import SweepSpec


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
    keys = set(load_yaml(file))
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
