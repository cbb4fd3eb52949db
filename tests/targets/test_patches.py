"""Charts of a user's own patches: measured spectra, and colours in CIELAB."""

import colour
import numpy as np
import pytest
from rendering import FURNACE, make_scene

import hesim_render as hr
from hesim_render.core.errors import SpecError
from hesim_render.sources.render.cube import render_cube
from hesim_render.spectral.patches import read_patches

SPECTRA = """\
# measured on a Monday
name,400,500,600,700
white,0.9,0.91,0.92,0.93
red,0.05,0.04,0.5,0.7

blue,0.4,0.3,0.1,0.05
grey,0.2,0.2,0.2,0.2
black,0.03,0.03,0.03,0.03
green,0.05,0.4,0.2,0.1
"""


def test_measured_patches_lie_row_by_row_from_the_top_left(tmp_path):
    (tmp_path / "chart.csv").write_text(SPECTRA)
    target = {"type": "patch-chart", "patches": str(tmp_path / "chart.csv"), "rows": 2, "cols": 3, "patch_fill": 0.8}
    scene = make_scene(target=target, light=FURNACE, camera={"fit": "target"})
    radiance = render_cube(scene, (20, 30), [450.0, 650.0], 16)[1]  # reflectance, as the radiance of the light is 1
    expected = [[(0.905, 0.925), (0.045, 0.6), (0.35, 0.075)], [(0.2, 0.2), (0.03, 0.03), (0.225, 0.15)]]
    np.testing.assert_allclose(radiance[5::10, 5::10], expected, rtol=1e-5)
    np.testing.assert_allclose(radiance[0, 0], 0.035, rtol=1e-5)  # the surround


def test_patches_in_cielab_have_their_colour_under_d50(tmp_path):
    wanted = {"skin": (66.0, 17.0, 18.0), "sky": (50.0, -5.0, -23.0), "grey": (50.0, 0.0, 0.0), "red": (42, 55, 28)}
    rows = "\n".join(f"{name},{L},{a},{b}" for name, (L, a, b) in wanted.items())
    (tmp_path / "chart.csv").write_text(f"name, L*, a*, b*\n{rows}\n")
    grid = np.arange(380, 781, 1.0)
    table, light = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"], colour.SDS_ILLUMINANTS["D50"]
    weights = np.stack([np.interp(grid, table.wavelengths, c) for c in table.values.T])
    weights *= np.interp(grid, light.wavelengths, light.values)
    white = weights.sum(axis=1)
    for name, spectrum in read_patches(tmp_path / "chart.csv").items():
        assert spectrum.values.min() >= 0 and spectrum.values.max() <= 1
        t = (weights @ spectrum.at(grid)) / white
        f = np.where(t > (6 / 29) ** 3, np.cbrt(t), t / (3 * (6 / 29) ** 2) + 4 / 29)
        lab = [116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])]
        assert np.linalg.norm(np.subtract(lab, wanted[name])) < 0.6, (name, lab)


MISTAKES = {
    "empty": ("", "a chart needs a header line and a line per patch"),
    "header": ("patch,x,y\na,0.1,0.2\n", ":1: the header must be 'name' and increasing wavelengths"),
    "order": ("name,500,400\na,0.1,0.2\n", ":1: the header must be"),
    "cells": ("name,400,700\na,0.1\n", ":2: expected 3 cells, found 2"),
    "text": ("name,400,700\na,0.1,dark\n", ":2: expected numbers after the name, found '0.1,dark'"),
    "nan": ("name,400,700\na,0.1,nan\n", ":2: a value is not finite"),
    "twice": ("name,400,700\na,0.1,0.2\na,0.2,0.3\n", ":3: the name 'a' is there twice"),
    "unnamed": ("name,400,700\n,0.1,0.2\n", ":2: the name '' is empty"),
    "percent": ("name,400,700\na,10,20\n", ":2: a reflectance must lie in [0, 1]; this one runs from 10 to 20; divide"),
    "lightness": ("name,L,a,b\na,120,0,0\n", ":2: L must lie in 0 to 100; it is 120"),
    "no surface": ("name,L,a,b\na,50,-120,100\n", ":2: no reflectance in [0, 1] has the colour"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_wrong_chart_is_one_line_with_file_and_line(mistake, tmp_path):
    text, told = MISTAKES[mistake]
    (tmp_path / "chart.csv").write_text(text)
    with pytest.raises(SpecError) as caught:
        read_patches(tmp_path / "chart.csv")
    assert told in str(caught.value) and str(caught.value).startswith(str(tmp_path / "chart.csv"))
    assert len(str(caught.value).splitlines()) == 1


SCENE = """\
schema_version: 1
name: chart
description: a chart of two patches
target: {type: patch-chart, %s}
light: {type: uniform, illuminance_lux: 100}
camera: {fit: target}
"""


@pytest.mark.parametrize(
    ("keys", "told"),
    [
        (
            "patches: chart.csv, rows: 2, cols: 2",
            "scene.yaml:4: target.patches: there are 2 patches; rows times cols is 4",
        ),
        ("rows: 1, cols: 2", "scene.yaml:4: target: give patches or spectra, exactly one of them"),
        ("patches: none.csv, rows: 1, cols: 2", "no such file: "),
        ("patches: ../chart.csv, rows: 1, cols: 2", "lies outside of the scene's folder"),
    ],
)
def test_a_chart_that_does_not_fit_its_scene_is_refused(keys, told, tmp_path):
    (tmp_path / "chart.csv").write_text("name,300,1100\na,0.1,0.2\nb,0.3,0.4\n")
    (tmp_path / "scene.yaml").write_text(SCENE % keys)
    with pytest.raises(SpecError) as caught:
        hr.load_scene(tmp_path / "scene.yaml")
    assert told in str(caught.value) and len(str(caught.value).splitlines()) == 1


def test_a_dump_holds_the_numbers_and_is_the_same_target(tmp_path):
    (tmp_path / "chart.csv").write_text("name,300,1100\na,0.1,0.2\nb,0.3,0.4\n")
    (tmp_path / "scene.yaml").write_text(SCENE % "patches: chart.csv, rows: 1, cols: 2")
    spec = hr.load_scene(tmp_path / "scene.yaml").spec
    dumped = spec.model_dump(mode="json", exclude_none=True)
    assert "csv" not in str(dumped)
    again = type(spec).model_validate(dumped).target.load()
    assert list(again) == ["a", "b"]
    np.testing.assert_array_equal(again["b"].values, [0.3, 0.4])


@pytest.mark.parametrize("row", ["a,0.1,0.2", "a,0.1,0.2,0.3,0.4"])
def test_a_row_has_as_many_cells_as_the_header(row, tmp_path):
    (tmp_path / "chart.csv").write_text(f"name,400,500,600\n{row}\n")
    with pytest.raises(SpecError, match=f"expected 4 cells, found {row.count(',') + 1}"):
        read_patches(tmp_path / "chart.csv")
