"""Hidden scenes by seed: is no more wrong than the audit of each run says?

Scenes with what is small, thin, fast or seen for a moment only (`tests/support/hidden_scenes.py`). The truth is every
pair of a pixel and a tick, traced with many rays of other random numbers. One line of JSON a run is appended to the
file; a run that is in it already is not made again.

    python benchmarks/hidden_scenes.py run --seeds 0:100 [--scenes "fan;fast ball"]
    python benchmarks/hidden_scenes.py judge

The file is `results/hidden_scenes.jsonl`, unless `--out` or an argument names another one; each line names the commit
that was run.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

import hidden_scenes
import records
from hidden_checks import not_held, pooled, record_of, run_of

RESULTS = Path(__file__).parent / "results" / "hidden_scenes.jsonl"


def run(scenes: list[str], seeds: range, out: Path) -> None:
    """Append a record for each scene and seed that has none."""
    commit = records.commit()
    import drjit as dr

    dr.set_thread_count(1)
    done = {(one["scene"], one["seed"]) for one in records.read(out)}
    for name in scenes:
        for seed in seeds:
            if (name, seed) in done:
                continue
            start = time.process_time()
            record = {"scene": name, "seed": seed, **record_of(name, seed), "commit": commit}
            run_of.cache_clear()
            record["cpu_s"] = round(time.process_time() - start, 1)
            records.append(out, record)
            print(*record.values(), flush=True)


def report(path: Path) -> int:
    """Print what each scene has wrong. Returns 1 if a limit is not met, see `hidden_checks.not_held`."""
    failed = False
    for name in hidden_scenes.SCENES:
        runs = [one for one in records.read(path) if one["scene"] == name]
        if not runs:
            continue
        print(f"{name}: {len(runs)} runs, {sum(one['true'] for one in runs):.0f} true events", end="")
        for kind, of in (("missed", "true"), ("extra", "in_run")):
            most = max(one[kind][0] for one in runs)
            print(f"; {100 * pooled(runs, kind, of):.2f} % {kind}, at most {100 * most:.2f} % in a run", end="")
        broken = sum(any(one[kind][0] > one[kind][1] for kind in ("missed", "extra")) for one in runs)
        print(f"; {broken} runs have more wrong than told")
        for line in not_held(runs):
            failed = True
            print(f"  does not hold: {line}")
    print("something does not hold" if failed else "all holds")
    return int(failed)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(required=True, dest="command")
    making = commands.add_parser("run")
    making.add_argument("--seeds", default="0:100", help="first:last, without the last")
    making.add_argument("--scenes", default=";".join(hidden_scenes.SCENES), help="names, with ; between")
    making.add_argument("--out", type=Path, default=RESULTS)
    judging = commands.add_parser("judge")
    judging.add_argument("results", type=Path, nargs="?", default=RESULTS)
    options = parser.parse_args()
    if options.command == "judge":
        return report(options.results)
    first, last = map(int, options.seeds.split(":"))
    run(options.scenes.split(";"), range(first, last), options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
