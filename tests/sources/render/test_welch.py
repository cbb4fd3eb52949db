"""Default and exact mode are two estimators of one flux: Welch's test of tiles, over random scenes.

None of the scenes was used to choose any constant.
"""

import numpy as np
import pytest
from random_scenes import DURATION_US, random_scene
from scipy import stats

from hesim_render.capture.loop import Capture
from hesim_render.capture.run_settings import TERMS, noise_models
from hesim_render.mosaic.schedule import Block
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.exact import RenderedFlux
from hesim_render.sources.render.renderer import flickering

SEEDS, REPEATS, COLS, ROWS = range(3000, 3020), 6, 16, 12
#: Parts of each side into which the region is divided: tiles of 4 by 4 event pixels of a monochrome sensor.
TILES = 4, 3


def runs(random, make, pixels, blocks, windows):
    """Flux of event pixels in some of the windows, by as many seeds, [repeat, window, pixel]."""
    result = []
    for repeat in range(REPEATS):
        source = flickering(random.scene, lambda part, light, n=repeat: make(part, light, n), 1.0)
        samples = [np.array(s.half_a) + np.array(s.half_b) for s in source.flux_of_blocks(pixels, iter(blocks))]
        result.append(0.5 * np.array(samples, np.float64)[windows])
    return np.array(result)


def p_values(seed, folder):
    """p of each tile and window in which either mode has any scatter."""
    random = random_scene(seed, folder, COLS, ROWS)

    def default(part, light, repeat):
        return ChangeDrivenFlux(part, random.sensor, seed=100 * seed + repeat, light=light)

    def exact(part, _, repeat):
        return RenderedFlux(part, random.sensor, 64, 100 * seed + repeat, max_motion_px=0.03)

    source = flickering(random.scene, lambda part, light: default(part, light, 0), 1.0)
    noise = noise_models(random.sensor, False, (), TERMS)
    capture = Capture(source, source.sensor, *noise, DURATION_US, seed)
    blocks = capture.sample_of_event_blocks().blocks[:1]
    times = np.stack([blocks[0].begin_us, blocks[0].end_us], axis=1)[blocks[0].wanted]
    chosen = np.unique([len(times) // 3, len(times) - 1])
    own = runs(random, default, capture.event_pixels, blocks, chosen)
    windows = [Block(*times[[k]].T, np.ones(1, np.bool_)) for k in chosen]
    other = runs(random, exact, capture.event_pixels, windows, slice(None))
    rows, cols = random.sensor.layout.evs_shape
    result = []
    for down in np.array_split(np.arange(rows), TILES[1]):
        for across in np.array_split(np.arange(cols), TILES[0]):
            tile = (down[:, None] * cols + across).ravel()
            one, two = own[..., tile].sum(axis=-1), other[..., tile].sum(axis=-1)
            for a, b in zip(one.T, two.T, strict=True):
                if max(a.std(), b.std()) > 1e-5 * abs(a.mean()):
                    result.append(stats.ttest_ind(a, b, equal_var=False).pvalue)
    return result


@pytest.mark.slow
def test_default_and_exact_mode_have_one_mean(tmp_path):
    """p is uniform, up to what six repeats that are not normal allow; no tile is far off."""
    values = [p_values(seed, tmp_path) for seed in SEEDS]
    p = np.concatenate([one for one in values if one])
    assert sum(bool(one) for one in values) >= 12 and p.size > 150
    assert stats.kstest(p, "uniform").pvalue > 1e-3
    assert p.min() > 1e-4 / p.size
