"""Lists of events as text: a line ``t x y p`` for each event.

Programs write them in many forms. Columns are apart by spaces, tabs, commas or semicolons. A header names them in any
order; without one, they are ``t x y p``, or ``x y p t`` where only that fits. Times with decimals are seconds, whole
ones are microseconds, unless the header names the unit. Polarity is 1 for ON, and 0 or -1 for OFF. The first line may
state ``width height``, or a comment the geometry.
"""

import re
from dataclasses import dataclass
from pathlib import Path

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import reading

TEXT_SUFFIXES = (".txt", ".csv", ".tsv", ".asc", ".dat")
#: Bytes in which a file shows its form.
_BEGIN_BYTES = 1 << 16
#: Coordinates have 16 bits.
LARGEST_SIDE = 1 << 16
_COMMENTS = ("#", "%", "//")
_TEXT_BYTES = bytes(range(32, 127)) + b"\t\r\n"
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$")
_NAMES = {
    "t": ("t", "ts", "time", "times", "timestamp", "timestamps"),
    "x": ("x", "col", "column"),
    "y": ("y", "row"),
    "p": ("p", "pol", "polarity", "polarities", "on"),
}
#: Units that a header may name, as powers of ten of µs.
_UNITS = {"s": 6, "sec": 6, "ms": 3, "us": 0, "µs": 0, "μs": 0, "ns": -3}
#: Whole times from here on are nanoseconds: microseconds since 1970 are a hundred times fewer.
_NANOSECONDS_FROM = 10**17
_GEOMETRY = re.compile(r"(\d{1,5})\s*[xX×, ]\s*(\d{1,5})")
_GEOMETRY_WORDS = ("geometry", "size", "resolution", "sensor", "width")


@dataclass(frozen=True)
class TextForm:
    """How a list of events is written.

    Attributes
    ----------
    begin : first byte of the events.
    line : number of their first line.
    columns : number of columns.
    order : columns of t, x, y and p.
    power : of ten, of microseconds in the unit of t.
    comma : whether decimals follow commas.
    shape : rows and columns of the event grid, px; None where it is not stated.
    """

    begin: int
    line: int
    columns: int
    order: tuple[int, int, int, int]
    power: int
    comma: bool
    shape: tuple[int, int] | None


def is_text(file: Path) -> bool:
    """Whether the begin of a file is text with lines of events, or with a header that names their columns.

    Raises
    ------
    SpecError
        If the file cannot be read.
    """
    return _form(file) is not None


def read_form(file: Path) -> TextForm:
    """How the events of a file are written.

    Raises
    ------
    SpecError
        If it is no list of events.
    """
    form = _form(file)
    if form is None:
        raise SpecError("is no list of events; expected lines t x y p, or a header that names these columns", file=file)
    return form


def _form(file: Path) -> TextForm | None:
    with reading(file), file.open("rb") as opened:
        begin = opened.read(_BEGIN_BYTES)
    mark = 3 if begin.startswith(b"\xef\xbb\xbf") else 0
    if begin[mark:].translate(None, _TEXT_BYTES + bytes(range(128, 256))) or not begin[mark:]:
        return None
    lines = begin[mark:].splitlines(keepends=True)
    if len(begin) == _BEGIN_BYTES:
        lines.pop()
    at, shape, names = mark, None, None
    for number, raw in enumerate(lines, 1):
        text = raw.decode("utf-8", "replace").strip()
        words = _words(text)
        if text.startswith(_COMMENTS):
            shape = shape or _stated_shape(text)
            names = names or _named(_words(text.lstrip("#%/ ")))
        elif text and not all(map(_is_number, words)):
            names = _named(words)
            if names is None:
                return None
        elif len(words) == 2 and shape is None:
            shape = _checked(int(float(words[1])), int(float(words[0])))
        elif text:
            rest = [_words(row.decode("utf-8", "replace")) for row in lines[number - 1 : number + 199]]
            return _of_lines([row for row in rest if row], text, at, number, names, shape)
        at += len(raw)
    if names is None and shape is None:
        return None
    count, order, unit = names or (4, (0, 1, 2, 3), 0)
    return TextForm(at, len(lines) + 1, count, order, unit or 0, False, shape)


def _of_lines(
    rows: list[list[str]], first: str, at: int, number: int, names: tuple | None, shape: tuple[int, int] | None
) -> TextForm | None:
    """The form that the first lines of events have."""
    comma = ";" in first and "," in first
    if names is None:
        order = next((o for o in ((0, 1, 2, 3), (3, 0, 1, 2)) if _fits(rows, o)), None)
        if order is None:
            return None
        count, unit = 4, None
    else:
        count, order, unit = names
        rows = [row for row in rows if len(row) == count]
        if not rows:
            return None
    times = [row[order[0]] for row in rows if len(row) == count and _is_number(row[order[0]])]
    return TextForm(at, number, count, order, _power(times) if unit is None else unit, comma, shape)


def _words(text: str) -> list[str]:
    if ";" in text:
        return [word.strip().replace(",", ".") for word in text.strip().strip(";").split(";")]
    return [word.strip("\"'") for word in re.split(r"[\s,]+", text.strip().strip(","))] if text.strip() else []


def _is_number(word: str) -> bool:
    return _NUMBER.match(word) is not None or word in ("True", "False")


def _named(words: list[str]) -> tuple[int, tuple[int, int, int, int], int | None] | None:
    """Number of columns, those of t, x, y and p, and the power of ten of µs that a header names."""
    cleaned = [re.sub(r"[^a-zA-Zµμ]+", "_", word).strip("_").lower() for word in words]
    # a unit may stand apart from its name, as in "t (us), x, y, p"
    unit = next((_UNITS[word] for word in cleaned if word in _UNITS), None)
    cleaned = [word for word in cleaned if word not in _UNITS]
    order = []
    for key, known in _NAMES.items():
        for k, word in enumerate(cleaned):
            name, _, end = word.rpartition("_")
            has_unit = key == "t" and name in known and end in _UNITS
            if word in known or has_unit:
                order.append(k)
                unit = _UNITS[end] if has_unit else unit
                break
    if len(order) != len(_NAMES):
        return None
    return len(cleaned), (order[0], order[1], order[2], order[3]), unit


def _fits(rows: list[list[str]], order: tuple[int, int, int, int]) -> bool:
    """Whether lines are events in an order of columns: times that do not fall, whole places, polarities."""
    whole = [row for row in rows[:-1] if len(row) == 4] or [row for row in rows if len(row) == 4]
    try:
        values = [[float(row[k]) for k in order[:3]] + [row[order[3]]] for row in whole]
    except ValueError:
        return False
    times = [row[0] for row in values]
    return (
        bool(values)
        and times == sorted(times)
        and all(x == int(x) and y == int(y) for _, x, y, _ in values)
        and {row[3] for row in values} <= {"0", "1", "-1", "+1", "0.0", "1.0", "-1.0", "True", "False"}
    )


def _power(times: list[str]) -> int:
    """Of times with decimals s; of whole ones µs, or ns where they are too large for that."""
    if any(re.search(r"[.eE]", word) and float(word) != int(float(word)) for word in times):
        return _UNITS["s"]
    return _UNITS["ns"] if times and float(times[0]) >= _NANOSECONDS_FROM else 0


def _stated_shape(comment: str) -> tuple[int, int] | None:
    low = comment.lower()
    if not any(word in low for word in _GEOMETRY_WORDS):
        return None
    width, height = (re.search(rf"{name}\D{{0,3}}(\d{{1,5}})", low) for name in ("width", "height"))
    if width and height:
        return _checked(int(height.group(1)), int(width.group(1)))
    size = _GEOMETRY.search(low)
    return _checked(int(size.group(2)), int(size.group(1))) if size else None


def _checked(rows: int, cols: int) -> tuple[int, int] | None:
    return (rows, cols) if 0 < rows <= LARGEST_SIDE and 0 < cols <= LARGEST_SIDE else None
