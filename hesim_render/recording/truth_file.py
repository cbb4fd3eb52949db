"""Geometric truth of a recording in one HDF5 file, written frame by frame.

docs/ground-truth.md lists the data sets with their units. Images are chunked by frame and packed with Blosc LZ4.

Kinds of ground truth that a run can be asked for.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import RangeError, SpecError, did_you_mean
from hesim_render.core.guard import reading
from hesim_render.core.hdf5 import COMPRESSION, new_file, read_dataset

if TYPE_CHECKING:
    from hesim_render.sources.render.truth.scene_truth import SceneTruth

#: Kinds with one image for each frame or time; all are those of the chief ray through each pixel's centre.
IMAGES = ("depth", "normals", "position", "ids", "flow", "mixed")
#: Kinds that are not images.
SERIES = ("poses", "boxes", "imu", "light")
#: Label of each event, events that were lost, and the events without noise.
EVENTS = "events"
TRUTH_KINDS = (*IMAGES, *SERIES, EVENTS)


def truth_kinds(names: str | Iterable[str]) -> tuple[str, ...]:
    """The kinds that names ask for, in the order of `TRUTH_KINDS`; ``all`` asks for all.

    One text holds names with commas between them, as on the command line.

    Raises
    ------
    RangeError
        For a name that is not a kind.
    """
    wanted: set[str] = set()
    for name in names.replace(" ", "").split(",") if isinstance(names, str) else names:
        if name == "all":
            wanted.update(TRUTH_KINDS)
        elif name in TRUTH_KINDS:
            wanted.add(name)
        else:
            known = (*TRUTH_KINDS, "all")
            raise RangeError("truth", name, f"one of {', '.join(known)}{did_you_mean(name, known)}")
    return tuple(kind for kind in TRUTH_KINDS if kind in wanted)


#: Place of the file in a recording.
TRUTH_FILE = "truth/geometry.h5"
_LAYOUT = 1
#: Interval between poses, and between times of event pixels where there are no frames, µs.
POSE_STEP_US, TIME_STEP_US = 1_000, 10_000
#: Letters of the kinds of data sets: numbers, truth values and names.
_NUMBERS = "fuibS"


@dataclass(frozen=True)
class TruthRequest:
    """What is written.

    Parameters
    ----------
    kinds : from `truth_kinds`.
    end_us : end of the run, µs.
    frame_times_us : times of the rows of each frame, [frame, row], µs.
    every_us : interval between the times at which event pixels are described, µs; None: at the middle of each frame, or
        every 10 ms where there are none.
    seed : seed of the noise of inertial measurements.
    """

    kinds: tuple[str, ...]
    end_us: int
    frame_times_us: NDArray[np.float64]
    every_us: int | None
    seed: int

    @classmethod
    def of(cls, manifest: Mapping[str, Any]) -> "TruthRequest":
        """What a run was asked for, by its manifest."""
        wanted = manifest["settings"].get("truth") or {"kinds": ()}
        rows = np.arange(manifest["roi"]["height_px"], dtype=np.float64)
        times = [
            frame["exposure_start_us"] + frame["exposure_us"] / 2 + rows * frame["line_time_us"]
            for frame in manifest["frames"]
        ]
        return cls(
            truth_kinds(wanted["kinds"]), manifest["time"]["end_us"], np.array(times).reshape(len(times), rows.size),
            wanted.get("every_us"), manifest["seed"],
        )  # fmt: skip

    @property
    def geometry(self) -> tuple[str, ...]:
        """The kinds that the file holds; labels of events are elsewhere."""
        return tuple(kind for kind in self.kinds if kind != EVENTS)

    @property
    def event_times_us(self) -> NDArray[np.float64]:
        """Times at which event pixels are described, µs."""
        if self.every_us is None and len(self.frame_times_us):
            return self.frame_times_us.mean(axis=1)
        return np.arange(0, self.end_us + 1, self.every_us or TIME_STEP_US, dtype=np.float64)


def write_truth(
    path: Path, truth: "SceneTruth", request: TruthRequest, progress: Callable[[int, int], None] | None = None
) -> None:
    """Write the file.

    Parameters
    ----------
    path : the file.
    truth : the scene.
    request : what is written.
    progress : called with numbers of images done and of all.
    """
    with new_file(path) as file:
        file.attrs.update({"layout": _LAYOUT, "kinds": ",".join(request.geometry), "times": "µs", "lengths": "m"})
        _write_constants(file, truth)
        has_events = 0 not in truth.sensor.layout.evs_shape
        groups = [("frames", "mosaic", list(request.frame_times_us))] if len(request.frame_times_us) else []
        if has_events:
            groups.append(("events", "events", list(request.event_times_us)))
        total, done = sum(len(times) for _, _, times in groups), 0
        for name, grid, times in groups:
            rows = np.array([np.broadcast_to(t, truth.sensor.rows) for t in times])
            file[f"{name}/row_time_us" if name == "frames" else f"{name}/time_us"] = (
                rows if name == "frames" else rows[:, 0]
            )
            for number in range(len(times)):
                _write_images(file[name], truth, grid, request.kinds, rows, number)
                done += 1
                if progress is not None:
                    progress(done, total)
        _write_series(file, truth, request)


def _write_constants(file: Any, truth: "SceneTruth") -> None:
    names = truth.names
    for kind in ("objects", "instances", "materials"):
        file[f"names/{kind}"] = np.array([name.encode() for name in getattr(names, kind)])
    file["names/object_of_instance"] = names.object_of
    for grid in ("mosaic", "events"):
        if grid == "events" and 0 in truth.sensor.layout.evs_shape:
            continue
        camera = truth.camera(grid)  # type: ignore[arg-type]
        file[f"camera/{grid}"] = camera.k
        file[f"camera/{grid}"].attrs.update({key: value for key, value in camera.as_dict().items() if key != "k"})


def _write_images(
    group: Any, truth: "SceneTruth", grid: Any, kinds: Sequence[str], rows: NDArray[np.float64], number: int
) -> None:
    """All images of one time, as entry `number` of their data sets.

    Each is flushed at once: HDF5 gives a chunk its place in the file when the last reference to its data set goes, and
    whoever looks into running programs (a debugger, dask's profiler) may hold references for longer.
    """
    count, now = len(rows), rows[number]
    for name, image in images_at(truth, grid, kinds, rows, number):
        if name not in group:
            fill = np.nan if image.dtype.kind == "f" else 0
            group.create_dataset(
                name, shape=(count, *image.shape), chunks=(1, *image.shape), dtype=image.dtype, compression=COMPRESSION,
                fillvalue=fill,
            )  # fmt: skip
        stored = group[name]
        stored[number] = image
        stored.flush()
    if "boxes" in kinds:
        boxes = truth.boxes(now, grid)
        for name in ("visible_px", "whole_px", "corners_m"):
            values = getattr(boxes, name)
            if f"boxes_{name}" not in group:
                group.create_dataset(f"boxes_{name}", shape=(count, *values.shape), dtype="f8")
            group[f"boxes_{name}"][number] = values


def images_at(
    truth: "SceneTruth", grid: Any, kinds: Sequence[str], rows: NDArray[np.float64], number: int
) -> list[tuple[str, NDArray]]:
    """Names and values of the images of one time; rows without a next or a previous time have no flow there.

    Parameters
    ----------
    truth, grid, kinds : scene, ``mosaic`` or ``events``, and wanted kinds.
    rows : times of rows at all times, [time, row], µs.
    number : which of them.
    """
    now = rows[number]
    arrays: list[tuple[str, NDArray]] = []
    if "depth" in kinds:
        arrays += [("depth_m", truth.depth(now, grid)), ("distance_m", truth.distance(now, grid))]
    if "normals" in kinds:
        arrays.append(("normal", truth.normals(now, grid)))
    if "position" in kinds:
        arrays.append(("position_m", truth.position(now, grid)))
    if "ids" in kinds:
        ids = truth.ids(now, grid)
        arrays += [("object", ids.object), ("instance", ids.instance), ("material", ids.material)]
    if "mixed" in kinds:
        arrays.append(("mixed", truth.mixed(now, grid)))
    if "flow" in kinds:
        for name, other in (("forward", number + 1), ("backward", number - 1)):
            if not 0 <= other < len(rows):
                shape = truth.raster(grid).shape
                arrays.append((f"flow_{name}_px", np.full((*shape, 2), np.nan, np.float32)))
                arrays.append((f"visible_{name}", np.zeros(shape, np.bool_)))
                continue
            flow = truth.flow(now, rows[other], grid)
            arrays += [(f"flow_{name}_px", flow.flow_px), (f"visible_{name}", flow.visible)]
    return arrays


def _write_series(file: Any, truth: "SceneTruth", request: TruthRequest) -> None:
    if "poses" in request.kinds or "light" in request.kinds:
        times = np.arange(0, request.end_us + 1, POSE_STEP_US, dtype=np.float64)
    if "poses" in request.kinds:
        file["poses/time_us"] = times
        file["poses/camera"] = truth.camera_pose(times)
        poses = truth.object_poses(times)
        file["poses/objects"] = np.stack(list(poses.values()), axis=1) if poses else np.empty((times.size, 0, 4, 4))
    if "light" in request.kinds:
        levels = truth.light_levels(times)
        file["light/time_us"] = times
        file["light/level"] = np.array([light.level for light in levels]).reshape(len(levels), times.size).T
        file["light/names"] = np.array([light.name.encode() for light in levels], dtype="S")
        file["light/units"] = np.array([light.unit.encode() for light in levels], dtype="S")
        file["light/mean"] = np.array([light.mean for light in levels])
    if "imu" in request.kinds:
        from hesim_render.sources.render.truth.imu import ImuModel

        model = ImuModel()
        for name, values in vars(truth.imu(0, request.end_us, model, request.seed)).items():
            file[f"imu/{'time_us' if name == 't_us' else name}"] = values
        file["imu"].attrs.update({name: np.asarray(value) for name, value in vars(model).items()})


class StoredTruth:
    """Geometric truth as it was written into a recording; each call reads what it returns.

    Raises
    ------
    SpecError
        If the file is missing or damaged, or was written in another layout.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        if not path.is_file():
            raise SpecError("no such file", file=path)
        with reading(path, "as truth"), h5py.File(path, "r") as file:
            if file.attrs.get("layout") != _LAYOUT:
                raise SpecError(f"layout is {file.attrs.get('layout')!r}; this version reads {_LAYOUT}", file=path)
            #: Kinds that were asked for.
            self.kinds = tuple(str(file.attrs.get("kinds", "")).split(","))
            #: Names of all data sets.
            self.names: tuple[str, ...] = tuple(_names(file))

    def __repr__(self) -> str:
        return f"<StoredTruth of {', '.join(self.kinds)}: {len(self.names)} data sets in {self._path}>"

    def read(self, name: str, number: int | None = None) -> NDArray:
        """A data set, or one entry of it.

        Parameters
        ----------
        name : as in `names` (``frames/depth_m``).
        number : number of the frame or time; None reads all.

        Returns
        -------
        The values; names as str.

        Raises
        ------
        RangeError
            If there is no such data set or entry.
        SpecError
            If the file is damaged.
        """
        if name not in self.names:
            raise RangeError("name", name, f"one of {', '.join(self.names)}{did_you_mean(name, self.names)}")
        values = read_dataset(self._path, "as truth", name, number, _NUMBERS)
        return np.char.decode(values, "utf-8") if values.dtype.kind == "S" else values


def _names(file: Any) -> list[str]:
    names: list[str] = []
    file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
    return names
