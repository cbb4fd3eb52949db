"""Book-keeping of change-driven rendering: halved intervals, straight lines between what was rendered, neighbours."""

import numpy as np
import pytest

from hesim_render.renderer.neighbours import Neighbours
from hesim_render.renderer.refinement import BYTES_PER_PAIR, _Chunk, chunk_length, nearest
from hesim_render.renderer.sketch import Gaps, halvings


@pytest.mark.parametrize("last", [1, 2, 3, 7, 20, 32])
def test_halving_meets_every_window_between_the_ends_once(last):
    middles = [middle for level in halvings(last) for _, middle, _ in level]
    assert sorted(middles) == list(range(1, last))
    known = {0, last}
    for level in halvings(last):
        assert all(low in known and high in known for low, _, high in level)
        known |= {middle for _, middle, _ in level}


def test_nearest_against_a_search():
    there = np.random.default_rng(1).random((33, 50)) < 0.2
    before, after = nearest(there)
    for window in range(33):
        for column in range(50):
            marked = np.flatnonzero(there[:, column])
            earlier, later = marked[marked <= window], marked[marked >= window]
            assert before[window, column] == (earlier[-1] if earlier.size else -1)
            assert after[window, column] == (later[0] if later.size else 33)


def test_what_was_not_rendered_is_interpolated_in_time():
    """Against numpy.interp, pixel by pixel, with windows that are not evenly spaced."""
    rng = np.random.default_rng(2)
    centre_us = np.cumsum(rng.uniform(500, 2000, 33))
    truth = rng.uniform(1e5, 1e6, (2, 33, 40)).astype(np.float32)
    rendered = rng.random((33, 40)) < 0.3
    rendered[0] = True
    halves = truth.copy()
    halves[:, ~rendered] = np.nan
    halves[:, -1] = truth[:, -1]  # the last window is always there, rendered or as it was
    chunk = _Chunk(0, halves[0], halves[1], rendered)
    chunk.fill(centre_us)
    for half, known in zip((chunk.half_a, chunk.half_b), truth, strict=True):
        for column in range(40):
            marks = np.union1d(np.flatnonzero(rendered[:, column]), [0, 32])
            wanted = np.interp(centre_us, centre_us[marks], known[marks, column])
            np.testing.assert_allclose(half[:, column], wanted, rtol=1e-5)


def test_gaps_are_split_into_both_parts():
    gaps = Gaps(np.array([4, 9]), np.array([0, 2]), np.array([8, 6]))
    place, low, high = gaps.split(np.array([3, 4]))
    assert list(zip(place.tolist(), low.tolist(), high.tolist(), strict=True)) == [
        (4, 0, 3),
        (9, 2, 4),
        (4, 3, 8),
        (9, 4, 6),
    ]


def test_chunks_keep_to_their_memory():
    assert chunk_length(90_000) == 32
    assert chunk_length(3264 * 2448 // 4) * 3264 * 2448 // 4 * BYTES_PER_PAIR < 2**30
    assert chunk_length(3264 * 2448) == 4  # never less


def test_neighbours_on_the_map_of_listed_pixels():
    """Every fourth pixel in both directions: neighbours are four pixels apart."""
    rows, cols = np.mgrid[0:32:4, 0:48:4]
    pixel = (rows * 48 + cols).ravel()
    near = Neighbours(pixel, (32, 48))
    assert near.cell_px == 4
    values = np.zeros((8, 12))
    values[3, 5] = 9.0
    mean, most = near.mean(values.ravel()).reshape(8, 12), near.most(values.ravel(), 2).reshape(8, 12)
    assert np.count_nonzero(mean) == 9 and mean[2, 4] == pytest.approx(1.0)
    assert np.count_nonzero(most) == 25 and most[1, 3] == 9
    values[:] = 1.0
    np.testing.assert_allclose(near.mean(values.ravel()), 1.0)  # at the border too


def test_pixels_inside_an_outline():
    near = Neighbours(np.arange(20 * 30), (20, 30))
    corners = np.array([[5.0, 4.0], [15.0, 4.0], [15.0, 10.0], [5.0, 10.0]])  # column, row
    inside = near.inside([corners]).reshape(20, 30)
    row, col = np.nonzero(inside)
    # all of it, and at most a pixel and a half around
    assert inside[4:10, 5:15].all()
    assert row.min() >= 2 and row.max() <= 11 and col.min() >= 3 and col.max() <= 16
