"""Layouts of other programs, walked as their loaders walk them; voxel grids against their definitions; the loader."""

from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from PIL import Image
from steps import Steps

import hesim_render as hr
from benchmarks import small
from hesim_render.benchmark import build_benchmark, layouts
from hesim_render.benchmark.layouts import cumulative_grid, export_benchmark
from hesim_render.core.errors import OutputError, RangeError, SpecError
from hesim_render.pixels.evs.events import EVENT_DTYPE

#: Multiples of the tick, so that there are events at the very times.
MIDDLES = [6250, 22500, 38750]


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A grey card before a hybrid sensor whose event pixels leak: events without a long render."""
    keys = {"aps.frame_rate_hz": 60, "evs.leak_rate_hz": 300}
    spec = small(
        scenes={"given": [{"scene": "flat-field", "split": "test"}]}, duration_s=0.048,
        sensors=[{"sensor": "gen2", "roi": "24x16", "set": keys}], exposures_us=[12_000],
        sharp={"times_us": MIDDLES, "window_us": 500}, truth=["events"],
    )  # fmt: skip
    return build_benchmark(spec, tmp_path_factory.mktemp("layouts") / "b", estimate=False)


@pytest.fixture(scope="module")
def clip(built):
    return next(built.clips())


def image_events(clip, begin, end):
    """Events after `begin` up to `end` at their places on the mosaic: GEN2's event pixel is at (1, 2) of each 4×4."""
    events = clip.recording.events
    events = events[(events["t_us"] > begin) & (events["t_us"] <= end)]
    return 4 * events["x"] + 2, 4 * events["y"] + 1, events["t_us"], events["polarity"] > 0


def same(given, expected):
    assert all(np.array_equal(a, b) for a, b in zip(given, expected, strict=True))
    return len(given[0])


def test_hs_ergb_has_the_events_before_each_image(built, clip, tmp_path):
    assert export_benchmark(built.root, "hs-ergb", tmp_path / "x") == 3
    folder = tmp_path / "x" / "test" / clip.name
    times = [float(line) for line in (folder / "timestamp.txt").read_text().split()]
    assert times == MIDDLES
    count = 0
    for number, t in enumerate(times):
        with np.load(folder / "events_aligned" / f"{number:06d}.npz") as file:
            begin = times[number - 1] if number else -1
            count += same([file[k] for k in "xytp"], image_events(clip, begin, t))
            assert set(np.unique(file["p"])) <= {0, 1}
        picture = np.asarray(Image.open(folder / "images_corrected" / f"{number:06d}.png"))
        assert picture.shape == (16, 24, 3) and picture.dtype == np.uint8 and 200 < picture.mean() < 255
    assert count > 20


def test_bs_ergb_has_the_events_after_each_image_in_fixed_point(built, clip, tmp_path):
    export_benchmark(built.root, "bs-ergb", tmp_path / "x")
    folder = tmp_path / "x" / "1_TEST" / clip.name
    assert len(list((folder / "images").iterdir())) == 3 and len(list((folder / "events").iterdir())) == 2
    for number in range(2):
        with np.load(folder / "events" / f"{number:06d}.npz") as file:
            given = [file["x"] / 32, file["y"] / 32, file["timestamp"], file["polarity"]]
            assert same(given, image_events(clip, MIDDLES[number], MIDDLES[number + 1])) > 5


def test_highrev_has_rows_as_x(built, clip, tmp_path):
    export_benchmark(built.root, "highrev", tmp_path / "x")
    root = tmp_path / "x" / "val"
    names = sorted(path.stem for path in (root / "blur").iterdir())
    assert names == sorted(path.stem for path in (root / "sharp").iterdir())
    assert names == [f"{clip.name}_{k:05d}" for k in range(len(clip.recording.frames))]
    for name, frame in zip(names, clip.recording.frames, strict=True):
        parts = [np.load(path) for path in sorted((root / "event").glob(f"{name}_*.npz"))]
        x, y, t, p = (np.concatenate([part[k] for part in parts]) for k in ("x", "y", "timestamp", "polarity"))
        begin = frame.exposure_start_us
        assert same([y, x, t, p], image_events(clip, begin, begin + frame.exposure_us)) > 2


def test_efnet_has_images_voxels_and_events(built, clip, tmp_path):
    export_benchmark(built.root, "efnet", tmp_path / "x")
    with h5py.File(tmp_path / "x" / "test" / f"{clip.name}.h5") as file:
        assert tuple(file.attrs["sensor_resolution"]) == (16, 24) and file.attrs["num_imgs"] == len(file["images"])
        x, y, t, p = (file[f"events/{k}"][()] for k in ("xs", "ys", "ts", "ps"))
        expected = image_events(clip, -1, 48_000)
        assert same([x, y, np.rint(t * 1e6), p], expected) == file.attrs["num_events"] and p.dtype == bool
        for number, frame in enumerate(clip.recording.frames):
            key = f"{number:09d}"
            voxel = file[f"voxels/voxel{key}"]
            assert voxel.shape == (6, 16, 24) and voxel.dtype == np.float32
            mask = file[f"masks/mask{key}"]
            assert tuple(mask.attrs["size"]) == mask.shape == (16, 24) and tuple(voxel.attrs["size"]) == voxel.shape
            assert file[f"images/image{key}"].shape == file[f"sharp_images/image{key}"].shape == (16, 24, 3)
            end = frame.exposure_start_us + frame.exposure_us
            middle = end - frame.exposure_us // 2
            inside = (expected[2] > middle) & (expected[2] <= end)
            wanted = np.zeros((16, 24))
            np.add.at(wanted, (expected[1][inside], expected[0][inside]), 2 * expected[3][inside].astype(int) - 1)
            np.testing.assert_array_equal(voxel[5], wanted)
            assert file[f"images/image{key}"].attrs["timestamp"] == voxel.attrs["timestamp"] == end / 1e6
            assert file[f"images/image{key}"].attrs["event_idx"] == (expected[2] <= end).sum()


def test_raw_npz_has_a_picture_for_every_tick(built, clip, tmp_path):
    export_benchmark(built.root, "raw-npz", tmp_path / "x")
    folder = tmp_path / "x" / "test" / clip.name
    for frame in clip.recording.frames:
        with np.load(folder / f"{frame.t_us:09d}_aps_raw.npz") as file:
            assert np.array_equal(file["raw"], frame.raw) and np.array_equal(file["aps_raw"], frame.raw)
    ticks = sorted(folder.glob("*_evs.npz"))
    assert len(ticks) == 48_000 // 1250
    total = 0
    for path in ticks:
        with np.load(path) as file:
            signs, codes = file["events"], file["event_raw"]
            assert (
                signs.dtype == np.int8
                and np.array_equal(signs > 0, codes == 2)
                and np.array_equal(signs < 0, codes == 1)
            )
            total += np.count_nonzero(signs)
    assert total == len(clip.recording.events)


def test_an_export_appears_whole_or_not_at_all(built, tmp_path):
    with pytest.raises(RangeError, match="did you mean 'hs-ergb'"):
        export_benchmark(built.root, "hs_ergb", tmp_path / "x")
    export_benchmark(built.root, "raw-npz", tmp_path / "x")
    with pytest.raises(OutputError, match="overwrite"):
        export_benchmark(built.root, "raw-npz", tmp_path / "x")
    told = Steps()
    export_benchmark(built.root, "hs-ergb", tmp_path / "x", overwrite=True, progress=told)
    told.count()
    assert len(told) == len(list(built.clips()))
    assert (tmp_path / "x" / "layout.txt").read_text() == "hs-ergb\n"
    with pytest.raises(SpecError):
        export_benchmark(tmp_path, "hs-ergb", tmp_path / "y")
    assert not (tmp_path / "y").exists()


def test_pictures_are_srgb_of_the_exposure_of_the_first():
    """Of which a half percent of values is above 0.95; by the piecewise function of IEC 61966-2-1, in whole steps."""
    rng = np.random.default_rng(3)
    light = rng.uniform(0, 2.4, (3, 30, 40, 3))
    light[1, 0, 0], light[1, 0, 1] = 99.0, -0.3
    made = layouts._Clip.__new__(layouts._Clip)
    made.development, made._gain = SimpleNamespace(linear=lambda number: light[number]), None
    made.picture(0)
    found = made.picture(1)
    linear = np.clip(light[1] * 0.95 / np.percentile(light[0], 99.5), 0, 1)
    wanted = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_array_equal(found, np.rint(255 * wanted))
    assert found.dtype == np.uint8 and found[0, 0].tolist() == [255] * 3 and found[0, 1].tolist() == [0] * 3
    dark = layouts._Clip.__new__(layouts._Clip)
    dark.development, dark._gain = SimpleNamespace(linear=lambda number: 0 * light[number]), None
    assert dark.picture(2).max() == 0


def test_times_and_pairs_are_those_of_the_middles_of_exposures():
    """A sharp image belongs to a frame if it is at most a quarter of the exposure from its middle."""
    frames = [SimpleNamespace(exposure_start_us=k, exposure_us=n, raw=k) for k, n in ((500, 800), (9_000, 400))]
    made = layouts._Clip.__new__(layouts._Clip)
    made.clip = SimpleNamespace(sharp=None, recording=SimpleNamespace(frames=frames))
    assert [(t, raw()) for t, raw in made.sequence()] == [(900, 500), (9_200, 9_000)] and made.pairs() == []
    for off, numbers in ((200, [0]), (-200, [0]), (201, []), (-201, []), (100, [0, 1])):
        times = np.array([900.0 + off, 9_200 - off])
        made.clip.sharp = SimpleNamespace(
            time_us=times, nearest=lambda t, times=times: int(np.argmin(np.abs(times - t))), raw_dn=lambda k: -k
        )
        assert made.pairs() == [(frames[k], k) for k in numbers]
        assert [(t, raw()) for t, raw in made.sequence()] == [(times[0], 0), (times[1], -1)]


# ---- voxels -------------------------------------------------------------------------------------------


def random_events(count=200):
    rng = np.random.default_rng(8)
    events = np.zeros(count, EVENT_DTYPE)
    events["t_us"] = np.sort(rng.integers(0, 1001, count))
    events["x"], events["y"] = rng.integers(0, 5, count), rng.integers(0, 4, count)
    events["polarity"] = rng.choice([-1, 1], count)
    return events


def test_cumulative_bins_begin_in_the_middle():
    events = random_events()
    events["t_us"][:50] = 100 + 200 * (np.arange(50) // 10)  # at the edges, too
    events = np.sort(events, order="t_us")
    found, edges = cumulative_grid(events, (4, 5), 100, 900, 4), [100, 300, 500, 700, 900]
    for k, (first, last, sign) in enumerate([(100, 500, -1), (300, 500, -1), (500, 700, 1), (500, 900, 1)]):
        part = events[(events["t_us"] > first) & (events["t_us"] <= last)]
        expected = np.zeros((4, 5))
        np.add.at(expected, (part["y"], part["x"]), sign * part["polarity"])
        assert np.array_equal(found[k], expected), edges
    with pytest.raises(RangeError, match="even"):
        cumulative_grid(events, (4, 5), 0, 10, 5)


# ---- the loader ---------------------------------------------------------------------------------------


def test_the_data_set_has_tensors_of_every_frame(built, clip):
    torch = pytest.importorskip("torch")
    from hesim_render.benchmark.torch_dataset import BenchmarkDataset

    data = BenchmarkDataset(built.root, "test", bins=3)
    assert len(data) == len(clip.recording.frames)
    item, frame = data[1], clip.recording.frames[1]
    span = 1023 - 64
    signal = np.where(frame.valid, (frame.raw.astype(float) - 64) / span, 0)
    assert item["frame"].dtype == torch.float32 and np.allclose(item["frame"][0].numpy(), signal)
    sharp = np.where(frame.valid, (clip.sharp.raw_dn(1).astype(float) - 64) / span, 0)
    assert np.allclose(item["sharp"][0].numpy(), sharp)
    assert np.array_equal(item["valid"][0].numpy(), frame.valid) and item["t_us"] == MIDDLES[1]
    begin = frame.exposure_start_us
    expected = hr.events.voxel_grid(clip.recording.events, (4, 6), 3, begin, begin + frame.exposure_us)
    assert np.allclose(item["voxels"].numpy(), expected) and np.abs(expected).sum() > 0
    loader = torch.utils.data.DataLoader(data, batch_size=len(data), num_workers=0)
    assert next(iter(loader))["frame"].shape == (len(data), 1, 16, 24)
    between = BenchmarkDataset(
        built.root, "test", task="interpolate", transform=lambda item: (item["before"], item["index"])
    )
    assert len(between) == len(data) - 2 and between[0][1] == 1
    assert torch.equal(between[0][0], data[0]["frame"])
    with pytest.raises(SpecError, match="no clip"):
        BenchmarkDataset(built.root, "train")


def test_the_data_set_says_that_torch_is_missing(built, monkeypatch):
    from hesim_render.benchmark import torch_dataset

    monkeypatch.setattr(torch_dataset, "torch", None)
    with pytest.raises(SpecError, match=r"torch>=2\.4"):
        torch_dataset.BenchmarkDataset(built.root)
