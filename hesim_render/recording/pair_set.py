"""Captures of EMVA 1288: pairs of frames at many exposures, and one series of many frames, dark and lit.

Two layouts are read: that of the standard's own data sets (``EMVA1288_Data.txt``), and a plain folder whose file names
state light and exposure (``lit_5160us_15508ph_01.png``). Frames are read one at a time.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import MOST_PIXELS, WholeFile, leads_out, printable, reading
from hesim_render.core.units import S_PER_US
from hesim_render.recording.camera_raw import RAW_SUFFIXES, read_raw
from hesim_render.specs.capture import CaptureSpec
from hesim_render.specs.files import load_yaml, validate

DATA_FILE = "EMVA1288_Data.txt"
_S_PER_NS = 1e-9
#: Names of a plain folder: light, exposure in µs, photons per pixel if known, number of the frame.
_NAME = re.compile(r"(dark|lit)_([0-9.]+)us(?:_([0-9.]+)ph)?_([0-9]+)(\.[A-Za-z]+)")
_NAME_STATED = "lit_<exposure>us_<photons>ph_<number>.png or dark_<exposure>us_<number>.png"
#: Most frames of a set: a hundred times those of the standard.
_MOST_FRAMES = 30_000
#: Exposures at which a variance is known, below which no line is fitted.
_FEWEST_EXPOSURES = 5


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


@dataclass(frozen=True)
class PairSet:
    """Captures of EMVA 1288.

    Attributes
    ----------
    file : the list of the frames, or the folder.
    spec : description, as that of other captures.
    shape : rows and columns.
    lit, dark : pairs in order of light and exposure; ``dark[k]`` belongs to ``lit[k]``, and one may stand there often.
    spatial_lit, spatial_dark : series of many frames.
    """

    file: Path
    spec: CaptureSpec
    shape: tuple[int, int]
    lit: tuple[Series, ...]
    dark: tuple[Series, ...]
    spatial_lit: Series
    spatial_dark: Series

    @property
    def has_photons(self) -> bool:
        return all(series.photons is not None for series in self.lit)

    def half(self, number: int) -> PairSet:
        """Every second exposure and every second frame of the long series, from the first (0) or the second (1) on."""
        cut = slice(number, None, 2)
        lit, dark = self.spatial_lit, self.spatial_dark
        return replace(
            self, lit=self.lit[cut], dark=self.dark[cut],
            spatial_lit=replace(lit, files=lit.files[cut]), spatial_dark=replace(dark, files=dark.files[cut]),
        )  # fmt: skip

    def frames(self, series: Series) -> Iterator[NDArray[np.uint16]]:
        """The frames of a series, [row, col], one at a time.

        Raises
        ------
        SpecError
            If a frame cannot be read, is of another size, or holds larger values than the stated bits allow.
        """
        for file in series.files:
            frame = read_raw(file, self.shape)
            if int(frame.max()) > self.spec.full_scale_dn:
                raise series.error(f"{file.name} holds {frame.max()} DN, more than {self.spec.bit_depth} bit have")
            yield frame


def is_pair_set(folder: str | Path) -> bool:
    """Whether a folder holds captures in one of the two layouts."""
    path = Path(folder)
    if (path / DATA_FILE).is_file():
        return True
    return path.is_dir() and any(_NAME.fullmatch(entry.name) for entry in path.iterdir())


def read_pair_set(folder: str | Path) -> PairSet:
    """Open the captures in `folder`; no frame is read but the first of a plain folder, for its size.

    Raises
    ------
    SpecError
        With file and line, if the list is wrong, names files outside the folder, or lacks a frame of a pair, a dark
        exposure or a long series.
    """
    path = Path(folder)
    if (path / DATA_FILE).is_file():
        spec, shape, series = _listed(path)
        where = path / DATA_FILE
    else:
        spec, shape, series = _named(path)
        where = path
    if (spec.tile_rows, spec.tile_cols) != (1, 1):
        raise SpecError(
            "EMVA 1288 evaluates one colour at a time: give the frames of each position of the tile a folder of their "
            "own, with tile_rows and tile_cols 1",
            file=path / "capture.yaml",
        )
    if spec.roi is not None and shape != (spec.roi.height_px, spec.roi.width_px):
        raise SpecError(f"roi is not of the frames' size, {shape[1]}x{shape[0]}", file=path / "capture.yaml")
    return _arranged(where, spec, shape, series)


def _capture_spec(folder: Path, bit_depth: int | None) -> CaptureSpec:
    """``capture.yaml``; a list of the standard states the bits itself and needs none."""
    file = folder / "capture.yaml"
    if file.is_file():
        spec = validate(CaptureSpec, load_yaml(file), file, {})
        if bit_depth not in (None, spec.bit_depth):
            raise SpecError(f"states {spec.bit_depth} bit, {DATA_FILE} {bit_depth}", file=file, key="bit_depth")
        return spec
    if bit_depth is None:
        raise SpecError("no such file; it states bit_depth, tile_rows and tile_cols", file=file)
    try:
        return CaptureSpec(bit_depth=bit_depth, tile_rows=1, tile_cols=1)
    except ValidationError:
        raise SpecError(f"{bit_depth} bit; expected 1 to 16", file=folder / DATA_FILE) from None


def _listed(folder: Path) -> tuple[CaptureSpec, tuple[int, int], list[Series]]:
    """What ``EMVA1288_Data.txt`` lists."""
    file = folder / DATA_FILE
    shape: tuple[int, int] | None = None
    bit_depth: int | None = None
    series: list[Series] = []
    for line, text in enumerate(WholeFile(file).text().splitlines(), 1):
        kind, _, rest = text.strip().partition(" ")
        if not kind or kind.startswith("#") or kind == "v":
            continue
        if kind == "n":
            bits, width, height = _numbers(file, line, rest, 3, "n <bits> <width> <height>")
            whole = all(value == int(value) for value in (bits, width, height))
            if not (whole and 1 <= bits <= 16 and width * height <= MOST_PIXELS):
                expected = f"expected 1 to 16 bit and at most {MOST_PIXELS} pixels, whole numbers"
                raise SpecError(f"{printable(rest.strip())}: {expected}", file=file, line=line)
            bit_depth, shape = int(bits), (int(height), int(width))
        elif kind in "bd":
            count, form = (2, "b <exposure ns> <photons>") if kind == "b" else (1, "d <exposure ns>")
            values = _numbers(file, line, rest, count, form)
            series.append(Series(kind == "b", values[0] * _S_PER_NS, (*values, None)[1], (), file, line))
        elif kind == "i":
            if not series:
                raise SpecError("a picture before the first exposure", file=file, line=line)
            picture = _picture(folder, file, line, rest.strip())
            if picture in series[-1].files:
                raise SpecError(f"{picture.name} is twice in one series", file=file, line=line)
            series[-1] = replace(series[-1], files=(*series[-1].files, picture))
        else:
            raise SpecError(
                f"{printable(kind[:20])!r} begins no line of such a file (v, n, b, d, i)", file=file, line=line
            )
    if shape is None or bit_depth is None:
        raise SpecError("has no line 'n <bits> <width> <height>'", file=file)
    return _capture_spec(folder, bit_depth), shape, series


def _numbers(file: Path, line: int, text: str, count: int, expected: str) -> tuple[float, ...]:
    try:
        values = tuple(float(word) for word in text.split())
    except ValueError:
        values = ()
    if len(values) != count or not all(math.isfinite(value) and value > 0 for value in values):
        raise SpecError(f"expected {expected}, numbers above 0", file=file, line=line)
    return values


def _picture(folder: Path, file: Path, line: int, name: str) -> Path:
    """A picture of the list: its name has slashes or backslashes, and does not leave the folder."""
    path = Path(name.replace("\\", "/"))
    shown = printable(name[:100])
    with reading(file):
        if not name or leads_out(folder, path):
            raise SpecError(f"{shown!r} leads out of its folder", file=file, line=line)
        if not (folder / path).is_file():
            raise SpecError(f"no such file: {shown!r}", file=file, line=line)
    return folder / path


def _named(folder: Path) -> tuple[CaptureSpec, tuple[int, int], list[Series]]:
    """Frames of a plain folder, by their names."""
    result: dict[tuple[bool, float, float | None], list[tuple[int, Path]]] = {}
    for path in sorted(folder.iterdir()):
        match = _NAME.fullmatch(path.name)
        if match is None:
            if path.suffix.lower() in RAW_SUFFIXES:
                raise SpecError(f"the name states no light and exposure; expected {_NAME_STATED}", file=path)
            continue
        light, exposure, photons, number, _ = match.groups()
        texts = exposure if photons is None else f"{exposure} {photons}"
        stated = _numbers(path, 1, texts, 1 if photons is None else 2, _NAME_STATED)
        if leads_out(folder, path.name):
            raise SpecError("leads out of its folder", file=path)
        result.setdefault((light == "lit", stated[0] * S_PER_US, None if photons is None else stated[1]), []).append(
            (int(number), path)
        )
    spec = _capture_spec(folder, None)
    series = [Series(*key, tuple(p for _, p in sorted(files)), folder, None) for key, files in result.items()]
    return spec, _size(series[0].files[0]), series


def _size(file: Path) -> tuple[int, int]:
    """Rows and columns of a frame."""
    if file.suffix.lower() != ".png":
        raise SpecError("the frames of a plain folder are PNG files", file=file)
    from PIL import Image

    with reading(file, "as a PNG file"), Image.open(file, formats=["PNG"]) as image:
        cols, rows = image.size
    if rows * cols > MOST_PIXELS:
        raise SpecError(f"is of {cols}x{rows} px", file=file)
    return rows, cols


def _arranged(file: Path, spec: CaptureSpec, shape: tuple[int, int], series: list[Series]) -> PairSet:
    """The series by what they are for."""
    if sum(len(entry.files) for entry in series) > _MOST_FRAMES:
        raise SpecError(f"lists more than {_MOST_FRAMES} frames", file=file)
    for entry in series:
        if len(entry.files) < 2:
            raise entry.error(f"{len(entry.files)} frame; a pair has two, and a variance follows from their difference")
    pairs = {
        lit: sorted((s for s in series if s.lit == lit and len(s.files) == 2), key=_order) for lit in (True, False)
    }
    dark = {entry.exposure_s: entry for entry in pairs[False]}
    for entry in pairs[True]:
        if entry.exposure_s not in dark:
            raise entry.error("no dark pair of this exposure")
    if len(pairs[True]) < _FEWEST_EXPOSURES:
        problem = f"{len(pairs[True])} lit pairs; EMVA 1288 asks for 50, and {_FEWEST_EXPOSURES} are the fewest"
        raise SpecError(problem, file=file)
    spatial = {}
    for lit, name in ((True, "lit"), (False, "dark")):
        result = [entry for entry in series if entry.lit == lit and len(entry.files) > 2]
        if len(result) != 1:
            where = f", at {' and '.join(s.label for s in result)}" if result else ""
            raise SpecError(
                f"{len(result)} {name} series of more than two frames{where}; one is needed, for DSNU and PRNU",
                file=file,
            )
        spatial[lit] = result[0]
    if spatial[True].exposure_s != spatial[False].exposure_s:
        raise spatial[True].error(
            f"the dark series is of {spatial[False].exposure_s * 1e6:g} µs; both need one exposure"
        )
    return PairSet(
        file, spec, shape, tuple(pairs[True]), tuple(dark[s.exposure_s] for s in pairs[True]), spatial[True],
        spatial[False],
    )  # fmt: skip


def _order(series: Series) -> tuple[float, float]:
    return series.photons or 0.0, series.exposure_s
