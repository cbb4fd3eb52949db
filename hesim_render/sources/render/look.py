"""A quick picture of the framing of a scene: which surfaces the sensor sees, without light."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import MitsubaModule, MitsubaObject
from hesim_render.core.host_arrays import from_host
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.render.camera import View, place_camera
from hesim_render.sources.render.framing import Framing, framing, outline, posed_view
from hesim_render.sources.render.primary_rays import RayFactory
from hesim_render.sources.render.scene.builder import build
from hesim_render.sources.render.scene.mesh_file import FileMaterial, file_materials
from hesim_render.sources.render.scene.mitsuba_version import mitsuba
from hesim_render.sources.scene import Scene
from hesim_render.spectral.transfer import encode

#: Longer side of the picture, pixels; part of the region's size that is shown beside it.
_LONGER_SIDE, _BESIDE = 640, 0.125
#: Wavelengths that stand for red, green and blue, nm. A ray carries four.
_COLOURS_NM = (610.0, 545.0, 465.0, 465.0)
#: Brightness of a surface seen at a grazing angle, and of what is outside of the picture.
_GRAZING, _OUTSIDE = 0.35, 0.45
#: Reflectance that stands for glass and metal.
_CLEAR = 0.3
_SKY = (0.25, 0.30, 0.40)


@dataclass(frozen=True, eq=False)
class FramingLook:
    """The framing of a scene.

    Parameters
    ----------
    picture : uint8 [row, col, 3], sRGB; the region that is read out, and darkened the surroundings.
    region : left, top, right, bottom of the read-out region in the picture.
    target : the target in the picture; None without a target.
    materials : materials of GLB and glTF files as they are rendered, by the name of the object.
    """

    picture: NDArray[np.uint8]
    region: tuple[float, float, float, float]
    target: Framing | None
    materials: dict[str, list[FileMaterial]] = field(default_factory=dict)


def look(scene: Scene, sensor: Sensor) -> FramingLook:
    """Show what a sensor sees of a scene at t = 0, as a picture without light, noise and filters.

    Each pixel has the diffuse reflectance at three wavelengths of the first surface, darker where it is seen at a
    grazing angle. Lamps are white. It works in darkness as well.

    Parameters
    ----------
    scene, sensor : from `load_scene` and `load_sensor`, cropped to the region that is read out.

    Raises
    ------
    SpecError
        If the scene cannot be loaded.
    """
    mi = mitsuba()
    built = build(mi, scene.spec)
    view = place_camera(scene.spec, sensor, built.mitsuba_sensor())
    built.pose(0.0)
    own = view.sensor
    scale = max(own.cols, own.rows) / (_LONGER_SIDE / (1 + 2 * _BESIDE))
    beside = _BESIDE * max(own.cols, own.rows)
    width, height = (round((count + 2 * beside) / scale) for count in (own.cols, own.rows))
    x, y = np.meshgrid((np.arange(width) + 0.5) * scale - beside, (np.arange(height) + 0.5) * scale - beside)
    colours = _colours(mi, built.scene, posed_view(scene.spec, view, 0.0), x.ravel(), y.ravel())
    inside = (x >= 0) & (x < own.cols) & (y >= 0) & (y < own.rows)
    shown = colours.reshape(height, width, 3) * np.where(inside, 1.0, _OUTSIDE)[..., None]
    left, top = beside / scale, beside / scale
    region = (left, top, left + own.cols / scale, top + own.rows / scale)
    rim = outline(scene.spec, view)
    picture = encode(np.clip(shown, 0, 1).astype(np.float32), "srgb", depth=8)
    drawn = _with_lines(picture, region, None if rim is None else (rim + beside) / scale)
    return FramingLook(drawn, region, framing(scene.spec, view), file_materials(scene.spec))


def _colours(mi: MitsubaModule, scene: MitsubaObject, view: View, x: NDArray, y: NDArray) -> NDArray[np.float64]:
    """Colours of the first surfaces behind places of the region (0, 0 is its upper left corner), [n, 3]."""
    types = jit()
    layout = view.sensor.layout
    row = from_host(types.Float, y + layout.row0 - 0.5)
    col = from_host(types.Float, x + layout.col0 - 0.5)
    middle = types.Float(0.5)
    origin, direction = RayFactory(view).rays(row, col, (middle, middle), None)
    bands = mi.UnpolarizedSpectrum(*_COLOURS_NM)
    ray = mi.RayDifferential3f(mi.Point3f(*origin), mi.Vector3f(*direction), mi.Float(0.0), bands)
    si = scene.ray_intersect(ray)
    hit = si.is_valid()
    bsdf = si.bsdf(ray)
    reflected = bsdf.eval_diffuse_reflectance(si, hit)
    # glass and metal have no diffuse part; without light they would be black
    clear = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta) | mi.has_flag(bsdf.flags(), mi.BSDFFlags.Glossy)
    reflected = dr.select(clear & ~dr.any(reflected > 0), _CLEAR, reflected)
    shade = _GRAZING + (1 - _GRAZING) * dr.abs(dr.dot(si.n, ray.d))
    shines = dr.any(si.emitter(scene, hit).eval(si, hit) > 0) & hit
    channels = []
    for k, sky in enumerate(_SKY):
        colour = dr.select(shines, 1.0, reflected[k] * shade)
        channels.append(np.array(dr.select(hit, colour, sky), dtype=np.float64))
    return np.stack(channels, axis=-1)


def _with_lines(
    picture: NDArray[np.uint8], region: tuple[float, float, float, float], rim: NDArray[np.float64] | None
) -> NDArray[np.uint8]:
    """The picture with the region (white) and the target (red) outlined."""
    from PIL import Image, ImageDraw

    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image)
    if rim is not None:
        points = [tuple(point) for point in np.clip(rim, -1e4, 1e4).tolist()]
        draw.line([*points, points[0]], fill=(230, 60, 40), width=2)
    left, top, right, bottom = region
    draw.rectangle((left - 1, top - 1, right, bottom), outline=(255, 255, 255))
    return np.asarray(image)
