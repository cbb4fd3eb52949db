"""How near the resting surfaces in view are."""

import numpy as np

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.host_arrays import from_host
from hesim_render.sources.render.change_driven.pair_tracer import PairTracer
from hesim_render.sources.render.scene.mitsuba_version import mitsuba

#: Rows and columns of the grid.
_ROWS, _COLS = 24, 32


def least_depth_m(tracer: PairTracer, t_us: float) -> float:
    """Least depth of the resting surfaces in view at a time, over an even grid of the picture, m.

    Depth is measured along the camera's axis. It is infinite where nothing is seen.
    """
    mitsuba()  # the variant may have been changed by other code
    mi, types, geometry, view = tracer.built.mi, jit(), tracer.sensor.spec.geometry, tracer.view
    left, right, top, bottom = view.followed_mm
    x = left + (np.arange(_COLS) + 0.5) / _COLS * (right - left)
    y = top + (np.arange(_ROWS) + 0.5) / _ROWS * (bottom - top)
    pitch_mm = geometry.pitch_um * 1e-3
    row = np.repeat(y / pitch_mm + (geometry.rows - 1) / 2, _COLS)
    col = np.tile(x / pitch_mm + (geometry.cols - 1) / 2, _ROWS)
    rows, cols = (from_host(types.Float, values) for values in (row, col))
    origin, direction = tracer.rays.towards(rows, cols, types.Float(0), types.Float(0))
    axis = -view.camera_to_world[:3, 2]
    if tracer.camera is not None:
        matrix = tracer.camera.matrix(t_us)
        axis = matrix[:3, :3] @ axis
        pose = tracer.camera.pose_at(types.Float(float(tracer.camera.local_us(t_us))))
        origin, direction = pose.to_world(origin), pose.turn_to_world(direction)
    ray = mi.Ray3f(mi.Point3f(*origin), mi.Vector3f(*direction))
    far = tracer.parts.resting_distance(ray)
    return float(dr.min(far * dr.dot(ray.d, mi.Vector3f(axis)))[0])
