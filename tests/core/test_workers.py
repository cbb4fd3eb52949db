"""Worker processes answer calls in order, fail with one clear error, and end with the process that started them."""

import errno
import os
import signal
import subprocess
import time

import numpy as np
import pytest

from hesim_render.core.errors import BackendError
from hesim_render.core.workers import Workers, checked_processes

#: A worker that remembers numbers, sleeps, fails and gives arrays.
PROGRAM = """
import os, sys, time
import numpy as np
from hesim_render.core.workers import serve

kept = [float(sys.argv[2])]

def answer(name, *given):
    if name == "add":
        kept[0] += given[0]
        return kept[0]
    if name == "sleep":
        time.sleep(given[0])
    if name == "fail":
        raise ValueError("no such thing")
    if name == "ones":
        return np.full(given[0], 3.5, np.float32), given[1].sum()
    return os.getpid()

serve(answer)
"""


@pytest.fixture(scope="module")
def workers():
    with Workers(PROGRAM, 2, 3) as started:
        yield started


def is_alive(process_id):
    try:
        os.kill(process_id, 0)
    except ProcessLookupError:
        return False
    return True


def test_each_worker_keeps_its_own_state_and_answers_may_be_taken_in_any_order(workers):
    tickets = [workers.ask(number % 2, "add", 2.25 * (number + 1)) for number in range(6)]
    answers = {k: workers.answer(tickets[k]) for k in (4, 1, 0, 5, 2, 3)}
    # the second argument of the program, the number of threads, is where both begin
    assert [answers[k] for k in (0, 2, 4)] == [3 + 2.25, 3 + 2.25 * 4, 3 + 2.25 * 9]
    assert [answers[k] for k in (1, 3, 5)] == [3 + 2.25 * 2, 3 + 2.25 * 6, 3 + 2.25 * 12]
    assert workers.answer(workers.ask(0, "pid")) != workers.answer(workers.ask(1, "pid"))


def test_large_calls_and_answers_do_not_wait_for_each_other(workers):
    """Far more than a pipe holds goes in both directions before anybody takes an answer."""
    size = 3_000_000
    tickets = [workers.ask(0, "ones", size + k, np.full(size, k, np.int64)) for k in range(4)]
    for k, ticket in enumerate(tickets):
        values, total = workers.answer(ticket)
        assert values.shape == (size + k,) and values[-1] == 3.5 and total == size * k


def test_a_call_that_fails_says_why(capfd):
    with Workers(PROGRAM, 1, 1) as workers:
        workers.ask(0, "fail")
        later = workers.ask(0, "add", 1.5)
        with pytest.raises(BackendError, match="a worker process of the run failed: ValueError: no such thing"):
            workers.answer(later)
    assert "Traceback" in capfd.readouterr().err


def test_a_worker_that_is_killed_is_named():
    with Workers(PROGRAM, 2, 1) as workers:
        process_id = workers.answer(workers.ask(1, "pid"))
        ticket = workers.ask(1, "sleep", 60)
        os.kill(process_id, signal.SIGKILL)
        with pytest.raises(BackendError, match=r"has ended \(signal 9\); with fewer --workers"):
            workers.answer(ticket)
        with pytest.raises(BackendError, match="signal 9"):
            for _ in range(2):  # the first call may still find the pipe open
                workers.ask(1, "pid")


def test_processes_that_cannot_be_started_leave_none(monkeypatch):
    started, popen = [], subprocess.Popen

    def limited(*given, **named):
        if len(started) == 2:
            raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")
        started.append(popen(*given, **named))
        return started[-1]

    monkeypatch.setattr(subprocess, "Popen", limited)
    with pytest.raises(BackendError, match="3 worker processes cannot be started: Resource temporarily unavailable"):
        Workers(PROGRAM, 3, 2).ask(0, "pid")
    assert [process.poll() for process in started] == [-signal.SIGKILL] * 2


def test_numbers_of_processes_may_come_from_numpy():
    assert type(checked_processes(np.int64(5))) is int


def test_workers_end_with_the_run_and_without_it():
    with Workers(PROGRAM, 1, 1) as workers:
        process_id = workers.answer(workers.ask(0, "pid"))
        workers.ask(0, "sleep", 60)
    assert not is_alive(process_id)
    orphans = Workers(PROGRAM, 1, 1)
    process_id = orphans.answer(orphans.ask(0, "pid"))
    orphans.ask(0, "sleep", 60)
    # as if the run had been killed: it sends nothing more, and its end of the pipe is closed
    orphans._pipes[0].close()
    end = time.monotonic() + 20
    while orphans._processes[0].poll() is None and time.monotonic() < end:
        time.sleep(0.05)
    assert orphans._processes[0].returncode == 0
