"""Child processes of Python, which run the package of their parent, and interrupts that wait."""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

_PACKAGE = Path(__file__).resolve().parents[1]
#: Imports the package from its file: the parent may have found it where the child does not look.
_IMPORT = """
import importlib.util, sys
spec = importlib.util.spec_from_file_location("{name}", {file!r})
sys.modules["{name}"] = module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
"""


def python_command(code: str, *arguments: str) -> tuple[str, ...]:
    """The command line that runs a program text in a new Python.

    Parameters
    ----------
    code : the program text.
    arguments : its ``sys.argv[1:]``.
    """
    return (sys.executable, "-P", "-c", code, *arguments)


def with_package(code: str) -> str:
    """A program text that may import this package, the one that runs now."""
    return _IMPORT.format(name=_PACKAGE.name, file=str(_PACKAGE / "__init__.py")) + code


def child_environment() -> dict[str, str]:
    """The environment for a child: paths of ``PYTHONPATH`` that are relative, or empty, lead to the working folder."""
    environment = dict(os.environ)
    paths = environment.pop("PYTHONPATH", "").split(os.pathsep)
    if kept := [path for path in paths if os.path.isabs(path)]:
        environment["PYTHONPATH"] = os.pathsep.join(kept)
    return environment


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
