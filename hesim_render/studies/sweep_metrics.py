"""Figures of one recording of a sweep: of its RAW frames, its events, and its first frame after the ISP."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import RangeError, SpecError, did_you_mean
from hesim_render.isp import FrameNoise
from hesim_render.isp.pipeline import DEFAULT, Pipeline, develop
from hesim_render.isp.steps import Development
from hesim_render.isp.tone import luminance
from hesim_render.measure import EdgeResponse, edge_response, measure_mtf
from hesim_render.measure.pictures import delta_e, psnr, ssim
from hesim_render.mosaic.colour_profile import Camera
from hesim_render.recording.recording import Recording
from hesim_render.specs.files import validate
from hesim_render.studies.table import Cell

#: Steps that reduce noise, which the pictures of noise-free frames do without.
_REDUCES = ("denoise", "noise_reduction")
#: Step that ends in codes, before which pictures are linear.
_ENCODE = "encode"


def changed_pipeline(pipeline: Pipeline, changes: Mapping[str, Any]) -> Pipeline:
    """A pipeline with other values of keys.

    Parameters
    ----------
    pipeline : the pipeline.
    changes : ``STEP.KEY`` with its value, or ``STEP`` with false, which leaves all steps of that name out. A key of a
        step that occurs several times is that of the first one.

    Raises
    ------
    SpecError
        If there is no such step or key, or the steps do not fit together any more.
    """
    steps = [dict(item) for item in pipeline.model_dump(exclude_none=True)["steps"]]
    for dotted, value in changes.items():
        name, _, key = dotted.partition(".")
        own = [step for step in steps if step["step"] == name]
        if not own:
            names = [step["step"] for step in steps]
            raise SpecError(f"isp.{dotted}: the pipeline has no step {name!r}{did_you_mean(name, names)}")
        if key:
            own[0][key] = value
        elif value is False:
            steps = [step for step in steps if step["step"] != name]
        elif value is not True:
            raise SpecError(f"isp.{dotted}: expected true or false, or a key of the step")
    return validate(Pipeline, {"steps": steps}, None, {})


@dataclass(frozen=True, eq=False)
class RunFigures:
    """Figures of a recording.

    Parameters
    ----------
    recording : the recording.
    pipeline : of its pictures.
    """

    recording: Recording
    pipeline: Pipeline = DEFAULT

    def __call__(self, metric: str) -> dict[str, Cell]:
        """One metric by its name in `specs.sweep.METRICS`: columns with values, None where it has no meaning."""
        name, of = _METRICS[metric]
        result = of(self)
        return result if isinstance(result, dict) else {name: result}

    @cached_property
    def seconds(self) -> float:
        """Length of the recording."""
        return self.recording.duration_us * 1e-6

    @property
    def events(self) -> int | None:
        """Number of events, None without event pixels."""
        return int(self.recording.manifest["counts"]["events"]) if self._event_pixels else None

    @property
    def _event_pixels(self) -> int:
        grid = self.recording.manifest["event_grid"]
        return int(grid["height"]) * int(grid["width"])

    @property
    def event_rate(self) -> float | None:
        """Events of one pixel in a second."""
        return None if self.events is None else self.events / (self._event_pixels * self.seconds)

    @property
    def on_share(self) -> float | None:
        """Part of the events that are ON."""
        return float((self.recording.events["polarity"] > 0).mean()) if self.events else None

    @property
    def electrons(self) -> float | None:
        """Noise-free mean of the first frame."""
        if not len(self.recording.frames):
            return None
        first = self.recording.frames[0]
        return float(first.electrons_mean[first.valid].mean(dtype=np.float64))

    @property
    def raw_mean(self) -> float | None:
        """Mean RAW value of the first frame."""
        if not len(self.recording.frames):
            return None
        first = self.recording.frames[0]
        return float(first.raw[first.valid].mean(dtype=np.float64))

    @cached_property
    def raw_variance(self) -> float | None:
        """Temporal variance from the difference of two frames (EMVA 1288); a still scene is needed."""
        if len(self.recording.frames) < 2:
            return None
        a, b = self._two_frames
        return float((a - b).var() / 2)

    @property
    def snr(self) -> float | None:
        """Mean signal above black over the temporal standard deviation."""
        if not self.raw_variance:
            return None
        a, b = self._two_frames
        return float((a.mean() + b.mean()) / 2 - self.recording.mosaic.black_level_dn) / self.raw_variance**0.5

    @cached_property
    def _two_frames(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        first, second = self.recording.frames[0], self.recording.frames[1]
        both = first.valid & second.valid
        return first.raw[both].astype(np.float64), second.raw[both].astype(np.float64)

    @cached_property
    def edge(self) -> EdgeResponse | None:
        """Response on the edge of a mono sensor's noise-free frame."""
        if not len(self.recording.frames):
            return None
        try:
            return measure_mtf(self.recording, signal="electrons")
        except RangeError:
            return None  # no edge, or a mosaic

    @property
    def mtf_nyquist(self) -> float | None:
        """Response at half a cycle per pixel."""
        return None if self.edge is None else float(np.interp(0.5, self.edge.frequency_cy_per_px, self.edge.mtf))

    @cached_property
    def picture(self) -> Development | None:
        """The first frame after the ISP."""
        if not len(self.recording.frames):
            return None
        noise = None
        if any(item.step == "denoise" for item in self.pipeline.steps):
            noise = FrameNoise.of_recording(self.recording.manifest, None, self.recording.path)
        return develop(self.recording.frames[0], self.recording.mosaic, self.pipeline, noise=noise)

    @cached_property
    def clean_picture(self) -> NDArray | None:
        """The noise-free first frame after the ISP without noise reduction, at the exposure of the noisy one."""
        if self.picture is None:
            return None
        return self._of_clean(self.pipeline)

    def _of_clean(self, pipeline: Pipeline) -> NDArray:
        mosaic, first = self.recording.mosaic, self.recording.frames[0]
        for name in _REDUCES:
            pipeline = pipeline.without(name)
        gain = None if self.picture is None else self.picture.exposure_gain
        raw = mosaic.black_level_dn + mosaic.system_gain_dn_per_e * first.electrons_mean
        clean = np.minimum(raw, Camera.of(mosaic).white_level_dn).astype(np.float32)
        return develop(clean, mosaic, pipeline, exposure_gain=gain).image

    def against_clean(self, measure: Callable[..., float]) -> float | None:
        """A measure of the picture against that of the noise-free frame; 1 is white, linear noise may be below 0."""
        if self.picture is None or self.clean_picture is None:
            return None
        return measure(_with_white_at_1(self.picture.image), _with_white_at_1(self.clean_picture))

    @property
    def picture_delta_e(self) -> float | None:
        """Mean ΔE2000 between the pictures, before codes are made of them."""
        if self.picture is None:
            return None
        linear = RunFigures(self.recording, self.pipeline.without(_ENCODE))
        return linear.against_clean(delta_e)

    @property
    def picture_mtf50(self) -> float | None:
        """Frequency at which luminance on the edge of the noise-free picture falls to half, cycles per pixel."""
        if self.picture is None:
            return None
        mosaic, signal = self.recording.mosaic, float(self.recording.frames[0].electrons_mean.max())
        if mosaic.black_level_dn + mosaic.system_gain_dn_per_e * signal >= mosaic.white_level_dn:
            return None  # a saturated edge has no response
        try:
            return _number(edge_response(luminance(self._of_clean(self.pipeline.without(_ENCODE)))).frequency_at(0.5))
        except RangeError:
            return None

    @property
    def isp_report(self) -> dict[str, Cell]:
        """Numbers that the steps of the ISP report."""
        result = {} if self.picture is None else self.picture.report or {}
        return {f"isp_{key}": float(value) for key, value in result.items() if isinstance(value, int | float)}


def _with_white_at_1(picture: NDArray) -> NDArray[np.float64]:
    top = np.iinfo(picture.dtype).max if picture.dtype.kind == "u" else 1
    return picture.astype(np.float64) / top


def _at(level: float) -> Callable[[RunFigures], Cell]:
    return lambda figures: None if figures.edge is None else _number(figures.edge.frequency_at(level))


def _number(value: float) -> float | None:
    return None if np.isnan(value) else value


#: Column and value of each metric.
_METRICS: dict[str, tuple[str, Callable[[RunFigures], Cell | dict[str, Cell]]]] = {
    "frames": ("frames", lambda figures: len(figures.recording.frames)),
    "electrons": ("electrons_mean", lambda figures: figures.electrons),
    "raw_mean": ("raw_mean_dn", lambda figures: figures.raw_mean),
    "raw_variance": ("raw_variance_dn2", lambda figures: figures.raw_variance),
    "snr": ("snr", lambda figures: figures.snr),
    "events": ("events", lambda figures: figures.events),
    "event_rate": ("event_rate_hz_per_px", lambda figures: figures.event_rate),
    "on_share": ("on_share", lambda figures: figures.on_share),
    "mtf50": ("mtf50_cy_per_px", _at(0.5)),
    "mtf10": ("mtf10_cy_per_px", _at(0.1)),
    "mtf_nyquist": ("mtf_nyquist", lambda figures: figures.mtf_nyquist),
    "picture_mean": (
        "picture_mean",
        lambda figures: None if figures.picture is None else float(_with_white_at_1(figures.picture.image).mean()),
    ),
    "picture_psnr": ("picture_psnr_db", lambda figures: figures.against_clean(psnr)),
    "picture_ssim": ("picture_ssim", lambda figures: figures.against_clean(ssim)),
    "picture_delta_e": ("picture_delta_e", lambda figures: figures.picture_delta_e),
    "picture_mtf50": ("picture_mtf50_cy_per_px", lambda figures: figures.picture_mtf50),
    "isp_report": ("isp_report", lambda figures: figures.isp_report),
}
