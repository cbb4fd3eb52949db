"""Worker processes on this machine that answer calls; each gets its calls in order, and keeps what it has built."""

import operator
import os
import queue
import signal
import subprocess
import sys
import threading
import traceback
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection, Pipe
from types import TracebackType
from typing import Any, NamedTuple

from hesim_render.core.child import child_environment, python_command, with_package
from hesim_render.core.errors import BackendError, RangeError

_GRACE_S = 2.0
#: Largest number of processes.
_MOST = 64


class Ticket(NamedTuple):
    """A call that was made, for its answer."""

    worker: int
    call: int


class Workers:
    """Processes that answer calls. They start with the first call; in a with statement they are ended at the end.

    Arguments and answers are pickled, and travel through a pipe that no other process has.

    Parameters
    ----------
    program : program text of a worker, which calls `serve`.
    count : number of processes.
    threads : of the renderer in each, the first argument of the program after the number of its pipe.

    Attributes
    ----------
    count : as given.
    """

    def __init__(self, program: str, count: int, threads: int) -> None:
        self.count, self._program, self._threads, self._calls = count, with_package(program), str(threads), 0
        self._processes: list[subprocess.Popen[bytes]] = []
        self._pipes: list[Connection] = []
        #: Calls that each worker has not answered, and answers that nobody has asked for.
        self._open: list[deque[int]] = [deque() for _ in range(count)]
        self._answers: dict[int, Any] = {}

    def _start(self) -> None:
        """Start all processes."""
        # linear algebra in each would take the processors of the others
        environment = {**child_environment(), "OPENBLAS_NUM_THREADS": "1"}
        for _ in range(self.count):
            own, theirs = Pipe()
            self._pipes.append(own)
            with theirs:
                command = python_command(self._program, str(theirs.fileno()), self._threads)
                # in a session of its own, so that an interrupt reaches the run alone, which then ends its workers
                process = subprocess.Popen(
                    command, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                    pass_fds=(theirs.fileno(),), start_new_session=True,
                )  # fmt: skip
            self._processes.append(process)

    def ask(self, worker: int, *call: Any) -> Ticket:
        """Make a call, and do not wait for its answer.

        Parameters
        ----------
        worker : number of the process.
        call : what the program of the worker takes.

        Raises
        ------
        BackendError
            If the processes cannot be started, or the worker has ended.
        """
        if not self._processes:
            try:
                self._start()
            except OSError as error:
                self.close()
                raise BackendError(f"{self.count} worker processes cannot be started: {error.strerror}") from None
        try:
            self._pipes[worker].send(call)
        except OSError:
            raise self._lost(worker) from None
        self._calls += 1
        self._open[worker].append(self._calls)
        return Ticket(worker, self._calls)

    def answer(self, ticket: Ticket) -> Any:
        """The answer to a call, once.

        Parameters
        ----------
        ticket : from `ask`.

        Raises
        ------
        BackendError
            If the worker has ended, or failed at this call or one before it.
        """
        while ticket.call not in self._answers:
            try:
                is_done, answer = self._pipes[ticket.worker].recv()
            except (EOFError, OSError):
                raise self._lost(ticket.worker) from None
            if not is_done:
                raise BackendError(f"a worker process of the run failed: {answer}")
            self._answers[self._open[ticket.worker].popleft()] = answer
        return self._answers.pop(ticket.call)

    def _lost(self, worker: int) -> BackendError:
        """The error for a worker that has ended."""
        process = self._processes[worker]
        with suppress(subprocess.TimeoutExpired):
            process.wait(_GRACE_S)
        status = process.returncode
        cause = f"signal {-status}" if status is not None and status < 0 else f"exit status {status}"
        return BackendError(
            f"a worker process of the run has ended ({cause}); with fewer --workers (workers) it takes less memory"
        )

    def close(self) -> None:
        """End the processes."""
        for pipe in self._pipes:
            pipe.close()
        for process in self._processes:
            process.kill()
        for process in self._processes:
            process.wait()

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()


def checked_processes(count: int) -> int:
    """A number of processes, also one of NumPy's integers, as an integer of Python.

    Raises
    ------
    RangeError
        If it is not whole, or out of range.
    """
    try:
        result = operator.index(count)
    except TypeError:
        result = 0
    if not 1 <= result <= _MOST:
        raise RangeError("workers", count, f"a whole number of processes, 1 to {_MOST}")
    return result


def serve(answer: Callable[..., Any]) -> None:
    """Answer the calls of the process that started this one, until that process closes the pipe or ends.

    Parameters
    ----------
    answer : called with what `Workers.ask` was given.
    """
    pipe: Connection = Connection(int(sys.argv[1]))
    calls: queue.SimpleQueue[tuple[Any, ...]] = queue.SimpleQueue()
    answers: queue.SimpleQueue[tuple[bool, Any]] = queue.SimpleQueue()

    # calls are read, and answers are sent, while others are worked on: no side waits for the other to read
    def read() -> None:
        with suppress(EOFError, OSError):
            while True:
                calls.put(pipe.recv())
        os._exit(0)

    def send() -> None:
        with suppress(OSError):  # that nobody reads any more is seen by the other thread
            while True:
                pipe.send(answers.get())

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that started this one decides
    for work in (read, send):
        threading.Thread(target=work, daemon=True).start()
    while True:
        call = calls.get()
        try:
            answers.put((True, answer(*call)))
        except Exception as error:  # the run says so
            traceback.print_exc()
            answers.put((False, f"{type(error).__name__}: {error}"))
