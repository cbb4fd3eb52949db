"""Clips in the folder layouts that networks for frame interpolation, deblurring and RAW load.

Pictures are 8-bit sRGB of the same size as the RAW frame. Coordinates of events are those of the picture: an event
pixel has the place that it has on the mosaic, so a sparse event grid gives sparse coordinates.

The cumulative representation of events of EFNet.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hesim_render.benchmark.folder import Benchmark, BenchmarkClip
from hesim_render.benchmark.pictures import ClipDevelopment
from hesim_render.core.errors import OutputError, RangeError, did_you_mean
from hesim_render.core.output import OutputFolder, output_errors
from hesim_render.core.progress import Progress
from hesim_render.recording.exports import write_tick_files
from hesim_render.recording.frame import Frame
from hesim_render.spectral.transfer import encode_exactly

_MARKER = "layout.txt"
#: Fixed-point scale of coordinates in BS-ERGB.
_BS_SCALE = 32
_PERCENTILE, _WHITE = 99.5, 0.95


class _Clip:
    """A clip with its pictures, all exposed alike, and its events in coordinates of the picture."""

    def __init__(self, clip: BenchmarkClip) -> None:
        self.clip, self.development = clip, ClipDevelopment(clip)
        self.name = clip.name
        self._gain: float | None = None

    def picture(self, raw: NDArray) -> NDArray[np.uint8]:
        """uint8 [row, col, 3]; the first picture sets the exposure of all."""
        linear = self.development.linear(raw)
        if self._gain is None:
            bright = float(np.percentile(linear, _PERCENTILE))
            self._gain = _WHITE / bright if bright > 0 else 1.0
        return np.rint(255 * encode_exactly(np.clip(linear * self._gain, 0, 1))).astype(np.uint8)

    def events(self, begin_us: float, end_us: float) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """x, y (px of the picture), t (µs) and polarity (0, 1) of the events after `begin_us`, up to `end_us`."""
        first, last = int(np.floor(begin_us)) + 1, int(np.floor(end_us)) + 1
        result = self.clip.recording.event_slice(first, max(first, last))
        layout = self.development.layout
        place = layout.evs_pixel.reshape(layout.evs_shape)[result["y"], result["x"]].astype(np.int64)
        return place % layout.cols, place // layout.cols, result["t_us"], (result["polarity"] > 0).astype(np.uint8)

    @property
    def shape(self) -> tuple[int, int]:
        return self.development.layout.shape

    def sequence(self) -> list[tuple[float, Callable[[], NDArray]]]:
        """Times and RAW of the frames of an interpolation set: the sharp images, or else the frames themselves."""
        sharp = self.clip.sharp
        if sharp is not None:
            return [(float(t), lambda k=k: sharp.raw_dn(k)) for k, t in enumerate(sharp.time_us)]  # type: ignore[misc]
        frames = self.clip.recording.frames
        return [(f.exposure_start_us + f.exposure_us / 2, lambda f=f: f.raw) for f in frames]  # type: ignore[misc]

    def pairs(self) -> list[tuple[Frame, int]]:
        """Frames with the number of the sharp image in the middle of their exposure."""
        sharp, result = self.clip.sharp, []
        for frame in self.clip.recording.frames if sharp is not None and len(sharp.time_us) else ():
            middle = frame.exposure_start_us + frame.exposure_us / 2
            assert sharp is not None
            number = sharp.nearest(middle)
            if abs(sharp.time_us[number] - middle) <= frame.exposure_us / 4:
                result.append((frame, number))
        return result


def _save(picture: NDArray[np.uint8], path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).save(path, format="PNG")


def _savez(path: Path, **arrays: NDArray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, **arrays)  # type: ignore[arg-type]


def _hs_ergb(clip: _Clip, split: str, root: Path) -> int:
    """HS-ERGB, as the code of Time Lens loads it: file n of the events is between the images n − 1 and n."""
    folder = root / split / clip.name
    sequence, times = clip.sequence(), list[float]()
    for number, (t, raw) in enumerate(sequence):
        _save(clip.picture(raw()), folder / "images_corrected" / f"{number:06d}.png")
        x, y, when, p = clip.events(times[-1] if times else -1.0, t)
        _savez(
            folder / "events_aligned" / f"{number:06d}.npz", x=x.astype(np.uint16), y=y.astype(np.uint16), t=when, p=p
        )
        times.append(t)
    if sequence:
        (folder / "timestamp.txt").write_text("".join(f"{t:.6f}\n" for t in times), encoding="utf-8")
    return len(sequence)


_BS_FOLDERS = {"test": "1_TEST", "val": "2_VALIDATION", "train": "3_TRAINING"}


def _bs_ergb(clip: _Clip, split: str, root: Path) -> int:
    """BS-ERGB, which TimeLens-XL and CBMNet load: file n of the events is between images n and n + 1; x, y times 32."""
    folder = root / _BS_FOLDERS[split] / clip.name
    sequence = clip.sequence()
    for number, (t, raw) in enumerate(sequence):
        _save(clip.picture(raw()), folder / "images" / f"{number:06d}.png")
        if number + 1 < len(sequence):
            x, y, when, p = clip.events(t, sequence[number + 1][0])
            _savez(
                folder / "events" / f"{number:06d}.npz", x=x * _BS_SCALE, y=y * _BS_SCALE, timestamp=when, polarity=p
            )
    return len(sequence)


def _highrev(clip: _Clip, split: str, root: Path) -> int:
    """HighREV: blurred and sharp pictures, and the events of each exposure, whose x is the row and y the column."""
    folder = root / ("train" if split == "train" else "val")
    pairs = clip.pairs()
    for number, (frame, sharp) in enumerate(pairs):
        assert clip.clip.sharp is not None
        name = f"{clip.name}_{number:05d}"
        _save(clip.picture(clip.clip.sharp.raw_dn(sharp)), folder / "sharp" / f"{name}.png")
        _save(clip.picture(frame.raw), folder / "blur" / f"{name}.png")
        x, y, when, p = clip.events(frame.exposure_start_us, frame.exposure_start_us + frame.exposure_us)
        _savez(folder / "event" / f"{name}_00.npz", x=y, y=x, timestamp=when, polarity=p)
    return len(pairs)


def _efnet(clip: _Clip, split: str, root: Path) -> int:
    """GoPro and REBlur as EFNet loads them: one HDF5 file for a clip, with its voxels and its events."""
    pairs = clip.pairs()
    if not pairs:
        return 0
    path = root / ("train" if split == "train" else "test") / f"{clip.name}.h5"
    path.parent.mkdir(parents=True, exist_ok=True)
    sharp = clip.clip.sharp
    assert sharp is not None
    with h5py.File(path, "w") as file:
        x, y, when, p = clip.events(-1.0, clip.clip.recording.duration_us)
        for name, values in (("xs", x), ("ys", y), ("ts", when / 1e6), ("ps", p.astype(bool))):
            kind = {"xs": "u2", "ys": "u2", "ts": "f8", "ps": "?"}[name]
            file.create_dataset(f"events/{name}", data=np.asarray(values).astype(kind))
        for number, (frame, nearest) in enumerate(pairs):
            end = frame.exposure_start_us + frame.exposure_us
            attributes = {"timestamp": end / 1e6, "event_idx": int(np.searchsorted(when, end, "right"))}
            images: dict[str, Any] = {
                "sharp_images/image": clip.picture(sharp.raw_dn(nearest)),
                "images/image": clip.picture(frame.raw),
                "voxels/voxel": _voxels(clip, frame),
                "masks/mask": np.zeros(clip.shape, np.uint8),
            }
            for name, values in images.items():
                entry = file.create_dataset(f"{name}{number:09d}", data=values)
                entry.attrs.update({**attributes, "size": values.shape})
        file.attrs.update({
            "sensor_resolution": clip.shape, "num_events": len(when), "num_imgs": len(pairs), "source": "hesim_render",
        })  # fmt: skip
    return len(pairs)


def _voxels(clip: _Clip, frame: Frame) -> NDArray[np.float32]:
    """Six cumulative bins of an exposure, on the grid of the picture."""
    begin, end = frame.exposure_start_us, frame.exposure_start_us + frame.exposure_us
    x, y, when, p = clip.events(begin, end)
    placed = np.zeros(len(when), [("t_us", "i8"), ("x", "i8"), ("y", "i8"), ("polarity", "i1")])
    placed["t_us"], placed["x"], placed["y"], placed["polarity"] = when, x, y, 2 * p.astype(np.int8) - 1
    return cumulative_grid(placed, clip.shape, begin, end)


def _raw_npz(clip: _Clip, split: str, root: Path) -> int:
    """H-ESIM and RGB-Event-ISP, whose files `write_tick_files` writes."""
    spec = clip.development.sensor.evs
    tick_us = None if spec is None else spec.tick_us
    return write_tick_files(clip.clip.recording, root / split / clip.name, tick_us)


#: Layouts by name: a writer of one clip, which returns the number of pictures.
LAYOUTS: dict[str, Callable[[_Clip, str, Path], int]] = {
    "hs-ergb": _hs_ergb,
    "bs-ergb": _bs_ergb,
    "highrev": _highrev,
    "efnet": _efnet,
    "raw-npz": _raw_npz,
}


def export_benchmark(
    root: str | Path, layout: str, out: str | Path, *, overwrite: bool = False, progress: Progress | None = None
) -> int:
    """Write all clips with frames in the layout of another program's loader; returns the number of pictures.

    Parameters
    ----------
    root : folder of the benchmark.
    layout : name, one of `LAYOUTS`.
    out : folder to write; it appears whole or not at all.
    overwrite : replace an earlier export.
    progress : called with (done, total, what).

    Raises
    ------
    RangeError
        If the layout is unknown.
    SpecError
        If the folder is no finished benchmark.
    OutputError
        If `out` cannot be written, or no clip has what the layout holds.
    """
    if layout not in LAYOUTS:
        raise RangeError("layout", layout, f"one of {', '.join(LAYOUTS)}{did_you_mean(layout, LAYOUTS)}")
    clips = list(Benchmark(root).clips())
    count = 0
    with OutputFolder(out, _MARKER, overwrite) as output, output_errors(output.target):
        for done, clip in enumerate(clips):
            if len(clip.recording.frames):
                count += LAYOUTS[layout](_Clip(clip), clip.split, output.path)
            if progress is not None:
                progress(done + 1, len(clips), "clips")
        if count == 0:
            raise OutputError(f"{out}: no clip has what the layout {layout} holds (frames, and sharp images beside)")
        (output.path / _MARKER).write_text(f"{layout}\n", encoding="utf-8")
    return count


def cumulative_grid(
    events: NDArray, shape: tuple[int, int], begin_us: float, end_us: float, bins: int = 6
) -> NDArray[np.float32]:
    """Symmetric cumulative event representation [sun2022]: sums of polarities from the middle of the exposure outwards.

    Parameters
    ----------
    events : structured array of `EVENT_DTYPE`.
    shape : rows and columns of the event grid.
    begin_us, end_us : the exposure, µs.
    bins : even number of bins. The first half holds minus the sums from each of the times begin, begin + h, … to the
        middle, the second half the sums from the middle to middle + h, …, end, with h the exposure over `bins`.

    Returns
    -------
    float32 [bin, y, x].

    Raises
    ------
    RangeError
        If the number of bins is odd.
    """
    if bins < 2 or bins % 2:
        raise RangeError("bins", bins, "an even number, 2 or more")
    rows, cols = shape
    edges = np.linspace(begin_us, end_us, bins + 1)
    part = np.searchsorted(edges, events["t_us"], side="left") - 1  # (edge, next edge]: a time stamp is an end
    inside = (part >= 0) & (part < bins)
    place = part[inside] * rows * cols + events["y"][inside].astype(np.int64) * cols + events["x"][inside]
    each = np.bincount(place, events["polarity"][inside], bins * rows * cols).reshape(bins, rows, cols)
    half = bins // 2
    before = -np.cumsum(each[:half][::-1], axis=0)[::-1]
    return np.concatenate([before, np.cumsum(each[half:], axis=0)]).astype(np.float32)
