"""Figures of a clip by which clips differ: brightness, contrast, activity and speed."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.units import US_PER_S
from hesim_render.recording.recording import Recording
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.render.truth.scene_truth import SceneTruth
from hesim_render.sources.scene import Scene

#: Names and units of the figures, in the order of the card.
FIGURES = {
    "brightness_e_per_s": "mean noise-free flux of the first frame (without frames: of the event pixels), e⁻/s a pixel",
    "contrast": "standard deviation over mean of that flux, averaged over the positions of the tile",
    "activity_hz": "events per event pixel and second",
    "speed_widths_per_s": "mean length of the flow in the middle of the clip, widths of the picture per second",
}
#: Time between the two instants of the flow, µs.
_FLOW_US = 1000


def figures(recording: Recording, scene: Scene, sensor: Sensor) -> dict[str, float | None]:
    """The figures of a clip, None where a sensor has no such pixels."""
    counts, seconds = recording.manifest["counts"], recording.duration_us / US_PER_S
    pixels = recording.event_shape[0] * recording.event_shape[1]
    result: dict[str, float | None] = dict.fromkeys(FIGURES)
    flux = _flux(recording)
    if flux is not None:
        result["brightness_e_per_s"] = float(np.nanmean(flux))
        result["contrast"] = _contrast(flux, sensor)
    if pixels:
        result["activity_hz"] = counts["events"] / pixels / seconds
    result["speed_widths_per_s"] = _speed(scene, sensor, recording.duration_us)
    return result


def _flux(recording: Recording) -> NDArray[np.float32] | None:
    if len(recording.frames):
        frame = recording.frames[0]
        return frame.electrons_mean / np.float32(frame.exposure_us / US_PER_S)
    truth = recording.event_truth
    return None if truth is None else truth.flux_mean_e_per_s


def _contrast(flux: NDArray[np.float32], sensor: Sensor) -> float:
    rows, cols = len(sensor.spec.tile_rows), len(sensor.spec.tile_rows[0])
    if flux.shape != sensor.layout.shape:
        rows = cols = 1
    result = []
    for i in range(rows):
        for j in range(cols):
            part = flux[i::rows, j::cols]
            part = part[np.isfinite(part)]
            if part.size and part.mean() > 0:
                result.append(part.std() / part.mean())
    return float(np.mean(result)) if result else 0.0


def _speed(scene: Scene, sensor: Sensor, duration_us: int) -> float:
    """Mean speed of what the pixels show; points that the flow loses from sight count as well."""
    grid: Any = "events" if 0 not in sensor.layout.evs_shape else "mosaic"
    step = min(_FLOW_US, duration_us)
    begin = (duration_us - step) // 2
    flow = SceneTruth(scene, sensor).flow(begin, begin + step, grid=grid).flow_px
    length = np.hypot(flow[..., 0], flow[..., 1])
    length = length[np.isfinite(length)]
    if length.size == 0:
        return 0.0
    return float(length.mean() / flow.shape[1] * US_PER_S / step)
