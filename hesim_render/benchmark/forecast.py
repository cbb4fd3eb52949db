"""Time and size of a build, estimated before it starts from a clip of each sensor."""

import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hesim_render.benchmark.plan import BenchmarkPlan, Clip
from hesim_render.capture.loop import Capture
from hesim_render.capture.overheads import noise_seconds
from hesim_render.capture.run_settings import noise_models
from hesim_render.capture.scene_renderer import scene_renderer
from hesim_render.core.progress import Progress, counted, in_words
from hesim_render.mosaic.schedule import Exposure
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.render.light_level import in_absolute_light
from hesim_render.sources.renderer import Demand
from hesim_render.sources.scene import Scene, load_scene

#: Clips that stand for all, at most; each takes some seconds.
_MOST = 3
#: Compiling and writing of a clip, and its audit, s of one processor: 6.4 to 8.1 s and 2.2 to 7.6 s for three generated
#: scenes of 2 to 4 solids whose rays took little (``benchmarks/clips.py``).
_CLIP_S, _AUDIT_S = 7.0, 5.0
#: Bytes of a pixel in a frame with its electrons, in a sharp image, and of an event.
_FRAME_BYTES, _SHARP_BYTES, _EVENT_BYTES = 10, 8, 8
#: Bytes of a pixel in one image of each kind of truth, packed.
_TRUTH_BYTES = {"depth": 6, "normals": 6, "position": 9, "ids": 1, "flow": 12, "mixed": 0.3}
#: Events per pixel and second that are assumed.
_ACTIVITY_HZ = 10.0
_FIXED_BYTES = 200_000


@dataclass(frozen=True)
class BuildEstimate:
    """Expected time and size of the clips that are still to be built, right to about a factor of three.

    Parameters
    ----------
    clips : their number.
    seconds : of one worker alone, s.
    bytes : size.
    """

    clips: int
    seconds: float
    bytes: float

    def __str__(self) -> str:
        return f"{counted(self.clips, 'clip')}, about {in_words(self.seconds)} of one worker, {self.bytes / 1e9:.2g} GB"

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def estimate_build(plan: BenchmarkPlan, clips: list[Clip], progress: Progress | None = None) -> BuildEstimate:
    """Estimate time and size of clips.

    Parameters
    ----------
    plan, clips : what is to be built.
    progress : called with (done, total, what).
    """
    if not clips:
        return BuildEstimate(0, 0.0, 0.0)
    every: dict[int, list[Clip]] = {}
    for clip in clips:
        every.setdefault(clip.sensor, []).append(clip)
    # from different scenes: one that is slow must not stand for all
    chosen = {
        sensor: own[len(own) * (2 * place + 1) // (2 * len(every))] for place, (sensor, own) in enumerate(every.items())
    }
    sample = list(chosen.values())[:_MOST]
    seconds: list[float] = []
    for number, clip in enumerate(sample):
        if progress is not None:
            progress(number, len(sample), "estimate")
        sensor = plan.sensor(clip)
        with tempfile.TemporaryDirectory() as folder:
            files = plan.scene_files(clip)
            scene = plan.given_scene(clip) if files is None else load_scene(files.write(Path(folder)))
            seconds.append(_render_seconds(plan, clip, scene, sensor))
    sizes = {number: _bytes(plan, plan.sensor(clip)) for number, clip in chosen.items()}
    size = sum(sizes[clip.sensor] for clip in clips)
    each = float(np.mean(seconds)) + _CLIP_S + plan.spec.audit * _AUDIT_S
    return BuildEstimate(len(clips), len(clips) * each, size)


def _sharp_exposures(plan: BenchmarkPlan, sensor: Sensor) -> list[Exposure]:
    spec = plan.spec.sharp
    if spec is None or sensor.spec.aps is None:
        return []
    line_us = sensor.spec.aps.line_time_us if sensor.spec.aps.shutter == "rolling" else 0.0
    middles = spec.middles_us(plan.spec.duration_us, line_us * (sensor.rows - 1))
    starts = [round(t - spec.window_us / 2) for t in middles]
    return [Exposure(k, start, spec.window_us, sensor.rows, line_us) for k, start in enumerate(starts)]


def _render_seconds(plan: BenchmarkPlan, clip: Clip, scene: Scene, sensor: Sensor) -> float:
    spec = plan.spec
    seed = spec.seeds[clip.seed]
    if spec.samples is not None:
        return 0.0  # most of the time of small clips is not that of rays
    flux = scene_renderer(in_absolute_light(scene)[0], sensor, seed, spec.quality)
    level = spec.noise[clip.noise]
    capture = Capture(flux, flux.sensor, *noise_models(sensor, level.clean, level.without), spec.duration_us, seed)
    pixel, exposures = capture.frame_exposures
    blocks = capture.sample_of_event_blocks()
    asked = [*exposures, *_sharp_exposures(plan, sensor)]
    expected = flux.estimate(Demand(spec.duration_us, capture.event_pixels, blocks, pixel, asked))
    return expected.seconds + noise_seconds(flux.sensor, spec.duration_us, blocks.windows, rests=flux.is_static)


def _bytes(plan: BenchmarkPlan, sensor: Sensor) -> float:
    """Expected size of a clip."""
    spec, aps = plan.spec, sensor.spec.aps
    frames = 0 if aps is None else int(spec.duration_s * aps.frame_rate_hz)
    pixels, event_pixels = sensor.rows * sensor.cols, int(np.prod(sensor.layout.evs_shape))
    truth = sum(_TRUTH_BYTES.get(kind, 0) for kind in spec.truth)
    images = frames * pixels * (_FRAME_BYTES + truth) + len(_sharp_exposures(plan, sensor)) * pixels * _SHARP_BYTES
    times = frames or spec.duration_s * 100
    events = event_pixels * (truth * times + _ACTIVITY_HZ * spec.duration_s * _EVENT_BYTES)
    return _FIXED_BYTES + images + events
