"""A folder of a stranger: modules with the names of everything that is imported, which leave a mark when they run."""

import importlib.metadata
import os
import sys

#: Names that nobody has installed, but that are looked for.
_OPTIONAL = ("torch", "rerun", "distributed", "cv2", "rawpy", "sitecustomize", "usercustomize")


def names():
    """Every module of the standard library and of all that is installed."""
    return {*sys.stdlib_module_names, *importlib.metadata.packages_distributions(), *_OPTIONAL} - {"__pycache__"}


def fill(folder):
    """Write the modules; returns the file that they write their names into."""
    mark = folder / "mark"
    for name in names():
        if name.isidentifier():
            lines = [
                "import posix",
                f"file = posix.open({str(mark)!r}, {os.O_WRONLY | os.O_CREAT | os.O_APPEND}, 0o600)",
                f"posix.write(file, {f'{name} '.encode()!r})",
                "raise SystemExit('a module of the working folder runs')",
            ]
            (folder / f"{name}.py").write_text("\n".join(lines))
    return mark
