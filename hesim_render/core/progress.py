"""Progress of a run: a bar on a terminal or in a notebook, occasional lines anywhere else."""

import contextlib
import html
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, Literal, TextIO

from hesim_render.core.guard import printable

#: Called with (done, total, what): µs of simulated time, or rays while a static scene renders.
Progress = Callable[[float, float, str], None]

#: A run that takes this many times its estimate prints a note.
LATE = 2.0
_LEAST_LATE_S = 10.0  # shorter runs print no note
#: Until this part of a phase is done, the remaining time also uses the estimate, as the first steps compile kernels.
_SETTLED = 0.2
_LEAST_DONE = 0.01
_REFRESH_S = 0.5
#: Without a terminal: seconds to the first line, growth of the interval per line, longest interval.
_FIRST_LINE_S, _GROWTH, _LONGEST_S = 30.0, 2.0, 600.0
#: The same where an answer is expected at once.
SOON_S = 2.0


class Pace:
    """Speed of a run, and its remaining time.

    A run has phases, each with its own `what`. The remaining time is that of the current phase.

    Parameters
    ----------
    clock : returns seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._begin_s = self._phase_begin_s = clock()
        self._expected_at_s = self._moved_s = self._begin_s
        self.estimate_s: float | None = None
        self.what = ""
        self.fraction = 0.0
        self._is_announced = False

    @property
    def elapsed_s(self) -> float:
        """Time since the run began, s."""
        return self._clock() - self._begin_s

    def expect(self, seconds: float | None) -> None:
        """Set the estimated time of the run from now on, s; None where there is none."""
        self.estimate_s = seconds
        self._expected_at_s = self._moved_s = self._clock()

    def move(self, done: float, total: float, what: str) -> None:
        now = self._clock()
        if what != self.what:  # progress of a new phase counts from the last report of the previous phase
            self.what, self._phase_begin_s = what, now if done <= 0 else self._moved_s
        self._moved_s = now
        self.fraction = min(1.0, max(0.0, done / total)) if total > 0 else 0.0

    @property
    def remaining_s(self) -> float | None:
        """Seconds to the end of the phase; None while there is no information."""
        now = self._clock()
        by_estimate = None if self.estimate_s is None else self._expected_at_s + self.estimate_s - now
        if by_estimate is not None and by_estimate < 0:
            by_estimate = None  # the estimate was wrong
        if self.fraction < _LEAST_DONE:
            return by_estimate
        by_pace = (now - self._phase_begin_s) * (1 - self.fraction) / self.fraction
        if by_estimate is None:
            return by_pace
        weight = min(1.0, self.fraction / _SETTLED)
        return weight * by_pace + (1 - weight) * by_estimate

    def late_note(self) -> str | None:
        """A note about a run that takes `LATE` times its estimate; once, None before and after."""
        if self._is_announced or self.estimate_s is None:
            return None
        taken = self._clock() - self._expected_at_s
        if taken < max(LATE * self.estimate_s, _LEAST_LATE_S):
            return None
        self._is_announced = True
        return (
            f"takes longer than its estimate: {in_words(taken)} so far, estimated were {in_words(self.estimate_s)}; "
            + self.describe()
        )

    def describe(self) -> str:
        """Part done and remaining time, as text."""
        done = f"{100 * self.fraction:.0f} % of {self.what or 'the run'}"
        left = self.remaining_s
        return f"{done}, about {in_words(left)} left" if left is not None else done


def in_words(seconds: float) -> str:
    """A duration in words to about two figures: ``40 s``, ``12 min``, ``3.5 h``, ``4.2 days``."""
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    if seconds < 2 * 86400:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 86400:.1f} days" if seconds < 1e7 * 86400 else f"{seconds / 86400 / 365.25:.1g} years"


def counted(number: int, noun: str) -> str:
    """A number with its noun: ``1 clip``, ``2 clips``."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


class _View:
    """Display of the pace; this one shows nothing."""

    def show(self, pace: Pace) -> None:
        pass

    def say(self, text: str) -> None:
        pass

    def paused(self) -> contextlib.AbstractContextManager[Any]:
        return contextlib.nullcontext()

    def close(self) -> None:
        pass


class ProgressReport:
    """Shows the progress of a run while it is open; `simulate` takes it as `progress`.

    Its own thread updates the display and reports if the run takes `LATE` times its estimate, even while native code
    does not return.
    """

    def __init__(self, view: _View, pace: Pace | None = None) -> None:
        self._view, self.pace = view, pace or Pace()
        self._lock, self._closed = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._refresh, name="progress", daemon=True)

    def __call__(self, done: float, total: float, what: str) -> None:
        with self._lock:
            self.pace.move(done, total, what)

    def part(self, what: str, fraction: float) -> None:
        """Progress of work that states what it does and the fraction done, as calibrations do."""
        self(fraction, 1.0, what)

    def expect(self, seconds: float | None) -> None:
        """Set the estimated time of the run from now on, s; None where there is none."""
        with self._lock:
            self.pace.expect(seconds)

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        """Hide the display while other output is written."""
        with self._lock, self._view.paused():
            yield

    def _refresh(self) -> None:
        while not self._closed.wait(_REFRESH_S):
            with self._lock:
                if self._closed.is_set():
                    return
                self._step()

    def _step(self) -> None:
        note = self.pace.late_note()
        if note is not None:
            self._view.say(note)
        self._view.show(self.pace)

    def __enter__(self) -> "ProgressReport":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()
        self._view.close()
        self._thread.join(_REFRESH_S)


class _Lines(_View):
    """Occasional lines, for logs."""

    def __init__(self, title: str, stream: TextIO, first_s: float | None = None) -> None:
        self._title, self._stream = title, stream
        self._next_s = _FIRST_LINE_S if first_s is None else first_s

    def show(self, pace: Pace) -> None:
        now = pace.elapsed_s
        if now < self._next_s:
            return
        self.say(f"{pace.describe()}, {in_words(now)} so far")
        self._next_s = now + min(_LONGEST_S, (_GROWTH - 1) * now)

    def say(self, text: str) -> None:
        with contextlib.suppress(OSError, ValueError):  # a closed stream is no reason to end the run
            self._stream.write(f"{self._title}: {text}\n")
            self._stream.flush()


class _Bar(_View):
    """A bar that moves, on a terminal."""

    def __init__(self, title: str, stream: TextIO) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

        self._title = title
        columns = (
            TextColumn("{task.description}", markup=False), BarColumn(), TaskProgressColumn(),
            TextColumn("{task.fields[left]}"), TimeElapsedColumn(),
        )  # fmt: skip
        self._bar = Progress(*columns, console=Console(file=stream), transient=True, redirect_stdout=False)
        self._task = self._bar.add_task(title, total=None, left="")
        self._bar.start()

    def show(self, pace: Pace) -> None:
        left = pace.remaining_s
        self._bar.update(
            self._task, completed=pace.fraction, total=1.0 if pace.what else None,
            description=f"{self._title}: {pace.what}" if pace.what else self._title,
            left="" if left is None else f"{in_words(left)} left",
        )  # fmt: skip

    def say(self, text: str) -> None:
        self._bar.console.print(f"{self._title}: {text}", markup=False, highlight=False)

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        self._bar.stop()
        try:
            yield
        finally:
            self._bar.start()

    def close(self) -> None:
        self._bar.stop()


class _Notebook(_View):
    """A bar below the cell of a notebook."""

    def __init__(self, title: str) -> None:
        from IPython.display import HTML, display

        self._title, self._html, self._notes = title, HTML, ""
        self._handle = display(HTML(self._text(Pace())), display_id=True)

    def _text(self, pace: Pace) -> str:
        status = f"{self._title}: {pace.describe()}, {in_words(pace.elapsed_s)} so far"
        return f"<progress value='{pace.fraction:.3f}' max='1'></progress> {html.escape(status)}{self._notes}"

    def show(self, pace: Pace) -> None:
        self._handle.update(self._html(self._text(pace)))

    def say(self, text: str) -> None:
        self._notes += f"<br>{html.escape(text)}"

    def close(self) -> None:
        self._handle.update(self._html(self._notes.removeprefix("<br>")))


def silent_report() -> ProgressReport:
    """A report that shows nothing."""
    return ProgressReport(_View())


def in_notebook() -> bool:
    """True if this is a kernel of Jupyter."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return getattr(shell, "kernel", None) is not None


def progress_report(title: str, stream: TextIO | None = None, first_s: float | None = None) -> ProgressReport:
    """A report that suits the place where this runs.

    Parameters
    ----------
    title : title of the run.
    stream : default stderr.
    first_s : time until the first line where `stream` is no terminal, s; default 30 s.
    """
    target, title = sys.stderr if stream is None else stream, printable(title)
    if in_notebook():
        return ProgressReport(_Notebook(title))
    return ProgressReport(_Bar(title, target) if target.isatty() else _Lines(title, target, first_s))


def expect(progress: Progress | None, seconds: float | None) -> None:
    """Let a report know the estimated time of the run from now on, s; a function of a caller does not get it."""
    if isinstance(progress, ProgressReport):
        progress.expect(seconds)


@contextlib.contextmanager
def shown(progress: Progress | Literal[False] | None, title: str) -> Iterator[Progress | None]:
    """The `progress` of a caller; by default a bar in a notebook, and nothing elsewhere."""
    if progress is None and in_notebook():
        with progress_report(title) as report:
            yield report
        return
    yield progress or None
