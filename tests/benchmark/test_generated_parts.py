"""Meshes, motions and lamps of generated scenes against geometry written out: surfaces, ways, and who faces whom."""

import numpy as np
import pytest

from hesim_render.benchmark import lamps, meshes, motions
from hesim_render.benchmark.draws import draws
from hesim_render.spectral.spectrum import Spectrum


def volume(points, faces):
    """Of a closed mesh whose faces look outwards, by tetrahedra to the origin."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    return np.sum(a * np.cross(b, c)) / 6


@pytest.mark.parametrize("seed", range(4))
def test_meshes_are_what_they_are_called(seed):
    points, faces = meshes._ring(np.random.default_rng(seed))
    x, y, z = points.T
    tube = np.hypot(np.hypot(x, y) - 1, z)
    inner = tube[0]
    np.testing.assert_allclose(tube, inner, rtol=1e-9)
    assert 0.12 <= inner <= 0.45 and volume(points, faces) == pytest.approx(2 * np.pi**2 * inner**2, rel=0.02)
    points, faces = meshes._star(np.random.default_rng(seed))
    count = (len(points) - 2) // 2
    radius, angle = np.hypot(*points[:count, :2].T), np.arctan2(points[:count, 1], points[:count, 0])
    np.testing.assert_allclose(radius[::2], 1)
    np.testing.assert_allclose(radius[1::2], radius[1])
    np.testing.assert_allclose(np.diff(np.unwrap(angle)), 2 * np.pi / count)
    half = points[:, 2].max()
    assert 6 <= count <= 16 and 0.35 <= radius[1] <= 0.8 and 0.1 <= half <= 0.5
    area = count * radius[1] * np.sin(2 * np.pi / count) / 2
    assert volume(points, faces) == pytest.approx(2 * half * area, rel=1e-9)
    points, faces = meshes._boulder(np.random.default_rng(seed))
    radius = np.linalg.norm(points, axis=1).reshape(24, 48)
    assert 0.28 < radius.min() < 0.97 < 1.03 < radius.max() < 1.72
    assert np.abs(np.diff(radius, axis=1)).max() < 0.25  # smooth
    np.testing.assert_allclose(points.reshape(24, 48, 3)[..., 1] / radius, np.cos(np.linspace(0, np.pi, 24))[:, None]
                               * np.ones(48), atol=1e-9)  # fmt: skip
    # outwards, or a boulder of glass is a hole in glass
    assert 4 * radius.min() ** 3 < volume(points, faces) < 4.2 * radius.max() ** 3


@pytest.mark.parametrize("begin", [0.0, 0.3])
def test_a_way_to_and_fro_is_its_way_to_both_sides(begin):
    """0.5 long at 0.8 a second: a quarter takes 625 ms; at a phase of 0.3 it has begun 750 ms before."""
    way = np.array([0.3, 0.0, -0.4])
    keys = motions._to_and_fro(way, 0.8, begin)
    assert [key["t_us"] for key in keys] == [625_000 * k - round(2_500_000 * begin) for k in range(5)]
    for key, part in zip(keys, (1, 0, -1, 0, 1), strict=True):
        np.testing.assert_allclose(key["translation_m"], part * way, atol=1e-9)


def test_ways_pass_the_middle_and_turns_are_no_faster_than_they():
    """A straight way has its middle at the origin; its turn moves the rim by as much at most, to both sides."""
    seen, turns = set(), []
    for number in range(150):
        track = motions.solid_track(draws(5, 1, number), "a", 0.9, 0.3, 500_000)
        first, last = track["keyframes"][0], track["keyframes"][-1]
        if "rotation_deg" in last and "translation_m" in last:
            seen.add("both")
            turns.append(np.radians(last["rotation_deg"]) * 0.15 / 0.45)
        if len(track["keyframes"]) == 2 and "translation_m" in last:
            np.testing.assert_allclose(np.add(first["translation_m"], last["translation_m"]), 0, atol=1e-9)
        if len(track["keyframes"]) == 5:
            seen.add("corners")
            reach = np.linalg.norm([key["translation_m"] for key in track["keyframes"]], axis=1)
            assert reach[0] == 0 and reach.max() < motions._LONGEST_WAY
    assert seen == {"both", "corners"} and len(turns) > 15
    assert min(turns) < -0.7 and max(turns) > 0.7 and np.abs(turns).max() <= 1
    for number in range(40):
        first, last = motions.camera_track(draws(5, 2, number), 0.1, 700_000)["keyframes"]
        np.testing.assert_allclose(np.add(first["translation_m"], last["translation_m"]), 0, atol=1e-12)
        assert abs(last["rotation_deg"]) <= np.degrees(0.07 / 2)
        assert abs(motions.camera_track(draws(5, 2, number), 0.1, 70_000)["keyframes"][1]["rotation_deg"]) <= 0.21


def test_a_fast_camera_goes_to_and_fro():
    track = motions.camera_track(draws(5, 3, 1), 0.9, 700_000)
    ways = np.array([key["translation_m"] for key in track["keyframes"]])
    np.testing.assert_allclose(np.linalg.norm(ways, axis=1), 0.15 * np.array([1, 0, 1, 0, 1]), atol=1e-8)
    assert track["repeat"] and track["pivot_m"] == [0, 0, motions.CAMERA_Z]


def test_panels_face_the_middle_of_the_view_and_stand_beside_it():
    """Square, right-handed; the pyramid from the camera to the view, and the panel's corners, do not meet."""
    light = Spectrum(np.array([400.0, 700.0]), np.array([2.0, 3.0]))
    for number in range(60):
        matrix = np.array(lamps._lamp(draws(9, 2, number), "panel", light)["to_world"])
        place, turned = matrix[:3, 3], matrix[:3, :3]
        np.testing.assert_allclose(turned[:, 2], -place / np.linalg.norm(place), atol=1e-8)
        sides = np.linalg.norm(turned[:, :2], axis=0)
        assert sides[0] == pytest.approx(sides[1], abs=1e-8) and np.linalg.det(turned) > 0
        assert np.abs(turned[:, :2].T @ turned[:, 2]).max() < 1e-8 and abs(turned[:, 0] @ turned[:, 1]) < 1e-8
        corners = place + np.array([(i, j) for i in (-1, 1) for j in (-1, 1)]) @ turned[:, :2].T
        nearest = np.abs(corners[:, :2]).max(axis=1)
        assert np.all(nearest > 0.5 * np.maximum(0, motions.CAMERA_Z - corners[:, 2]) / motions.CAMERA_Z)


@pytest.mark.parametrize(("height", "size"), [(0.9, 0.1), (1.6, 0.5), (2.2, 0.3)])
def test_lamps_hide_the_view_up_to_its_corner_and_theirs(height, size):
    """The view is 1 m wide at z = 0 and a point at the camera; beyond, the lamp and the camera's own way are left."""
    half = max(0.0, 0.5 * (2 - height) / 2)
    limit = np.hypot(half + size / 2, half + size / 2) + 0.15
    for angle in (0.3, 2.0):
        way = np.array([np.cos(angle), np.sin(angle), 0.0])
        assert lamps._hides_the_view(0.999 * limit * way + [0, 0, height], size)
        assert not lamps._hides_the_view(1.001 * limit * way + [0, 0, height], size)


def test_the_spectrum_of_a_lamp_ends_where_it_is_known():
    found = lamps._emission(Spectrum(np.array([400.0, 500.0, 650.0]), np.array([2.0, 3.0, 1.5])), 0.25)
    nm, values = np.array(found["wavelengths"]), np.array(found["values"])
    inside = (nm >= 400) & (nm <= 650)
    assert not np.any(values[~inside]) and inside.any() and not inside.all()
    np.testing.assert_allclose(values[inside], 0.25 * np.interp(nm[inside], [400, 500, 650], [2, 3, 1.5]), rtol=1e-6)
