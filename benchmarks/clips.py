"""Cost of the clips of a benchmark: where their time goes, what the framework adds, what a second worker brings.

Four parts, each with generated scenes of the default ranges::

    python benchmarks/clips.py parts [--clips 4] [--roi 256x192] [--sensor gen2] [--duration 0.05]
    python benchmarks/clips.py overhead [the same options]
    python benchmarks/clips.py workers [--equal] [the same options]
    python benchmarks/clips.py spans --clips 1 --duration 0.4 [the same options]

`parts` prints processor seconds of each step of a clip, with the materials of its scene. `overhead` builds the clips
with one worker of one thread, and prints what that took beyond the time inside the clips. `workers` builds the same
clips with one and with two workers of one thread each, when their kernels are compiled. Scenes differ by a factor of
ten in their time, so that with few clips the last one keeps a worker waiting: `--equal` gives all clips one scene.
`spans` cuts each clip into four spans for the two workers. All but `parts` need an idle machine and clips of more than
some seconds.
"""

import argparse
import contextlib
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from hesim_render.benchmark import clip as clip_module
from hesim_render.benchmark.build import build_benchmark, opened
from hesim_render.benchmark.clip import build_clip
from hesim_render.benchmark.local import LocalWorkers
from hesim_render.benchmark.plan import BenchmarkPlan
from hesim_render.benchmark.spans import spans_of
from hesim_render.benchmark.worker import order_of
from hesim_render.capture import simulate as simulate_module
from hesim_render.capture.loop import Capture
from hesim_render.core.guard import WholeFile
from hesim_render.recording.writer import RecordingWriter
from hesim_render.sources.render.audit.audit import Audit
from hesim_render.specs.benchmark import BenchmarkSpec

#: Steps of a clip: an object, the name of its function, and what it does.
STEPS = (
    (clip_module, "load_scene", "scene"),
    (simulate_module, "forecast", "forecast"),
    (Capture, "record", "frames and events"),
    (Audit, "run", "audit"),
    (RecordingWriter, "write_truth", "geometric truth"),
    (RecordingWriter, "finish", "manifest, preview"),
    (clip_module, "write_sharp", "sharp images"),
    (clip_module, "figures", "figures"),
    (WholeFile, "sha256", "hashes"),
)


def spec_of(given):
    keys = {
        "schema_version": 1, "name": "cost", "description": "Default ranges.", "duration_s": given.duration,
        "scenes": {"count": 1 if given.equal else given.clips, "objects": [2, 4]},
        "seeds": list(range(7, 7 + given.clips)) if given.equal else [7],
        "sensors": [{"sensor": given.sensor, "roi": given.roi}],
        "sharp": {"every_us": round(given.duration * 1e6 / 5), "window_us": 200},
        "truth": ["flow", "depth", "events"], "quality": given.quality, "audit": given.audit,
    }  # fmt: skip
    return BenchmarkSpec.model_validate(keys)


@contextlib.contextmanager
def timed(spent):
    """Processor seconds of each step, by its name."""
    before = [(owner, name, getattr(owner, name)) for owner, name, _ in STEPS]

    def wrapped(function, what):
        def call(*arguments, **options):
            begin = time.process_time()
            try:
                return function(*arguments, **options)
            finally:
                spent[what] = spent.get(what, 0.0) + time.process_time() - begin

        return call

    for (owner, name, function), (_, _, what) in zip(before, STEPS, strict=True):
        setattr(owner, name, wrapped(function, what))
    try:
        yield
    finally:
        for owner, name, function in before:
            setattr(owner, name, function)


def parts(spec, folder):
    plan = BenchmarkPlan(spec)
    total: dict[str, float] = {}
    for clip in plan.clips:
        spent: dict[str, float] = {}
        begin = time.process_time()
        with timed(spent):
            build_clip(plan, clip, folder)
        spent["all"] = time.process_time() - begin
        shapes = plan.scene_files(clip).content["mitsuba"]["inline"]
        kinds = sorted({item["bsdf"]["type"] for item in shapes.values() if isinstance(item, dict) and "bsdf" in item})
        print(f"{clip.name} ({', '.join(kinds)})")
        print("  " + ", ".join(f"{what} {seconds:.1f} s" for what, seconds in spent.items()), flush=True)
        for what, seconds in spent.items():
            total[what] = total.get(what, 0.0) + seconds
    print("share of all: " + ", ".join(f"{what} {100 * s / total['all']:.0f} %" for what, s in total.items()))
    print(f"{3600 * len(plan.clips) / total['all']:.0f} clips per hour of one core")


def run(spec, folder, count, spans=()):
    """Clips by `count` workers of one thread: when they began, the time of each answer, and that inside its unit."""
    plan = BenchmarkPlan(spec)
    opened(plan, folder)
    answers, begin = [], time.monotonic()
    failed = LocalWorkers(order_of(spec, folder), count, threads=1).run(
        plan.clips, lambda answer: answers.append((time.monotonic(), answer.get("seconds", 0.0))), spans
    )
    assert not failed, failed
    return begin, answers


def overhead(spec, folder):
    begin, answers = run(spec, folder, 1)
    ends, inside = zip(*answers, strict=True)
    start = ends[0] - begin - inside[0]
    between = ends[-1] - ends[0] - sum(inside[1:])
    print(f"{len(inside)} clips, {sum(inside):.1f} s inside them; start of the worker {start:.1f} s, once")
    if len(inside) > 1:
        share = 100 * between / sum(inside[1:])
        print(f"hand-over between clips {1000 * between / (len(inside) - 1):.0f} ms each: {share:.2f} % of their time")
    begin = time.monotonic()
    build_benchmark(spec, folder, workers=0, estimate=False)  # the clips are there: plan, manifest and card alone
    rest = time.monotonic() - begin
    print(f"plan, manifest and card {rest:.1f} s, {100 * rest / sum(inside):.2f} %")


def workers(spec, folder):
    times, inside = {}, {}
    run(spec, folder / "first", 2)  # compiles the kernels, which stay on the disk of a machine
    for count in (1, 2):
        begin, answers = run(spec, folder / str(count), count)
        times[count] = max(end for end, _ in answers) - begin
        inside[count] = sum(seconds for _, seconds in answers)
        each = ", ".join(f"{seconds:.1f}" for _, seconds in answers)
        print(f"{count} workers of one thread: {times[count]:.1f} s with their start; clips: {each} s", flush=True)
    slower, idle = inside[2] / inside[1], 1 - inside[2] / (2 * times[2])
    print(
        f"two are {times[1] / times[2]:.2f} times as fast as one; they began or waited for {100 * idle:.0f} % of that"
    )
    print(f"clips take {slower:.2f} times as long beside each other, plain loops {plain_loops(2) / plain_loops(1):.2f}")


#: Arithmetic that needs little memory, for some seconds: what the processors themselves give to a second process.
LOOP = "import time; t = time.perf_counter(); sum(i * i for i in range(40_000_000)); print(time.perf_counter() - t)"


def plain_loops(count):
    """Mean time of equal loops in as many processes at once, s."""
    loops = [subprocess.Popen([sys.executable, "-c", LOOP], stdout=subprocess.PIPE, text=True) for _ in range(count)]
    return sum(float(loop.communicate()[0]) for loop in loops) / count


def spans(spec, folder):
    times = {}
    for count, parts in ((1, ()), (2, spans_of(spec.duration_us, -(-spec.duration_us // 4)))):
        begin, answers = run(spec, folder / str(count), count, parts)
        times[count] = max(end for end, _ in answers) - begin
        inside = ", ".join(f"{seconds:.1f}" for _, seconds in answers)
        print(
            f"{count} workers, {len(parts)} spans: {times[count]:.1f} s with their start; units: {inside} s", flush=True
        )
    print(f"two are {times[1] / times[2]:.2f} times as fast as one")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["parts", "overhead", "workers", "spans"])
    parser.add_argument("--clips", type=int, default=4)
    parser.add_argument("--equal", action="store_true", help="one scene with as many seeds, so that clips take as long")
    parser.add_argument("--roi", default="256x192")
    parser.add_argument("--sensor", default="gen2")
    parser.add_argument("--duration", type=float, default=0.05)
    parser.add_argument("--quality", type=float, default=0.5)
    parser.add_argument("--audit", type=float, default=1.0)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        {"parts": parts, "overhead": overhead, "workers": workers, "spans": spans}[given.what](
            spec_of(given), Path(folder)
        )


if __name__ == "__main__":
    main()
