"""The courses of edges: lines that move through a pixel, from a few windows in which they are fitted.

While one straight edge crosses a pixel, the flux follows the share of the pixel on either side of it. Lines are fitted
to decision rays in some of the windows in which the pilot changes. Where two successive ones have the same edge, its
line between them is interpolated, and the flux of a window between them is

    Φ̂(w) = g(w) + interpolation of (Φ̂ − g) between both windows,

with g the mean of the model over the pixel. Windows between them are not rendered. The model's own errors are those of
both ends, so only what bends between them remains.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.sources.render.change_driven.edge_share import halfplane_share
from hesim_render.sources.render.change_driven.edges import EdgeFit
from hesim_render.sources.render.change_driven.estimates import Flux

#: A line is fitted in every so many of the windows in which a pixel changes, and where the next ones are farther.
_STRIDE, _FAR = 4, 16
#: Largest number of windows between two fits, difference of their directions, rad, and of their levels over the
#: contrast, of one edge.
_LONGEST, _TURN, _LEVEL = 64, 0.1, 0.05
#: Largest difference of the pilot's flux from that of the model, over the contrast: its rays are few.
_PILOT = 0.2
#: Largest error of a window between two fits that the width of their gaps may cause, in wanted errors.
_BEND = 1.0


def fitted_windows(worth: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Windows in which lines are fitted, [window, pixel], of those in which they would pay.

    Every `_STRIDE`-th one of a pixel, and both ends of what is not farther than `_FAR` windows apart.
    """
    fitted = np.zeros(worth.shape, np.bool_)
    pixels = np.arange(worth.shape[1])
    # of each pixel: the last window in which a fit would pay, and its number in the run of such windows
    last, rank = np.full(pixels.size, -_FAR - 1), np.zeros(pixels.size, np.int64)
    for window, here in enumerate(worth):
        # a run of windows begins where the last one is far; the run before it, if there was one, ends with a fit
        starts = here & (window - last > _FAR)
        ends = starts & (last >= 0)
        fitted[last[ends], pixels[ends]] = True
        rank = np.where(starts, 0, rank + here)
        fitted[window] = here & (rank % _STRIDE == 0)
        last[here] = window
    # the last run of each pixel ends with its last window
    some = last >= 0
    fitted[last[some], pixels[some]] = True
    return fitted


@dataclass(frozen=True)
class Courses:
    """Windows of pixels between two fits of the same edge, arrays [n].

    Parameters
    ----------
    window, pixel : which pair.
    before, after : windows of both fits.
    model : mean of the model over the pixel, less the interpolation of that in both windows, e⁻/s.
    """

    window: NDArray[np.int64]
    pixel: NDArray[np.int64]
    before: NDArray[np.int64]
    after: NDArray[np.int64]
    model: NDArray[np.float32]

    @classmethod
    def none(cls) -> "Courses":
        """No windows."""
        nothing = np.empty(0, np.int64)
        return cls(nothing, nothing, nothing, nothing, np.empty(0, np.float32))

    def fill(self, flux: Flux, centre_us: NDArray[np.float64]) -> None:
        """Put the flux of these windows into `flux` [window, pixel], from that of the windows of both fits."""
        part = _part(self.window, self.before, self.after, centre_us).astype(np.float32)
        nothing = np.zeros_like(self.model)
        for values, model in zip(flux.arrays, (self.model, self.model, nothing), strict=True):
            begin, end = values[self.before, self.pixel], values[self.after, self.pixel]
            # of fluxes near 0, an interpolation may be below it
            values[self.window, self.pixel] = np.maximum(begin + part * (end - begin) + model, 0)


def courses(
    window: NDArray[np.int64],
    pixel: NDArray[np.int64],
    fit: EdgeFit,
    pilot: NDArray[np.float32],
    footprint_px: float,
    wanted: NDArray[np.float32],
    centre_us: NDArray[np.float64],
    barred: NDArray[np.bool_],
) -> Courses:
    """Windows between successive fits of the same edge in a pixel.

    Parameters
    ----------
    window, pixel : [k], of each fit.
    fit : the fits; fluxes as those of the pilot, e⁻/s.
    pilot : [window, pixel], flux of the pilot.
    footprint_px : width of the area in which the pilot's rays start, px.
    wanted : [k], wanted error of each pair, e⁻/s.
    centre_us : [window], middles of the windows, µs.
    barred : [window, pixel], pairs over which no edge is followed.
    """
    # neighbours in time: both fits of a pixel, one after the other
    # [k], by pixel, then by window
    order = np.lexsort((window, pixel))
    first, second = order[:-1], order[1:]
    # [pairs of fits]
    both = (pixel[first] == pixel[second]) & (window[second] - window[first] <= _LONGEST)
    both &= fit.is_edge[first] & fit.is_edge[second]
    first, second = first[both], second[both]
    # one edge: nearly the same direction and levels on both sides
    # of the weaker of both fits, e⁻/s
    contrast = np.minimum(fit.high[first] - fit.low[first], fit.high[second] - fit.low[second])
    turn = _angle(fit, second) - _angle(fit, first)
    # the shorter way round
    turn -= 2 * np.pi * np.rint(turn / (2 * np.pi))
    same = np.abs(turn) <= _TURN
    for level in (fit.low, fit.high):
        same &= np.abs(level[second] - level[first]) <= _LEVEL * contrast
    # what the gaps leave open is the same at both ends, but for the bend of the share between them
    slopes = np.stack([_slope(fit, first), _slope(fit, second), _slope(fit, first, second)])
    # half of the mean width of both gaps, px: the line may lie anywhere in its gap
    gaps = 0.25 * (fit.gap[first] + fit.gap[second])
    same &= contrast * gaps * np.ptp(slopes, axis=0) <= _BEND * np.minimum(wanted[first], wanted[second])
    first, second, turn = first[same], second[same], turn[same]
    if first.size == 0:
        return Courses.none()
    # every window between both
    count = window[second] - window[first] - 1
    # [windows between]: number of the pair of fits, and place of the window between both
    segment = np.repeat(np.arange(first.size), count)
    within = np.arange(segment.size) - np.repeat(np.cumsum(count) - count, count)
    one, other = first[segment], second[segment]
    now = window[one] + 1 + within
    part = _part(now, window[one], window[other], centre_us)
    # directions are interpolated as angles, since a mean of normals would turn unevenly
    angle = _angle(fit, one) + part * turn[segment]
    normal = np.cos(angle), np.sin(angle)

    def between(values: NDArray[np.floating]) -> NDArray[np.float64]:
        return values[one] + part * (values[other].astype(np.float64) - values[one])

    offset, dark, bright = between(fit.offset), between(fit.low), between(fit.high)
    # something else may pass between both fits: the pilot's few rays must see the same edge
    seen = dark + (bright - dark) * halfplane_share(*normal, offset / footprint_px)
    differs = np.abs(pilot[now, pixel[one]] - seen) > _PILOT * (bright - dark)
    differs |= barred[now, pixel[one]]
    # one window that differs ends the whole segment: the edge is not the same all along
    fails = np.bincount(segment, differs, minlength=first.size) > 0
    keep = ~fails[segment]
    share = dark + (bright - dark) * halfplane_share(*normal, offset)
    # the same model in both windows of fits, of which the interpolation is subtracted
    ends = [
        fit.low[k] + (fit.high[k] - fit.low[k]) * halfplane_share(fit.normal_x[k], fit.normal_y[k], fit.offset[k])
        for k in (one, other)
    ]
    model = share - (ends[0] + part * (ends[1] - ends[0]))
    columns = now, pixel[one], window[one], window[other], model.astype(np.float32)
    return Courses(*(values[keep] for values in columns))


def _angle(fit: EdgeFit, which: NDArray[np.int64]) -> NDArray[np.float64]:
    """Direction of normals, rad."""
    return np.arctan2(fit.normal_y[which].astype(np.float64), fit.normal_x[which])


def _slope(fit: EdgeFit, which: NDArray[np.int64], other: NDArray[np.int64] | None = None) -> NDArray[np.float64]:
    """Change of the share above a line with its offset, 1/px; half way between two lines where two are given."""
    x, y, offset = (values[which].astype(np.float64) for values in (fit.normal_x, fit.normal_y, fit.offset))
    if other is not None:
        others = fit.normal_x[other], fit.normal_y[other], fit.offset[other]
        x, y, offset = (0.5 * (a + b) for a, b in zip((x, y, offset), others, strict=True))
        # a mean of two unit normals is shorter than one
        length = np.maximum(np.hypot(x, y), 1e-6)
        x, y = x / length, y / length
    step = 0.01
    return (halfplane_share(x, y, offset + step) - halfplane_share(x, y, offset - step)) / (2 * step)


def _part(
    window: NDArray[np.int64], before: NDArray[np.int64], after: NDArray[np.int64], centre_us: NDArray[np.float64]
) -> NDArray[np.float64]:
    """How far the middle of a window is on the way between two others."""
    return (centre_us[window] - centre_us[before]) / (centre_us[after] - centre_us[before])
