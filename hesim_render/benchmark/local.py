"""Worker processes on this machine: they take units of work one by one, and a dead one is replaced.

A pool of `concurrent.futures` ends with the first process that dies, and does not say at which unit it died.
"""

import contextlib
import json
import selectors
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import IO, Any

from hesim_render.benchmark.plan import Clip
from hesim_render.benchmark.spans import Span, Unit, Waiting
from hesim_render.core.bands import processors
from hesim_render.core.child import child_environment, python_command, with_package
from hesim_render.core.errors import BackendError, OutputError

#: A unit of work at which a worker dies so many times is given up, and so is its clip.
MOST_DEATHS = 3
_GRACE_S = 2.0
#: How a worker process is started.
COMMAND = python_command(with_package("from hesim_render.benchmark.worker import main; main()"))
#: Called with the answer for each unit of work as it comes.
OnAnswer = Callable[[dict[str, Any]], None]


@dataclass
class _Worker:
    process: subprocess.Popen[str]
    unit: Unit | None = None
    is_ready: bool = False

    @property
    def answers(self) -> IO[str]:
        assert self.process.stdout is not None
        return self.process.stdout

    def send(self, text: str) -> None:
        assert self.process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # its death is seen at its answers
            self.process.stdin.write(text + "\n")
            self.process.stdin.flush()


class LocalWorkers:
    """Processes that build clips.

    Parameters
    ----------
    order : from `order_of`.
    count : number of processes.
    """

    def __init__(self, order: str, count: int) -> None:
        self._order, self._count = order, count
        #: Threads of the renderer in each: the processors are divided among them.
        self._threads = max(1, processors() // count)
        self._waits = selectors.DefaultSelector()
        self._workers: list[_Worker] = []

    def _start(self) -> _Worker:
        process = subprocess.Popen(
            COMMAND, env=child_environment(),
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, encoding="utf-8", start_new_session=True,
        )  # fmt: skip
        worker = _Worker(process)
        worker.send(f"{self._order}\n{self._threads}")
        self._workers.append(worker)
        self._waits.register(worker.answers, selectors.EVENT_READ, worker)
        return worker

    def run(self, clips: Sequence[Clip], on_answer: OnAnswer, spans: Sequence[Span] = ()) -> dict[str, str]:
        """Build clips.

        Parameters
        ----------
        clips : in the order in which they are begun.
        on_answer : called with each answer of a worker (`attempt`).
        spans : of every clip, whose light is rendered span by span before the clip is built.

        Returns
        -------
        Why a clip could not be built, by its name; empty if all are there.

        Raises
        ------
        OutputError
            If a clip cannot be written, as when the disk is full; the finished clips stay.
        BackendError
            If workers cannot start.
        """
        waiting, deaths, failed = Waiting(clips, spans), dict[Unit, int](), dict[str, str]()

        def fail(unit: Unit, answer: dict[str, Any]) -> None:
            failed.setdefault(answer["name"], answer["error"])
            waiting.drop(unit.clip)
            on_answer(answer)

        try:
            for _ in range(min(self._count, len(waiting))):
                self._start()
            while self._workers:
                for key, _ in self._waits.select():
                    worker: _Worker = key.data
                    line = worker.answers.readline()
                    if not line:
                        unit, status = worker.unit, self._remove(worker)
                        if not worker.is_ready:
                            raise BackendError(f"a worker of the benchmark could not start (status {status})")
                        if unit is not None:
                            deaths[unit] = deaths.get(unit, 0) + 1
                            if unit.clip.name in failed:
                                pass
                            elif deaths[unit] >= MOST_DEATHS:
                                cause = f"signal {-status}" if status < 0 else f"exit status {status}"
                                error = f"its worker died {MOST_DEATHS} times (last: {cause})"
                                error = error if unit.span is None else f"{unit}: {error}"
                                fail(unit, {"name": unit.clip.name, "error": error})
                            else:
                                waiting.again(unit)
                        if waiting:
                            self._start()
                        self._give_all(waiting)
                        continue
                    answer = json.loads(line)
                    if "ready" in answer:
                        worker.is_ready = True
                    else:
                        assert worker.unit is not None
                        unit, worker.unit = worker.unit, None
                        waiting.done(unit)
                        if "error" not in answer:
                            on_answer(answer)
                        else:
                            fail(unit, answer)
                            if answer.get("fatal"):
                                raise OutputError(answer["error"])
                    self._give_all(waiting)
        finally:
            self._end()
        return failed

    def _give_all(self, waiting: Waiting) -> None:
        """The next unit for each worker that has none. Where nothing waits, the worker ends; where all that waits has
        to, so does the worker.
        """
        for worker in [worker for worker in self._workers if worker.is_ready and worker.unit is None]:
            worker.unit = waiting.take()
            if worker.unit is not None:
                worker.send(json.dumps(worker.unit.as_dict()))
            elif not waiting:
                self._remove(worker)

    def _remove(self, worker: _Worker) -> int:
        self._waits.unregister(worker.answers)
        self._workers.remove(worker)
        assert worker.process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            worker.process.stdin.close()
        worker.answers.close()
        return worker.process.wait()

    def _end(self) -> None:
        """End the workers that still run; their unfinished clips leave nothing."""
        for worker in self._workers:
            worker.process.terminate()
        for worker in self._workers:
            try:
                worker.process.wait(_GRACE_S)
            except subprocess.TimeoutExpired:
                worker.process.kill()
                worker.process.wait()
        self._workers.clear()
        self._waits.close()
