"""The kind of a file of a study: a comparison of filter sets, a design of filters, or a sweep of any keys."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path

from hesim_render.specs.design import DesignSpec
from hesim_render.specs.files import load_yaml, locate
from hesim_render.specs.study import StudySpec
from hesim_render.specs.sweep import SweepSpec


class StudyKind(StrEnum):
    """Kinds of studies."""

    comparison = "comparison"
    design = "design"
    sweep = "sweep"


_MODELS = {StudyKind.comparison: StudySpec, StudyKind.design: DesignSpec, StudyKind.sweep: SweepSpec}


def study_kind(name_or_path: str | Path) -> StudyKind:
    """The kind whose model has most of the file's keys, so that a misspelt key does not change it.

    Raises
    ------
    SpecError
        If there is no such file, or it is no YAML mapping.
    """
    keys = set(load_yaml(locate(name_or_path, "studies")))
    return max(StudyKind, key=lambda kind: len(keys & set(_MODELS[kind].model_fields)))
