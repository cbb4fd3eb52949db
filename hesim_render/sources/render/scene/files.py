"""File names in Mitsuba scenes: a scene from elsewhere may name files in its own folder only."""

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

#: Mitsuba 3.9 sorts parameters by the numbers in their names, and crashes if a number does not fit 32 bits.
_LONG_NUMBER = re.compile(r"\d{10,}")


def check_xml(file: Path, root: Path | None, find: Callable[[str], str]) -> None:
    """Refuse an XML scene that names files outside `root` or would crash Mitsuba's parser, before Mitsuba reads any
    file.

    Parameters
    ----------
    file : the XML file.
    root : folder of the allowed files; None allows all.
    find : Mitsuba's search for a file name.

    Raises
    ------
    SpecError
        If the scene is refused, or is not valid XML.
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
    """Refuse a parameter name with a number at which Mitsuba's parser ends the process.

    Raises
    ------
    SpecError
        If a number in the name does not fit 32 bits.
    """
    if _LONG_NUMBER.search(name):
        raise SpecError(f"the name {name[:40]!r} holds too large a number", file=file)


def require_state_inside(
    mi: MitsubaModule, state: Any, root: Path, find: Callable[[str], str], file: Path | None
) -> None:
    """As `check_xml`, for a scene that Mitsuba has parsed but not yet built."""
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
    """Files that an element names, in an attribute of its own or as a parameter."""
    named = element.get("value") if element.get("name") == "filename" else None
    return [name for name in (element.get("filename"), named) if name]


def _require(path: Path, root: Path, name: str, file: Path | None) -> None:
    if leads_out(root, path):
        raise SpecError(f"{name!r} {OUTSIDE}", file=file)
