"""Linear sRGB of tristimulus values, from the primaries of the standard and from an independent adaptation."""

import numpy as np
import pytest
from colour.adaptation import matrix_chromatic_adaptation_VonKries as adaptation

from hesim_render.spectral.colorimetry import xyz_to_linear_srgb

#: Chromaticities of IEC 61966-2-1: red, green, blue, and the white D65.
PRIMARIES, D65 = [(0.64, 0.33), (0.30, 0.60), (0.15, 0.06)], (0.3127, 0.3290)


def xyz(chromaticity):
    x, y = chromaticity
    return np.array([x / y, 1.0, (1 - x - y) / y])


def to_xyz():
    """XYZ of the three primaries [XYZ, primary], whose sum is the white."""
    each = np.stack([xyz(primary) for primary in PRIMARIES], axis=1)
    return each * np.linalg.solve(each, xyz(D65))


def test_primaries_of_the_standard_are_unit_vectors():
    """The matrix of the standard has four digits."""
    np.testing.assert_allclose(xyz_to_linear_srgb(to_xyz().T, xyz(D65)), np.eye(3), atol=5e-4)


@pytest.mark.parametrize("white", [(0.4476, 0.4074), (0.28, 0.31)])
def test_colours_under_another_light_are_adapted_as_bradford_says(white):
    own = 3.7 * xyz(white)
    given = np.random.default_rng(3).uniform(0.2, 3.0, (20, 3))
    matrix = adaptation(own / own[1], xyz(D65), transform="Bradford")
    expected = np.linalg.solve(to_xyz(), matrix @ (given / own[1]).T).T
    np.testing.assert_allclose(xyz_to_linear_srgb(given, own), expected, atol=2e-3)
    np.testing.assert_allclose(xyz_to_linear_srgb(own, own), np.ones(3), atol=1e-12)
