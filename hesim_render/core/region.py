"""The part of a sensor that is read out, as text."""

import re

from hesim_render.core.errors import RangeError


def parse_roi(text: str, name: str = "--roi") -> tuple[int, int, int | None, int | None]:
    """Width, height and optional first column and row of ``512x384`` or ``512x384+100+200``, px.

    Raises
    ------
    RangeError
        If it is no such text; the message has `name`.
    """
    match = re.fullmatch(r"([0-9]{1,9})[xX]([0-9]{1,9})(?:\+([0-9]{1,9})\+([0-9]{1,9}))?", text)
    if match is None:
        raise RangeError(name, text, "WIDTHxHEIGHT or WIDTHxHEIGHT+X+Y, such as 512x384")
    width, height, x, y = (None if part is None else int(part) for part in match.groups())
    assert width is not None and height is not None
    return width, height, x, y
