"""Files that a scene of Mitsuba's own names: those of a stranger's scene must lie in its folder."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from pathlib import Path
from string import Template
from typing import Any

from hesim_render.core.device_types import MitsubaModule
from hesim_render.core.errors import SpecError
from hesim_render.core.guard import leads_out, reading
from hesim_render.specs.scene import OUTSIDE

#: Mitsuba 3.9 orders parameters by the numbers in their names, and crashes where one does not fit.
_LONG_NUMBER = re.compile(r"\d{10,}")


def check_xml(file: Path, root: Path | None, find: Callable[[str], str]) -> None:
    """Refuse an XML scene that names files outside of `root`, before Mitsuba reads any of them, or would crash it.

    Parameters
    ----------
    root : None lets them lie anywhere.
    find : where Mitsuba looks for a name.

    Raises
    ------
    SpecError
        If it does, or is not valid XML.
    """
    defaults: dict[str, str] = {}
    waiting, seen = [file], set()
    while waiting:
        current = waiting.pop()
        seen.add(current.resolve())
        for element in _elements(current):
            if element.tag == "default":
                defaults.setdefault(element.get("name", ""), element.get("value", ""))
            require_short_number(element.get("name", ""), current)
            for name in _names(element):
                with reading(current, "as a scene"):
                    path = Path(find(Template(name).safe_substitute(defaults)))
                    if root is not None:
                        _require(path, root, name, current)
                    if element.tag == "include" and path.is_file() and path.resolve() not in seen:
                        waiting.append(path)


def require_short_number(name: str, file: Path | None) -> None:
    """Refuse the name of a parameter at whose number Mitsuba's parser ends the process.

    Raises
    ------
    SpecError
        If it holds a number that is no 32-bit one.
    """
    if _LONG_NUMBER.search(name):
        raise SpecError(f"the name {name[:40]!r} holds too large a number", file=file)


def require_state_inside(
    mi: MitsubaModule, state: Any, root: Path, find: Callable[[str], str], file: Path | None
) -> None:
    """The same of a scene that Mitsuba has parsed, before anything is made of it."""
    for node in state.nodes:
        for key in node.props:
            if key == "filename" and node.props.type(key) == mi.Properties.Type.String:
                _require(Path(find(node.props[key])), root, node.props[key], file)


def _elements(file: Path) -> Iterator[ElementTree.Element]:
    if not file.is_file():
        raise SpecError("no such file", file=file)
    with reading(file, "as XML"):
        tree = ElementTree.parse(file)
    return tree.iter()


def _names(element: ElementTree.Element) -> list[str]:
    """Files that an element names: by an attribute of its own, or as a parameter."""
    named = element.get("value") if element.get("name") == "filename" else None
    return [name for name in (element.get("filename"), named) if name]


def _require(path: Path, root: Path, name: str, file: Path | None) -> None:
    if leads_out(root, path):
        raise SpecError(f"{name!r} {OUTSIDE}", file=file)
