"""Edges: a straight line through a pixel that separates two levels of flux, and rays about it.

A pixel with a sharp edge needs thousands of uniform rays, because each says no more than the side of the edge that it
meets. If a line is known near the edge, the mean over the pixel is that of the two levels, in closed form, plus that of
the difference between the scene and these levels, which is zero nearly everywhere away from the line. Half of the rays
of such a pair start uniformly, half of them in a strip about the line. They are combined by the balance heuristic
[veach1997], so the estimate is unbiased for any line and any levels: a wrong model costs rays, not truth.

The line is fitted to *decision rays*, which are never part of the picture: the straight line with the largest distance
from all of them, if there is one that separates those above the middle of their range from those below it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Mask, UInt32
from hesim_render.core.host_arrays import spread_out
from hesim_render.sources.render.change_driven.edge_search import widest_gap, widest_moving_gap
from hesim_render.sources.render.change_driven.edge_share import LEAST_SPEED, moving_share

#: Half width of a strip beyond the gap that the decision rays leave, px: of edges that are not quite straight.
_SLACK_PX = 0.004
#: Largest scatter about the levels of both sides, over their difference: three levels, or a corner, scatter more.
_MOST_UNEVEN = 0.02
#: Least number of decision rays on either side of a line.
_LEAST_ON_A_SIDE = 2


@dataclass(frozen=True)
class PairEdges:
    """Models of listed pairs, arrays [n]: flux is `high` where normal · place + offset > 0, and `low` elsewhere.

    Parameters
    ----------
    normal_x, normal_y : unit vector towards the side of the higher flux, in columns and rows.
    offset : of the centre of the pixel from the line in the middle of the window, px.
    half_width : of the strip about the line, px.
    low, high : levels, e⁻/s on the optical axis.
    speed : of the line against its normal, px per window: the offset grows by it from begin to end.
    """

    normal_x: NDArray[np.float32]
    normal_y: NDArray[np.float32]
    offset: NDArray[np.float32]
    half_width: NDArray[np.float32]
    low: NDArray[np.float32]
    high: NDArray[np.float32]
    speed: NDArray[np.float32]

    @classmethod
    def at(cls, count: int, place: NDArray[np.int64], models: "PairEdges") -> "PairEdges":
        """Models of `count` pairs, of which those at some places have one."""
        padded = cls(*(np.zeros(count, np.float32) for _ in fields(cls)))
        for values, own in zip(astuple_of(padded), astuple_of(models), strict=True):
            values[place] = own
        return padded

    def part(self, part: slice | NDArray) -> "PairEdges":
        """Those of some pairs."""
        return PairEdges(*(values[part] for values in astuple_of(self)))

    @property
    def is_there(self) -> NDArray[np.bool_]:
        """Pairs that have a model; the strip of the others has no width."""
        return self.half_width > 0

    @property
    def mean(self) -> NDArray[np.float64]:
        """Mean of the model over the pixel, e⁻/s on the optical axis."""
        low, high = self.low.astype(np.float64), self.high.astype(np.float64)
        return low + (high - low) * moving_share(self.normal_x, self.normal_y, self.offset, self.speed)


def astuple_of(values: "PairEdges | EdgeFit") -> tuple[NDArray, ...]:
    """The arrays of a data class, without copies."""
    return tuple(getattr(values, each.name) for each in fields(values))


@dataclass(frozen=True)
class EdgeFit:
    """Lines fitted to decision rays of listed pairs, arrays [n], float32; fluxes in e⁻/s on the optical axis.

    Parameters
    ----------
    normal_x, normal_y, offset, speed : the line, see `PairEdges`.
    gap : width of the strip without any decision ray between both sides, px; negative where no line separates them.
    low, high : mean flux of either side.
    scatter : standard deviation of single rays about the mean of their side.
    fewer : number of rays on the side that has fewer.
    rays : number of decision rays.
    """

    normal_x: NDArray[np.float32]
    normal_y: NDArray[np.float32]
    offset: NDArray[np.float32]
    speed: NDArray[np.float32]
    gap: NDArray[np.float32]
    low: NDArray[np.float32]
    high: NDArray[np.float32]
    scatter: NDArray[np.float32]
    fewer: NDArray[np.float32]
    rays: NDArray[np.float32]

    @classmethod
    def empty(cls, count: int) -> "EdgeFit":
        """Fits to be filled in."""
        return cls(*(np.empty(count, np.float32) for _ in fields(cls)))

    @property
    def is_line(self) -> NDArray[np.bool_]:
        """True where a line separates two even levels, one of which may be that of a single ray."""
        return (self.gap > 0) & (self.fewer >= 1) & (self.scatter < _MOST_UNEVEN * (self.high - self.low))

    @property
    def is_edge(self) -> NDArray[np.bool_]:
        """True where a line separates two even levels."""
        return self.is_line & (self.fewer >= _LEAST_ON_A_SIDE)

    def at(self, part: NDArray) -> "EdgeFit":
        """Fits of some pairs."""
        return EdgeFit(*(values[part] for values in astuple_of(self)))

    def scaled(self, factor: NDArray[np.float32]) -> "EdgeFit":
        """The same lines, their fluxes times a factor."""
        fluxes = {name: getattr(self, name) * factor for name in ("low", "high", "scatter")}
        return replace(self, **fluxes)

    def replace(self, part: slice | NDArray[np.int64], fits: "EdgeFit") -> None:
        """Put in the fits of some pairs."""
        for values, fitted in zip(astuple_of(self), astuple_of(fits), strict=True):
            values[part] = fitted

    def models(self, part: NDArray, wider: bool = False) -> PairEdges:
        """Models of some pairs; `wider` strips hold lines that lie askew in the gap as well."""
        half_width = np.float32(1.0 if wider else 0.5) * self.gap[part] + np.float32(_SLACK_PX)
        levels = self.low[part], self.high[part], self.speed[part]
        return PairEdges(self.normal_x[part], self.normal_y[part], self.offset[part], half_width, *levels)

    def put(self, part: slice, decision_rays: Sequence[Float], rays: int, moves: bool = False) -> None:
        """Fit lines to pairs with `rays` decision rays each.

        Parameters
        ----------
        part : pairs that were traced.
        decision_rays : of one pair after the other: x and y of each ray, px from the centre of its pixel, its time,
            windows from the middle of its own, and its flux, e⁻/s on the optical axis.
        rays : number of rays of each pair, a power of two.
        moves : True where lines may move within the window.
        """
        types, (x, y, time, flux) = jit(), decision_rays
        ray = dr.arange(types.UInt32, len(flux))
        of, count = ray // dr.opaque(types.UInt32, rays), dr.opaque(types.Float, rays)

        def spread(each: Float) -> Float:
            return dr.gather(types.Float, each, of)

        # two sides: above and below the middle of the range
        middle = 0.5 * (dr.block_reduce(dr.ReduceOp.Min, flux, rays) + dr.block_reduce(dr.ReduceOp.Max, flux, rays))
        above = flux > spread(middle)
        above_count = dr.block_sum(dr.select(above, types.Float(1), 0), rays)
        below_count = count - above_count
        low = dr.block_sum(dr.select(above, 0, flux), rays) / dr.maximum(below_count, 1)
        # of rays that all see the same, none is above the middle: both levels are the same
        high = dr.block_sum(dr.select(above, flux, 0), rays) / dr.maximum(above_count, 1)
        high = dr.select(above_count > 0, high, low)
        deviation = flux - dr.select(above, spread(high), spread(low))
        # relative to the largest flux, so that no square leaves float32
        unit = dr.maximum(dr.block_reduce(dr.ReduceOp.Max, dr.abs(flux), rays), 1e-30)
        scatter = unit * dr.sqrt(dr.block_sum(dr.square(deviation / spread(unit)), rays) / count)
        side = dr.select(above, types.Float(1), -1)
        dr.eval(side, low, high, scatter, above_count, below_count)
        if moves:
            line = widest_moving_gap(x, y, time, side, rays)
        else:
            angle, gap, at = widest_gap(x, y, side, rays)
            sine, cosine = dr.sincos(angle)
            line = cosine, sine, -at, dr.zeros(types.Float, len(gap)), gap
        values = *line, low, high, scatter, dr.minimum(above_count, below_count)
        dr.eval(values)
        self.rays[part] = rays
        for out, value in zip(astuple_of(self)[:-1], values, strict=True):
            out[part] = np.array(value)


def joined_rays(first: Sequence[Float], pairs: NDArray[np.int64], more: Sequence[Float], rays: int) -> list[Float]:
    """Values of two sets of decision rays, pair by pair.

    Parameters
    ----------
    first : of all pairs, `rays` each, as many values as `more` has.
    pairs : [n], pairs that have more.
    more : of these pairs, as many each.
    rays : a power of two.
    """
    types = jit()
    # of each pair the rays of the first set, then those of the second
    half = dr.arange(types.UInt32, 2 * rays * pairs.size) // dr.opaque(types.UInt32, rays)
    within = dr.arange(types.UInt32, 2 * rays * pairs.size) - half * dr.opaque(types.UInt32, rays)
    is_first, pair = half % 2 == 0, half // 2
    own = spread_out(types.UInt32, pairs.astype(np.uint32), pair) * dr.opaque(types.UInt32, rays) + within
    other = pair * dr.opaque(types.UInt32, rays) + within
    merged = [
        dr.select(is_first, dr.gather(types.Float, a, own), dr.gather(types.Float, b, other, ~is_first))
        for a, b in zip(first, more, strict=True)
    ]
    dr.eval(merged)
    return merged


@dataclass(frozen=True)
class LaneEdges:
    """Models of pairs, on the device, per ray.

    Parameters
    ----------
    normal_x, normal_y, offset, half_width, low, high, speed : see `PairEdges`.
    is_strip : True if this ray starts in the strip.
    """

    normal_x: Float
    normal_y: Float
    offset: Float
    half_width: Float
    low: Float
    high: Float
    speed: Float
    is_strip: Mask

    @classmethod
    def of(cls, edges: PairEdges, pair: UInt32, is_strip: Mask) -> "LaneEdges":
        """Spread the models of pairs over rays.

        Parameters
        ----------
        edges : of all pairs.
        pair : of each lane.
        is_strip : True for the rays that start in the strip.
        """
        kind = jit().Float
        spread = {each.name: spread_out(kind, getattr(edges, each.name), pair) for each in fields(edges)}
        return cls(**spread, is_strip=is_strip)

    def place(
        self, uniform: tuple[Float, Float], point: tuple[Float, Float], share: Float
    ) -> tuple[Float, Float, Float, Float, Float]:
        """Place of each ray, px from the centre of its pixel, its share of the window, its weight, and the model's flux
        there.

        Parameters
        ----------
        uniform : places of rays that start uniformly in the pixel.
        point : [0, 1)², place inside the strip, across and along it.
        share : [0, 1), share of the window at which a ray starts.
        """
        # a strip that moves is drawn at times at which its line meets the pixel
        moves = abs(self.speed) > LEAST_SPEED
        begin, span = self._times(moves)
        drawn = dr.fma(span, share, begin)
        share = dr.select(moves & self.is_strip & (span > 0), drawn, share)
        offset = dr.select(moves, dr.fma(self.speed, share - 0.5, self.offset), self.offset)
        is_met = ~moves | ((share >= begin) & (share <= begin + span) & (span > 0))
        # at its time, it is drawn line by line: the distance from its middle, then a point of the part inside of it
        across = dr.fma(2 * self.half_width, point[0], -self.half_width)
        first, length = self._inside(across - offset)
        along = dr.fma(length, point[1], first)
        away = across - offset
        strip = self.normal_x * away - self.normal_y * along, self.normal_y * away + self.normal_x * along
        # a line that misses the pixel has no point in it: such a ray starts anywhere, and counts for nothing
        is_strip = self.is_strip & (length > 0) & is_met
        x, y = (dr.select(is_strip, a, b) for a, b in zip(strip, uniform, strict=True))
        distance = dr.fma(self.normal_x, x, dr.fma(self.normal_y, y, offset))
        _, own_length = self._inside(distance - offset)
        inside = (self.is_strip | (abs(distance) <= self.half_width)) & (own_length > 0) & is_met
        # density of the rays of the strip here, beside that of 1 of the uniform ones: weights by the balance heuristic
        density = dr.select(inside, dr.rcp(2 * self.half_width * own_length), 0)
        density = dr.select(moves & inside, density * dr.rcp(span), density)
        weight = dr.select(is_strip | ~self.is_strip, 2 / (1 + density), 0)
        return x, y, share, weight, dr.select(distance > 0, self.high, self.low)

    def _times(self, moves: Mask) -> tuple[Float, Float]:
        """Begin and length of the time in which a moving line meets the pixel, shares of the window."""
        reach = 0.5 * (abs(self.normal_x) + abs(self.normal_y))
        per_px = dr.rcp(dr.select(moves, self.speed, 1))
        one, other = (-reach - self.offset) * per_px + 0.5, (reach - self.offset) * per_px + 0.5
        begin = dr.maximum(dr.minimum(one, other), 0)
        return begin, dr.maximum(dr.minimum(dr.maximum(one, other), 1) - begin, 0)

    def _inside(self, away: Float) -> tuple[Float, Float]:
        """Begin and length of the part inside of the pixel of a line, which has a distance from the pixel's centre
        along the normal, px; the length is 0 or less if there is none.
        """
        # along the line, x is n_x·away − n_y·s and y is n_y·away + n_x·s
        low, high = type(away)(-10), type(away)(10)
        for middle, slope in ((self.normal_x * away, -self.normal_y), (self.normal_y * away, self.normal_x)):
            flat = abs(slope) < 1e-7
            one, other = (-0.5 - middle) / slope, (0.5 - middle) / slope
            outside = abs(middle) > 0.5
            low = dr.select(flat, dr.select(outside, 10, low), dr.maximum(low, dr.minimum(one, other)))
            high = dr.select(flat, high, dr.minimum(high, dr.maximum(one, other)))
        return low, dr.maximum(high - low, 0)
