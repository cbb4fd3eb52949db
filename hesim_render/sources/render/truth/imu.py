"""An inertial measurement unit fixed to the camera: angular rate and specific force, ideal and with noise.

A sample covers the time since the previous one, as that of a unit that sums up angle and velocity does. The rate is the
turn during that time over its length, and the specific force is the change of velocity over that length, less gravity,
in the axes that the unit has in the middle of it. Summed up, the samples of a track give back its turn and its
velocity, also where a track changes its velocity at once, as at keyframes.

Noise is that of the usual model: white noise, and a bias that walks at random [burri2016].
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hesim_render.core.errors import RangeError
from hesim_render.core.rng import Stream, device_normal
from hesim_render.core.units import S_PER_US, US_PER_S
from hesim_render.sources.render.scene.trajectory import Trajectory
from hesim_render.sources.render.truth.chief_rays import ChiefRays
from hesim_render.sources.render.truth.poses import VISION_AXES

_DENSITIES = (
    *("gyro_noise_density", "gyro_random_walk"),
    *("accelerometer_noise_density", "accelerometer_random_walk"),
)
_KINDS = ("gyro_white", "gyro_walk", "accelerometer_white", "accelerometer_walk")


@dataclass(frozen=True)
class ImuModel:
    """Sampling and noise of a unit; the noise defaults to that of the ADIS16448 as the EuRoC data set gives it.

    Parameters
    ----------
    rate_hz : samples per second.
    gyro_noise_density : rad/s/√Hz.
    gyro_random_walk : rad/s²/√Hz, of the bias.
    accelerometer_noise_density : m/s²/√Hz.
    accelerometer_random_walk : m/s³/√Hz, of the bias.
    gravity_m_per_s2 : gravity in world axes; y is up.

    Raises
    ------
    RangeError
        If the rate is not above 0, or a density is negative.

    Examples
    --------
    >>> import hesim_render as hr
    >>> truth = hr.SceneTruth(hr.load_scene("camera-sweep"), hr.load_sensor("reference-mono").crop(32, 24))
    >>> truth.imu(0, 10_000, hr.ImuModel(rate_hz=500)).gyro_rad_per_s.shape
    (5, 3)
    """

    rate_hz: float = 1000.0
    gyro_noise_density: float = 1.6968e-4
    gyro_random_walk: float = 1.9393e-5
    accelerometer_noise_density: float = 2.0e-3
    accelerometer_random_walk: float = 3.0e-3
    gravity_m_per_s2: Sequence[float] = field(default=(0.0, -9.80665, 0.0))

    def __post_init__(self) -> None:
        if not 0 < self.rate_hz <= US_PER_S:
            raise RangeError("rate_hz", self.rate_hz, "above 0, at most 1e6 samples per second")
        for name in _DENSITIES:
            if not 0 <= getattr(self, name) < np.inf:
                raise RangeError(name, getattr(self, name), "0 or more")
        if len(self.gravity_m_per_s2) != 3 or not np.all(np.isfinite(self.gravity_m_per_s2)):
            raise RangeError("gravity_m_per_s2", self.gravity_m_per_s2, "three numbers, m/s²")


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """Samples in camera axes: x to the right of the image, y downwards, z along the view. All [n, 3] but `t_us`.

    Parameters
    ----------
    t_us : [n], end of each sample, µs.
    gyro_rad_per_s, accelerometer_m_per_s2 : with noise.
    gyro_ideal_rad_per_s, accelerometer_ideal_m_per_s2 : without noise; at rest the specific force is −gravity.
    gyro_bias_rad_per_s, accelerometer_bias_m_per_s2 : biases within the noise.
    """

    t_us: NDArray[np.float64]
    gyro_rad_per_s: NDArray[np.float64]
    accelerometer_m_per_s2: NDArray[np.float64]
    gyro_ideal_rad_per_s: NDArray[np.float64]
    accelerometer_ideal_m_per_s2: NDArray[np.float64]
    gyro_bias_rad_per_s: NDArray[np.float64]
    accelerometer_bias_m_per_s2: NDArray[np.float64]


def imu_samples(rays: ChiefRays, model: ImuModel, begin_us: float, end_us: float, seed: int) -> ImuSamples:
    """Samples whose ends lie after `begin_us` and up to `end_us`, at multiples of the period after `begin_us`.

    The noise of a sample is a pure function of the seed and its number.
    """
    period_us = US_PER_S / model.rate_hz
    count = int(np.floor((end_us - begin_us) / period_us + 1e-9))
    edges: NDArray[np.float64] = np.linspace(begin_us, begin_us + period_us * count, count + 1, dtype=np.float64)
    step_s = period_us * S_PER_US
    # orientations at the ends of the samples, and in their middles, [n, 3, 3]
    rotation = (rays.camera_to_world(edges) @ VISION_AXES)[:, :3, :3]
    middle = (rays.camera_to_world(edges[:-1] + period_us / 2) @ VISION_AXES)[:, :3, :3]
    # the mean rate over a sample is the whole turn in it, as a gyroscope integrates
    turn = np.swapaxes(rotation[:-1], 1, 2) @ rotation[1:]
    gyro = Rotation.from_matrix(turn).as_rotvec() / step_s if count else np.empty((0, 3))
    # likewise the mean acceleration is the change of velocity; gravity is felt as the opposite of a fall
    velocity = _velocity(rays.camera, rays.view.camera_to_world[:3, 3], edges)
    force = np.diff(velocity, axis=0) / step_s - np.asarray(model.gravity_m_per_s2, dtype=np.float64)
    accelerometer = np.einsum("nji,nj->ni", middle, force)
    normal = {kind: _normal(seed, number, count) for number, kind in enumerate(_KINDS)}
    root = step_s**0.5
    # biases are random walks; white noise of a density falls with the root of the rate
    gyro_bias = np.cumsum(model.gyro_random_walk * root * normal["gyro_walk"], axis=0)
    own_bias = np.cumsum(model.accelerometer_random_walk * root * normal["accelerometer_walk"], axis=0)
    return ImuSamples(
        edges[1:],
        gyro + gyro_bias + model.gyro_noise_density / root * normal["gyro_white"],
        accelerometer + own_bias + model.accelerometer_noise_density / root * normal["accelerometer_white"],
        gyro,
        accelerometer,
        gyro_bias,
        own_bias,
    )


def _normal(seed: int, kind: int, count: int) -> NDArray[np.float64]:
    """Standard normal deviates [count, 3]; each kind has numbers of its own."""
    index = (np.arange(count)[:, None] * len(_KINDS) + kind) * 3 + np.arange(3)
    return device_normal(seed, Stream.IMU, index.astype(np.uint32)).astype(np.float64)


def _velocity(track: Trajectory | None, place: NDArray[np.float64], t_us: NDArray[np.float64]) -> NDArray[np.float64]:
    """Velocity of a point that moves with a track, just after each time, [n, 3], m/s.

    Parameters
    ----------
    track : the motion, None for rest.
    place : the point at rest, [3], m.
    t_us : times, [n], µs.
    """
    if track is None:
        return np.zeros((t_us.size, 3))
    segment, share, length_us = track.segments(track.local_us(t_us))
    seconds = length_us * S_PER_US
    pose = track.within(segment, share)
    # the place turns about the pivot: its speed is that of the pivot and ω × arm
    arm = pose[:, :3, :3] @ (place - track.pivot_m)
    turn = track.arc_axis[segment] * (track.arc_rad[segment] / seconds)[:, None]
    shift = (track.translation_m[segment + 1] - track.translation_m[segment]) / seconds[:, None]
    speed = shift + np.cross(turn, arm)
    if not track.repeat:  # the pose is held before and after
        own = t_us - track.knots_us[0]
        speed[(own < 0) | (own >= track.period_us)] = 0.0
    return speed
