"""A run of a video that was interrupted and goes on gives the bytes of one that ran through."""

import functools
import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from videos import encode, moving_bar, rgb_frames

import hesim_render as hr
from hesim_render.capture import simulate_video as kept_run
from hesim_render.core.errors import OutputError
from hesim_render.exchange import dsec
from hesim_render.pixels.evs.events import EVENT_DTYPE
from hesim_render.recording.frame import Frame
from hesim_render.sources.video.linear import Lineariser

#: sensor, its changes, input, options: comparisons at ticks with frames in exposure, without events, without frames,
#: asynchronous pixels with all that they remember, crosstalk, made pictures, and events in blocks of several chunks.
TAGS = {"transfer": "srgb", "primaries": "bt709"}
RUNS = {
    "ticks": ("gen2", {"aps.exposure_us": 45_000}, "npy", {}),
    "frames": ("reference-mono", {}, "npy", {"interpolation": "linear"}),
    "events": ("dvxplorer", {}, "npy", {}),
    "asynchronous": ("davis346", {}, "npy", {}),
    "follows light": ("imx636", {}, "npy", {"lens_shading": True}),
    "crosstalk": ("gen2", {"geometry.crosstalk": 0.05}, "npy", {}),
    "motion": ("eiger", {}, "h264", {"interpolation": "motion", "motion_factor": 2}),
    "file": ("eiger", {}, "h264", {}),
    "folder": ("gen2", {}, "folder", {}),
}


@pytest.fixture
def clip(tmp_path):
    """20 pictures, 100 a second."""
    place, linear = tmp_path / "in", moving_bar(20)
    place.mkdir()

    def made(kind):
        if kind == "h264":
            return encode(place / "v.mp4", rgb_frames(linear), "libx264", 100)
        pictures = np.uint8(255 * linear)
        if kind == "npy":
            np.save(place / "v.npy", pictures)
            return place / "v.npy"
        for number, picture in enumerate(pictures):
            Image.fromarray(picture).save(place / f"{number:03}.png")
        return place

    return functools.cache(made)


def record(name, clip, out, monkeypatch, *, stop_after=None, part_s=0.0, long_s=0.0, **more):
    """Simulate; the number of pictures that were converted. `stop_after` so many of them comes Ctrl-C."""
    sensor, changes, kind, options = RUNS[name]
    calls, linear = 0, Lineariser.linear

    def counted(self, planes):
        nonlocal calls
        if calls == stop_after:
            raise KeyboardInterrupt
        calls += 1
        return linear(self, planes)

    given = {"seed": 5, "resume": True, **({} if kind == "h264" else {**TAGS, "fps": 100}), **options, **more}
    with monkeypatch.context() as patch:
        patch.setattr(Lineariser, "linear", counted)
        for name, value in (("_LONG_S", long_s), ("_PART_S", part_s)):
            patch.setattr(f"hesim_render.capture.simulate_video.{name}", value)
        hr.simulate_video(clip(kind), hr.load_sensor(sensor, changes).crop(16, 12), out=out, **given)
    return calls


def bytes_in(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def others(folder):
    return sorted(path.name for path in folder.iterdir() if path.name not in ("in", "whole"))


@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n == "ticks" else pytest.mark.slow) for n in RUNS])
def test_an_interrupted_video_goes_on_and_gives_the_same_bytes(name, clip, tmp_path, monkeypatch):
    every = record(name, clip, tmp_path / "whole", monkeypatch, resume=False)
    stop, out = every // 3 + 1, tmp_path / "out"  # so that a frame is in exposure then
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            record(name, clip, out, monkeypatch, stop_after=stop)
        assert others(tmp_path) == [".out.unfinished"]
    last = record(name, clip, out, monkeypatch)
    found, whole = bytes_in(out), bytes_in(tmp_path / "whole")
    assert found.keys() == whole.keys() and [key for key in whole if found[key] != whole[key]] == []
    assert others(tmp_path) == ["out"]
    # both interrupted runs have done their share, but for the pictures between two comparisons, or in an exposure
    assert stop > 0 and last <= every - 2 * stop + 10


def interrupted(clip, out, monkeypatch, stop_after=12):
    with pytest.raises(KeyboardInterrupt):
        record("ticks", clip, out, monkeypatch, stop_after=stop_after)
    return out.with_name(f".{out.name}.unfinished")


@pytest.mark.slow
def test_another_video_or_option_does_not_go_on(clip, tmp_path, monkeypatch):
    out = tmp_path / "out"
    journal = interrupted(clip, out, monkeypatch)
    kept = journal.read_bytes()
    for changed, what in (({"seed": 6}, "seed"), ({"white_lux": 900.0}, "video"), ({"duration_s": 0.1}, "time")):
        with pytest.raises(OutputError, match=rf"interrupted run.*another {what};"):
            record("ticks", clip, out, monkeypatch, **changed)
    pictures = np.load(clip("npy"))
    np.save(clip("npy"), pictures[::-1])
    with pytest.raises(OutputError, match=r"interrupted run.*another input;"):
        record("ticks", clip, out, monkeypatch)
    assert journal.read_bytes() == kept
    every = record("ticks", clip, out, monkeypatch, overwrite=True)
    assert every == 20 and others(tmp_path) == ["out"]
    record("ticks", clip, tmp_path / "whole", monkeypatch, resume=False)
    assert bytes_in(out) == bytes_in(tmp_path / "whole")


@pytest.mark.slow
@pytest.mark.parametrize("where", [0.02, 0.5, 0.99, b'"times"', b'"sizes"', b'"capture"'])
def test_a_damaged_journal_costs_what_is_damaged_only(where, clip, tmp_path, monkeypatch):
    """Cut off at part of its length, or with another bit in the last frame, block of events or state."""
    record("ticks", clip, tmp_path / "whole", monkeypatch, resume=False)
    journal = interrupted(clip, tmp_path / "out", monkeypatch)
    data = bytearray(journal.read_bytes())
    if isinstance(where, bytes):
        data[data.rindex(where)] ^= 0x40
    else:
        first = data.index(b"\n") + 1
        del data[first + int(where * (len(data) - first)) :]
    journal.write_bytes(data)
    record("ticks", clip, tmp_path / "out", monkeypatch)
    assert bytes_in(tmp_path / "out") == bytes_in(tmp_path / "whole")


@pytest.mark.slow
def test_the_length_of_parts_changes_no_byte(clip, tmp_path, monkeypatch):
    """Each part has several blocks of events, which are kept as one; the blocks decide the layout of the file."""
    monkeypatch.setattr(kept_run, "time", SimpleNamespace(monotonic=itertools.count().__next__))
    monkeypatch.setattr(kept_run, "_MOST_EVENTS", 400)
    monkeypatch.setattr(dsec, "_CHUNK", 50)
    record("asynchronous", clip, tmp_path / "whole", monkeypatch, resume=False)
    for part_s in (0, 5):  # of a clock that counts how often it is asked
        out = tmp_path / str(part_s)
        with pytest.raises(KeyboardInterrupt):
            record("asynchronous", clip, out, monkeypatch, stop_after=16, part_s=part_s)
        record("asynchronous", clip, out, monkeypatch, part_s=part_s)
        assert bytes_in(out) == bytes_in(tmp_path / "whole")


def test_a_short_run_keeps_nothing(clip, tmp_path, monkeypatch):
    """This one takes seconds; it is kept above where a run of 0 s counts as long."""
    with pytest.raises(KeyboardInterrupt):
        record("ticks", clip, tmp_path / "out", monkeypatch, stop_after=12, long_s=20.0)
    assert others(tmp_path) == []


def test_what_is_kept_comes_back_in_its_parts_and_the_run_goes_on_after_the_last(monkeypatch):
    """Three parts of blocks and frames; of a fourth that was not ended nothing comes back, nor of one with a gap."""
    rng, clock, kept = np.random.default_rng(3), [0.0], {}
    monkeypatch.setattr(kept_run.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(kept_run, "_MOST_EVENTS", 50)
    journal = SimpleNamespace(read=kept.get)
    journal.keep = lambda key, arrays: kept.__setitem__(key, b"".join(array.tobytes() for array in arrays))

    def events(count):
        made = np.zeros(count, EVENT_DTYPE)
        made["t_us"], made["x"] = np.sort(rng.integers(0, 9_000, count)), rng.integers(0, 7, count)
        return made

    mask = np.arange(12).reshape(3, 4) % 3 > 0

    def frame(index):
        noise_free = np.where(mask, rng.random((3, 4)), np.nan).astype(np.float32)
        error = np.where(mask, np.float32(0), np.float32(np.nan))
        return Frame(rng.integers(0, 99, (3, 4)).astype(np.uint16), mask, noise_free, error, 70, 40, 30, 1.5, index)

    class Capture:
        frame_mask, progress, given = mask, (0, 900), None

        def state(self):
            return {"at": self.progress[0]}

        def go_on(self, state):
            self.given = state

    def run(capture):
        return kept_run.KeptRun(capture, journal, 10.0)

    # blocks of 20 to 70 events, a frame after every second one, a part every third
    items, capture = [], Capture()
    first = run(capture)
    for number in range(12):
        items.append(events(20 + 7 * number))
        if number % 2:
            items.append(frame(number // 2))
    ends = []
    for number, item in enumerate(items):
        capture.progress = (50 * (number + 1), 900)
        clock[0] += 2.3
        before = len(kept)
        first.keep(item)
        if clock[0] - (ends[-1][1] if ends else 0.0) >= 10:
            assert len(kept) > before
            ends.append((number + 1, clock[0]))
    assert len(ends) == 3 and ends[-1][0] < len(items)

    def back():
        got, told, again = [], [], Capture()
        writer = SimpleNamespace(add_events=got.append, add_frame=got.append)
        run(again).go_on(writer, lambda *given: told.append(given))
        return got, told, again.given

    got, told, state = back()
    there = items[: ends[-1][0]]
    assert told == [(50 * count, 900, "simulated µs") for count, _ in ends] and state == {"at": 50 * ends[-1][0]}
    for kind in (np.ndarray, Frame):
        mine, wanted = ([one for one in each if isinstance(one, kind)] for each in (got, there))
        assert len(mine) == len(wanted) > 0
        for one, other in zip(mine, wanted, strict=True):
            for name in ("raw", "electrons_mean", "electrons_stderr") if kind is Frame else (None,):
                pair = (one, other) if name is None else (getattr(one, name), getattr(other, name))
                np.testing.assert_array_equal(*pair)
            assert kind is not Frame or one.times == other.times
    # one chunk of the second part is gone: that part and the last do not come back
    assert kept.pop(kept_run.key_of("frame", 2)) and len(back()[1]) < 3
