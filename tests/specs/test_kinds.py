"""The kind of a study's file is told by its keys, also where one of them is misspelt or another kind has it."""

import pytest

from hesim_render.core.errors import SpecError
from hesim_render.core.shipped import data_folder, list_names
from hesim_render.specs.run import StudyKind, study_kind


def test_each_shipped_study_is_of_its_kind():
    kinds = {name: study_kind(name).value for name in list_names("studies")}
    assert kinds == {
        **dict.fromkeys(("filter-sets", "five-cfas", "hybrid-events", "one-pixel", "shipped-sensors"), "comparison"),
        **dict.fromkeys(("hybrid-quad-bayer", "rggb-dyes", "tile-shares"), "design"), "light-and-exposure": "sweep",
    }  # fmt: skip


@pytest.mark.parametrize(("text", "kind"), [
    ("schema_version: 1\nname: x\nsensors: [gen2]\n", StudyKind.comparison),
    ("schema_version: 1\nname: x\nsensor: gen2\nvary: [red]\nfilter_set: rggb\n", StudyKind.design),
    ("schema_version: 1\nname: x\nstudy: five-cfas\nvary: {palette: [dyes]}\n", StudyKind.sweep),
    ("schema_version: 1\nname: x\nscenes: [dark]\nsensors: [gen2]\nvry: {}\n", StudyKind.sweep),  # misspelt
    ("schema_version: 1\nname: x\nsensor: gen2\nfit: {}\njugde: {}\n", StudyKind.design),
])  # fmt: skip
def test_the_keys_tell_the_kind(text, kind, tmp_path):
    (tmp_path / "s.yaml").write_text(text)
    assert study_kind(tmp_path / "s.yaml") is kind


def test_a_name_that_is_none_is_one_line():
    with pytest.raises(SpecError, match=r"no study named 'five-cfa'; shipped are .*did you mean 'five-cfas'"):
        study_kind("five-cfa")


def test_filter_sets_and_palettes_are_in_the_folder_of_studies():
    assert {data_folder(kind).parent for kind in ("filter_sets", "palettes")} == {data_folder("studies")}
    assert "rggb" in list_names("filter_sets") and "dyes" in list_names("palettes")
