"""The command line. Heavy modules are imported inside the commands, so that ``--help`` is fast."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from hesim_render.cli.exit_status import ExitStatus
from hesim_render.cli.interrupts import Interrupts
from hesim_render.cli.terminal import complain, silence_stdout
from hesim_render.core.errors import HesimError, HesimWarning
from hesim_render.core.output import discard_unfinished


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point.

    Exit status: `ExitStatus`; with 2 there is a line on stderr for each mistake of the user. If the reader of the
    output is gone (``| head``), a run continues to its end, and its status is unaffected.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    with Interrupts() as interrupts, warnings.catch_warnings():
        warnings.showwarning = _note(warnings.showwarning)
        status = _run(given, interrupts)
        if status == ExitStatus.INTERRUPTED:  # newer typer turns the exception into this status itself
            discard_unfinished()
            complain("interrupted")
            if arguments is None:
                _leave_at_once()
    sys.exit(status)


def _leave_at_once() -> None:
    """End the process without Python's own clearing up: native threads may still run kernels whose memory it frees."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(ExitStatus.INTERRUPTED)


def _note(otherwise: Callable[..., None]) -> Callable[..., None]:
    """Show warnings of this package on one line each, and other warnings as `otherwise` does."""

    def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
        if issubclass(category, HesimWarning):
            complain(f"note: {message}")
        else:
            otherwise(message, category, *where, **more)

    return show


def _run(given: list[str], interrupts: Interrupts) -> int:
    """The exit status of one command."""
    usage_error: Any = ()
    try:
        import typer

        from hesim_render.cli.commands import program

        # typer carries its own copy of click in newer versions; this is the base of its usage errors in all
        usage_error = next(kind for kind in typer.BadParameter.__mro__ if kind.__name__ == "ClickException")
        status = program()(args=given or ["--help"], standalone_mode=False)
        return status if isinstance(status, int) else 0
    except KeyboardInterrupt:
        return ExitStatus.INTERRUPTED
    except SystemExit as stop:
        if stop.code == 1:  # so typer ends where its own output, such as the help, meets a closed pipe
            silence_stdout()
            return 0
        raise
    except Exception as error:
        if interrupts.happened or type(error).__name__ == "Abort":
            return ExitStatus.INTERRUPTED
        if isinstance(error, HesimError):
            complain(*str(error).splitlines())
        elif isinstance(error, usage_error):
            complain(error.format_message().replace("Value error, ", ""))
        elif isinstance(error, OSError):
            silence_stdout()
            complain(f"{error.filename or 'standard output'}: {error.strerror or error}")
        else:
            raise
        return ExitStatus.REFUSED
