"""Captures of EMVA 1288: pairs of frames at many exposures, and one series of many frames, dark and lit.

Two layouts are read: that of the standard's own data sets (``EMVA1288_Data.txt``, or a list of another name), and a
plain folder whose file names state light and exposure (``lit_5160us_15508ph_01.png``). Frames are read one at a time.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import leads_out, printable
from hesim_render.core.units import S_PER_US
from hesim_render.recording.camera_raw import RAW_SUFFIXES
from hesim_render.recording.emva_list import Series, find_list, numbers, read_list
from hesim_render.recording.grey_picture import PICTURE_SUFFIXES, grey_size, read_grey
from hesim_render.specs.capture import CaptureSpec
from hesim_render.specs.files import read_spec

#: Names of a plain folder: light, exposure in µs, photons per pixel if known, number of the frame.
_NAME = re.compile(r"(dark|lit)_([0-9.]+)us(?:_([0-9.]+)ph)?_([0-9]+)(\.[A-Za-z]+)")
_NAME_STATED = "lit_<exposure>us_<photons>ph_<number>.png or dark_<exposure>us_<number>.png"
#: Most frames of a set: a hundred times those of the standard.
_MOST_FRAMES = 30_000
#: Exposures at which a variance is known, below which no line is fitted.
_FEWEST_EXPOSURES = 5
#: Exposures that differ by less, relatively, are one.
_SAME_EXPOSURE = 1e-3
#: Part of saturation at which the standard takes the long series.
_LONG_AT = 0.5


@dataclass(frozen=True)
class PairSet:
    """Captures of EMVA 1288.

    Attributes
    ----------
    file : the list of the frames, or the folder.
    spec : description, as that of other captures.
    shape : rows and columns.
    lit, dark : pairs in order of light and exposure; ``dark[k]`` belongs to ``lit[k]``, and one may stand there often.
    spatial_lit, spatial_dark : series of many frames that are used.
    long : all of them, lit and dark, where there are several lights.
    halved : every second exposure of a set alone.
    tile, position : rows and columns of a colour mosaic, and the place in it whose pixels are the frames.
    """

    file: Path
    spec: CaptureSpec
    shape: tuple[int, int]
    lit: tuple[Series, ...]
    dark: tuple[Series, ...]
    spatial_lit: Series
    spatial_dark: Series
    long: tuple[tuple[Series, Series], ...] = ()
    tile: tuple[int, int] = (1, 1)
    position: tuple[int, int] = (0, 0)
    halved: bool = False

    @property
    def has_photons(self) -> bool:
        return all(series.photons is not None for series in self.lit)

    @property
    def is_dark_once(self) -> bool:
        """Whether dark frames of one exposure stand for those of all, so that dark current counts as light."""
        return any(not _same(lit.exposure_s, dark.exposure_s) for lit, dark in zip(self.lit, self.dark, strict=True))

    def with_long_at(self, light: float) -> "PairSet":
        """The set with that long series which is nearest to some light, in photons or else in s of exposure."""
        if len(self.long) < 2:
            return self
        lit, dark = min(self.long, key=lambda both: abs(light_of_series(both[0], self.has_photons) - light))
        return replace(self, spatial_lit=lit, spatial_dark=dark)

    def with_long_of(self, other: "PairSet") -> "PairSet":
        """The set with the long series of the light that another set of the same list uses."""
        return self.with_long_at(light_of_series(other.spatial_lit, other.has_photons))

    def half(self, number: int) -> "PairSet":
        """Every second exposure and every second frame of the long series, from the first (0) or the second (1) on."""
        cut = slice(number, None, 2)

        def of(series: Series) -> Series:
            return replace(series, files=series.files[cut])

        return replace(
            self, halved=True, lit=self.lit[cut], dark=self.dark[cut],
            spatial_lit=of(self.spatial_lit), spatial_dark=of(self.spatial_dark),
            long=tuple((of(lit), of(dark)) for lit, dark in self.long),
        )  # fmt: skip

    def frames(self, series: Series) -> Iterator[NDArray[np.uint16]]:
        """The frames of a series, [row, col], one at a time.

        Raises
        ------
        SpecError
            If a frame cannot be read, is of another size, or holds larger values than the stated bits allow.
        """
        rows, cols = (count * of for count, of in zip(self.shape, self.tile, strict=True))
        for file in series.files:
            frame = read_grey(file, (rows, cols))[self.position[0] :: self.tile[0], self.position[1] :: self.tile[1]]
            frame = self._shifted(series, file, frame)
            if int(frame.max()) > self.spec.full_scale_dn:
                raise series.error(f"{file.name} holds {frame.max()} DN, more than {self.spec.bit_depth} bit have")
            yield frame

    @cached_property
    def _left_bits(self) -> int:
        """Bits that the values are shifted to the left by in files of 16 bits, seen in the brightest frame."""
        spare = 16 - self.spec.bit_depth
        rows, cols = (count * of for count, of in zip(self.shape, self.tile, strict=True))
        frame = read_grey(self.lit[-1].files[-1], (rows, cols))
        low = (1 << spare) - 1
        return spare if frame.max() > self.spec.full_scale_dn and not np.any(frame & low) else 0

    def _shifted(self, series: Series, file: Path, frame: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """The frame without the zeros below the ADC's last bit."""
        if self._left_bits == 0:
            return frame
        if np.any(frame & ((1 << self._left_bits) - 1)):
            raise series.error(
                f"{file.name} has values that are no multiples of {1 << self._left_bits}, as the brightest frame has"
            )
        return np.right_shift(frame, np.uint16(self._left_bits))


def is_pair_set(folder: str | Path) -> bool:
    """Whether a folder holds captures in one of the two layouts, or a file is a list of such."""
    path = Path(folder)
    if find_list(path) is not None:
        return True
    return path.is_dir() and any(_NAME.fullmatch(entry.name) for entry in path.iterdir())


def read_pair_set(folder: str | Path) -> PairSet:
    """Open the captures in `folder`; no frame is read but the first of a plain folder, for its size.

    Parameters
    ----------
    folder : the folder, or the list in it.

    Raises
    ------
    SpecError
        With file and line, if the list is wrong, names files outside the folder, or lacks a frame of a pair, a dark
        exposure or a long series.
    """
    path = Path(folder)
    where = find_list(path)
    if where is not None:
        path = where.parent
        spec, shape, series = _listed(where)
    else:
        spec, shape, series = _named(path)
        where = path
    tile, position = (spec.tile_rows, spec.tile_cols), spec.tile_position
    if tile != (1, 1) and position is None:
        raise SpecError(
            "EMVA 1288 evaluates one colour at a time: state tile_position: [row, column], the place in the tile to "
            "evaluate, or give the frames of each position a folder of their own, with tile_rows and tile_cols 1",
            file=path / "capture.yaml",
        )
    if spec.roi is not None and shape != (spec.roi.height_px, spec.roi.width_px):
        raise SpecError(f"roi is not of the frames' size, {shape[1]}x{shape[0]}", file=path / "capture.yaml")
    if shape[0] % tile[0] or shape[1] % tile[1]:
        raise SpecError(
            f"frames of {shape[1]}x{shape[0]} px do not hold whole tiles of {tile[1]}x{tile[0]}",
            file=path / "capture.yaml",
        )
    shape = shape[0] // tile[0], shape[1] // tile[1]
    of_place: dict[str, object] = {} if tile == (1, 1) else {"tile_position": None, "roi": None}
    own = spec.model_copy(update={"tile_rows": 1, "tile_cols": 1, **of_place})
    return replace(_arranged(where, own, shape, series), tile=tile, position=position or (0, 0))


def _capture_spec(folder: Path, bit_depth: int | None, listed: str = "") -> CaptureSpec:
    """``capture.yaml``; a list of the standard states the bits itself and needs none."""
    file = folder / "capture.yaml"
    if file.is_file():
        spec = read_spec(CaptureSpec, file)
        if bit_depth not in (None, spec.bit_depth):
            raise SpecError(f"states {spec.bit_depth} bit, {listed} {bit_depth}", file=file, key="bit_depth")
        return spec
    if bit_depth is None:
        raise SpecError("no such file; it states bit_depth, tile_rows and tile_cols", file=file)
    try:
        return CaptureSpec(bit_depth=bit_depth, tile_rows=1, tile_cols=1)
    except ValidationError:
        raise SpecError(f"{bit_depth} bit; expected 1 to 16", file=folder / listed) from None


def _listed(file: Path) -> tuple[CaptureSpec, tuple[int, int], list[Series]]:
    """What a list of the standard's form lists."""
    own = file.parent / "capture.yaml"
    unit = read_spec(CaptureSpec, own).exposure_unit if own.is_file() else None
    bit_depth, shape, series = read_list(file, unit)
    return _capture_spec(file.parent, bit_depth, file.name), shape, series


def _named(folder: Path) -> tuple[CaptureSpec, tuple[int, int], list[Series]]:
    """Frames of a plain folder, by their names."""
    result: dict[tuple[bool, float, float | None], list[tuple[int, Path]]] = {}
    for path in sorted(folder.iterdir()):
        match = _NAME.fullmatch(path.name)
        if match is None:
            if path.suffix.lower() in (*RAW_SUFFIXES, *PICTURE_SUFFIXES):
                raise SpecError(f"the name states no light and exposure; expected {_NAME_STATED}", file=path)
            continue
        light, exposure, photons, number, _ = match.groups()
        texts = exposure if photons is None else f"{exposure} {photons}"
        stated = numbers(path, 1, texts, (1 if photons is None else 2,), _NAME_STATED)
        if leads_out(folder, path.name):
            raise SpecError("leads out of its folder", file=path)
        result.setdefault((light == "lit", stated[0] * S_PER_US, None if photons is None else stated[1]), []).append(
            (int(number), path)
        )
    spec = _capture_spec(folder, None)
    series = [Series(*key, tuple(p for _, p in sorted(files)), folder, None) for key, files in result.items()]
    return spec, grey_size(series[0].files[0]), series


def _arranged(file: Path, spec: CaptureSpec, shape: tuple[int, int], series: list[Series]) -> PairSet:
    """The series by what they are for."""
    if sum(len(entry.files) for entry in series) > _MOST_FRAMES:
        raise SpecError(f"lists more than {_MOST_FRAMES} frames", file=file)
    for entry in series:
        if len(entry.files) < 2:
            only = f"{printable(entry.files[0].name)} alone" if entry.files else "no frame"
            raise entry.error(f"{only}; a pair has two frames, and a variance follows from their difference")
    ordered = sorted(series, key=lambda entry: (entry.photons or 0.0, entry.exposure_s))
    pairs = {lit: [entry for entry in ordered if entry.lit == lit and len(entry.files) == 2] for lit in (True, False)}
    if len(pairs[True]) < _FEWEST_EXPOSURES:
        problem = f"{len(pairs[True])} lit pairs; EMVA 1288 asks for 50, and {_FEWEST_EXPOSURES} are the fewest"
        raise SpecError(problem, file=file)
    dark = _dark_of(pairs[True], pairs[False], [s for s in series if not s.lit])
    long = _long_series(file, series)
    result = PairSet(file, spec, shape, tuple(pairs[True]), tuple(dark), *long[0], long=tuple(long))
    return result.with_long_at(_LONG_AT * max(light_of_series(entry, result.has_photons) for entry in result.lit))


def _dark_of(lit: list[Series], dark: list[Series], all_dark: list[Series]) -> list[Series]:
    """The dark pair of each lit one. Where dark frames of one exposure are all there is, they stand for every one.

    The first two frames of a long series are a pair.
    """
    exposures = {entry.exposure_s for entry in all_dark}
    only = all_dark[0] if len(exposures) == 1 else None
    if only is not None and len(only.files) > 2:
        only = dark[0] if dark else replace(only, files=only.files[:2])
    result = []
    for entry in lit:
        nearest = min(dark, key=lambda pair: abs(pair.exposure_s - entry.exposure_s), default=None)
        if nearest is None or not _same(nearest.exposure_s, entry.exposure_s):
            nearest = only
        if nearest is None:
            raise entry.error(
                "no dark pair of this exposure; capture one for each, or dark frames of a single exposure for all"
            )
        result.append(nearest)
    return result


def _long_series(file: Path, series: list[Series]) -> list[tuple[Series, Series]]:
    """The series of more than two frames, lit and dark, that belong together."""
    by_light = {lit: [s for s in series if s.lit == lit and len(s.files) > 2] for lit in (True, False)}
    for lit, name in ((True, "lit"), (False, "dark")):
        if not by_light[lit]:
            raise SpecError(f"0 {name} series of more than two frames; one is needed, for DSNU and PRNU", file=file)
    is_dark_once = len({s.exposure_s for s in series if not s.lit}) == 1
    result = []
    for entry in by_light[True]:
        nearest = min(by_light[False], key=lambda dark: abs(dark.exposure_s - entry.exposure_s))
        if is_dark_once or _same(nearest.exposure_s, entry.exposure_s):
            result.append((entry, nearest))
    if not result:
        raise by_light[True][0].error(
            f"the dark series is of {by_light[False][0].exposure_s * 1e6:g} µs; both need one exposure"
        )
    return result


def _same(first_s: float, second_s: float) -> bool:
    return abs(first_s - second_s) <= _SAME_EXPOSURE * max(first_s, second_s)


def light_of_series(series: Series, has_photons: bool) -> float:
    """Photons per pixel of a series, or its exposure in s where photons are not stated."""
    return series.photons or 0.0 if has_photons else series.exposure_s
