"""Light that has no closed form, from the first vertex of a path on.

`DiffuseIntegrator` knows the direct light that lights of closed form give diffuse surfaces. What bounces to them from
other surfaces, what other lights give them, and all light of surfaces that are not diffuse is found by paths, whose
first vertex is what the ray has hit.
"""

from math import pi

from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Mask, MitsubaObject, Ray, UInt32, Vector3
from hesim_render.sources.render.transport.known_lights import KnownLights
from hesim_render.sources.render.transport.moving_scene import Surface
from hesim_render.sources.render.transport.paths import Begun, PathIntegrator
from hesim_render.sources.render.transport.swept_boxes import Moment


def bounced_flux(
    paths: PathIntegrator,
    sampler: MitsubaObject,
    surface: Surface,
    ray: Ray,
    moment: Moment,
    filter_index: UInt32,
    painted: Mask,
    other: Mask | None,
    known: KnownLights | None,
    onward: Vector3 | None,
) -> tuple[Float, Mask]:
    """Flux of what paths find beside closed forms, without what the surface itself emits.

    Parameters
    ----------
    paths : traces the paths.
    sampler, moment, filter_index : see `PathIntegrator.flux`.
    surface, ray : first vertices, with what their BSDFs need, and the rays that hit them, with wavelengths.
    painted : lanes of which the direct light of some lights is known.
    other : lanes with surfaces that are not diffuse; None if the scene has none.
    known : lights of which it is known; None for all.
    onward : direction in which paths go on from painted lanes, with a cosine distribution about the normal; None: one
        of their own. With that of the shadow ray to a sky, a ray brings either the sky's light or that of what hides
        the sky, which differ less from ray to ray than the light of two directions.

    Returns
    -------
    flux : e⁻/s.
    met : True where a path came through the box of a moving object.
    """
    mi, scene = paths.scene.mi, paths.scene
    is_other = mi.Bool(False) if other is None else other
    goes_on = painted | is_other if paths.bounces or known is not None else is_other
    # where lights are sampled
    asks: Mask | bool = goes_on if known is not None else False if other is None else other
    place, lobe, light, _ = sampler.next_vertex(mi.Bool(True))
    given = surface, moment, goes_on, mi.Bool(paths.bounces), (place, lobe, light)
    reflected, chosen, weight, met = paths.scatter(*given, asks, known)
    if onward is not None and not paths.sees_images:
        # a diffuse surface weighs all directions alike; those of cones about images of lamps save more noise
        chosen.wo = dr.select(painted, surface.to_local(onward), chosen.wo)
        chosen.pdf = dr.select(painted, dr.abs(mi.Frame3f.cos_theta(chosen.wo)) / pi, chosen.pdf)
    goes_on = goes_on & dr.any(weight != 0)
    following = scene.leaving.along(surface.world, surface.to_world(chosen.wo))
    following.wavelengths = ray.wavelengths
    # what the second vertex itself emits is direct light: where no light is sampled, all of it is known
    density = dr.select(asks, chosen.pdf, 0.0)
    is_delta = asks & mi.has_flag(chosen.sampled_type, mi.BSDFFlags.Delta)
    begun = Begun(surface.world, goes_on, density, is_delta, known)
    sent, near = paths.sample(sampler, following, moment, begun)
    # lanes whose path ends here have no weight, or one that is undefined
    radiance = reflected + dr.select(goes_on, weight * sent, 0.0)
    return dr.sum(radiance) / len(radiance) * paths.wavelengths.total(filter_index), met | near
