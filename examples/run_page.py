"""Run a page of the documentation: its commands, its Python blocks, and the files that it shows.

Blocks called ``bash`` run in one shell after another, blocks called ``python`` are scripts, and a block with a title is
written to the file of that name. Other blocks (``text``, ``math``) are left alone, and so is a block below a comment
``<!-- not run: why -->``.

Run: python examples/run_page.py docs/tutorial.md FOLDER [--installed]

``--installed`` leaves out blocks that install something, and takes the `hesim-render` beside this Python.
"""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

_FENCE = re.compile(
    r'(?:^<!-- not run: (?P<reason>[^>]+?) -->\n+)?^```(?P<kind>\w+)(?: title="(?P<title>[^"]+)")?\n(?P<text>.*?)^```$',
    re.MULTILINE | re.DOTALL,
)
_END = "END_OF_THE_BLOCK"


class Block(NamedTuple):
    """A fenced block of a page."""

    kind: str
    text: str
    title: str | None
    reason: str | None
    line: int


def blocks_of(page: Path) -> list[Block]:
    """The fenced blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    found = []
    for match in _FENCE.finditer(text):
        line = text.count("\n", 0, match.start("text"))
        found.append(Block(match["kind"], match["text"], match["title"], match["reason"], line))
    return found


def script_of(page: Path, installed: bool = False) -> str:
    """The page as one bash script."""
    lines = ["set -euo pipefail"]
    for block in blocks_of(page):
        if block.reason or (installed and "pip install" in block.text):
            continue
        if block.title:
            lines.append(f"cat > {block.title} <<'{_END}'\n{block.text}{_END}")
        elif block.kind in ("bash", "python"):
            lines.append(f"echo '=== {page.name}, line {block.line}' >&2")
            lines.append(block.text if block.kind == "bash" else f"python - <<'{_END}'\n{block.text}{_END}")
    return "\n".join(lines)


def run(page: Path, folder: Path, installed: bool = False) -> None:
    """Run a page in a folder; a command that fails ends it."""
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "examples").exists():  # pages that start a script do it in a clone of the repository
        (folder / "examples").symlink_to(Path(__file__).resolve().parent)
    environment = os.environ | {"MPLBACKEND": "Agg"}
    if installed:
        environment["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{environment['PATH']}"
    else:  # the page makes an environment of its own
        environment = {key: value for key, value in environment.items() if key not in ("PYTHONPATH", "VIRTUAL_ENV")}
    script = folder / f".{page.stem}.sh"
    script.write_text(script_of(page, installed), encoding="utf-8")
    subprocess.run(["bash", script.name], cwd=folder, env=environment, check=True)


if __name__ == "__main__":
    run(Path(sys.argv[1]).resolve(), Path(sys.argv[2]), "--installed" in sys.argv)
