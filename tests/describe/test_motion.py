"""The picture of what moves: trails with their speed, and the density of events, on the pixels' own grids."""

from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.collections import LineCollection

from hesim_render.core import drawing
from hesim_render.describe import motion
from hesim_render.sources.render.truth.motion_look import EventForecast, MotionLook


@pytest.mark.parametrize("has_events", [True, False])
def test_trails_and_densities_are_drawn_side_by_side(has_events, tmp_path, monkeypatch):
    """Speed of each piece of a trail is its length over 20 ms; pieces with an end that is not seen are left out."""
    rng, drawn = np.random.default_rng(4), []
    monkeypatch.setattr(motion, "new_figure", lambda size: drawn.append(drawing.new_figure(size)) or drawn[-1])
    trails = rng.uniform(0, 30, (6, 5, 2))
    trails[2, 3], trails[4] = np.nan, trails[4, :1]
    density = rng.exponential(40.0, (7, 9)) * (rng.random((7, 9)) < 0.6)
    events = EventForecast(density, 3, np.array([310.0, 90.0])) if has_events else None
    picture = rng.random((10, 12, 3)).astype(np.float32)
    look = MotionLook(picture, 4, 20_000.0 * np.arange(5), trails, np.zeros(6), 0.5, events)
    sensor = SimpleNamespace(layout=SimpleNamespace(shape=(40, 48), evs_shape=(21, 27)))
    motion.write_motion(look, sensor, 30_000.0, tmp_path / "m.png")
    assert (tmp_path / "m.png").stat().st_size > 1_000
    (figure,) = drawn
    axes = figure.axes
    # pixels of 40 rows and 48 columns are square where 130 of 560 px are the bar and 60 px title and labels
    assert figure.get_size_inches() * 72 == pytest.approx([560 * (1 + has_events), 430 * 40 // 48 + 60])
    grid = axes[0].get_subplotspec().get_gridspec()
    assert (grid.nrows, grid.ncols) == (1, 1 + has_events) and len(
        [a for a in axes if a.get_subplotspec()]
    ) == grid.ncols
    lines = next(each for each in axes[0].collections if isinstance(each, LineCollection))
    pieces, speed = [], []
    for trail in trails:
        for first, second in zip(trail[:-1], trail[1:], strict=True):
            if np.isfinite([first, second]).all():
                pieces.append([first, second])
                speed.append(np.hypot(*(second - first)) / 0.02)
    np.testing.assert_allclose(lines.get_segments(), pieces)
    np.testing.assert_allclose(lines.get_array(), speed)
    assert lines.get_clim() == pytest.approx((0, np.quantile(speed, 0.98)))
    assert axes[0].get_xlim() == (-0.5, 47.5) and axes[0].get_ylim() == (39.5, -0.5)
    titles = [each.get_title(loc="left") + each.get_title() for each in axes]
    assert "0.03 s" in titles[0] and "0.08 s" in titles[0]
    if has_events:
        image = axes[1].images[0]
        np.testing.assert_allclose(image.get_array().filled(0), density)
        assert image.get_extent() == [-0.5, 26.5, 20.5, -0.5]
        assert image.norm.vmax == density.max() and image.norm.vmin == pytest.approx(max(density.max() / 1000, 0.01))
        assert "200/s" in titles[1]
