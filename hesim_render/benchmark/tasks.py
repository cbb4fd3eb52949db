"""Tasks of a clip with their baselines: deblurring, interpolation, denoising, events, flow, intensity, colour."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.benchmark.event_filters import FILTERS
from hesim_render.benchmark.exposure_merge import flux_of, flux_scores, merged_exposures
from hesim_render.benchmark.folder import BenchmarkClip
from hesim_render.benchmark.intensity import intensity_scores, leaky_sum, sharp_over_blurred
from hesim_render.benchmark.metrics import chamfer, count_error, denoising_scores, rate_error
from hesim_render.benchmark.optical_flow import flow_scores, of_pictures, picture_methods, plane_fit
from hesim_render.benchmark.pictures import ClipDevelopment, bilinear
from hesim_render.benchmark.predictions import Predictions
from hesim_render.pixels.evs.events import Label
from hesim_render.recording.frame import Frame

#: A sharp image counts as that of the middle of an exposure if it is at most so far away, in parts of the exposure.
_NEAR = 0.25
#: Tasks whose results are in DN.
IN_DN = ("deblur", "interpolate", "demosaic")


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
    predictions : results of a user, which are scored beside the baselines; None for none.
    longer : clips of the same scene, sensor, noise and seed with longer exposures, if this one has the shortest.
    """

    def __init__(
        self, clip: BenchmarkClip, predictions: Predictions | None = None, longer: Sequence[BenchmarkClip] = ()
    ) -> None:
        self._clip, self._development = clip, ClipDevelopment(clip)
        self._predictions, self._longer = predictions, longer

    def _predicted(self, task: str, item: int, shape: tuple[int, ...]) -> dict[str, NDArray]:
        """The user's result for an item, by the name of its method; empty where there is none."""
        if self._predictions is None:
            return {}
        full_scale = 2**self._clip.recording.mosaic.bit_depth - 1 if task in IN_DN else None
        prediction = self._predictions.read(task, self._clip.name, item, shape, full_scale)
        return {} if prediction is None else {"prediction": prediction}

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
            estimates = {"blurred": frame.raw.astype(np.float64)}
            if self._has_events():
                estimates["double-integral"] = self._sharpened(frame, truth[0])
            for name, raw in (estimates | self._predicted("deblur", frame.index, frame.raw.shape)).items():
                yield self._score("deblur", name, frame.index, raw, truth[1])

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
            estimates = {"hold": first, "average": (first + last) / 2}
            if self._has_events():
                t = truth[0]
                weight = (t - _middle_us(before)) / (_middle_us(after) - _middle_us(before))
                estimates["double-integral"] = (1 - weight) * self._sharpened(before, t) + weight * self._sharpened(
                    after, t
                )
            estimates |= self._predicted("interpolate", left_out.index, left_out.raw.shape)
            for name, raw in estimates.items():
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
        kept |= {name: mask > 0 for name, mask in self._predicted("denoise", 0, is_signal.shape).items()}
        for name, mask in kept.items():
            yield Score(self._clip.name, "denoise", name, 0, denoising_scores(mask, is_signal))

    def fidelity(self) -> Iterator[Score]:
        """Events, filtered or not, against those of the noise-free pixels."""
        labels, recording = self._clip.recording.event_labels, self._clip.recording
        if labels is None:
            return
        shape = recording.event_shape
        every: dict[str, Any] = {"none": lambda events, shape: np.ones(len(events), bool), **FILTERS}
        for name, mask in self._predicted("fidelity", 0, (len(recording.events),)).items():
            every[name] = lambda events, shape, mask=mask: mask > 0
        for name, filtered in every.items():
            events = recording.events[filtered(recording.events, shape)]
            values = {
                "count_error": count_error(events, labels.clean),
                "chamfer_px": chamfer(events, labels.clean),
                "rate_error_hz": rate_error(events, labels.clean, shape, recording.duration_us),
            }
            yield Score(self._clip.name, "fidelity", name, 0, values)

    def flow(self) -> Iterator[Score]:
        """Flow from each frame to the next, over the pixels whose point is seen again.

        Methods: none at all, OpenCV's on both frames as they are shown, and planes through the events between them.
        """
        stored, frames = self._clip.recording.stored_truth, self._clip.recording.frames
        if stored is None or "frames/flow_forward_px" not in stored.names:
            return
        for frame, after in zip(frames[:-1], frames[1:], strict=True):
            truth = stored.read("frames/flow_forward_px", frame.index)
            valid = stored.read("frames/visible_forward", frame.index) & np.isfinite(truth).all(axis=-1)
            estimates: dict[str, NDArray] = {"zero": np.zeros(truth.shape)}
            if picture_methods():
                first, second = self._development.grey_pair(frame.raw, after.raw)
                estimates |= {name: of_pictures(name, first, second) for name in picture_methods()}
            if self._has_events():
                estimates["plane-fit"] = self._event_flow(_middle_us(frame), _middle_us(after))
            estimates |= self._predicted("flow", frame.index, truth.shape)
            for name, flow in estimates.items():
                yield Score(self._clip.name, "flow", name, frame.index, flow_scores(flow, truth, valid))

    def _event_flow(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Flow of the mosaic between two times, px, from planes through the events between them."""
        recording = self._clip.recording
        events = recording.event_slice(int(begin_us), int(np.ceil(end_us)) + 1)
        velocity = plane_fit(events, recording.event_shape) * (end_us - begin_us)
        return self._development.flow_on_mosaic(velocity)

    def intensity(self) -> Iterator[Score]:
        """Log intensity from the events alone at each sharp image, where every pixel gives frames and events."""
        sharp, layout = self._clip.sharp, self._development.layout
        if sharp is None or not self._has_events() or layout.evs_shape != layout.shape:
            return
        spec = self._development.sensor.evs
        assert spec is not None
        thresholds = spec.contrast_threshold_on, spec.contrast_threshold_off
        for number, t_us in enumerate(sharp.time_us):
            with np.errstate(divide="ignore", invalid="ignore"):
                truth = np.log(sharp.flux_e_per_s(number).astype(np.float64))
            events = self._clip.recording.event_slice(0, int(t_us) + 1)
            estimates: dict[str, NDArray] = {"leaky-sum": leaky_sum(events, layout.shape, float(t_us), thresholds)}
            estimates |= self._predicted("intensity", number, layout.shape)
            for name, picture in estimates.items():
                yield Score(self._clip.name, "intensity", name, number, intensity_scores(picture, truth))

    def hdr(self) -> Iterator[Score]:
        """Flux in the middle of the shortest exposure, from frames of several exposures that begin at the same time."""
        if not self._longer or self._clip.sharp is None:
            return
        aps, sharp = self._development.sensor.aps, self._clip.sharp
        assert aps is not None
        clips = [self._clip, *self._longer]
        for number in range(min(len(clip.recording.frames) for clip in clips)):
            frames = [clip.recording.frames[number] for clip in clips]
            middle = _middle_us(frames[0])
            nearest = sharp.nearest(middle)
            if abs(sharp.time_us[nearest] - middle) > _NEAR * frames[-1].exposure_us:
                continue
            truth, valid = sharp.flux_e_per_s(nearest), self._development.layout.aps_mask
            exposures = [flux_of(frame.raw, frame.exposure_us, aps, self._clip.recording.mosaic) for frame in frames]
            estimates: dict[str, NDArray] = {"shortest": exposures[0].flux, "longest": exposures[-1].flux}
            estimates["merge"] = merged_exposures(exposures)
            estimates |= self._predicted("hdr", number, truth.shape)
            for name, flux in estimates.items():
                yield Score(self._clip.name, "hdr", name, number, flux_scores(flux, truth, valid))

    def demosaic(self) -> Iterator[Score]:
        """Every channel at every pixel from the noise-free RAW of each sharp image, whose event pixels have no value.

        The truth is the rendered light through each filter (`colours`).
        """
        sharp, colours, development = self._clip.sharp, self._clip.colours, self._development
        if sharp is None or colours is None:
            return
        mosaic, aps = self._clip.recording.mosaic, development.sensor.aps
        assert aps is not None
        order = [colours.channels.index(name) for name in mosaic.channels]
        for number in range(len(colours.time_us)):
            raw = sharp.raw_dn(number).astype(np.float64)
            exposure_us = float(self._clip.content["exposure_us"] or aps.exposure_us)
            truth = development.full_dn(colours.flux_e_per_s(number)[..., order], exposure_us)
            estimates = {"guided": development.demosaiced(raw), "bilinear": bilinear(raw, mosaic.tile_channel)}
            estimates |= self._predicted("demosaic", number, truth.shape)
            for name, channels in estimates.items():
                values = development.channel_scores(channels, truth)
                yield Score(self._clip.name, "demosaic", name, number, values)


TASKS: dict[str, Callable[[ClipTasks], Iterator[Score]]] = {
    "deblur": ClipTasks.deblur,
    "interpolate": ClipTasks.interpolate,
    "denoise": ClipTasks.denoise,
    "fidelity": ClipTasks.fidelity,
    "flow": ClipTasks.flow,
    "intensity": ClipTasks.intensity,
    "hdr": ClipTasks.hdr,
    "demosaic": ClipTasks.demosaic,
}
