"""Flux of single pixels at single instants, by Mitsuba alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from mitsuba_specfilm import camera_at, perspective_dict
from numpy.typing import NDArray

from hesim_render.core.device_types import MitsubaModule, MitsubaObject
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.render.camera import MITSUBA_AXES, place_camera
from hesim_render.sources.render.exact import used_responses
from hesim_render.sources.render.scene.builder import build
from hesim_render.sources.render.scene.deformation import Deformation
from hesim_render.sources.render.scene.mitsuba_version import box_corners, spectrum_dict
from hesim_render.sources.render.scene.parents import camera_trajectory, trajectories
from hesim_render.sources.render.scene.trajectory import Trajectory
from hesim_render.sources.scene import Scene
from hesim_render.spectral.waveform import Waveform

#: Cells of a window in which a waveform's power counts as constant to draw instants; their weights are exact.
_CELLS = 64
#: Times in a window at which the motion of objects is measured, and the largest motion between two. An object that
#: moves farther jumps.
_STEPS, _MOST_STEP_PX = 65, 2.0


@dataclass(frozen=True)
class Work:
    """Work of each repeat for a pixel: number of instants, and of rays at each."""

    instants: int
    samples: int

    @property
    def rays(self) -> int:
        """Number of rays."""
        return self.instants * self.samples


class FrozenPixels:
    """Single pixels of a scene frozen at chosen instants, rendered by Mitsuba's own cameras, films and integrators.

    In a scalar variant nothing is compiled: a pixel at an instant takes 20 µs and a ray 1 µs.

    Parameters
    ----------
    mi : the mitsuba module in a scalar spectral variant, which must be current whenever this is used.
    waveform : waveform of the light, None if it is steady.
    scene : the scene, lit by that light alone.
    sensor : the sensor that sees it.

    Attributes
    ----------
    view : the placed camera.
    is_dark : True if nothing emits.
    is_static : True if nothing moves.
    """

    def __init__(self, mi: MitsubaModule, waveform: Waveform | None, scene: Scene, sensor: Sensor) -> None:
        self._mi, self.waveform, self._scene = mi, waveform, scene
        self._built = build(mi, scene.spec, used_responses(sensor))
        self.view = place_camera(scene.spec, sensor, self._built.mitsuba_sensor())
        sensor = self.view.sensor
        self.is_dark = self._built.is_dark
        self.is_static = not self._built.moves and camera_trajectory(scene.spec) is None
        self._filter = sensor.layout.filter_index.ravel()
        self._full_index = sensor.layout.full_index.ravel()
        scale = scene.spec.mitsuba.radiance_scale if scene.spec.mitsuba is not None else 1.0
        self._factor = sensor.relative_illumination.ravel().astype(np.float64) * scale
        self._cameras: dict[int, tuple[MitsubaObject, MitsubaObject]] = {}
        responses = used_responses(sensor)
        for number, name in enumerate(sensor.layout.filters):
            if name not in responses or self.is_dark:
                continue
            film = {
                "type": "specfilm",
                "width": sensor.cols,
                "height": sensor.rows,
                "crop_offset_x": 0,
                "crop_offset_y": 0,
                "crop_width": 1,
                "crop_height": 1,
                "component_format": "float32",
                "rfilter": {"type": "box"},
                "channel_000": spectrum_dict(responses[name]),
            }
            given = perspective_dict(mi, self.view, self.view.camera_to_world, film)
            camera = mi.load_dict({**given, "sampler": {"type": "multijitter"}})
            self._cameras[number] = camera, mi.traverse(camera)

    def repeats(
        self, span_us: tuple[float, float], pixels: NDArray[np.int64], work: Work, count: int, key: Sequence[int]
    ) -> NDArray[np.float64]:
        """Independent estimates of the mean flux over a window, [repeat, pixel], e⁻/s.

        In a static scene, the result is the flux at the mean power of the light.
        """
        if self.is_static:
            span_us = (0.0, 0.0)
        words = np.array(span_us, np.float64).view(np.uint32).tolist()
        times, weight = self._instants(
            span_us, np.random.default_rng([*key, *words, work.instants]), (count, work.instants)
        )
        of_pixel = [np.random.default_rng([*key, *words, 1 + int(self._full_index[pixel])]) for pixel in pixels]
        seeds = np.array([rng.integers(2**32, size=times.shape) for rng in of_pixel]).reshape(-1, *times.shape)
        row, col = np.divmod(pixels, self.view.sensor.cols)
        found = np.zeros((count, pixels.size))
        # the poses of all instants at once: one by one, they would take longer than the rays
        poses = {name: track.matrix(times) for name, track in self._built.trajectories.items()}
        cameras = np.broadcast_to(camera_at(self._scene, self.view, times) @ MITSUBA_AXES, (*times.shape, 4, 4))
        for repeat, instant in np.ndindex(times.shape):
            if not self.is_static:
                now = repeat, instant
                self._built.place(float(times[now]), {name: matrices[now] for name, matrices in poses.items()})
                matrix = self._mi.ScalarAffineTransform4f(cameras[now])
                for _, parameters in self._cameras.values():
                    parameters["to_world"] = matrix
            for place, own in enumerate(seeds[:, repeat, instant]):
                camera, parameters = self._cameras[int(self._filter[pixels[place]])]
                parameters["film.crop_offset"] = self._mi.ScalarPoint2u(int(col[place]), int(row[place]))
                parameters.update()
                image = self._mi.render(
                    self._built.scene, sensor=camera, integrator=self._built.integrator, spp=work.samples, seed=int(own)
                )
                found[repeat, place] += weight[repeat, instant] * float(np.array(image).ravel()[0])
        return found / work.instants * self._factor[pixels]

    def _instants(
        self, span_us: tuple[float, float], rng: np.random.Generator, shape: tuple[int, int]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Times, one in each part of a window with an equal share of the light, and their weights; both [repeat,
        instant].
        """
        begin, end = span_us
        share = (np.arange(shape[1]) + rng.random(shape)) / shape[1]
        if self.is_static or begin == end:
            times = np.full(shape, begin)
            now = 1.0 if self.is_static or self.waveform is None else float(self.waveform.mean(begin, begin))
            return times, np.full(shape, now)
        if self.waveform is None:
            return begin + share * (end - begin), np.ones(shape)
        inner = (self.waveform.follow_us(begin, end), self.waveform.jumps_us(begin, end))
        edges = np.unique(np.concatenate([np.linspace(begin, end, _CELLS + 1), *inner]))
        light = self.waveform.mean(edges[:-1], edges[1:]) * np.diff(edges)
        if not light.any():
            return np.full(shape, begin), np.zeros(shape)
        total = np.concatenate([[0.0], np.cumsum(light)])
        times = np.interp(share * total[-1], total, edges)
        cell = np.clip(np.searchsorted(edges, times, side="right") - 1, 0, light.size - 1)
        power = self.waveform.mean(times, times)
        even = np.divide(light, np.diff(edges))[cell]
        return times, np.divide(power, even, out=np.zeros(shape), where=even > 0) * total[-1] / (end - begin)

    def motion_px(self, begin_us: float, end_us: float) -> float:
        """Approximate motion of any object within a window, inside the picture or at most one picture beside it,
        pixels.
        """
        times, farthest = np.linspace(begin_us, end_us, _STEPS), 0.0
        moving: list[Trajectory | Deformation] = [*trajectories(self._scene.spec).values()]
        moving += self._built.deformations.values()
        knots = [t_us for each in moving for t_us in each.knots_us]
        inside = [float(t) for t in knots if begin_us < t < end_us]
        times = np.unique(np.concatenate([times, inside]))
        cameras = np.broadcast_to(camera_at(self._scene, self.view, times), (times.size, 4, 4))
        still = [self._built.corners] if np.ptp(cameras, axis=0).any() else []
        places = [np.broadcast_to(corners, (times.size, *corners.shape)) for corners in still]
        for name in dict.fromkeys((*self._built.trajectories, *self._built.deformations)):
            track, deformation = self._built.trajectories.get(name), self._built.deformations.get(name)
            poses = np.broadcast_to(np.eye(4), (times.size, 4, 4)) if track is None else track.matrix(times)
            if deformation is None:
                corners = np.concatenate([shape.corners for shape in self._built.groups[name]])
            else:
                vertices = (deformation.at(t_us) for t_us in times)
                corners = np.stack([box_corners(shape.min(axis=0), shape.max(axis=0)) for shape in vertices])
            places.append(corners @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3])
        for points in places:
            size = np.array([self.view.sensor.cols, self.view.sensor.rows])
            seen = np.clip(self.view.project(points, cameras), -size, 2 * size)
            steps = np.minimum(np.linalg.norm(np.diff(seen, axis=0), axis=-1), _MOST_STEP_PX)
            farthest = max(farthest, float(steps.sum(axis=0).max()))
        return farthest
