"""How a scene moves in the picture, and how many events that gives, from its geometry alone: no light is traced.

Surfaces are as bright as their diffuse reflectance under light from the camera, and the sky as a white card where all
light comes from everywhere; so shadows, highlights, lamps that flicker and noise give no events here. What a pixel sees
is the mean over nine rays through its square.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import RangeError
from hesim_render.core.units import S_PER_US, US_PER_S
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.render.truth.chief_rays import ChiefRays, Placed
from hesim_render.sources.render.truth.poses import PoseTable, inverse
from hesim_render.sources.render.truth.raster import Raster
from hesim_render.sources.scene import Scene
from hesim_render.specs.event_pixels import EvsSpec

#: Wavelengths that stand for red, green and blue, nm; a ray carries four. Event pixels see their mean.
COLOURS_NM = (610.0, 545.0, 465.0, 465.0)
#: Longer side of the picture, px; points across it that are followed, and times at which they are.
_LONGER_SIDE, _POINTS, _TIMES = 480, 24, 65
#: Most event pixels that stand for all; intervals between samples, in bursts where these do not cover the run.
_PIXELS, _BURSTS, _INTERVALS = 10_000, 16, 8
#: Part of a pixel by which the picture moves from one sample to the next, at most, and quantile of speed that counts.
_STEP_PX, _FAST = 1 / 3, 0.99
#: Rays through a pixel, beside its centre, px.
_FOOTPRINT = [(x, y) for x in (-1 / 3, 0.0, 1 / 3) for y in (-1 / 3, 0.0, 1 / 3)]
#: A point moves if its path is at least so long, px.
_MOVES_PX = 0.5


class EventForecast(NamedTuple):
    """Events that the motion gives, by pixels and bursts of samples that stand for all.

    Parameters
    ----------
    density_hz : [row, col], events per pixel and second, of every `stride`-th event pixel in both directions.
    stride : event pixels from one to the next.
    rates_hz : [sample], events per second of all event pixels, between two samples each.
    """

    density_hz: NDArray[np.float64]
    stride: int
    rates_hz: NDArray[np.float64]

    @property
    def mean_hz(self) -> float:
        """Events per second of all event pixels, mean over the run."""
        return float(self.rates_hz.mean())

    @property
    def busy_hz(self) -> float:
        """Events per second that 90 % of the samples do not exceed."""
        return float(np.quantile(self.rates_hz, 0.9))


@dataclass(frozen=True, eq=False)
class MotionLook:
    """What moves in a scene.

    Parameters
    ----------
    picture : [row, col, 3], brightness at the wanted time, of every `stride`-th pixel of the region.
    stride : pixels of the region from one to the next.
    times_us : [time], µs.
    trails : [point, time, 2], column and row of points of surfaces that move, px of the region; NaN where a point is
        not in front of the camera. Occlusion does not count.
    speed_px_per_s : [point], speed at the wanted time; of all points, also of those at rest.
    moving : share of the points that move during the run.
    events : None for a sensor without event pixels.
    """

    picture: NDArray[np.float32]
    stride: int
    times_us: NDArray[np.float64]
    trails: NDArray[np.float64]
    speed_px_per_s: NDArray[np.float64]
    moving: float
    events: EventForecast | None


def motion_look(scene: Scene, sensor: Sensor, t_us: float, duration_us: int) -> MotionLook:
    """Look at the motion of a scene.

    Parameters
    ----------
    scene, sensor : from `load_scene` and `load_sensor`, cropped to the region that is read out.
    t_us : time of the picture, within the run, µs.
    duration_us : length of the run, µs.

    Raises
    ------
    RangeError
        If the time is outside of the run.
    SpecError
        If the scene cannot be loaded, or has no geometric truth (a mesh that changes its shape).
    """
    if not 0 <= t_us <= duration_us:
        raise RangeError("look", t_us * S_PER_US, f"0 to {duration_us * S_PER_US:g} s, within the run")
    rays = ChiefRays(scene, sensor)
    layout = rays.sensor.layout
    first = np.array([layout.col0, layout.row0], np.float64)
    stride = max(1, -(-max(layout.rows, layout.cols) // _LONGER_SIDE))
    row, col = np.mgrid[stride // 2 : layout.rows : stride, stride // 2 : layout.cols : stride]
    at = Placed(col.ravel() + first[0], row.ravel() + first[1], np.full(col.size, float(t_us)))
    picture = rays.brightness(at, COLOURS_NM)[:, :3].reshape(*col.shape, 3)
    times = np.linspace(0, duration_us, _TIMES)
    apart = max(layout.rows, layout.cols) / _POINTS
    y, x = (np.arange(apart / 2, count, apart) for count in layout.shape)
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) + first
    # a step of a thousandth of the run around the wanted time gives the speed
    near = np.clip([t_us - duration_us / 2000, t_us + duration_us / 2000], 0, duration_us)
    paths = _follow(rays, places, float(t_us), np.concatenate([times, near])) - first
    steps = np.linalg.norm(np.diff(paths[:, :-2], axis=1), axis=-1)
    length = np.nansum(steps, axis=1)
    speed = np.nan_to_num(np.linalg.norm(paths[:, -1] - paths[:, -2], axis=-1)) / ((near[1] - near[0]) * S_PER_US)
    moves = length >= _MOVES_PX
    fastest = np.nan_to_num(steps).max(axis=1) / (times[1] * S_PER_US)
    spec = rays.sensor.spec.evs
    event_density = None
    if spec is not None:
        fast = float(np.quantile(fastest[moves], _FAST)) if moves.any() else 0.0
        event_density = _events(rays, spec, duration_us, fast)
    return MotionLook(picture, stride, times, paths[moves, :-2], speed, float(moves.mean()), event_density)


def _follow(
    rays: ChiefRays, places: NDArray[np.float64], t_us: float, times_us: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Places at other times of the points that the picture shows at places at one time, [place, time, 2]."""
    hits = rays.trace(Placed(places[:, 0], places[:, 1], np.full(len(places), t_us)))
    group = rays.names.group_of[rays.names.object_of[rays.names.instance(hits.shape)]]
    local = rays.view.projection.unproject(places)
    local /= np.linalg.norm(local, axis=1, keepdims=True)
    far = np.isinf(hits.distance_m)
    local *= np.where(far, 1.0, hits.distance_m)[:, None]
    before = PoseTable(rays, np.array([t_us]))
    points = np.einsum("ij,nj->ni", before.camera[0], np.concatenate([local, np.where(far, 0.0, 1.0)[:, None]], axis=1))
    rest = np.einsum("nij,nj->ni", inverse(before.groups[group, 0]), points)
    after = PoseTable(rays, times_us)
    relative = inverse(after.camera) @ after.groups
    return np.stack(
        [
            rays.view.projection.project(np.einsum("nij,nj->ni", relative[group, k][:, :3], rest))
            for k in range(times_us.size)
        ],
        axis=1,
    )


def _events(rays: ChiefRays, spec: EvsSpec, duration_us: int, fast_px_per_s: float) -> EventForecast:
    """Events of pixels that stand for all."""
    raster = Raster.of(rays.sensor, "events")
    rows, cols = raster.shape
    stride = max(1, int(np.ceil((rows * cols / _PIXELS) ** 0.5)))
    some = np.s_[stride // 2 :: stride, stride // 2 :: stride]
    col, row = raster.col[some].astype(np.float64), raster.row[some].astype(np.float64)
    share = rows * cols / col.size
    tick_us = float(spec.tick_us or 0) if spec.reference == "previous_sample" else 0.0
    step_us = _STEP_PX / fast_px_per_s * US_PER_S if fast_px_per_s > 0 else float(duration_us)
    ticks = max(1, round(step_us / tick_us)) if tick_us else 0
    step_us = ticks * tick_us or min(step_us, duration_us)
    begins, count = _bursts(duration_us, step_us)
    total, rates = np.zeros(col.shape), np.zeros((begins.size, count))
    for number, begin_us in enumerate(begins):
        level = np.log(_seen(rays, col, row, begin_us))
        for k in range(count):
            log = np.log(_seen(rays, col, row, begin_us + (k + 1) * step_us))
            counts, level = _compared(spec, log, level, ticks)
            total += counts
            rates[number, k] = share * counts.sum() / (step_us * S_PER_US)
    return EventForecast(total / (rates.size * step_us * S_PER_US), stride, rates.ravel())


def _compared(
    spec: EvsSpec, log: NDArray[np.float64], level: NDArray[np.float64], ticks: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Events between two samples of ln brightness, and the level of comparison after them.

    Parameters
    ----------
    spec : thresholds.
    log, level : the sample, and the level of comparison before.
    ticks : fixed comparisons between two samples, over which the change is spread evenly; 0 for asynchronous pixels.
    """
    on, off = spec.contrast_threshold_on, spec.contrast_threshold_off
    change = log - level
    if ticks:
        each = change / ticks
        return ticks * ((each >= on) | (-each >= off)).astype(np.float64), log
    # a change of exactly a threshold counts, also after rounding
    up, down = (np.floor(np.maximum(change, 0) / on + 1e-9), np.floor(np.maximum(-change, 0) / off + 1e-9))
    return up + down, level + up * on - down * off


def _bursts(duration_us: float, step_us: float) -> tuple[NDArray[np.float64], int]:
    """Begins of bursts of samples, µs, and intervals in each: one that covers the run, or several spread over it."""
    intervals = max(1, round(duration_us / step_us))
    if intervals <= _BURSTS * _INTERVALS:
        return np.zeros(1), intervals
    return (np.arange(_BURSTS) + 0.5) / _BURSTS * duration_us - _INTERVALS * step_us / 2, _INTERVALS


def _seen(rays: ChiefRays, col: NDArray[np.float64], row: NDArray[np.float64], t_us: float) -> NDArray[np.float64]:
    """Brightness that pixels see at a time, the mean over their squares."""
    x, y = (np.concatenate([(own + offset[k]).ravel() for offset in _FOOTPRINT]) for k, own in enumerate((col, row)))
    bands = rays.brightness(Placed(x, y, np.full(x.size, float(t_us))), COLOURS_NM)[:, :3].mean(axis=1)
    return np.maximum(bands.reshape(len(_FOOTPRINT), *col.shape).mean(axis=0, dtype=np.float64), 1e-4)
