"""Reads the docstrings of this package for the site: in ``name : text`` the text describes, the type is in the code.

numpydoc's own form has the type there, so griffe would show every description as a type.
"""

import re
from typing import Any

import griffe

_HEADING = re.compile(r"^(Parameters|Attributes|Returns|Yields|Raises|Other Parameters)\n-+\n", re.MULTILINE)
_ENTRY = re.compile(r"^(\*{0,2}\w[\w, *]*) : (.*)$")


def described(text: str, returned: str = "returned") -> str:
    """The docstring `text` in the form in which griffe finds names and descriptions; `returned` is the annotation."""
    parts = _HEADING.split(text)
    whole = parts[0]
    for title, body in zip(parts[1::2], parts[2::2], strict=True):
        section, rest = re.match(r"((?:(?!\n\n\S[^\n]*\n-{3,}\n).)*)(.*)", body, re.DOTALL).groups()
        whole += f"{title}\n{'-' * len(title)}\n{_section(title, section, returned)}{rest}"
    return whole


def _section(title: str, section: str, returned: str) -> str:
    lines = section.split("\n")
    if title in ("Returns", "Yields") and lines and not any(line.startswith(" ") for line in lines if line):
        # a description alone; griffe takes an unindented line for a type
        return "\n".join([returned, *(f"    {line}" if line else "" for line in lines)])
    found = []
    for line in lines:
        entry = _ENTRY.match(line) if title in ("Parameters", "Attributes", "Other Parameters") else None
        found += [entry.group(1), f"    {entry.group(2)}"] if entry else [line]
    return "\n".join(found)


class NumpydocText(griffe.Extension):
    """Rewrites docstrings before they are parsed."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite the docstring of `obj`."""
        if obj.docstring is not None:
            annotation = getattr(obj, "returns", None) or getattr(obj, "annotation", None)
            text = described(obj.docstring.value, str(annotation or "returned"))
            # [row][col] is the shape of a list here, and would be a reference
            obj.docstring.value = re.sub(r"(?<!`)((?:\[[\w ]+\]){2,})", r"`\1`", text)
