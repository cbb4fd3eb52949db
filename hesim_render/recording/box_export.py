"""Boxes and masks of objects in the layouts of detectors: Prophesee's ``bbox.npy``, DSEC-det, and COCO.

A box covers whole pixels: x and y are the first column and row that show the object, w and h their number. It is around
what is visible in the image of object numbers (`SceneTruth.ids`). The track of an object is its number; its class is
what ``labels`` of the scene file says, else its name without the number at its end (``car-2`` and ``car 13`` are of
class ``car``). An object whose label is null has no boxes.
"""

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from hesim_render.core.errors import SpecError
from hesim_render.recording.colour_view import colour_picture
from hesim_render.recording.recorded import Recorded
from hesim_render.sources.render.truth.scene_truth import SceneTruth

#: Interval of boxes on the event grid, µs: that of DSEC-det.
BOXES_EVERY_US = 50_000
#: Records of Prophesee's toolbox and of RVT.
PROPHESEE_BOX = np.dtype({
    "names": ["t", "x", "y", "w", "h", "class_id", "track_id", "class_confidence"],
    "formats": ["<i8", "<f4", "<f4", "<f4", "<f4", "<u4", "<u4", "<f4"],
    "offsets": [0, 8, 12, 16, 20, 24, 28, 32],
    "itemsize": 40,
})  # fmt: skip
#: Records of DSEC-det.
DSEC_BOX = np.dtype([
    ("t", "<u8"), ("x", "<f8"), ("y", "<f8"), ("h", "<f8"), ("w", "<f8"), ("class_id", "u1"),
    ("class_confidence", "<f8"), ("track_id", "<u8"),
])  # fmt: skip
#: A class is one byte there.
_MOST_DSEC_CLASSES = 256


def pixel_boxes(objects: NDArray[np.integer]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Boxes around the pixels of each object.

    Parameters
    ----------
    objects : [row, col], number of the object that each pixel shows; 0 is the background, which has no box.

    Returns
    -------
    Numbers of the visible objects [box], and their boxes [box, 4]: x, y, w, h, whole px.
    """
    slices = ndimage.find_objects(np.asarray(objects, np.int32))
    numbers = [number for number, part in enumerate(slices, start=1) if part is not None]
    boxes = [
        (cols.start, rows.start, cols.stop - cols.start, rows.stop - rows.start)
        for rows, cols in (slices[number - 1] for number in numbers)
    ]
    return np.array(numbers, np.int64), np.array(boxes, np.int64).reshape(-1, 4)


def run_lengths(mask: ArrayLike) -> dict[str, Any]:
    """A mask [row, col] as run-length code of COCO, not compressed: column by column, beginning with pixels outside."""
    values = np.asarray(mask, np.bool_)
    edges = np.flatnonzero(np.diff(values.T.ravel(), prepend=False))
    counts = np.diff(np.concatenate([[0], edges, [values.size]]))
    return {"size": list(values.shape), "counts": counts.tolist()}


def classes(names: Sequence[str], labels: Mapping[str, str | None]) -> tuple[list[str], NDArray[np.int64]]:
    """Names of classes, and the class of each object by its number; −1 for the background and for objects without one.

    Parameters
    ----------
    names : names of objects by number, the background first.
    labels : classes by the name of an object, of the scene file; None for no class.

    Raises
    ------
    SpecError
        If a label is of an object that is not there.
    """
    for name in labels:
        if name not in names[1:]:
            raise SpecError(f"no object {name!r} in the scene; there are {', '.join(names[1:])}", key="labels")
    of_object = [labels.get(name, re.sub(r"[\s_.-]*\d+$", "", name) or name) for name in names[1:]]
    class_names = list(dict.fromkeys(name for name in of_object if name is not None))
    return class_names, np.array(
        [-1, *(-1 if name is None else class_names.index(name) for name in of_object)], np.int64
    )


def box_records(
    images: Iterable[tuple[float, NDArray[np.integer]]], class_of: NDArray[np.int64], kind: np.dtype
) -> NDArray[np.void]:
    """Boxes as records.

    Parameters
    ----------
    images : times in µs, and the number of the object that each pixel shows then, [row, col].
    class_of : class of each object by its number; −1 for none.
    kind : `PROPHESEE_BOX` or `DSEC_BOX`.

    Returns
    -------
    Structured array [box], in order of the images.
    """
    parts = [np.zeros(0, kind)]
    for t_us, objects in images:
        numbers, boxes = _labelled_boxes(objects, class_of)
        rows = np.zeros(numbers.size, kind)
        rows["t"], rows["class_id"], rows["track_id"], rows["class_confidence"] = t_us, class_of[numbers], numbers, 1
        for column, key in enumerate("xywh"):
            rows[key] = boxes[:, column]
        parts.append(rows)
    return np.concatenate(parts)


def _labelled_boxes(
    objects: NDArray[np.integer], class_of: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Those of `pixel_boxes` that have a class."""
    numbers, boxes = pixel_boxes(objects)
    kept = class_of[numbers] >= 0
    return numbers[kept], boxes[kept]


def _event_boxes(
    recording: Recorded, truth: SceneTruth, every_us: int | None, kind: np.dtype
) -> tuple[NDArray, NDArray[np.int64], dict[str, Any]]:
    """Boxes on the event grid as records, their times, and their description."""
    step = every_us or min(BOXES_EVERY_US, recording.duration_us)
    times = np.arange(0, recording.duration_us + 1, step, dtype=np.int64)
    names, class_of = classes(truth.names.objects, truth.scene.spec.labels)
    rows = box_records(((float(t), truth.ids(float(t), "events").object) for t in times), class_of, kind)
    return rows, times, {"every_us": int(step), "classes": names, "tracks": _tracks(truth, class_of)}


def _tracks(truth: SceneTruth, class_of: NDArray[np.int64]) -> dict[int, str]:
    """Names of the objects that have a class, by number."""
    return {number: name for number, name in enumerate(truth.names.objects) if class_of[number] >= 0}


def write_prophesee_boxes(recording: Recorded, truth: SceneTruth, folder: Path, every_us: int | None) -> dict[str, Any]:
    """``recording_bbox.npy`` for ``recording_td.dat``."""
    rows, _, facts = _event_boxes(recording, truth, every_us, PROPHESEE_BOX)
    np.save(folder / "recording_bbox.npy", rows)
    return facts


def write_dsec_det(recording: Recorded, truth: SceneTruth, folder: Path, every_us: int | None) -> dict[str, Any]:
    """``object_detections/left/tracks.npy``, with the times of the boxes as those of images."""
    rows, times, facts = _event_boxes(recording, truth, every_us, DSEC_BOX)
    if len(facts["classes"]) > _MOST_DSEC_CLASSES:
        raise SpecError(f"{len(facts['classes'])} classes; DSEC-det has at most {_MOST_DSEC_CLASSES}", key="labels")
    for name in ("object_detections/left", "images"):
        (folder / name).mkdir(parents=True)
    np.save(folder / "object_detections" / "left" / "tracks.npy", rows)
    (folder / "images" / "timestamps.txt").write_text("".join(f"{t}\n" for t in times), encoding="ascii")
    return facts


def write_coco(recording: Recorded, truth: SceneTruth, folder: Path, every_us: int | None) -> dict[str, Any]:
    """``annotations/instances.json`` with boxes and masks of each frame, and the frames as 8-bit sRGB in ``images``.

    Annotations are written as they come: masks of many frames are larger than memory.
    """
    from PIL import Image

    names, class_of = classes(truth.names.objects, truth.scene.spec.labels)
    for name in ("annotations", "images"):
        (folder / name).mkdir()
    scene, sensor = recording.manifest["scene"]["name"], recording.manifest["sensor"]["name"]
    images, count = list[dict[str, Any]](), 0
    head = {
        "info": {"description": f"{scene} seen by {sensor}"},
        "categories": [{"id": number, "name": name} for number, name in enumerate(names, start=1)],
    }
    with (folder / "annotations" / "instances.json").open("w", encoding="utf-8") as file:
        file.write(_json(head)[:-1] + ', "annotations": [')
        for frame in recording.frames:
            rows, cols = frame.raw.shape
            picture = colour_picture(frame.raw, recording.mosaic, max_width=cols)
            entry = {"id": frame.index, "file_name": f"{frame.index:06d}.png", "width": cols, "height": rows}
            images.append(entry | {"t_us": frame.exposure_start_us + frame.exposure_us / 2})
            Image.fromarray(picture).save(folder / "images" / entry["file_name"], format="PNG")
            for annotation in _annotations(truth.ids(frame).object, class_of):
                count += 1
                file.write((", " if count > 1 else "") + _json({"id": count, "image_id": frame.index, **annotation}))
        file.write(f'], "images": {_json(images)}}}\n')
    return {"frames": len(images), "classes": names, "tracks": _tracks(truth, class_of)}


def _annotations(objects: NDArray[np.integer], class_of: NDArray[np.int64]) -> Iterator[dict[str, Any]]:
    """Boxes and masks of COCO of one image of object numbers."""
    for number, box in zip(*_labelled_boxes(objects, class_of), strict=True):
        mask = objects == number
        yield {
            "category_id": int(class_of[number]) + 1, "track_id": int(number), "bbox": box.tolist(),
            "area": int(mask.sum()), "iscrowd": 0, "segmentation": run_lengths(mask),
        }  # fmt: skip


def _json(content: Any) -> str:
    return json.dumps(content, ensure_ascii=False)
