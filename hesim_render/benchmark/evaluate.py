"""Evaluation of a benchmark: every baseline of every task on every clip, the means, and sentences on them.

A sentence says which method loses to doing nothing, in how many items, and why that happens.
"""

import json
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hesim_render.benchmark.clip import CLIP_FILE
from hesim_render.benchmark.folder import Benchmark, BenchmarkClip
from hesim_render.benchmark.predictions import Predictions
from hesim_render.benchmark.tasks import TASKS, ClipTasks, Score
from hesim_render.benchmark.verify import digest_of
from hesim_render.core.errors import RangeError, SpecError, did_you_mean
from hesim_render.core.guard import WholeFile
from hesim_render.core.output import check_place, write_whole
from hesim_render.core.plain import as_plain
from hesim_render.core.progress import Progress
from hesim_render.specs.benchmark import SPLITS

Summary = dict[str, dict[str, dict[str, dict[str, float]]]]
#: Of each task: the method that does nothing, the measure that decides, and 1 where more of it is better, else −1.
NOTHING = {
    "deblur": ("blurred", "raw_psnr_db", 1),
    "interpolate": ("hold", "raw_psnr_db", 1),
    "denoise": ("none", "f1", 1),
    "fidelity": ("none", "chamfer_px", -1),
    "flow": ("zero", "epe_px", -1),
    "hdr": ("shortest", "psnr_mu_db", 1),
}
#: Why a method may lose; ``{nothing}`` is the mean of doing nothing.
_WHY = {
    "deblur": "doing nothing has {nothing:.3g} dB because little blurs, so there is little to gain, and a method adds "
    "errors everywhere",
    "interpolate": "doing nothing has {nothing:.3g} dB because little changes from frame to frame, and a method adds "
    "errors everywhere",
    "denoise": "F1 is {nothing:.3g} without a filter: so many events are signal that a filter drops more of them than "
    "of the noise",
    "fidelity": "without a filter the events are {nothing:.3g} px from the true ones; true events that a filter drops "
    "make this distance larger",
    "flow": "pixels move by {nothing:.3g} px in the mean, so a flow of zero is off by no more; a method has errors "
    "also where nothing moves",
    "hdr": "the shortest exposure has {nothing:.3g} dB; what moves between exposures leaves ghosts in a merge",
}
_MUCH = "which leaves much to gain; the errors of the method are larger than that"
#: Why a method may lose where doing nothing has less than this value.
_WHY_BELOW = {
    "deblur": (30, f"blur leaves {{nothing:.3g}} dB, {_MUCH}"),
    "interpolate": (30, f"the frame before has {{nothing:.3g}} dB, {_MUCH}"),
    # without a filter F1 is 2/3 where half of the events are signal
    "denoise": (2 / 3, "F1 is {nothing:.3g} without a filter: most events are noise, but signal is dropped with them"),
}
#: Methods that count a threshold for each event.
_INTEGRALS = ("double-integral",)


def evaluate_benchmark(
    root: str | Path,
    *,
    split: str | None = "test",
    tasks: Sequence[str] = (),
    predictions: str | Path | None = None,
    out: str | Path | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Measure the baselines, and results of your own, on the clips of a benchmark.

    Parameters
    ----------
    root : folder of the benchmark.
    split : whose clips; None takes all.
    tasks : names (`TASKS`); default all. A clip without what a task needs is left out of it.
    predictions : folder of your own results, ``TASK/CLIP/000000.npy`` or ``.png``, which are scored beside the
        baselines.
    out : JSON file of the result; None writes none. It is replaced if it exists.
    progress : called with (done, total, what).

    Returns
    -------
    ``score_summary`` [task][method][measure]: mean, std and number of values; ``scores``, a list of every single one;
    ``verdicts``: a sentence for each method that is worse than doing nothing, which says why that happens;
    ``digest`` of the benchmark and ``split``; ``unused``: files of `predictions` that belong to no item of these tasks.

    Raises
    ------
    RangeError
        If a task or the split is unknown, or the split has no clips.
    SpecError
        If the folder is no finished benchmark, or a clip was changed after it was built.
    OutputError
        If `out` cannot be written.
    """
    for name in tasks:
        if name not in TASKS:
            raise RangeError("task", name, f"one of {', '.join(TASKS)}{did_you_mean(name, TASKS)}")
    if split is not None and split not in SPLITS:
        raise RangeError("split", split, f"one of {', '.join(SPLITS)}, or all")
    target = None if out is None else check_place(out)
    benchmark = Benchmark(root)
    clips = list(benchmark.clips(split))
    if not clips:
        raise RangeError("split", split, "a split that has clips")
    hashes = {entry["name"]: entry["sha256"] for entry in benchmark.manifest["clips"]}
    for clip in clips:
        if (
            not (clip.folder / CLIP_FILE).is_file()
            or WholeFile(clip.folder / CLIP_FILE).sha256() != hashes[clip.folder.name]
        ):
            raise SpecError("was changed or removed after the build (benchmark verify)", file=clip.folder / CLIP_FILE)
    given = None if predictions is None else Predictions(predictions, TASKS, {clip.folder.name for clip in clips})
    longer = _longer_exposures(clips) if "hdr" in (tasks or TASKS) else {}
    scores: list[Score] = []
    for done, clip in enumerate(clips):
        for name in tasks or TASKS:
            scores += TASKS[name](ClipTasks(clip, given, longer.get(clip.folder.name, ())))
        if progress is not None:
            progress(done + 1, len(clips), "clips")
    result = {
        "benchmark": benchmark.manifest["name"],
        "digest": digest_of(benchmark),
        "split": split or "all",
        "clips": len(clips),
        "unused": [] if given is None else given.unused,
        "summary": score_summary(scores),
        "verdicts": verdicts(scores, {clip.name for clip in clips if _is_ticked(clip)}),
        "scores": [vars(score) for score in scores],
    }
    if target is not None:
        write_whole(target, json.dumps(as_plain(result), indent=1) + "\n")
    return result


def _is_ticked(clip: BenchmarkClip) -> bool:
    """True if the event pixels of a clip compare at fixed ticks."""
    evs = clip.recording.manifest["sensor"]["spec"].get("evs")
    return evs is not None and evs["reference"] == "previous_sample"


def _longer_exposures(clips: Sequence[BenchmarkClip]) -> dict[str, list[BenchmarkClip]]:
    """Clips that differ in their exposure only: those of longer ones, in order, by the name of that of the shortest."""
    alike: dict[tuple[Any, ...], list[BenchmarkClip]] = {}
    for clip in clips:
        content = clip.content
        if content.get("exposure_us") is not None:
            key = tuple(content[name] for name in ("scene", "motion", "light", "sensor", "noise", "seed"))
            alike.setdefault(key, []).append(clip)
    result = {}
    for group in alike.values():
        first, *others = sorted(group, key=lambda clip: clip.content["exposure_us"])
        if others:
            result[first.folder.name] = others
    return result


def score_summary(scores: Sequence[Score]) -> Summary:
    """Mean, standard deviation and number of the finite values of each measure, by task and method.

    Parameters
    ----------
    scores : of clips and their items, each of which counts once.
    """
    values: dict[tuple[str, str, str], list[float]] = {}
    for score in scores:
        for name, value in score.values.items():
            values.setdefault((score.task, score.method, name), []).append(value)
    result: Summary = {}
    for (task, method, name), given in values.items():
        finite = np.array([value for value in given if np.isfinite(value)])
        entry: dict[str, float] = {"count": len(finite)}
        if len(finite):
            entry |= {"mean": float(finite.mean()), "std": float(finite.std())}
        result.setdefault(task, {}).setdefault(method, {})[name] = entry
    return result


def score_table(result: Summary) -> str:
    """The means as a text table, one block for each task."""
    lines = []
    for task, methods in result.items():
        names = list(dict.fromkeys(name for values in methods.values() for name in values))
        lines.append(f"{task:<20}" + "".join(f"{name:>15}" for name in names))
        for method, values in methods.items():
            cells = [values[name].get("mean") if name in values else None for name in names]
            lines.append(f"  {method:<18}" + "".join(f"{'–' if c is None else f'{c:.4g}':>15}" for c in cells))
    return "\n".join(lines)


def verdicts(scores: Sequence[Score], ticked: Collection[str] = ()) -> list[str]:
    """One sentence for each method that is worse than doing nothing, over the items that both have.

    Parameters
    ----------
    scores : of clips and their items.
    ticked : clips whose event pixels compare at fixed ticks.
    """
    result = []
    for task, (nothing, measure, way) in NOTHING.items():
        own = [score for score in scores if score.task == task]
        idle = _values(own, nothing, measure)
        for method in dict.fromkeys(score.method for score in own if score.method != nothing):
            values = _values(own, method, measure)
            both = [item for item in values if item in idle]
            if not both:
                continue
            pairs = np.array([(values[item], idle[item]) for item in both])
            gain = way * (pairs[:, 0] - pairs[:, 1])
            if gain.mean() >= 0:
                continue
            mean = pairs.mean(axis=0)
            least, below = _WHY_BELOW.get(task, (-np.inf, ""))
            why = below if mean[1] < least else _WHY[task]
            text = (
                f"{task}: {method} loses to doing nothing ({nothing}): {measure} {mean[0]:.4g} in place of "
                f"{mean[1]:.4g}, worse in {np.count_nonzero(gain < 0)} of {gain.size} items. Why: "
                f"{why.format(nothing=mean[1])}"
            )
            of_ticks = sum(clip in ticked for clip, _ in both)
            if method in _INTEGRALS and of_ticks:
                text += (
                    f"; {of_ticks} of the items are of pixels with a fixed tick, whose events do not say by how much "
                    "the light changed"
                )
            result.append(text)
    return result


def _values(scores: Sequence[Score], method: str, measure: str) -> dict[tuple[str, int], float]:
    """The finite values of a measure, by clip and item."""
    return {
        (score.clip, score.item): score.values[measure]
        for score in scores
        if score.method == method and np.isfinite(score.values.get(measure, np.nan))
    }
