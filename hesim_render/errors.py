"""Every error a user can cause, one class per kind of cause.

The command line prints the message of a `HesimError` on one line and exits with status 2;
anything else that escapes is a bug of ours and keeps its traceback.
"""

from __future__ import annotations

from pathlib import Path


class HesimError(Exception):
    """Base of all errors with a message meant for the user."""


class SpecError(HesimError, ValueError):
    """A sensor file, scene file, spectrum or override is wrong.

    Parameters
    ----------
    message : what is wrong and what was expected.
    file : the file it is in, if any.
    line : 1-based line in that file, if known.
    key : dotted key inside the file (``aps.read_noise_e``), if known.
    """

    def __init__(
        self,
        message: str,
        *,
        file: str | Path | None = None,
        line: int | None = None,
        key: str | None = None,
    ) -> None:
        self.file, self.line, self.key = file, line, key
        where = str(file) if file is not None else ""
        if where and line is not None:
            where += f":{line}"
        parts = [part for part in (where, key) if part]
        super().__init__(": ".join([*parts, message]))


class RangeError(HesimError, ValueError):
    """An argument lies outside the range in which the model holds."""

    def __init__(self, name: str, value: object, expected: str) -> None:
        self.name, self.value, self.expected = name, value, expected
        super().__init__(f"{name} is {value!r}; expected {expected}")


class BackendError(HesimError, RuntimeError):
    """No Dr.Jit backend can run here; the message says what to install."""


class OutputError(HesimError, OSError):
    """A result could not be written; nothing half-written is left behind."""
