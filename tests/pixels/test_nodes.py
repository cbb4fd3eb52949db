"""Nodes of filtered noise lie at whole periods, after the present one and before the end."""

import pytest

from hesim_render.pixels.evs.processes import BandNoise


@pytest.mark.parametrize(("node", "end_us", "nodes"), [
    (4, 91.0, [5, 6]), (4, 91.1, [5, 6, 7]), (6, 91.0, []), (5, 70.0, []), (-1, 26.0, [0, 1]),
])  # fmt: skip
def test_nodes_are_whole_periods(node, end_us, nodes):
    noise = BandNoise.__new__(BandNoise)
    noise._node, noise._period_us = node, 13.0
    assert noise.nodes_us(end_us) == [13.0 * k for k in nodes]
