"""A path tracer whose rays have individual times, and which reports whether a path came near a moving object.

The estimator is the common one [veach1997]: light is sampled at every vertex and combined with the surface's own
sampling by the power heuristic; long paths are ended by Russian roulette. Mitsuba's own path tracer cannot be used,
because it follows a path through one scene at one time. This one has two additions: diffuse surfaces send some paths to
the images of lamps in flat mirrors (`LampImages`), and a uniform sky is not sampled (`spare_even_skies`).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from hesim_render.core.device import dr
from hesim_render.core.device_types import (
    Bands,
    Float,
    Interaction,
    LoopState,
    Mask,
    MitsubaObject,
    Point2,
    Ray,
    UInt32,
)
from hesim_render.sources.render.sampling.wavelengths import WavelengthSampler
from hesim_render.sources.render.transport.known_lights import KnownLights
from hesim_render.sources.render.transport.mirrored_lamps import LampImages, redirected
from hesim_render.sources.render.transport.moving_scene import MovingScene, Surface
from hesim_render.sources.render.transport.swept_boxes import Moment, box_rows, inverse_of, meets_box

#: Largest probability of survival in Russian roulette.
_ROULETTE_MOST = 0.95
#: Largest number of lights with separate boxes, which tell whether a ray may hit them; more lights share one box.
_MOST_LAMPS = 8


@dataclass(frozen=True)
class Begun:
    """First vertices of paths that begin with their second segment, per lane.

    Parameters
    ----------
    vertex : Interaction3f, world space.
    active : lanes that have one.
    density : of the direction in which the path goes on. With a density of 0, what the second vertex emits is left out.
    is_delta : True where this direction was the only one.
    known : lights of which what the second vertex emits is left out; None for none.
    """

    vertex: Interaction
    active: Mask
    density: Float
    is_delta: Mask
    known: KnownLights | None = None


class PathIntegrator:
    """Radiance along rays through a `MovingScene`, and the resulting flux of a pixel.

    Parameters
    ----------
    scene : the scene to trace.
    max_depth : longest path in segments, 2 is direct light; below 0 there is no limit.
    roulette_depth : first segment with Russian roulette; below 0, never.
    wavelengths : samples the wavelengths of a ray by the filter of its pixel.

    Attributes
    ----------
    scene, wavelengths : as given.
    """

    def __init__(self, scene: MovingScene, max_depth: int, roulette_depth: int, wavelengths: WavelengthSampler) -> None:
        self.scene, self.wavelengths = scene, wavelengths
        self._max_depth, self._roulette_depth = (
            depth if depth >= 0 else 1 << 30 for depth in (max_depth, roulette_depth)
        )
        lamps = scene.lamp_boxes
        if len(lamps) > _MOST_LAMPS:
            lamps = np.stack([lamps[:, 0].min(axis=0), lamps[:, 1].max(axis=0)])[None]
        mi = scene.mi
        self._lamps = [(mi.Vector3f(row[:3]), mi.Vector3f(row[4:7])) for row in box_rows(lamps)]
        dr.make_opaque(self._lamps)
        self._images = LampImages.of(scene.mi, scene.static)

    @property
    def bounces(self) -> bool:
        """True if light may meet more than one surface."""
        return self._max_depth > 2

    @property
    def sees_images(self) -> bool:
        """True if directions of diffuse surfaces are drawn from the cones about mirrored lamps as well."""
        return bool(self._images)

    @property
    def may_share(self) -> bool:
        """True if there are second vertices that neighbours may share; the chance of cones depends on the place."""
        return self._max_depth > 2 and not self._images

    def flux(
        self, sampler: MitsubaObject, ray: Ray, moment: Moment, filter_index: UInt32
    ) -> tuple[Float, Float, Float, None, Mask]:
        """Trace one ray per lane. Parameters and results as `DiffuseIntegrator.flux`, with one estimate in place of
        two, and no part apart.
        """
        ray.wavelengths = self.scene.mi.UnpolarizedSpectrum(*self.wavelengths.sample(filter_index, sampler.next_1d()))
        radiance, met = self.sample(sampler, ray, moment)
        # not dr.mean: it puts the number of lanes into the kernel, so that each new number would compile again
        flux = dr.sum(radiance) / len(radiance) * self.wavelengths.total(filter_index)
        return flux, flux, flux, None, met

    def sample(
        self, sampler: MitsubaObject, ray: Ray, moment: Moment, begun: Begun | None = None
    ) -> tuple[Bands, Mask]:
        """Trace one path per lane.

        Parameters
        ----------
        sampler : `next_vertex`, see `CounterSampler`.
        ray : Ray3f with wavelengths, world space.
        moment : time of each ray.
        begun : first vertices of paths whose second segment is `ray`; None for paths from the camera.

        Returns
        -------
        radiance : Spectrum, W m⁻² sr⁻¹ nm⁻¹.
        met : Bool, True where any segment came through the box of a moving object.
        """
        mi, scene = self.scene.mi, self.scene
        depth, met = mi.UInt32(0 if begun is None else 1), mi.Bool(False)
        throughput, radiance = mi.Spectrum(1.0), mi.Spectrum(0.0)
        stretch = mi.Float(1.0)  # change of solid angle by refraction
        before = dr.zeros(mi.Interaction3f)
        before_pdf, before_delta = mi.Float(1.0), mi.Bool(True)
        ray, active = mi.Ray3f(ray), mi.Bool(True)
        if begun is not None:
            before, active = mi.Interaction3f(begun.vertex), mi.Bool(begun.active)
            before_pdf, before_delta = mi.Float(begun.density), mi.Bool(begun.is_delta)
        most, roulette_depth = (dr.opaque(mi.UInt32, depth) for depth in (self._max_depth, self._roulette_depth))

        def left_out(depth: UInt32) -> KnownLights | None:
            """Lights of which what a vertex itself emits is left out."""
            known = None if begun is None else begun.known
            return known and known.among(depth == 1)

        def step(*state: Any) -> LoopState:
            """One vertex from which the path may continue. The last segment is handled after the loop."""
            sampler, depth, met, throughput, radiance, stretch, before, before_pdf, before_delta, ray, active, _ = state
            surface = scene.intersect(ray, moment, depth == 0, active)
            si = surface.rest
            met |= surface.met
            shine = self.shine(si, active, before, before_pdf, before_delta, left_out(depth))
            radiance = dr.fma(throughput, shine, radiance)

            goes_on = active & si.is_valid()
            place, lobe, light, luck = sampler.next_vertex(depth == 0)
            reflected, chosen, chosen_weight, near = self.scatter(
                surface, moment, goes_on, depth + 3 <= most, (place, lobe, light)
            )
            met |= near
            radiance = dr.fma(throughput, reflected, radiance)

            # the next direction of the path
            following = scene.leaving.along(surface.world, surface.to_world(chosen.wo))
            ray.o, ray.d, ray.maxt = following.o, following.d, following.maxt
            throughput = dr.select(goes_on, throughput * chosen_weight, throughput)
            stretch *= dr.select(goes_on, chosen.eta, 1.0)
            before = mi.Interaction3f(surface.world)
            before_pdf = chosen.pdf
            before_delta = mi.has_flag(chosen.sampled_type, mi.BSDFFlags.Delta)
            goes_on &= dr.any(throughput != 0)
            depth = dr.select(si.is_valid(), depth + 1, depth)

            if self._max_depth > self._roulette_depth:
                survival = dr.minimum(dr.max(throughput) * stretch * stretch, _ROULETTE_MOST)
                at_risk = depth >= roulette_depth
                throughput = dr.select(at_risk, throughput * dr.rcp(survival), throughput)
                goes_on &= ~at_risk | (luck < survival)
            active = goes_on & (depth + 1 < most)
            left = goes_on & ~active
            state = sampler, depth, met, throughput, radiance, stretch, before, before_pdf, before_delta, ray
            return *state, active, left

        left = active & (most <= depth + 1)
        active &= most > depth + 1
        state = sampler, depth, met, throughput, radiance, stretch, before, before_pdf, before_delta, ray, active, left
        if self._max_depth == 2:
            # a single step needs no loop, which costs time
            end = step(*state) if begun is None else state
        else:
            end = dr.while_loop(state, lambda *values: values[-2], step, label="paths")
        _, depth, met, throughput, radiance, _, before, before_pdf, before_delta, ray, _, left = end

        # the last segment contributes only if it hits a light
        if not (scene.has_sky or self._lamps):
            return radiance, met
        if not scene.has_sky:
            left &= self._near_lamps(ray)
        if self._lamps:
            surface = scene.intersect(ray, moment, depth == 0, left)
            si, near = surface.rest, surface.met
        else:
            si = dr.zeros(mi.SurfaceInteraction3f, dr.width(ray))
            si.t, near = scene.distance(ray, moment, left)
            si.wi, si.wavelengths = -ray.d, ray.wavelengths
        met |= left & near
        # the throughput of a path that has ended is undefined
        shine = self.shine(si, left, before, before_pdf, before_delta, left_out(depth))
        return dr.select(left, dr.fma(throughput, shine, radiance), radiance), met

    def seen(self, si: Interaction, active: Mask, filter_index: UInt32) -> Float:
        """Flux of what surfaces themselves emit that rays from the camera hit, e⁻/s; see `shine`."""
        mi = self.scene.mi
        radiance = self.shine(si, active, dr.zeros(mi.Interaction3f), mi.Float(1.0), mi.Bool(True))
        return dr.sum(radiance) / len(radiance) * self.wavelengths.total(filter_index)

    def shine(
        self,
        si: Interaction,
        active: Mask,
        before: Interaction,
        pdf: Float,
        delta: Mask,
        known: KnownLights | None = None,
    ) -> Bands:
        """Light that a hit surface itself emits, with its weight against sampling of lights.

        Parameters
        ----------
        si, active : the surface, and lanes that count.
        before : vertex before it.
        pdf, delta : density of the direction that led to it, and True where this was the only one.
        known : lights that are left out; None for none.
        """
        mi, static = self.scene.mi, self.scene.static
        light = si.emitter(static, active)
        shines = active & (light != None)  # noqa: E711  (a Dr.Jit comparison)
        if known is not None:
            shines &= ~known.has(light)
        seen = mi.DirectionSample3f(static, si, before)
        light_pdf = static.pdf_emitter_direction(before, seen, shines & ~delta)
        if known is not None:
            light_pdf *= known.density
        share = dr.select(delta, 1.0, power_heuristic(pdf, light_pdf))
        return dr.select(shines, light.eval(si, shines) * share, 0.0)

    def scatter(
        self,
        surface: Surface,
        moment: Moment,
        goes_on: Mask,
        may_follow: Mask,
        numbers: tuple[Point2, Float, Point2],
        asks: Mask | bool = True,
        known: KnownLights | None = None,
    ) -> tuple[Bands, MitsubaObject, Bands, Mask]:
        """Light of one lamp that a vertex reflects, and the direction in which the path goes on.

        Parameters
        ----------
        surface : the vertex.
        goes_on : lanes with a vertex.
        may_follow : lanes with two segments or more to go.
        numbers : random numbers `place`, `lobe` and `light`, see `CounterSampler.next_vertex`.
        asks : lanes in which a lamp is sampled; False for none, where all surfaces are diffuse.
        known : lights that are left out; None for none.

        Returns
        -------
        reflected : radiance by light that was sampled.
        chosen, weight : sample of the direction, and its weight.
        near : True where the shadow ray came through the box of a moving object.
        """
        mi, scene, si = self.scene.mi, self.scene, surface.rest
        context, bsdf = mi.BSDFContext(), si.bsdf()
        place, lobe, light = numbers
        if asks is False:
            # where all surfaces are diffuse, there are no mirrors, and no images of lamps in them
            chosen, weight = bsdf.sample(context, si, lobe, place, goes_on)
            return mi.Spectrum(0.0), chosen, si.to_world_mueller(weight, -chosen.wo, si.wi), mi.Bool(False)

        # sample a light from this vertex
        asks = goes_on & asks & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        drawn = light if known is None else mi.Point2f(known.drawn(light.x), light.y)
        seen, weight = scene.static.sample_emitter_direction(surface.world, drawn, False, asks)
        if known is not None:
            asks &= ~known.has(seen.emitter)
            seen.pdf *= known.density
            weight /= known.density
        asks &= seen.pdf != 0
        shadow = scene.leaving.to(surface.world, seen.p)
        infinite = mi.has_flag(seen.emitter.flags(), mi.EmitterFlags.Infinite)
        # a sky has no distance; Mitsuba gives it one that depends on the size of the resting scene
        shadow.d = dr.select(infinite, seen.d, shadow.d)
        shadow.maxt = dr.select(infinite, dr.inf, shadow.maxt)
        asks &= dr.any(weight != 0)
        blocked, near = scene.occluded(shadow, moment, asks)
        clear = asks & ~blocked

        towards = surface.to_local(seen.d)
        choice = lobe
        if self._images:
            # a path to the image of a lamp needs two more segments
            is_diffuse = goes_on & mi.has_flag(bsdf.flags(), mi.BSDFFlags.DiffuseReflection) & may_follow
            upwards = dr.mulsign(mi.Vector3f(surface.shading_normal), mi.Frame3f.cos_theta(si.wi))
            cones = self._images.seen_from(surface.world.p, upwards, is_diffuse)
            # where no cone is chosen, rescale the random number for the surface's own sampling
            lobe = dr.maximum(choice - cones.chance, 0.0) / (1 - cones.chance)
        value, pdf, chosen, chosen_weight = bsdf.eval_pdf_sample(context, si, towards, lobe, place, goes_on)
        if self._images:
            pdf = dr.fma(1 - cones.chance, pdf, cones.density(seen.d))
            chosen_weight = redirected(bsdf, context, surface, cones, choice, place, chosen, chosen_weight)
        value = si.to_world_mueller(value, -towards, si.wi)
        share = dr.select(seen.delta, 1.0, power_heuristic(seen.pdf, pdf))
        chosen_weight = si.to_world_mueller(chosen_weight, -chosen.wo, si.wi)
        return dr.select(clear, value * weight * share, 0.0), chosen, chosen_weight, near

    def _near_lamps(self, ray: Ray) -> Mask:
        """True where a ray meets the box around a light."""
        inverse, near = inverse_of(ray.d), self.scene.mi.Bool(False)
        for box in self._lamps:
            near |= meets_box(ray, inverse, dr.inf, box)
        return near


def power_heuristic(a: Float, b: Float) -> Float:
    """Power heuristic of exponent 2: the weight of the strategy with density `a`."""
    a, b = a * a, b * b
    share = a / (a + b)
    return dr.select(dr.isfinite(share), share, 0.0)
