"""Benchmarks: ``benchmark build``, ``verify``, ``evaluate``, ``export`` and ``peers``."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hesim_render.cli.console import Console, DryRun, Json, Quiet, facts_of
from hesim_render.cli.exit_status import ExitStatus
from hesim_render.cli.options import LONG_MINUTES, FileKeys, HelpAll, Overwrite, Yes, listed
from hesim_render.cli.terminal import complain
from hesim_render.core.errors import RangeError, TooLongError, did_you_mean
from hesim_render.core.output import free_place
from hesim_render.core.progress import counted

if TYPE_CHECKING:
    from hesim_render.benchmark.forecast import BuildEstimate
    from hesim_render.core.progress import ProgressReport

app = typer.Typer(help="Build, verify and evaluate benchmarks of many clips.", no_args_is_help=True)
#: Formats of `export` that are a few large files.
_SHARDS = ("webdataset", "hdf5")
_Folder = Annotated[Path, typer.Argument(help="folder of a benchmark")]


@app.command()
def build(
    spec: Annotated[Path, typer.Argument(help="YAML file of the benchmark")],
    out: Annotated[Path, typer.Option(help="folder to build in; an interrupted build continues")],
    workers: Annotated[int, typer.Option(help="processes on this machine; 0: only this process")] = 1,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="dask.distributed scheduler, in place of --workers")
    ] = None,
    span: Annotated[
        float,
        typer.Option(metavar="SECONDS", help="several workers render longer clips in spans of this length; 0: never"),
    ] = 1.0,
    estimate: Annotated[bool, typer.Option(help="estimate time and size before the start")] = True,
    yes: Yes = False,
    set_: FileKeys = None,
    dry_run: DryRun = False,
    json_: Json = False,
    quiet: Quiet = False,
    help_all: HelpAll = False,
) -> None:
    """Build all clips of a benchmark, with manifest and card.

    Ends with status 3 where the audits find clips that are worse than the benchmark asks for.
    """
    from hesim_render.benchmark.build import build_benchmark, check_build, last_run, require_workers
    from hesim_render.recording.quality import is_short_of_wish, verdict_lines
    from hesim_render.specs.benchmark import read_benchmark
    from hesim_render.specs.files import parse_override

    if scheduler is not None and workers != 1:
        raise RangeError("--workers", workers, "nothing beside --scheduler, whose workers build the clips")
    require_workers(workers, span)
    content = read_benchmark(spec, dict(map(parse_override, set_ or [])))
    console = Console(json_, quiet, dry_run)
    if dry_run:
        with console.progress(content.name) as progress:
            total, missing, expected = check_build(content, out, progress)
        text = f"{counted(total, 'clip')}, {len(missing)} not yet built; nothing was written (--dry-run)"
        console.text("" if expected is None else f"estimate: {expected}")
        facts = {"dry_run": True, "clips": total, "missing": len(missing), "estimate": expected and facts_of(expected)}
        console.result(text, facts)
        return
    with console.progress(content.name) as progress:
        built = build_benchmark(
            content, out, workers=workers, scheduler=scheduler, span_s=span, estimate=estimate,
            on_estimate=lambda expected: _estimated(console, expected, progress, workers, yes or scheduler is not None),
            progress=progress,
        )  # fmt: skip
    clips = built.manifest["clips"]
    count = {split: sum(c["split"] == split for c in clips) for split in ("train", "val", "test")}
    splits = ", ".join(f"{number} {split}" for split, number in count.items())
    text = f"{counted(len(clips), 'clip')} ({splits})\n  {last_run(built.root)}\n  in {built.root}\n"
    card = built.root / "README.md"
    audits = {clip.name: clip.content["render"].get("audit") for clip in built.clips()}
    short = [name for name, audit in audits.items() if is_short_of_wish(audit)]
    console.result(
        "\n".join([f"{text}  card: {card}", *(f"  {line}" for line in verdict_lines(audits, "clips"))]),
        {"benchmark": built.root, "card": card, "clips": len(clips), "splits": count, "not_met": short},
        ExitStatus.NOT_MET if short else ExitStatus.DONE,
    )


def _estimated(
    console: Console, expected: "BuildEstimate", progress: "ProgressReport", workers: int, is_wanted: bool
) -> None:
    """Print the estimate; refuse a long build that nobody has wanted."""
    console.estimated(progress)(expected)
    seconds = expected.seconds / max(1, workers)
    if seconds > 60 * LONG_MINUTES and not is_wanted:
        raise TooLongError(
            "max_minutes", LONG_MINUTES,
            f"this build takes {expected}; to start one of more than {LONG_MINUTES} min, add --yes, or ask "
            "for fewer clips (--set clips=100), a shorter duration_s, or a larger quality",
        )  # fmt: skip
    progress.expect(seconds)


@app.command()
def verify(
    folder: _Folder,
    discard: Annotated[bool, typer.Option("--discard", help="remove damaged clips; build makes them again")] = False,
    json_: Json = False,
    quiet: Quiet = False,
    help_all: HelpAll = False,
) -> None:
    """Compare every file of a benchmark with its SHA-256.

    Ends with status 1 where anything differs.
    """
    from hesim_render.benchmark.folder import Benchmark
    from hesim_render.benchmark.verify import digest_of, discard_damaged, verify_benchmark

    console = Console(json_, quiet)
    with console.progress(f"verify {folder.name}") as progress:
        problems = verify_benchmark(folder, progress)
    if problems:
        complain(*problems)
        removed = discard_damaged(folder, problems) if discard else []
        text = f"removed {counted(len(removed), 'clip')}; 'benchmark build' makes them again" if discard else ""
        console.result(text, {"problems": problems, "removed": removed}, ExitStatus.DIFFERENT)
    benchmark = Benchmark(folder)
    count, digest = len(benchmark.manifest["clips"]), digest_of(benchmark)
    facts = {"problems": [], "clips": count, "digest": digest}
    console.result(f"{counted(count, 'clip')} as built; digest {digest}", facts)


@app.command()
def evaluate(
    folder: _Folder,
    split: Annotated[str, typer.Option(help="train, val, test or all")] = "test",
    tasks: Annotated[
        str | None,
        typer.Option(
            metavar="TASK,TASK…",
            help="deblur, interpolate, denoise, fidelity, flow, intensity, hdr, demosaic; default all",
        ),
    ] = None,
    predictions: Annotated[
        Path | None,
        typer.Option(help="folder of your own results, TASK/CLIP/000000.npy or .png, scored beside the baselines"),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="JSON file of all single values")] = None,
    overwrite: Overwrite = False,
    json_: Json = False,
    quiet: Quiet = False,
    help_all: HelpAll = False,
) -> None:
    """Score the baselines and your own results.

    On the clips of a split, for each task.
    """
    from hesim_render.benchmark.evaluate import evaluate_benchmark, score_table

    if out is not None:
        free_place(out, overwrite, (".json",))
    console = Console(json_, quiet)
    with console.progress(f"evaluate {folder.name}") as progress:
        result = evaluate_benchmark(
            folder, split=None if split == "all" else split, tasks=listed(tasks), predictions=predictions, out=out,
            progress=progress,
        )  # fmt: skip
    lines = [f"{counted(result['clips'], 'clip')} of {result['benchmark']}, split {result['split']}"]
    lines += [score_table(result["summary"]) or "no clip has what these tasks need", *result["verdicts"]]
    lines += [] if out is None else [f"in {out}"]
    for name in listed(tasks):
        if name not in result["summary"]:
            complain(f"{name}: no clip of this split has what it needs")
    for name in result["unused"]:
        complain(f"{name}: belongs to no item that was scored")
    facts = {name: result[name] for name in ("benchmark", "split", "clips", "summary", "verdicts", "unused")}
    console.result("\n".join(lines), {**facts, "values": out})


@app.command()
def export(
    folder: _Folder,
    format_: Annotated[
        str,
        typer.Option(
            "--format",
            help="layout that another program loads: hs-ergb, bs-ergb, highrev, efnet, raw-npz; a few large files for "
            "training: webdataset (tar), hdf5",
        ),
    ],
    out: Annotated[
        str, typer.Option(help="folder; of webdataset and hdf5 also an address of fsspec, such as s3://bucket/set")
    ],
    shard_mb: Annotated[
        float, typer.Option(help="size at which a file of webdataset or hdf5 is closed, MB", hidden=True)
    ] = 256.0,
    overwrite: Overwrite = False,
    json_: Json = False,
    quiet: Quiet = False,
    help_all: HelpAll = False,
) -> None:
    """Write a benchmark for another program, or training.

    In a layout that another program loads, or as a few large files.
    """
    from hesim_render.benchmark.layouts import LAYOUTS, export_benchmark
    from hesim_render.benchmark.shards import pack_benchmark, verify_shards

    known = (*LAYOUTS, *_SHARDS)
    if format_ not in known:
        raise RangeError("--format", format_, f"one of {', '.join(known)}{did_you_mean(format_, known)}")
    console = Console(json_, quiet)
    with console.progress(f"{folder.name} → {out}") as progress:
        if format_ in LAYOUTS:
            count = export_benchmark(folder, format_, Path(out), overwrite=overwrite, progress=progress)
            noun, problems = "pictures", []
        else:
            count = pack_benchmark(
                folder, out, format=format_, shard_mb=shard_mb, overwrite=overwrite, progress=progress
            )  # fmt: skip
            noun, problems = "samples", verify_shards(out, progress)
    facts = {"written": out, "format": format_, noun: count, "problems": problems}
    complain(*problems)
    text = "" if problems else f"{count} {noun} in {out}"
    console.result(text, facts, ExitStatus.DIFFERENT if problems else ExitStatus.DONE)


@app.command()
def peers(
    spec: Annotated[Path, typer.Argument(help="YAML file of the comparison")],
    out: Annotated[Path | None, typer.Option(help="JSON file of the result")] = None,
    set_: FileKeys = None,
    run_programs: Annotated[
        bool, typer.Option("--run-programs", help="let the programs run that the file names; read it before")
    ] = False,
    overwrite: Overwrite = False,
    json_: Json = False,
    quiet: Quiet = False,
    help_all: HelpAll = False,
) -> None:
    """Compare our sensor and other event simulators.

    In the same light. Ends with status 1 where one of them fails.
    """
    from hesim_render.benchmark.peers import compare_peers, peers_table
    from hesim_render.specs.files import parse_override
    from hesim_render.specs.peers import read_peers

    if out is not None:
        free_place(out, overwrite, (".json",))
    content = read_peers(spec, dict(map(parse_override, set_ or [])))
    console = Console(json_, quiet)
    with console.progress(content.name) as progress:
        result = compare_peers(content, out, progress, run_programs=run_programs)
    failed = any("failed" in peer for peer in result["peers"].values()) or any("error" in row for row in result["rows"])
    text = peers_table(result) if out is None else f"{peers_table(result)}\nin {out}"
    console.result(text, result, ExitStatus.DIFFERENT if failed else ExitStatus.DONE)
