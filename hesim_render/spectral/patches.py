"""Patches of a user's chart from a CSV file: measured reflectances, or CIELAB values."""

import csv
import functools
import warnings
from pathlib import Path

import numpy as np

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import WholeFile
from hesim_render.spectral.spectrum import Spectrum, colour_science

_LAB = ("l", "a", "b")


def read_patches(file: Path) -> dict[str, Spectrum]:
    """Reflectances of the patches of a file, by name, in its order.

    The first line is a header: ``name`` and wavelengths in nm, or ``name, L, a, b``; lines that begin with ``#`` are
    comments. CIELAB values are those of the patch under D50 for the 2° observer. Their reflectance is the smooth one
    of [jakob2019] that has this colour under D50; it takes 0.1 s a patch.

    Parameters
    ----------
    file : the CSV file.

    Raises
    ------
    SpecError
        If the file is not valid; the message names file and line.
    """
    lines = [
        (number, [cell.strip() for cell in next(csv.reader([line]))])
        for number, line in enumerate(WholeFile(file).text().splitlines(), 1)
        if line.split("#", 1)[0].strip()
    ]
    if not lines:
        raise SpecError("a chart needs a header line and a line per patch", file=file)
    (first, header), rows = lines[0], lines[1:]
    is_lab = tuple(cell.lower().rstrip("*") for cell in header[1:]) == _LAB
    wavelengths = None if is_lab else _wavelengths(header, file, first)
    result: dict[str, Spectrum] = {}
    for number, cells in rows:
        if len(cells) != len(header):
            raise SpecError(f"expected {len(header)} cells, found {len(cells)}", file=file, line=number)
        name = cells[0]
        if not name or name in result:
            raise SpecError(f"the name {name!r} is {'empty' if not name else 'there twice'}", file=file, line=number)
        try:
            values = np.array([float(cell) for cell in cells[1:]])
        except ValueError:
            raise SpecError(
                f"expected numbers after the name, found {','.join(cells[1:])!r}", file=file, line=number
            ) from None
        if not np.isfinite(values).all():
            raise SpecError("a value is not finite", file=file, line=number)
        if wavelengths is None:
            result[name] = _of_lab(tuple(values.tolist()), file, number)
            continue
        if values.min() < 0 or values.max() > 1:
            hint = "; divide percent by 100" if values.max() > 1.5 else ""
            raise SpecError(
                f"a reflectance must lie in [0, 1]; this one runs from {values.min():g} to {values.max():g}{hint}",
                file=file,
                line=number,
            )
        result[name] = Spectrum(wavelengths, values)
    return result


def _wavelengths(header: list[str], file: Path, line: int) -> np.ndarray:
    try:
        wavelengths = np.array([float(cell.lower().removesuffix("nm")) for cell in header[1:]])
    except ValueError:
        wavelengths = np.empty(0)
    if wavelengths.size < 2 or not np.all(np.diff(wavelengths) > 0):
        raise SpecError(
            "the header must be 'name' and increasing wavelengths in nm, or 'name,L,a,b'", file=file, line=line
        )
    return wavelengths


def _of_lab(lab: tuple[float, ...], file: Path, line: int) -> Spectrum:
    if not 0 <= lab[0] <= 100:
        raise SpecError(f"L must lie in 0 to 100; it is {lab[0]:g}", file=file, line=line)
    spectrum = _recovered(*lab)
    if spectrum is None:
        raise SpecError(f"no reflectance in [0, 1] has the colour L, a, b = {lab}", file=file, line=line)
    return spectrum


#: Largest difference ΔE*ab between a patch and the colour of its recovered reflectance.
MOST_DELTA_E = 0.5


@functools.lru_cache(maxsize=4096)
def _recovered(lightness: float, a: float, b: float) -> Spectrum | None:
    colour = colour_science()
    white = colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]["D50"]
    light = colour.SDS_ILLUMINANTS["D50"]
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    wanted = np.array([lightness, a, b])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that tables are brought to one grid
        distribution = colour.recovery.XYZ_to_sd_Jakob2019(colour.Lab_to_XYZ(wanted, white), observer, light)
        got = colour.XYZ_to_Lab(colour.sd_to_XYZ(distribution, observer, light) / 100, white)
    if np.linalg.norm(got - wanted) > MOST_DELTA_E:
        return None
    return Spectrum(np.asarray(distribution.wavelengths), np.clip(np.asarray(distribution.values), 0.0, 1.0))
