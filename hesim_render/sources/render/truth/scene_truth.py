"""Geometric truth of a scene at any time: one call for each kind."""

from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.render.light_level import LightLevels, light_levels
from hesim_render.sources.render.truth import poses
from hesim_render.sources.render.truth.boxes import Boxes, ObjectShapes
from hesim_render.sources.render.truth.chief_rays import ChiefRays, Placed
from hesim_render.sources.render.truth.flow import Flow, flow_between
from hesim_render.sources.render.truth.imu import ImuModel, ImuSamples, imu_samples
from hesim_render.sources.render.truth.names import Names
from hesim_render.sources.render.truth.poses import CameraModel
from hesim_render.sources.render.truth.raster import Grid, Raster, row_times_us
from hesim_render.sources.render.truth.surfaces import BAND, Surfaces, mixed_pixels, surfaces_at
from hesim_render.sources.scene import Scene, scene_and_sensor

#: Largest number of objects that the short text of a truth names.
_MOST_NAMES = 6


class Ids(NamedTuple):
    """Numbers of what each pixel shows, uint16 [row, col] each; 0 is the background. `SceneTruth.names` has
    the names."""

    object: NDArray[np.uint16]
    instance: NDArray[np.uint16]
    material: NDArray[np.uint16]


class SceneTruth:
    """Geometry that a sensor sees of a scene, exact at any time.

    Everything is that of the chief ray through the centre of a pixel at one time, never an average over the pixel, its
    exposure or the blur of the lens. Surfaces are those that a ray meets first, also where they are transparent.

    Times are one time in µs, a time for each row of the region (a rolling shutter), or a frame of a recording: the
    middle of each row's exposure. Grids are ``mosaic``, all pixels of the region, or ``events``, the event pixels.

    Parameters
    ----------
    scene, sensor : from `load_scene` and `load_sensor` (crop the sensor for a region of interest), or names or paths.

    Raises
    ------
    SpecError
        If the scene cannot be loaded.

    Examples
    --------
    >>> import hesim_render as hr
    >>> truth = hr.SceneTruth(hr.load_scene("rotating-star"), hr.load_sensor("gen2").crop(64, 48))
    >>> truth.names.objects
    ('background', 'target', 'wall')
    >>> truth.depth(0).shape, truth.flow(0, 10_000, grid="events").flow_px.shape
    ((48, 64), (12, 16, 2))
    """

    def __init__(self, scene: Scene | str | Path, sensor: Sensor | str | Path) -> None:
        self.scene, sensor = scene_and_sensor(scene, sensor)
        self._rays = ChiefRays(self.scene, sensor)
        #: The sensor, with the lens in use.
        self.sensor = self._rays.sensor
        self._rasters: dict[str, Raster] = {}
        self._last: tuple[Any, Surfaces] | None = None

    def __repr__(self) -> str:
        shown = [name for name in self.names.objects if name != "background"]
        objects = ", ".join(shown[:_MOST_NAMES]) + (
            f" and {len(shown) - _MOST_NAMES} more" * (len(shown) > _MOST_NAMES)
        )
        return f"<SceneTruth of {self.scene.name!r} seen by {self.sensor.name!r}: {objects or 'no objects'}>"

    @property
    def names(self) -> Names:
        """Names of objects, instances and materials, by number."""
        return self._rays.names

    def raster(self, grid: Grid = "mosaic") -> Raster:
        """Places of a grid's pixels on the full sensor.

        Parameters
        ----------
        grid : ``mosaic`` or ``events``.

        Returns
        -------
        The grid.
        """
        if grid not in self._rasters:
            self._rasters[grid] = Raster.of(self.sensor, grid)
        return self._rasters[grid]

    def surfaces(self, when: Any, grid: Grid = "mosaic") -> Surfaces:
        """Everything that chief rays meet at a time; the other calls take their parts of it.

        Parameters
        ----------
        when : time or times of rows, µs, or a frame.
        grid : ``mosaic`` or ``events``.

        Returns
        -------
        Distance, normal and numbers of the surfaces.
        """
        raster, times = self.raster(grid), row_times_us(when, self.sensor.rows)
        key = grid, times.tobytes()
        if self._last is None or self._last[0] != key:
            self._last = key, surfaces_at(self._rays, raster, times)
        return self._last[1]

    def depth(self, when: Any, grid: Grid = "mosaic") -> NDArray[np.float32]:
        """Depth along the optical axis.

        Parameters
        ----------
        when, grid : see `surfaces`.

        Returns
        -------
        float32 [row, col], m; infinite where there is no surface.
        """
        return self.surfaces(when, grid).depth_m(self.raster(grid))

    def distance(self, when: Any, grid: Grid = "mosaic") -> NDArray[np.float32]:
        """Distance from the entrance pupil.

        Parameters
        ----------
        when, grid : see `surfaces`.

        Returns
        -------
        float32 [row, col], m; infinite where there is no surface.
        """
        return self.surfaces(when, grid).distance_m

    def normals(self, when: Any, grid: Grid = "mosaic") -> NDArray[np.float32]:
        """Geometric unit normals in world axes, towards the camera's side.

        Parameters
        ----------
        when, grid : see `surfaces`.

        Returns
        -------
        float32 [row, col, 3]; NaN where there is no surface.
        """
        return self.surfaces(when, grid).normal

    def position(self, when: Any, grid: Grid = "mosaic") -> NDArray[np.float32]:
        """Position of the surface in the world.

        Parameters
        ----------
        when, grid : see `surfaces`.

        Returns
        -------
        float32 [row, col, 3], m; NaN where there is no surface.
        """
        return self.surfaces(when, grid).position(self._rays, self.raster(grid))

    def ids(self, when: Any, grid: Grid = "mosaic") -> Ids:
        """Numbers of object, instance (shape) and material of each pixel.

        Parameters
        ----------
        when, grid : see `surfaces`.

        Returns
        -------
        Three uint16 [row, col].
        """
        surfaces, names = self.surfaces(when, grid), self.names
        instance = names.instance(surfaces.shape)
        return Ids(names.object_of[instance], instance, names.material(surfaces.material))

    def objects_at(self, t_us: ArrayLike, x: ArrayLike, y: ArrayLike) -> NDArray[np.uint16]:
        """Numbers of the objects that event pixels show, each at a time of its own.

        Parameters
        ----------
        t_us : [event], times, µs.
        x, y : [event], columns and rows of the event grid.

        Returns
        -------
        uint16 [event]; 0 is the background, and `names` has the names.
        """
        raster, times = self.raster("events"), np.asarray(t_us, np.float64)
        place = np.asarray(y, np.intp), np.asarray(x, np.intp)
        objects = np.empty(times.size, np.uint16)
        for first in range(0, times.size, BAND):
            part = slice(first, first + BAND)
            here = place[0][part], place[1][part]
            placed = Placed(raster.col[here].astype(np.float64), raster.row[here].astype(np.float64), times[part])
            objects[part] = self.names.object_of[self.names.instance(self._rays.trace(placed).shape)]
        return objects

    def mixed(self, when: Any, grid: Grid = "mosaic") -> NDArray[np.bool_]:
        """Pixels whose footprint shows more than one surface, or an edge of one.

        Parameters
        ----------
        when, grid : see `surfaces`.

        Returns
        -------
        bool [row, col].
        """
        return mixed_pixels(self._rays, self.raster(grid), self.surfaces(when, grid))

    def flow(self, from_when: Any, to_when: Any, grid: Grid = "mosaic") -> Flow:
        """Displacement of what each pixel shows at one time until another, earlier or later.

        Parameters
        ----------
        from_when, to_when : time or times of rows, µs, or frames.
        grid : ``mosaic`` or ``events``.

        Returns
        -------
        The flow, and whether each point is seen at the second time.
        """
        to_us = row_times_us(to_when, self.sensor.rows)
        return flow_between(self._rays, self.raster(grid), self.surfaces(from_when, grid), to_us)

    def camera(self, grid: Grid = "mosaic") -> CameraModel:
        """Intrinsics of the camera that is used, for a grid.

        Parameters
        ----------
        grid : ``mosaic`` or ``events``.

        Returns
        -------
        Camera matrix, size and distortion.
        """
        return poses.camera_model(self._rays, self.raster(grid))

    def camera_pose(self, t_us: ArrayLike) -> NDArray[np.float64]:
        """Pose of the camera in the world: x to the right of the image, y downwards, z along the view.

        Parameters
        ----------
        t_us : times of any shape, µs.

        Returns
        -------
        [..., 4, 4], m, from camera to world.
        """
        return poses.camera_pose(self._rays, t_us)

    def object_poses(self, t_us: ArrayLike) -> dict[str, NDArray[np.float64]]:
        """Pose of each object: from its place in the scene file to its place at a time.

        Parameters
        ----------
        t_us : times of any shape, µs.

        Returns
        -------
        [..., 4, 4], m, by name.
        """
        return poses.object_poses(self._rays, t_us)

    def project(self, points_m: ArrayLike, t_us: float, grid: Grid = "mosaic") -> NDArray[np.float64]:
        """Column and row of world points at one time.

        Parameters
        ----------
        points_m : [..., 3], world, m.
        t_us : time, µs.
        grid : ``mosaic`` or ``events``.

        Returns
        -------
        [..., 2], px of the grid; NaN for points that are not in front of the camera.
        """
        matrix = self._rays.camera_to_world(np.asarray(float(t_us)))
        local = (np.asarray(points_m, dtype=np.float64) - matrix[:3, 3]) @ matrix[:3, :3]
        return self.raster(grid).to_grid(self._rays.view.projection.project(local))

    @cached_property
    def _shapes(self) -> ObjectShapes:
        return ObjectShapes(self._rays)

    def boxes(self, when: Any, grid: Grid = "mosaic") -> Boxes:
        """Boxes around all objects, in the picture and in space.

        Parameters
        ----------
        when, grid : see `surfaces`.

        Returns
        -------
        The boxes of all objects.
        """
        times = row_times_us(when, self.sensor.rows)
        return self._shapes.boxes(self.raster(grid), self.ids(times, grid).object, times)

    def light_levels(self, t_us: ArrayLike) -> list[LightLevels]:
        """Level of each light on its own plane.

        Parameters
        ----------
        t_us : times of any shape, µs.

        Returns
        -------
        One entry for each light.
        """
        return light_levels(self.scene, t_us)

    def imu(self, begin_us: float, end_us: float, model: ImuModel | None = None, seed: int = 7) -> ImuSamples:
        """Inertial measurements of a unit in the camera, with its axes.

        Parameters
        ----------
        begin_us, end_us : samples end after the first and up to the second, µs.
        model : sampling, noise and gravity.
        seed : seed of the noise.

        Returns
        -------
        The samples, with and without noise.
        """
        return imu_samples(self._rays, model or ImuModel(), begin_us, end_us, seed)
