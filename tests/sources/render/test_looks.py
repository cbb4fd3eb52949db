"""Windows in which an asynchronous pixel is looked at, beside one that changes: by the distance of the looks."""

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.looks import Looks
from hesim_render.sources.render.change_driven.neighbours import Lattice, Sites
from hesim_render.sources.render.change_driven.pair_flux import PilotFlux

#: Nine rows of 17 pixels; that in the middle gets brighter from window to window, all others rest.
ROWS, COLS, ROW, COL = 9, 17, 4, 7


def looked_windows(margin_px, stride=16, last=16, turns_back=False):
    """[window, row, col], True where a site was looked at after the last window."""
    sites = Sites.around(np.arange(ROWS * COLS, dtype=np.uint32), Lattice.whole(ROWS, COLS))
    middle = int(np.flatnonzero(sites.index == ROW * COLS + COL)[0])
    taken = np.zeros((last + 1, sites.size), np.bool_)

    def show(window, place):
        assert not taken[window, place].any() and (window > 0).all()
        taken[window, place] = True
        out = PilotFlux.empty(place.size)
        out.controlled[:] = out.plain[:] = 530.0
        time = np.minimum(window, last - window) if turns_back else window
        out.plain[place == middle] += 41.0 * time[place == middle]
        out.controlled_scatter[:] = 3.5
        return out

    first = PilotFlux.empty(sites.size)
    first.controlled[:] = first.plain[:] = 530.0
    first.controlled_scatter[:] = 3.5
    looks = Looks(first, last + 1, np.ones(sites.size, np.bool_), show)
    looks.at_end()
    taken[:] = False
    looks.every(stride, sites, lambda flux: np.full(flux.shape, 17.0, np.float32), margin_px)
    out = np.zeros((last + 1, ROWS * COLS), np.bool_)
    out[:, sites.index] = taken
    return out.reshape(-1, ROWS, COLS), looks.tables["plain"][:, middle]


@pytest.mark.parametrize(("margin_px", "beside"), [
    (0.125, {4, 8, 12}), (0.1, {4, 8, 12}), (0.375, {8}), (0.21, {8}), (0.06, {2, 4, 6, 8, 10, 12, 14}),
    (0.04, set(range(1, 16))),
])  # fmt: skip
def test_pixels_beside_a_change_are_looked_at_while_it_could_come_and_go_between_two_looks(margin_px, beside):
    """By 0.05 px a window: between looks eight windows apart something comes 0.2 px nearer at most, and goes again."""
    taken, flux = looked_windows(margin_px)
    windows = {(row, col): set(np.flatnonzero(taken[:, row, col])) for row in range(ROWS) for col in range(COLS)}
    assert windows[ROW, COL] == set(range(1, 16))
    np.testing.assert_allclose(flux, 530 + 41.0 * np.arange(17))
    for (row, col), own in windows.items():
        far = max(abs(row - ROW), abs(col - COL))
        expected = beside if far == 1 else {8} if far == 2 else set()
        if far:
            assert own == expected, (row, col)


def test_what_changes_by_less_than_its_wanted_error_is_not_looked_at_between():
    """A ramp of 82 between looks at both ends of two windows; up and down again it is the same at both ends."""
    taken, flux = looked_windows(0.125, turns_back=True)
    assert not taken.any()
    np.testing.assert_allclose(flux, 530)
    taken, _ = looked_windows(0.125, stride=8, turns_back=True)
    assert set(np.flatnonzero(taken[:, ROW, COL])) == set(range(1, 16))


def test_looks_go_as_far_beyond_their_pixel_as_the_pilot_does(monkeypatch):
    """An eighth of a pixel; what a look costs follows from it."""
    margins, every = [], Looks.every

    def noted(self, stride, sites, wanted, margin_px):
        margins.append(margin_px)
        every(self, stride, sites, wanted, margin_px)

    monkeypatch.setattr(Looks, "every", noted)
    source = ChangeDrivenFlux(hr.load_scene("rotating-star"), hr.load_sensor("davis346").crop(14, 11, 160, 120), seed=3)
    pixel = source.sensor.layout.evs_pixel.ravel()
    for _ in source.flux_of_blocks(pixel, list(source.sample_blocks(1, 0, 2000))):
        pass
    assert set(margins) == {0.125}
