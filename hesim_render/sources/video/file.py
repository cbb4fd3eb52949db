"""Video from a file, decoded by PyAV as it is needed."""

import contextlib
import re
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import reason, require_plain
from hesim_render.sources.video.digest import Hashed
from hesim_render.sources.video.picture_layout import Planes, Timing
from hesim_render.sources.video.pyav import frame_format, planes_of, require_decodable, tags_of

_PIECE_BYTES = 1 << 20


class FileVideo(Hashed):
    """The first video stream of a file; only a few pictures are in memory.

    The file is first read once without decoding, for the time stamps of all its pictures, which may be regular or not.
    Pictures that a decoder reports as damaged are errors; they are never used in part.

    Parameters
    ----------
    path : the file.
    fps : pictures per second of the video's clock instead of the file's time stamps.

    Raises
    ------
    SpecError
        If the file is not a usable video; also later in `read`, if a picture is damaged or missing.
    """

    def __init__(self, path: str | Path, fps: float | None = None) -> None:
        self.name = str(path)
        self._path = Path(path)
        self._container: Any = None
        self._open()
        self._pts, timing, self.count = self._scan()
        if fps is not None:
            timing = replace(Timing.regular(self.count, fps), cut_short="" if timing is None else timing.cut_short)
        self.timing = timing
        self._open()
        frame, self._first = self._decoded()
        self.format, self._target = frame_format(frame, self._codec, self.name)
        self.tags = tags_of(frame, self.format, self.name)
        self._pixel_format = frame.format.name
        self._next_frame: Any = frame

    # -- opening and scanning

    def _open(self) -> None:
        import av

        self._close_container()
        require_plain(self._path)
        try:
            self._container = av.open(self.name)
        except (av.error.FFmpegError, OSError, ValueError) as error:
            raise SpecError(f"cannot be opened as a video ({reason(error)})", file=self._path) from None
        if not self._container.streams.video:
            self._close_container()
            raise SpecError("has no video in it", file=self._path)
        self._stream = self._container.streams.video[0]
        if self._stream.codec_context is None:
            raise SpecError("has a video that no decoder here reads", file=self._path)
        require_decodable(self._stream, self._path)
        # frames decoded ahead would log checksum errors before _checksum_errors listens
        self._stream.thread_type = "SLICE" if self._stream.codec_context.name == "ffv1" else "AUTO"
        self._stream.codec_context.options = {"err_detect": "crccheck+explode"}
        self._codec = self._stream.codec_context.name
        ratio = self._stream.sample_aspect_ratio
        if ratio is not None and ratio > 0 and ratio != 1:
            raise SpecError(f"has pixels that are not square ({ratio}): scale it first", file=self._path)
        self._frames = self._decode()
        self._next = 0
        self._next_frame = None

    def _scan(self) -> tuple[np.ndarray | None, Timing | None, int]:
        """Sorted time stamps and timing (None if they do not distinguish the pictures), and the number of pictures."""
        import av

        stamps = array("q")  # an hour at 3200 pictures/s has 11 million
        unknown = False
        last_duration, damaged = 0, ""
        try:
            for packet in self._container.demux(self._stream):
                if packet.size == 0 or packet.is_discard:
                    continue
                if packet.is_corrupt:
                    damaged = "a packet is damaged"
                    break
                unknown |= packet.pts is None
                stamps.append(packet.pts or 0)
                last_duration = packet.duration or last_duration
        except (av.error.FFmpegError, OSError) as error:
            damaged = reason(error)
        if not stamps:
            raise SpecError(f"has no pictures in it{f' ({damaged})' if damaged else ''}", file=self._path)
        if unknown:
            return None, None, len(stamps)
        pts = np.sort(np.array(stamps, dtype=np.int64))
        unit = float(self._stream.time_base or 1)
        begin = (pts - pts[0]) * unit
        if np.any(np.diff(pts) <= 0):
            # the clock is coarser than the picture period, as for a high-speed video in Matroska
            return None, None, len(stamps)
        typical = float(np.median(np.diff(begin))) if pts.size > 1 else 0.0
        length = last_duration * unit or typical or 1 / float(self._stream.average_rate or 1)
        timing = Timing(
            begin, float(begin[-1] + length), self._cut_short(len(pts), begin[-1] + length, typical, damaged)
        )
        return pts, timing, len(stamps)

    def _cut_short(self, count: int, end_s: float, typical_s: float, damaged: str) -> str:
        """A description of the evidence that the file once held more pictures; empty without evidence."""
        if damaged:
            return damaged
        if self._stream.frames > count:
            return f"its header counts {self._stream.frames} pictures"
        stated = re.fullmatch(r"(\d+):(\d+):([\d.]+)", self._stream.metadata.get("DURATION", ""))
        if stated is not None:
            seconds = int(stated[1]) * 3600 + int(stated[2]) * 60 + float(stated[3])
            if seconds > end_s + 1.5 * typical_s:
                return f"its header gives it {seconds:g} s"
        return ""

    # -- pictures

    def _decode(self) -> Iterator[Any]:
        import av

        try:
            yield from self._container.decode(self._stream)
        except (av.error.FFmpegError, OSError) as error:
            raise SpecError(
                f"picture {self._next} cannot be decoded ({reason(error)}): the file is damaged", file=self._path
            ) from None

    def _decoded(self) -> tuple[Any, int]:
        """The next picture and its number."""
        with _checksum_errors() as failed:
            frame = next(self._frames, None)
        if frame is None:
            raise SpecError(f"ends before picture {self._next} of {self.count}: the file is damaged", file=self._path)
        if frame.is_corrupt or failed:
            raise SpecError(f"picture {self._next} or one soon after it is damaged", file=self._path)
        index = self._next
        if self._pts is not None and frame.pts is not None:
            index = int(np.searchsorted(self._pts, frame.pts))
            if index > self._next:
                raise SpecError(f"picture {self._next} is missing: the file is damaged", file=self._path)
        self._next = max(index, self._next) + 1
        return frame, self._next - 1

    def read(self, index: int) -> Planes:
        if not 0 <= index < self.count:
            raise SpecError(f"has no picture {index}", file=self._path)
        if index < self._next - 1:
            self._open()
        while self._next <= index or self._next_frame is None:
            self._next_frame, _ = self._decoded()
        frame = self._next_frame
        where = f"{self.name}: picture {index}"
        if (frame.width, frame.height, frame.format.name) != (
            self.format.width,
            self.format.height,
            self._pixel_format,
        ):
            raise SpecError(
                f"is {frame.width}x{frame.height} {frame.format.name}, unlike the first picture "
                f"({self.format.width}x{self.format.height} {self._pixel_format})",
                file=where,
            )
        return planes_of(frame, self.format, self._target, where)

    def _pieces(self) -> Iterator[bytes]:
        with self._path.open("rb") as file:
            while piece := file.read(_PIECE_BYTES):
                yield piece

    def describe(self) -> Mapping[str, Any]:
        return {
            "source": self.name,
            "sha256": self._sha256(),
            "pictures": self.count,
            "size_px": [self.format.width, self.format.height],
            "codec": self._codec,
            "pixel_format": self._pixel_format,
            "bits": self.format.bits,
        }

    def close(self) -> None:
        self._stop_digest()
        self._close_container()

    def _close_container(self) -> None:
        if self._container is not None:
            self._container.close()
        self._container = None
        self._next_frame = None


@contextlib.contextmanager
def _checksum_errors() -> Iterator[list[str]]:
    """Errors of checksums that decoders only log: some (FFV1) return the damaged picture anyway."""
    import av.logging

    result: list[str] = []
    before = av.logging.get_level()
    av.logging.set_level(av.logging.ERROR)
    try:
        with av.logging.Capture(local=False) as logs:
            yield result
            result += [text for *_, text in logs if "CRC mismatch" in text]
    finally:
        av.logging.set_level(before)
