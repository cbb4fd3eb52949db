"""Benchmarks: ``benchmark build``, ``verify``, ``evaluate``, ``export``, ``pack`` and ``peers``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hesim_render.cli.options import LONG_MINUTES, Overwrite, Yes, listed
from hesim_render.cli.terminal import complain, say
from hesim_render.core.errors import OutputError, RangeError, TooLongError
from hesim_render.core.progress import progress_report

if TYPE_CHECKING:
    from hesim_render.benchmark.forecast import BuildEstimate
    from hesim_render.core.progress import ProgressReport

app = typer.Typer(help="Build, verify and evaluate benchmarks of many clips.", no_args_is_help=True)
_Folder = Annotated[Path, typer.Argument(help="folder of a benchmark")]
_DIFFERENT = 1  # exit status of verify where a file differs, of peers where one of them fails


@app.command()
def build(
    spec: Annotated[Path, typer.Argument(help="YAML file of the benchmark")],
    out: Annotated[Path, typer.Option(help="folder to build in; a build that was stopped goes on")],
    workers: Annotated[int, typer.Option(help="processes on this machine; 0: this one alone")] = 1,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="dask.distributed scheduler, in place of --workers")
    ] = None,
    estimate: Annotated[bool, typer.Option(help="estimate time and size before the start")] = True,
    yes: Yes = False,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="change a key of the YAML file")
    ] = None,
) -> None:
    """Build all clips of a benchmark, with manifest and card."""
    from hesim_render.benchmark.build import build_benchmark, last_run
    from hesim_render.specs.benchmark import read_benchmark
    from hesim_render.specs.files import parse_override

    if scheduler is not None and workers != 1:
        raise RangeError("--workers", workers, "nothing beside --scheduler, whose workers build the clips")
    content = read_benchmark(spec, dict(map(parse_override, set_ or [])))
    with progress_report(content.name) as progress:
        built = build_benchmark(
            content, out, workers=workers, scheduler=scheduler, estimate=estimate,
            on_estimate=lambda expected: _estimated(expected, progress, workers, yes or scheduler is not None),
            progress=progress,
        )  # fmt: skip
    clips = built.manifest["clips"]
    splits = ", ".join(f"{sum(c['split'] == split for c in clips)} {split}" for split in ("train", "val", "test"))
    say(f"{len(clips)} clips ({splits})\n  {last_run(built.root)}")
    say(f"  in {built.root}\n  card: {built.root / 'README.md'}")


def _estimated(expected: BuildEstimate, progress: ProgressReport, workers: int, is_wanted: bool) -> None:
    """Print the estimate; refuse a long build that nobody has wanted."""
    with progress.paused():
        say(f"estimate: {expected}")
    seconds = expected.seconds / max(1, workers)
    if seconds > 60 * LONG_MINUTES and not is_wanted:
        raise TooLongError(
            "max_minutes", LONG_MINUTES,
            f"this build takes {expected}; one of more than {LONG_MINUTES} min has to be wanted: add --yes, or ask "
            "for fewer clips (--set clips=100), a shorter duration_s, or a larger quality",
        )  # fmt: skip
    progress.expect(seconds)


@app.command()
def verify(
    folder: _Folder,
    discard: Annotated[bool, typer.Option("--discard", help="remove damaged clips; build makes them again")] = False,
) -> None:
    """Compare every file of a benchmark with its SHA-256. Ends with status 1 where anything differs."""
    from hesim_render.benchmark.folder import Benchmark
    from hesim_render.benchmark.verify import digest_of, discard_damaged, verify_benchmark

    with progress_report(f"verify {folder.name}") as progress:
        problems = verify_benchmark(folder, progress)
    if problems:
        complain(*problems)
        if discard:
            removed = discard_damaged(folder, problems)
            say(f"removed {len(removed)} clips; 'benchmark build' makes them again")
        raise typer.Exit(_DIFFERENT)
    benchmark = Benchmark(folder)
    say(f"{len(benchmark.manifest['clips'])} clips are as they were built; digest {digest_of(benchmark)}")


@app.command()
def evaluate(
    folder: _Folder,
    split: Annotated[str, typer.Option(help="train, val, test or all")] = "test",
    tasks: Annotated[
        str | None,
        typer.Option(
            metavar="TASK,TASK…", help="deblur, interpolate, denoise, fidelity, flow, intensity, hdr; default all"
        ),
    ] = None,
    predictions: Annotated[
        Path | None, typer.Option(help="folder of your own results, TASK/CLIP/000000.npy, scored beside the baselines")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="JSON file of all single values")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Measure the baselines of each task, and your own results, on the clips of a split."""
    from hesim_render.benchmark.evaluate import evaluate_benchmark, table

    if out is not None and out.exists() and not overwrite:
        raise OutputError(f"{out} exists; use --overwrite to replace it")
    with progress_report(f"evaluate {folder.name}") as progress:
        result = evaluate_benchmark(
            folder, split=None if split == "all" else split, tasks=listed(tasks), predictions=predictions, out=out,
            progress=progress,
        )  # fmt: skip
    say(f"{result['clips']} clips of {result['benchmark']}, split {result['split']}")
    say(table(result["summary"]) or "no clip has what these tasks need")
    for name in result["unused"]:
        complain(f"{name}: belongs to no item that was scored")
    if out is not None:
        say(f"in {out}")


@app.command()
def export(
    folder: _Folder,
    layout: Annotated[str, typer.Option(help="hs-ergb, bs-ergb, highrev, efnet or raw-npz")],
    out: Annotated[Path, typer.Option(help="folder to write")],
    overwrite: Overwrite = False,
) -> None:
    """Write a benchmark in the layout that another program loads."""
    from hesim_render.benchmark.layouts import export_benchmark

    with progress_report(f"{folder.name} → {layout}") as progress:
        count = export_benchmark(folder, layout, out, overwrite=overwrite, progress=progress)
    say(f"{count} pictures in {out}")


@app.command()
def pack(
    folder: _Folder,
    out: Annotated[str, typer.Option(help="folder, or an address that fsspec knows, such as s3://bucket/set")],
    format_: Annotated[str, typer.Option("--format", help="webdataset (tar) or hdf5")] = "webdataset",
    shard_mb: Annotated[float, typer.Option(help="size at which a shard is closed, MB")] = 256.0,
    overwrite: Overwrite = False,
) -> None:
    """Write the samples of a benchmark into a few large files for training, each checked after it is there."""
    from hesim_render.benchmark.shards import pack_benchmark, verify_shards

    with progress_report(f"{folder.name} → {out}") as progress:
        count = pack_benchmark(
            folder, out, format=format_, shard_mb=shard_mb, overwrite=overwrite, progress=progress
        )  # fmt: skip
        problems = verify_shards(out, progress)
    if problems:
        complain(*problems)
        raise typer.Exit(_DIFFERENT)
    say(f"{count} samples in {out}")


@app.command()
def peers(
    spec: Annotated[Path, typer.Argument(help="YAML file of the comparison")],
    out: Annotated[Path | None, typer.Option(help="JSON file of the result")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="change a key of the YAML file")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Compare our sensor and other event simulators in the same light. Ends with status 1 where one of them fails."""
    from hesim_render.benchmark.peers import compare_peers, peers_table
    from hesim_render.specs.files import parse_override
    from hesim_render.specs.peers import read_peers

    if out is not None and out.exists() and not overwrite:
        raise OutputError(f"{out} exists; use --overwrite to replace it")
    content = read_peers(spec, dict(map(parse_override, set_ or [])))
    with progress_report(content.name) as progress:
        result = compare_peers(content, out, progress)
    say(peers_table(result))
    if out is not None:
        say(f"in {out}")
    if any("failed" in told for told in result["peers"].values()) or any("error" in row for row in result["rows"]):
        raise typer.Exit(_DIFFERENT)
