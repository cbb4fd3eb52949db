"""Shards for training: all that a clip has is in them once, anywhere, and with the same bytes each time."""

import io
import json
import tarfile

import h5py
import numpy as np
import pytest

from benchmarks import small
from hesim_render.benchmark import build_benchmark
from hesim_render.benchmark.shards import pack_benchmark, verify_shards
from hesim_render.benchmark.store import store_of
from hesim_render.core.errors import OutputError, RangeError, SpecError


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A grey card before hybrid sensors whose event pixels leak: two clips of three frames, without a long render."""
    keys = {"aps.frame_rate_hz": 60, "evs.leak_rate_hz": 300}
    scenes = [{"scene": "flat-field", "split": "test"}, {"scene": "step-wedge", "split": "train"}]
    spec = small(
        scenes={"given": scenes}, duration_s=0.048, sensors=[{"sensor": "gen2", "roi": "24x16", "set": keys}],
        exposures_us=[12_000], sharp={"times_us": [6250, 22500, 38750], "window_us": 500}, truth=["events", "depth"],
    )  # fmt: skip
    return build_benchmark(spec, tmp_path_factory.mktemp("shards") / "b", estimate=False)


def tar_samples(content):
    """Files of a tar by the part of their names before the first dot, as WebDataset groups them."""
    found = {}
    with tarfile.open(fileobj=io.BytesIO(content)) as file:
        names = file.getnames()
        for name in names:
            key, _, kind = name.partition(".")
            data = file.extractfile(name).read()
            found.setdefault(key, {})[kind] = (
                json.loads(data) if kind == "json" else np.load(io.BytesIO(data), allow_pickle=False)
            )
    # files of a sample stand together, as readers of streams need them
    keys = [name.partition(".")[0] for name in names]
    assert [k for i, k in enumerate(keys) if i == 0 or keys[i - 1] != k] == list(found)
    return found


def same_as(clip, found):
    """Samples against the clip itself; each event is in one sample, with its own label."""
    recording, count = clip.recording, 0
    assert len(found) == len(recording.frames) == 3
    events = np.concatenate([sample["events.npy"] for sample in found.values()])
    labels = np.concatenate([sample["label.npy"] for sample in found.values()])
    assert np.array_equal(events, recording.events) and len(events) > 20
    assert np.array_equal(labels, recording.event_labels.label)
    for number, (name, sample) in enumerate(found.items()):
        frame = recording.frames[number]
        assert name == f"{clip.name}-{number:06d}" and sample["json"]["index"] == number
        assert np.array_equal(sample["raw.npy"], frame.raw)
        assert np.array_equal(sample["sharp.npy"], clip.sharp.raw_dn(number))
        assert sample["json"]["split"] == clip.split and sample["json"]["exposure_us"] == 12_000
        assert np.array_equal(sample["depth_m.npy"], recording.stored_truth.read("frames/depth_m", number))
        inner = sample["events.npy"]["t_us"]
        if number:
            assert inner.min() > frame.exposure_start_us
        if number < 2:
            assert inner.max() <= recording.frames[number + 1].exposure_start_us
        count += 1
    return count


@pytest.mark.parametrize("kind", ["folder", "file", "memory"])
def test_shards_hold_every_sample_once_with_the_same_bytes(built, tmp_path, kind):
    if kind != "folder":
        pytest.importorskip("fsspec")
    target = {"folder": tmp_path / "x", "file": f"file://{tmp_path}/y", "memory": "memory://shards/z"}[kind]
    # so small that each sample closes its shard
    assert pack_benchmark(built.root, target, shard_mb=1e-6) == 6
    assert verify_shards(target) == []
    store = store_of(target)
    index = json.loads(b"".join(store.blocks("index.json")))
    assert [entry["name"] for entry in index["shards"]] == [
        f"{s}-{k:06d}.tar" for s in ("train", "test") for k in range(3)
    ]
    for clip in built.clips():
        found = {}
        for entry in index["shards"]:
            if entry["split"] == clip.split:
                found |= tar_samples(b"".join(store.blocks(entry["name"])))
        assert same_as(clip, found) == 3
    assert pack_benchmark(built.root, tmp_path / "again", shard_mb=1e-6) == 6
    again = json.loads((tmp_path / "again" / "index.json").read_text())
    assert again == index  # the hashes are equal, so the bytes are
    with pytest.raises(OutputError, match="exists"):
        pack_benchmark(built.root, target)
    assert pack_benchmark(built.root, target, overwrite=True) == 6 and verify_shards(target) == []


def test_hdf5_shards_and_what_is_changed_or_wrong(built, tmp_path):
    assert pack_benchmark(built.root, tmp_path / "h", format="hdf5") == 6
    first = json.loads((tmp_path / "h" / "index.json").read_text())
    for clip in built.clips():
        with h5py.File(tmp_path / "h" / f"{clip.split}-000000.h5") as file:
            found = {
                name: {f"{key}.npy": values[()] for key, values in group.items()}
                | {"json": json.loads(group.attrs["figures"])}
                for name, group in file.items()
            }
        assert same_as(clip, found) == 3
    pack_benchmark(built.root, tmp_path / "g", format="hdf5")
    assert json.loads((tmp_path / "g" / "index.json").read_text()) == first
    file = tmp_path / "h" / "test-000000.h5"
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    (tmp_path / "h" / "train-000000.h5").unlink()
    assert verify_shards(tmp_path / "h") == ["train-000000.h5: is missing", "test-000000.h5: was changed"]
    with pytest.raises(RangeError, match="did you mean 'hdf5'"):
        pack_benchmark(built.root, tmp_path / "i", format="hdf")
    with pytest.raises(RangeError, match="shard_mb"):
        pack_benchmark(built.root, tmp_path / "i", shard_mb=0)
    with pytest.raises(SpecError, match="leads out"):
        store_of(tmp_path / "h").has("../x")
    with pytest.raises(SpecError, match="cannot be read"):
        verify_shards(tmp_path / "none")


def test_webdataset_reads_shards_by_itself(built, tmp_path):
    webdataset = pytest.importorskip("webdataset")
    pack_benchmark(built.root, tmp_path / "w")
    clip = next(built.clips("train"))
    read = webdataset.WebDataset(str(tmp_path / "w" / "train-000000.tar"), shardshuffle=False).decode()
    found = {sample["__key__"]: sample for sample in read}
    assert same_as(clip, found) == 3


def test_the_command_packs_and_checks(built, tmp_path, capsys):
    from hesim_render import cli

    with pytest.raises(SystemExit) as end:
        cli.main(["benchmark", "pack", str(built.root), "--out", str(tmp_path / "c"), "--format", "hdf5"])
    assert not end.value.code and "6 samples" in capsys.readouterr().out
    with pytest.raises(SystemExit) as end:
        cli.main(["benchmark", "pack", str(built.root), "--out", str(tmp_path / "c")])
    assert end.value.code == 2 and "overwrite" in capsys.readouterr().err


def test_addresses_that_nobody_knows_are_refused():
    pytest.importorskip("fsspec")
    with pytest.raises(OutputError, match="nosuch"):
        store_of("nosuch://bucket/x")
