"""Edges that are followed from window to window, against lines whose course is known."""

from types import SimpleNamespace

import numpy as np
import pytest

from hesim_render.sources.render.change_driven import edge_courses
from hesim_render.sources.render.change_driven.edge_courses import Courses, courses, fitted_windows
from hesim_render.sources.render.change_driven.edge_share import halfplane_share
from hesim_render.sources.render.change_driven.edges import EdgeFit
from hesim_render.sources.render.change_driven.estimates import Flux

#: Middles of windows, unevenly spaced, µs.
CENTRE = np.cumsum(np.array([130.0, 110, 125, 118, 122, 131, 119, 127, 121, 124, 116, 129, 123]))
#: Levels of the two pixels, e⁻/s, and the wanted error.
LOW, HIGH, WANTED = np.array([310.0, 120.0]), np.array([2700.0, 950.0]), np.array([9.0, 3.5])


def line(time_us, pixel):
    """Direction, rad, and offset, px, of the line in a pixel at some times: both turn and move evenly."""
    part = (np.asarray(time_us) - CENTRE[0]) / (CENTRE[-1] - CENTRE[0])
    return (0.6 + 0.07 * part, -0.52 + 0.95 * part) if pixel == 0 else (2.2 - 0.05 * part, 0.4 - 0.75 * part)


def flux(pixel):
    angle, offset = line(CENTRE, pixel)
    return LOW[pixel] + (HIGH[pixel] - LOW[pixel]) * halfplane_share(np.cos(angle), np.sin(angle), offset)


def fits(window, pixel, **changed):
    """Fits of the true lines, [k]."""
    angle, offset = (
        np.array(v) for v in zip(*(line(CENTRE[w], p) for w, p in zip(window, pixel, strict=True)), strict=True)
    )
    count = len(window)
    fit = EdgeFit(*(np.asarray(v, np.float32) for v in (
        np.cos(angle), np.sin(angle), offset, np.zeros(count), np.full(count, 0.004), LOW[pixel], HIGH[pixel],
        np.zeros(count), np.full(count, 20), np.full(count, 128),
    )))  # fmt: skip
    for name, values in changed.items():
        getattr(fit, name)[:] = values
    return fit


PILOT = np.stack([flux(0), flux(1)], axis=1).astype(np.float32)


def course(window=(1, 6, 11, 2, 10), pixel=(0, 0, 0, 1, 1), pilot=PILOT, barred=None, footprint=1.0, **changed):
    window, pixel = np.array(window), np.array(pixel)
    barred = np.zeros(PILOT.shape, np.bool_) if barred is None else barred
    return courses(window, pixel, fits(window, pixel, **changed), pilot, footprint, WANTED[pixel], CENTRE, barred)


def test_windows_between_two_fits_have_the_flux_of_the_line():
    found = course()
    pairs = set(zip(found.window.tolist(), found.pixel.tolist(), strict=True))
    assert pairs == {(w, 0) for w in (2, 3, 4, 5, 7, 8, 9, 10)} | {(w, 1) for w in range(3, 10)}
    values = Flux(*(np.zeros(PILOT.shape, np.float32) for _ in range(3)))
    ends = ([1, 6, 11, 2, 10], [0, 0, 0, 1, 1])
    # both halves are off by a part that is the same at both ends, and by errors of their own
    for half, wrong in ((values.half_a, 11.0), (values.half_b, -4.0)):
        half[ends] = PILOT[ends] + wrong
    values.error[ends] = [2.0, 4.0, 8.0, 3.0, 5.0]
    found.fill(values, CENTRE)
    for half, wrong in ((values.half_a, 11.0), (values.half_b, -4.0)):
        np.testing.assert_allclose(half[found.window, found.pixel] - wrong, PILOT[found.window, found.pixel], atol=1.5)
    # a straight line between both ends is far off
    part = (CENTRE[3] - CENTRE[1]) / (CENTRE[6] - CENTRE[1])
    assert abs(PILOT[1, 0] + part * (PILOT[6, 0] - PILOT[1, 0]) - PILOT[3, 0]) > 80
    between = 2 + 2 * (CENTRE[3] - CENTRE[1]) / (CENTRE[6] - CENTRE[1])
    assert values.error[3, 0] == pytest.approx(between, rel=1e-6)
    assert np.count_nonzero(values.half_a) == len(pairs) + 5


def test_an_interpolated_flux_is_not_negative():
    found = Courses(*(np.array([v]) for v in (1, 0, 0, 2)), np.array([-50.0], np.float32))
    values = Flux(*(np.full((3, 1), 20.0, np.float32) for _ in range(3)))
    found.fill(values, CENTRE[:3])
    assert values.half_a[1, 0] == values.half_b[1, 0] == 0 and values.error[1, 0] == 20


@pytest.mark.parametrize(("changed", "left"), [
    ({"low": [310, 310, 310 + 0.06 * 2390, 120, 120]}, {(1, 6), (2, 10)}),
    ({"high": [2700, 2700, 2700 - 0.06 * 2390, 950, 950]}, {(1, 6), (2, 10)}),
    ({"fewer": [20, 1, 20, 20, 20]}, {(2, 10)}),
    ({"gap": [0.004, 0.004, 0.004, 0.4, 0.4]}, {(1, 6), (6, 11)}),
    ({"scatter": [0, 0, 0, 0, 40]}, {(1, 6), (6, 11)}),
])  # fmt: skip
def test_fits_of_other_edges_are_not_joined(changed, left):
    found = course(**changed)
    assert set(zip(found.before.tolist(), found.after.tolist(), strict=True)) == left


def test_an_edge_that_turns_too_far_or_faces_the_other_way_is_another_one():
    angle, _ = line(CENTRE[11], 0)
    for turn, is_same in ((0.05, True), (0.12, False), (np.pi, False), (2 * np.pi, True)):
        fit = fits(np.array([1, 6, 11]), np.zeros(3, np.int64))
        fit.normal_x[2], fit.normal_y[2] = np.cos(angle + turn), np.sin(angle + turn)
        found = course((1, 6, 11), (0, 0, 0), normal_x=fit.normal_x, normal_y=fit.normal_y, pilot=PILOT)
        assert (11 in found.after) == is_same


def test_nothing_is_followed_where_the_pilot_sees_something_else_or_is_barred():
    pilot = PILOT.copy()
    pilot[8, 0] += 0.19 * 2390
    assert set(course(pilot=pilot).after.tolist()) == {6, 11, 10}
    pilot[8, 0] += 0.02 * 2390
    assert set(course(pilot=pilot).after.tolist()) == {6, 10}
    barred = np.zeros(PILOT.shape, np.bool_)
    barred[4, 1] = True
    assert set(course(barred=barred).after.tolist()) == {6, 11}


def test_the_pilot_sees_the_share_of_its_own_area():
    wide = np.empty_like(PILOT)
    for pixel in (0, 1):
        angle, offset = line(CENTRE, pixel)
        share = halfplane_share(np.cos(angle), np.sin(angle), offset / 3.0)
        wide[:, pixel] = LOW[pixel] + (HIGH[pixel] - LOW[pixel]) * share
    assert course(pilot=wide, footprint=3.0).window.size == 15
    assert course(pilot=wide, footprint=1.0).window.size < 15


def test_windows_next_to_each_other_have_nothing_between_them():
    assert course((4, 5), (0, 0)).window.size == 0


def test_every_fourth_window_of_a_stretch_is_fitted(monkeypatch):
    monkeypatch.setattr(edge_courses, "_FAR", 5)
    worth = np.zeros((24, 3), np.bool_)
    worth[[2, 3, 5, 6, 8, 9, 10, 17, 18, 20], 0] = True
    worth[[0, 23], 1] = True
    fitted = fitted_windows(worth)
    assert np.flatnonzero(fitted[:, 0]).tolist() == [2, 8, 10, 17, 20]
    assert np.flatnonzero(fitted[:, 1]).tolist() == [0, 23]
    assert not fitted[:, 2].any()


@pytest.mark.parametrize(("offsets", "is_followed"), [((-0.31, 0.27), True), ((-0.31, 0.56), False)])
def test_wide_gaps_matter_where_the_share_bends(offsets, is_followed):
    """A line along columns: its share is straight while it is inside of the pixel, and bends where it leaves."""
    window, pixel = np.array([2, 7]), np.array([0, 0])
    fit = fits(window, pixel, gap=0.03, normal_x=1, normal_y=0, offset=offsets)
    pilot = np.full(PILOT.shape, np.nan, np.float32)
    part = (CENTRE[2:8] - CENTRE[2]) / (CENTRE[7] - CENTRE[2])
    share = np.minimum(0.5 + offsets[0] + part * (offsets[1] - offsets[0]), 1)
    pilot[2:8, 0] = LOW[0] + (HIGH[0] - LOW[0]) * share
    found = courses(window, pixel, fit, pilot, 1.0, WANTED[pixel], CENTRE, np.zeros(PILOT.shape, np.bool_))
    assert found.window.tolist() == ([3, 4, 5, 6] if is_followed else [])


def test_directions_are_joined_across_half_a_turn():
    angle = np.array([np.pi - 0.03, np.pi + 0.04])
    window, pixel = np.array([2, 7]), np.array([0, 0])
    fit = fits(window, pixel, normal_x=np.cos(angle), normal_y=np.sin(angle), offset=[-0.2, 0.3])
    part = (CENTRE - CENTRE[2]) / (CENTRE[7] - CENTRE[2])
    middle = angle[0] + part * (angle[1] - angle[0])
    share = halfplane_share(np.cos(middle), np.sin(middle), -0.2 + 0.5 * part)
    pilot = np.stack([LOW[0] + (HIGH[0] - LOW[0]) * share] * 2, axis=1).astype(np.float32)
    found = courses(window, pixel, fit, pilot, 1.0, WANTED[pixel], CENTRE, np.zeros(PILOT.shape, np.bool_))
    assert found.window.tolist() == [3, 4, 5, 6]
    chord = pilot[2, 0] + part * (pilot[7, 0] - pilot[2, 0])
    np.testing.assert_allclose(found.model, (pilot[:, 0] - chord)[3:7], atol=2.0)


def test_the_share_of_a_pixel_changes_as_a_line_between_two_moves():
    """Upright lines at 0.1 and 0.7 px of a pixel's middle: 1/px at their mean, 0.4 px; and lines at 30 and 90°."""
    x, y = np.array([1.0, 1.0, np.cos(np.pi / 6), 0.0]), np.array([0.0, 0.0, 0.5, 1.0])
    offset = np.array([0.1, 0.7, 0.25, 0.05])
    fit = SimpleNamespace(normal_x=x, normal_y=y, offset=offset)
    alone = edge_courses._slope(fit, np.arange(4))
    np.testing.assert_allclose(alone[[0, 1, 3]], [1, 0, 1], atol=1e-9)
    first, second = np.array([0, 2, 1]), np.array([1, 3, 1])
    found = edge_courses._slope(fit, first, second)
    share = lambda at: halfplane_share(np.cos(np.pi / 3), np.sin(np.pi / 3), 0.15 + at)  # noqa: E731
    np.testing.assert_allclose(found, [1, (share(0.01) - share(-0.01)) / 0.02, 0], atol=1e-9)
