"""Names of the files that ship with the package, found without loading what reads them."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

#: Kinds of shipped files and their folders: in ``shipped`` of an installed package, at the top of the source tree.
FOLDERS = {
    "scenes": "scenes",
    "sensors": "sensors",
    "studies": "studies",
    "filter_sets": "studies/filter_sets",
    "palettes": "studies/palettes",
}


def data_folder(kind: str) -> Path:
    """Folder of the shipped files of a kind, one of `FOLDERS`."""
    package = Path(__file__).resolve().parent.parent
    installed = package / "shipped"
    return (installed if installed.is_dir() else package.parent) / FOLDERS[kind]


def list_names(kind: str) -> list[str]:
    """Names of the shipped files of a kind."""
    return sorted(path.stem for path in data_folder(kind).glob("*.yaml"))


def read_keys(file: Path, keys: Collection[str]) -> dict[str, Any]:
    """Some top-level keys of a shipped file; the rest of it is not parsed, which takes seconds for many long files.

    Only for files in block style whose keys here use no aliases, as those that ship.

    Parameters
    ----------
    file, keys : the file, and the keys that are wanted.
    """
    from ruamel.yaml import YAML

    parts: list[str] = []
    is_wanted = False
    for line in file.read_text(encoding="utf-8").splitlines(keepends=True):
        if line[:1] not in " #\t-\r\n":
            is_wanted = line.partition(":")[0] in keys
        if is_wanted:
            parts.append(line)
    result = YAML(typ="safe", pure=True).load("".join(parts)) if parts else {}
    return result if isinstance(result, dict) else {}
