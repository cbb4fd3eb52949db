"""Paths of neighbouring pixels that share what they find at their second vertices.

Neighbouring pixels see nearly the same surface, and light comes to both from nearly the same places. In a *group* of
paths, one of each pixel of a tile, every first vertex is connected to every second vertex by a shadow ray. With the
density p_k(x) with which the first vertex of path k, by its own sampling, would have chosen the place x, path k gets

    Σ_j w_kj · S_j,     w_kj = p_k(x_j) / Σ_l p_l(x_j),

of the light S_j that the second vertex of path j sends back: the balance heuristic for all paths of the group
[veach1997], which is unbiased, since a diffuse surface sends the same light in all directions; sharing paths between
pixels is due to [bekaert2002]. Both vertices have to be diffuse; all others keep what their own path finds, and so does
light that a second vertex emits itself.
"""

from dataclasses import dataclass

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Bands, Float, Interaction, LoopState, Mask, MitsubaObject, Ray, UInt32
from hesim_render.sources.render.transport.paths import Begun, PathIntegrator
from hesim_render.sources.render.transport.swept_boxes import Moment

#: A density of directions is that of a diffuse surface if it differs by less than this, 1/sr.
_ALIKE = 1e-4


@dataclass(frozen=True)
class Groups:
    """Lanes of the paths of each group. A tile has so many pixels, and each of these some paths, one pixel after the
    other; a group has one path of each.

    Parameters
    ----------
    count, size : number of paths in a group, and the same on the device.
    own : number of the lane's path in its group.
    first : lane of the first path of the group.
    stride : lanes from one path of the group to the next.
    """

    count: int
    size: UInt32
    own: UInt32
    first: UInt32
    stride: UInt32

    @classmethod
    def of(cls, size: int, pair: UInt32, paths: UInt32) -> "Groups":
        """Groups of lanes.

        Parameters
        ----------
        size : number of pixels of a tile.
        pair : pixel of each lane, counted over all tiles.
        paths : number of paths of a pixel, for each lane.
        """
        types = jit()
        count = dr.opaque(types.UInt32, size)
        own = pair - pair // count * count
        return cls(size, count, own, dr.arange(types.UInt32, dr.width(pair)) - own * paths, types.UInt32(paths))

    def lane(self, number: UInt32) -> UInt32:
        """Lane of a path of the group."""
        return dr.fma(number, self.stride, self.first)

    def of_first(self, values: Float) -> Float:
        """Values of the first path of each group."""
        dr.eval(values)
        return dr.gather(type(values), values, self.first)


class SharedPaths:
    """Flux of pixels by paths that share their second vertices.

    Parameters
    ----------
    paths : traces the paths.
    """

    def __init__(self, paths: PathIntegrator) -> None:
        self._paths = paths

    def flux(
        self, sampler: MitsubaObject, ray: Ray, moment: Moment, filter_index: UInt32, groups: Groups
    ) -> tuple[Float, Float, Mask]:
        """Trace one path per lane; all paths of a group have one time and one filter.

        Parameters
        ----------
        sampler, ray, moment, filter_index : see `PathIntegrator.flux`.
        groups : paths that share.

        Returns
        -------
        shared, alone : flux of each lane, with and without what other paths of its group found.
        met : True where the path, or a shadow ray to its second vertex, came through the box of a moving object.
        """
        mi, paths, scene = self._paths.scene.mi, self._paths, self._paths.scene
        wavelengths = paths.wavelengths.sample(filter_index, groups.of_first(sampler.next_1d()))
        ray.wavelengths = mi.UnpolarizedSpectrum(*wavelengths)
        every, none = mi.Bool(True), dr.zeros(mi.Interaction3f)
        # the first vertex: light that it emits, and that of lamps
        first = scene.intersect(ray, moment, True, every)
        goes_on = first.rest.is_valid()
        place, lobe, light, _ = sampler.next_vertex(every)
        reflected, chosen, weight, near = paths.scatter(first, moment, goes_on, mi.Bool(True), (place, lobe, light))
        direct = reflected + paths.shine(first.rest, every, none, mi.Float(1.0), mi.Bool(True))
        goes_on &= dr.any(weight != 0)
        upwards = dr.mulsign(mi.Vector3f(first.shading_normal), mi.Frame3f.cos_theta(first.rest.wi))
        by_cosine = dr.abs(mi.Frame3f.cos_theta(chosen.wo)) * dr.inv_pi
        # a bumpy surface has another density than its shading normal says
        shares = goes_on & _is_diffuse(mi, first.rest) & (dr.abs(chosen.pdf - by_cosine) < _ALIKE)
        # the second vertex, with the light that it emits
        following = scene.leaving.along(first.world, first.to_world(chosen.wo))
        following.wavelengths = ray.wavelengths
        second = scene.intersect(following, moment, False, goes_on)
        is_delta = mi.has_flag(chosen.sampled_type, mi.BSDFFlags.Delta)
        direct += dr.select(goes_on, weight * paths.shine(second.rest, goes_on, first.world, chosen.pdf, is_delta), 0.0)
        arrives = goes_on & second.rest.is_valid()
        # places are compared by area, which the geometric normal measures
        back = dr.mulsign(mi.Vector3f(second.world.n), -dr.dot(second.world.n, following.d))
        is_shared = arrives & shares & _is_diffuse(mi, second.rest)
        begin, place, met = mi.Interaction3f(first.world), mi.Point3f(second.world.p), first.met | near | second.met
        dr.eval(direct, weight, begin, upwards, shares, following, arrives, is_shared, place, back, met)
        dr.eval(sampler.state, sampler.dimension)
        # what each second vertex sends back
        sent, near = paths.sample(sampler, following, moment, Begun(begin, arrives, mi.Float(0.0), mi.Bool(False)))
        sent = dr.select(arrives, sent, 0.0)
        met |= near
        dr.eval(sent, met)
        gathered, near = self._gathered(groups, moment, (begin, upwards, shares), (place, back, is_shared, sent))
        arriving = dr.select(is_shared, 0.0, sent) + gathered
        both = tuple(
            # as for paths of one pixel alone
            dr.sum(dr.fma(weight, bounced, direct)) / len(sent) * paths.wavelengths.total(filter_index)
            for bounced in (arriving, sent)
        )
        return both[0], both[1], met | near

    def _gathered(
        self,
        groups: Groups,
        moment: Moment,
        firsts: tuple[Interaction, MitsubaObject, Mask],
        seconds: tuple[MitsubaObject, MitsubaObject, Mask, Bands],
    ) -> tuple[Bands, Mask]:
        """Light from the second vertices of a group at the first vertex of each lane, before it is reflected.

        Parameters
        ----------
        groups, moment : see `flux`.
        firsts : first vertices, their upward normals, and those that share.
        seconds : second vertices, their normals towards the first one, those that are shared, and the light they send.

        Returns
        -------
        Radiance, and True where a shadow ray came through the box of a moving object.
        """
        mi, scene = self._paths.scene.mi, self._paths.scene
        (begin, upwards, shares), (place, back, is_shared, sent) = firsts, seconds
        types, lane = jit(), dr.arange(mi.UInt32, dr.width(sent))
        # four numbers side by side, so that one fetch brings them: places, with 1 where they share, and both normals
        places, normals, ups, lights = (
            dr.ravel(types.Array4f(*values))
            for values in ((*begin.p, dr.select(shares, 1.0, 0.0)), (*begin.n, 0.0), (*upwards, 0.0), tuple(sent))
        )
        dr.eval(places, normals, ups, lights)
        # [second vertex, first vertex], densities with which first vertices choose the places of second ones, m⁻²
        densities = dr.empty(mi.Float, dr.width(sent) * groups.count)

        def meet(number: UInt32, total: Float, met: Mask) -> LoopState:
            """Density of one first vertex of the group at the second vertex of this lane."""
            other = groups.lane(number)
            there, normal, up = (dr.gather(types.Array4f, values, other) for values in (places, normals, ups))
            one = dr.zeros(mi.Interaction3f)
            one.p, one.n = mi.Point3f(there[0], there[1], there[2]), mi.Normal3f(normal[0], normal[1], normal[2])
            way = place - one.p
            square = dr.squared_norm(way)
            direction = way * dr.rsqrt(square)
            leaves = dr.dot(mi.Vector3f(up[0], up[1], up[2]), direction)
            arrives = -dr.dot(back, direction)
            asks = is_shared & (there[3] > 0) & (leaves > 0) & (arrives > 0)
            # its own first vertex has seen it
            blocked, near = scene.occluded(scene.leaving.to(one, place), moment, asks & (number != groups.own))
            density = dr.select(asks & ~blocked, leaves * arrives / square * dr.inv_pi, 0.0)
            dr.scatter(densities, density, lane * groups.size + number)
            return number + 1, total + density, met | near

        def goes_on(number: UInt32, *_: Float) -> Mask:
            return number < groups.size

        start = mi.UInt32(0), mi.Float(0.0), mi.Bool(False)
        _, total, met = dr.while_loop(start, goes_on, meet, label="meetings")
        dr.eval(densities, total, met)

        def take(number: UInt32, light: Bands) -> LoopState:
            """Light from the second vertex of one path of the group."""
            other = groups.lane(number)
            density = dr.gather(mi.Float, densities, other * groups.size + groups.own)
            share = dr.select(density > 0, density / dr.gather(mi.Float, total, other), 0.0)
            bands = dr.gather(types.Array4f, lights, other)
            return number + 1, dr.fma(mi.UnpolarizedSpectrum(*bands), share, light)

        light = dr.while_loop((mi.UInt32(0), mi.UnpolarizedSpectrum(0.0)), goes_on, take, label="shares")[1]
        return light, met


def _is_diffuse(mi: MitsubaObject, si: Interaction) -> Mask:
    """True where a surface does nothing but reflect diffusely."""
    flags, names = si.bsdf().flags(), mi.BSDFFlags
    is_other = mi.Bool(False)
    for other in (names.Glossy, names.Delta, names.Delta1D, names.Null, names.DiffuseTransmission):
        is_other |= mi.has_flag(flags, other)
    return mi.has_flag(flags, names.DiffuseReflection) & ~is_other
