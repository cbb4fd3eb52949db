"""The exit statuses of all commands; ``docs/cli.md`` has the same table."""

from __future__ import annotations

from enum import IntEnum


class ExitStatus(IntEnum):
    """What a command ends with. A traceback with status 1 is a fault of this program."""

    DONE = 0
    DIFFERENT = 1
    REFUSED = 2
    NOT_MET = 3
    INTERRUPTED = 130
