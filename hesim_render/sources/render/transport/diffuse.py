"""Direct light on diffuse surfaces: colour, closed-form irradiance and visibility are computed separately.

Light k gives a diffuse surface of reflectance ρ the irradiance S_k(λ)·e_k(x, n). S_k is the irradiance on the light's
own plane, e_k depends on geometry alone. A pixel of response R(λ) then receives

    Φ = Σ_k C[k, ρ, R] · e_k(x, n) · V_k(x),     C[k, ρ, R] = ∫ R(λ) ρ(λ)/π S_k(λ) dλ

with V_k the visible share of the light. The spectral integrals are exact (spectra are linear between their samples) and
tabulated, e_k is a closed form, and rays estimate the visibility alone. A point drawn on the light contributes r to the
irradiance (E[r] = e_k) and is visible or not (v = 1 or 0). This gives two unbiased estimators of e_k·V_k, of which
one uses e_k as a control variate:

    controlled  e_k − (1 − v)·r     no noise where the whole light is visible, or `outlines` occlude the sky
    plain       v·r                 no noise where the whole light is occluded

Each pair of a pixel and a window uses the estimator that its pilot pass found less noisy.

A path tracer with multiple importance sampling [veach1997] estimates the product of all these factors at once. On the
dark side of a penumbra its error was three times as large, with more rays.
"""

from collections.abc import Mapping, Sequence
from math import pi

import numpy as np

from hesim_render.core.device import dr
from hesim_render.core.device_types import (
    Float,
    Mask,
    MitsubaObject,
    Ray,
    UInt32,
)
from hesim_render.core.host_arrays import from_host
from hesim_render.sources.render.scene.diffuse_scene import DiffuseScene
from hesim_render.sources.render.scene.pictures import TextureData
from hesim_render.sources.render.transport.bounced import bounced_flux
from hesim_render.sources.render.transport.known_lights import KnownTable, number_of
from hesim_render.sources.render.transport.light_sources import BallLamp, RectangleLamp, Sky, light_source
from hesim_render.sources.render.transport.moving_scene import MovingScene
from hesim_render.sources.render.transport.occluded_lamps import SLOTS, LampShadows
from hesim_render.sources.render.transport.outlines import OccludedSky
from hesim_render.sources.render.transport.paths import PathIntegrator
from hesim_render.sources.render.transport.swept_boxes import Moment
from hesim_render.sources.render.transport.texels import Texels
from hesim_render.spectral.spectrum import Spectrum, constant, integrate_product
from hesim_render.targets.piece import Picture

#: Columns of a shape's row in the table of paints: number of its one or two colours, how many of its sides are painted,
#: number of its lamp from 1, or -1 if paths see what it emits, the scale of its checks or picture, the number of its
#: picture from 1, and 1 for a shape that is not diffuse.
_ROW = 8
#: Row of a shape without paint: its front is black.
_BLACK = (0.0, 0.0, 1.0, 0.0, 1.0, 1.0, 0.0, 0.0)


class DiffuseIntegrator:
    """Flux of direct light on the diffuse shapes of a `MovingScene`, by the method of the module docstring, and of what
    paths find beside it.

    Parameters
    ----------
    scene : the scene to trace.
    diffuse : its paints and lights.
    responses : R per filter, in the order of the filter index; e⁻ s⁻¹ per W m⁻² sr⁻¹ nm⁻¹.
    paths : trace light that bounces, that of lights without a closed form, and all light of other shapes; None where
        there is none.
    """

    def __init__(
        self,
        scene: MovingScene,
        diffuse: DiffuseScene,
        responses: Mapping[str, Spectrum],
        paths: PathIntegrator | None = None,
    ) -> None:
        self._scene, self._paths = scene, paths
        #: Objects that compute e_k and draw a point, in the order of the scene's lights.
        self._lights = [light_source(scene.leaving, light) for light in diffuse.lights]
        irradiances = [light.level for light in diffuse.lights]
        # a ray that hits the light itself carries its strength
        even = {shape: radiance for shape, radiance in diffuse.glows.items() if radiance is not None}
        strengths = [*(light.strength for light in diffuse.lights), *even.values()]
        shining = [*(light.shape for light in diffuse.lights), *even]
        lamp_of = {shape: number for number, shape in enumerate(shining) if shape is not None}
        self._has_sky = bool(diffuse.lights) and diffuse.lights[-1].kind == "sky"
        self._outlines = OccludedSky(scene) if self._has_sky else None
        self._shadows = LampShadows(scene) if any(light.kind == "rectangle" for light in diffuse.lights) else None
        black = constant(0.0)
        colours: list[Spectrum] = [black]
        rows: dict[str, list[float]] = {}
        # numbers from 1, of pictures that repeat or not; parts of an object share one
        pictures: dict[tuple[Picture | TextureData, bool], int] = {}
        for paint in diffuse.paints:
            numbers = [len(colours) + k for k in range(len(paint.colours))]
            colours += paint.colours
            own = 0
            if paint.picture is not None:
                own = pictures.setdefault((paint.picture, paint.repeats), len(pictures) + 1)
            rows[paint.shape] = [numbers[0], numbers[-1], 1.0 + paint.two_sided, 0.0, *paint.scale, own, 0.0]
        for shape in diffuse.others:
            rows[shape] = [0.0] * (_ROW - 1) + [1.0]
        for shape, number in lamp_of.items():
            rows.setdefault(shape, [0.0] * _ROW)[3] = number + 1.0
        for shape in diffuse.glows.keys() - even.keys():
            rows.setdefault(shape, [0.0] * _ROW)[3] = -1.0
        self._has_others = bool(diffuse.others)
        # what rays may see of which paths say how bright it is: another sky, and shapes that do not shine evenly
        self._has_other_sky = scene.has_sky and not self._has_sky
        self._has_unknown = self._has_other_sky or len(even) < len(diffuse.glows)
        self._known: KnownTable | None = None
        if diffuse.glows or diffuse.more_lights:
            lamps = {light.shape for light in diffuse.lights if light.shape is not None}
            self._known = KnownTable(scene, lamps, diffuse.more_lights)
        self._has_checks = any(len(paint.colours) > 1 for paint in diffuse.paints)
        self._tables(rows, colours, irradiances, strengths, list(responses.values()))
        of_lights = irradiances, list(responses.values())
        # without light there is nothing to see of a picture
        self._texels = Texels(scene.mi, list(pictures), *of_lights) if pictures and irradiances else None
        dr.make_opaque(self._rows, self._reflected, self._emitted, self._filters, self._colours)

    def _tables(
        self,
        rows: Mapping[str, Sequence[float]],
        colours: Sequence[Spectrum],
        irradiances: Sequence[Spectrum],
        strengths: Sequence[Spectrum],
        responses: Sequence[Spectrum],
    ) -> None:
        """Tables of paints, by the number that Dr.Jit gives a shape, and of fluxes by (light, filter, colour) and
        (light, filter).
        """
        mi = self._scene.mi
        numbers = {number_of(mi, shape): rows.get(name, _BLACK) for name, shape in self._scene.shapes.items()}
        rows_of = np.zeros((max(numbers, default=0) + 1, _ROW))
        for place, row in numbers.items():
            rows_of[place] = row
        reflected = [
            [[integrate_product(r, colour, level) / pi for colour in colours] for r in responses]
            for level in irradiances
        ]
        emitted = [[integrate_product(r, strength) for r in responses] for strength in strengths]
        self._rows = from_host(mi.Float, rows_of)
        self._reflected = from_host(mi.Float, reflected or [[[0.0]]])
        self._emitted = from_host(mi.Float, [*emitted, [0.0] * len(responses)])
        self._filters, self._colours = mi.UInt32(len(responses)), mi.UInt32(len(colours))

    def flux(
        self,
        sampler: MitsubaObject,
        ray: Ray,
        moment: Moment,
        filter_index: UInt32,
        shadows: UInt32 | None = None,
    ) -> tuple[Float, Float, Float, Float | None, Mask]:
        """Trace one ray per lane.

        Parameters
        ----------
        sampler : `next_2d`, see `CounterSampler`.
        ray : Ray3f, world space.
        moment : time of each ray.
        filter_index : UInt32, filter of the ray's pixel.
        shadows : UInt32, shapes whose shadows are taken in closed form, see `LampShadows.before`; None for none.

        Returns
        -------
        controlled, plain : Float, both estimates of the flux, e⁻/s; with `shadows`, the controlled one twice.
        unshadowed : Float, the flux if nothing hid any light, e⁻/s, but for `shadows` of a single shape, and for balls.
        bounced : Float, the part of either estimate that paths find, e⁻/s; None if there are no paths.
        met : Bool, True where the path came through the box of a moving object.
        """
        mi, scene = self._scene.mi, self._scene
        if self._outlines is not None and self._outlines.groups:
            # outlines need these poses in all lanes, so surfaces and shadows may share them
            moment = scene.posed(moment, self._outlines.groups)
        flags = mi.RayFlags.UV | mi.RayFlags.ShadingFrame
        if self._paths is not None:
            flags = mi.RayFlags.All
            ray.wavelengths = mi.UnpolarizedSpectrum(*self._paths.wavelengths.sample(filter_index, sampler.next_1d()))
        surface = scene.intersect(ray, moment, True, mi.Bool(True), flags)
        si, met = surface.rest, surface.met
        hit = si.is_valid()
        which: UInt32 = dr.reinterpret_array(mi.UInt32, si.shape)
        first = 2 * dr.select(hit, which, 0)
        one, other, sides, lamp = dr.gather(mi.Vector4f, self._rows, first)
        front = mi.Frame3f.cos_theta(si.wi) > 0
        colour, texel = one, None
        if self._has_checks or self._texels is not None:
            u, v, picture, _ = dr.gather(mi.Vector4f, self._rows, first + 1)
            place = mi.Point2f(si.uv.x * u, si.uv.y * v)
            beyond = (place - dr.floor(place)) > 0.5
            colour = dr.select(beyond.x == beyond.y, one, other)
            if self._texels is not None:
                texel = self._texels.at(mi.UInt32(dr.maximum(picture - 1, 0)), place, hit & (picture > 0))

        # light sources that the ray hits
        emits = dr.select(hit, (lamp > 0) & front, self._has_sky)
        lights_beside_sky = len(self._lights) - self._has_sky
        source = dr.select(hit, mi.UInt32(dr.maximum(lamp - 1, 0)), mi.UInt32(lights_beside_sky))
        seen = dr.gather(mi.Float, self._emitted, source * self._filters + filter_index, emits)
        if self._has_unknown and self._paths is not None:
            seen += self._paths.seen(si, dr.select(hit, lamp < 0, self._has_other_sky), filter_index)

        # light that a painted surface reflects
        painted = hit & (front & (sides > 0) | (sides > 1))
        normal = mi.Vector3f(surface.shading_normal)
        normal = dr.select(front, normal, -normal)
        controlled, plain, unshadowed, onward = seen, seen, seen, None
        for number, light in enumerate(self._lights):
            open_, share, shadow = light.seen_from(surface.world, normal, sampler)
            # a lamp that is painted as well gives no light to itself; rounding would say it does
            asks = painted & (open_ > 0) & (lamp != number + 1)
            if isinstance(light, Sky):
                # what hides the sky here sends light by a path
                onward = shadow.d
            blocked, near = scene.occluded(shadow, moment, asks)
            met |= near
            scale = dr.gather(
                mi.Float,
                self._reflected,
                (number * self._filters + filter_index) * self._colours + mi.UInt32(colour),
                asks,
            )
            if self._texels is not None and texel is not None:
                scale = self._texels.factor(texel, number * self._filters + filter_index, scale, asks)
            known = open_
            if shadows is not None and self._shadows is not None and isinstance(light, RectangleLamp):
                of = normal, shadow, moment, dr.select(asks, shadows, 0)
                part, hits = self._shadows.before(light.rectangle, *of)
                known = dr.fma(share, hits, open_ - part * light.scale)
                # where two shapes hide the same, a ray may bring more than is known to arrive
                open_ = dr.select(shadows < 256, open_ - part * light.scale, open_)
            if self._outlines is not None and self._outlines.is_known and isinstance(light, Sky):
                # a share of the sky that is known to be hidden, and whether it hides this ray
                part, hides = self._outlines.hides(surface.world.p, normal, shadow.d, moment)
                known = open_ - part + hides
            controlled = dr.fma(scale, dr.select(blocked, known - share, known), controlled)
            plain = dr.fma(scale, dr.select(blocked, 0.0, share), plain)
            if isinstance(light, BallLamp):
                # the housing of a lamp hides a part of it from everywhere
                open_ = dr.select(blocked, 0.0, open_)
            unshadowed = dr.fma(scale, open_, unshadowed)
        bounced = None
        if self._paths is not None:
            other = None
            if self._has_others:
                other = hit & (dr.gather(mi.Float, self._rows, 4 * first + _ROW - 1, hit) > 0)
            known = None if self._known is None else self._known.where(painted)
            of_paths = self._paths, sampler, surface, ray, moment, filter_index
            bounced, near = bounced_flux(*of_paths, painted, other, known, onward)
            met |= near
            controlled, plain, unshadowed = controlled + bounced, plain + bounced, unshadowed + bounced
        # known shadows are known in all windows, so there is no choice
        return controlled, plain if shadows is None else controlled, unshadowed, bounced, met

    @property
    def moves_outlines(self) -> bool:
        """True if outlines before the sky move: the known share of the sky changes where no ray meets anything too."""
        return self._outlines is not None and bool(self._outlines.groups)

    @property
    def has_pictures(self) -> bool:
        """True if a surface has a picture."""
        return self._texels is not None

    @property
    def knows_shadows(self) -> bool:
        """True if there are shapes whose shadows have a closed form."""
        return self._shadows is not None and self._shadows.is_known

    def shadows_of(self, sampler: MitsubaObject, ray: Ray, moment: Moment) -> UInt32:
        """Shapes that hide lamps from what a ray of each lane hits: eight bits for each of the first lamps, see
        `LampShadows.first_met`.
        """
        mi, scene = self._scene.mi, self._scene
        assert self._shadows is not None
        surface = scene.intersect(ray, moment, True, mi.Bool(True), mi.RayFlags.Minimal)
        hit = surface.rest.is_valid()
        normal = mi.Vector3f(surface.world.n)
        normal = dr.select(dr.dot(normal, ray.d) < 0, normal, -normal)
        code = mi.UInt32(0)
        lamps = [light for light in self._lights if isinstance(light, RectangleLamp)]
        for number, lamp in enumerate(lamps[:SLOTS]):
            open_, _, shadow = lamp.seen_from(surface.world, normal, sampler)
            code |= self._shadows.first_met(shadow, moment, hit & (open_ > 0)) << (8 * number)
        return code
