"""Spectra: values on an explicit wavelength grid in nm, linear between their samples.

The integral of a product is exact (`integrate_product`); where a product has to be a spectrum itself, it
is sampled on the merged grid of all factors, refined to 1 nm or finer (0.02 % off; the unrefined merged
grid is 0.25-0.4 % off, sums of 10 nm rectangles up to 8 %). Named data come from colour-science; see
`illuminant`, `colorchecker_reflectances` and `camera_sensitivity`. Those of most scenes and sensors are copied to
``named.npz``, because the import of colour-science takes most of a second.
"""

import functools
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.errors import SpecError, did_you_mean
from hesim_render.core.guard import WholeFile
from hesim_render.core.npz import read_arrays
from hesim_render.core.units import LUMINOUS_EFFICACY_LM_PER_W

#: Largest step of the grid on which products are integrated, nm.
INTEGRATION_STEP_NM = 1.0
#: Share of a response that light and reflectance must cover; a smaller coverage would lose signal silently.
REQUIRED_COVERAGE = 0.999
#: Copies from colour-science by ``tests/spectral/test_named.py``: rows of wavelengths, nm, and values, ``table/curve``.
NAMED_FILE = Path(__file__).with_name("named.npz")
#: Wavelengths the spectral renderer can carry, nm (Mitsuba 3's CIE range).
RENDERABLE_NM = (360.0, 830.0)


@dataclass(frozen=True)
class Spectrum:
    """A piecewise-linear function of wavelength, zero outside its table.

    Parameters
    ----------
    wavelength_nm : strictly increasing, shape [n], n >= 2.
    values : same shape; the unit is the caller's and is stated where the spectrum is used.
    """

    wavelength_nm: NDArray[np.float64]
    values: NDArray[np.float64]

    def __post_init__(self) -> None:
        wavelength = np.asarray(self.wavelength_nm, dtype=np.float64)
        values = np.asarray(self.values, dtype=np.float64)
        if wavelength.ndim != 1 or wavelength.size < 2 or wavelength.shape != values.shape:
            raise SpecError(
                f"a spectrum needs two equally long lists of at least 2 numbers, not shapes "
                f"{wavelength.shape} and {values.shape}"
            )
        if not np.all(np.diff(wavelength) > 0):
            raise SpecError("wavelengths of a spectrum must increase strictly, in nm")
        if not (np.all(np.isfinite(wavelength)) and np.all(np.isfinite(values))):
            raise SpecError("a spectrum holds a value that is not finite")
        object.__setattr__(self, "wavelength_nm", wavelength)
        object.__setattr__(self, "values", values)

    @property
    def support_nm(self) -> tuple[float, float]:
        """First and last wavelength of the table, nm."""
        return float(self.wavelength_nm[0]), float(self.wavelength_nm[-1])

    def at(self, wavelength_nm: ArrayLike) -> NDArray[np.float64]:
        """Values at `wavelength_nm`, zero outside the table."""
        wanted = np.asarray(wavelength_nm, dtype=np.float64)
        return np.interp(wanted, self.wavelength_nm, self.values, left=0.0, right=0.0)

    def scaled(self, factor: float) -> "Spectrum":
        return Spectrum(self.wavelength_nm, self.values * factor)

    def integral(self) -> float:
        """∫ f dλ over the table, exact for a piecewise-linear function."""
        return float(np.trapezoid(self.values, self.wavelength_nm))


def constant(value: float, low_nm: float = 300.0, high_nm: float = 1100.0) -> Spectrum:
    """A flat spectrum."""
    return Spectrum(np.array([low_nm, high_nm]), np.array([value, value], dtype=float))


def _merged_knots(*spectra: Spectrum) -> NDArray[np.float64]:
    """Union of all sample points over the common support; empty where the supports do not overlap."""
    low = max(s.support_nm[0] for s in spectra)
    high = min(s.support_nm[1] for s in spectra)
    if low >= high:
        return np.empty(0)
    knots = np.unique(np.concatenate([s.wavelength_nm for s in spectra] + [np.array([low, high])]))
    return knots[(knots >= low) & (knots <= high)]


def merged_grid(*spectra: Spectrum, step_nm: float = INTEGRATION_STEP_NM) -> NDArray[np.float64]:
    """Union of all sample points over the common support, refined to `step_nm` or finer.

    Empty where the supports do not overlap.
    """
    knots = _merged_knots(*spectra)
    if knots.size == 0:
        return knots
    pieces = np.maximum(1, np.ceil(np.diff(knots) / step_nm - 1e-9)).astype(int)
    starts = np.repeat(np.cumsum(pieces) - pieces, pieces)
    fraction = (np.arange(pieces.sum()) - starts) / np.repeat(pieces, pieces)
    inner = np.repeat(knots[:-1], pieces) + fraction * np.repeat(np.diff(knots), pieces)
    return np.append(inner, knots[-1])


def integrate_product(*spectra: Spectrum) -> float:
    """∫ f·g·… dλ over the common support, exactly. Unit: product of units × nm.

    Between the merged sample points the product of n spectra is a polynomial of degree n, for which Gauss and
    Legendre's rule with ⌈(n + 1)/2⌉ nodes is exact.
    """
    knots = _merged_knots(*spectra)
    if knots.size == 0:
        return 0.0
    place, weight = np.polynomial.legendre.leggauss((len(spectra) + 2) // 2)
    half, middle = np.diff(knots) / 2, (knots[1:] + knots[:-1]) / 2
    values = np.prod([s.at(middle + half * place[:, None]) for s in spectra], axis=0)
    return float(np.sum(weight @ values * half))


def product(*spectra: Spectrum) -> Spectrum:
    """The product sampled on `merged_grid`, over the common support.

    Raises
    ------
    SpecError
        If the supports do not overlap.
    """
    grid = merged_grid(*spectra)
    if grid.size == 0:
        supports = ", ".join("{:g}-{:g} nm".format(*s.support_nm) for s in spectra)
        raise SpecError(f"spectra do not overlap in wavelength ({supports})")
    return Spectrum(grid, np.prod([s.at(grid) for s in spectra], axis=0))


def summed(*spectra: Spectrum) -> Spectrum:
    """The sum over the union of all tables; where a table ends at a value other than 0, the sum drops within 0.001
    nm.
    """
    edges = np.array([s.support_nm for s in spectra])
    steps = np.concatenate([edges[:, 0] - 1e-3, edges[:, 1] + 1e-3])
    low, high = edges.min(), edges.max()
    knots = np.unique(np.concatenate([s.wavelength_nm for s in spectra] + [steps[(steps > low) & (steps < high)]]))
    return Spectrum(knots, np.sum([s.at(knots) for s in spectra], axis=0))


def coverage(spectrum: Spectrum, response: Spectrum) -> float:
    """Share of ∫ response dλ that lies inside the table of `spectrum`."""
    total = integrate_product(response, constant(1.0, *response.support_nm))
    return integrate_product(response, constant(1.0, *spectrum.support_nm)) / total if total else 1.0


def require_coverage(spectrum: Spectrum, response: Spectrum, what: str, response_name: str) -> None:
    """Raise `SpecError` unless `spectrum` covers at least 99.9 % of `response`."""
    share = coverage(spectrum, response)
    if share < REQUIRED_COVERAGE:
        low, high = spectrum.support_nm
        first, last = response.support_nm
        raise SpecError(
            f"{what} covers {low:g}-{high:g} nm, only {share:.2%} of the response of {response_name} "
            f"({first:g}-{last:g} nm); at least {REQUIRED_COVERAGE:.1%} is needed"
        )


@functools.cache
def colour_science() -> Any:
    """The module ``colour``. Its import sets NumPy's print options for the whole program; they are restored."""
    before = np.get_printoptions()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns about optional packages that are not installed
        import colour
    np.set_printoptions(**before)
    return colour


@functools.cache
def _copies() -> dict[str, dict[str, Spectrum]]:
    """Curves by table and name, of `NAMED_FILE`."""
    tables: dict[str, dict[str, Spectrum]] = {}
    for name, rows in read_arrays(NAMED_FILE).items():
        table, _, curve = name.partition("/")
        tables.setdefault(table, {})[curve] = Spectrum(*rows)
    return tables


def _from_colour(distribution) -> Spectrum:  # noqa: ANN001 - colour.SpectralDistribution
    return Spectrum(np.asarray(distribution.wavelengths), np.asarray(distribution.values))


def _lookup(table, name: str, what: str):  # noqa: ANN001
    try:
        return table[name]
    except KeyError:
        known = ", ".join(repr(key) for key in sorted(map(str, table)))
        raise SpecError(f"unknown {what} {name!r}; known are {known}{did_you_mean(name, map(str, table))}") from None


def illuminant_names() -> list[str]:
    """Names `illuminant` accepts: CIE illuminants and measured light sources of colour-science."""
    colour = colour_science()
    return sorted({*colour.SDS_ILLUMINANTS, *colour.SDS_LIGHT_SOURCES})


def illuminant(name: str) -> Spectrum:
    """Relative spectral power of a named illuminant (``D65``, ``A``, ``FL11``, ``LED-B3``, …)."""
    if copy := _copies().get(f"illuminant {name}"):
        return copy[name]
    colour = colour_science()
    if name in colour.SDS_LIGHT_SOURCES:
        return _from_colour(colour.SDS_LIGHT_SOURCES[name])
    return _from_colour(_lookup(colour.SDS_ILLUMINANTS, name, "illuminant"))


def colorchecker_reflectances(dataset: str = "ISO 17321-1") -> dict[str, Spectrum]:
    """Measured reflectances of the 24 ColorChecker patches, by name, in chart order (row by row).

    Parameters
    ----------
    dataset : ``ISO 17321-1`` and ``ColorChecker N Ohta`` reach from 380 to 780 nm;
        ``BabelColor Average`` (30 charts averaged) ends at 730 nm.
    """
    return dict(_patches(dataset))


@functools.cache
def _patches(dataset: str) -> dict[str, Spectrum]:
    """The patches of a chart; a scene of many tiles asks for them as often."""
    if copy := _copies().get(f"ColorChecker {dataset}"):
        return copy
    charts = colour_science().SDS_COLOURCHECKERS
    return {name: _from_colour(sd) for name, sd in _lookup(charts, dataset, "ColorChecker data set").items()}


def camera_sensitivity(camera: str, channel: str) -> Spectrum:
    """Peak-normalised camera sensitivity per unit *energy* of colour-science, per channel."""
    curves = _copies().get(f"camera {camera}")
    if curves is None:
        table = _lookup(colour_science().MSDS_CAMERA_SENSITIVITIES, camera, "camera")
        curves = {str(one.name): _from_colour(one) for one in table.to_sds()}
    if channel not in curves:
        raise SpecError(f"camera {camera!r} has no channel {channel!r}; it has {', '.join(curves)}")
    return curves[channel]


def srgb_reflectances() -> tuple[Spectrum, Spectrum, Spectrum]:
    """Reflectances of linear sRGB red, green and blue, [mallett2019], 380-780 nm at 5 nm.

    Each lies between 0 and 1, they sum to 1, and under D65 a mixture has the tristimulus values of its colour.
    """
    red, green, blue = _copies()["sRGB"].values()
    return red, green, blue


def photopic() -> Spectrum:
    """V(λ), CIE 1924 photopic luminous efficiency, 360-830 nm at 1 nm."""
    (curve,) = _copies()["V"].values()
    return curve


def colour_matching_functions() -> tuple[Spectrum, Spectrum, Spectrum]:
    """x̄, ȳ, z̄ of the CIE 1931 2° observer, 360-830 nm at 1 nm."""
    x, y, z = _copies()["CIE 1931"].values()
    return x, y, z


def illuminance_lux(spectral_irradiance: Spectrum) -> float:
    """E_v = 683.002 lm/W · ∫ E(λ) V(λ) dλ, for E in W m⁻² nm⁻¹."""
    return LUMINOUS_EFFICACY_LM_PER_W * integrate_product(spectral_irradiance, photopic())


def scale_to_lux(shape: Spectrum, lux: float) -> Spectrum:
    """Spectral irradiance in W m⁻² nm⁻¹ with the shape of `shape` and an illuminance of `lux`.

    Raises
    ------
    SpecError
        If the spectrum has no luminance (a near-infrared source has no lux).
    """
    unit = illuminance_lux(shape)
    if unit <= 0:
        raise SpecError("this light has no illuminance in lux (nothing inside V(λ)); give it in W m^-2 instead")
    return shape.scaled(lux / unit)


def scale_to_irradiance(shape: Spectrum, w_per_m2: float) -> Spectrum:
    """Spectral irradiance in W m⁻² nm⁻¹ with a total of `w_per_m2` over the table of `shape`."""
    total = shape.integral()
    if total <= 0:
        raise SpecError("this light has no power over its table")
    return shape.scaled(w_per_m2 / total)


def read_csv(file: Path, column: str | int | None = None) -> Spectrum:
    """Spectrum from a CSV file: wavelength in nm in the first column, one value column each after.

    Lines that start with ``#`` are comments; a header line is recognised by its text.

    Parameters
    ----------
    column : header name or 1-based number of the value column; default the only one.
    """
    lines = WholeFile(file).text().splitlines()
    header: list[str] | None = None
    rows: list[list[float]] = []
    for number, line in enumerate(lines, 1):
        text = line.split("#", 1)[0].strip()
        if not text:
            continue
        cells = [cell.strip() for cell in text.replace(";", ",").replace("\t", ",").split(",")]
        try:
            rows.append([float(cell) for cell in cells])
        except ValueError:
            if header is None and not rows:
                header = cells
                continue
            raise SpecError("expected numbers separated by commas", file=file, line=number) from None
        if len(rows[-1]) != len(rows[0]) or len(rows[-1]) < 2:
            raise SpecError(f"expected {max(2, len(rows[0]))} columns, found {len(cells)}", file=file, line=number)
    if len(rows) < 2:
        raise SpecError("a spectrum file needs at least 2 rows of numbers", file=file)
    table = np.array(rows)
    index = _csv_column(column, header, table.shape[1], file)
    try:
        return Spectrum(table[:, 0], table[:, index])
    except SpecError as error:
        raise SpecError(str(error), file=file) from None


def _csv_column(column: str | int | None, header: list[str] | None, count: int, file: Path) -> int:
    if column is None:
        if count == 2:
            return 1
        raise SpecError(f"the file has {count - 1} value columns; say which with 'column'", file=file)
    if isinstance(column, int):
        if not 1 <= column < count:
            raise SpecError(f"column {column} does not exist; value columns are 1 to {count - 1}", file=file)
        return column
    if header is None or column not in header[1:]:
        known = ", ".join((header or [])[1:]) or "no header line"
        raise SpecError(f"no column {column!r} ({known})", file=file)
    return header.index(column)
