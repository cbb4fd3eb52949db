"""The command line. Heavy modules are imported inside the commands, so that ``--help`` is fast."""

import os
import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from hesim_render.cli.exit_status import ExitStatus, Interrupts
from hesim_render.cli.options import in_options
from hesim_render.cli.terminal import complain, silence_stdout
from hesim_render.core.errors import HesimError, HesimWarning
from hesim_render.core.host_memory import keep_freed_memory
from hesim_render.core.output import discard_unfinished

#: Text in Dr.Jit's errors.
_OUT_OF_MEMORY = "out of memory"


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point.

    Exit status: `ExitStatus`; with 2 there is a line on stderr for each mistake of the user. If the reader of the
    output is gone (``| head``), a run continues to its end, and its status is unaffected.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    if arguments is None:
        keep_freed_memory()
    with Interrupts() as interrupts, warnings.catch_warnings():
        warnings.showwarning = _note(warnings.showwarning)
        status = _run(given, interrupts)
        if status == ExitStatus.INTERRUPTED:  # newer typer turns the exception into this status itself
            discard_unfinished()
            complain("interrupted")
            if arguments is None:
                _leave_at_once()
    sys.exit(status)


def _is_of_stdout(error: OSError) -> bool:
    """True if an error came from printing: the innermost of our own functions is one that prints."""
    own = Path(__file__).parents[1]
    files = [Path(frame.f_code.co_filename) for frame, _ in traceback.walk_tb(error.__traceback__)]
    inner = [file for file in files if file.is_relative_to(own)]
    return not inner or inner[-1] in (Path(__file__), Path(__file__).with_name("terminal.py"))


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
            complain(*in_options(error, program(), given).splitlines())
        elif isinstance(error, usage_error):
            complain(error.format_message().replace("Value error, ", ""))
        elif isinstance(error, OSError):
            silence_stdout()
            where = error.filename or ("standard output" if _is_of_stdout(error) else "a file cannot be written")
            complain(f"{where}: {error.strerror or error}")
        elif isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and _OUT_OF_MEMORY in str(error)):
            cause = (str(error).splitlines() or [""])[0][:200]
            complain(f"not enough memory{f' ({cause})' if cause else ''}; a smaller region (--roi) or file needs less")
        else:
            raise
        return ExitStatus.REFUSED
