"""Surfaces that chief rays meet: one ray of each place in the picture, at a time of its own.

Rays run through the same `MovingScene` as those of the renderer, so that objects and camera are where the render has
them at every instant. Directions and positions are computed in float64 from the distance that Mitsuba finds.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Ray, UInt32
from hesim_render.core.host_arrays import from_host
from hesim_render.core.method_cache import method_cache
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.render.camera import place_camera
from hesim_render.sources.render.change_driven.windows import Moments, Windows
from hesim_render.sources.render.primary_rays import RayFactory
from hesim_render.sources.render.scene.builder import build
from hesim_render.sources.render.scene.mitsuba_version import mitsuba
from hesim_render.sources.render.scene.parents import camera_trajectory
from hesim_render.sources.render.scene.trajectory import Trajectory
from hesim_render.sources.render.tracer import BLOCK_RAYS
from hesim_render.sources.render.transport.moving_scene import MovingScene
from hesim_render.sources.render.transport.swept_boxes import Moment
from hesim_render.sources.render.truth.names import Names
from hesim_render.sources.scene import Scene
from hesim_render.specs.light import irradiance
from hesim_render.specs.scene import SceneSpec
from hesim_render.spectral.spectrum import illuminance_lux

#: Part of the way to a point in which nothing may lie if the point is visible. The rest is left to rounding.
FREE_PART = 1 - 1e-4
#: Brightness that stands for glass and metal, of the sky of a Mitsuba scene, and of what is seen at a grazing angle
#: over what faces the camera (`ChiefRays.brightness`).
CLEAR, SKY, _GRAZING = 0.3, 0.3, 0.35


class Hits(NamedTuple):
    """Surfaces that rays met, [n] each.

    Parameters
    ----------
    distance_m : distance from the entrance pupil, float32; infinite where nothing was met.
    shape : number of the shape that moves or rests as a whole: an instance where there is one; see `Names`.
    material : number of the reflection model.
    normal : [n, 3], geometric unit normal in world axes, on the side of the camera, float32; NaN where nothing was met.
    """

    distance_m: NDArray[np.float32]
    shape: NDArray[np.uint32]
    material: NDArray[np.uint32]
    normal: NDArray[np.float32]


@dataclass(frozen=True)
class Placed:
    """Rays through places of the picture: columns and rows of the full sensor and times, [n] each.

    Parameters
    ----------
    col, row : whole pixels.
    t_us : time of each ray, µs.
    """

    col: NDArray[np.float64]
    row: NDArray[np.float64]
    t_us: NDArray[np.float64]


def sky_brightness(spec: SceneSpec) -> float:
    """Brightness of what lies behind all surfaces, over that of a white card in the same light: the part of the lights'
    level that comes from everywhere. `SKY` for a Mitsuba scene, whose lights are its own.
    """
    if spec.mitsuba is not None:
        return SKY
    levels = [(light, irradiance(light)) for light in spec.lights]
    lux = [(light.type in ("uniform", "environment"), illuminance_lux(level)) for light, level in levels if level]
    return sum(own for everywhere, own in lux if everywhere) / total if (total := sum(own for _, own in lux)) else 0.0


class ChiefRays:
    """Intersects rays from the camera with a moving scene.

    Parameters
    ----------
    scene, sensor : the scene and the sensor that sees it.

    Attributes
    ----------
    view : the placed camera; `sensor` has the lens in use.
    camera : trajectory of the camera, None if it rests.
    parts : the scene; its groups move.
    names : names of everything that can be met.

    Raises
    ------
    SpecError
        If the scene cannot be loaded.
    """

    def __init__(self, scene: Scene, sensor: Sensor) -> None:
        self._mi = mitsuba()
        self._sky = sky_brightness(scene.spec)
        self.built = build(self._mi, scene.spec)
        self.view = place_camera(scene.spec, sensor, self.built.mitsuba_sensor())
        self.sensor = self.view.sensor
        self.camera = camera_trajectory(scene.spec)
        self.parts = MovingScene(self.built, geometry_only=True)
        self.names = Names.of(self._mi, self.built, self.parts)
        self._rays = RayFactory(self.view)
        self._boxes = method_cache(self.parts.box_rows_in, maxsize=8)

    @property
    def tracks(self) -> list[Trajectory]:
        """Trajectories of the groups, in their order."""
        return [group.trajectory for group in self.parts.groups]

    def camera_to_world(self, t_us: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pose of the camera, [..., 4, 4]; its axes are those of camera space (y up, looking along −z)."""
        if self.camera is None:
            return np.broadcast_to(self.view.camera_to_world, (*np.shape(t_us), 4, 4))
        return self.camera.matrix(t_us) @ self.view.camera_to_world

    def _moment(self, t_us: NDArray[np.float64]) -> tuple[Moments, NDArray[np.float32]]:
        """All times as shares of one window."""
        # one window from the first to the last time, so that each ray may have its own
        span = float(t_us.min()), float(t_us.max())
        windows = Windows(np.array(span[:1]), np.array(span[1:]))
        tracks = self.tracks + ([self.camera] if self.camera else [])
        moments = Moments.of(windows, span, tracks, self._boxes)
        share = (t_us - span[0]) / max(span[1] - span[0], 1e-300)
        return moments, share.astype(np.float32)

    def _now(self, moments: Moments, share: Float) -> Moment:
        return moments.at(jit().UInt32(0), share)

    def _seen(self, row: Float, col: Float, offset: tuple[Float, Float], now: Moment) -> tuple[Ray, Float]:
        """Rays from the camera in world space; and depth along the axis at distance 1."""
        types = jit()
        aperture = offset[0] + 0.5, offset[1] + 0.5
        origin, direction = self._rays.rays(row, col, aperture, None)
        axis = types.Array3f(*(dr.opaque(types.Float, float(-v)) for v in self.view.camera_to_world[:3, 2]))
        along = dr.dot(axis, direction)
        if self.camera is not None:
            pose = self.camera.pose_at(now.local_us(len(self.parts.groups)))
            origin, direction = pose.to_world(origin), pose.turn_to_world(direction)
        mi = self._mi
        return mi.Ray3f(mi.Point3f(*origin), mi.Vector3f(*direction)), along

    def trace(self, at: Placed, offset_px: tuple[float, float] = (0.0, 0.0)) -> Hits:
        """The nearest surface on each ray.

        Parameters
        ----------
        at : places and times.
        offset_px : place beside the pixels' centres, px, to the right and downwards.
        """
        mi, types = mitsuba(), jit()
        near = dr.opaque(types.Float, self.view.near_m)
        count = at.t_us.size
        distance, normal = np.empty(count, np.float32), np.empty((count, 3), np.float32)
        shape, material = np.empty(count, np.uint32), np.empty(count, np.uint32)
        for part, ray, along, now in self._blocks(at, offset_px):
            surface = self.parts.intersect(ray, now, True, mi.Bool(True), mi.RayFlags.Minimal)
            rest, lanes = surface.rest, part.stop - part.start
            met = rest.is_valid()
            # normals point to the side of the camera; of an instance of a group, the instance is what has a name
            facing = dr.select(dr.dot(surface.world.n, ray.d) > 0, -1.0, 1.0)
            instance: UInt32 = dr.reinterpret_array(types.UInt32, rest.instance)
            own: UInt32 = dr.reinterpret_array(types.UInt32, rest.shape)
            columns = (
                dr.select(met, rest.t + near / along, dr.inf),
                *(dr.select(met, value * facing, dr.nan) for value in surface.world.n),
                dr.select(met, dr.select(instance != 0, instance, own), 0),
                dr.select(met, dr.reinterpret_array(types.UInt32, rest.bsdf()), 0),
            )
            columns = tuple(value + dr.zeros(type(value), lanes) for value in columns)
            dr.eval(columns)
            t, x, y, z, met_shape, met_material = (np.array(value) for value in columns)
            distance[part], shape[part], material[part] = t, met_shape, met_material
            normal[part] = np.stack([x, y, z], axis=1)
        return Hits(distance, shape, material, normal)

    def _blocks(self, at: Placed, offset_px: tuple[float, float]) -> Iterator[tuple[slice, Ray, Float, Moment]]:
        """Rays block by block: which they are, the rays, their depth at distance 1, and their times."""
        types = jit()
        moments, share = self._moment(at.t_us)
        offset = dr.opaque(types.Float, offset_px[0]), dr.opaque(types.Float, offset_px[1])
        for first in range(0, share.size, BLOCK_RAYS):
            part = slice(first, min(first + BLOCK_RAYS, share.size))
            row, col, shares = (from_host(types.Float, values[part]) for values in (at.row, at.col, share))
            now = self._now(moments, shares)
            yield part, *self._seen(row, col, offset, now), now

    def brightness(self, at: Placed, wavelengths_nm: Sequence[float]) -> NDArray[np.float32]:
        """Light that surfaces send to the camera if it came from there, over that of a white card; no light is traced.

        Parameters
        ----------
        at : places and times.
        wavelengths_nm : four wavelengths, nm.

        Returns
        -------
        [n, 4]: diffuse reflectance, darker where a surface is seen at a grazing angle. `CLEAR` where glass or metal has
        none, 1 for lamps, `sky_brightness` where nothing was met.
        """
        mi = mitsuba()
        values = np.empty((at.t_us.size, 4), np.float32)
        bands = mi.UnpolarizedSpectrum(*(dr.opaque(mi.Float, float(value)) for value in wavelengths_nm))
        for part, ray, _, now in self._blocks(at, (0.0, 0.0)):
            ray.wavelengths = bands
            surface = self.parts.intersect(ray, now, True, mi.Bool(True))
            rest = surface.rest
            met = rest.is_valid()
            bsdf = rest.bsdf()
            # glass and metal have no diffuse part: they are drawn as clear
            reflected = bsdf.eval_diffuse_reflectance(rest, met)
            clear = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta) | mi.has_flag(bsdf.flags(), mi.BSDFFlags.Glossy)
            reflected = dr.select(clear & ~dr.any(reflected > 0), CLEAR, reflected)
            shade = _GRAZING + (1 - _GRAZING) * dr.abs(dr.dot(surface.world.n, ray.d))
            value = dr.select(met, dr.select(rest.shape.is_emitter(), 1.0, reflected * shade), self._sky)
            columns = [value[k] + dr.zeros(mi.Float, part.stop - part.start) for k in range(4)]
            dr.eval(columns)
            for k, column in enumerate(columns):
                values[part, k] = np.array(column)
        return values

    def sees(
        self, points: NDArray[np.float64], t_us: NDArray[np.float64], origin: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Whether nothing lies between the camera and points at given times.

        Parameters
        ----------
        points : [n, 3], world, m; where the row is not finite, the result is False.
        t_us : [n], µs.
        origin : [n, 3], position of the camera, m.

        Returns
        -------
        [n]; surfaces within the last 1e-4 of the way do not occlude a point.
        """
        way = points - origin
        length = np.linalg.norm(way, axis=1)
        usable = np.isfinite(length) & (length > 0)
        return self._clear(way / np.where(usable, length, 1.0)[:, None], length, t_us, origin, usable)

    def sees_sky(
        self, directions: NDArray[np.float64], t_us: NDArray[np.float64], origin: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Whether nothing lies in world directions [n, 3]; see `sees`."""
        way = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        usable = np.isfinite(way).all(axis=1)
        return self._clear(way, np.full(len(way), np.inf), t_us, origin, usable)

    def _clear(
        self,
        direction: NDArray[np.float64],
        length: NDArray[np.float64],
        t_us: NDArray[np.float64],
        origin: NDArray[np.float64],
        usable: NDArray[np.bool_],
    ) -> NDArray[np.bool_]:
        mi, types = mitsuba(), jit()
        clear = np.zeros(usable.size, np.bool_)
        where = np.flatnonzero(usable)
        if where.size == 0:
            return clear
        moments, share = self._moment(t_us[where])
        for first in range(0, where.size, BLOCK_RAYS):
            lanes = where[first : first + BLOCK_RAYS]
            start = origin[lanes]
            if self.view.near_m > 0:
                start = start + direction[lanes] * self.view.near_m  # surfaces nearer than that are not seen
            o, d = ([from_host(types.Float, v) for v in values.T] for values in (start, direction[lanes]))
            ray = mi.Ray3f(mi.Point3f(*o), mi.Vector3f(*d))
            reach = np.minimum((length[lanes] - self.view.near_m) * FREE_PART, 1e30)
            ray.maxt = from_host(types.Float, reach)
            now = self._now(moments, from_host(types.Float, share[first : first + BLOCK_RAYS]))
            blocked, _ = self.parts.occluded(ray, now, mi.Bool(True))
            blocked = blocked | dr.zeros(mi.Bool, lanes.size)
            clear[lanes] = ~np.array(blocked)
        return clear
