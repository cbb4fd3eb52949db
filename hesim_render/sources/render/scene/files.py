"""File names in Mitsuba scenes: a scene from elsewhere may name files in its own folder only.

Mitsuba opens files where it finds them: in folders that a scene may add to, or in the working folder. So the names in
an XML file are followed as Mitsuba 3.9 follows them, and whatever it is about to open is checked before.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.parsers import expat

from hesim_render.core.device_types import MitsubaModule, MitsubaObject
from hesim_render.core.errors import SpecError
from hesim_render.core.guard import WholeFile, leads_out, reading
from hesim_render.sources.render.scene.sizes import require_fits
from hesim_render.specs.scene import OUTSIDE

#: Mitsuba 3.9 sorts parameters by the numbers in their names, and crashes if a number does not fit 32 bits.
_LONG_NUMBER = re.compile(r"\d{10,}")
#: Files that are included in all, and depth of includes in includes, which is Mitsuba's own.
_MOST_INCLUDES, _DEEPEST = 1000, 15
#: Mitsuba reads data/ior/MATERIAL.eta.spd.
_MATERIAL = re.compile(r"[\w-]{1,40}")


class SceneFiles:
    """The files that a scene names.

    Parameters
    ----------
    resolver : Mitsuba's search for a file name, as it is when Mitsuba begins to read; a copy.
    root : folder that must contain all files; None allows all.
    """

    def __init__(self, resolver: MitsubaObject, root: Path | None) -> None:
        self._resolver, self._root = resolver, root
        self._defaults: dict[str, str] = {}
        self._includes = self._depth = 0

    def check_xml(self, file: Path) -> None:
        """Refuse an XML scene that names files outside of the root, or would crash Mitsuba's parser.

        Nothing outside is opened. Names are read as Mitsuba does: in the order of the text, with the parameters
        (``$name``) and folders (``<path>``) that are known there.

        Raises
        ------
        SpecError
            If the scene is refused, or is not valid XML.
        """
        parser = expat.ParserCreate()

        def begin(tag: str, given: dict[str, str]) -> None:
            self._element(tag, {key: self._substituted(value) for key, value in given.items()}, file)

        def refuse(*_: object) -> None:
            raise SpecError("has a document type, which Mitsuba does not read; remove it", file=file)

        def declare(_: str, encoding: str | None, __: int) -> None:
            if (encoding or "utf-8").lower() not in ("utf-8", "utf8", "us-ascii", "ascii"):
                raise SpecError(f"has the encoding {encoding}; expected utf-8", file=file)

        parser.StartElementHandler, parser.StartDoctypeDeclHandler, parser.XmlDeclHandler = begin, refuse, declare
        if not file.is_file():
            raise SpecError("no such file", file=file)
        with reading(file, "as XML"):
            parser.Parse(WholeFile(file).text().encode(), True)

    def _element(self, tag: str, given: Mapping[str, str], file: Path) -> None:
        name = given.get("name", "")
        require_short_number(name, file)
        if tag == "default":
            self._defaults.setdefault(name, given.get("value", ""))
        elif tag == "path":
            self._resolver.prepend(str(self._folder(given.get("value", ""), file)))
        elif "filename" in given:
            path = self.require(given["filename"], file)
            if tag == "include":
                self._includes += 1
                self._depth += 1
                if self._includes > _MOST_INCLUDES or self._depth > _DEEPEST:
                    raise SpecError(f"includes itself, or more than {_MOST_INCLUDES} files", file=file)
                own = self._resolver
                self._resolver = type(own)(own)  # folders of an included file are for that file alone
                self.check_xml(path)
                self._resolver = own
                self._depth -= 1

    def _substituted(self, text: str) -> str:
        """A text with its parameters, the longest first; a dollar behind a backslash is none."""
        if "$" not in text:
            return text
        for name in sorted(self._defaults, key=len, reverse=True):
            value, place = self._defaults[name], 0
            while (place := text.find(f"${name}", place)) >= 0:
                if place and text[place - 1] == "\\":
                    place += 1 + len(name)
                else:
                    text = text[:place] + value + text[place + 1 + len(name) :]
                    place += len(value)
        return text

    def check_dictionary(self, node: Mapping[str, Any], file: Path | None) -> None:
        """As `check_xml`, for a scene given as a dictionary."""
        for key, value in node.items():
            if isinstance(value, Mapping):
                self.check_dictionary(value, file)
            elif key == "filename" and isinstance(value, str):
                self.require(value, file)

    def check_state(self, mi: MitsubaModule, state: Any, file: Path | None) -> None:
        """As `check_xml`, for a scene that Mitsuba has parsed but not yet built."""
        for _, name in _texts(mi, state, "filename"):
            require_fits(self.require(name, file))
        for _, name in _texts(mi, state, "material"):
            require_material(name, file)

    def require(self, name: str, file: Path | None) -> Path:
        """The file that Mitsuba opens for a name.

        Parameters
        ----------
        name : the name.
        file : the file that names it, for errors.

        Raises
        ------
        SpecError
            If it lies outside, or is no plain file.
        """
        path = self._resolved(name, file)
        if not path.is_file():
            raise SpecError(f"no such file: {name!r}", file=file)
        return path

    def _folder(self, name: str, file: Path) -> Path:
        """The folder of a ``<path>``: beside the file, or else one that Mitsuba finds."""
        beside = file.resolve().parent / name
        folder = self._resolved(str(beside) if beside.exists() else name, file)
        if not folder.is_dir():
            raise SpecError(f"no such folder: {name!r}", file=file)
        return folder

    def _resolved(self, name: str, file: Path | None) -> Path:
        """What Mitsuba finds in its folders; a relative name that it does not find is one of the working folder."""
        if "$" in name or "\\" in name or "\0" in name:
            raise SpecError(f"the file name {name[:80]!r} holds a '$', '\\' or NUL", file=file)
        path = Path(str(self._resolver.resolve(name)))
        if self._root is None:
            return path
        if not path.is_absolute():
            raise SpecError(f"no such file: {name!r}", file=file)
        if leads_out(self._root, path):
            raise SpecError(f"{name!r} {OUTSIDE}", file=file)
        return path


def require_material(name: str, file: Path | None, key: str | None = None) -> str:
    """The name of a metal, of which Mitsuba makes the names of files.

    Raises
    ------
    SpecError
        If it cannot be one.
    """
    if not _MATERIAL.fullmatch(name):
        raise SpecError(f"{name[:40]!r} is no metal of Mitsuba's", file=file, key=key)
    return name


def require_short_number(name: str, file: Path | None) -> None:
    """Refuse a parameter name with a number at which Mitsuba's parser ends the process.

    Raises
    ------
    SpecError
        If a number in the name does not fit 32 bits.
    """
    if _LONG_NUMBER.search(name):
        raise SpecError(f"the name {name[:40]!r} holds too large a number", file=file)


def _texts(mi: MitsubaModule, state: Any, name: str) -> Iterator[tuple[Any, str]]:
    """Nodes of a parsed scene that have a parameter with a text, and the text."""
    for node in state.nodes:
        for key in node.props:
            if key == name and node.props.type(key) == mi.Properties.Type.String:
                yield node, node.props[key]
