"""What a clip holds for training, as arrays: one sample for each frame, and each event in one of them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.benchmark.folder import BenchmarkClip

#: Geometric truth that goes with each frame, and its name in the recording.
_TRUTH = {
    "depth_m": "frames/depth_m", "flow_px": "frames/flow_forward_px", "visible": "frames/visible_forward",
    "normal": "frames/normal", "object": "frames/object",
}  # fmt: skip


def samples(clip: BenchmarkClip) -> Iterator[tuple[str, dict[str, NDArray], dict[str, Any]]]:
    """The samples of a clip, in order of time.

    The events of a frame are those from the begin of its exposure to the begin of the next frame's; the first frame has
    those before it as well, the last one all to the end. A clip without frames is one sample.

    Parameters
    ----------
    clip : the clip.

    Yields
    ------
    Name, arrays and figures. Arrays: ``raw`` (uint16, DN) and ``sharp`` (uint16, DN, of the sharp image nearest to the
    middle of the exposure), ``events`` (`EVENT_DTYPE`) with ``label`` (uint8) and ``event_object`` (uint16), and the
    geometric truth of the frame, as far as the clip has them. Figures: split, times, levels and shapes.
    """
    recording, sharp, stored = clip.recording, clip.sharp, clip.recording.stored_truth
    frames, mosaic = recording.frames, recording.mosaic
    labels = recording.event_labels
    objects = recording.event_objects if recording.has_event_objects else None
    when = recording.events["t_us"]
    begins = [frame.exposure_start_us for frame in frames][1:]
    edges = np.searchsorted(when, begins, side="right") if begins else np.empty(0, np.int64)
    edges = np.concatenate([[0], edges, [len(when)]]).astype(np.int64)
    common = {
        "clip": clip.name, "split": clip.split, "sensor": clip.content["sensor"], "noise": clip.content["noise"],
        "event_shape": list(recording.event_shape), "bit_depth": mosaic.bit_depth,
        "black_level_dn": mosaic.black_level_dn, "duration_us": recording.duration_us,
    }  # fmt: skip
    for number in range(max(1, len(frames))):
        arrays: dict[str, NDArray] = {}
        figures: dict[str, Any] = {**common, "index": number}
        part = slice(edges[number], edges[number + 1])
        if 0 not in recording.event_shape:
            arrays["events"] = recording.events[part]
            if labels is not None:
                arrays["label"] = labels.label[part]
            if objects is not None:
                arrays["event_object"] = objects[part]
        if len(frames):
            frame = frames[number]
            arrays["raw"] = frame.raw
            figures |= {
                "exposure_start_us": frame.exposure_start_us, "exposure_us": frame.exposure_us,
                "line_time_us": frame.line_time_us,
            }  # fmt: skip
            if sharp is not None and len(sharp.time_us):
                nearest = sharp.nearest(frame.exposure_start_us + frame.exposure_us / 2)
                arrays["sharp"], figures["sharp_t_us"] = sharp.raw_dn(nearest), float(sharp.time_us[nearest])
            if stored is not None:
                arrays |= {key: stored.read(name, number) for key, name in _TRUTH.items() if name in stored.names}
        yield f"{clip.name}-{number:06d}", arrays, figures
