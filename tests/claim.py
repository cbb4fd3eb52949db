"""Repeat claims of docs/validation.md: run the tests of their rows, slow ones as well.

``python -m tests.claim NAME…``; without a name, the claims are listed. Tests that need real data or a program that is
not here are skipped, and pytest says why.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def claims() -> dict[str, tuple[str, list[str]]]:
    """Claim and tests of each row of the page that has a name, in its order."""
    found: dict[str, tuple[str, list[str]]] = {}
    for line in (ROOT / "docs" / "validation.md").read_text(encoding="utf-8").splitlines():
        if name := re.search(r"`python -m tests\.claim ([\w-]+)`", line):
            assert name.group(1) not in found, f"two claims are named {name.group(1)}"
            found[name.group(1)] = (line.strip("| ").split(" | ")[0], re.findall(r"`(tests/[\w/]+\.py[\w:]*)`", line))
    return found


def main(names: list[str]) -> int:
    """Run the tests of the claims; the exit status is that of pytest."""
    known = claims()
    if not names or set(names) - set(known):
        width = max(map(len, known))
        print("\n".join(f"{name:{width}}  {claim}" for name, (claim, _) in known.items()))
        return 2 if names else 0
    tests = [test for name in names for test in known[name][1]]
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-rs", "-m", "slow or not slow", *tests], cwd=ROOT
    ).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
