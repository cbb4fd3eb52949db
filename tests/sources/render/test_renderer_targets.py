"""Targets tile their rectangle exactly and carry the right reflectance at the right place."""

import colour
import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from hesim_render.sources.render.scene.targets import build_target
from hesim_render.specs.target import TargetSpec

TARGETS = [
    {"type": "flat"},
    {"type": "colorchecker"},
    {"type": "colorchecker", "patch_fill": 1.0},
    {"type": "step-wedge", "steps": 7},
    {"type": "checkerboard", "rows": 3, "cols": 5},
    {"type": "checkerboard", "rows": 1, "cols": 1},
    {"type": "slanted-edge"},
    {"type": "slanted-edge", "angle_deg": -12},
    {"type": "slanted-edge", "angle_deg": 40, "width_m": 0.1, "height_m": 0.3},
    {"type": "slanted-edge", "angle_deg": -40, "width_m": 0.1, "height_m": 0.3},
    {"type": "siemens-star", "spokes": 5},
    {"type": "siemens-star", "width_m": 0.4, "spokes": 36},
]


def target_of(content):
    return TypeAdapter(TargetSpec).validate_python(content)


def triangles(piece):
    corners = piece.vertices_m[piece.faces.astype(int)]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return corners, 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def value_at(pieces, x, y, wavelength_nm=550.0):
    """Reflectance at points [n], and how many triangles hold each."""
    hits, value = np.zeros(x.shape, dtype=int), np.zeros(x.shape)
    for piece in pieces:
        corners, _ = triangles(piece)
        inside = np.ones((len(corners), x.size), dtype=bool)
        for k in range(3):
            p, q = corners[:, k], corners[:, (k + 1) % 3]
            side = (q[:, :1] - p[:, :1]) * (y - p[:, 1:2]) - (q[:, 1:2] - p[:, 1:2]) * (x - p[:, :1])
            inside &= side > 0
        hits += inside.sum(axis=0)
        value[inside.any(axis=0)] = piece.reflectance.at(wavelength_nm)
    return value, hits


@pytest.mark.parametrize("content", TARGETS, ids=str)
def test_pieces_tile_the_rectangle_without_overlap(content):
    target = target_of(content)
    pieces = build_target(target)
    areas = np.concatenate([triangles(piece)[1] for piece in pieces])
    assert areas.min() > -1e-15  # counter-clockwise as seen from +z
    np.testing.assert_allclose(areas.sum(), target.width_m * target.height_m, rtol=1e-9)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (2, 4000))
    _, hits = value_at(pieces, points[0] * target.width_m, points[1] * target.height_m)
    np.testing.assert_array_equal(hits, 1)
    assert all(np.all(piece.vertices_m[:, 2] == 0) for piece in pieces)


def test_colorchecker_order_is_row_by_row_from_the_top_left():
    target = target_of({"type": "colorchecker"})
    x = ((np.arange(24) % 6 + 0.6) / 6 - 0.5) * target.width_m  # off the diagonals of the patches
    y = (0.5 - (np.arange(24) // 6 + 0.5) / 4) * target.height_m
    value, _ = value_at(build_target(target), x, y, 640.0)
    chart = colour.SDS_COLOURCHECKERS["ISO 17321-1"]
    expected = [np.interp(640, sd.wavelengths, sd.values) for sd in chart.values()]
    np.testing.assert_allclose(value, expected, rtol=1e-12)


def test_step_wedge_is_even_in_density_and_checkerboard_starts_light():
    target = target_of(TARGETS[3])
    x = ((np.arange(7) + 0.6) / 7 - 0.5) * target.width_m
    value, _ = value_at(build_target(target), x, np.zeros(7))
    np.testing.assert_allclose(-np.log10(value), np.linspace(2, -np.log10(0.9), 7), rtol=1e-9)
    board = target_of(TARGETS[4])
    value, _ = value_at(build_target(board), np.array([-0.14, -0.07]), np.array([0.098, 0.098]))
    np.testing.assert_allclose(value, [0.8, 0.05])


def test_slanted_edge_leans_clockwise_and_star_spokes_are_dark_from_the_x_axis():
    for angle in (5.0, -12.0, 40.0):
        target = target_of({"type": "slanted-edge", "angle_deg": angle})
        x, y = np.random.default_rng(1).uniform(-0.1, 0.1, (2, 500))
        value, _ = value_at(build_target(target), x, y)
        np.testing.assert_array_equal(value == 0.2, x < y * np.tan(np.radians(angle)))  # dark on the left
    star = build_target(target_of({"type": "siemens-star", "spokes": 4}))
    angle = np.radians(np.arange(8) * 45 + 20.123)
    value, _ = value_at(star, 0.08 * np.cos(angle), 0.08 * np.sin(angle))
    np.testing.assert_allclose(value, np.where(np.arange(8) % 2 == 0, 0.05, 0.8))
    outside, _ = value_at(star, np.array([0.095]), np.array([0.093]))
    assert outside == [0.8]


def test_reflectance_outside_0_to_1_is_refused():
    for value in (1.01, -0.1):
        with pytest.raises(ValidationError, match=r"\[0, 1\]"):
            target_of({"type": "flat", "reflectance": {"flat": value}})
