"""Noise of event pixels whose bandwidth differs from pixel to pixel (`evs.noise_spread`)."""

import numpy as np
import pytest
from scipy import stats

from hesim_render.core.backend import jit
from hesim_render.core.errors import SpecError
from hesim_render.mosaic.layout import Layout
from hesim_render.pixels.evs.model import EvsNoise
from hesim_render.pixels.evs.processes import BandNoise, bandwidth_map, most_bandwidth
from hesim_render.pixels.evs.stage import EvsStage
from hesim_render.sensor.reading import read_sensor
from hesim_render.sensor.sensor import load_sensor

ROWS, COLS = 34, 46
SPREAD = {"bandwidth_rel": 0.23, "odd_rows_rel": 0.31, "odd_cols_rel": -0.12}


def spec_of(**changes):
    beta = {"beta1": 1.0, "beta2": 0.3, "beta3": 0.21, "beta4": 0.05, "beta5": 0.0}
    return read_sensor("reference-mono", {
        "geometry.rows": ROWS, "geometry.cols": COLS, "device_seed": 11, "evs.reference": "last_event",
        "evs.tick_us": None, "evs.window_us": 1000, "evs.contrast_threshold_on": 0.23,
        "evs.contrast_threshold_off": 0.27, "evs.threshold_mismatch_rel": 0.0,
        "evs.signal_reference": {"k_dn_per_e": 1.0, "t_ref_us": 1000.0, "filter": "own"}, "evs.coefficients": [beta],
        "evs.shot_law": "sqrt", "evs.noise_cutoff_hz": 37.0, "evs.leak_rate_hz": 0.0,
        "evs.refractory_period_us": None, "evs.photoreceptor": None, "evs.noise_spread": SPREAD, **changes,
    })  # fmt: skip


def noise_of(spec, layout=None):
    return EvsNoise(spec.evs, layout or Layout.full(spec), spec.device_seed, np.ones(1))


def test_bandwidths_have_the_law_that_is_stated():
    noise = noise_of(spec_of())
    factor = bandwidth_map(noise).reshape(ROWS, COLS)
    row, col = np.where(np.arange(ROWS) % 2, 1.31, 0.69), np.where(np.arange(COLS) % 2, 0.88, 1.12)
    own = np.log(factor / row[:, None] / col) / 0.23
    # Kolmogorov and Smirnov at 1e-3; deviates beyond 3 are cut off in the fastest rows and columns only
    assert stats.kstest(own.ravel(), "norm").pvalue > 1e-3
    assert factor.max() <= most_bandwidth(noise) == pytest.approx(1.31 * 1.12 * np.exp(0.69))
    # the law of the first moment is taken at each pixel's part of the largest bandwidth
    assert BandNoise(noise, 5).share(ROWS * COLS) == pytest.approx(factor.ravel() / most_bandwidth(noise), rel=1e-5)
    assert bandwidth_map(noise.without("mismatch")) is None and most_bandwidth(noise.without("mismatch")) == 1


def test_a_crop_has_the_bandwidths_of_the_full_sensor():
    spec = spec_of()
    whole = bandwidth_map(noise_of(spec)).reshape(ROWS, COLS)
    part = noise_of(spec, Layout.full(spec).crop(13, 9, x=7, y=5))
    assert np.array_equal(bandwidth_map(part).reshape(9, 13), whole[5:14, 7:20])


@pytest.mark.parametrize("grid", [(1, 1), (3, 1), (1, 2)])
def test_rows_of_a_tile_are_counted_by_its_event_pixels(grid):
    """One event pixel in 4×4: rows of events are those of tiles. Three rows, or two columns, in 5×4: they alternate."""
    tile = {(1, 1): None, (3, 1): "R w G G\nR R G G\nR w G B\nG G B B\nG w B B\n",
            (1, 2): "R R G G\nR R G G\nw R w B\nG G B B\nG G B B\n"}[grid]  # fmt: skip
    changes = {} if tile is None else {
        "tile": tile, "evs_grid": {"rows_per_tile": grid[0], "cols_per_tile": grid[1]},
    }  # fmt: skip
    layout = Layout.full(load_sensor("gen2", {"geometry.rows": 40, "geometry.cols": 64, **changes}).spec)
    parts = {"bandwidth_rel": 0.0, "odd_rows_rel": -0.31, "odd_cols_rel": 0.12}
    spec = spec_of().evs.model_copy(update={"noise_spread": spec_of().evs.noise_spread.model_copy(update=parts)})
    noise = EvsNoise(spec, layout, 3, np.ones(1))
    factor = bandwidth_map(noise).reshape(layout.evs_shape)
    assert factor.shape == ((10, 16) if tile is None else (8 * grid[0], 16 * grid[1]))
    row, col = (
        np.where(np.arange(factor.shape[0]) % 2, 0.69, 1.31),
        np.where(np.arange(factor.shape[1]) % 2, 1.12, 0.88),
    )
    assert factor == pytest.approx(row[:, None] * col, rel=1e-6)
    assert most_bandwidth(noise) == pytest.approx(1.31 * 1.12)


def test_noise_of_each_pixel_has_its_bandwidth():
    """Correlation from every second node to the next, (1 + a τ) exp(−a τ) of each pixel's a, in classes of like a."""
    noise = noise_of(spec_of())
    band = BandNoise(noise, 5)
    node_us = 1e6 / (16 * 37.0 * most_bandwidth(noise))
    values = [np.array(band.start(0))]
    for k in range(1, 3000):
        value = np.array(band.at(k * node_us))
        if k % 2 == 0:
            values.append(value)
    values = np.array(values)
    own = np.mean(values[1:] * values[:-1], axis=0) / np.mean(values**2, axis=0)
    at = 2 * np.pi * 37.0 * bandwidth_map(noise) / np.sqrt(np.sqrt(2) - 1) * 2 * node_us * 1e-6
    expected = (1 + at) * np.exp(-at)
    for part in np.array_split(np.argsort(at), 6):
        assert own[part].mean() == pytest.approx(expected[part].mean(), abs=0.004)
    # on the average over time the noise is 1: at nodes it is a little more, as lines between them have less
    more = 3 / (2 + (1 + at / 2) * np.exp(-at / 2))
    assert np.mean(values**2 / more) == pytest.approx(1.0, abs=0.02)


@pytest.mark.slow
def test_rates_follow_the_bandwidth_from_the_first_moment_on():
    """Events of a class of pixels over its bandwidth are equal, and the first second has as many as later ones."""
    spec = spec_of()
    noise = noise_of(spec)
    stage, light = EvsStage(noise, 9), jit().Float(np.full(ROWS * COLS, 0.4, np.float32))
    stage.step(light, 0)
    counts = []
    for k in range(1, 7):
        events = stage.step(light, k * 1_000_000)
        counts.append(np.bincount(events["y"].astype(int) * COLS + events["x"], minlength=ROWS * COLS))
    counts = np.array(counts, float)
    order = np.argsort(bandwidth_map(noise))
    relative = [counts[:, part].sum() / bandwidth_map(noise)[part].sum() for part in np.array_split(order, 4)]
    assert np.std(relative) < 0.03 * np.mean(relative)
    assert counts[0].sum() == pytest.approx(counts[1:].sum(axis=1).mean(), rel=0.04)


def test_what_does_not_go_together_is_refused():
    with pytest.raises(SpecError, match="noise_spread belongs to reference 'last_event'"):
        read_sensor("reference-mono", {"evs.noise_spread": SPREAD})
    with pytest.raises(SpecError, match="both set bandwidths"):
        spec_of(**{"evs.photoreceptor": {
            "cutoff_hz": 90.0, "signal_dn": 2.0, "min_cutoff_hz": 3.0, "filters_noise": True,
        }})  # fmt: skip
