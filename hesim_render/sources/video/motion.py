"""Motion-compensated pictures between those of a video, by libavfilter's minterpolate."""

from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.sources.video.picture_layout import Planes, Reader

_NAMES = {(0, 0): "yuv444p", (1, 0): "yuv422p", (1, 1): "yuv420p", (0, 1): "yuv440p", (2, 0): "yuv411p"}


class MotionVideo:
    """A video with `factor` - 1 additional pictures between every two; the given ones are unchanged.

    Blocks are tracked in both directions and overlap (mi_mode=mci, mc_mode=aobmc, vsbmc=1). Motion is estimated in
    luma or green, in picture values and not in linear light. At a change of scene, pictures are repeated.

    Parameters
    ----------
    reader : video of 8-bit pictures; minterpolate supports no others.
    factor : pictures per given picture.

    Raises
    ------
    SpecError
        If the pictures have more than 8 bits.
    """

    def __init__(self, reader: Reader, factor: int) -> None:
        shape = reader.format
        if shape.bits != 8 or (shape.layout == "yuv" and shape.chroma_shift not in _NAMES):
            raise SpecError("interpolation 'motion' needs 8-bit pictures; 'linear' takes any", file=reader.name)
        self._reader, self._factor = reader, factor
        self.name, self.tags, self.timing = reader.name, reader.tags, reader.timing
        self.format = replace(shape, layout="planar") if shape.layout == "interleaved" else shape
        self.count = (reader.count - 1) * factor + 1
        self._restart()

    def _restart(self) -> None:
        import av.filter

        shape = self.format
        name = {"grey": "gray", "planar": "yuv444p"}.get(shape.layout) or _NAMES[shape.chroma_shift]
        self._name = name
        graph = av.filter.Graph()
        self._source = graph.add(
            "buffer",
            f"video_size={shape.width}x{shape.height}:pix_fmt={name}:time_base=1/1:pixel_aspect=1/1:frame_rate=1/1",
        )
        middle = graph.add("minterpolate", f"fps={self._factor}:mi_mode=mci:mc_mode=aobmc:me_mode=bidir:vsbmc=1")
        self._sink = graph.add("buffersink")
        self._source.link_to(middle)
        middle.link_to(self._sink)
        graph.configure()
        self._graph: Any = graph
        self._given = 0
        self._next = 0
        self._made: deque[Planes] = deque()
        self._last: Planes | None = None

    def read(self, index: int) -> Planes:
        if index < self._next - 1:
            self._restart()
        while self._next <= index:
            while not self._made:
                self._feed()
            self._last = self._made.popleft()
            self._next += 1
        assert self._last is not None
        return self._last

    def _feed(self) -> None:
        """Feed one picture and take the output. The last picture is fed twice, because the output ends one picture
        early.
        """
        import av

        if self._given > self._reader.count:
            self._source.push(None)
        else:
            planes = self._reader.read(min(self._given, self._reader.count - 1))
            frame = self._frame(planes)
            frame.pts, frame.time_base = self._given, Fraction(1)
            self._source.push(frame)
        self._given += 1
        while True:
            try:
                result = self._sink.pull()
            except (av.error.BlockingIOError, av.error.EOFError):
                return
            self._made.append(self._planes(result))

    def _frame(self, planes: Planes) -> Any:
        import av

        if planes[0].ndim == 3:
            planes = tuple(planes[0][..., channel] for channel in range(3))
        if self.format.layout == "planar":
            planes = planes[1], planes[0], planes[2]  # motion is estimated in the first plane: green
        frame = av.VideoFrame(self.format.width, self.format.height, self._name)
        for plane, values in zip(frame.planes, planes, strict=True):
            lines = np.zeros((plane.height, plane.line_size), np.uint8)
            lines[:, : plane.width] = values
            plane.update(lines.tobytes())
        return frame

    def _planes(self, frame: Any) -> Planes:
        result: list[NDArray] = [
            np.ascontiguousarray(np.frombuffer(p, np.uint8).reshape(p.height, p.line_size)[:, : p.width])
            for p in frame.planes
        ]
        return (result[1], result[0], result[2]) if self.format.layout == "planar" else tuple(result)

    def start_digest(self) -> None:
        self._reader.start_digest()

    def describe(self) -> Mapping[str, Any]:
        return self._reader.describe()

    def close(self) -> None:
        self._made.clear()
        self._graph = None
        self._reader.close()
