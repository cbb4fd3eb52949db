"""A second, independent estimate of the flux: Mitsuba's own camera, film and sampler."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import atan, degrees
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.device_types import MitsubaModule
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.render.camera import MITSUBA_AXES, View, place_camera
from hesim_render.sources.render.exact import used_responses
from hesim_render.sources.render.light_level import in_absolute_light
from hesim_render.sources.render.scene.builder import build
from hesim_render.sources.render.scene.mitsuba_version import mitsuba, spectrum_dict, transform
from hesim_render.sources.render.scene.parents import camera_trajectory
from hesim_render.sources.scene import Scene, light_parts

#: Effects that Mitsuba's cameras have, or that are factors on their pictures.
_MITSUBA_HAS = ("relative_illumination", "depth_of_field")


@contextmanager
def using_variant(name: str | None) -> Iterator[MitsubaModule]:
    """The mitsuba module, temporarily in another variant (``scalar_spectral``); None keeps the variant of the backend.

    Raises
    ------
    SpecError
        If this build of Mitsuba lacks the variant.
    """
    mi = mitsuba()
    if name is None or name == mi.variant():
        yield mi
        return
    if name not in mi.variants() or "spectral" not in name:
        spectral = ", ".join(v for v in mi.variants() if "spectral" in v)
        raise SpecError(f"no spectral Mitsuba variant {name!r}; this build has {spectral}")
    before = mi.variant()
    mi.set_variant(name)
    mi.set_log_level(mi.LogLevel.Error)
    try:
        yield mi
    finally:
        mi.set_variant(before)


@dataclass(frozen=True)
class ReferenceFlux:
    """Flux of every pixel as if all had the same filter.

    Parameters
    ----------
    flux : per filter, [row, col], e⁻/s.
    stderr : standard error of each, from the scatter of independent renders, [row, col].
    sensor : with the lens in use.
    """

    flux: dict[str, NDArray[np.float64]]
    stderr: dict[str, NDArray[np.float64]]
    sensor: Sensor

    def mosaic(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Flux and standard error of each pixel through its own filter, [row, col]."""
        index = self.sensor.layout.filter_index
        names = self.sensor.layout.filters
        blank = np.zeros(self.sensor.layout.shape)
        flux = np.stack([self.flux.get(name, blank) for name in names])
        stderr = np.stack([self.stderr.get(name, blank) for name in names])
        choose = index[None].astype(np.intp)
        return np.take_along_axis(flux, choose, axis=0)[0], np.take_along_axis(stderr, choose, axis=0)[0]


def require_plain_lens(sensor: Sensor) -> None:
    """Refuse effects of a lens that Mitsuba's own cameras do not have.

    Raises
    ------
    SpecError
        Names the key of the first of them.
    """
    for name in sensor.optics.used_effects():
        if name not in _MITSUBA_HAS:
            key = "psf_fwhm_um" if name == "psf" and sensor.optics.psf is None else name
            raise SpecError("cameras of Mitsuba do not have this effect; leave it away", key=f"lens.{key}")


def perspective_dict(
    mi: MitsubaModule, view: View, camera_to_world: NDArray[np.float64], film: dict[str, Any]
) -> dict[str, Any]:
    """Mitsuba's perspective or thin-lens sensor over exactly the read-out region."""
    left, right, top, bottom = view.region_mm
    width, height = right - left, bottom - top
    image_mm, (axis_x, axis_y) = view.sensor.lens.image_distance_mm, view.sensor.lens.axis_mm
    # Mitsuba measures the offset of the film's centre from the axis in units of the film's size
    off = ((left + right) / 2 - axis_x) / width, ((top + bottom) / 2 - axis_y) / height
    lens = view.sensor.lens
    kind: dict[str, Any] = {
        "type": "perspective", "principal_point_offset_x": off[0], "principal_point_offset_y": off[1]
    }  # fmt: skip
    if view.sensor.optics.depth_of_field:
        if max(map(abs, off)) > 1e-9:
            raise SpecError("Mitsuba's thin lens has its axis in the middle: choose a region around the axis")
        focus_m = min(lens.focus_distance_m, 1e5)
        kind = {"type": "thinlens", "aperture_radius": lens.pupil_radius_m, "focus_distance": focus_m}
    return {
        **kind,
        "fov": degrees(2 * atan(width / 2 / image_mm)),
        "fov_axis": "x",
        "near_clip": max(1e-4, view.near_m),
        "far_clip": 1e5,
        "to_world": transform(mi, camera_to_world @ MITSUBA_AXES),
        "sampler": {"type": "independent"},
        "film": film,
    }


def camera_at(scene: Scene, view: View, t_us: ArrayLike) -> NDArray[np.float64]:
    """Camera-to-world matrices at times [...], µs: [..., 4, 4], or a single one [4, 4] if the camera rests."""
    camera = camera_trajectory(scene.spec)
    return view.camera_to_world if camera is None else camera.matrix(t_us) @ view.camera_to_world


def reference_flux(
    scene: Scene,
    sensor: Sensor,
    samples: int,
    t_us: float = 0.0,
    variant: str | None = None,
    *,
    repeats: int = 8,
    seed: int = 0,
) -> ReferenceFlux:
    """Flux at one instant through `mitsuba.render` and a ``specfilm`` whose channels are the pixel responses.

    It shares the scene's geometry and the lens with `RenderedFlux`, but neither rays, wavelengths,
    random numbers nor film. It also runs in scalar variants. Relative illumination is applied.

    Parameters
    ----------
    scene, sensor : the scene and the sensor that sees it.
    samples : rays per pixel and repeat.
    t_us : instant at which objects, camera and lights are frozen, µs.
    variant : a spectral Mitsuba variant, such as ``scalar_spectral``; default: that of the backend.
    repeats : independent renders, 2 or more; their scatter gives the standard error.
    seed : seed of the random numbers.

    Returns
    -------
    Flux and standard error per filter, [row, col], e⁻/s.

    Raises
    ------
    SpecError
        If the scene is not valid, the variant is missing, or the lens has effects that Mitsuba's cameras lack.
    RangeError
        If `samples` is below 1 or `repeats` below 2.
    """
    if samples < 1:
        raise RangeError("samples", samples, "1 or more")
    if repeats < 2:
        raise RangeError("repeats", repeats, "2 or more")
    require_plain_lens(sensor)
    scene, _ = in_absolute_light(scene)
    parts = [(1.0 if w is None else float(w.mean(t_us, t_us)), part) for w, part in light_parts(scene)]
    view: View | None = None
    renders = np.zeros(1)
    with using_variant(variant) as mi:
        for power, part in parts:
            view, own = _renders(mi, part, sensor, samples, t_us, repeats, seed)
            renders = renders + power * own
    assert view is not None
    scale = scene.spec.mitsuba.radiance_scale if scene.spec.mitsuba is not None else 1.0
    renders = renders * (view.sensor.relative_illumination * scale)[None, :, :, None]
    mean = renders.mean(axis=0)
    stderr = renders.std(axis=0, ddof=1) / np.sqrt(repeats)
    names = list(used_responses(view.sensor))
    return ReferenceFlux(
        {name: mean[:, :, k] for k, name in enumerate(names)},
        {name: stderr[:, :, k] for k, name in enumerate(names)},
        view.sensor,
    )


def _renders(
    mi: MitsubaModule, scene: Scene, sensor: Sensor, samples: int, t_us: float, repeats: int, seed: int
) -> tuple[View, NDArray[np.float64]]:
    """The placed camera and [repeat, row, col, filter] without relative illumination, lights at their mean power."""
    built = build(mi, scene.spec, used_responses(sensor))
    view = place_camera(scene.spec, sensor, built.mitsuba_sensor())
    responses = used_responses(view.sensor)
    if built.is_dark:
        return view, np.zeros((repeats, *view.sensor.layout.shape, len(responses)))
    built.pose(t_us)
    film = {
        "type": "specfilm",
        "width": view.sensor.cols,
        "height": view.sensor.rows,
        "component_format": "float32",
        "rfilter": {"type": "box"},
        # Mitsuba returns channels in the order of their names
        **{f"channel_{number:03d}": spectrum_dict(response) for number, response in enumerate(responses.values())},
    }
    camera = mi.load_dict(perspective_dict(mi, view, camera_at(scene, view, t_us), film))
    renders = [
        np.array(
            mi.render(built.scene, sensor=camera, integrator=built.integrator, spp=samples, seed=seed + k),
            dtype=np.float64,
        )
        for k in range(repeats)
    ]
    return view, np.stack(renders)
