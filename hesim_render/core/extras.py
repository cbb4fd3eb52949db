"""Packages that a part of this package needs and that not every installation has."""

from __future__ import annotations

import re
from importlib.metadata import PackageNotFoundError, requires


def how_to_install(extra: str) -> str:
    """The command that installs the packages of an extra, by their own names: this works without a release as well.

    Parameters
    ----------
    extra : name of the extra in ``pyproject.toml``.
    """
    try:
        stated = requires("hesim_render") or []
    except PackageNotFoundError:  # run from a source tree that was never installed
        stated = []
    own = re.compile(rf"""extra\s*==\s*["']{re.escape(extra)}["']""")
    result = [line.partition(";")[0].strip() for line in stated if own.search(line)]
    packages = [re.sub(r"^([\w.-]+(?:\[[^\]]*\])?)\s*\(?([^)]*)\)?$", r"\1\2", text) for text in result] or [
        f".[{extra}]"
    ]
    return "pip install " + " ".join(f"'{name}'" for name in packages)
