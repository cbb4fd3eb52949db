"""Cones around images of lamps in mirrors: who is in front of what, and how wide, by distances and angles."""

import numpy as np

from hesim_render.sources.render.scene.mitsuba_version import mitsuba
from hesim_render.sources.render.transport.mirrored_lamps import _SHARE, LampImages

#: Centre and radius of an image behind a mirror, its normal and offset: the mirror stands at x = 0.7 and faces -x.
LEFT, RIGHT = (
    (np.array([1.3, 0.2, 0.4]), 0.45, np.array([-1.0, 0.0, 0.0]), -0.7),
    (np.array([-1.1, -0.3, 0.9]), 0.3, np.array([0.8, 0.0, -0.6]), -0.95),
)


def cones_from(point, upwards, *images):
    mi = mitsuba()
    seen = LampImages(mi, list(images)).seen_from(
        mi.Point3f(list(map(float, point))), mi.Vector3f(upwards), mi.Bool(True)
    )
    return [tuple(np.array(part, np.float64).ravel() for part in cone) for cone in seen._cones]


def test_a_cone_is_as_wide_as_the_ball_looks():
    """Its sine is the radius over the distance to the centre; chances are shared by all images."""
    point = np.array([0.3, 0.1, 0.0])
    for (axis, width, chance), (centre, radius, _, _) in zip(
        cones_from(point, [0, 0, 1], LEFT, RIGHT), (LEFT, RIGHT), strict=True
    ):
        away = np.linalg.norm(centre - point)
        np.testing.assert_allclose(axis, (centre - point) / away, rtol=1e-6)
        np.testing.assert_allclose(1 - width, np.cos(np.arcsin(radius / away)), rtol=1e-6)
        np.testing.assert_allclose(chance, _SHARE / 2, rtol=1e-6)


def test_an_image_lights_what_is_before_its_mirror_and_turned_to_it():
    for point, upwards, lit in (
        ([0.3, 0.1, 0.0], [0, 0, 1], True),
        ([0.3, 0.1, 0.0], [0, 0, -1], False),  # turned away
        ([0.3, 0.1, 0.0], [-0.9, 0, -(0.19**0.5)], False),
        ([0.71, 0.1, 0.0], [0, 0, 1], False),  # behind the mirror
        ([0.69, 0.1, 0.0], [0, 0, 1], True),
        ([0.69, 0.2, 0.4], [0.6, 0, 0.8], True),  # 0.61 from the centre
    ):
        ((_, _, chance),) = cones_from(point, upwards, LEFT)
        np.testing.assert_allclose(chance, _SHARE * lit, rtol=1e-6)
    near = LEFT[0], 0.61, LEFT[2], LEFT[3]  # reaches over the mirror: the point lies at its rim
    ((_, _, chance),) = cones_from([0.69, 0.2, 0.4], [0.6, 0, 0.8], near)
    assert chance == 0
    far = LEFT[0], 0.0026, LEFT[2], LEFT[3]  # 1 - cos of 9e-6 is too narrow for float32, of 1.1e-5 is not
    for scale, seen in ((1.0, False), (1.5, True)):
        ((_, width, chance),) = cones_from([0.7 - 0.0001, 0.2, 0.4], [1, 0, 0], (far[0], far[1] * scale, *far[2:]))
        assert (chance > 0) == seen and abs(width - 0.5 * (0.0026 * scale / 0.6001) ** 2) < 1e-7


def test_the_images_of_the_largest_lamps_are_kept():
    def image(k):
        return np.array([2.0 + 3 * k, 0.2, 0.4]), (0.3, 0.5, 0.2, 0.6, 0.1, 0.4)[k], LEFT[2], LEFT[3]

    found = [axis[0] * 0 + width for axis, width, _ in cones_from([0.3, 0.1, 0.0], [0, 0, 1], *map(image, range(6)))]
    distances = [np.linalg.norm(image(k)[0] - [0.3, 0.1, 0.0]) for k in (3, 1, 5, 0)]
    sines = np.array([0.6, 0.5, 0.4, 0.3]) / distances
    np.testing.assert_allclose(np.ravel(found), 1 - np.sqrt(1 - sines**2), rtol=1e-4)
