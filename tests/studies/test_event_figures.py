"""Figures of the event pixels of a tile, against the probabilities of a sensor's pixels, each with its thresholds."""

from types import SimpleNamespace

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.studies.cfa import tile_event_figures


def xyz_of(lightness, a, b):
    """CIELAB under a white of (0.9, 1, 1.1), by its definition; lightness above 8."""
    y = (lightness + 16) / 116
    return np.stack([0.9 * (y + a / 500) ** 3, y**3, 1.1 * (y - b / 200) ** 3], axis=-1)


def test_what_a_tile_sees_is_what_its_pixels_would():
    """Three surfaces under four event pixels of three filters; thresholds differ by a quarter from pixel to pixel.

    Means over 32,000 pixels a position: a probability of one half has an error of 0.003.
    """
    changes = {
        "evs.threshold_mismatch_rel": 0.25, "evs.contrast_threshold_on": 0.15, "evs.contrast_threshold_off": 0.27,
        "evs.leak_rate_hz": 3.0, "device_seed": 5,
    }  # fmt: skip
    sensor = hr.load_sensor("eiger", changes)
    filters, white = ["blue", "green", "red"], np.array([2.1e5, 4.7e5, 3.3e5])
    channels = np.array([[0.05, 0.09, 0.11], [0.054, 0.086, 0.12], [0.052, 0.096, 0.104]])
    lab = np.array([[40.0, 30.0, -20.0], [44.0, -10.0, 15.0], [47.0, 5.0, -12.0]])
    samples = SimpleNamespace(xyz=xyz_of(*lab.T), white_xyz=np.array([0.9, 1.0, 1.1]))
    found = tile_event_figures(sensor, filters, white, channels, samples)
    part, tile = sensor.crop(720, 720), sensor.spec.tile_rows
    own = [filters.index(sensor.spec.pixels[tile[i][j]].filter) for i, j in sensor.spec.positions("evs")]
    where = part.layout.evs_position
    electrons = (white * channels * sensor.spec.evs.window_us * 1e-6)[:, own][:, where]
    seen = {}
    for a, b in ((0, 1), (1, 0), (0, 2), (2, 0), (1, 2), (2, 1)):
        on, off = part.evs.event_probability(electrons[a], electrons[b])
        any_of = [np.mean((on + off)[where == k]) for k in range(4)]
        seen[a, b] = 1 - np.prod(1 - np.array(any_of))
    assert 0.04 < min(seen.values()) < 0.1 and 0.3 < max(seen.values()) < 0.5
    assert found["event_seen"] == pytest.approx(np.mean(list(seen.values())), abs=3e-3)
    # surfaces 0 and 1 differ by 4 in lightness and by more than 20 altogether, 0 and 2 by 7, 1 and 2 by 3 and more
    pairs = [(0, 1), (1, 0), (1, 2), (2, 1)]
    assert found["event_seen_isoluminant"] == pytest.approx(np.mean([seen[pair] for pair in pairs]), abs=3e-3)
    one = SimpleNamespace(xyz=samples.xyz[:1], white_xyz=samples.white_xyz)
    alone = tile_event_figures(sensor, filters, white, channels[:1], one)
    assert alone["event_seen"] is None and alone["event_seen_isoluminant"] is None
    assert alone["event_contrast_on"] == found["event_contrast_on"]
