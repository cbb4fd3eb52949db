"""A benchmark as a data set in the form of tonic's: events of a clip with a target, and tonic's transforms.

Neither tonic nor PyTorch is needed for it; a `DataLoader` of PyTorch takes it as well.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hesim_render.benchmark.folder import Benchmark, BenchmarkClip
from hesim_render.core.errors import RangeError, SpecError, did_you_mean
from hesim_render.recording.box_export import PROPHESEE_BOX, box_records, classes

Target = Literal["cause", "object", "boxes", "frames", "sharp"]
TARGETS = ("cause", "object", "boxes", "frames", "sharp")
#: Kind of truth that a target needs.
_KINDS = {"cause": "events", "boxes": "ids"}


class EventDataset:
    """Clips of a benchmark as events with a target, one item a clip.

    An item is a pair. Its events are a structured array with ``x``, ``y`` (px of the event grid), ``t`` (µs) and ``p``
    (True is ON), as tonic's transforms take them; `sensor_size` is (width, height, 2). Its target is the ``cause``
    (uint8, numbers of `Label`) or the ``object`` (uint16) of each event, the ``boxes`` of the clip's objects on the
    event grid (records of Prophesee and RVT, `PROPHESEE_BOX`) at the times of ``truth: [ids]``, or the ``frames`` of
    the clip (RAW in DN, with the end of each exposure) or its ``sharp`` images (RAW in DN, with their times), as a
    dictionary of ``images`` [n, row, col] and ``t_us`` [n].

    Parameters
    ----------
    root : folder of the benchmark.
    split : ``train``, ``val``, ``test``, or None for all.
    target : ``cause``, ``object``, ``boxes``, ``frames`` or ``sharp``.
    transform : called with the events.
    target_transform : called with the target.
    transforms : called with both, in place of these two.

    Raises
    ------
    RangeError
        If the target is unknown, or `transforms` is given beside another one.
    SpecError
        If the folder is no finished benchmark, no clip of the split has events and such a target, or its clips have
        event grids of different sizes.

    Examples
    --------
    >>> from hesim_render.benchmark.tonic_dataset import EventDataset
    >>> EventDataset.dtype.names
    ('x', 'y', 't', 'p')
    """

    #: Events of an item.
    dtype = np.dtype([("x", np.int16), ("y", np.int16), ("t", np.int64), ("p", np.bool_)])
    ordering = dtype.names

    def __init__(
        self,
        root: str | Path,
        split: str | None = "train",
        target: Target = "cause",
        *,
        transform: Callable[[NDArray], Any] | None = None,
        target_transform: Callable[[Any], Any] | None = None,
        transforms: Callable[[NDArray, Any], tuple[Any, Any]] | None = None,
    ) -> None:
        if target not in TARGETS:
            raise RangeError("target", target, f"one of {', '.join(TARGETS)}{did_you_mean(str(target), TARGETS)}")
        if transforms is not None and (transform is not None or target_transform is not None):
            raise RangeError("transforms", "given", "nothing beside transform or target_transform")
        self._target = target
        self.transform, self.target_transform, self.transforms = transform, target_transform, transforms
        self._folders: list[Path] = []
        #: Names of the classes of ``boxes``, of all clips, by ``class_id``.
        self.classes: list[str] = []
        shapes = set()
        for clip in Benchmark(root).clips(split):
            counts, shape = clip.content["counts"], clip.recording.event_shape
            has = {"frames": counts["frames"], "sharp": counts["sharp"]}.get(target, True)
            if target in _KINDS:
                has = _KINDS[target] in (clip.recording.manifest["settings"].get("truth") or {"kinds": ()})["kinds"]
            if has and 0 not in shape:
                if target == "boxes":
                    self.classes += [name for name in _classes(clip)[0] if name not in self.classes]
                self._folders.append(clip.folder)
                shapes.add(shape)
        if not self._folders:
            raise SpecError(f"no clip of the split {split} has events and the target {target}", file=root)
        if len(shapes) > 1:
            sizes = ", ".join(f"{cols}x{rows}" for rows, cols in sorted(shapes))
            raise SpecError(f"clips have event grids of different sizes ({sizes} px)", file=root)
        rows, cols = shapes.pop()
        #: Width and height of the event grid, and number of polarities.
        self.sensor_size = (cols, rows, 2)

    def __len__(self) -> int:
        return len(self._folders)

    def __getitem__(self, item: int) -> tuple[Any, Any]:
        # opened anew for each item: an open HDF5 file must not be shared by the processes of a loader
        clip = BenchmarkClip(self._folders[item])
        stored = clip.recording.events
        events = np.empty(stored.size, self.dtype)
        events["x"], events["y"], events["t"], events["p"] = (
            stored["x"],
            stored["y"],
            stored["t_us"],
            stored["polarity"] > 0,
        )
        target = self._target_of(clip)
        if self.transforms is not None:
            return self.transforms(events, target)
        made = events if self.transform is None else self.transform(events)
        return made, target if self.target_transform is None else self.target_transform(target)

    def _target_of(self, clip: BenchmarkClip) -> Any:
        recording = clip.recording
        if self._target == "cause":
            labels = recording.event_labels
            assert labels is not None
            return labels.label
        if self._target == "object":
            return recording.event_objects
        if self._target == "boxes":
            return self._boxes_of(clip)
        if self._target == "frames":
            images, times = [frame.raw for frame in recording.frames], [frame.t_us for frame in recording.frames]
        else:
            sharp = clip.sharp
            assert sharp is not None
            images, times = [sharp.raw_dn(k) for k in range(len(sharp.time_us))], list(sharp.time_us)
        return {"images": np.stack(images), "t_us": np.array(times)}

    def _boxes_of(self, clip: BenchmarkClip) -> NDArray[np.void]:
        """Boxes of the clip, with the classes of all clips."""
        names, own = _classes(clip)
        of_all = np.array([*(self.classes.index(name) for name in names), -1], np.int64)
        stored = clip.recording.stored_truth
        assert stored is not None
        images = ((t, stored.read("events/object", k)) for k, t in enumerate(stored.read("events/time_us")))
        return box_records(images, of_all[own], PROPHESEE_BOX)


def _classes(clip: BenchmarkClip) -> tuple[list[str], NDArray[np.int64]]:
    """As `classes`, of a clip with stored truth."""
    stored = clip.recording.stored_truth
    assert stored is not None
    return classes(stored.read("names/objects").tolist(), clip.recording.manifest["scene"]["spec"].get("labels", {}))
