"""Nodes of filtered noise lie at whole periods, after the present one and before the end."""

import numpy as np
import pytest

from hesim_render.core.backend import jit
from hesim_render.pixels.evs.processes import BandNoise


@pytest.mark.parametrize(("node", "end_us", "nodes"), [
    (4, 91.0, [5, 6]), (4, 91.1, [5, 6, 7]), (6, 91.0, []), (5, 70.0, []), (-1, 26.0, [0, 1]),
])  # fmt: skip
def test_nodes_are_whole_periods(node, end_us, nodes):
    noise = BandNoise.__new__(BandNoise)
    noise._node, noise._period_us = node, 13.0
    assert noise.nodes_us(end_us) == [13.0 * k for k in nodes]


def test_noise_is_a_line_between_two_nodes_and_goes_on_at_the_next():
    """Nodes at 52 and 65 µs; the next one is reached there, or before it by less than rounding."""
    types, advanced = jit(), []
    noise = BandNoise.__new__(BandNoise)
    noise._period_us, noise._is_alike = 13.0, True

    def advance():
        advanced.append(noise._node)
        noise._value, noise._state = types.Float([4.0, 1.0]), (types.Float([7.0, 7.0]),)

    noise._advance = advance
    for t_us, expected in ((52.0, [2, 5]), (55.9, [2.6, 3.8]), (64.99, [4 - 0.02 / 13, 1 + 0.04 / 13])):
        noise._node, noise._value, noise._state = 4, types.Float([2.0, 5.0]), (types.Float([4.0, 1.0]),)
        np.testing.assert_allclose(np.array(noise.at(t_us)), expected, rtol=1e-5)
    assert advanced == []
    for t_us, expected in ((65.0, [4, 1]), (65.0 - 1e-9, [4, 1])):
        noise._node, noise._value, noise._state = 4, types.Float([2.0, 5.0]), (types.Float([4.0, 1.0]),)
        np.testing.assert_allclose(np.array(noise.at(t_us)), expected, rtol=1e-5)
    assert advanced == [5, 5]
