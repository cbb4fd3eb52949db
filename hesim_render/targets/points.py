"""Places of the points that a calibration finds on a target."""

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.specs.boards import (
    AprilGridTarget,
    CharucoTarget,
    CheckerboardTarget,
    CircleGridTarget,
    LedGridTarget,
)
from hesim_render.specs.geometry import rotation_about
from hesim_render.specs.reflectance import PlacedTarget
from hesim_render.specs.target import TargetSpec
from hesim_render.targets.boards import disc_centres
from hesim_render.targets.piece import on_cylinder


def target_points(target: TargetSpec) -> NDArray[np.float64]:
    """Points of a calibration target in its own flat plane.

    The order is that in which OpenCV gives them: inner corners of a checkerboard and centres of discs and lamps row by
    row from the top left; corners of a ChArUco board by their number; of an AprilGrid by tag number, and for each tag
    its four corners from the bottom left one, counter-clockwise.

    Parameters
    ----------
    target : from ``scene.spec.target``.

    Examples
    --------
    >>> import hesim_render as hr
    >>> from hesim_render.targets import target_points
    >>> target_points(hr.load_scene("checkerboard").spec.target)[0].round(4).tolist()
    [-0.125, 0.075, 0.0]

    Returns
    -------
    [point, 3], m: x to the right, y up, z towards the viewer, from the target's centre.

    Raises
    ------
    SpecError
        If the target has no such points.
    """
    if isinstance(target, CheckerboardTarget):
        x = (np.arange(1, target.cols) / target.cols - 0.5) * target.width_m
        y = (0.5 - np.arange(1, target.rows) / target.rows) * target.height_m
        flat = np.column_stack([np.tile(x, len(y)), np.repeat(y, len(x))])
    elif isinstance(target, CharucoTarget):
        across = (np.arange(1, target.cols) - target.cols / 2) * target.square_m
        down = (target.rows / 2 - np.arange(1, target.rows)) * target.square_m
        flat = np.column_stack([np.tile(across, len(down)), np.repeat(down, len(across))])
    elif isinstance(target, AprilGridTarget):
        w, h = target.pattern_m
        pitch, gap = (1 + target.spacing) * target.tag_m, target.spacing * target.tag_m
        row, col = (index.ravel() for index in np.mgrid[: target.rows, : target.cols])
        corner = np.column_stack([col * pitch + gap - w / 2, row * pitch + gap - h / 2])
        tag = target.tag_m * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        flat = (corner[:, None] + tag).reshape(-1, 2)
    elif isinstance(target, CircleGridTarget | LedGridTarget):
        flat = disc_centres(target)
    else:
        raise SpecError(f"a target of type {target.type!r} has no calibration points", key="target")
    return np.column_stack([flat, np.zeros(len(flat))])


def placement(target: PlacedTarget) -> NDArray[np.float64]:
    """Pose [4, 4] of a target at rest: turned about its centre, then moved."""
    matrix = np.eye(4)
    if target.rotation_deg:
        matrix[:3, :3] = rotation_about(target.rotation_axis, target.rotation_deg)
    matrix[:3, 3] = target.position_m
    return matrix


def surface_points(target: TargetSpec, count: int) -> NDArray[np.float64]:
    """A grid of points over a target, row by row from the top left, before its tilt and shift, [count², 3], m."""
    x = np.linspace(-0.5, 0.5, count) * target.width_m
    y = np.linspace(0.5, -0.5, count) * target.height_m
    flat = np.column_stack([np.tile(x, count), np.repeat(y, count)])
    if target.bend_radius_m is None:
        return np.column_stack([flat, np.zeros(count**2)])
    return on_cylinder(flat, target.bend_radius_m)
