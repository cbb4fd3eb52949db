"""Targets tile their rectangle exactly and carry the right reflectance at the right place."""

import colour
import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from hesim_render.core.errors import SpecError
from hesim_render.specs.target import TargetSpec
from hesim_render.spectral.spectrum import Spectrum
from hesim_render.targets.build import build_target, placed_pieces
from hesim_render.targets.piece import Picture, bent, picture_piece
from hesim_render.targets.points import target_points

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
    {"type": "edge-field"},
    {"type": "edge-field", "rows": 2, "cols": 3, "angle_deg": [5, -7, 30], "fill": 0.69},
    {"type": "resolution-wedges"},
    {"type": "resolution-wedges", "lines": 1, "line_wide_m": 0.001, "line_narrow_m": 0.02, "width_m": 0.1},
    {"type": "zone-plate", "cycles": 4},
    {"type": "grey-ramp"},
    {"type": "dead-leaves", "texels_across": 64, "radius_min_m": 0.01, "radius_max_m": 0.05},
    {"type": "integrating-sphere"},
    {"type": "charuco", "rows": 3, "cols": 4},
    {"type": "charuco", "rows": 4, "cols": 3, "margin_m": 0},
    {"type": "aprilgrid", "rows": 2, "cols": 3},
    {"type": "aprilgrid", "rows": 2, "cols": 1, "border_bits": 2},
    {"type": "circle-grid", "rows": 3, "cols": 4},
    {"type": "circle-grid", "rows": 4, "cols": 3, "asymmetric": True},
    {"type": "circle-grid", "rows": 1, "cols": 3, "asymmetric": True, "margin_m": 0},
    {"type": "dot-grid", "rows": 3, "cols": 5},
    {"type": "led-grid", "rows": 3, "cols": 2},
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
        if isinstance(piece.reflectance, Spectrum):
            value[inside.any(axis=0)] = piece.reflectance.at(wavelength_nm)
    return value, hits


@pytest.mark.slow
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
    for width, height in ((0.26, 0.18), (0.18, 0.31)):
        star = build_target(target_of({"type": "siemens-star", "spokes": 4, "width_m": width, "height_m": height}))
        for radius, value in ((0.0899, np.where(np.arange(8) % 2 == 0, 0.05, 0.8)), (0.0901, 0.8)):
            found, _ = value_at(star, radius * np.cos(angle), radius * np.sin(angle))
            inside = (abs(radius * np.cos(angle)) < width / 2) & (abs(radius * np.sin(angle)) < height / 2)
            np.testing.assert_allclose(found[inside], np.broadcast_to(value, 8)[inside])


def test_squares_of_an_edge_field_are_turned_clockwise_about_the_middles_of_their_cells():
    content = {"type": "edge-field", "rows": 2, "cols": 3, "angle_deg": [10, -20], "fill": 0.6, "width_m": 0.36,
               "height_m": 0.2}  # fmt: skip
    target = target_of(content)
    x, y = np.random.default_rng(2).uniform(-0.5, 0.5, (2, 3000)) * [[0.36], [0.2]]
    value, _ = value_at(build_target(target), x, y)
    u, v = np.mod(x + 0.18, 0.12) - 0.06, np.mod(y, 0.1) - 0.05
    number = (y < 0) * 3 + np.floor((x + 0.18) / 0.12)
    angle = np.radians(np.where(number % 2 == 0, 10, -20))
    # the turned axes of a square: its upright side leans to the right for a positive angle
    own_x, own_y = u * np.cos(angle) - v * np.sin(angle), u * np.sin(angle) + v * np.cos(angle)
    dark = (abs(own_x) < 0.03) & (abs(own_y) < 0.03)
    np.testing.assert_array_equal(value == 0.2, dark)


def test_lines_of_a_wedge_have_the_stated_widths():
    target = target_of({"type": "resolution-wedges", "lines": 3, "line_wide_m": 0.01, "line_narrow_m": 0.002})
    pieces = build_target(target)
    along = np.linspace(-0.15, 0.15, 30001)
    for height in (-0.0899, 0.0, 0.0899):  # the lines are 0.18 long
        left = along[along < 0] + 1e-7
        value, _ = value_at(pieces, left, np.full(left.size, height))
        assert np.count_nonzero(np.diff(value)) == 6  # three dark lines
        width = 0.006 - 0.008 * height / 0.18
        np.testing.assert_allclose(np.mean(value == 0.05) * 0.15, 3 * width, atol=6e-5)  # six ends, 1e-5 each
    # the right wedge has level lines that become narrower to the right: a length of 0.135 about x = 0.075
    for x, width in ((0.0076, 0.01), (0.075, 0.006), (0.1424, 0.002)):
        upright = np.linspace(-0.0999, 0.0999, 20001)
        value, _ = value_at(pieces, np.full(upright.size, x), upright)
        np.testing.assert_allclose(np.mean(value == 0.05) * 0.1998, 3 * width, atol=1e-4)


def test_discs_have_their_area_and_place():
    target = target_of({"type": "circle-grid", "rows": 3, "cols": 2, "asymmetric": True, "pitch_m": 0.1,
                        "diameter_m": 0.06})  # fmt: skip
    dark = next(piece for piece in build_target(target) if piece.name == "dark")
    corners, areas = triangles(dark)
    np.testing.assert_allclose(areas.sum(), 6 * np.pi * 0.03**2, rtol=1e-12)
    centres = corners.reshape(6, -1, 3).mean(axis=1)[:, :2]
    # OpenCV's asymmetric grid: (2 col + row % 2, row) in pitches
    expected = np.array([[2 * col + row % 2, -row] for row in range(3) for col in range(2)]) * 0.1
    np.testing.assert_allclose(centres - centres[0], expected, atol=1e-4)
    reach = np.linalg.norm(corners.reshape(6, -1, 2 + 1)[:, :, :2] - target_points(target)[:, None, :2], axis=2)
    np.testing.assert_allclose([reach.min(), reach.max()], 0.03, rtol=1.7e-4)


def test_targets_are_bent_then_turned_then_moved():
    flat = {"type": "checkerboard", "rows": 2, "cols": 3, "width_m": 0.3, "height_m": 0.2}
    pieces = placed_pieces(target_of({**flat, "rotation_axis": [0, 1, 0], "rotation_deg": 90, "position_m": [1, 2, 3]}))
    points = np.concatenate([piece.vertices_m for piece in pieces])
    # turned about the upright axis by 90°, the right side points away from the camera, and the face to the right
    np.testing.assert_allclose(points.min(axis=0), [1, 1.9, 2.85], atol=1e-12)
    np.testing.assert_allclose(points.max(axis=0), [1, 2.1, 3.15], atol=1e-12)
    for radius in (0.2, -0.2):
        pieces = build_target(target_of({**flat, "bend_radius_m": radius}))
        corners = np.concatenate([p.vertices_m[p.faces.astype(int)] for p in pieces])
        # all on the cylinder, and the area is that of the flat board but for the chords of the strips
        on_axis = np.hypot(corners[..., 0], corners[..., 2] - radius)
        np.testing.assert_allclose(on_axis, 0.2, rtol=1e-9)
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
        np.testing.assert_allclose(area.sum(), 0.06, rtol=2e-5)
        assert np.sign(corners[..., 2].sum()) == np.sign(radius)
        assert np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2].min() > 0
    with pytest.raises(SpecError, match=r"more than half a cylinder of this radius; it must be 0.09549 m or more"):
        build_target(target_of({**flat, "bend_radius_m": 0.09}))


def test_places_on_a_bent_picture_are_those_of_the_flat_one():
    """Unrolled, each strip lies between its lines, has its place in the picture, and together they are the whole."""
    width, height, radius, step = 0.31, 0.17, 0.11, 0.023
    flat = picture_piece("p", Picture(np.zeros((2, 3, 1), np.float32), "grey"), width, height, (0.2, 0.7, 0.1, 0.4))
    found = bent(flat, radius, step)
    x, y, z = found.vertices_m.T
    along = radius * np.arctan2(x, radius - z)
    np.testing.assert_allclose(found.uv[:, 0], 0.2 + 0.5 * (along / width + 0.5), atol=1e-9)
    np.testing.assert_allclose(found.uv[:, 1], 0.1 + 0.3 * (y / height + 0.5), atol=1e-9)
    strips = np.stack([along, y], axis=1)[found.faces.astype(int)]
    one, other = strips[:, 1] - strips[:, 0], strips[:, 2] - strips[:, 0]
    area = (one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]) / 2
    assert area.min() > 0 and area.sum() == pytest.approx(width * height, rel=1e-9)
    place = strips[..., 0] / step
    assert np.all(np.ceil(place.max(axis=1) - 1e-9) - np.floor(place.min(axis=1) + 1e-9) == 1)
    # 14 strips of two triangles, each cut into a part of 3 or 4 corners
    assert len(strips) <= 14 * 2 * 2


def test_a_zone_plate_has_the_stated_frequency():
    (piece,) = build_target(target_of({"type": "zone-plate", "cycles": 20, "width_m": 0.2, "height_m": 0.2}))
    values = piece.reflectance.values[..., 0].astype(float)
    middle = values[len(values) // 2]
    x = (np.arange(middle.size) + 0.5) / middle.size - 0.5
    assert len(values) % 2 == 1  # the row in the middle goes through the centre
    np.testing.assert_allclose(middle, 0.425 + 0.375 * np.cos(2 * np.pi * 20 * x**2), atol=1e-6)
    # the phase at a side is 2π · 20 / 4 = 10 π, with ten zeros of the cosine before it
    assert np.count_nonzero(np.diff(np.sign(middle - 0.425))) == 20


@pytest.mark.parametrize(("width", "height"), [(0.2, 0.13), (0.12, 0.31)])
def test_the_rings_of_a_zone_plate_are_circles_on_the_target(width, height):
    """At x and y from the middle, in widths of the target: cos 2π · 7 (x² + y²), whatever its shape."""
    plate = {"type": "zone-plate", "cycles": 7, "width_m": width, "height_m": height}
    values = build_target(target_of(plate))[0].reflectance.values[..., 0].astype(float)
    rows, cols = values.shape
    x = (np.arange(cols) + 0.5) / cols - 0.5
    y = ((np.arange(rows) + 0.5) / rows - 0.5) * height / width
    np.testing.assert_allclose(values, 0.425 + 0.375 * np.cos(14 * np.pi * (x**2 + y[:, None] ** 2)), atol=1e-5)
    # texels are square within one of them, and the finest rings, of the corners, have 24 texels a cycle
    assert abs(rows / cols - height / width) * cols <= 1
    assert 0 <= cols - 24 * 7 * np.hypot(1, height / width) < 1


def test_reflectance_outside_0_to_1_is_refused():
    for value in (1.01, -0.1):
        with pytest.raises(ValidationError, match=r"\[0, 1\]"):
            target_of({"type": "flat", "reflectance": {"flat": value}})


@pytest.mark.parametrize(
    ("target", "key"),
    [
        ({"type": "zone-plate", "width_m": 0.01, "height_m": 1.0, "cycles": 300}, "target.cycles"),
        ({"type": "dead-leaves", "width_m": 0.01, "height_m": 10.0, "texels_across": 16384, "radius_min_m": 1e-4},
         "target.texels_across"),
    ],
)  # fmt: skip
def test_pictures_that_would_be_too_large_are_refused_before_they_are_drawn(target, key):
    with pytest.raises(SpecError, match=r"the picture would have .* texels, more than 2.68e.08") as caught:
        build_target(TypeAdapter(TargetSpec).validate_python(target))
    assert key in str(caught.value)
