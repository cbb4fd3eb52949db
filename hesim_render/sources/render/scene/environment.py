"""Environment maps: light from everywhere, as a picture of all directions, with a level on a plane."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device import dr
from hesim_render.core.device_types import MitsubaModule, MitsubaObject
from hesim_render.core.errors import SpecError
from hesim_render.core.guard import reading
from hesim_render.core.host_arrays import from_host
from hesim_render.core.units import LUMINOUS_EFFICACY_LM_PER_W
from hesim_render.sources.render.scene.mitsuba_version import as_spec_error, files_readable, transform
from hesim_render.sources.render.scene.sizes import require_fits
from hesim_render.specs.geometry import rotation_about
from hesim_render.specs.light import LightSpec
from hesim_render.spectral.spectrum import photopic

#: Wavelengths at which a map is summed up, nm, as many groups as lanes of four wavelengths need.
_WAVELENGTH_NM = np.linspace(360.0, 830.0, 96)
#: Directions that are evaluated at once.
_CHUNK = 1 << 20
#: Least part of the sphere's power that must fall onto the plane.
_LEAST = 1e-9


def environment(mi: MitsubaModule, light: LightSpec, normal: NDArray[np.float64], key: str) -> dict[str, Any]:
    """Mitsuba's emitter of an environment map that gives the wanted level on a plane, without shadows.

    The map is equirectangular, its upper edge at +y, its middle column at +z before the turn by `rotation_deg` about y.
    Colours are linear sRGB, which Mitsuba turns into smooth spectra times that of D65 [jakob2019].

    Parameters
    ----------
    mi : the mitsuba module.
    light : the light.
    normal : unit normal of its plane, [3].
    key : place of the light in the scene file, for errors.

    Raises
    ------
    SpecError
        If the file cannot be read, has negative values, or gives no light to the plane.
    """
    if mi.variant().startswith("scalar"):
        raise SpecError("environment maps of scene files are rendered in vectorised variants of Mitsuba only", key=key)
    file = light.folder / str(light.file)
    require_fits(file)
    with as_spec_error(file, f"{key}.file"), reading(file, "as a picture"), files_readable():
        picture = mi.Bitmap(str(file)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False)
    values = np.array(picture, dtype=np.float32)
    if not np.isfinite(values).all() or values.min() < 0 or min(values.shape[:2]) < 2:
        raise SpecError(
            "an environment map needs 2x2 pixels or more, with values of 0 or above", file=file, key=f"{key}.file"
        )
    pose = np.eye(4)
    pose[:3, :3] = rotation_about((0.0, 1.0, 0.0), light.rotation_deg)

    def plugin(scale: float) -> dict[str, Any]:
        return {"type": "envmap", "bitmap": mi.Bitmap(values), "scale": scale, "to_world": transform(mi, pose)}

    in_lux = light.illuminance_lux is not None
    level = level_on_plane(mi, mi.load_dict(plugin(1.0)), values.shape[:2], pose[:3, :3], normal, in_lux=in_lux)
    if not level > _LEAST * float(values.max()):
        raise SpecError("the environment map gives no light to the plane (see plane_normal)", key=key)
    wanted = light.illuminance_lux if light.illuminance_lux is not None else light.irradiance_w_m2
    return plugin(float(wanted or 0.0) / level)


def level_on_plane(
    mi: MitsubaModule,
    emitter: MitsubaObject,
    shape: tuple[int, int],
    turn: NDArray[np.float64],
    normal: NDArray[np.float64],
    in_lux: bool,
) -> float:
    """∫ L cos θ dω over the half sphere above a plane, lx or W m⁻² (360 to 830 nm): the sum over a map.

    Between four texels Mitsuba interpolates spectrum and scale apart, so their product is of the second degree along
    each axis: two points of Gauss along each are exact. They also lie off the texels, where a GPU's rounding of places
    would fetch the neighbours of the wrong cell.

    Parameters
    ----------
    emitter : the environment.
    shape : rows and columns of its map, whose rows run from pole to pole.
    turn : rotation of the map, [3, 3].
    normal : unit normal of the plane, [3].
    in_lux : weigh by the luminous efficiency.
    """
    rows, cols = shape
    # two points in each cell between texels, as multiples of its size; texels lie on both poles, and half a column from
    # the seam
    points = (np.arange(max(rows - 1, cols))[:, None] + 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)).ravel()
    theta, phi = points[: 2 * (rows - 1)] * np.pi / (rows - 1), (points[: 2 * cols] + 0.5) * 2 * np.pi / cols
    rows_at_once, total = max(1, _CHUNK // phi.size), 0.0
    weight_nm = np.full(_WAVELENGTH_NM.size, _WAVELENGTH_NM[1] - _WAVELENGTH_NM[0])
    weight_nm[[0, -1]] /= 2
    if in_lux:
        weight_nm *= LUMINOUS_EFFICACY_LM_PER_W * photopic().at(_WAVELENGTH_NM)
    for first in range(0, theta.size, rows_at_once):
        polar = theta[first : first + rows_at_once, None]
        own = np.broadcast_arrays(np.sin(phi) * np.sin(polar), np.cos(polar), -np.cos(phi) * np.sin(polar))
        direction = turn @ np.stack(own).reshape(3, -1)
        weight = np.maximum(normal @ direction, 0.0) * np.repeat(np.sin(polar), phi.size)
        seen = np.flatnonzero(weight > 0)
        if seen.size == 0:
            continue
        si = dr.zeros(mi.SurfaceInteraction3f, seen.size)
        si.wi = mi.Vector3f(*(from_host(mi.Float, -each[seen]) for each in direction))
        level = dr.zeros(mi.Float, seen.size)
        # one kernel for all groups of four wavelengths, which leaves their sum on the device
        for wavelengths, weights in zip(_WAVELENGTH_NM.reshape(-1, 4), weight_nm.reshape(-1, 4), strict=True):
            si.wavelengths = type(si.wavelengths)([dr.opaque(mi.Float, float(one)) for one in wavelengths])
            radiance = emitter.eval(si)
            for band, one in enumerate(weights):
                level += radiance[band] * dr.opaque(mi.Float, float(one))
            dr.eval(level)
        total += float(np.array(level, np.float64) @ weight[seen])
    return total / 4 * (np.pi / (rows - 1)) * (2 * np.pi / cols)
