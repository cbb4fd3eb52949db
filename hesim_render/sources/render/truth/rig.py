"""Several cameras that move together: the scene as each of them sees it."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.units import MM_PER_M
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.render.camera import place_camera
from hesim_render.sources.render.truth.poses import VISION_AXES
from hesim_render.sources.scene import Scene, scene_and_sensor
from hesim_render.specs.geometry import LARGEST_M
from hesim_render.specs.scene import CameraSpec

#: Largest deviation of a matrix from a rigid pose.
_RIGID = 1e-6


def rig_scenes(
    scene: Scene | str | Path, sensor: Sensor | str | Path, poses: Mapping[str, ArrayLike]
) -> dict[str, Scene]:
    """The same scene for each camera of a rig.

    The rig moves as the camera of the scene does. All cameras have the lens that the scene gives this sensor; simulate
    each scene with the sensor of its own camera.

    Parameters
    ----------
    scene : the scene, or its name or path; its camera is the origin of the rig.
    sensor : the sensor, or its name or path, for which a scene with ``fit`` or a field of view places its camera.
    poses : for each camera, its pose in the rig, 4×4 rigid, m: from its axes to those of the scene's camera. Axes are x
        to the right of the image, y downwards, z along the view.

    Examples
    --------
    A stereo pair with a base of 10 cm:

    >>> import numpy as np
    >>> import hesim_render as hr
    >>> sensor = hr.load_sensor("reference-mono").crop(32, 24)
    >>> right = np.eye(4)
    >>> right[0, 3] = 0.1
    >>> pair = hr.rig_scenes(hr.load_scene("camera-sweep"), sensor, {"left": np.eye(4), "right": right})
    >>> left, right = (hr.SceneTruth(pair[name], sensor).camera_pose(5_000) for name in ("left", "right"))
    >>> np.round(np.linalg.inv(left) @ right, 9)[:3, 3].tolist()
    [0.1, 0.0, 0.0]

    Returns
    -------
    The scenes, by name.

    Raises
    ------
    RangeError
        If a pose is not rigid, or no camera is given.
    SpecError
        If the scene takes its camera from a Mitsuba scene.
    """
    scene, sensor = scene_and_sensor(scene, sensor)
    if not poses:
        raise RangeError("poses", "{}", "one camera or more")
    if scene.spec.camera is None:
        raise SpecError("a rig needs a 'camera' section in the scene file", file=scene.spec.file, key="camera")
    view = place_camera(scene.spec, sensor)
    lens = view.sensor.lens
    # focused at d, the image distance is f (1 + |m|) with |m| = f/(d − f)
    m = lens.magnification
    focus_m = lens.focal_length_mm * (1 + 1 / m) / MM_PER_M if m > 0 else None
    scenes = {}
    for name, given in poses.items():
        pose = np.asarray(given, dtype=np.float64)
        if pose.shape != (4, 4) or np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() > _RIGID or (
            np.linalg.det(pose[:3, :3]) < 0 or np.abs(pose[3] - [0, 0, 0, 1]).max() > _RIGID
        ):  # fmt: skip
            raise RangeError(f"poses[{name!r}]", pose.tolist(), "a rigid 4×4 matrix")
        world = view.camera_to_world @ VISION_AXES @ pose
        away = focus_m or LARGEST_M / 10
        camera = CameraSpec(
            origin_m=_vector(world[:3, 3]),
            target_m=_vector(world[:3, 3] + world[:3, 2]),
            up=_vector(-world[:3, 1]),
            focal_length_mm=lens.focal_length_mm,
            f_number=lens.f_number,
            focus_distance_m=away,
        )
        scenes[name] = Scene(scene.spec.model_copy(update={"name": f"{scene.name}-{name}", "camera": camera}))
    return scenes


def _vector(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
