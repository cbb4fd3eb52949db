"""Child processes of Python: they run the package of their parent, and no module that lies in the working folder."""

from __future__ import annotations

import os
import sys
from pathlib import Path

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
    """A program text that may import this package, the one that runs now.

    Parameters
    ----------
    code : the program text.
    """
    return _IMPORT.format(name=_PACKAGE.name, file=str(_PACKAGE / "__init__.py")) + code


def child_environment() -> dict[str, str]:
    """The environment for a child: paths of ``PYTHONPATH`` that are relative, or empty, lead to the working folder."""
    environment = dict(os.environ)
    paths = environment.pop("PYTHONPATH", "").split(os.pathsep)
    if kept := [path for path in paths if os.path.isabs(path)]:
        environment["PYTHONPATH"] = os.pathsep.join(kept)
    return environment
