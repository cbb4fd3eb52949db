"""Names of options in errors that the Python API raised with the names of its arguments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hesim_render.core.errors import HesimError


def in_options(error: HesimError, program: Any, given: Sequence[str]) -> str:
    """The message of an error, with the option of the command in place of the argument of a function.

    Parameters
    ----------
    error : what was raised.
    program : all commands.
    given : the command line.

    Returns
    -------
    ``--filter is 'rde'; …`` for ``filter_name is 'rde'; …``. An argument without an option of its name, or with one as
    its begin or end, as ``duration_s``, keeps its name.
    """
    name, text = getattr(error, "name", None), str(error)
    if not isinstance(name, str) or not text.startswith(f"{name} is "):
        return text
    command = program
    for word in given:
        command = getattr(command, "commands", {}).get(word, command)
    options = {param.name.rstrip("_"): max(param.opts, key=len) for param in command.params if param.opts}
    fitting = [option for own, option in options.items() if own == name]
    fitting += [option for own, option in options.items() if name.startswith(f"{own}_") or name.endswith(f"_{own}")]
    return next((f"{option}{text[len(name) :]}" for option in fitting if option.startswith("--")), text)
