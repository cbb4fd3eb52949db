"""A worker process: takes units of work from its standard input, one line each, and answers with one line each.

A worker of dask calls `attempt`. Errors travel as text, because exceptions with several arguments cannot be pickled.

Which GPU a worker uses: each process on a machine takes one of its own, as long as there are enough.
"""

import contextlib
import fcntl
import functools
import json
import os
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Mapping, MutableMapping, Sequence
from pathlib import Path
from typing import Any

from hesim_render import __version__
from hesim_render.benchmark.clip import build_clip, render_span
from hesim_render.benchmark.plan import BenchmarkPlan
from hesim_render.benchmark.spans import Unit
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


VISIBLE = "CUDA_VISIBLE_DEVICES"
_NVIDIA = Path("/proc/driver/nvidia/gpus")
#: Locks that this process holds, for as long as it lives.
_held: list[int] = []


def devices_of(environment: Mapping[str, str], gpus: Path = _NVIDIA) -> list[str]:
    """Names of the GPUs that a process may use: those that the environment lists, else all of the machine.

    Parameters
    ----------
    environment : with ``CUDA_VISIBLE_DEVICES``, where that is set.
    gpus : folder in which the driver has an entry for each GPU.
    """
    given = environment.get(VISIBLE)
    if given is not None:
        return [name.strip() for name in given.split(",") if name.strip()]
    return [str(k) for k in range(len(list(gpus.iterdir())))] if gpus.is_dir() else []


def claim_device(
    environment: MutableMapping[str, str] = os.environ, gpus: Path = _NVIDIA, locks: Path | None = None
) -> str | None:
    """Take a GPU that no other worker of this machine has, and make it the only visible one.

    It must be called before anything has looked for GPUs. A lock on a file marks a GPU as taken and ends with the
    process, however it ends. Where all are taken, processes share them evenly by their numbers.

    Parameters
    ----------
    environment : in which the GPU is set.
    gpus : see `devices_of`.
    locks : folder of the lock files; default the system's temporary one.

    Returns
    -------
    Name of the GPU; None where there is none or only one.
    """
    devices = devices_of(environment, gpus)
    if len(devices) < 2:
        return None
    folder = locks or Path(tempfile.gettempdir())
    chosen = devices[os.getpid() % len(devices)]
    for device in devices:
        name = "".join(c if c.isalnum() else "-" for c in device)
        try:
            handle = os.open(folder / f"hesim_render-{os.getuid()}-gpu-{name}.lock", os.O_CREAT | os.O_RDWR, 0o600)
        except OSError:
            continue
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(handle)
            continue
        _held.append(handle)
        chosen = device
        break
    environment[VISIBLE] = chosen
    return chosen
