"""Spans of one clip, rendered by several processes, leave the bytes of a clip that one process built."""

import contextlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from benchmarks import SMALL, generated, small
from hesim_render.benchmark import build_benchmark, local, verify_benchmark
from hesim_render.benchmark.build import UnfinishedError
from hesim_render.benchmark.clip import build_clip, clip_folder, render_span
from hesim_render.benchmark.local import LocalWorkers
from hesim_render.benchmark.plan import BenchmarkPlan
from hesim_render.benchmark.spans import Unit, Waiting, journals_in, spans_folder, spans_of
from hesim_render.benchmark.verify import digest_of
from hesim_render.benchmark.worker import attempt
from hesim_render.core.errors import OutputError, RangeError
from hesim_render.core.journal import Journal
from hesim_render.sources.render.change_driven.pair_tracer import PairTracer

STAR = {"given": [{"scene": "rotating-star", "split": "train"}]}
CLIPS = {
    "ticks": {
        "scenes": STAR, "duration_s": 0.04, "sharp": {"times_us": [5000, 15000, 25000], "window_us": 500}, "audit": 0,
        "truth": ["events"],
        "sensors": [{"sensor": "reference-mono", "roi": "24x16", "set": {"aps.frame_rate_hz": 90}}],
    },
    "hybrid": {
        "scenes": STAR, "duration_s": 0.05, "sharp": None, "audit": 0, "truth": [],
        "sensors": [{"sensor": "gen2", "roi": "24x16"}],
    },
    "asynchronous": {
        "scenes": STAR, "duration_s": 0.05, "sharp": {"times_us": [5000, 25000], "window_us": 500}, "audit": 0,
        "sensors": [{"sensor": "davis346", "roi": "16x12", "set": {"aps.frame_rate_hz": 60}}],
    },
    "flicker": {
        "scenes": {"count": 1, "objects": 1, "textured": 0}, "motions": {"speed": 1, "camera": 0}, "sharp": None,
        "lights": {"flicker": 1, "lamps": 2, "illuminance_lux": 500}, "duration_s": 0.04, "audit": 0,
        "splits": {"train": 1, "val": 0, "test": 0},
    },
    "exact": {"scenes": STAR, "duration_s": 0.02, "sharp": None, "truth": [], "samples": 8},
}  # fmt: skip


@pytest.fixture
def blocks(monkeypatch):
    """Grows by one for each block of rays that is traced."""
    traced = []
    for name in ("_trace_block", "_pilot_block"):
        trace = getattr(PairTracer, name)

        def counted(self, *arguments, trace=trace):
            traced.append(1)
            return trace(self, *arguments)

        monkeypatch.setattr(PairTracer, name, counted)
    return traced


def bytes_of(root, plan):
    folder = clip_folder(root, plan.clips[0])
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
@pytest.mark.parametrize("name", CLIPS)
def test_a_clip_finds_all_its_light_in_its_spans(name, tmp_path, blocks):
    """The spans come in any order. The first frame is traced once, and a span that is rendered again traces nothing."""
    plan = BenchmarkPlan(small(**CLIPS[name]))
    clip, spans = plan.clips[0], spans_of(plan.spec.duration_us, 15_000)
    build_clip(plan, clip, tmp_path / "whole")
    whole, root = len(blocks), tmp_path / "spans"
    for span in spans[::-1]:
        render_span(plan, clip, span, root)
        assert not clip_folder(root, clip).exists()
    assert len(journals_in(clip_folder(root, clip))) == len(spans) >= 2
    traced = len(blocks) - whole
    render_span(plan, clip, spans[0], root)
    assert len(blocks) == whole + traced
    build_clip(plan, clip, root)
    assert len(blocks) == whole + traced  # the clip itself traces nothing
    # a span that does not begin with the clip traces the first window of its first block, which is the last of the span
    # before, for each light; all else is traced once
    assert 0 <= traced - whole <= (len(spans) - 1) * (2 if name == "flicker" else 1)
    assert bytes_of(root, plan) == bytes_of(tmp_path / "whole", plan)
    assert [path.name for path in (root / "clips").iterdir()] == [clip.name]


def test_spans_are_equal_parts_none_longer_than_asked_for():
    assert spans_of(100, 100) == spans_of(100, 0) == ()
    assert spans_of(100, 99) == ((0, 50), (50, 100))
    assert spans_of(1000, 300) == ((0, 250), (250, 500), (500, 750), (750, 1000))
    for duration, most in ((7, 1), (100_001, 17), (1_000_000, 333_333)):
        spans = spans_of(duration, most)
        assert spans[0][0] == 0 and spans[-1][1] == duration and max(b - a for a, b in spans) <= most
        assert all(one[1] == other[0] for one, other in zip(spans[:-1], spans[1:], strict=True))


def test_a_clip_waits_for_its_spans_and_others_do_not():
    plan = BenchmarkPlan(generated(2))
    one, other = plan.clips
    spans = ((0, 5), (5, 10))
    waiting = Waiting(plan.clips, spans)
    first, second = waiting.take(), waiting.take()
    assert (first, second) == (Unit(one, spans[0]), Unit(one, spans[1]))
    waiting.done(first)
    assert waiting.take() == Unit(other, spans[0]) and waiting.take() == Unit(other, spans[1])
    assert waiting.take() is None and len(waiting) == 2  # both clips, of which no span but one is done
    waiting.again(second)  # its worker has died
    assert waiting.take() == second
    waiting.done(second)
    assert waiting.take() == Unit(one)
    waiting.drop(other)
    assert waiting.take() is None and len(waiting) == 0
    assert Unit.of(json.loads(json.dumps(second.as_dict()))) == second and Unit.of(one.as_dict()) == Unit(one)
    assert str(Unit(one, (500_000, 1_000_000))) == f"{one.name}, 0.5 to 1 s"


def test_journals_of_others_are_read_and_never_written(tmp_path):
    run, key, data = {"clip": 1}, b"k" * 16, np.arange(5.0)
    with Journal(tmp_path / "one", run, stays=True) as one:
        one.keep(key, [data])
        written = one.path.read_bytes()
        found = np.zeros(5)
        # while the other is open, and with a part of an entry that it is writing: the first 50 of 68 bytes
        begun = written[-68:-18]
        with one.path.open("ab") as file:
            file.write(begun)
        with Journal(tmp_path / "two", run, others=[one.path, tmp_path / "none"]) as two:
            assert two.count == 1 and two.recall(key, [found]) and np.array_equal(found, data)
            two.keep(b"l" * 16, [data])
        assert not two.path.exists()
        with Journal(tmp_path / "two", {"clip": 2}, others=[one.path]) as of_another_run:
            assert not of_another_run.recall(key, [found])
        with Journal(tmp_path / "two", run, others=[one.path]) as late:
            one.path.rename(tmp_path / "gone")
            assert not late.recall(key, [found])
    assert (tmp_path / "gone").read_bytes() == written + begun
    with Journal(tmp_path / "three", run, stays=True) as three:
        three.keep(key, [data])
    assert three.path.read_bytes() == written


_FAKE = """
import json, os, sys
sys.stdin.readline(), sys.stdin.readline()
print(json.dumps({"ready": True}), flush=True)
for line in sys.stdin:
    unit = json.loads(line)
    if unit["scene"] == 1 and unit.get("span"): os.kill(os.getpid(), 9)
    if unit["scene"] == 2 and unit.get("span") == [0, 5]:
        print(json.dumps({"name": unit["name"], "error": "is wrong", "fatal": False}), flush=True)
        continue
    print(json.dumps({"name": unit["name"], "seconds": 1, "bytes": 2, "span": unit.get("span")}), flush=True)
"""


@pytest.mark.parametrize("count", [1, 3])
def test_a_span_that_fails_fails_its_clip_alone(monkeypatch, count):
    """One kills its workers, one cannot be rendered; no unit is told twice, and each clip comes after its spans."""
    monkeypatch.setattr(local, "COMMAND", (sys.executable, "-c", _FAKE))
    clips, told = BenchmarkPlan(generated(4)).clips, []
    failed = LocalWorkers("{}", count).run(clips, told.append, ((0, 5), (5, 10)))
    assert failed.keys() == {clips[1].name, clips[2].name} and failed[clips[2].name] == "is wrong"
    died = rf"{clips[1].name}, (0 to 5e-06|5e-06 to 1e-05) s: its worker died 3 times \(last: signal 9\)"
    assert re.fullmatch(died, failed[clips[1].name])
    for clip in (clips[0], clips[3]):
        mine = [answer.get("span") for answer in told if answer["name"] == clip.name]
        assert mine[-1] is None and sorted(mine[:-1]) == [[0, 5], [5, 10]]
    for clip in (clips[1], clips[2]):
        assert sum("error" in answer for answer in told if answer["name"] == clip.name) == 1
        assert all("span" in answer or "error" in answer for answer in told if answer["name"] == clip.name)


def test_a_span_that_failed_on_a_cluster_is_the_answer_for_its_clip():
    wrong = {"name": "c", "error": "is wrong", "fatal": False}
    assert attempt("{}", {"name": "c"}, [{"name": "c", "seconds": 1.0}, wrong]) == wrong


def test_only_several_workers_have_spans(monkeypatch, tmp_path):
    """And the progress counts clips, of which a span is a part."""
    asked, done = [], []

    def run(self, clips, told, spans):
        asked.append(spans)
        for clip in clips:
            for _ in (*spans, None):
                told({"name": clip.name, "seconds": 1.0, "bytes": 1})
        raise OutputError("stop")

    def alone(order, unit):
        asked.append(())
        return {"name": unit["name"], "error": "stop", "fatal": True}

    monkeypatch.setattr(LocalWorkers, "run", run)
    monkeypatch.setattr("hesim_render.benchmark.build.attempt", alone)
    spec = small(duration_s=0.04, sharp=None)
    for workers, span_s in ((2, 0.02), (1, 0.02), (0, 0.02), (2, 0.0), (2, 1.0)):
        with pytest.raises(OutputError, match="stop"):
            build_benchmark(
                spec, tmp_path / "b", workers=workers, span_s=span_s, estimate=False,
                progress=lambda count, total, what: done.append((round(count, 9), total)),
            )  # fmt: skip
    assert asked == [((0, 20_000), (20_000, 40_000)), (), (), (), ()]
    assert done[:6] == [(round(k / 3, 9), 2) for k in range(1, 7)]
    for wrong in (-1.0, float("nan")):
        with pytest.raises(RangeError, match="span_s"):
            build_benchmark(spec, tmp_path / "b", span_s=wrong)


# ---- real processes, really killed -----------------------------------------------------------------------

#: Two clips of three spans.
LONG = {
    "scenes": STAR, "duration_s": 0.06, "sharp": {"times_us": [5000, 35000], "window_us": 500}, "audit": 1,
    "sensors": [
        {"sensor": "reference-mono", "roi": "24x16", "set": {"aps.frame_rate_hz": 60}},
        {"sensor": "davis346", "roi": "24x16", "set": {"aps.frame_rate_hz": 60}},
    ],
}  # fmt: skip
SPAN_S = 0.02
#: A worker that keeps what it renders from the first second on, in spans and in clips.
KEEPS = "from hesim_render.benchmark import clip, worker; clip._KEPT_AFTER_S = 0.0; worker.main()"


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Built in this process, without spans."""
    return build_benchmark(small(**LONG), tmp_path_factory.mktemp("spans") / "whole", estimate=False)


def check(built, whole):
    """The same bytes, verified, and nothing lies about."""
    assert digest_of(built) == digest_of(whole) and verify_benchmark(built.root) == []
    assert (built.root / "benchmark.json").read_bytes() == (whole.root / "benchmark.json").read_bytes()
    assert {path.name for path in (built.root / "clips").iterdir()} == {clip.name for clip in built.clips()}


def await_span(root, begun=0):
    """Wait until the journal of a span grows beyond `begun` bytes."""
    while not any(path.stat().st_size > begun for path in (root / "clips").glob(".*.spans/.*.unfinished")):
        time.sleep(0.02)


@pytest.mark.slow
def test_two_workers_with_spans_and_a_kill_in_one_leave_the_same_bytes(whole, tmp_path, monkeypatch):
    root, killed, begin = tmp_path / "b", [], LocalWorkers.run

    def run(self, clips, told, spans):
        def kill():
            await_span(root, 1000)
            killed.append(self._workers[-1].process.pid)
            os.kill(killed[0], signal.SIGKILL)

        threading.Thread(target=kill, daemon=True).start()
        return begin(self, clips, told, spans)

    monkeypatch.setattr(LocalWorkers, "run", run)
    built = build_benchmark(small(**LONG), root, workers=2, span_s=SPAN_S, estimate=False)
    check(built, whole)
    assert killed
    # what a worker that was thought dead has left after its clip was done
    left = spans_folder(next(built.clips()).folder)
    left.mkdir()
    (left / "x").write_text("")
    check(build_benchmark(small(**LONG), root, estimate=False), whole)


@pytest.mark.slow
def test_a_build_of_which_all_is_killed_in_a_span_goes_on(whole, tmp_path):
    """The next build has another number of workers, longer spans and then none; it uses what the first has rendered."""
    file, root = tmp_path / "b.yaml", tmp_path / "b"
    file.write_text(json.dumps(SMALL | LONG))
    command = [sys.executable, "-m", "hesim_render.cli", "benchmark", "build", str(file), "--out", str(root)]
    command += ["--no-estimate", "--workers", "2", "--span", str(SPAN_S)]
    run = subprocess.Popen(command, start_new_session=True, stderr=subprocess.DEVNULL)
    await_span(root, 100_000)
    children = [int(pid) for pid in Path(f"/proc/{run.pid}/task/{run.pid}/children").read_text().split()]
    for pid in (run.pid, *children):
        os.kill(pid, signal.SIGKILL)
    run.wait()
    assert children and any((root / "clips").glob(".*.spans"))
    check(build_benchmark(small(**LONG), root, workers=0, estimate=False), whole)


class Killer(threading.Thread):
    """Kills one of the running processes at random times, until `count` are dead."""

    def __init__(self, pids, count, seed):
        super().__init__(daemon=True)
        self.pids, self.left, self.rng = pids, count, random.Random(seed)
        self.start()

    def run(self):
        while self.left:
            time.sleep(self.rng.uniform(0.5, 5.0))
            running = self.pids()
            if running:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(self.rng.choice(running), signal.SIGKILL)
                    self.left -= 1


#: Builds in which all kills have to be over.
MOST_BUILDS = 20


def build_in_spite_of(killer, root, whole, **how):
    """Build again and again, as a user does whose clips were given up after three deaths; returns how often."""
    for count in range(1, MOST_BUILDS + 1):
        with contextlib.suppress(UnfinishedError):
            built = build_benchmark(small(**LONG), root, span_s=SPAN_S, estimate=False, **how)
            if not killer.left:
                check(built, whole)
                return count
            shutil.rmtree(root)  # too fast: the next kills meet a fresh build
    raise AssertionError(f"{MOST_BUILDS} builds did not end")


@pytest.mark.slow
def test_twenty_random_kills_of_workers_leave_the_same_bytes(whole, tmp_path, monkeypatch):
    """Two workers, which die in spans, in clips with a journal, and while they start."""
    monkeypatch.setattr(local, "COMMAND", (sys.executable, "-c", KEEPS))
    running, begin = [], LocalWorkers.run

    def run(self, *given):
        running[:] = [self]
        return begin(self, *given)

    monkeypatch.setattr(LocalWorkers, "run", run)
    # a worker that dies while it starts ends the build, which is another test
    killer = Killer(lambda: [w.process.pid for made in running for w in made._workers if w.is_ready], 20, 5)
    assert build_in_spite_of(killer, tmp_path / "b", whole, workers=2) <= MOST_BUILDS


@pytest.mark.slow
def test_twenty_random_kills_of_dask_workers_leave_the_same_bytes(whole, tmp_path):
    distributed, dask = pytest.importorskip("distributed"), pytest.importorskip("dask")
    # a local cluster gives a worker up that happens to be starting so long after one of the same name has died
    dask.config.set({"distributed.deploy.lost-worker-timeout": "1 hour"})
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:

        def pids():
            """Those that have reported for work: a nanny gives up a worker that dies while it starts."""
            nannies, known = list(cluster.workers.values()), set(cluster.scheduler.workers)
            running = [nanny.process for nanny in nannies if nanny.worker_address in known]
            return [process.pid for process in running if process is not None and process.pid]

        killer = Killer(pids, 20, 6)
        assert build_in_spite_of(killer, tmp_path / "b", whole, scheduler=cluster.scheduler_address) <= MOST_BUILDS
