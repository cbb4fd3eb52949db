"""Files of records, one line of JSON each, to which benchmarks that take hours append what they have done."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path


def read(path: Path) -> list[dict]:
    """All records; none where there is no file."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def append(path: Path, record: dict) -> None:
    """Write one record at the end."""
    with path.open("a") as file:
        file.write(json.dumps(record) + "\n")


def commit() -> str:
    """Name of the commit that is run; it ends in ``-dirty`` where files differ from it."""
    command = ["git", "describe", "--always", "--dirty"]
    return subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True).stdout.strip()
