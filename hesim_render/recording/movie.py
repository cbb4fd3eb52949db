"""A recording as a video for people: the colour view, the events, or the events over the colour view."""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np

from hesim_render.core.errors import RangeError
from hesim_render.pixels.evs.events import no_events
from hesim_render.recording.colour_view import Picture, black_picture, colour_picture, events_picture
from hesim_render.recording.preview import magnified
from hesim_render.recording.recorded import Recorded

#: Pictures per second of the video, and time that one shows where there are no frames, µs.
_FPS, _STEP_US = 25, 10_000
#: Most pictures where there are no frames: four minutes of video. Those of a longer recording show longer times.
_MOST_PICTURES = 6000
_WIDEST_PX = 1280
#: Fewest pictures of a video, if the recording has as many µs: it shows two seconds at least.
_FEWEST = 50
#: Constant quality of x264, where 0 is without loss.
_QUALITY = "18"


def write_movie(recording: Recorded, path: Path, kind: str) -> int:
    """Write an MP4 file (H.264) with a picture for each frame, or for each 10 ms where there are no frames.

    Without frames there are at most 6000 pictures: those of a recording of more than a minute show longer times.
    Returns the number of pictures.

    A recording that gives fewer than 50 of them has several pictures for each, in equal steps of time, so that what
    is short plays for two seconds. The events of a picture are those since the one before, over the frame that ends
    next. The video has 25 pictures a second, so a recording of 100 frames a second plays four times as slow as it was.

    Parameters
    ----------
    recording, path, kind : recording, file, and ``mp4`` (events over the colour view), ``mp4-colour`` or
        ``mp4-events``.

    Raises
    ------
    RangeError
        If the recording has no frames or no events to show.
    """
    import av

    if kind == "mp4-colour" and not len(recording.frames):
        raise RangeError("format", kind, "mp4-events: there are no frames")
    if kind == "mp4-events" and 0 in recording.event_shape:
        raise RangeError("format", kind, "mp4-colour: there are no events")
    count = 0
    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=_FPS)
        stream.pix_fmt, stream.options = "yuv420p", {"crf": _QUALITY, "threads": "1"}
        for small in _pictures(recording, kind):
            picture = magnified(small)
            even = picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2]
            if not count:
                stream.height, stream.width = even.shape[:2]
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")
            container.mux(stream.encode(frame))
            count += 1
        container.mux(stream.encode(None))
    return count


def _pictures(recording: Recorded, kind: str) -> Iterator[Picture]:
    time = recording.manifest["time"]
    begin_us, end_us = time["begin_us"], time["end_us"]
    if len(recording.frames):
        edges = [begin_us, *(entry["t_us"] for entry in recording.manifest["frames"])]
    else:
        step_us = max(_STEP_US, -(-(end_us - begin_us) // _MOST_PICTURES))
        edges = [*range(begin_us, end_us, step_us), end_us]
    parts = -(-_FEWEST // (len(edges) - 1))
    black = black_picture(recording, _WIDEST_PX)
    for number, ends in enumerate(pairwise(edges)):
        background = black
        if kind != "mp4-events" and len(recording.frames):
            background = colour_picture(recording.frames[number].raw, recording.mosaic, _WIDEST_PX)
        for first, last in pairwise(np.linspace(*ends, parts + 1).round().astype(int).tolist()):
            if kind == "mp4-colour" or min(recording.event_shape) == 0:
                yield background
                continue
            events = recording.event_slice(first + 1, last + 1) if last > first else no_events()
            yield events_picture(background, events, recording.event_shape)
