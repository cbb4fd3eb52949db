"""Run the command line and kill it at a chosen step of its work on files: ``killed.py STEP SIDE EXCHANGE ARGUMENT …``.

Steps are the calls that make, move or remove something in the folder it runs in, counted from 1; SIDE is ``before`` or
``after``. EXCHANGE ``no`` stands for a file system that cannot exchange two folders. Without as many steps the command
ends by itself.
"""

import os
import shutil
import signal
import sys

from hesim_render.core import output

STEPS = ("rename", "replace", "mkdir", "unlink", "rmdir")


def main(step, side, exchange, arguments):
    here, count, inside = os.getcwd(), 0, False

    def watched(call, first=0):
        def wrapper(*given, **named):
            nonlocal count, inside
            path = os.path.abspath(os.fspath(given[first])) if given else ""
            if inside or not isinstance(path, str) or not path.startswith(here):
                return call(*given, **named)
            count += 1
            inside = True  # what is done inside of a step is no step
            try:
                if count == step and side == "before":
                    os.kill(os.getpid(), signal.SIGKILL)
                return call(*given, **named)
            finally:
                if count == step and side == "after":
                    os.kill(os.getpid(), signal.SIGKILL)
                inside = False

        return wrapper

    for name in STEPS:
        setattr(os, name, watched(getattr(os, name)))
    shutil.rmtree = watched(shutil.rmtree)
    output._exchange = watched(output._exchange) if exchange == "yes" else lambda *_: False
    from hesim_render.cli import main as run

    run(arguments)


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2], sys.argv[3], sys.argv[4:])
