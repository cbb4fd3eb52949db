"""Environment maps give the level that is asked for, from the right side."""

import contextlib
import json

import numpy as np
import pytest
from rendering import flux_image, mono

import hesim_render as hr
from hesim_render.core.errors import SpecError
from hesim_render.sources.render.scene import environment
from hesim_render.sources.render.scene.mitsuba_version import files_readable, mitsuba
from hesim_render.specs.light import LightSpec

ROWS, COLS = 64, 128
THETA = np.linspace(0, np.pi, ROWS)[:, None]
AROUND = 2 * np.pi * np.arange(COLS)[None] / COLS


def write_map(folder, values):
    picture = np.repeat(np.broadcast_to(values, (ROWS, COLS))[..., None], 3, axis=2).astype(np.float32)
    with files_readable():
        mitsuba().Bitmap(picture).write(str(folder / "map.exr"))


def flux(folder, light, tilt_deg=0.0, samples=1 << 14):
    """Mean flux of a grey plate that faces the camera, or is turned about y."""
    plate = {"name": "p", "shape": "rectangle", "size_m": [1, 1, 0], "reflectance": 0.5}
    plate |= {"rotation_axis": [0, 1, 0], "rotation_deg": tilt_deg}
    content = {"objects": [plate], "light": light, "camera": {"origin_m": [0, 0, 1], "target_m": [0, 0, 0]}}
    file = folder / "scene.yaml"
    file.write_text(json.dumps({"schema_version": 1, "name": "t", "description": "", **content}))
    a, b, _ = flux_image(hr.load_scene(file), mono(4, 4), samples)
    return float((a + b).mean() / 2)


@pytest.mark.parametrize("rotation_deg", [pytest.param(0, marks=pytest.mark.slow), 70])
def test_the_level_is_the_one_asked_for(tmp_path, rotation_deg):
    """A grey map with a gradient, a bright window and a bright spot, against the uniform light of the same level."""
    values = 1 + 0.8 * np.cos(THETA) + 0.5 * np.sin(THETA) * np.cos(AROUND)
    values = np.broadcast_to(values, (ROWS, COLS)).copy()
    values[10:20, 60:75] += 20
    values[30, 5] += 300
    write_map(tmp_path, values)
    expected = flux(tmp_path, {"type": "uniform", "illuminance_lux": 500}, samples=64)
    light = {"type": "environment", "file": "map.exr", "illuminance_lux": 500, "rotation_deg": rotation_deg}
    assert flux(tmp_path, light) == pytest.approx(expected, rel=8e-3)
    other = light | {"plane_normal": [0.6, 0, 0.8]}
    tilted = float(np.degrees(np.arctan2(0.6, 0.8)))
    assert flux(tmp_path, other, tilted) == pytest.approx(expected, rel=8e-3)
    assert flux(tmp_path, other) != pytest.approx(expected, rel=0.03)


def test_black_texels_dim_their_neighbours_as_in_mitsuba(tmp_path):
    """Half of the texels are black. Spectrum and scale are interpolated apart: the sky has 4 % less than their mean."""
    write_map(tmp_path, (1.3 + np.cos(THETA)) * (np.random.default_rng(7).random((ROWS, COLS)) > 0.5))
    expected = flux(tmp_path, {"type": "uniform", "illuminance_lux": 500}, samples=64)
    light = {"type": "environment", "file": "map.exr", "illuminance_lux": 500, "rotation_deg": 20}
    assert flux(tmp_path, light) == pytest.approx(expected, rel=8e-3)


def test_the_upper_edge_is_up_and_the_middle_is_behind_the_camera(tmp_path):
    """Light from one half of the sphere alone reaches plates that face it."""
    up = {"type": "environment", "file": "map.exr", "illuminance_lux": 500, "plane_normal": [0, 1, 0]}
    write_map(tmp_path, np.pi / 2 > THETA)
    half = flux(tmp_path, up)  # half of the level of all directions falls onto an upright plate
    assert half == pytest.approx(
        0.5 * flux(tmp_path, {"type": "uniform", "illuminance_lux": 500}, samples=64), rel=0.02
    )
    # the camera looks along -z, so the plate faces +z
    write_map(tmp_path, np.abs(AROUND - np.pi) < np.pi / 2 - 0.05)
    behind = {**up, "plane_normal": [0, 0, 1]}
    assert flux(tmp_path, behind) == pytest.approx(2 * half, rel=0.02)
    ahead = {**behind, "plane_normal": [0, 0, -1], "rotation_deg": 180}
    assert flux(tmp_path, ahead) < 1e-3 * half
    # a quarter turn about y takes +z to +x
    side = {**behind, "plane_normal": [1, 0, 0], "rotation_deg": 90}
    assert flux(tmp_path, side, tilt_deg=60) > 2 * flux(tmp_path, side, tilt_deg=-60)


@pytest.mark.parametrize(
    ("light", "told"),
    [
        ({"file": "none.exr"}, "no such file"),
        ({"file": "bad.exr"}, "map|picture|scene"),
        ({"file": "black.exr"}, "no light to the plane"),
        ({"file": "map.exr", "illuminant": "A"}, "colours of its file"),
        ({}, "needs file"),
    ],
)
def test_wrong_maps_are_told(tmp_path, light, told):
    write_map(tmp_path, 0.0)
    (tmp_path / "map.exr").rename(tmp_path / "black.exr")
    write_map(tmp_path, 1.0)
    (tmp_path / "bad.exr").write_bytes(b"not a picture")
    with pytest.raises(SpecError, match=told):
        flux(tmp_path, {"type": "environment", "illuminance_lux": 500, **light}, samples=4)


@pytest.mark.parametrize(("level", "fits"), [(1.02e-9, True), (0.98e-9, False), (0.0, False)])
def test_a_map_gives_light_to_the_plane_from_a_part_of_its_brightest_place_on(tmp_path, monkeypatch, level, fits):
    """A thousand millionth of the brightest texel, 37.5: light in W m⁻² is scaled by the level that the map gives."""
    values = np.full((ROWS, COLS), 3.0)
    values[9, 40] = 37.5
    write_map(tmp_path, values)
    monkeypatch.setattr(environment, "level_on_plane", lambda *_, **__: 37.5 * level)
    given = {"type": "environment", "file": "map.exr", "irradiance_w_m2": 2.6}
    light = LightSpec.model_validate(given, context={"folder": tmp_path})
    with contextlib.nullcontext() if fits else pytest.raises(SpecError, match="no light to the plane"):
        found = environment.environment(mitsuba(), light, np.array([0.0, 0.0, 1.0]), "light")
        assert found["scale"] == pytest.approx(2.6 / (37.5 * level))


def test_one_light_from_everywhere(tmp_path):
    write_map(tmp_path, 1.0)
    light = [
        {"type": "environment", "file": "map.exr", "illuminance_lux": 5},
        {"type": "uniform", "illuminance_lux": 5},
    ]
    with pytest.raises(SpecError, match="no uniform light beside it"):
        flux(tmp_path, light, samples=4)
