"""Camera placement.

Camera space: x to the right of the image, y up, view direction −z, the origin at the centre of the
entrance pupil. The optical axis meets the chip at the centre of the *full* sensor, or at the place that the lens in use
states (`Lens.axis_mm`). Positions on the chip are measured from that centre.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from math import atan2, degrees, radians, tan

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.units import MM_PER_M
from hesim_render.sensor.distortion import Distortion
from hesim_render.sensor.lens import pixel_centres_mm
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.render.projection import Projection
from hesim_render.sources.render.scene.mitsuba_scene import MitsubaCamera
from hesim_render.sources.render.scene.parents import trajectories
from hesim_render.specs.geometry import rotation_about
from hesim_render.specs.scene import CameraSpec, SceneSpec, Vector

#: Points along each side of a target whose images must fit into the picture, and steps towards a fit.
_FIT_POINTS, _FIT_STEPS = 33, 20
#: From this camera's axes to Mitsuba's (x to the left, looking along +z), and back.
MITSUBA_AXES = np.diag([-1.0, 1.0, -1.0, 1.0])


@dataclass(frozen=True)
class View:
    """A placed camera.

    Parameters
    ----------
    camera_to_world : 4×4 rigid, at rest (before any motion of the camera).
    sensor : the sensor, with the lens in use.
    of_region : True if the read-out region decides the placement, so that another region sees another picture.
    near_m : surfaces nearer than this depth are not seen, m.
    """

    camera_to_world: NDArray[np.float64]
    sensor: Sensor
    of_region: bool = False
    near_m: float = 0.0

    @property
    def followed_mm(self) -> tuple[float, float, float, float]:
        """Part of the chip where motion is followed, as `region_mm`: the same for all crops of one picture."""
        if self.of_region:
            return self.region_mm
        geometry = self.sensor.spec.geometry
        half_x, half_y = (count * geometry.pitch_um * 1e-3 / 2 for count in (geometry.cols, geometry.rows))
        return -half_x, half_x, -half_y, half_y

    @property
    def region_mm(self) -> tuple[float, float, float, float]:
        """Read-out region relative to the centre of the chip: left, right, top, bottom (y downwards), mm."""
        x, y = pixel_centres_mm(self.sensor.layout)
        half = self.sensor.spec.geometry.pitch_um * 1e-3 / 2
        return float(x[0] - half), float(x[-1] + half), float(y[0] - half), float(y[-1] + half)

    @cached_property
    def projection(self) -> Projection:
        """Geometry of the lens: places on the full sensor and directions in camera space."""
        return Projection.of(self.sensor, self.followed_mm)

    def direction(self, x_mm: float, y_mm: float) -> NDArray[np.float64]:
        """Chief ray of a place on the chip, measured as in `region_mm`, in camera space; of any length."""
        image_mm, (axis_x, axis_y) = self.sensor.lens.image_distance_mm, self.sensor.lens.axis_mm
        if self.projection.distortion is None:
            return np.array([x_mm - axis_x, axis_y - y_mm, -image_mm])
        x, y = self.projection.undistorted(np.array([x_mm - axis_x, y_mm - axis_y]) / image_mm)
        return np.array([x, -y, -1.0])

    def project(self, points: NDArray[np.float64], camera_to_world: NDArray[np.float64] | None = None) -> NDArray:
        """Column and row of world points [..., 3], in pixels of this region with (0, 0) at its left top corner;
        [..., 2].

        Points beside or behind the pupil are treated as if at a small positive depth.
        """
        matrix = self.camera_to_world if camera_to_world is None else camera_to_world
        layout = self.sensor.layout
        return self.projection.project(_in_front(points, matrix)) + 0.5 - np.array([layout.col0, layout.row0])

    def project_on_sensor(
        self, points: NDArray[np.float64], camera_to_world: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Column and row of world points [k, n, 3] for k poses of the camera, in pixels of the full sensor with (0, 0)
        at its left top corner.

        Returns
        -------
        places : [k, n, 2]; points beside or behind the pupil are treated as if at a small positive depth.
        px_per_m : [k, n], pixels per metre across the axis at that depth.
        """
        local = _in_front(points, camera_to_world)
        model = self.projection.distortion
        steepest = self.projection.focal_px * (1.0 if model is None else model.steepest[0])
        return self.projection.project(local) + 0.5, steepest / -local[..., 2]

    def defocus_px(self, px_per_m: NDArray[np.float64]) -> float:
        """Largest radius of the blur of points out of focus, by the px_per_m of `project_on_sensor`, px."""
        if not self.sensor.optics.depth_of_field:
            return 0.0
        lens, model = self.sensor.lens, self.projection.distortion
        steepest = self.projection.focal_px * (1.0 if model is None else model.steepest[0])
        return float(lens.pupil_radius_m * np.abs(px_per_m - steepest / lens.focus_distance_m).max())

    def unproject(self, depth_m: NDArray[np.float64], camera_to_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """World points of a 5×5 grid over the picture, at each depth along the axis; [25 · depths, 3]."""
        layout = self.sensor.layout
        x, y = np.meshgrid(
            layout.col0 - 0.5 + np.linspace(0, layout.cols, 5), layout.row0 - 0.5 + np.linspace(0, layout.rows, 5)
        )
        rays = self.projection.unproject(np.stack([x.ravel(), y.ravel()], axis=-1))
        local = (depth_m[:, None, None] * rays).reshape(-1, 3)
        return local @ camera_to_world[:3, :3].T + camera_to_world[:3, 3]


def _in_front(points: NDArray[np.float64], camera_to_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """World points in camera space, [..., 3], at a small positive depth if they lie beside or behind the pupil."""
    local = (points - camera_to_world[..., None, :3, 3]) @ camera_to_world[..., :3, :3]
    local[..., 2] = -np.maximum(-local[..., 2], 1e-3 + 0.02 * np.linalg.norm(local, axis=-1))
    return local


def look_at(origin: Vector, target: Vector, up: Vector) -> NDArray[np.float64]:
    """Camera-to-world matrix of a camera at `origin` that looks at `target`, with `up` upwards in the image.

    Raises
    ------
    SpecError
        If `up` is parallel to the line of sight.
    """
    backward = np.subtract(origin, target).astype(np.float64)
    backward /= np.linalg.norm(backward)
    right = np.cross(np.asarray(up, dtype=np.float64), backward)
    if np.linalg.norm(right) < 1e-9:
        raise SpecError("'up' is parallel to the line of sight", key="camera.up")
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = right, np.cross(backward, right), backward
    matrix[:3, 3] = origin
    return matrix


def _region_size_mm(sensor: Sensor) -> tuple[float, float]:
    pitch = sensor.spec.geometry.pitch_um * 1e-3
    return sensor.cols * pitch, sensor.rows * pitch


def _with_image_distance(sensor: Sensor, camera: CameraSpec, image_mm: float, object_mm: float | None) -> Sensor:
    """The sensor with the focal length that gives an image distance of `image_mm` when focused at `object_mm`."""
    fixed = sensor.spec.lens.magnification
    focus_mm = camera.focus_distance_m * MM_PER_M if camera.focus_distance_m else object_mm
    if fixed != "focus":
        focal = image_mm / (1 + abs(float(fixed)))
    elif focus_mm is None:
        focal = image_mm
    else:
        focal = image_mm * focus_mm / (image_mm + focus_mm)  # 1/f = 1/v + 1/d
    focus_m = None if focus_mm is None else focus_mm / MM_PER_M
    return sensor.with_lens(f_number=camera.f_number, focal_length_mm=focal, focus_distance_m=focus_m)


def _turned_to_region(view: View, towards: tuple[float, float] = (0.0, 0.0)) -> View:
    """The camera turned so that the centre of its region, not the optical axis, looks along its −z.

    A field of view is stated for the region. Without the turn, a region far from the axis would look past the scene.

    Parameters
    ----------
    towards : direction of the centre instead of −z: tangents to the right and downwards.
    """
    left, right, top, bottom = view.region_mm
    looks = view.direction((left + right) / 2, (top + bottom) / 2)
    wanted = np.array([towards[0], -towards[1], -1.0])
    looks, wanted = looks / np.linalg.norm(looks), wanted / np.linalg.norm(wanted)
    axis = np.cross(looks, wanted)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return view
    turn = np.eye(4)
    turn[:3, :3] = rotation_about(axis, degrees(atan2(sine, float(looks @ wanted))))
    return replace(view, camera_to_world=view.camera_to_world @ turn)


def _fit_to_target(scene: SceneSpec, camera: CameraSpec, sensor: Sensor) -> View:
    """Move the camera back along +z until the target's image fills `fit_margin` of the region and fits in both
    directions.

    The required magnification m fixes the distance: d = f (1 + 1/m) for a thin lens focused on the
    target, else d = v/m with the image distance v that the file or the field of view sets. If the
    region is off the optical axis, the camera moves sideways so that the target still fills it.
    """
    assert scene.target is not None
    width_mm, height_mm = _region_size_mm(sensor)
    target = scene.target
    needed = camera.fit_margin * min(width_mm / (target.width_m * MM_PER_M), height_mm / (target.height_m * MM_PER_M))
    view, gain = _at_magnification(camera, sensor, needed), 1.0
    if sensor.optics.distortion is not None:
        for _ in range(_FIT_STEPS):
            # a barrel shows more than its centre promises: come nearer until the target fills the picture
            gain *= camera.fit_margin / _filled(view, target.width_m, target.height_m)
            view = _at_magnification(camera, sensor, needed * gain)
    return view


def _at_magnification(camera: CameraSpec, sensor: Sensor, needed: float) -> View:
    """A camera on which the plane z = 0 is imaged at a magnification on the axis; its region looks at the origin."""
    if camera.horizontal_fov_deg is not None:
        image_mm = _image_distance_mm(sensor, camera.horizontal_fov_deg)
        sensor = _with_image_distance(sensor, camera, image_mm, image_mm / needed)
    else:
        focal = camera.focal_length_mm or sensor.spec.lens.focal_length_mm
        focus_m = camera.focus_distance_m or focal * (1 + 1 / needed) / MM_PER_M
        sensor = sensor.with_lens(f_number=camera.f_number, focal_length_mm=focal, focus_distance_m=focus_m)
        image_mm = sensor.lens.image_distance_mm
    distance_m = image_mm / needed / MM_PER_M
    view = View(np.eye(4), sensor, of_region=True)
    left, right, top, bottom = view.region_mm
    if view.projection.distortion is None:
        across = (left + right) / 2 / image_mm * distance_m, -(top + bottom) / 2 / image_mm * distance_m
    else:
        x, y, _ = view.direction((left + right) / 2, (top + bottom) / 2) * distance_m
        across = float(x), float(y)
    view.camera_to_world[:3, 3] = [-across[0], -across[1], distance_m]
    return view


def _filled(view: View, width_m: float, height_m: float) -> float:
    """Part of the region that a target around the origin fills, in the direction in which it fills more."""
    side = np.linspace(-0.5, 0.5, _FIT_POINTS)
    rim = [(x, y, 0) for end in (-0.5, 0.5) for pair in ((side, 0 * side + end), (0 * side + end, side))
           for x, y in zip(*pair, strict=True)]  # fmt: skip
    place = view.project(np.array(rim) * [width_m, height_m, 0])
    middle = np.array([view.sensor.cols, view.sensor.rows]) / 2
    return float((np.abs(place - middle).max(axis=0) / middle).max())


def _image_distance_mm(sensor: Sensor, horizontal_fov_deg: float) -> float:
    """Image distance at which the width of the region, if it were centred on the axis, shows a field of view."""
    tangent = tan(radians(horizontal_fov_deg) / 2)
    model, half_mm = sensor.optics.distortion, _region_size_mm(sensor)[0] / 2
    if model is None:
        return half_mm / tangent
    try:
        return half_mm / Distortion.height_at(model, tangent)
    except SpecError as error:
        raise sensor.lens_error(str(error).removeprefix(f"{error.key}: "), "lens.distortion") from None


def place_camera(scene: SceneSpec, sensor: Sensor, mitsuba_sensor: MitsubaCamera | None = None) -> View:
    """Place the camera of a scene: its pose at rest, and the sensor with focal length, f-number and focus resolved.

    A track that holds one pose is part of the pose at rest; one that moves the camera is not, see `camera_trajectory`.

    With a `camera` section: `fit` as in `CameraSpec`, otherwise the stated origin and target; the focus defaults to the
    distance between them. `horizontal_fov_deg` spans the width of the read-out region as if it were centred on the
    axis, and the camera is turned so that the centre of the region looks at the target. With a focal length, a region
    off the axis sees its part of the full sensor's picture. Without a `camera` section, the first sensor of the Mitsuba
    scene is used: its whole picture (the film's crop window, where it has one) just fits into the region, focused at
    infinity. If its principal point is off the centre of the picture, the axis moves on the chip accordingly, and the
    lens's relative illumination with it.

    Parameters
    ----------
    scene : content of the scene file.
    sensor : the sensor, with its own lens.
    mitsuba_sensor : sensor of the Mitsuba scene; needed only without a `camera` section.

    Raises
    ------
    SpecError
        If the camera cannot be placed as asked.
    """
    placed = _placed(scene, sensor, mitsuba_sensor)
    track = trajectories(scene).get("camera")
    if track is None or track.moves:
        return placed
    return replace(placed, camera_to_world=track.matrix(0.0) @ placed.camera_to_world)


def _placed(scene: SceneSpec, sensor: Sensor, mitsuba_sensor: MitsubaCamera | None) -> View:
    """The camera without its track."""
    camera = scene.camera
    if camera is None:
        return _from_mitsuba(scene, sensor, mitsuba_sensor)
    fixed = sensor.spec.lens.magnification
    if sensor.optics.depth_of_field and fixed != "focus" and camera.focus_distance_m is not None:
        raise sensor.lens_error(
            f"the lens is focused by a fixed magnification of {fixed:g}, and the scene has a camera.focus_distance_m: "
            "set the magnification to 'focus', or leave the distance away",
            "lens.magnification",
        )
    if camera.fit == "target":
        return _fit_to_target(scene, camera, sensor)
    matrix = look_at(camera.origin_m, camera.target_m, camera.up)
    away_m = float(np.linalg.norm(np.subtract(camera.origin_m, camera.target_m)))
    if camera.horizontal_fov_deg is not None:
        image_mm = _image_distance_mm(sensor, camera.horizontal_fov_deg)
        placed = View(matrix, _with_image_distance(sensor, camera, image_mm, away_m * MM_PER_M), of_region=True)
        return _turned_to_region(placed)
    focus_m = camera.focus_distance_m or away_m
    return View(
        matrix,
        sensor.with_lens(f_number=camera.f_number, focal_length_mm=camera.focal_length_mm, focus_distance_m=focus_m),
    )


def _from_mitsuba(scene: SceneSpec, sensor: Sensor, camera: MitsubaCamera | None) -> View:
    if camera is None:
        raise SpecError(f"scene {scene.name!r}: the Mitsuba scene has no sensor; add a 'camera' section", key="camera")
    left, right, top, bottom = camera.picture
    width_mm, height_mm = _region_size_mm(sensor)
    image_mm = min(width_mm / (right - left), height_mm / (bottom - top))
    matrix = camera.to_world @ MITSUBA_AXES
    matrix[:3, :3] /= np.linalg.norm(matrix[:3, :3], axis=0)  # a scale in to_world does not affect the view
    used = _with_image_distance(sensor, CameraSpec(), image_mm, None)
    # the centre of the picture, not the axis, lies at the centre of the region
    middle = (left + right) / 2, (top + bottom) / 2
    lens = replace(used.lens, axis_mm=(-middle[0] * image_mm, -middle[1] * image_mm))
    return _turned_to_region(View(matrix, replace(used, lens=lens), True, camera.near_m), middle)
