"""Rays that are aimed at objects smaller than a pixel.

A ball that covers a thousandth of a pixel and is thirty times as bright as what lies behind it is met by one ray of a
thousand, which then weighs far too much. Half of the rays of such a pair of pixel and window therefore start uniformly
in pixel and window, as all rays do elsewhere. The other half start within the squares around the images of the objects
at the rays' own instants. The two are combined by the balance heuristic [veach1997]: with the density W of the pixel
and q of the aimed rays, a ray of either kind has the weight W/(W/2 + q/2). The estimate is unbiased for any squares.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Mask, UInt32
from hesim_render.core.host_arrays import from_host, spread_out
from hesim_render.sources.render.change_driven.edges import PairEdges
from hesim_render.sources.render.primary_rays import RayFactory
from hesim_render.sources.render.scene.tracks import DevicePose
from hesim_render.sources.render.transport.moving_scene import Group, MovingScene
from hesim_render.sources.render.transport.swept_boxes import Moment

#: Squares are this much wider than the image of the ball around an object.
_WIDER = 1.02
#: Columns and rows up to 8192 are exact to this in float32, pixels.
_ROUNDING_PX = 5e-4


@dataclass(frozen=True)
class Aims:
    """Objects at which rays of some pairs are aimed.

    Parameters
    ----------
    key : [k], increasing: window · sites + site of each such pair.
    first : [k + 1], place of its first object in `group`; the last entry is the number of entries.
    group : [m], numbers of moving groups.
    sites : number of sites.
    """

    key: NDArray[np.int64]
    first: NDArray[np.int64]
    group: NDArray[np.uint32]
    sites: int

    @classmethod
    def of(cls, parts: Sequence[tuple[int, NDArray[np.int64], NDArray[np.int64]]], sites: int) -> "Aims | None":
        """Collect objects; None if there are none.

        Parameters
        ----------
        parts : window, and site and group [m] each.
        sites : number of sites.
        """
        if not parts:
            return None
        # one number for each pair, and its objects behind one another, in order of their numbers
        keys = np.concatenate([window * sites + site for window, site, _ in parts])
        group = np.concatenate([group for _, _, group in parts])
        order = np.lexsort((group, keys))
        key, first = np.unique(keys[order], return_index=True)
        return cls(key, np.append(first, order.size), group[order].astype(np.uint32), sites)

    def at(self, window: NDArray[np.integer], site: NDArray[np.integer]) -> "PairAims":
        """The objects of listed pairs, [n]."""
        wanted = window.astype(np.int64) * self.sites + site
        # pairs that are not in the list have no objects; the sentinel −1 is no key
        place = np.searchsorted(self.key, wanted)
        known = np.append(self.key, -1)[place] == wanted
        first = np.where(known, self.first[place], 0)
        last = np.where(known, self.first[np.minimum(place + 1, self.key.size)], 0)
        return PairAims(first.astype(np.uint32), (last - first).astype(np.uint32), self.group)


@dataclass(frozen=True)
class PairAims:
    """Objects at which rays of listed pairs are aimed.

    Parameters
    ----------
    first, count : [n], place of the first object in `group`, and number of objects; 0 where no rays are aimed.
    group : [m], numbers of moving groups.
    """

    first: NDArray[np.uint32]
    count: NDArray[np.uint32]
    group: NDArray[np.uint32]

    def part(self, part: slice | NDArray) -> "PairAims":
        """Those of some pairs."""
        return PairAims(self.first[part], self.count[part], self.group)


def in_blocks(
    packets: NDArray[np.int64],
    room: int,
    aims: PairAims | None,
    edges: PairEdges | None,
    shadows: NDArray[np.uint32] | None = None,
) -> Iterator[tuple[slice | NDArray[np.int64], PairAims | PairEdges | None, NDArray[np.uint32] | None]]:
    """Pairs that are traced together, what half of their rays are aimed at, and their known shadows.

    Pairs with aimed rays or known shadows have a kernel of their own, so that the bits of the others do not depend on
    their company.

    Parameters
    ----------
    packets : [n], packets of rays of each pair.
    room : largest number of packets at a time, unless a single pair has more.
    aims, edges : small objects and edges of all pairs; None where there are none. A pair has one kind at most.
    shadows : codes of `LampShadows` of all pairs, 0 where none are known; None for none.
    """
    # pairs sorted by kind: aimed at objects, about edges, neither
    plain = np.ones(packets.size, np.bool_)
    alike: list[tuple[NDArray[np.int64] | None, PairAims | PairEdges | None]] = []
    for kind, has_any in (
        (aims, None if aims is None else aims.count > 0),
        (edges, None if edges is None else edges.is_there),
    ):
        if has_any is not None:
            alike.append((np.flatnonzero(has_any), kind))
            plain &= ~has_any
    # plain pairs first; where there are no others, a slice saves the copy
    alike.insert(0, (np.flatnonzero(plain) if alike else None, None))
    by_shadow: list[tuple[NDArray[np.int64] | None, PairAims | PairEdges | None, NDArray[np.uint32] | None]] = []
    for places, aimed in alike:
        if shadows is None or not shadows.any():
            by_shadow.append((places, aimed, None))
            continue
        every = np.arange(packets.size) if places is None else places
        by_shadow.append((every[shadows[every] == 0], aimed, None))
        by_shadow.append((every[shadows[every] > 0], aimed, shadows))
    for places, aimed, own in by_shadow:
        ends = np.cumsum(packets if places is None else packets[places])
        first = 0
        while first < ends.size:
            # as many pairs as there is room for, one at least
            done = int(ends[first - 1]) if first else 0
            last = max(first + 1, int(np.searchsorted(ends, done + room, side="right")))
            part = slice(first, last) if places is None else places[first:last]
            yield part, None if aimed is None else aimed.part(part), None if own is None else own[part]
            first = last


@dataclass(frozen=True)
class LaneAims:
    """Objects at which the ray of each lane may be aimed, on the device.

    Parameters
    ----------
    first, count : see `PairAims`, per lane; the count is 1 or more.
    group : table of the numbers of moving groups.
    is_aimed : True if this ray is aimed.
    """

    first: UInt32
    count: UInt32
    group: UInt32
    is_aimed: Mask

    @classmethod
    def of(cls, aims: PairAims, pair: UInt32, is_aimed: Mask) -> "LaneAims":
        """Spread the objects of pairs over lanes.

        Parameters
        ----------
        aims : of all pairs.
        pair : of each lane.
        is_aimed : True for the rays that are aimed.
        """
        types = jit()
        first, count = (spread_out(types.UInt32, values, pair) for values in (aims.first, aims.count))
        group = from_host(types.UInt32, np.append(aims.group, np.zeros(2, np.uint32)))
        return cls(first, count, group, is_aimed)


@dataclass(frozen=True)
class _Square:
    """Part of a square that lies in a pixel's area, relative to the centre of the pixel, pixels."""

    low_x: Float
    low_y: Float
    wide: Float
    high: Float

    @property
    def density(self) -> Float:
        """Of a point drawn uniformly inside, 1/pixel; 0 if the square does not meet the area."""
        area = dr.maximum(self.wide, 0) * dr.maximum(self.high, 0)
        return dr.select(area > 0, dr.rcp(area), 0)

    def has(self, x: Float, y: Float) -> Mask:
        return (x >= self.low_x) & (x <= self.low_x + self.wide) & (y >= self.low_y) & (y <= self.low_y + self.high)


class Aim:
    """Draws rays towards small objects, and weights rays of both kinds.

    Parameters
    ----------
    parts : the moving scene.
    rays : places of pixels on the chip.
    """

    def __init__(self, parts: MovingScene, rays: RayFactory) -> None:
        self._parts, self._rays = parts, rays
        self._balls = from_host(jit().Float, np.array([ball_around(group) for group in parts.groups] or [(0.0,) * 4]))
        dr.make_opaque(self._balls)

    def choose(self, lanes: LaneAims, moment: Float) -> tuple[UInt32, Float]:
        """Object at which each aimed ray is aimed, as number in its list, and the instant of each ray in [0, 1).

        One random number decides both, so that the instants of the rays of each object are stratified.
        """
        scaled = moment * lanes.count
        slot = dr.minimum(type(lanes.count)(scaled), lanes.count - 1)
        return slot, dr.select(lanes.is_aimed, scaled - slot, moment)

    def place(
        self,
        lanes: LaneAims,
        slot: UInt32,
        now: Moment,
        camera: DevicePose | None,
        centre: tuple[Float, Float],
        uniform: tuple[Float, Float],
        point: tuple[Float, Float],
    ) -> tuple[Float, Float, Float]:
        """Place of each ray relative to the centre of its pixel, pixels, and its weight.

        Parameters
        ----------
        lanes : objects of each lane.
        slot : object at which the ray is aimed, from `choose`.
        now : instants of the rays.
        camera : pose of the camera; None if it rests.
        centre : column and row of the pixel on the full sensor.
        uniform : places of rays that are not aimed, pixels from the centre.
        point : [0, 1)², place inside the square of an aimed ray.
        """
        types = jit()
        # an aimed ray: a point of the square around its object, at its own instant
        own = self._square(dr.gather(types.UInt32, lanes.group, lanes.first + slot), now, camera, centre)
        aimed = own.low_x + own.wide * point[0], own.low_y + own.high * point[1]
        x, y = (dr.select(lanes.is_aimed, a, b) for a, b in zip(aimed, uniform, strict=True))

        def add(k: UInt32, density: Float) -> tuple[UInt32, Float]:
            group = dr.gather(types.UInt32, lanes.group, lanes.first + k)
            square = self._square(group, now, camera, centre)
            return k + 1, density + dr.select(square.has(x, y), square.density, 0)

        # the density of aimed rays at this place: the mean over the squares of all objects of the pair
        state = dr.zeros(types.UInt32, dr.width(x)), dr.zeros(types.Float, dr.width(x))
        _, density = dr.while_loop(state, lambda k, _: k < lanes.count, add, label="aimed rays")
        density = density / lanes.count
        pixel = self._rays.density(x, y, centre)
        # an aimed ray whose object is not there at this instant finds nothing
        # balance heuristic: the pixel's density over the mean of both
        meets = (pixel > 0) & (~lanes.is_aimed | (own.density > 0))
        weight = dr.select(meets, 2 * pixel / (pixel + density), 0)
        return x, y, weight

    def _square(self, group: UInt32, now: Moment, camera: DevicePose | None, centre: tuple[Float, Float]) -> _Square:
        """Square around the image of the ball around an object, cut to the pixel's area."""
        types = jit()
        ball = dr.gather(types.Array4f, self._balls, group)
        middle = self._parts.pose(group, now).to_world(types.Array3f(ball.x, ball.y, ball.z))
        if camera is not None:
            middle = camera.to_rest(middle)
        col, row, px_per_m = self._rays.seen(middle)
        # the ball in the picture, a little wider, and no further than rays of this pixel may start
        reach = _WIDER * ball.w * px_per_m + _ROUNDING_PX
        half, seen = self._rays.reach_px, px_per_m > 0
        sides = []
        for place, pixel in zip((col, row), centre, strict=True):
            low = dr.maximum(place - pixel - reach, -half)
            sides.append((low, dr.select(seen, dr.minimum(place - pixel + reach, half) - low, 0)))
        (low_x, wide), (low_y, high) = sides
        return _Square(low_x, low_y, wide, high)


def ball_around(group: Group) -> tuple[float, float, float, float]:
    """Centre and radius of a ball that contains an object at rest, m."""
    low, high = group.corners.min(axis=0), group.corners.max(axis=0)
    form = group.part.form
    if form is not None and len(form.balls) == 1 and not form.faces:
        radius = float((high - low).max()) / 2
    else:
        radius = float(np.linalg.norm(high - low)) / 2
    x, y, z = (float(v) for v in (low + high) / 2)
    return x, y, z, radius
