"""Verification of a benchmark by its hashes: nothing is missing, changed or added, and splits share no part."""

import hashlib
import shutil
from collections.abc import Sequence
from pathlib import Path

from hesim_render.benchmark.clip import CLIP_FILE
from hesim_render.benchmark.folder import MANIFEST_FILE, PLAN_FILE, Benchmark, read_clip
from hesim_render.benchmark.plan import shared_parts
from hesim_render.core.errors import HesimError
from hesim_render.core.guard import WholeFile
from hesim_render.core.output import output_errors
from hesim_render.core.progress import Progress


def verify_benchmark(root: str | Path, progress: Progress | None = None) -> list[str]:
    """Compare every file of a benchmark with its manifest.

    Parameters
    ----------
    root : folder of the benchmark.
    progress : called with (done, total, what).

    Returns
    -------
    A line for each file that is missing, changed or unexpected, and for each part that splits share; empty if all is
    as it was built.

    Raises
    ------
    SpecError
        If the folder is no finished benchmark.
    """
    benchmark = Benchmark(root)
    problems: list[str] = []
    parts: dict[str, tuple[str, set[str]]] = {}
    entries = benchmark.manifest["clips"]
    for done, (entry, clip) in enumerate(zip(entries, benchmark.clips(), strict=True)):
        if progress is not None:
            progress(done, len(entries), "clips")
        file = clip.folder / CLIP_FILE
        if not file.is_file():
            problems.append(f"{entry['name']}: is missing")
            continue
        if WholeFile(file).sha256() != entry["sha256"]:
            problems.append(f"{entry['name']}/{CLIP_FILE}: was changed")
            continue
        try:
            content = read_clip(clip.folder)
        except HesimError as error:
            problems.append(str(error))
            continue
        parts[content["name"]] = (content["split"], set(content["parts"]))
        problems += [f"{entry['name']}/{line}" for line in _files(clip.folder, content["files"])]
    plan, expected = benchmark.root / PLAN_FILE, benchmark.manifest.get("plan_sha256")
    if not plan.is_file() or WholeFile(plan).sha256() != expected:
        problems.append(f"{PLAN_FILE}: was changed, or is missing")
    known, folder = {entry["name"] for entry in entries}, benchmark.root / "clips"
    listed = folder.iterdir() if folder.is_dir() else ()
    present = {path.name for path in listed if not path.name.startswith(".")}
    problems += [f"{name}: is not in the manifest" for name in sorted(present - known)]
    problems += [
        f"the splits {first} and {second} share the part {part}" for part, first, second in shared_parts(parts)
    ]
    return problems


def discard_damaged(root: str | Path, problems: Sequence[str]) -> list[str]:
    """Remove the clips in which something is wrong, so that the next build makes them again; returns their names.

    The manifest is removed as well, because the set is not whole then. Folders that are no clips are left alone.

    Parameters
    ----------
    root : folder of the benchmark.
    problems : from `verify_benchmark`.
    """
    benchmark = Benchmark(root)
    wrong = {line.split(":")[0].split("/")[0] for line in problems}
    result = [clip.folder for clip in benchmark.clips() if clip.folder.name in wrong]
    if result:
        with output_errors(benchmark.root):
            (benchmark.root / MANIFEST_FILE).unlink()
            for folder in result:
                shutil.rmtree(folder, ignore_errors=not folder.exists())
    return [folder.name for folder in result]


def _files(folder: Path, files: dict[str, dict[str, object]]) -> list[str]:
    """What is wrong with the files of a clip."""
    problems = []
    for name, entry in files.items():
        path = folder / name
        if not path.resolve().is_relative_to(folder.resolve()) or not path.is_file():
            problems.append(f"{name}: is missing")
        elif path.stat().st_size != entry["bytes"] or WholeFile(path).sha256() != entry["sha256"]:
            problems.append(f"{name}: was changed")
    present = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir()}
    return problems + [f"{name}: is not in the manifest" for name in sorted(present - set(files) - {CLIP_FILE})]


def digest_of(benchmark: Benchmark) -> str:
    """One SHA-256 for a whole benchmark: that of its manifest, which names the hash of every clip."""
    text = "".join(f"{entry['name']} {entry['sha256']}\n" for entry in benchmark.manifest["clips"])
    return hashlib.sha256(text.encode()).hexdigest()
