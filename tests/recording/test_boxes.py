"""Boxes, masks and objects of events, against the image of object numbers."""

import json

import h5py
import numpy as np
import pytest
import recordings
from test_truth_files import moving_scene, sensor

import hesim_render as hr
from hesim_render.capture.simulate import simulate
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.recording.box_export import DSEC_BOX, box_records, classes, pixel_boxes, run_lengths
from hesim_render.recording.truth_export import export_truth
from hesim_render.specs.files import validate


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    out = tmp_path_factory.mktemp("boxes") / "rec"
    return simulate(moving_scene(), sensor(), duration_s=0.06, samples=2, out=out, truth=["ids", "events"])


def around(image, number):
    """x, y, w, h of the pixels of an object, pixel by pixel."""
    rows, cols = np.nonzero(image == number)
    return [cols.min(), rows.min(), cols.max() - cols.min() + 1, rows.max() - rows.min() + 1]


def test_boxes_hold_every_pixel_of_their_object_and_are_tight():
    rng = np.random.default_rng(4)
    for _ in range(30):
        image = rng.choice([0, 0, 0, 0, 0, 2, 3, 7], (9, 14))
        numbers, boxes = pixel_boxes(image)
        assert numbers.tolist() == [number for number in (2, 3, 7) if (image == number).any()]
        for number, box in zip(numbers, boxes, strict=True):
            assert box.tolist() == around(image, number)
    numbers, boxes = pixel_boxes(np.zeros((3, 5), np.uint16))
    assert numbers.size == 0 and boxes.shape == (0, 4)


def test_masks_are_the_run_lengths_of_coco():
    assert run_lengths([[0, 1, 1], [0, 1, 0]]) == {"size": [2, 3], "counts": [2, 3, 1]}
    assert run_lengths([[1, 0], [1, 1]]) == {"size": [2, 2], "counts": [0, 2, 1, 1]}
    assert run_lengths(np.zeros((2, 3)))["counts"] == [6] and run_lengths(np.ones((2, 3)))["counts"] == [0, 6]


def test_masks_are_read_by_pycocotools():
    coder = pytest.importorskip("pycocotools.mask")
    rng = np.random.default_rng(6)
    for _ in range(10):
        mask = rng.random((7, 11)) < 0.3
        code = coder.frPyObjects(run_lengths(mask), *mask.shape)
        np.testing.assert_array_equal(coder.decode(code), mask)
        assert coder.toBbox(code).tolist() == around(mask, True)


def test_classes_are_names_without_their_numbers():
    objects = ("background", "car-2", "wall", "car 13", "solid0", "7", "2nd")
    names, of = classes(objects, {})
    assert names == ["car", "wall", "solid", "7", "2nd"] and of.tolist() == [-1, 0, 1, 0, 2, 3, 4]


def test_labels_of_the_scene_file_name_classes_or_say_that_there_is_none():
    objects = ("background", "car-2", "wall", "van", "car 13", "tree")
    names, of = classes(objects, {"van": "car", "wall": None, "tree": "plant 2"})
    assert names == ["car", "plant 2"] and of.tolist() == [-1, 0, -1, 0, 0, 1]
    with pytest.raises(SpecError, match="labels: no object 'tre' in the scene; there are car-2, wall, van"):
        classes(objects, {"tre": "plant"})
    with pytest.raises(SpecError, match=r"labels: no object 'wal' in the scene; there are card, wall"):
        labelled({"wal": "x"})


def labelled(labels):
    scene = moving_scene()
    return type(scene)(validate(type(scene.spec), scene.spec.model_dump(mode="json") | {"labels": labels}, None, {}))


def test_boxes_of_a_scene_are_tight_at_odd_crops(tmp_path):
    scene = labelled({"wall": None, "card": "sign"})
    for name, crop in (("gen2", (44, 28, 1612, 1208)), ("davis346", (37, 29, 149, 113))):
        truth = hr.SceneTruth(scene, hr.load_sensor(name).crop(*crop))
        count = 0
        for t_us in (1_300.0, 30_700.0, 59_100.0):
            for grid in ("events", "mosaic"):
                image = truth.ids(t_us, grid).object
                records = box_records([(t_us, image)], np.array([-1, 0, -1]), DSEC_BOX)
                assert (records["track_id"] == 1).all() and records.size == (image == 1).any()
                for row in records:
                    assert [row[key] for key in "xywh"] == around(image, 1)
                    count += 1
        assert count > 2, name
    recording = recordings.make("davis346")
    recording.__dict__["truth"] = truth
    out = export_truth(recording, "prophesee-boxes", tmp_path / "x")
    told = json.loads((out / "export.json").read_text())
    assert told["classes"] == ["sign"] and told["tracks"] == {"1": "card"}
    assert (np.load(out / "recording_bbox.npy")["class_id"] == 0).all()


@pytest.mark.parametrize("layout", ["prophesee-boxes", "dsec-det"])
def test_boxes_of_the_event_grid_have_the_records_of_their_layout(layout, recorded, tmp_path):
    out = export_truth(recorded, layout, tmp_path / "x", every_us=25_000)
    file = {"prophesee-boxes": "recording_bbox.npy", "dsec-det": "object_detections/left/tracks.npy"}[layout]
    rows = np.load(out / file)
    expected = {  # of RVT (box_loading.py) and of the readme of DSEC-det
        "prophesee-boxes": [("t", "i8"), ("x", "f4"), ("y", "f4"), ("w", "f4"), ("h", "f4"), ("class_id", "u4"),
                            ("track_id", "u4"), ("class_confidence", "f4")],
        "dsec-det": [("t", "u8"), ("x", "f8"), ("y", "f8"), ("h", "f8"), ("w", "f8"), ("class_id", "u1"),
                     ("class_confidence", "f8"), ("track_id", "u8")],
    }[layout]  # fmt: skip
    assert [(name, rows.dtype[name].str[1:]) for name in rows.dtype.names] == expected
    assert sorted(set(rows["t"].tolist())) == [0, 25_000, 50_000] and np.all(np.diff(rows["t"].astype(np.int64)) >= 0)
    for t in (0, 25_000, 50_000):
        image = recorded.truth.ids(float(t), "events").object
        here = rows[rows["t"] == t]
        assert here["track_id"].tolist() == sorted(set(np.unique(image)) - {0})
        for row in here:
            assert [row[key] for key in "xywh"] == around(image, row["track_id"])
            assert (row["class_id"], row["class_confidence"]) == (row["track_id"] - 1, 1)
    card = rows[rows["track_id"] == 1]
    assert len(set(card["x"].tolist())) > 1  # it moves
    told = json.loads((out / "export.json").read_text())
    assert told["classes"] == ["card", "wall"] and told["tracks"] == {"1": "card", "2": "wall"}
    if layout == "dsec-det":
        assert np.genfromtxt(out / "images" / "timestamps.txt", dtype="int64").tolist() == [0, 25_000, 50_000]


def test_frames_have_boxes_and_masks_of_coco(recorded, tmp_path):
    out = recorded.export("coco", tmp_path / "x")
    content = json.loads((out / "annotations" / "instances.json").read_text())
    assert [entry["name"] for entry in content["categories"]] == ["card", "wall"]
    assert len(content["images"]) == len(recorded.frames) >= 2
    for entry, frame in zip(content["images"], recorded.frames, strict=True):
        image = recorded.stored_truth.read("frames/object", frame.index)
        assert (entry["height"], entry["width"]) == image.shape == frame.raw.shape
        assert entry["t_us"] == frame.exposure_start_us + 0.5 * frame.exposure_us
        assert (out / "images" / entry["file_name"]).is_file()
        here = [item for item in content["annotations"] if item["image_id"] == entry["id"]]
        assert [item["track_id"] for item in here] == sorted(set(np.unique(image)) - {0})
        for item in here:
            assert item["bbox"] == around(image, item["track_id"]) and item["category_id"] == item["track_id"]
            counts = item["segmentation"]["counts"]
            mask = np.repeat(np.arange(len(counts)) % 2, counts).reshape(image.shape[::-1]).T
            np.testing.assert_array_equal(mask, image == item["track_id"])
            assert item["area"] == mask.sum() and item["iscrowd"] == 0
    recorded.__dict__["truth"] = recorded.truth_with(labelled({"wall": None, "card": "sign"}))  # as --scene
    again = export_truth(recorded, "coco", tmp_path / "z")
    del recorded.__dict__["truth"]
    other = json.loads((again / "annotations" / "instances.json").read_text())
    assert other["categories"] == [{"id": 1, "name": "sign"}] and other["images"] == content["images"]
    cards = [item | {"id": 0} for item in content["annotations"] if item["track_id"] == 1]
    assert [item | {"id": 0} for item in other["annotations"]] == cards
    with pytest.raises(RangeError, match="coco has none"):
        export_truth(recorded, "coco", tmp_path / "y", every_us=10)


def test_coco_is_read_by_pycocotools(recorded, tmp_path):
    reader, pycocotools = pytest.importorskip("pycocotools.coco"), pytest.importorskip("pycocotools.mask")
    out = recorded.export("coco", tmp_path / "x")
    coco = reader.COCO(str(out / "annotations" / "instances.json"))
    for item in coco.loadAnns(coco.getAnnIds()):
        image = recorded.stored_truth.read("frames/object", item["image_id"])
        np.testing.assert_array_equal(coco.annToMask(item), image == item["track_id"])
        code = coco.annToRLE(item)
        assert pycocotools.toBbox(code).tolist() == item["bbox"] and pycocotools.area(code) == item["area"]


def test_each_event_has_the_object_that_its_pixel_shows_at_its_time(recorded, tmp_path):
    events = recorded.events
    found = recorded.event_objects
    assert found.dtype == np.uint16 and found.shape == events.shape and set(np.unique(found)) == {1, 2}
    for number in np.random.default_rng(1).choice(events.size, 25, replace=False):
        t_us, x, y, _ = events[number]
        assert found[number] == recorded.truth.ids(float(t_us), "events").object[y, x]
    again = hr.Recording.load(hr.Recording.load(recorded.path).save(tmp_path / "again"))
    with h5py.File(again.path / "truth" / "event_objects.h5", "r+") as file:
        np.testing.assert_array_equal(file["object"][:], found)
        file["object"].resize((events.size - 1,))
    with pytest.raises(SpecError, match=rf"event_objects.h5: holds {events.size - 1} objects; the recording has"):
        _ = again.event_objects
    (again.path / "truth" / "event_objects.h5").unlink()
    np.testing.assert_array_equal(hr.Recording.load(again.path).event_objects, found)  # from the scene
    part = hr.Recording.load(again.path).labelled_slice(0, int(events["t_us"][9]))
    np.testing.assert_array_equal(part["object"], found[: part.size])


def test_a_slice_has_the_cause_and_the_object_of_each_event(recorded, tmp_path, monkeypatch):
    events, labels, objects = recorded.events, recorded.event_labels, recorded.event_objects
    assert events.size > 40 and len(set(labels.label.tolist())) > 1
    times = np.unique(events["t_us"])
    begin, end = int(times[1]) + 1, int(times[-2])  # not at a whole ms, where the index of the file begins
    low, high = np.searchsorted(events["t_us"], [begin, end])
    for given in (hr.Recording.load(recorded.path), recorded):
        found = given.labelled_slice(begin, end)
        assert 0 < low < high < events.size and found.size == high - low
        for name in events.dtype.names:
            np.testing.assert_array_equal(found[name], events[name][low:high])
        np.testing.assert_array_equal(found["cause"], labels.label[low:high])
        np.testing.assert_array_equal(found["object"], objects[low:high])
        assert given.labelled_slice(end, begin).size == 0
    from hesim_render.recording import label_file

    def no_whole_column(file, name, path, kind, part=slice(None)):
        assert part.stop is not None and part.stop - part.start < events.size
        return column(file, name, path, kind, part)

    column = label_file._column
    monkeypatch.setattr(label_file, "_column", no_whole_column)
    hr.Recording.load(recorded.path).labelled_slice(begin, end)
    with pytest.raises(SpecError, match="events have no labels; simulate with --truth events"):
        recordings.make("davis346").labelled_slice(0, 10)


def test_objects_are_written_in_whole_pieces(tmp_path, monkeypatch):
    from hesim_render.exchange import dsec
    from hesim_render.pixels.evs.events import EVENT_DTYPE
    from hesim_render.recording import label_file

    monkeypatch.setattr(label_file, "_PIECE", 30)
    monkeypatch.setattr(dsec, "BLOCK", 47)
    (tmp_path / "truth").mkdir()
    events = np.zeros(175, EVENT_DTYPE)
    events["t_us"], events["x"], events["polarity"] = 3 * np.arange(175), np.arange(175) % 7, 1
    writer = dsec.EventFileWriter(tmp_path / "events.h5", (2, 7), 0, 1000)
    writer.append(events)
    writer.close()
    label_file.write_objects(tmp_path, lambda t, x, y: (t + 2 * x + 5 * y).astype(np.uint16))
    expected = events["t_us"] + 2 * events["x"]
    np.testing.assert_array_equal(label_file.read_objects(tmp_path, 175), expected)
