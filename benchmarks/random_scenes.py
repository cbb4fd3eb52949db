"""Random scenes in the default mode: is each run as right as its manifest says?

Scenes by seed, none of which chose any constant, are simulated with their audit. Some pixels of each are rendered by
Mitsuba's own integrators. That takes about a minute of one core a scene. One line of JSON a scene is appended to the
file, and a scene that is in it already is not run.

    python benchmarks/random_scenes.py run --seeds 2000:2500
    python benchmarks/random_scenes.py judge

The file is `results/random_scenes.jsonl`, unless `--out` or an argument names another one; each line names the commit
that was run. Run it in several processes with seeds and files of their own. `judge` prints counts and bounds, and what
does not hold.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

import records
from random_checks import judge, judged_run
from random_scenes import small_scene

RESULTS = Path(__file__).parent / "results" / "random_scenes.jsonl"


def run(seeds: range, out: Path) -> None:
    """Append a record for each seed that has none."""
    commit = records.commit()
    import drjit as dr

    dr.set_thread_count(1)
    done = {one["seed"] for one in records.read(out)}
    for seed in seeds:
        if seed in done:
            continue
        start = time.process_time()
        with tempfile.TemporaryDirectory() as folder:
            record = judged_run(small_scene(seed, Path(folder)))
        record |= {"commit": commit, "cpu_s": round(time.process_time() - start, 1)}
        records.append(out, record)
        print(seed, record["verdict"], record["off"], record["missed"], record["extra"], record["cpu_s"], flush=True)


def report(path: Path) -> int:
    """Print counts beside their bounds. Returns 1 if something does not hold."""
    runs = records.read(path)
    verdicts = [one["verdict"] for one in runs]
    print(f"{len(runs)} scenes; verdicts:", {name: verdicts.count(name) for name in sorted(set(verdicts))})
    for name in ("off", "missed", "extra"):
        rows = [one[name] for one in runs]
        count, total = sum(row[0] for row in rows), sum(row[1] for row in rows)
        allowed = sum(row[1] * row[2] for row in rows)
        share, bound = (value / max(total, 1) for value in (count, allowed))
        print(f"{name}: {count:.0f} of {total:.0f} ({share:.4f}); the bounds allow {bound:.4f}")
    exact = sum(one["values"]["exact"] for one in runs)
    mean = sum(one["values"]["mean"] * one["values"]["exact"] for one in runs) / max(exact, 1)
    print(f"mean deviation {mean:.4f} noise units; off by more than three wanted errors:"
          f" {sum(one['values']['off'] for one in runs)} of {exact}")  # fmt: skip
    wrong = judge(runs)
    print("\n".join(wrong) or "all holds")
    return 1 if wrong else 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("run")
    one.add_argument("--seeds", default="2000:2500", help="first:last, without the last")
    one.add_argument("--out", type=Path, default=RESULTS)
    commands.add_parser("judge").add_argument("file", type=Path, nargs="?", default=RESULTS)
    given = parser.parse_args()
    if given.command == "judge":
        sys.exit(report(given.file))
    run(range(*map(int, given.seeds.split(":"))), given.out)
