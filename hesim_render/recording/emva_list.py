"""The list of an EMVA 1288 data set: which picture is of which light and exposure.

The standard's form has a line for each exposure and one for each picture below it::

    n 12 640 480
    b 40000 118.4
    i images\\b_000_snap_001.png
    i images\\b_000_snap_002.png
    d 40000
    i images\\d_000_snap_001.png

``b`` is lit: exposure in ns, photons per pixel; ``d`` is dark. Programs of makers vary it, and what they vary is read
too: separators, decimal commas, units behind the exposure, comments, encodings, quotes, and paths of the machine that
wrote the list.
"""

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import MOST_PIXELS, MOST_TEXT_BYTES, WholeFile, leads_out, printable, reading

#: The name that the standard's own data sets give the list.
DATA_FILE = "EMVA1288_Data.txt"
#: Suffixes of a list of another name.
_SUFFIXES = (".txt", ".csv", ".dat", ".emva", ".lst")
#: Bytes in which a list of another name shows that it is one.
_BEGIN_BYTES = 1 << 14
_COMMENTS = ("#", "//", "%", ";")
_SEPARATORS = " \t;,"
#: Seconds of the units of an exposure.
_UNITS_S = {"ns": 1e-9, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ms": 1e-3, "s": 1.0}
_UNIT = re.compile(r"(?<=[0-9.])\s*(ns|us|µs|μs|ms|s)(?=$|[\s;,])", re.IGNORECASE)
_SIZE_LINE = re.compile(r"^\s*n[\s;,]+\d+[\s;,]+\d+[\s;,]+\d+[\s;,]*$", re.IGNORECASE | re.MULTILINE)
#: Decimals of an exposure in s that are kept, so that 40.5 µs and 40500 ns are one.
_DECIMALS = 13


@dataclass(frozen=True)
class Series:
    """Frames of one light and exposure.

    Attributes
    ----------
    lit : whether light fell on the sensor.
    exposure_s : exposure, s.
    photons : mean photons per pixel and exposure; None where it is not stated.
    files : the frames.
    where, line : file and line that state them, for messages.
    """

    lit: bool
    exposure_s: float
    photons: float | None
    files: tuple[Path, ...]
    where: Path
    line: int | None

    def error(self, text: str) -> SpecError:
        """An error of these frames, with file and line."""
        return SpecError(f"{self.label}: {text}", file=self.where, line=self.line)

    @property
    def label(self) -> str:
        light = "dark" if not self.lit else "lit" if self.photons is None else f"{self.photons:g} photons"
        return f"{light}, {self.exposure_s * 1e6:g} µs"


def find_list(folder: Path) -> Path | None:
    """The list of a folder, or the path itself where it is one; None where there is none.

    Raises
    ------
    SpecError
        If the folder holds two lists.
    """
    if folder.is_file():
        return folder if _is_list(folder) else None
    if not folder.is_dir():
        return None
    entries = sorted(entry for entry in folder.iterdir() if entry.suffix.lower() in _SUFFIXES and entry.is_file())
    named = [entry for entry in entries if entry.name.casefold() == DATA_FILE.casefold()]
    result = named or [entry for entry in entries if _is_list(entry)]
    if len(result) > 1:
        names = " and ".join(printable(entry.name) for entry in result[:3])
        raise SpecError(f"holds {len(result)} lists of EMVA 1288 pictures, {names}; name the one to use", file=folder)
    return result[0] if result else None


def _is_list(file: Path) -> bool:
    """Whether the begin of a text file has a line ``n <bits> <width> <height>``."""
    if file.name.casefold() == DATA_FILE.casefold():
        return True
    if file.suffix.lower() not in _SUFFIXES:
        return False
    with reading(file), file.open("rb") as opened:
        begin = opened.read(_BEGIN_BYTES)
    return _SIZE_LINE.search(_decoded(begin).replace("\r", "\n")) is not None


def _decoded(data: bytes) -> str:
    """Text of UTF-8, UTF-16 with its mark, or else of Windows' western code page."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16", "replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", "replace")


def read_list(file: Path, unit: str | None = None) -> tuple[int, tuple[int, int], list[Series]]:
    """Bits, shape (rows, columns) and series of a list.

    Parameters
    ----------
    file : the list.
    unit : of exposures without a unit of their own: ``ns`` (default, the standard's), ``us``, ``ms`` or ``s``.

    Raises
    ------
    SpecError
        With file and line, if a line has no such form, or a picture is missing or outside the folder.
    """
    text = _decoded(WholeFile(file, MOST_TEXT_BYTES).read())
    shape: tuple[int, int] | None = None
    bit_depth: int | None = None
    series: list[Series] = []
    pictures = _Pictures(file)
    scale = _UNITS_S[unit or "ns"]
    is_repeated = False
    for line, whole in enumerate(text.splitlines(), 1):
        stripped = whole.strip()
        if not stripped.strip(_SEPARATORS) or stripped.startswith(_COMMENTS):
            continue
        word = re.match(r"[^\s;,]*", stripped)
        kind = "" if word is None else word.group()
        rest = stripped[len(kind) :].strip(_SEPARATORS)
        kind = kind.lower()
        if kind == "v":
            continue
        if kind == "n":
            if shape is not None:
                raise SpecError("a second line 'n <bits> <width> <height>'", file=file, line=line)
            bit_depth, shape = _size(file, line, _uncommented(rest))
        elif kind in ("b", "d"):
            entry = _exposure(file, line, kind, _uncommented(rest), scale)
            # some programs repeat the line of the exposure before each picture
            again = bool(series) and _key(series[-1]) == _key(entry) and (is_repeated or len(series[-1].files) == 1)
            is_repeated = again
            if not again:
                series.append(entry)
        elif kind == "i":
            if not series:
                raise SpecError("a picture before the first exposure", file=file, line=line)
            picture = pictures.find(line, rest)
            if picture in series[-1].files:
                raise SpecError(f"{printable(picture.name)} is twice in one series", file=file, line=line)
            series[-1] = replace(series[-1], files=(*series[-1].files, picture))
        else:
            raise SpecError(
                f"{printable(kind[:20])!r} begins no line of such a file (v, n, b, d, i)", file=file, line=line
            )
    if shape is None or bit_depth is None:
        raise SpecError("has no line 'n <bits> <width> <height>'", file=file)
    return bit_depth, shape, series


def _uncommented(text: str) -> str:
    """A line's values without a comment behind them."""
    return re.split(r"\s(?:#|//|%)", text, maxsplit=1)[0].strip(_SEPARATORS)


def _key(entry: Series) -> tuple[bool, float, float | None]:
    return entry.lit, entry.exposure_s, entry.photons


def _size(file: Path, line: int, text: str) -> tuple[int, tuple[int, int]]:
    bits, width, height = numbers(file, line, text, (3,), "n <bits> <width> <height>")
    whole = all(value == int(value) for value in (bits, width, height))
    if not (whole and 1 <= bits <= 16 and width * height <= MOST_PIXELS):
        expected = f"expected 1 to 16 bit and at most {MOST_PIXELS} pixels, whole numbers"
        raise SpecError(f"{printable(text)}: {expected}", file=file, line=line)
    return int(bits), (int(height), int(width))


def _exposure(file: Path, line: int, kind: str, text: str, scale: float) -> Series:
    """Of a line ``b`` or ``d``. Light of 0 photons is dark."""
    stated = _UNIT.search(text)
    if stated is not None:
        scale = _UNITS_S[stated.group(1).lower()]
        text = text[: stated.start()] + " " + text[stated.end() :]
    form = "b <exposure ns> <photons>" if kind == "b" else "d <exposure ns>"
    values = numbers(file, line, text, (2, 1) if kind == "b" else (1, 2), form, last_may_be_0=True)
    photons = values[1] if len(values) == 2 else None
    if kind == "d" and photons:
        raise SpecError(f"{photons:g} photons in the dark; expected {form}", file=file, line=line)
    lit = kind == "b" and photons != 0
    return Series(lit, round(values[0] * scale, _DECIMALS), photons if lit else None, (), file, line)


def numbers(
    file: Path, line: int, text: str, counts: tuple[int, ...], expected: str, *, last_may_be_0: bool = False
) -> tuple[float, ...]:
    """Numbers above 0 with points or commas before their decimals.

    Parameters
    ----------
    file, line : of the text, for the error.
    text : numbers between spaces, tabs or semicolons, or commas where they make up one of the counts.
    counts : numbers that there may be, first those that are tried first.
    expected : the form, for the error.
    last_may_be_0 : a second number may be 0.

    Raises
    ------
    SpecError
        If it has others.
    """
    words = [word.strip(",") for word in re.split(r"[\s;]+", text.strip(_SEPARATORS)) if word.strip(",")]
    if len(words) < counts[0] and len(apart := re.split(r"[\s;,]+", text.strip(_SEPARATORS))) == counts[0]:
        words = apart
    try:
        values = tuple(float(word.replace(",", ".")) for word in words)
    except ValueError:
        values = ()
    least = [value > 0 or (last_may_be_0 and k == 1 and value == 0) for k, value in enumerate(values)]
    if len(values) not in counts or not all(least) or not all(map(math.isfinite, values)):
        raise SpecError(f"expected {expected}, numbers above 0", file=file, line=line)
    return values


class _Pictures:
    """Pictures in the folder of a list, by the names that the list gives them."""

    def __init__(self, file: Path) -> None:
        self._file, self._folder = file, file.parent
        self._listed: dict[Path, dict[str, list[Path]]] = {}

    def find(self, line: int, name: str) -> Path:
        """The file of a name with slashes or backslashes, in letters of any case, which does not leave the folder.

        Of a path of the machine that wrote the list, the end that exists here is taken.

        Raises
        ------
        SpecError
            With file and line, if there is none.
        """
        plain = name.strip(_SEPARATORS).strip("\"'").strip().replace("\\", "/")
        shown = printable(name[:100])
        whole = PurePosixPath(re.sub(r"^[A-Za-z]:", "", plain))
        absolute = whole.is_absolute() or plain[1:2] == ":"
        parts = [part for part in whole.parts if part != "/" and part.strip("/")]
        with reading(self._file):
            if not parts or ".." in parts or (not absolute and leads_out(self._folder, plain)):
                raise SpecError(f"{shown!r} leads out of its folder", file=self._file, line=line)
            result = next(
                (path for first in range(len(parts)) if (path := self._exact(parts[first:])) is not None), None
            )
            if result is None:
                raise SpecError(f"no such file: {shown!r}", file=self._file, line=line)
            if leads_out(self._folder, result.relative_to(self._folder)):
                raise SpecError(f"{shown!r} leads out of its folder", file=self._file, line=line)
        return result

    def _exact(self, parts: list[str]) -> Path | None:
        """The one file of these names in letters of any case; the same case goes first."""
        path = self._folder.joinpath(*parts)
        if path.is_file():
            return path
        here = self._folder
        for part in parts:
            if here not in self._listed:
                names: dict[str, list[Path]] = {}
                for entry in here.iterdir() if here.is_dir() else ():
                    names.setdefault(entry.name.casefold(), []).append(entry)
                self._listed[here] = names
            result = self._listed[here].get(part.casefold(), [])
            if len(result) != 1:
                return None
            here = result[0]
        return here if here.is_file() else None
