"""How commands end: their exit statuses, of which ``docs/cli.md`` has the same table, and Ctrl-C.

Ctrl-C ends a run within two seconds, also in native code that does not return to Python.
"""

import os
import signal
import sys
import threading
from enum import IntEnum
from typing import Any

from hesim_render.core.output import discard_unfinished

#: Time for Python to end the run itself, s.
GRACE_S = 1.2
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class ExitStatus(IntEnum):
    """What a command ends with. A traceback with status 1 is a fault of this program."""

    DONE = 0
    DIFFERENT = 1
    REFUSED = 2
    NOT_MET = 3
    INTERRUPTED = 130


class Interrupts:
    """Handles SIGINT and SIGTERM alike, and remembers them, because a library may replace the exception by its own.

    Python runs its signal handlers between two of its own instructions, so a long call of native code would delay
    an interrupt. The C part of Python's handler, however, writes the signal's number into a pipe at once. A thread
    reads it there, waits `GRACE_S` for the main thread, then removes unfinished output and ends the process.

    Where the handler runs inside of a finaliser or of a callback of a weak reference, Python cannot pass its exception
    on: it would print a traceback and go on. Nothing is printed then, and the thread ends the process.
    """

    def __init__(self) -> None:
        self.happened = False
        self._before: dict[int, Any] = {}
        self._ended = threading.Event()
        self._tell_unraisable = sys.unraisablehook

    def _unraisable(self, about: Any) -> None:
        if not (self.happened and issubclass(about.exc_type, KeyboardInterrupt)):
            self._tell_unraisable(about)

    def _note(self, *_: Any) -> None:
        self.happened = True
        raise KeyboardInterrupt

    def __enter__(self) -> "Interrupts":
        self._reading, self._writing = os.pipe()
        os.set_blocking(self._writing, False)
        self._wakeup_before = signal.set_wakeup_fd(self._writing, warn_on_full_buffer=False)
        threading.Thread(target=self._watch, name="interrupts", daemon=True).start()
        for number in _SIGNALS:
            if signal.getsignal(number) is not signal.SIG_IGN:
                self._before[number] = signal.signal(number, self._note)
        self._tell_unraisable, sys.unraisablehook = sys.unraisablehook, self._unraisable
        return self

    def _watch(self) -> None:
        while received := os.read(self._reading, 64):
            if any(number in received for number in self._before):
                break
        else:
            os.close(self._reading)
            return
        if self._ended.wait(GRACE_S):
            os.close(self._reading)
            return
        discard_unfinished()
        show_cursor = "\x1b[?25h\r\x1b[2K" if sys.stderr.isatty() else ""
        os.write(2, f"{show_cursor}hesim-render: interrupted\n".encode())
        os._exit(ExitStatus.INTERRUPTED)

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        sys.unraisablehook = self._tell_unraisable
        for number, handler in self._before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._wakeup_before)
        os.close(self._writing)
