"""Delayed interrupts: native libraries lose a KeyboardInterrupt that arrives while they are loaded."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Delay SIGINT and SIGTERM until the end of the block, if Python handles them.

    A KeyboardInterrupt during the import of a native extension turns into another exception, ends the process from
    C++, or is lost. Only the main thread receives signals; in other threads nothing is delayed.
    """
    held: list[tuple[int, FrameType | None]] = []
    handlers = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            before = signal.getsignal(number)
            if callable(before):
                handlers[number] = before
                signal.signal(number, lambda *arguments: held.append(arguments))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        if held:
            first, frame = held[0]
            handlers[signal.Signals(first)](first, frame)
