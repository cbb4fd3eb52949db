"""Shards for training: all that a clip has is in them once, anywhere, and with the same bytes each time."""

import io
import json
import shutil
import tarfile

import h5py
import numpy as np
import pytest
from steps import Steps

from benchmarks import small
from hesim_render.benchmark import build_benchmark
from hesim_render.benchmark.folder import Benchmark
from hesim_render.benchmark.layouts import LAYOUTS, export_benchmark
from hesim_render.benchmark.shards import pack_benchmark, verify_shards
from hesim_render.benchmark.store import store_of
from hesim_render.benchmark.verify import discard_damaged, verify_benchmark
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
    objects = np.concatenate([sample["event_object.npy"] for sample in found.values()])
    assert np.array_equal(objects, recording.event_objects) and recording.has_event_objects
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
    packed, checked = Steps(), Steps()
    assert pack_benchmark(built.root, target, shard_mb=1e-6, progress=packed) == 6
    assert verify_shards(target, progress=checked) == []
    packed.count()
    checked.count()
    assert len(packed) == 2 and len(checked) == 6
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
    for place in (tmp_path / "h", f"file://{tmp_path}/h"):
        with pytest.raises(SpecError, match="is not the name of a file"):
            list(store_of(place).blocks("../x"))
    with pytest.raises(SpecError, match="no such file"):
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
        cli.main(["benchmark", "export", str(built.root), "--out", str(tmp_path / "c"), "--format", "hdf5"])
    assert not end.value.code and "6 samples" in capsys.readouterr().out
    with pytest.raises(SystemExit) as end:
        cli.main(["benchmark", "export", str(built.root), "--out", str(tmp_path / "c"), "--format", "webdataset"])
    assert end.value.code == 2 and "overwrite" in capsys.readouterr().err


def test_addresses_that_nobody_knows_are_refused():
    pytest.importorskip("fsspec")
    with pytest.raises(OutputError, match="nosuch"):
        store_of("nosuch://bucket/x")


@pytest.mark.parametrize("kind", ["folder", "file", "memory"])
def test_an_error_leaves_no_shards_and_no_half_of_two_sets(built, tmp_path, kind, monkeypatch):
    """A folder keeps its old set; an address has none then."""
    from hesim_render.benchmark import shards

    if kind != "folder":
        pytest.importorskip("fsspec")
    target = {"folder": tmp_path / "x", "file": f"file://{tmp_path}/y", "memory": "memory://shards/e"}[kind]
    whole, samples_left = shards.samples, 4

    def failing(clip):
        nonlocal samples_left
        for sample in whole(clip):
            samples_left -= 1
            if not samples_left:
                raise OSError(28, "No space left on device")
            yield sample

    for is_new in (True, False):
        with monkeypatch.context() as patch:
            samples_left = 4
            patch.setattr(shards, "samples", failing)
            with pytest.raises(OSError, match="No space"):
                pack_benchmark(built.root, target, shard_mb=1e-6, overwrite=True)
        store = store_of(target)
        if is_new or kind != "folder":
            for name in ("index.json", "train-000000.tar", "train-000002.tar", "train-000002.tar.partial"):
                with pytest.raises(SpecError):
                    b"".join(store.blocks(name))
            pack_benchmark(built.root, target, shard_mb=1e-6)
        assert verify_shards(target) == []
    if kind != "memory":
        assert len(list(tmp_path.iterdir())) == 1 and len(list(next(tmp_path.iterdir()).iterdir())) == 8


@pytest.mark.parametrize("name", ["../../outside", "..", "/etc/x", "a/b", "other", "x\n"])
def test_a_clip_with_another_name_than_its_folder_writes_nothing(built, tmp_path, name):
    """It was joined to the folder that is written, and stood in tar files as it was."""
    root = shutil.copytree(built.root, tmp_path / "in" / "b")
    file = next(Benchmark(root).clips()).folder / "clip.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"name": name}))
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(SpecError, match="name"):
        pack_benchmark(root, tmp_path / "out" / "a")
    for layout in LAYOUTS:
        with pytest.raises(SpecError, match="name"):
            export_benchmark(root, layout, tmp_path / "out" / "b")
    found = sorted(path for path in tmp_path.rglob("*") if path != tmp_path / "out")
    assert found == before


@pytest.mark.parametrize("key", ["sensor", "noise", "seed", "motion", "exposure_us", "counts", "figures", "render"])
def test_a_clip_that_lacks_a_key_is_told(built, tmp_path, key):
    """`pack` ended with a KeyError."""
    root = shutil.copytree(built.root, tmp_path / "b")
    file = next(Benchmark(root).clips()).folder / "clip.json"
    file.write_text(json.dumps({name: value for name, value in json.loads(file.read_text()).items() if name != key}))
    with pytest.raises(SpecError, match=rf"clip\.json.*{key}"):
        pack_benchmark(root, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("key", ["name", "split"])
def test_a_manifest_that_names_other_folders_is_refused_and_nothing_is_discarded(built, tmp_path, key):
    root = shutil.copytree(built.root, tmp_path / "b")
    (tmp_path / "b" / "clips" / "photos").mkdir()
    (tmp_path / "b" / "clips" / "photos" / "1.jpg").touch()
    manifest = json.loads((root / "benchmark.json").read_text())
    for value in ("..", ".", "", "../clips/photos", "photos/..", "/"):
        changed = [manifest["clips"][0], manifest["clips"][1] | {key: value}]
        (root / "benchmark.json").write_text(json.dumps(manifest | {"clips": changed}))
        before = sorted(tmp_path.rglob("*"))
        with pytest.raises(SpecError, match=r"benchmark\.json"):
            discard_damaged(root, verify_benchmark(root))
        with pytest.raises(SpecError, match=r"benchmark\.json"):
            export_benchmark(root, "raw-npz", tmp_path / "out")
        assert sorted(tmp_path.rglob("*")) == before
    (root / "benchmark.json").write_text(json.dumps(manifest | {"clips": manifest["clips"][:1] * 2}))
    with pytest.raises(SpecError, match="twice"):
        Benchmark(root)


def test_a_sensor_file_whose_name_cannot_be_part_of_a_clip_needs_one():
    for file in ("..", "a\x1b[1m.yaml", "a b.yaml", "a.b.yaml"):
        with pytest.raises(ValueError, match="give it a name"):
            small(sensors=[{"sensor": f"x/{file}"}])
        assert small(sensors=[{"sensor": f"x/{file}", "name": "own"}]).sensors[0].name == "own"


def test_a_clip_that_is_a_link_is_refused(built, tmp_path):
    root = shutil.copytree(built.root, tmp_path / "b")
    clip = next(Benchmark(root).clips()).folder
    shutil.rmtree(clip)
    for target in (clip.parent, root, tmp_path):
        clip.symlink_to(target)
        with pytest.raises(SpecError, match="is a link"):
            discard_damaged(root, verify_benchmark(root))
        clip.unlink()
    assert (root / "benchmark.json").is_file()


def test_shards_of_names_that_are_none_are_refused(built, tmp_path):
    pack_benchmark(built.root, tmp_path / "s")
    index = json.loads((tmp_path / "s" / "index.json").read_text())
    for name in ("../b/secret", "..", "/etc/passwd", "a\x1b[31m"):
        index["shards"][0]["name"] = name
        (tmp_path / "s" / "index.json").write_text(json.dumps(index))
        for place in (tmp_path / "s", f"file://{tmp_path}/s"):
            with pytest.raises(SpecError, match=r"^[^\x1b]*is not the name of a file"):
                verify_shards(place)


def test_long_names_fit_into_a_tar(built, tmp_path):
    """Names of clips have up to 120 bytes; a header of USTAR has 100."""
    root = shutil.copytree(built.root, tmp_path / "b")
    manifest = json.loads((root / "benchmark.json").read_text())
    for number, entry in enumerate(manifest["clips"]):
        old, entry["name"] = entry["name"], f"{number}-{'long' * 30}"
        folder = (root / "clips" / old).rename(root / "clips" / entry["name"])
        content = json.loads((folder / "clip.json").read_text()) | {"name": entry["name"]}
        (folder / "clip.json").write_text(json.dumps(content))
    (root / "benchmark.json").write_text(json.dumps(manifest))
    assert pack_benchmark(root, tmp_path / "s") == 6
    found = tar_samples((tmp_path / "s" / "train-000000.tar").read_bytes())
    assert [len(name) for name in found] == [122 + 7] * 3
