"""Hyperspectral cubes in files, read by bands of rows: ENVI, MATLAB, HDF5, EXR, NPY, and folders of pictures.

Layouts are those in which CAVE, ICVL, KAIST, Harvard, ARAD-1K and ISETCam store their images. None of these sets is
needed: a file says by its names and shapes which layout it has.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import reading, require_memory
from hesim_render.core.hdf5 import dataset_of

#: Channels of a spectral EXR file, [fichet2021], and those of the EXR files of KAIST.
_EXR_CHANNELS = (re.compile(r"(?:T|S0)\.(\d+(?:,\d+)?)nm"), re.compile(r"w(\d+(?:\.\d+)?)nm"))
#: A plane of a folder of CAVE.
_CAVE = re.compile(r"(.+)_ms_(\d\d)\.png")
#: Wavelengths of sets whose files do not have them: names of the variable, number of bands, first and step in nm.
_KNOWN_BANDS = {
    ("ref", 31): (420.0, 10.0), ("reflectances", 33): (400.0, 10.0), ("reflectances", 32): (410.0, 10.0),
    ("reflectances", 31): (410.0, 10.0), ("cube", 31): (400.0, 10.0), ("rad", 31): (400.0, 10.0),
    ("CAVE", 31): (400.0, 10.0),
}  # fmt: skip
#: Attribute emissiveUnits of spectral EXR files in absolute units.
RADIANCE_UNITS = "W.m^-2.sr^-1.nm^-1"
_WAVELENGTHS = ("bands", "wavelength", "wavelength_nm", "wavelengths", "wave")
_CUBES = ("cube", "rad", "ref", "reflectances", "photons", "data", "mcCOEF")
#: Largest MATLAB v5 file that is loaded whole, as numbers of float64, bytes.
MOST_MATLAB_BYTES = 4 << 30

Rows = Callable[[int, int], NDArray[np.float32]]


@dataclass(frozen=True, eq=False)
class CubeFile:
    """An open cube.

    Parameters
    ----------
    file : the file.
    shape : rows, columns, bands.
    wavelength_nm : [band], increasing; None where the file does not say.
    read : float32 [row, col, band] of the rows from the first number up to the second.
    layout : what was recognised.
    illuminant : [band], light on the scene in the unit of the cube, where the file has it.
    is_absolute : True if the file says that its values are radiance in W m⁻² sr⁻¹ nm⁻¹.
    """

    file: Path
    shape: tuple[int, int, int]
    wavelength_nm: NDArray[np.float64] | None
    read: Rows
    layout: str
    illuminant: NDArray[np.float64] | None = None
    is_absolute: bool = False

    def require_reflectance(self) -> None:
        """Refuse a file that says that it holds radiance.

        Raises
        ------
        SpecError
            If it does.
        """
        if self.is_absolute:
            raise SpecError(
                "holds radiance, as it says, and no reflectance (quantity: radiance, --radiance)", file=self.file
            )

    def whole(self) -> NDArray[np.float32]:
        """All rows; refused if they do not fit into memory."""
        rows, cols, bands = self.shape
        require_memory(4 * rows * cols * bands, "the cube", self.file)
        return self.rows(0, rows)

    def rows(self, first: int, end: int) -> NDArray[np.float32]:
        """Some rows, float32 [row, col, band].

        Raises
        ------
        SpecError
            If they cannot be read, or hold values that are not finite.
        """
        with reading(self.file, "as a cube"):
            values = np.ascontiguousarray(self.read(first, end), dtype=np.float32)
        if not np.isfinite(values).all():
            raise SpecError("holds values that are not finite", file=self.file)
        return values


def open_cube(file: Path, wavelength_nm: Sequence[float] | None = None) -> CubeFile:
    """A hyperspectral cube in a file or a folder; the end of its name tells the kind.

    Parameters
    ----------
    file : ``.hdr`` (ENVI), ``.mat``, ``.h5``, ``.exr``, ``.npy``, or a folder of ``NAME_ms_01.png`` …
    wavelength_nm : of the bands, where the file does not say.

    Returns
    -------
    The open cube, with wavelengths.

    Raises
    ------
    SpecError
        If the file cannot be read, has no cube, or wavelengths are missing, given twice, or do not increase.
    """
    reader = _cave if file.is_dir() else READERS.get(file.suffix.lower())
    if reader is None:
        raise SpecError(f"a cube must be one of {', '.join(READERS)}, not {file.suffix!r}", file=file)
    if not file.exists():
        raise SpecError("no such file", file=file)
    with reading(file, "as a cube"):
        found = reader(file)
    if min(found.shape) < 1 or found.shape[2] < 2:
        raise SpecError(f"expected a cube [row, col, wavelength], found {found.shape}", file=file)
    if wavelength_nm is not None:
        if found.wavelength_nm is not None:
            raise SpecError("has wavelengths of its own: leave wavelength_nm out", file=file, key="wavelength_nm")
        found = replace(found, wavelength_nm=np.asarray(wavelength_nm, dtype=np.float64))
    bands = found.wavelength_nm
    if bands is None:
        raise SpecError("says no wavelengths: give them (wavelength_nm)", file=file, key="wavelength_nm")
    if bands.shape != (found.shape[2],):
        raise SpecError(
            f"the cube has {found.shape[2]} planes and wavelength_nm {bands.size} values", file=file,
            key="wavelength_nm",
        )  # fmt: skip
    if not (np.isfinite(bands).all() and np.all(np.diff(bands) > 0)):
        raise SpecError("the wavelengths of a cube must increase", file=file, key="wavelength_nm")
    return found


def _npy(file: Path) -> CubeFile:
    mapped = np.load(file, mmap_mode="r", allow_pickle=False)
    if mapped.ndim != 3 or mapped.dtype.kind not in "fui":
        raise SpecError(f"expected numbers [row, col, wavelength], found {mapped.dtype} {mapped.shape}", file=file)
    return CubeFile(file, mapped.shape, None, lambda a, b: np.asarray(mapped[a:b]), "NPY")


def _envi(file: Path) -> CubeFile:
    try:
        from spectral.io import envi
    except ImportError:
        raise SpecError("ENVI files need the package spectral: pip install 'hesim_render[cubes]'", file=file) from None
    image = envi.open(str(file))
    header = image.metadata
    bands = None
    if "wavelength" in header:
        bands = np.array([float(value) for value in header["wavelength"]])
        unit = str(header.get("wavelength units", "")).lower()
        if unit in ("micrometers", "um", "µm", "micrometres") or (not unit and bands.max() < 100):
            bands = bands * 1e3
    mapped = image.open_memmap(interleave="bip", writable=False)
    factor = np.float32(1 / float(header.get("reflectance scale factor", 1) or 1))
    shape = int(image.nrows), int(image.ncols), int(image.nbands)
    return CubeFile(file, shape, bands, lambda a, b: np.asarray(mapped[a:b], dtype=np.float32) * factor, "ENVI")


def _exr(file: Path) -> CubeFile:
    import OpenEXR

    with OpenEXR.File(str(file), separate_channels=True) as opened:
        channels = opened.channels()
        is_absolute = opened.header().get("emissiveUnits") == RADIANCE_UNITS
        for pattern in _EXR_CHANNELS:
            found = sorted(
                (float(match[1].replace(",", ".")), name) for name in channels if (match := pattern.fullmatch(name))
            )
            if len(found) >= 2:
                planes = [channels[name].pixels for _, name in found]
                shape = (*planes[0].shape, len(planes))
                bands = np.array([wavelength for wavelength, _ in found])
                return CubeFile(file, shape, bands, _of_planes(planes), "EXR", is_absolute=is_absolute)
        some = ", ".join(sorted(channels)[:8])
    raise SpecError(f"expected channels T.550,0nm … or w550nm … (a picture: R, G, B); found {some}", file=file)


def _of_planes(planes: Sequence[NDArray]) -> Rows:
    return lambda a, b: np.stack([plane[a:b] for plane in planes], axis=-1)


def _cave(file: Path) -> CubeFile:
    """A folder of one 16-bit picture per band; codes are divided by 65535."""
    from PIL import Image

    names = sorted((match[1], int(match[2]), path) for path in file.iterdir() if (match := _CAVE.fullmatch(path.name)))
    if (
        not names
        or len({name for name, _, _ in names}) != 1
        or [n for _, n, _ in names] != list(range(1, len(names) + 1))
    ):
        raise SpecError("expected pictures NAME_ms_01.png, 02, … of one scene", file=file)
    planes = []
    for _, _, path in names:
        with Image.open(path) as image:
            if image.mode not in ("I;16", "I", "L"):
                raise SpecError(f"expected grey codes of 16 bits, found mode {image.mode}", file=path)
            require_memory(2 * image.width * image.height * len(names), "the cube", file)
            planes.append(np.asarray(image) * np.float32(1 / (255 if image.mode == "L" else 65535)))
    if len({plane.shape for plane in planes}) != 1:
        raise SpecError("its pictures differ in size", file=file)
    shape = (*planes[0].shape, len(planes))
    return CubeFile(file, shape, _known_bands("CAVE", len(planes)), _of_planes(planes), "CAVE")


def _matlab(file: Path) -> CubeFile:
    import h5py

    if h5py.is_hdf5(file):
        return _hdf5(file)
    from scipy.io import loadmat, whosmat

    sizes = {"double": 8, "int64": 8, "uint64": 8, "single": 4, "int32": 4, "uint32": 4, "int16": 2, "uint16": 2}
    total = sum(sizes.get(kind, 1) * int(np.prod(shape, dtype=np.int64)) for _, shape, kind in whosmat(file))
    require_memory(total, "a MATLAB v5 file is read whole; this one", file, MOST_MATLAB_BYTES)
    return _of_variables(file, loadmat(file), "MATLAB")


def _of_variables(file: Path, data: dict[str, Any], layout: str) -> CubeFile:
    """Arrays in MATLAB's order: [row, col, band]."""
    name = next((key for key in _CUBES if getattr(data.get(key), "ndim", 0) == 3), None)
    if name is None:
        found = ", ".join(key for key in data if not key.startswith("__"))
        raise SpecError(
            f"expected one of {', '.join(_CUBES)} with three dimensions; found {found or 'nothing'}", file=file
        )
    if name == "mcCOEF":
        return _isetcam_basis(file, data)
    values = np.asarray(data[name])
    bands = _bands_in(data)
    bands = _known_bands(name, values.shape[2]) if bands is None else bands
    if name == "photons" and bands is not None:
        values = values / bands  # photons to energy, relative; the constant does not matter
        layout = "ISETCam"
    return CubeFile(file, values.shape, bands, lambda a, b: values[a:b], layout)


def _isetcam_basis(file: Path, data: dict[str, Any]) -> CubeFile:
    """ISETCam: photons = mcCOEF · basisᵀ + imgMean at each pixel; radiance is proportional to photons/λ."""
    basis = data.get("basis")
    fields = {key: np.asarray(basis[key][0, 0]) for key in ("wave", "basis")} if basis is not None else {}
    if len(fields) != 2:
        raise SpecError("mcCOEF needs a structure basis with wave and basis", file=file)
    bands = fields["wave"].astype(np.float64).ravel()
    coefficients, table = np.asarray(data["mcCOEF"]), fields["basis"].astype(np.float64)
    if table.shape != (bands.size, coefficients.shape[2]):
        raise SpecError(f"basis of shape {table.shape} does not fit {bands.size} wavelengths", file=file)
    mean = np.asarray(data.get("imgMean", np.zeros(bands.size)), dtype=np.float64).ravel()
    light = data.get("illuminant")
    illuminant = None
    if light is not None and light.dtype.names and "data" in light.dtype.names:
        given = np.asarray(light["data"][0, 0]).astype(np.float64).ravel()
        illuminant = given / bands if given.size == bands.size else None

    def read(first: int, end: int) -> NDArray[np.float32]:
        return np.asarray((coefficients[first:end] @ table.T + mean) / bands, dtype=np.float32)

    return CubeFile(file, (*coefficients.shape[:2], bands.size), bands, read, "ISETCam", illuminant)


def _hdf5(file: Path) -> CubeFile:
    """MATLAB v7.3 and HDF5: MATLAB writes the axes of an array in the opposite order."""
    import h5py

    opened = h5py.File(file, "r")
    name = next((key for key in _CUBES if isinstance(opened.get(key), h5py.Dataset) and opened[key].ndim == 3), None)
    if name is None:
        raise SpecError(
            f"expected a data set {', '.join(_CUBES)} with three dimensions; found {', '.join(opened)}", file=file
        )
    data = dataset_of(opened, name, file, "fui")
    bands = _bands_in(
        {key: np.asarray(opened[key]) for key in _WAVELENGTHS if isinstance(opened.get(key), h5py.Dataset)}
    )
    count, second, third = data.shape
    bands = _known_bands(name, count) if bands is None else bands
    if name == "rad":  # ICVL: the image lies on its side

        def read(first: int, end: int) -> NDArray[np.float32]:
            # rotated counter-clockwise: row r of the image is column third - 1 - r … of the stored planes
            part = data[:, second - end : second - first, :]
            return np.moveaxis(part, 0, -1)[::-1]

        return CubeFile(file, (second, third, count), bands, read, "ICVL")

    def transposed(first: int, end: int) -> NDArray[np.float32]:
        return np.moveaxis(data[:, :, first:end], 0, -1).swapaxes(0, 1)

    return CubeFile(file, (third, second, count), bands, transposed, "HDF5")


def _bands_in(data: dict[str, Any]) -> NDArray[np.float64] | None:
    for name in _WAVELENGTHS:
        if name in data and np.asarray(data[name]).dtype.kind in "fui":
            return np.asarray(data[name], dtype=np.float64).ravel()
    return None


def _known_bands(name: str, count: int) -> NDArray[np.float64] | None:
    known = _KNOWN_BANDS.get((name, count))
    return None if known is None else known[0] + known[1] * np.arange(count, dtype=np.float64)


#: Reader for each end of a file name.
READERS: dict[str, Callable[[Path], CubeFile]] = {
    ".hdr": _envi,
    ".mat": _matlab,
    ".h5": _hdf5,
    ".hdf5": _hdf5,
    ".exr": _exr,
    ".npy": _npy,
}
