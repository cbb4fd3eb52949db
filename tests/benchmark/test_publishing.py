"""What others read of a benchmark: Croissant metadata, the header of the card, and data sets in the form of tonic's."""

import hashlib
import json

import numpy as np
import pytest
from ruamel.yaml import YAML

import hesim_render as hr
from benchmarks import small
from hesim_render.benchmark import build_benchmark, card
from hesim_render.benchmark.card import card_header, spread, tasks
from hesim_render.benchmark.shards import pack_benchmark
from hesim_render.benchmark.statistics import FIGURES
from hesim_render.benchmark.tonic_dataset import EventDataset
from hesim_render.core.errors import RangeError, SpecError


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Two hybrid clips whose event pixels leak: events without a long render."""
    keys = {"aps.frame_rate_hz": 60, "evs.leak_rate_hz": 300}
    scenes = [{"scene": "flat-field", "split": "test"}, {"scene": "step-wedge", "split": "train"}]
    spec = small(
        scenes={"given": scenes}, duration_s=0.048, sensors=[{"sensor": "gen2", "roi": "24x16", "set": keys}],
        exposures_us=[12_000], sharp={"times_us": [6250, 22500], "window_us": 500}, truth=["events", "depth", "ids"],
        description='A "quoted" description: with a colon.\nAnd a second line.',
    )  # fmt: skip
    return build_benchmark(spec, tmp_path_factory.mktemp("published") / "b", estimate=False)


def test_croissant_names_every_clip_and_the_bytes_of_the_manifest(built):
    content = json.loads((built.root / "croissant.json").read_text())
    assert content["conformsTo"] == "http://mlcommons.org/croissant/1.1" and content["name"] == "small"
    manifest, *sets = content["distribution"]
    assert manifest["sha256"] == hashlib.sha256((built.root / "benchmark.json").read_bytes()).hexdigest()
    assert [entry["name"] for entry in sets] == ["frames", "events", "truth", "recordings", "sharp"]
    for entry in sets:
        assert list(built.root.glob(entry["includes"])), entry["includes"]
    splits, clips = content["recordSet"]
    assert splits["data"] == [{"splits/name": "train"}, {"splits/name": "test"}]
    first = built.manifest["clips"][0]
    for field in clips["field"]:
        assert field["name"] in first
        kind = {"sc:Text": str, "sc:Integer": int}[field["dataType"]]
        assert isinstance(first[field["name"]], kind)


def test_croissant_is_valid_and_its_records_are_the_clips(built):
    mlc = pytest.importorskip("mlcroissant")
    found = mlc.Dataset(jsonld=str(built.root / "croissant.json"))
    assert not found.metadata.ctx.issues.errors
    records = list(found.records("clips"))
    for record, clip in zip(records, built.manifest["clips"], strict=True):
        for name in ("name", "split", "scene", "sensor", "noise", "seed", "sha256"):
            value = record[f"clips/{name}"]
            assert (value.decode() if isinstance(value, bytes) else value) == clip[name]


def test_the_card_begins_with_the_header_that_hubs_read(built):
    text = (built.root / "README.md").read_text()
    _, header, body = text.split("---\n", 2)
    values = YAML(typ="safe").load(header)
    assert values["pretty_name"] == "small" and values["size_categories"] == ["n<1K"]
    tasks = ["image-to-image", "depth-estimation", "image-segmentation", "object-detection"]
    assert values["task_categories"] == tasks
    assert "event-camera" in values["tags"] and body.startswith("\n# small\n")


def test_figures_of_the_card_are_those_of_the_clips(built, monkeypatch):
    """Smallest, median and largest over the clips, decades of the range, and how many have none."""
    clips = [clip.content for clip in built.clips()]
    named = dict.fromkeys(card.FIGURES)
    told = {"min": 0.02, "median": 0.5, "max": 40.0, "decades": 3.3, "zero": 0}
    monkeypatch.setattr(card, "spread", lambda _: {name: {**told, "zero": 7 * k} for k, name in enumerate(named)})
    text = card.card(built.manifest, clips)
    rows = [line for line in text.splitlines() if line.startswith(tuple(f"| `{name}`" for name in named))]
    for k, (name, row) in enumerate(zip(named, rows, strict=True)):
        more = f", {7 * k} clips with 0" if k else ""
        assert row == f"| `{name}` | 0.02 | 0.5 | 40 | 3.3 | {card.FIGURES[name]}{more} |"


def test_shards_tell_hubs_the_files_of_each_split(built, tmp_path):
    pack_benchmark(built.root, tmp_path / "x")
    _, header, body = (tmp_path / "x" / "README.md").read_text().split("---\n", 2)
    files = YAML(typ="safe").load(header)["configs"][0]["data_files"]
    assert files == [{"split": "train", "path": "train-*.tar"}, {"split": "test", "path": "test-*.tar"}]
    assert all(list((tmp_path / "x").glob(entry["path"])) for entry in files) and "index.json" in body
    given = {"clips": [], "name": "n", "spec": {"truth": [], "sharp": None}}
    values = YAML(typ="safe").load(card_header(given, {"val": "val-*.h5"}).split("---\n")[1])
    assert values["configs"][0]["data_files"] == [{"split": "validation", "path": "val-*.h5"}]


def test_figures_of_clips_span_decades_of_what_is_above_0():
    first, second = list(FIGURES)[:2]
    rates = [{"figures": {first: value, second: 0.0}} for value in (30.0, 0.0, 3000.0, 3.0, 600.0)]
    found = spread([*rates, {"figures": {}}])
    assert found[first] == {"min": 0, "median": 30, "max": 3000, "decades": pytest.approx(3), "zero": 1}
    assert found[second] == {"min": 0, "median": 0, "max": 0, "decades": 0, "zero": 5}


def test_sizes_and_tasks_of_other_benchmarks():
    spec = {"truth": ["all"], "sharp": None}
    assert tasks(spec) == ["depth-estimation", "image-segmentation", "object-detection"]
    for count, size in ((999, "n<1K"), (1000, "1K<n<10K"), (99_999, "10K<n<100K"), (1_000_000, "n>1M")):
        manifest = {"clips": [None] * count, "name": "no: \n---\nname", "spec": {"truth": [], "sharp": None}}
        header = card_header(manifest)
        values = YAML(typ="safe").load(header.split("---\n")[1])
        assert values["size_categories"] == [size] and "task_categories" not in values
        assert values["pretty_name"] == "no: \n---\nname" and header.count("\n---\n") == 1


def test_items_are_the_events_of_a_clip_with_their_target(built):
    clip = next(built.clips("train"))
    recording = clip.recording
    data = EventDataset(built.root, "train")
    assert len(data) == 1 and data.sensor_size == (6, 4, 2) and data.ordering == ("x", "y", "t", "p")
    events, cause = data[0]
    assert events.size == cause.size == recording.events.size > 20
    for name, values in zip("xyt", (recording.events[k] for k in ("x", "y", "t_us")), strict=True):
        np.testing.assert_array_equal(events[name], values)
    np.testing.assert_array_equal(events["p"], recording.events["polarity"] > 0)
    np.testing.assert_array_equal(cause, recording.event_labels.label)
    np.testing.assert_array_equal(EventDataset(built.root, "train", "object")[0][1], recording.event_objects)
    boxes = EventDataset(built.root, None, "boxes")
    assert boxes.classes == ["target", "wall"]  # of both clips
    for clip, (_, found) in zip(built.clips(), (boxes[k] for k in range(2)), strict=True):
        names, seen = clip.recording.truth.names.objects, 0
        for t_us in clip.recording.stored_truth.read("events/time_us"):
            image = clip.recording.truth.ids(float(t_us), "events").object
            here = found[found["t"] == int(t_us)]
            assert here["track_id"].tolist() == sorted(set(np.unique(image)) - {0})
            for row in here:
                rows, cols = np.nonzero(image == row["track_id"])
                assert [row[key] for key in "xywh"] == [cols.min(), rows.min(), np.ptp(cols) + 1, np.ptp(rows) + 1]
                assert boxes.classes[row["class_id"]] == names[row["track_id"]]
                seen += 1
        assert seen == found.size > 0
    before = [boxes.classes[k] for k in boxes[0][1]["class_id"]]
    boxes.classes.reverse()  # as if another clip had named them first
    assert [boxes.classes[k] for k in boxes[0][1]["class_id"]] == before
    frames = EventDataset(built.root, "train", "frames")[0][1]
    np.testing.assert_array_equal(frames["images"], [frame.raw for frame in recording.frames])
    assert frames["t_us"].tolist() == [frame.t_us for frame in recording.frames]
    sharp = EventDataset(built.root, "train", "sharp")[0][1]
    np.testing.assert_array_equal(sharp["images"][1], clip.sharp.raw_dn(1))
    assert sharp["t_us"].tolist() == [6250, 22500] and len(EventDataset(built.root, None)) == 2


def test_transforms_get_events_and_target(built):
    counted = EventDataset(built.root, "test", transform=len, target_transform=lambda cause: int(cause.max()))
    count, most = counted[0]
    recording = next(built.clips("test")).recording
    assert (count, most) == (recording.events.size, recording.event_labels.label.max())
    both = EventDataset(built.root, "test", transforms=lambda events, cause: (cause, events))
    assert both[0][1].dtype == EventDataset.dtype
    with pytest.raises(RangeError, match="nothing beside transform"):
        EventDataset(built.root, "test", transform=len, transforms=lambda a, b: (a, b))
    with pytest.raises(RangeError, match=r"target is 'casue'; expected one of cause.*did you mean 'cause'"):
        EventDataset(built.root, target="casue")
    with pytest.raises(SpecError, match="no clip of the split val"):
        EventDataset(built.root, "val")


def test_transforms_of_tonic_take_the_items(built):
    transforms = pytest.importorskip("tonic.transforms")
    plain = EventDataset(built.root, "train")
    data = EventDataset(built.root, "train", transform=transforms.ToFrame(plain.sensor_size, n_time_bins=3))
    frames, _ = data[0]
    assert frames.shape == (3, 2, 4, 6) and 0 < frames.sum() <= plain[0][0].size
    recording = next(built.clips("train")).recording
    frames, _ = EventDataset(built.root, "train", transform=transforms.ToFrame(plain.sensor_size, event_count=1))[0]
    on = hr.events.event_frame(recording.events, recording.event_shape, kind="counts")
    assert frames.shape[0] == recording.events.size
    np.testing.assert_array_equal(frames.sum(axis=0).astype(int).sum(axis=0), on.sum(axis=0))
