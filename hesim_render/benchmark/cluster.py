"""Clips on the workers of a dask.distributed scheduler."""

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from hesim_render.benchmark.plan import Clip
from hesim_render.benchmark.spans import Span, Unit
from hesim_render.benchmark.worker import attempt
from hesim_render.core.errors import BackendError, OutputError, RangeError, how_to_install

_PATIENCE_S = 10


def connected(address: str) -> Any:
    """A client of a scheduler.

    Raises
    ------
    RangeError
        If dask.distributed is not installed, or the scheduler does not answer.
    """
    try:
        from distributed import Client
        from distributed.comm.core import CommClosedError
    except ImportError:
        raise RangeError("--scheduler", address, f"dask.distributed: {how_to_install('cluster')}") from None
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # our own error names a lost scheduler
    try:
        return Client(address, timeout=_PATIENCE_S, set_as_default=False)
    except (OSError, ValueError, CommClosedError) as error:  # TimeoutError is an OSError
        reason = str(error) or type(error).__name__
        expected = f"the address of a running scheduler, such as tcp://10.0.0.1:8786 ({reason})"
        raise RangeError("--scheduler", address, expected) from None


def run_on_cluster(
    client: Any,
    order: str,
    clips: Sequence[Clip],
    on_answer: Callable[[dict[str, Any]], None],
    spans: Sequence[Span] = (),
) -> dict[str, str]:
    """Build clips on a cluster, whose workers see the folder of the benchmark under the same path.

    Parameters
    ----------
    client : from `connected`.
    order : from `order_of`.
    clips : what is built.
    on_answer : called with each answer (`attempt`).
    spans : of every clip; the clip comes after all of them.

    Returns
    -------
    Why a clip could not be built, by its name; empty if all are there.

    Raises
    ------
    OutputError
        If a clip cannot be written; the finished clips stay.
    BackendError
        If the scheduler is gone; the finished clips stay.
    """
    import distributed
    from distributed.scheduler import KilledWorker

    failed: dict[str, str] = {}
    futures = {}
    with _scheduler_is_there(client):
        for clip in clips:
            # the key is of this call: a result of an earlier build must not stand for this one
            parts: list[Any] = []
            for span in (*spans, None):
                given = (list(parts),) if span is None and spans else ()
                future = client.submit(attempt, order, Unit(clip, span).as_dict(), *given, pure=False, retries=0)
                futures[future.key] = (future, clip)
                parts.append(future)
    waiting = iter(distributed.as_completed([future for future, _ in futures.values()], loop=client.loop))
    while futures:
        with _scheduler_is_there(client):
            future = next(waiting)
            failure = future.exception()
            answer = None if failure is not None else future.result()
        clip = futures.pop(future.key)[1]
        if isinstance(failure, KilledWorker):
            answer = {"name": clip.name, "error": "its workers died again and again (dask: KilledWorker)"}
        elif answer is None:
            raise failure
        if clip.name not in failed:
            on_answer(answer)
        if "error" in answer:
            failed.setdefault(clip.name, answer["error"])
            if answer.get("fatal"):
                raise OutputError(answer["error"])
    return failed


@contextmanager
def _scheduler_is_there(client: Any) -> Iterator[None]:
    """Turn what a client raises without a scheduler into one `BackendError`: it gives its tasks up at any call."""
    from asyncio import CancelledError as Cancelled
    from concurrent.futures import CancelledError

    from distributed.comm.core import CommClosedError

    try:
        yield
    except Exception as error:
        kinds = (Cancelled, CancelledError, CommClosedError)
        if not isinstance(error, kinds) and getattr(client, "status", "running") == "running":
            raise
        raise _gone() from None
    except Cancelled:  # no Exception
        raise _gone() from None


def _gone() -> BackendError:
    return BackendError(
        "the scheduler is gone, or has given the clips up; the finished ones stay, and the same command with a running "
        "scheduler builds the others"
    )
