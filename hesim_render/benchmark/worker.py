"""A worker process: takes units of work from its standard input, one line each, and answers with one line each.

A worker of dask calls `attempt`. Errors travel as text, because exceptions with several arguments cannot be pickled.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import signal
import sys
import threading
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hesim_render import __version__
from hesim_render.benchmark.clip import build_clip, render_span
from hesim_render.benchmark.devices import claim_device
from hesim_render.benchmark.plan import BenchmarkPlan
from hesim_render.benchmark.units import Unit
from hesim_render.core.errors import HesimError, OutputError
from hesim_render.core.output import discard_unfinished
from hesim_render.specs.benchmark import BenchmarkSpec

#: One clip at a time in a process, even if a scheduler gives it several threads.
_one_at_a_time = threading.Lock()


def order_of(spec: BenchmarkSpec, root: Path) -> str:
    """Everything that a worker needs to build clips of a benchmark, as one line of text."""
    content = {"spec": spec.model_dump(mode="json"), "folder": str(spec.folder.resolve()), "root": str(root)}
    return json.dumps({**content, "version": __version__}, sort_keys=True)


@functools.lru_cache(maxsize=4)
def _opened(order: str) -> tuple[BenchmarkPlan, Path, str]:
    content = json.loads(order)
    spec = BenchmarkSpec.model_validate(content["spec"]).model_copy(update={"folder": Path(content["folder"])})
    return BenchmarkPlan(spec), Path(content["root"]), content["version"]


@functools.cache
def _claimed() -> str | None:
    """The GPU of this process, chosen before the first clip."""
    return claim_device()


def attempt(order: str, unit: dict[str, Any], spans: Sequence[dict[str, Any]] = ()) -> dict[str, Any]:
    """Build a clip, or render a span of one, and tell what became of it.

    Parameters
    ----------
    order : from `order_of`.
    unit : fields of a `Unit`.
    spans : answers for the spans of the clip; one that failed is the answer for the clip as well.

    Returns
    -------
    ``name`` of the clip, and ``seconds`` and ``bytes``, or ``error`` and ``fatal`` (True where other clips would fail
    as well).
    """
    failed = [answer for answer in spans if "error" in answer]
    if failed:
        return dict(failed[0])
    with _one_at_a_time:
        _claimed()
        name = str(unit["name"])
        try:
            plan, root, version = _opened(order)
            if version != __version__:
                text = f"this worker has hesim_render {__version__}, and the build was started by {version}"
                return {"name": name, "error": text, "fatal": True}
            work = Unit.of(unit)
            if work.span is None:
                built = build_clip(plan, work.clip, root)
            else:
                built = render_span(plan, work.clip, work.span, root)
        except HesimError as error:
            return {"name": name, "error": str(error), "fatal": isinstance(error, OutputError)}
        except Exception as error:  # a fault of ours in one clip must not end the build of the others
            traceback.print_exc()
            return {"name": name, "error": f"{type(error).__name__}: {error}", "fatal": False}
        return {"name": name, "seconds": built.seconds, "bytes": built.bytes}


def _stop(*_: object) -> None:
    discard_unfinished()
    os._exit(128 + signal.SIGTERM)


def main() -> None:
    """Do units of work until the standard input ends, or nobody reads the answers any more."""
    with contextlib.suppress(BrokenPipeError):
        _work()
    discard_unfinished()
    os._exit(0)  # an orphan has nobody to tell what Python may find at its end


def _work() -> None:
    # unbuffered: what a buffer still held when nobody reads any more, Python would complain about at its end
    answers = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)  # what libraries print is no answer
    signal.signal(signal.SIGTERM, _stop)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that started this one decides

    def answer(content: dict[str, Any]) -> None:
        answers.write(json.dumps(content).encode("utf-8") + b"\n")

    _claimed()
    order = sys.stdin.readline()
    threads = int(sys.stdin.readline() or 0)
    if threads:
        import drjit as dr

        from hesim_render.core import backend

        backend.jit()
        dr.set_thread_count(threads)
    answer({"ready": True})
    for line in sys.stdin:
        answer(attempt(order.strip(), json.loads(line)))
