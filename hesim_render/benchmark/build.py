"""Building a benchmark: plan, clips, manifest and card. A build that was stopped goes on where it was."""

import contextlib
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hesim_render import __version__
from hesim_render.benchmark.card import CROISSANT_FILE, croissant, write_card
from hesim_render.benchmark.clip import CLIP_FILE, Clip, clip_folder, is_complete
from hesim_render.benchmark.folder import CARD_FILE, MANIFEST_FILE, PLAN_FILE, SCHEMA, Benchmark, read_clip
from hesim_render.benchmark.forecast import BuildEstimate, estimate_build
from hesim_render.benchmark.local import LocalWorkers
from hesim_render.benchmark.plan import BenchmarkPlan, shared_parts
from hesim_render.benchmark.spans import SPAN_S, Span, discard_spans, spans_of
from hesim_render.benchmark.worker import attempt, order_of
from hesim_render.core.errors import HesimError, OutputError, RangeError, SpecError
from hesim_render.core.guard import WholeFile
from hesim_render.core.output import check_target, output_errors, write_whole
from hesim_render.core.progress import Progress, counted, in_words
from hesim_render.specs.benchmark import BenchmarkSpec, read_benchmark
from hesim_render.specs.files import content_hash

REPORT_FILE = "build.json"


class UnfinishedError(HesimError):
    """Some clips could not be built; the others are there, and the same command builds the missing ones."""


def require_workers(workers: int, span_s: float) -> None:
    """Refuse a negative number of workers, or length of the spans that they share."""
    if workers < 0:
        raise RangeError("workers", workers, "0 or more")
    if not 0 <= span_s < float("inf"):
        raise RangeError("span_s", span_s, "a length of time, s; or 0 for whole clips")


def build_benchmark(
    spec: BenchmarkSpec | str | Path,
    out: str | Path,
    *,
    workers: int = 0,
    scheduler: str | None = None,
    span_s: float = SPAN_S,
    estimate: bool = True,
    on_estimate: Callable[[BuildEstimate], None] | None = None,
    progress: Progress | None = None,
) -> Benchmark:
    """Build a benchmark, or complete one that was begun from the same specification.

    Parameters
    ----------
    spec : the benchmark, or the path of its YAML file.
    out : folder of the benchmark. Each clip appears in it whole or not at all.
    workers : number of processes; 0 builds in this process. The bytes do not depend on it.
    scheduler : address of a dask.distributed scheduler, in place of `workers`.
    span_s : where there are several workers, the light of longer clips is rendered by them side by side in equal spans,
        none of which is longer, s; 0: one worker for each clip. The bytes do not depend on it.
    estimate : estimate time and size before the start, which takes some seconds for each sensor.
    on_estimate : called with the estimate.
    progress : called with (done, total, what).

    Raises
    ------
    SpecError
        If the specification is not valid, or its splits share a part.
    OutputError
        If `out` holds something else, or cannot be written (the finished clips stay).
    RangeError
        If `workers` or `span_s` is negative, or the scheduler does not answer.
    UnfinishedError
        If clips could not be built.
    """
    require_workers(workers, span_s)
    spec = spec if isinstance(spec, BenchmarkSpec) else read_benchmark(spec)
    plan = BenchmarkPlan(spec)
    plan.check()
    with _client(scheduler) as client:
        root = opened(plan, Path(out))
        missing = [clip for clip in plan.clips if not is_complete(root, clip)]
        expected = estimate_build(plan, missing, progress=progress) if estimate and missing else None
        if expected is not None and on_estimate is not None:
            on_estimate(expected)
        begin, done = time.monotonic(), {"clips": float(len(plan.clips) - len(missing)), "seconds": 0.0, "bytes": 0}
        is_shared = client is not None or workers > 1
        spans = spans_of(spec.duration_us, max(1, round(span_s * 1e6)) if span_s else 0) if is_shared else ()
        left = {clip.name: 1.0 for clip in missing}

        def on_answer(answer: dict[str, Any]) -> None:
            name = answer["name"]
            part = left[name] if "error" in answer else 1 / (len(spans) + 1)
            left[name] -= part
            done["clips"] += part
            done["seconds"] += answer.get("seconds", 0.0)
            done["bytes"] += answer.get("bytes", 0)
            if progress is not None:
                progress(done["clips"], len(plan.clips), "clips")

        failed = _run(missing, spans, order_of(spec, root), workers, client, on_answer) if missing else {}
    _report(root, expected, len(missing), time.monotonic() - begin, done, workers, scheduler)
    if failed:
        lines = [f"{name}: {reason}" for name, reason in sorted(failed.items())]
        summary = f"{len(failed)} of {len(plan.clips)} clips could not be built; run again to try only these"
        raise UnfinishedError("\n".join([*lines, summary]))
    _finish(plan, root)
    return Benchmark(root)


def check_build(
    spec: BenchmarkSpec, out: str | Path, progress: Progress | None = None
) -> tuple[int, list[Clip], BuildEstimate | None]:
    """What `build_benchmark` would do, with all its checks; nothing is written.

    Parameters
    ----------
    spec, out, progress : as for `build_benchmark`.

    Returns
    -------
    Number of clips, those that are still to be built, and their estimate; None where there are none.
    """
    plan = BenchmarkPlan(spec)
    plan.check()
    root = _checked(plan, Path(out))
    missing = [clip for clip in plan.clips if not is_complete(root, clip)]
    return len(plan.clips), missing, estimate_build(plan, missing, progress=progress) if missing else None


def _client(scheduler: str | None) -> Any:
    """A client of the scheduler, to be used in a with statement; None in it where there is no scheduler."""
    if scheduler is None:
        return contextlib.nullcontext()
    from hesim_render.benchmark.cluster import connected

    return connected(scheduler)


def last_run(root: Path) -> str:
    """What the last build in a folder took, in words."""
    run = WholeFile(root / REPORT_FILE).json()[-1]
    if not run["clips"]:
        return "all clips were there"
    text = f"{counted(run['clips'], 'clip')} in {in_words(run['seconds'])}, "
    text += f"{3600 * run['clips'] / run['seconds']:.0f} clips/h, {run['bytes'] / 1e9:.3g} GB"
    if run["expected"] is not None:
        seconds, size = run["expected"]["seconds"], run["expected"]["bytes"]
        text += f" (estimate: {in_words(seconds)} of one worker, {size / 1e9:.2g} GB)"
    return text


def _run(
    clips: list[Clip],
    spans: tuple[Span, ...],
    order: str,
    workers: int,
    client: Any,
    on_answer: Callable[[dict[str, Any]], None],
) -> dict[str, str]:
    if client is not None:
        from hesim_render.benchmark.cluster import run_on_cluster

        return run_on_cluster(client, order, clips, on_answer, spans)
    if workers:
        return LocalWorkers(order, workers).run(clips, on_answer, spans)
    failed: dict[str, str] = {}
    for clip in clips:
        answer = attempt(order, clip.as_dict())
        on_answer(answer)
        if "error" in answer:
            failed[clip.name] = answer["error"]
            if answer["fatal"]:
                raise OutputError(answer["error"])
    return failed


def _plan_content(plan: BenchmarkPlan) -> dict[str, Any]:
    """What decides the bytes of all clips: the specification and the content of the files that it names."""
    spec = plan.spec
    first = {clip.sensor: clip for clip in reversed(plan.clips)}
    given = {clip.scene: clip for clip in reversed(plan.clips) if clip.scene >= spec.scenes.count}
    pools = plan.generator.given_files()
    return {
        "schema_version": SCHEMA,
        "spec": spec.model_dump(mode="json"),
        "sensors": {str(number): content_hash(plan.sensor(clip).spec) for number, clip in sorted(first.items())},
        "scenes": {str(number): content_hash(plan.given_scene(clip).spec) for number, clip in sorted(given.items())},
        "parts": sorted(WholeFile(path).sha256() for path in pools),
        "hesim_render": __version__,
    }


def opened(plan: BenchmarkPlan, out: Path) -> Path:
    """The folder of the benchmark, with its plan in it.

    Raises
    ------
    OutputError
        If it holds something else, or clips of another plan.
    """
    root = _checked(plan, out)
    file = root / PLAN_FILE
    if not file.is_file():
        text = json.dumps(_plan_content(plan), indent=1, sort_keys=True, ensure_ascii=False) + "\n"
        with output_errors(root):
            (root / "clips").mkdir(parents=True, exist_ok=True)
        write_whole(file, text)
    return root


def _checked(plan: BenchmarkPlan, out: Path) -> Path:
    """The folder of the benchmark, which is empty, missing, or holds clips of this plan."""
    content = _plan_content(plan)
    root = check_target(out, PLAN_FILE, overwrite=True)
    file = root / PLAN_FILE
    if file.is_file():
        try:
            before = WholeFile(file).json()
        except (OSError, ValueError):
            raise OutputError(f"{file}: is damaged, so it is not known what the clips beside it are") from None
        if before != content:
            different = sorted(key for key in {*content, *before} if before.get(key) != content.get(key))
            raise OutputError(
                f"{out}: holds a benchmark of another plan (different: {', '.join(different)}); give another folder"
            )
    return root


def _report(
    root: Path,
    expected: BuildEstimate | None,
    clips: int,
    seconds: float,
    done: dict[str, Any],
    workers: int,
    scheduler: str | None,
) -> None:
    """Note what the build took beside what was expected; this file is not part of the data."""
    file = root / REPORT_FILE
    runs = []
    if file.is_file():
        try:
            runs = list(WholeFile(file).json())
        except (OSError, ValueError):
            runs = []
    runs.append({
        "clips": clips, "seconds": seconds, "clip_seconds": done["seconds"], "bytes": done["bytes"],
        "workers": workers, "cluster": scheduler is not None,
        "expected": None if expected is None else expected.as_dict(),
    })  # fmt: skip
    write_whole(file, json.dumps(runs, indent=1) + "\n")


def _finish(plan: BenchmarkPlan, root: Path) -> None:
    """Write manifest and card from the clips.

    Raises
    ------
    SpecError
        If splits share a part.
    """
    for clip in plan.clips:  # a worker that was thought dead may have left a span after its clip was done
        discard_spans(clip_folder(root, clip))
    contents = [read_clip(clip_folder(root, clip)) for clip in plan.clips]
    leaks = shared_parts({content["name"]: (content["split"], set(content["parts"])) for content in contents})
    if leaks:
        part, first, second = leaks[0]
        raise SpecError(f"the splits {first} and {second} share the part {part}, of {len(leaks)}", file=root)
    manifest = {
        "schema_version": SCHEMA,
        "name": plan.spec.name,
        "spec": plan.spec.model_dump(mode="json"),
        "plan_sha256": WholeFile(root / PLAN_FILE).sha256(),
        "versions": contents[0]["versions"],
        "units": contents[0]["units"],
        "clips": [
            {
                "name": content["name"], "split": content["split"], "scene": content["scene"],
                "sensor": content["sensor"], "noise": content["noise"], "seed": content["seed"],
                "exposure_us": content["exposure_us"], "counts": content["counts"], "figures": content["figures"],
                "verdict": content["render"].get("audit", {}).get("verdict"),
                "sha256": WholeFile(clip_folder(root, clip) / CLIP_FILE).sha256(),
            }
            for clip, content in zip(plan.clips, contents, strict=True)
        ],
    }  # fmt: skip
    text = json.dumps(manifest, indent=1, sort_keys=True, ensure_ascii=False) + "\n"
    write_card(root / CARD_FILE, manifest, contents)
    write_whole(root / CROISSANT_FILE, croissant(manifest, text))
    write_whole(root / MANIFEST_FILE, text)  # last: its presence says that all is there
