"""Building: the same bytes for any number of workers and after kills, and nothing that is not whole."""

import io
import json
import os
import random
import shutil
import signal
import sys
import threading
import time

import h5py
import numpy as np
import pytest
from PIL import Image
from steps import Steps

import hesim_render as hr
from benchmarks import SMALL, generated, small
from hesim_render import cli
from hesim_render.benchmark import Benchmark, build_benchmark, local, verify_benchmark
from hesim_render.benchmark.build import REPORT_FILE, UnfinishedError
from hesim_render.benchmark.card import _own_ticks, card, histograms, spread
from hesim_render.benchmark.clip import CLIP_FILE, build_clip, clip_folder
from hesim_render.benchmark.forecast import estimate_build
from hesim_render.benchmark.local import LocalWorkers
from hesim_render.benchmark.plan import BenchmarkPlan
from hesim_render.benchmark.verify import digest_of, discard_damaged
from hesim_render.benchmark.worker import attempt, order_of
from hesim_render.capture.scene_renderer import scene_renderer
from hesim_render.core.errors import BackendError, OutputError, RangeError, SpecError
from hesim_render.sources.render.light_level import in_absolute_light

DIFFUSE = {"plastic": 0, "rough_plastic": 0, "metal": 0}


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The small benchmark, built by two processes."""
    return build_benchmark(small(), tmp_path_factory.mktemp("benchmark") / "small", workers=2, estimate=False)


def test_clips_hold_what_was_asked_for(built):
    clips = list(built.clips())
    assert [clip.split for clip in clips] == ["train", "test"] and [c.name for c in built.clips("test")] == [
        clips[1].name
    ]
    moving, still = clips
    assert moving.recording.frames[0].raw.shape == (16, 24) and len(moving.recording.events) > 0
    assert moving.recording.event_labels is not None
    assert moving.sharp.time_us.tolist() == [5000, 10000, 15000]
    assert moving.content["figures"]["speed_widths_per_s"] > 0.05
    assert still.content["figures"]["speed_widths_per_s"] == 0
    assert moving.content["render"]["audit"] and moving.content["versions"]["hesim_render"] == hr.__version__


@pytest.mark.slow
def test_the_blurred_frame_is_the_integral_of_the_sharp_flux(tmp_path):
    """20 windows of 500 µs tile the exposure of 10 ms; both sides have an error of half of the sensor's noise.

    Seeds are fixed. The difference would have an rms of 0.71 of the noise, were the errors as large as allowed and
    independent; they are smaller and share random numbers: 0.30, and 0.19 at half the quality. One sharp image alone,
    taken for the exposure, is 8 times as far away.
    """
    times = [250 + 500 * k for k in range(20)]
    spec = small(
        scenes={"given": [{"scene": "rotating-star", "split": "train"}]}, quality=0.5, truth=[],
        sharp={"times_us": times, "window_us": 500}, noise=[{"name": "clean", "clean": True}],
    )  # fmt: skip
    plan = BenchmarkPlan(spec)
    build_clip(plan, plan.clips[0], tmp_path)
    folder = clip_folder(tmp_path, plan.clips[0])
    frame = hr.Recording.load(folder / "recording").frames[0]
    with h5py.File(folder / "sharp.h5") as file:
        flux, stderr = file["flux_e_per_s"][()].astype(float), file["stderr_e_per_s"][()].astype(float)
        raw = file["raw_dn"][()]
    assert frame.exposure_start_us == 0 and frame.exposure_us == 10_000
    integral = flux.sum(axis=0) * 500e-6
    aps = hr.load_sensor("reference-mono").spec.aps
    noise = np.sqrt(integral + aps.read_noise_e**2)
    off = (integral - frame.electrons_mean) / noise
    assert np.sqrt(np.mean(off**2)) < 0.4 and abs(off.mean()) < 0.05
    assert np.sqrt(np.mean((stderr.sum(axis=0) * 500e-6 / noise) ** 2)) < 0.7
    alone = (flux[0] * 0.01 - frame.electrons_mean) / noise
    assert np.sqrt(np.mean(alone**2)) > 6 * np.sqrt(np.mean(off**2))
    # RAW of the sharp image: gain, black and rounding
    expected = np.minimum(flux * 0.01, aps.full_well_e) * aps.system_gain_dn_per_e + aps.black_level_dn
    assert np.abs(raw - expected).max() <= 0.5 + 1e-3 * expected.max()


@pytest.mark.slow
def test_sharp_images_are_those_of_a_renderer_of_their_own(tmp_path):
    """The renderer that made the recording gives them to the bit; they have its crosstalk, here none."""
    level = {"name": "plain", "without": ["aps.crosstalk"]}
    keys = {"geometry.crosstalk": 0.1}
    spec = small(
        scenes={"given": [{"scene": "rotating-star", "split": "train"}]}, truth=[], noise=[level], audit=0,
        sensors=[{"sensor": "reference-mono", "roi": "16x12", "set": keys}],
        sharp={"times_us": [8000], "window_us": 500},
    )  # fmt: skip
    plan = BenchmarkPlan(spec)
    build_clip(plan, plan.clips[0], tmp_path)
    with h5py.File(clip_folder(tmp_path, plan.clips[0]) / "sharp.h5") as file:
        made = file["flux_e_per_s"][0]
    sensor = plan.sensor(plan.clips[0])
    scene = in_absolute_light(hr.load_scene("rotating-star"))[0]
    own = scene_renderer(scene, sensor, 7, spec.quality)
    pixel = np.flatnonzero(sensor.layout.aps_mask).astype(np.uint32)
    a, b = own.mean_flux(pixel, 7750, 8250)
    expected = 0.5 * (np.array(a, np.float32) + np.array(b, np.float32))
    assert np.array_equal(made.ravel()[pixel], expected)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [0, 1, 4])
def test_any_number_of_workers_leaves_the_same_bytes(built, tmp_path, workers):
    again = build_benchmark(small(), tmp_path / "w", workers=workers, estimate=False)
    assert (again.root / "benchmark.json").read_bytes() == (built.root / "benchmark.json").read_bytes()
    assert digest_of(again) == digest_of(built) and verify_benchmark(again.root) == []


def await_builder(root):
    """Number of a process that builds a clip, as soon as there is one: its unfinished folder names it."""
    while True:
        for path in (root / "clips").glob(".*.partial"):
            return int(path.name.removesuffix(".partial").rpartition("-")[2])
        time.sleep(0.05)


@pytest.mark.slow
def test_a_killed_worker_leaves_the_same_bytes(built, tmp_path):
    """Two processes, one of which is killed while it renders; what is there is not built again."""
    spec = small()
    root = tmp_path / "w2"
    workers = []
    begin = LocalWorkers.run

    def run(self, *given):
        workers.append(self)
        threading.Thread(target=kill, daemon=True).start()
        return begin(self, *given)

    killed = []

    def kill():
        pid = await_builder(root)
        assert pid in {worker.process.pid for worker in workers[0]._workers}
        os.kill(pid, signal.SIGKILL)
        killed.append(pid)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LocalWorkers, "run", run)
        again = build_benchmark(spec, root, workers=2, estimate=False)
    assert killed and digest_of(again) == digest_of(built)
    assert (root / "benchmark.json").read_bytes() == (built.root / "benchmark.json").read_bytes()
    told = Steps()
    assert verify_benchmark(root, progress=told) == []
    assert len(told) >= 2 and told[-1][0] == told[-1][1] == 2


def test_a_build_goes_on_where_it_was(built, tmp_path):
    """A clip that is built again in this process has the bytes that a worker process gave it."""
    root = tmp_path / "again"
    shutil.copytree(built.root, root)
    before = {path: path.stat().st_mtime_ns for path in root.rglob("clip.json")}
    lost = next(built.clips("test")).name
    shutil.rmtree(root / "clips" / lost)
    (root / "benchmark.json").unlink()
    with pytest.raises(SpecError, match="has not ended"):
        Benchmark(root)
    build_benchmark(small(), root, estimate=False)
    assert verify_benchmark(root) == []
    assert digest_of(Benchmark(root)) == digest_of(built)
    kept = [path for path in before if path.parent.name != lost]
    assert all(path.stat().st_mtime_ns == before[path] for path in kept)


@pytest.mark.slow
def test_a_generated_scene_is_rendered_from_its_folder(tmp_path):
    """Its textures and meshes lie beside its scene file, and a render from there is the same as that of the clip."""
    spec = generated(
        1, seed=14, scenes={"objects": 1, "size": 0.4, "contrast": 0.9, "textured": 1, "materials": DIFFUSE},
        motions={"speed": 2.0, "camera": 0}, lights={"illuminance_lux": 2000},
    )  # fmt: skip
    clip = next(build_benchmark(spec, tmp_path / "b", estimate=False).clips())
    assert {path.suffix for path in (clip.folder / "scene").iterdir()} == {".yaml", ".png", ".obj"}
    scene = hr.load_scene(clip.scene_file)
    again = hr.simulate(scene, hr.load_sensor("reference-mono").crop(24, 16), duration_s=0.02, quality=4)
    assert len(clip.recording.events) > 0 and np.array_equal(again.events, clip.recording.events)
    for one, other in zip(again.frames, clip.recording.frames, strict=True):
        assert np.array_equal(one.raw, other.raw)


@pytest.mark.slow
def test_a_hundred_clips_differ_by_decades(tmp_path):
    spec = generated(
        100, scenes={"objects": [1, 2]}, duration_s=0.02, quality=8, exposures_us=[2000],
        sensors=[{"sensor": "reference-mono", "roi": "16x12"}],
    )  # fmt: skip
    built = build_benchmark(spec, tmp_path / "b", workers=2, estimate=False)
    for name, values in spread([clip.content for clip in built.clips()]).items():
        assert values["decades"] >= 1, (name, values)


def test_verify_finds_every_change(built, tmp_path):
    root = tmp_path / "changed"

    def fresh():
        shutil.rmtree(root, ignore_errors=True)
        shutil.copytree(built.root, root)
        return next(Benchmark(root).clips()).folder

    clip = fresh()
    assert verify_benchmark(root) == []
    events = clip / "recording" / "events.h5"
    data = bytearray(events.read_bytes())
    data[len(data) // 2] ^= 1  # of the same size
    events.write_bytes(data)
    assert verify_benchmark(root) == [f"{clip.name}/recording/events.h5: was changed"]
    clip = fresh()
    (clip / "sharp.h5").unlink()
    (clip / "note.txt").write_text("mine")
    shutil.copytree(clip, root / "clips" / "stranger")
    found = verify_benchmark(root)
    assert f"{clip.name}/sharp.h5: is missing" in found and f"{clip.name}/note.txt: is not in the manifest" in found
    assert "stranger: is not in the manifest" in found and len(found) == 3
    clip = fresh()
    content = json.loads((clip / CLIP_FILE).read_text())
    (clip / CLIP_FILE).write_text(json.dumps(content | {"split": "test"}))
    assert verify_benchmark(root) == [f"{clip.name}/{CLIP_FILE}: was changed"]
    shutil.rmtree(clip)
    assert verify_benchmark(root) == [f"{clip.name}: is missing"]


def test_another_plan_in_the_same_folder_is_refused(built, tmp_path):
    with pytest.raises(OutputError, match="another plan"):
        build_benchmark(small(seeds=[8]), built.root, estimate=False)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").write_text("mine")
    with pytest.raises(OutputError, match="holds other things"):
        build_benchmark(small(), tmp_path / "other", estimate=False)
    assert [path.name for path in (tmp_path / "other").iterdir()] == ["thesis.tex"]


def test_a_clip_that_cannot_be_built_is_reported_and_the_others_are_there(tmp_path, monkeypatch):
    from hesim_render.benchmark import clip as clips

    def broken(plan, clip, root):
        if clip.split == "test":
            raise SpecError("is broken")
        return clips.Built(clip.name, 1.5, 700)

    monkeypatch.setattr("hesim_render.benchmark.worker.build_clip", broken)
    with pytest.raises(UnfinishedError, match="is broken\n1 of 2 clips could not be built"):
        build_benchmark(small(), tmp_path / "b", estimate=False)
    (run,) = json.loads((tmp_path / "b" / REPORT_FILE).read_text())
    assert run["bytes"] == 700  # those of the clip that is there
    assert not (tmp_path / "b" / "benchmark.json").exists()


def test_a_full_disk_ends_the_build(tmp_path, monkeypatch):
    def full(plan, clip, root):
        raise OutputError("cannot be written (No space left on device)")

    monkeypatch.setattr("hesim_render.benchmark.worker.build_clip", full)
    told = []
    with pytest.raises(OutputError, match="No space left"):
        build_benchmark(small(), tmp_path / "b", estimate=False, progress=lambda *what: told.append(what))
    assert len(told) == 1


# ---- worker processes, with a program in place of the renderer -------------------------------------------

_FAKE = """
import json, os, sys
sys.stdin.readline(), sys.stdin.readline()
if BEFORE: sys.exit(5)
print(json.dumps({"ready": True}), flush=True)
for line in sys.stdin:
    clip = json.loads(line)
    if clip["scene"] == BAD: os.kill(os.getpid(), 9)
    if clip["scene"] == WRONG:
        print(json.dumps({"name": clip["name"], "error": "is wrong", "fatal": FATAL}), flush=True)
        continue
    print(json.dumps({"name": clip["name"], "seconds": 1, "bytes": 2}), flush=True)
"""


def fake(monkeypatch, bad=-1, wrong=-1, fatal=False, before=False):
    head = f"BAD, WRONG, FATAL, BEFORE = {bad}, {wrong}, {fatal}, {before}\n"
    monkeypatch.setattr(local, "COMMAND", (sys.executable, "-c", head + _FAKE))


@pytest.mark.parametrize("count", [1, 3])
def test_a_clip_at_which_workers_die_three_times_is_given_up(monkeypatch, count):
    fake(monkeypatch, bad=2)
    clips, told = BenchmarkPlan(generated(6)).clips, []
    failed = LocalWorkers("{}", count).run(clips, told.append)
    assert failed == {clips[2].name: "its worker died 3 times (last: signal 9)"}
    assert sorted(answer["name"] for answer in told) == sorted(clip.name for clip in clips)


def test_a_wrong_clip_does_not_stop_the_others_but_a_fatal_one_does(monkeypatch):
    clips = BenchmarkPlan(generated(6)).clips
    fake(monkeypatch, wrong=1)
    assert LocalWorkers("{}", 2).run(clips, lambda answer: None) == {clips[1].name: "is wrong"}
    fake(monkeypatch, wrong=1, fatal=True)
    workers = LocalWorkers("{}", 2)
    with pytest.raises(OutputError, match="is wrong"):
        workers.run(clips, lambda answer: None)
    assert workers._workers == []


def test_workers_that_cannot_start_are_one_error(monkeypatch):
    fake(monkeypatch, before=True)
    with pytest.raises(BackendError, match="status 5"):
        LocalWorkers("{}", 2).run(BenchmarkPlan(generated(3)).clips, lambda answer: None)


def test_a_worker_of_another_version_is_refused():
    plan = BenchmarkPlan(small())
    order = order_of(plan.spec, __import__("pathlib").Path("/nowhere")).replace(hr.__version__, "9.9.9")
    assert "9.9.9" in attempt(order, plan.clips[0].as_dict())["error"]


def test_a_scheduler_that_is_not_there_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("hesim_render.benchmark.cluster._PATIENCE_S", 1.5)
    with pytest.raises(RangeError, match="--scheduler"):
        build_benchmark(small(), tmp_path / "b", scheduler="tcp://127.0.0.1:9", estimate=False)


def test_a_scheduler_that_dies_and_a_clip_that_kills_its_workers_are_told(monkeypatch):
    """Answers as dask gives them: of a finished clip, of dead workers, and of a scheduler that is gone."""
    distributed = pytest.importorskip("distributed")
    from concurrent.futures import CancelledError

    from distributed.scheduler import KilledWorker

    from hesim_render.benchmark.cluster import run_on_cluster

    clips = BenchmarkPlan(generated(3)).clips

    class Answer:
        def __init__(self, key, failure):
            self.key, self.failure = key, failure

        def exception(self):
            if isinstance(self.failure, CancelledError):
                raise self.failure
            return None if self.failure == "late" else self.failure

        def result(self):
            if self.failure == "late":  # the scheduler died between the two questions
                raise CancelledError
            return {"name": clips[self.key].name, "seconds": 1.0, "bytes": 2}

    class Client:
        loop = None
        status = "running"

        def __init__(self, *failures):
            self.waiting = [Answer(k, failure) for k, failure in enumerate(failures)][::-1]

        def submit(self, *arguments, **options):
            if self.status == "closed":
                raise RuntimeError("Client is closed")
            return self.waiting.pop()

    monkeypatch.setattr(distributed, "as_completed", lambda futures, loop: futures)
    dead, told = KilledWorker.__new__(KilledWorker), []
    failed = run_on_cluster(Client(None, dead, None), "{}", clips, told.append)
    assert len(told) == 3 and list(failed) == [clips[1].name] and "died again and again" in failed[clips[1].name]
    with pytest.raises(BackendError, match="the finished ones stay"):
        run_on_cluster(Client(None, CancelledError()), "{}", clips[:2], told.append)
    with pytest.raises(BackendError, match="the finished ones stay"):
        run_on_cluster(Client(None, "late"), "{}", clips[:2], told.append)
    closed = Client(None)
    closed.status = "closed"
    with pytest.raises(BackendError, match="the finished ones stay"):
        run_on_cluster(closed, "{}", clips[:1], told.append)
    told.clear()
    with pytest.raises(ModuleNotFoundError, match="hesim_render"):  # of a worker of another environment
        run_on_cluster(Client(None, ModuleNotFoundError("hesim_render")), "{}", clips[:2], told.append)
    assert [answer["name"] for answer in told] == [clips[0].name]


@pytest.mark.slow
def test_two_workers_of_dask_and_a_kill_leave_the_same_bytes(built, tmp_path):
    distributed = pytest.importorskip("distributed")
    root = tmp_path / "dask"
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:

        def kill():
            os.kill(await_builder(root), signal.SIGKILL)

        threading.Thread(target=kill, daemon=True).start()
        again = build_benchmark(small(), root, scheduler=cluster.scheduler_address, estimate=False)
    assert digest_of(again) == digest_of(built) and verify_benchmark(root) == []


@pytest.mark.slow
def test_twenty_random_kills_leave_the_same_bytes(built, tmp_path):
    """Runs are killed with all their processes at random times, until 20 are dead; then one may end."""
    import subprocess

    root = tmp_path / "killed"
    file = tmp_path / "b.yaml"
    file.write_text(json.dumps(SMALL))
    rng = random.Random(4)
    command = [sys.executable, "-m", "hesim_render.cli", "benchmark", "build", str(file), "--out", str(root)]
    command += ["--no-estimate", "--workers"]
    for number in range(20):
        run = subprocess.Popen([*command, str(number % 3)], start_new_session=True, stderr=subprocess.DEVNULL)
        time.sleep(rng.uniform(0.5, 9))
        run.kill()
        run.wait()
    subprocess.run([*command, "1"], check=True)
    assert verify_benchmark(root) == [] and digest_of(Benchmark(root)) == digest_of(built)


def test_damaged_clips_are_discarded_and_made_again(tmp_path, capsys):
    given = [{"scene": "flat-field", "split": "train"}, {"scene": "checkerboard", "split": "test"}]
    spec = small(
        scenes={"given": given}, truth=[],
        sensors=[{"sensor": "reference-mono", "roi": "8x6"}], sharp=None, audit=0,
    )  # fmt: skip
    built = build_benchmark(spec, tmp_path / "b", estimate=False)
    digest, first = digest_of(built), next(built.clips())
    (first.folder / "recording" / "preview.png").write_bytes(b"")
    problems = verify_benchmark(built.root)
    assert problems == [f"{first.name}/recording/preview.png: was changed"]
    with pytest.raises(SystemExit) as end:
        cli.main(["benchmark", "verify", str(built.root), "--discard"])
    told = capsys.readouterr()
    assert end.value.code == 1 and "was changed" in told.err and "removed 1 clip;" in told.out
    assert not first.folder.exists() and not (built.root / "benchmark.json").exists()
    again = build_benchmark(spec, built.root, estimate=False)
    assert digest_of(again) == digest and verify_benchmark(built.root) == []
    plan = built.root / "plan.json"
    plan.write_text(plan.read_text() + " ")
    assert verify_benchmark(built.root) == ["plan.json: was changed, or is missing"]
    assert discard_damaged(built.root, verify_benchmark(built.root)) == []  # nothing of the clips is wrong
    shutil.rmtree(built.root / "clips")
    assert len(verify_benchmark(built.root)) == 3  # two clips and the plan, without a traceback


def test_samples_ask_for_the_exact_mode_and_have_no_sharp_images(tmp_path):
    with pytest.raises(ValueError, match="leave one of the two out"):
        small(samples=8)
    given = {"given": [{"scene": "flat-field", "split": "test"}]}
    spec = small(scenes=given, truth=[], sharp=None, samples=8, sensors=[{"sensor": "reference-mono", "roi": "8x6"}])
    built = build_benchmark(spec, tmp_path / "b")
    recording = next(built.clips()).recording
    assert recording.manifest["settings"]["mode"] == "exact" and recording.manifest["settings"]["samples"] == 8
    text = (built.root / "README.md").read_text()
    assert "8 rays per pixel" in text and "1 met" in text


def test_a_fault_of_ours_in_one_clip_does_not_stop_the_others(monkeypatch):
    def broken(plan, clip, root):
        raise KeyError("x")

    monkeypatch.setattr("hesim_render.benchmark.worker.build_clip", broken)
    plan = BenchmarkPlan(small())
    answer = attempt(order_of(plan.spec, __import__("pathlib").Path("/nowhere")), plan.clips[0].as_dict())
    assert answer == {"name": plan.clips[0].name, "error": "KeyError: 'x'", "fatal": False}


# ---- card and estimate --------------------------------------------------------------------------------


def test_the_card_says_how_clips_differ(built):
    contents = [clip.content for clip in built.clips()]
    text = card(built.manifest, contents)
    assert "2 clips of 0.02 s" in text and "| train | 1 | 1 |" in text and "reference-mono" in text
    values = [content["figures"]["contrast"] for content in contents]
    assert spread(contents)["contrast"]["max"] == max(values)
    assert spread(contents)["speed_widths_per_s"]["zero"] == 1
    assert (built.root / "histograms.png").stat().st_size > 1000


def test_axes_of_alike_clips_have_numbers_that_do_not_overlap():
    """Ends of the range, or one number; powers of ten tell a range of two decades or more."""
    assert _own_ticks(np.array([7.5, 3.0, 4.0])) == [3.0, 7.5] and _own_ticks(np.array([3.0, 300.0])) == []
    assert _own_ticks(np.array([3.0, 5.0, 4.0])) == pytest.approx([15**0.5])
    one = {"figures": dict.fromkeys(("brightness_e_per_s", "contrast", "activity_hz", "speed_widths_per_s"), 1.7)}
    with Image.open(io.BytesIO(histograms([one]))) as picture:
        shades = np.asarray(picture.convert("L"))
    left = shades[:200, 24:36] < 128  # numbers of clips beside the first axis: 0 and 1
    assert np.count_nonzero(np.diff(left.any(axis=1).astype(int)) == 1) == 1
    below = shades[216:240] < 128  # numbers on the four axes
    assert 4 <= np.count_nonzero(np.diff(below.any(axis=0).astype(int)) == 1) <= 24


def test_a_share_of_the_clips_is_audited():
    """A quarter of 400 clips: 100 with a standard deviation of 8.7; 4.5 of these are 39 (false alarm 7e-6)."""
    plans = [BenchmarkPlan(generated(400, audit=share)) for share in (0.25, 0.25, 0, 1)]
    counts = [sum(plan.is_audited(clip) for clip in plan.clips) for plan in plans]
    assert 61 <= counts[0] <= 139 and counts[1:] == [counts[0], 0, 400]
    assert [plans[0].is_audited(c) for c in plans[0].clips] == [plans[1].is_audited(c) for c in plans[1].clips]


def test_without_an_audit_a_clip_has_the_same_bits_and_says_so(tmp_path):
    found = {}
    for audit in (0, 1):
        sensors = [{"sensor": "reference-mono", "roi": "8x6"}]
        given = {"given": [{"scene": "flat-field", "split": "test"}]}
        plan = BenchmarkPlan(small(scenes=given, sensors=sensors, truth=[], sharp=None, audit=audit))
        build_clip(plan, plan.clips[0], tmp_path / str(audit))
        folder = clip_folder(tmp_path / str(audit), plan.clips[0])
        content = json.loads((folder / CLIP_FILE).read_text())
        assert ("audit" in content["render"]) is bool(audit) and content["render"]["rays"] > 0
        found[audit] = hr.Recording.load(folder / "recording")
    assert np.array_equal(found[0].frames[0].raw, found[1].frames[0].raw)
    assert np.array_equal(found[0].events, found[1].events)


def test_the_estimate_counts_the_missing_clips():
    plan = BenchmarkPlan(small(truth=[], sharp=None))
    one, two = estimate_build(plan, plan.clips[1:]), estimate_build(plan, plan.clips[1:] * 2)
    assert two.bytes == 2 * one.bytes and two.clips == 2 and two.seconds > 1.5 * one.seconds > 0
    assert estimate_build(plan, []).seconds == 0
