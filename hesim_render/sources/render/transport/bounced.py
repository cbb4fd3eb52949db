"""Light that has no closed form, from the first vertex of a path on.

`DiffuseIntegrator` knows the direct light of diffuse surfaces. What bounces to them from other surfaces, and all light
of surfaces that are not diffuse, is found by paths, whose first vertex is what the ray has hit.
"""

from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Mask, MitsubaObject, Ray, UInt32
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
) -> tuple[Float, Mask]:
    """Flux of the light that bounces to diffuse surfaces, and of all light that other surfaces reflect.

    Parameters
    ----------
    paths : traces the paths.
    sampler, moment, filter_index : see `PathIntegrator.flux`.
    surface, ray : first vertices, with what their BSDFs need, and the rays that hit them, with wavelengths.
    painted : lanes of which the direct light is known.
    other : lanes with surfaces that are not diffuse, none of which shines; None if the scene has none.

    Returns
    -------
    flux : e⁻/s.
    met : True where a path came through the box of a moving object.
    """
    mi, scene = paths.scene.mi, paths.scene
    asks: Mask | bool = False if other is None else other
    is_other = mi.Bool(False) if other is None else other
    goes_on = painted | is_other if paths.bounces else is_other
    place, lobe, light, _ = sampler.next_vertex(mi.Bool(True))
    given = surface, moment, goes_on, mi.Bool(paths.bounces), (place, lobe, light)
    reflected, chosen, weight, met = paths.scatter(*given, asks)
    goes_on &= dr.any(weight != 0)
    following = scene.leaving.along(surface.world, surface.to_world(chosen.wo))
    following.wavelengths = ray.wavelengths
    # what the second vertex itself emits is direct light: it is known of painted surfaces, and sampled at others
    density = dr.select(is_other, chosen.pdf, 0.0)
    is_delta = is_other & mi.has_flag(chosen.sampled_type, mi.BSDFFlags.Delta)
    sent, near = paths.sample(sampler, following, moment, Begun(surface.world, goes_on, density, is_delta))
    # lanes whose path ends here have no weight, or one that is undefined
    radiance = reflected + dr.select(goes_on, weight * sent, 0.0)
    return dr.sum(radiance) / len(radiance) * paths.wavelengths.total(filter_index), met | near
