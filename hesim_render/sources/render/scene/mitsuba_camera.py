"""The camera of a Mitsuba scene: its position and field of view."""

from __future__ import annotations

from dataclasses import dataclass
from math import radians, tan

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device_types import MitsubaModule, MitsubaObject
from hesim_render.sources.render.scene.mitsuba_version import box_corners
from hesim_render.sources.render.scene.plugins import Used


@dataclass(frozen=True)
class MitsubaCamera:
    """A perspective sensor of a Mitsuba scene.

    Parameters
    ----------
    to_world : 4×4, from Mitsuba's axes: x to the left of the picture, y up, view direction +z.
    picture : tangents of the angles between the optical axis and the borders of the picture: left, right, top, bottom;
        positive to the right and downwards. If the film has a crop window, the picture is that window.
    near_m : surfaces nearer than this depth are not seen, m.
    """

    to_world: NDArray[np.float64]
    picture: tuple[float, float, float, float]
    near_m: float

    @classmethod
    def of(cls, mi: MitsubaModule, scene: MitsubaObject, used: Used) -> MitsubaCamera:
        """The first sensor of a loaded scene.

        Parameters
        ----------
        mi : the mitsuba module.
        scene : the loaded scene.
        used : that sensor, from `check_camera`.

        Raises
        ------
        SpecError
            If the sensor asks for an exposure, or its far plane cuts off shapes.
        """
        sensor = scene.sensors()[0]
        parameters = mi.traverse(sensor)
        if sensor.shutter_open_time() > 0:
            raise used.refused("its shutter_open and shutter_close are an exposure, which the sensor file gives; "
                               "remove them")  # fmt: skip
        to_world = np.array(parameters["to_world"].matrix, dtype=np.float64).reshape(4, 4, -1)[:, :, 0]
        far, depth = float(parameters["far_clip"]), _farthest(scene, to_world)
        if depth > far:
            raise used.refused(
                f"its far_clip is {far:g}, and there are shapes up to {depth:g} away, which would be seen here; "
                "give a far_clip beyond them, or remove them"
            )
        film = (parameters[f"film.{key}"] for key in ("size", "crop_size", "crop_offset"))
        size, crop, first = (np.ravel(value).astype(float) for value in film)
        half_x = tan(radians(float(np.ravel(parameters["x_fov"])[0])) / 2)
        half = np.array([half_x, half_x * size[1] / size[0]])
        shift = np.array([float(np.ravel(parameters[f"principal_point_offset_{axis}"])[0]) for axis in "xy"])
        low, high = ((2 * (edge / size + shift) - 1) * half for edge in (first, first + crop))
        picture = float(low[0]), float(high[0]), float(low[1]), float(high[1])
        return cls(to_world, picture, float(parameters["near_clip"]))


def _farthest(scene: MitsubaObject, to_world: NDArray[np.float64]) -> float:
    """Largest depth of anything in a scene along the axis, m; minus infinity in an empty scene."""
    if not scene.shapes():
        return -np.inf
    box = scene.bbox()
    corners = box_corners(*(np.array(corner, dtype=np.float64).ravel() for corner in (box.min, box.max)))
    axis = to_world[:3, 2] / np.linalg.norm(to_world[:3, 2])
    return float(((corners - to_world[:3, 3]) @ axis).max())
