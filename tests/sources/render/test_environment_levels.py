"""The level of an environment map on a plane, against the integral of a sky that brightens towards one side."""

import numpy as np
import pytest

from hesim_render.sources.render.scene import environment
from hesim_render.sources.render.scene.mitsuba_version import mitsuba, transform
from hesim_render.specs.geometry import rotation_about

ROWS, COLS = 41, 96


def level(values, normal, rotation_deg=0.0, in_lux=True):
    mi = mitsuba()
    pose = np.eye(4)
    pose[:3, :3] = rotation_about((0.0, 1.0, 0.0), rotation_deg)
    picture = np.repeat(values[..., None], 3, axis=2).astype(np.float32)
    emitter = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(picture), "to_world": transform(mi, pose)})
    return environment.level_on_plane(mi, emitter, (ROWS, COLS), pose[:3, :3], np.array(normal), in_lux=in_lux)


@pytest.mark.parametrize(("chunk", "in_lux"), [(1 << 20, True), (6000, False)])
def test_a_sky_that_brightens_to_one_side_gives_its_integral(monkeypatch, chunk, in_lux):
    """L = 1 + d·g in all directions d: π + 2π/3 n·g on a plane with normal n. Rows from +y on, the middle column at +z.

    A map of 41 × 96 texels follows it to a part of 1e-3.
    """
    monkeypatch.setattr(environment, "_CHUNK", chunk)
    theta = np.linspace(0, np.pi, ROWS)[:, None]
    phi = 2 * np.pi * (np.arange(COLS)[None] + 0.5) / COLS  # texels lie half a column from the seam at -z
    x, y, z = np.sin(phi) * np.sin(theta), np.cos(theta) * np.ones_like(phi), -np.cos(phi) * np.sin(theta)
    one = level(np.ones((ROWS, COLS)), [0, 0, 1], in_lux=in_lux) / np.pi
    slope = np.array([0.2, -0.5, 0.35])
    values = 1 + slope[0] * x + slope[1] * y + slope[2] * z
    for normal, turn in (([0.6, 0.0, 0.8], 0.0), ([0.36, -0.48, -0.8], 110.0)):
        seen = rotation_about((0.0, 1.0, 0.0), turn) @ slope
        expected = np.pi + 2 * np.pi / 3 * np.dot(normal, seen)
        assert level(values, normal, turn, in_lux) / one == pytest.approx(expected, rel=1e-3)
