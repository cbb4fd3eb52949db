"""Tasks of a clip with their baselines: deblurring, frame interpolation, event denoising, fidelity of events."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.benchmark.double_integral import sharp_over_blurred
from hesim_render.benchmark.event_filters import FILTERS
from hesim_render.benchmark.folder import BenchmarkClip
from hesim_render.benchmark.metrics import chamfer, count_error, denoising_scores, rate_error
from hesim_render.benchmark.pictures import Development
from hesim_render.pixels.evs.events import Label
from hesim_render.recording.frame import Frame

#: A sharp image counts as that of the middle of an exposure if it is at most so far away, in parts of the exposure.
_NEAR = 0.25


@dataclass(frozen=True)
class Score:
    """Measures of one method on one item of a clip."""

    clip: str
    task: str
    method: str
    item: int
    values: dict[str, float]


def _middle_us(frame: Frame) -> float:
    return frame.exposure_start_us + frame.exposure_us / 2


class ClipTasks:
    """All tasks of one clip.

    Parameters
    ----------
    clip : the clip.
    """

    def __init__(self, clip: BenchmarkClip) -> None:
        self._clip, self._development = clip, Development(clip)

    def _truth(self, frame: Frame) -> tuple[float, NDArray] | None:
        """Time and RAW of the sharp image in the middle of a frame's exposure; None where there is none."""
        sharp = self._clip.sharp
        if sharp is None or not len(sharp.time_us):
            return None
        number = sharp.nearest(_middle_us(frame))
        t_us = float(sharp.time_us[number])
        if abs(t_us - _middle_us(frame)) > _NEAR * frame.exposure_us:
            return None
        return t_us, sharp.raw_dn(number).astype(np.float64)

    def _has_events(self) -> bool:
        return self._development.sensor.evs is not None

    def _sharpened(self, frame: Frame, t_us: float) -> NDArray[np.float64]:
        """RAW at a time, from a blurred frame and its events (event double integral)."""
        spec, development = self._development.sensor.evs, self._development
        assert spec is not None
        begin = min(frame.exposure_start_us, t_us)
        rows = frame.raw.shape[0] * frame.line_time_us
        end = max(frame.exposure_start_us + frame.exposure_us, t_us) + rows
        events = self._clip.recording.event_slice(int(begin), int(np.ceil(end)) + 1)
        shape = self._clip.recording.event_shape
        row_of = development.layout.evs_pixel.reshape(shape)[:, 0] // development.layout.cols
        starts = frame.exposure_start_us + row_of * frame.line_time_us
        thresholds = spec.contrast_threshold_on, spec.contrast_threshold_off
        ratio = sharp_over_blurred(
            events, shape, starts, frame.exposure_us, [t_us + row_of[0] * frame.line_time_us], thresholds
        )[0]
        black = self._clip.recording.mosaic.black_level_dn
        return (frame.raw - black) * development.on_mosaic(ratio) + black

    def deblur(self) -> Iterator[Score]:
        """Sharp image in the middle of each exposure: the blurred frame as it is, and the event double integral."""
        for frame in self._clip.recording.frames:
            truth = self._truth(frame)
            if truth is None:
                continue
            yield self._score("deblur", "blurred", frame.index, frame.raw.astype(np.float64), truth[1])
            if self._has_events():
                yield self._score("deblur", "double-integral", frame.index, self._sharpened(frame, truth[0]), truth[1])

    def interpolate(self) -> Iterator[Score]:
        """Every second frame is left out and made from its neighbours, as in the H-ESIM paper.

        The truth is the sharp image in the middle of its exposure. Methods: the mean of both neighbours, the earlier
        one as it is, and the event double integral of both, weighted by their distance in time.
        """
        frames = self._clip.recording.frames
        for k in range(1, len(frames) - 1, 2):
            before, left_out, after = frames[k - 1], frames[k], frames[k + 1]
            truth = self._truth(left_out)
            if truth is None:
                continue
            first, last = before.raw.astype(np.float64), after.raw.astype(np.float64)
            found = {"hold": first, "average": (first + last) / 2}
            if self._has_events():
                t = truth[0]
                weight = (t - _middle_us(before)) / (_middle_us(after) - _middle_us(before))
                found["double-integral"] = (1 - weight) * self._sharpened(before, t) + weight * self._sharpened(
                    after, t
                )
            for name, raw in found.items():
                yield self._score("interpolate", name, left_out.index, raw, truth[1])

    def _score(self, task: str, method: str, item: int, raw: NDArray, truth: NDArray) -> Score:
        return Score(self._clip.name, task, method, item, self._development.scores(raw, truth))

    def denoise(self) -> Iterator[Score]:
        """Which events are signal: the labels ``signal`` and ``mismatch`` are, all others are noise."""
        labels, recording = self._clip.recording.event_labels, self._clip.recording
        if labels is None or not len(recording.events):
            return
        is_signal = np.isin(labels.label, [Label.SIGNAL, Label.MISMATCH])
        kept = {"none": np.ones(len(is_signal), bool)}
        kept |= {name: filtered(recording.events, recording.event_shape) for name, filtered in FILTERS.items()}
        for name, mask in kept.items():
            yield Score(self._clip.name, "denoise", name, 0, denoising_scores(mask, is_signal))

    def fidelity(self) -> Iterator[Score]:
        """Events, filtered or not, against those of the noise-free pixels."""
        labels, recording = self._clip.recording.event_labels, self._clip.recording
        if labels is None:
            return
        shape = recording.event_shape
        every: dict[str, Any] = {"none": lambda events, shape: np.ones(len(events), bool), **FILTERS}
        for name, filtered in every.items():
            events = recording.events[filtered(recording.events, shape)]
            values = {
                "count_error": count_error(events, labels.clean),
                "chamfer_px": chamfer(events, labels.clean),
                "rate_error_hz": rate_error(events, labels.clean, shape, recording.duration_us),
            }
            yield Score(self._clip.name, "fidelity", name, 0, values)


TASKS: dict[str, Callable[[ClipTasks], Iterator[Score]]] = {
    "deblur": ClipTasks.deblur,
    "interpolate": ClipTasks.interpolate,
    "denoise": ClipTasks.denoise,
    "fidelity": ClipTasks.fidelity,
}
