"""Estimated time of a run of a video, from counts.

What the rate of a video's pictures does to events, for the way in which the pixels compare.
"""

import os
from dataclasses import dataclass

import numpy as np

from hesim_render.core.progress import in_words
from hesim_render.core.units import S_PER_US
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.renderer import Estimate
from hesim_render.specs.event_pixels import EvsSpec

#: Processor seconds for a pixel of a picture, of an event sample and of a frame that is read out and stored; seconds
#: for each of these besides its pixels, and in all. From `benchmarks/video.py`, for one core of an AVX-512 server.
_PER_PIXEL_S, _PER_ITEM_S, _IN_ALL_S = np.array([8e-9, 17e-9, 60e-9]), np.array([1e-3, 1e-3, 2e-2]), 4.0


@dataclass(frozen=True)
class VideoEstimate(Estimate):
    """Estimated work of a run, right to about a factor of two; memory does not depend on its length.

    Parameters
    ----------
    seconds : total time, s.
    peak_bytes, rays, held_bytes : 0; a video has no rays, and its memory is not estimated.
    pictures, event_samples, frames : number of each.
    """

    pictures: int = 0
    event_samples: int = 0
    frames: int = 0

    def __str__(self) -> str:
        return (
            f"about {in_words(self.seconds)}, {self.pictures} pictures, {self.event_samples} event samples, "
            f"{self.frames} frames"
        )


def estimate_of_counts(sensor: Sensor, duration_us: int, pictures: int, seconds_per_picture: float) -> VideoEstimate:
    """The estimate of a run.

    Parameters
    ----------
    sensor, duration_us : the sensor and the length of the run, µs.
    pictures, seconds_per_picture : number of pictures, and time to read and decode one, s.
    """
    aps, evs, shape = sensor.spec.aps, sensor.spec.evs, sensor.layout.shape
    samples = 0
    if evs is not None:
        samples = pictures if evs.tick_us is None else duration_us // evs.tick_us
    frames = 0 if aps is None else int(duration_us * S_PER_US * aps.frame_rate_hz)
    count = np.array([pictures, samples, frames], dtype=np.float64)
    rows, cols = sensor.layout.evs_shape
    pixels = np.array([shape[0] * shape[1], rows * cols, shape[0] * shape[1]])
    seconds = (count * pixels * _PER_PIXEL_S).sum() / (os.cpu_count() or 1) + (count * _PER_ITEM_S).sum() + _IN_ALL_S
    seconds += pictures * seconds_per_picture
    return VideoEstimate(float(seconds), 0.0, 0.0, pictures=pictures, event_samples=int(samples), frames=frames)


def event_notes(spec: EvsSpec, period_us: float, is_held: bool) -> list[str]:
    """Notes for the user of a video in front of event pixels, in sentences; none where events follow the pictures.

    Parameters
    ----------
    spec : the event pixels.
    period_us : time from one picture to the next, µs.
    is_held : each picture is held until the next one; otherwise the light goes in a straight line between them.
    """
    if spec.tick_us is None:
        return [
            "the sensor's event pixels are asynchronous: their ln x goes in a straight line from the middle of one "
            "picture to that of the next, so that events are not half a picture late; frames see held pictures"
        ] if is_held else []  # fmt: skip
    if period_us <= spec.tick_us:
        return []
    rates = f"pictures come every {period_us:.0f} µs, event comparisons every {spec.tick_us} µs"
    if spec.reference == "last_event":  # small steps add up
        gather = f"{rates}: events gather where pictures change; interpolation 'linear' spreads them and loses none"
        return [gather] if is_held else []
    ticks, threshold = period_us / spec.tick_us, min(spec.contrast_threshold_on, spec.contrast_threshold_off)
    # light goes in a straight line: its largest relative step is that at the dark end
    spread, held = (f"{1 + number * np.expm1(threshold):.3g} times" for number in (ticks, 1.0))
    lost = (
        f"spreads a change over {ticks:.3g} comparisons, each with the sample before: one of less than {spread} "
        f"between two pictures gives no event, and {held} are enough where pictures are held"
    )
    if is_held:
        return [
            f"{rates}: events gather where pictures change; only pictures as fast as the comparisons avoid that. "
            f"Interpolation is not advised for this sensor: it {lost}"
        ]
    return [
        f"{rates}: events are LOST, as interpolation {lost}. Hold the pictures (interpolation 'none'), or use pictures "
        "as fast as the comparisons"
    ]
