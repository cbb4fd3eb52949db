"""Events of lists as text, a line for each event, in the forms of `text_form`."""

from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import printable, reading
from hesim_render.exchange.text_form import LARGEST_SIDE, TextForm
from hesim_render.pixels.evs.events import EVENT_DTYPE

#: Bytes that are read at once: of the shortest lines, 2¹⁸ events.
_PIECE_BYTES = 1 << 21
_LONGEST_LINE = 1000
#: Microseconds since 1 January 1970 of the year 2200; later times are those of a damaged file.
_LATEST_US = 7_300_000_000_000_000
_LINE_END, _SPACE = 10, 32
#: Letters of a number that is read with all others, and decimals of one that is not.
_MOST_DIGITS, _DECIMALS = 19, 9


def read(file: Path, form: TextForm) -> Iterator[NDArray]:
    """Blocks of events of a list.

    Raises
    ------
    SpecError
        With file and line, if a line is no event, or a value is out of range.
    """
    change = bytes.maketrans(b",;\r", b". \n") if form.comma else bytes.maketrans(b",;\r", b"  \n")
    with reading(file), file.open("rb") as opened:
        opened.seek(form.begin)
        rest, passed, per_line = b"", 0, 1
        while data := opened.read(_PIECE_BYTES):
            # line ends of two bytes become two lines, of which one is empty
            per_line = 2 if b"\r\n" in data else per_line
            whole, end, rest = (rest + data.translate(change)).rpartition(b"\n")
            if whole.strip():
                yield _events(file, form, whole, passed, per_line)
            passed += whole.count(b"\n") + len(end)
            if len(rest) > _LONGEST_LINE:
                line = form.line + passed // per_line
                raise SpecError(f"a line of more than {_LONGEST_LINE} bytes", file=file, line=line)
        if rest.strip():
            yield _events(file, form, rest, passed, per_line)


def _events(file: Path, form: TextForm, data: bytes, passed: int, line_ends: int) -> NDArray:
    """Events of whole lines behind `passed` ends of lines, of which spaces keep the columns apart."""
    data = data.replace(b"True", b"1").replace(b"False", b"0")
    letters = np.frombuffer(data, np.uint8)
    starts, ends = _words_of(letters)
    per_line = np.diff(
        np.searchsorted(starts, np.append(np.flatnonzero(letters == _LINE_END), letters.size)), prepend=0
    )
    filled = np.flatnonzero(per_line)

    def error(number: int, text: str) -> SpecError:
        return SpecError(text, file=file, line=form.line + (passed + number) // line_ends)

    wrong = filled[per_line[filled] != form.columns]
    if wrong.size:
        first = int(wrong[0])
        raise error(first, f"{per_line[first]} values; expected {form.columns}")
    starts, ends = (places.reshape(-1, form.columns)[:, form.order] for places in (starts, ends))
    events = np.empty(len(starts), dtype=EVENT_DTYPE)
    limits = (("t", 0, _LATEST_US), ("x", 0, LARGEST_SIDE - 1), ("y", 0, LARGEST_SIDE - 1), ("p", -1, 1))
    for k, (name, low, high) in enumerate(limits):
        digits, decimals, wrong = _numbers(data, letters, starts[:, k], ends[:, k])
        if wrong.any():
            first = int(wrong.argmax())
            shown = printable(
                data[starts[first, k] : min(ends[first, k], starts[first, k] + 20)].decode("utf-8", "replace")
            )
            raise error(int(filled[first]), f"{name} is {shown!r}, and no number")
        values = _scaled(digits, decimals, form.power if k == 0 else 0)
        bad = (values < low) | (values > high)
        if k > 0:
            bad |= values * 10**decimals != digits
        if bad.any():
            first = int(bad.argmax())
            shown = printable(data[starts[first, k] : ends[first, k]].decode("ascii", "replace")[:20])
            raise error(int(filled[first]), f"{name} is {shown}; expected {low} to {high}")
        if name == "p":
            events["polarity"] = np.where(values > 0, 1, -1)
        else:
            events["t_us" if name == "t" else name] = values
    return events


def _words_of(letters: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First byte of each word, and the byte behind it."""
    solid = np.zeros(letters.size + 2, np.int8)
    solid[1:-1] = letters > _SPACE
    change = np.diff(solid)
    return np.flatnonzero(change == 1), np.flatnonzero(change == -1)


def _numbers(
    data: bytes, letters: NDArray[np.uint8], starts: NDArray[np.int64], ends: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Digits of decimal numbers as whole numbers, how many of them follow the point, and which words are no numbers.

    Letter by letter of all words at once, which takes a tenth of the time of NumPy's own reader of text.
    """
    length = ends - starts
    digits, decimals = np.zeros(starts.size, np.int64), np.zeros(starts.size, np.int64)
    behind, odd = np.zeros(starts.size, bool), length > _MOST_DIGITS
    minus = letters[starts] == ord("-")
    for k in range(min(int(length.max()), _MOST_DIGITS)):
        here = k < length
        letter = np.where(here, letters[np.minimum(starts + k, letters.size - 1)], _SPACE)
        value = letter.astype(np.int64) - ord("0")
        digit = (value >= 0) & (value <= 9)
        digits = np.where(digit, 10 * digits + value, digits)
        decimals += digit & behind
        point = letter == ord(".")
        odd |= (point & behind) | (here & ~digit & ~point & ((k > 0) | ((letter != ord("-")) & (letter != ord("+")))))
        behind |= point
    digits = np.where(minus, -digits, digits)
    odd |= length == (behind.astype(np.int64) + minus)
    wrong = np.zeros(starts.size, bool)
    for k in np.flatnonzero(odd).tolist():
        try:
            exact = Decimal(data[starts[k] : ends[k]].decode("ascii"))
            digits[k], decimals[k] = int(exact.scaleb(_DECIMALS).to_integral_value()), _DECIMALS
        except (ArithmeticError, ValueError):
            wrong[k] = True
            break
    return digits, decimals, wrong


def _scaled(digits: NDArray[np.int64], decimals: NDArray[np.int64], power: int) -> NDArray[np.int64]:
    """Digits by a power of ten less their decimals, rounded."""
    values = np.empty_like(digits)
    for count in np.unique(decimals).tolist():
        which, exponent = decimals == count, power - count
        if exponent >= 0:
            values[which] = digits[which] * 10**exponent
        else:
            values[which] = (digits[which] + 10**-exponent // 2) // 10**-exponent
    return values
