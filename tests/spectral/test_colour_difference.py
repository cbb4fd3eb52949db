"""CIELAB and ΔE2000 against colour-science, on NumPy and on the device."""

import colour
import numpy as np
import pytest

from hesim_render.core.backend import jit
from hesim_render.core.device_types import device_namespace
from hesim_render.core.host_arrays import from_host
from hesim_render.spectral.colorimetry import delta_e_2000, delta_e_2000_of, delta_e_ab, lab, lab_of

#: Pairs of [sharma2005] at which implementations differ: hues on both sides of 0°, greys, the turn at 275°.
PAIRS = np.array([
    [50, 2.6772, -79.7751, 50, 0, -82.7485, 2.0425], [50, -1.3802, -84.2814, 50, 0, -82.7485, 1.0],
    [50, 0, 0, 50, -1, 2, 2.3669], [50, 2.49, -0.001, 50, -2.49, 0.0009, 7.1792],
    [50, 2.49, -0.001, 50, -2.49, 0.0011, 7.2195], [50, 2.5, 0, 50, 0, -2.5, 4.3065],
    [50, 2.5, 0, 73, 25, -18, 27.1492], [60.2574, -34.0099, 36.2677, 60.4626, -34.1751, 39.4387, 1.2644],
    [2.0776, 0.0795, -1.135, 0.9033, -0.0636, -0.5514, 0.9082],
])  # fmt: skip


def test_published_pairs():
    np.testing.assert_allclose(delta_e_2000(PAIRS[:, :3], PAIRS[:, 3:6]), PAIRS[:, 6], atol=5e-5)
    np.testing.assert_allclose(delta_e_2000(PAIRS[:, 3:6], PAIRS[:, :3]), PAIRS[:, 6], atol=5e-5)


def test_random_colours_are_those_of_colour_science():
    rng = np.random.default_rng(4)
    white = np.array([0.95, 1.0, 1.09])
    xyz = rng.uniform(-0.02, 1.1, (2, 3000, 3)) ** np.array([1, 1, 1])
    xyz[:, :200] = np.abs(xyz[:, :200]) * 0.01  # the linear part
    ours = lab(xyz, white)
    theirs = colour.XYZ_to_Lab(xyz, colour.XYZ_to_xy(white))
    np.testing.assert_allclose(ours, theirs, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(delta_e_2000(*ours), colour.delta_E(*theirs, method="CIE 2000"), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(delta_e_ab(*ours), colour.delta_E(*theirs, method="CIE 1976"), rtol=1e-9)
    # single precision on the device
    xp, types = device_namespace(), jit()
    pair = [lab_of(tuple(from_host(types.Float, column) for column in (each / white).T), xp) for each in xyz]
    np.testing.assert_allclose(delta_e_2000_of(*pair, xp).numpy(), delta_e_2000(*ours), rtol=2e-4, atol=2e-3)


def test_equal_colours_do_not_differ():
    colours = np.random.default_rng(5).uniform(-50, 50, (100, 3))
    colours[:10, 1:] = 0
    assert delta_e_2000(colours, colours).max() == 0
    assert delta_e_2000([50, 0, 0], [51, 0, 0]) == pytest.approx(1 / (1 + 0.015 * 0.25 / np.sqrt(20.25)))
