"""Time until the command line answers: processor time and time of the clock, s, the best of five.

python benchmarks/cli.py
"""

import os
import subprocess
import sys
import time

COMMANDS = ("--help", "simulate --help", "info scenes", "info sensors", "info names")


def best(command):
    runs = []
    for _ in range(5):
        before, clock = os.times(), time.perf_counter()
        subprocess.run([sys.executable, "-m", "hesim_render.cli", *command.split()], capture_output=True, check=True)
        after = os.times()
        process = after.children_user + after.children_system - before.children_user - before.children_system
        runs.append((process, time.perf_counter() - clock))
    return min(run[0] for run in runs), min(run[1] for run in runs)


def main():
    for command in COMMANDS:
        process, clock = best(command)
        print(f"hesim-render {command:18} {process:.2f} s of processor time, {clock:.2f} s")


if __name__ == "__main__":
    main()
