"""A capture set on disk: ``capture.yaml`` and the ``.npz`` files beside it, read as streams.

Frames are decompressed one at a time, so a capture set larger than memory can be calibrated.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import inside
from hesim_render.core.npz import member_header, read_arrays, stream_member
from hesim_render.core.units import S_PER_US
from hesim_render.sensor.reading import read_sensor
from hesim_render.specs.capture import CaptureSpec
from hesim_render.specs.files import read_spec
from hesim_render.specs.sensor import SensorSpec

#: Largest clean signal of an event pixel: a thousand times the largest DN of 16 bits, for bright lights.
BRIGHTEST_DN = 65535e3
SIGNAL_RANGE = (
    f"signal_dn must be 0 or above (the clean light signal, black subtracted), and at most {BRIGHTEST_DN:g} DN"
)
#: Largest number that a capture may state; up to here float64 holds all whole numbers.
_MOST = 2.0**53


@dataclass(frozen=True)
class CaptureSet:
    """A folder of captures and the content of its ``capture.yaml``."""

    folder: Path
    spec: CaptureSpec
    sensor: SensorSpec | None

    @property
    def interval_s(self) -> float | None:
        """From one fixed comparison of event pixels to the next, s; None where neither file states it."""
        tick_us = self.spec.tick_us
        if tick_us is None and self.sensor is not None and self.sensor.evs is not None:
            tick_us = self.sensor.evs.tick_us
        return None if tick_us is None else tick_us * S_PER_US

    @property
    def frame_rate_hz(self) -> float | None:
        """Frames per second within an exposure; None where neither file states it."""
        if self.spec.frame_rate_hz is None and self.sensor is not None and self.sensor.aps is not None:
            return self.sensor.aps.frame_rate_hz
        return self.spec.frame_rate_hz

    def frames(self, name: Literal["aps_dark", "aps_lit"]) -> "FrameStack":
        """The stack of frames in ``<name>.npz``, not yet read.

        Raises
        ------
        SpecError
            If the file is missing, is not a stack of whole-number frames, or does not fit the tile.
        """
        return FrameStack(self._file(name), self.spec)

    def arrays(self, name: str, required: tuple[str, ...]) -> dict[str, NDArray]:
        """All arrays of a small ``.npz`` file.

        Raises
        ------
        SpecError
            If the file or one of the `required` arrays is missing, or cannot be read.
        """
        return read_arrays(self._file(name), required)

    def has(self, name: str) -> bool:
        return (self.folder / f"{name}.npz").is_file()

    def _file(self, name: str) -> Path:
        file = self.folder / f"{name}.npz"
        if not file.is_file():
            what = {
                "aps_dark": "frames with the lens covered, at several exposures",
                "aps_lit": "frames of a static scene of many brightnesses, at several exposures",
                "evs_static": "counts of events of a static scene of many brightnesses and in the dark",
            }.get(name, "this capture")
            raise SpecError(f"no such file; capture {what}", file=file)
        return file


def read_captures(folder: str | Path) -> CaptureSet:
    """Open the capture set in `folder`.

    Raises
    ------
    SpecError
        If the folder or ``capture.yaml`` is missing or wrong, or the named sensor has another tile.
    """
    path = Path(folder)
    if not path.is_dir():
        raise SpecError("no such folder of captures", file=path)
    file = path / "capture.yaml"
    if not file.is_file():
        raise SpecError("no such file; it states bit_depth, tile_rows and tile_cols", file=file)
    spec = read_spec(CaptureSpec, file)
    sensor = None
    if spec.sensor is not None:
        is_name = Path(spec.sensor).name == spec.sensor.removesuffix(".yaml") and not (path / spec.sensor).exists()
        sensor = read_sensor(spec.sensor if is_name else inside(path, spec.sensor, file=file, key="sensor"))
        tile = len(sensor.tile_rows), len(sensor.tile_rows[0])
        if tile != (spec.tile_rows, spec.tile_cols):
            raise SpecError(
                f"the tile is {spec.tile_rows}×{spec.tile_cols}, but that of sensor {sensor.name} is "
                f"{tile[0]}×{tile[1]}",
                file=file,
                key="tile_rows",
            )
    return CaptureSet(path, spec, sensor)


class FrameStack:
    """``frames[exposure, frame, row, col]`` of a ``.npz`` file, read one frame at a time.

    Attributes
    ----------
    exposures_us : int64 [exposure], as in the file.
    shape : (exposures, frames, rows, cols).
    """

    def __init__(self, file: Path, spec: CaptureSpec) -> None:
        self.file, self._full = file, spec.full_scale_dn
        exposures = read_arrays(file, ("frames", "exposures_us"), only=("exposures_us",))["exposures_us"]
        self.shape, self._dtype = self._header()
        self.exposures_us = self._check(exposures, spec)

    def _header(self) -> tuple[tuple[int, int, int, int], np.dtype]:
        shape, dtype = member_header(self.file, "frames")
        if dtype.kind not in "ui":
            raise SpecError(
                f"frames holds {dtype.name}, not whole DN; save the RAW values as uint16, not scaled, averaged or "
                "dark-subtracted ones",
                file=self.file,
            )
        if len(shape) != 4 or 0 in shape:
            raise SpecError(f"frames has shape {shape}; expected [exposure, frame, row, col]", file=self.file)
        count, frames, rows, cols = shape
        return (count, frames, rows, cols), dtype

    def _check(self, exposures: NDArray, spec: CaptureSpec) -> NDArray[np.int64]:
        count, frames, rows, cols = self.shape
        if exposures.shape != (count,):
            raise SpecError(f"{exposures.size} exposures_us for {count} exposures in frames", file=self.file)
        if exposures.dtype.kind not in "uif" or not np.all((np.rint(exposures) > 0) & (exposures < 2**53)):
            raise SpecError("exposures_us must be numbers above 0, in microseconds", file=self.file)
        exposures = np.rint(exposures).astype(np.int64)
        if np.unique(exposures).size != count:
            raise SpecError("exposures_us holds one exposure twice; put its frames together", file=self.file)
        if count < 2:
            raise SpecError(
                "holds one exposure only, which cannot tell dark current from the fixed offset nor light from time; "
                "capture at least 2 exposures, better 5 over a factor of 20",
                file=self.file,
            )
        if frames < 8:
            raise SpecError(
                f"holds {frames} frames per exposure; a variance needs 8 at least, better 64", file=self.file
            )
        if rows % spec.tile_rows or cols % spec.tile_cols:
            raise SpecError(
                f"frames of {rows}×{cols} pixels are not whole tiles of {spec.tile_rows}×{spec.tile_cols}",
                file=self.file,
            )
        if spec.roi is not None and (rows, cols) != (spec.roi.height_px, spec.roi.width_px):
            raise SpecError(
                f"frames of {rows}×{cols} pixels are not the roi of capture.yaml, "
                f"{spec.roi.height_px}×{spec.roi.width_px}",
                file=self.file,
            )
        return exposures

    def __iter__(self) -> Iterator[NDArray]:
        """Frames [row, col] of all exposures in order; each is valid until the next one is requested."""
        shape = self.shape[2:]
        for frame in stream_member(self.file, "frames", int(np.prod(self.shape[:2])), shape):
            if int(frame.max()) > self._full or (self._dtype.kind == "i" and int(frame.min()) < 0):
                raise SpecError(
                    f"holds values outside 0 to {self._full}, the range of bit_depth in capture.yaml", file=self.file
                )
            yield frame


def single_number(value: NDArray, name: str, file: Path, *, whole: bool = False, least: float = 0.0) -> float:
    """The single number that an array holds.

    Raises
    ------
    SpecError
        If it holds text, several values, or a number that is not finite, too small or too large.
    """
    kind = "whole number" if whole else "number"
    wrong = SpecError(f"{name} must be one {kind} of {least:g} or more, up to {_MOST:g}", file=file)
    if value.size != 1 or value.dtype.kind not in "uif":
        raise wrong
    result = float(value.item())
    if not least <= result <= _MOST or (whole and result != int(result)):
        raise wrong
    return result


def count_maps(captures: CaptureSet, name: str, member: str) -> Iterator[NDArray]:
    """Maps [row, col] of a member [k, row, col] of a ``.npz`` file, one at a time."""
    file = captures.folder / f"{name}.npz"
    shape, _ = member_header(file, member)
    if len(shape) != 3:
        raise SpecError(f"{member} has shape {shape}; expected [contrast, row, col]", file=file)
    yield from stream_member(file, member, shape[0], shape[1:])
