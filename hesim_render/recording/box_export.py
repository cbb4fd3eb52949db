"""Boxes and masks of objects in the layouts of detectors: Prophesee's ``bbox.npy``, DSEC-det, and COCO.

A box covers whole pixels: x and y are the first column and row that show the object, w and h their number. It is around
what is visible in the image of object numbers (`SceneTruth.ids`). The track of an object is its number; its class is
its name without the number at its end (``car-2`` and ``car 13`` are of class ``car``).
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from hesim_render.recording.colour_view import colour_picture
from hesim_render.sources.render.truth.scene_truth import SceneTruth

if TYPE_CHECKING:
    from hesim_render.recording.recorded import Recorded

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


def pixel_boxes(objects: NDArray[np.integer]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Boxes around the pixels of each object.

    Parameters
    ----------
    objects : [row, col], number of the object that each pixel shows; 0 is the background, which has no box.

    Returns
    -------
    Numbers of the visible objects [box], and their boxes [box, 4]: x, y, w, h, whole px.
    """
    found = ndimage.find_objects(np.asarray(objects, np.int32))
    numbers = [number for number, part in enumerate(found, start=1) if part is not None]
    boxes = [
        (cols.start, rows.start, cols.stop - cols.start, rows.stop - rows.start)
        for rows, cols in (found[number - 1] for number in numbers)
    ]
    return np.array(numbers, np.int64), np.array(boxes, np.int64).reshape(-1, 4)


def run_lengths(mask: ArrayLike) -> dict[str, Any]:
    """A mask [row, col] as run-length code of COCO, not compressed: column by column, beginning with pixels outside."""
    values = np.asarray(mask, np.bool_)
    edges = np.flatnonzero(np.diff(values.T.ravel(), prepend=False))
    counts = np.diff(np.concatenate([[0], edges, [values.size]]))
    return {"size": list(values.shape), "counts": counts.tolist()}


def classes(names: tuple[str, ...]) -> tuple[list[str], NDArray[np.int64]]:
    """Names of classes, and the class of each object by its number; −1 for the background.

    Parameters
    ----------
    names : names of objects by number, the background first.
    """
    of_object = [re.sub(r"[\s_.-]*\d+$", "", name) or name for name in names[1:]]
    found = list(dict.fromkeys(of_object))
    return found, np.array([-1, *(found.index(name) for name in of_object)], np.int64)


def _event_boxes(
    recording: Recorded, truth: SceneTruth, every_us: int | None, kind: np.dtype
) -> tuple[NDArray, NDArray[np.int64], dict[str, Any]]:
    """Boxes on the event grid as records, their times, and their description."""
    step = every_us or min(BOXES_EVERY_US, recording.duration_us)
    times = np.arange(0, recording.duration_us + 1, step, dtype=np.int64)
    names, class_of = classes(truth.names.objects)
    parts = [np.zeros(0, kind)]
    for t in times:
        numbers, boxes = pixel_boxes(truth.ids(float(t), "events").object)
        rows = np.zeros(numbers.size, kind)
        rows["t"], rows["class_id"], rows["track_id"], rows["class_confidence"] = t, class_of[numbers], numbers, 1
        for column, key in enumerate("xywh"):
            rows[key] = boxes[:, column]
        parts.append(rows)
    facts = {"every_us": int(step), "classes": names, "tracks": dict(enumerate(truth.names.objects[1:], start=1))}
    return np.concatenate(parts), times, facts


def write_prophesee_boxes(recording: Recorded, truth: SceneTruth, folder: Path, every_us: int | None) -> dict[str, Any]:
    """``recording_bbox.npy`` for ``recording_td.dat``."""
    rows, _, facts = _event_boxes(recording, truth, every_us, PROPHESEE_BOX)
    np.save(folder / "recording_bbox.npy", rows)
    return facts


def write_dsec_det(recording: Recorded, truth: SceneTruth, folder: Path, every_us: int | None) -> dict[str, Any]:
    """``object_detections/left/tracks.npy``, with the times of the boxes as those of images."""
    rows, times, facts = _event_boxes(recording, truth, every_us, DSEC_BOX)
    for name in ("object_detections/left", "images"):
        (folder / name).mkdir(parents=True)
    np.save(folder / "object_detections" / "left" / "tracks.npy", rows)
    (folder / "images" / "timestamps.txt").write_text("".join(f"{t}\n" for t in times), encoding="ascii")
    return facts


def write_coco(recording: Recorded, truth: SceneTruth, folder: Path, every_us: int | None) -> dict[str, Any]:
    """``annotations/instances.json`` with boxes and masks of each frame, and the frames as 8-bit sRGB in ``images``."""
    from PIL import Image

    names, class_of = classes(truth.names.objects)
    images, annotations = list[dict[str, Any]](), list[dict[str, Any]]()
    for name in ("annotations", "images"):
        (folder / name).mkdir()
    for frame in recording.frames:
        file = f"{frame.index:06d}.png"
        rows, cols = frame.raw.shape
        picture = colour_picture(frame.raw, recording.mosaic, max_width=cols)
        Image.fromarray(picture).save(folder / "images" / file, format="PNG")
        middle_us = frame.exposure_start_us + frame.exposure_us / 2
        images.append({"id": frame.index, "file_name": file, "width": cols, "height": rows, "t_us": middle_us})
        objects = truth.ids(frame).object
        for number, box in zip(*pixel_boxes(objects), strict=True):
            mask = objects == number
            annotations.append({
                "id": len(annotations) + 1, "image_id": frame.index, "category_id": int(class_of[number]) + 1,
                "track_id": int(number), "bbox": box.tolist(), "area": int(mask.sum()), "iscrowd": 0,
                "segmentation": run_lengths(mask),
            })  # fmt: skip
    categories = [{"id": number, "name": name} for number, name in enumerate(names, start=1)]
    scene, sensor = recording.manifest["scene"]["name"], recording.manifest["sensor"]["name"]
    content = {
        "info": {"description": f"{scene} seen by {sensor}"},
        "images": images, "annotations": annotations, "categories": categories,
    }  # fmt: skip
    text = json.dumps(content, ensure_ascii=False)
    (folder / "annotations" / "instances.json").write_text(text + "\n", encoding="utf-8")
    return {"frames": len(images), "classes": names, "tracks": dict(enumerate(truth.names.objects[1:], start=1))}
