"""Hyperspectral cubes in MATLAB and HDF5 files, in the layouts of ARAD-1K, ICVL, Harvard, Foster and ISETCam."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import require_memory
from hesim_render.core.hdf5 import dataset_of
from hesim_render.targets.opened_cube import CubeFile, Rows, known_bands

_WAVELENGTHS = ("bands", "wavelength", "wavelength_nm", "wavelengths", "wave")
_CUBES = ("cube", "rad", "ref", "reflectances", "photons", "data", "mcCOEF")
#: Most bytes of wavelengths, a basis or a mean.
_MOST_SMALL_BYTES = 1 << 26
#: Largest MATLAB v5 file that is loaded whole, as numbers of float64, bytes.
MOST_MATLAB_BYTES = 4 << 30


def read_matlab(file: Path) -> CubeFile:
    """A MATLAB file: up to v7 read whole, v7.3 as HDF5."""
    import h5py

    if h5py.is_hdf5(file):
        return read_hdf5(file)
    from scipy.io import loadmat, whosmat

    sizes = {"double": 8, "int64": 8, "uint64": 8, "single": 4, "int32": 4, "uint32": 4, "int16": 2, "uint16": 2}
    total = sum(sizes.get(kind, 1) * int(np.prod(shape, dtype=np.int64)) for _, shape, kind in whosmat(file))
    require_memory(total, "a MATLAB v5 file is read whole; this one", file, MOST_MATLAB_BYTES)
    return _of_variables(file, loadmat(file), "MATLAB")


def _of_variables(file: Path, data: dict[str, Any], layout: str) -> CubeFile:
    """Arrays in MATLAB's order: [row, col, band]."""
    name = next((key for key in _CUBES if getattr(data.get(key), "ndim", 0) == 3), None)
    if name is None:
        result = ", ".join(key for key in data if not key.startswith("__"))
        raise SpecError(
            f"expected one of {', '.join(_CUBES)} with three dimensions; found {result or 'nothing'}", file=file
        )
    if name == "mcCOEF":
        return _isetcam_basis(file, data)
    values = np.asarray(data[name])
    bands = _bands_in(data)
    bands = known_bands(name, values.shape[2]) if bands is None else bands
    if name == "photons" and bands is not None:
        values = values / bands  # photons to energy, relative; the constant does not matter
        layout = "ISETCam"
    return CubeFile(file, values.shape, bands, lambda a, b: values[a:b], layout)


def _isetcam_basis(file: Path, data: dict[str, Any]) -> CubeFile:
    """ISETCam in a MATLAB v5 file: coefficients of a basis at each pixel."""
    basis = data.get("basis")
    fields = {key: np.asarray(basis[key][0, 0]) for key in ("wave", "basis")} if basis is not None else {}
    coefficients = np.asarray(data["mcCOEF"])
    light = data.get("illuminant")
    given = None
    if light is not None and light.dtype.names and "data" in light.dtype.names:
        given = np.asarray(light["data"][0, 0])
    return _of_basis(file, coefficients.shape, lambda a, b: coefficients[a:b], fields, data.get("imgMean"), given)


def _of_basis(
    file: Path, shape: tuple[int, ...], coefficients: Rows, basis: dict[str, NDArray], mean: Any, light: NDArray | None
) -> CubeFile:
    """ISETCam: photons = coefficients · basisᵀ + mean at each pixel; radiance is proportional to photons/λ."""
    if len(basis) != 2:
        raise SpecError("mcCOEF needs a structure basis with wave and basis", file=file)
    bands, table = basis["wave"].astype(np.float64).ravel(), basis["basis"].astype(np.float64)
    if table.shape != (bands.size, shape[2]):
        raise SpecError(f"basis of shape {table.shape} does not fit {bands.size} wavelengths", file=file)
    average = np.zeros(bands.size) if mean is None else np.asarray(mean, dtype=np.float64).ravel()
    illuminant = None
    if light is not None and light.size == bands.size:
        illuminant = light.astype(np.float64).ravel() / bands

    def read(first: int, end: int) -> NDArray[np.float32]:
        return np.asarray((coefficients(first, end) @ table.T + average) / bands, dtype=np.float32)

    return CubeFile(file, (shape[0], shape[1], bands.size), bands, read, "ISETCam", illuminant)


def read_hdf5(file: Path) -> CubeFile:
    """MATLAB v7.3 and HDF5: MATLAB writes the axes of an array in the opposite order."""
    import h5py

    opened = h5py.File(file, "r")
    name = next((key for key in _CUBES if isinstance(opened.get(key), h5py.Dataset) and opened[key].ndim == 3), None)
    if name is None:
        raise SpecError(
            f"expected a data set {', '.join(_CUBES)} with three dimensions; found {', '.join(opened)}", file=file
        )
    data = dataset_of(opened, name, file, "fui")
    bands = _bands_in({key: _whole(opened, key, file) for key in _WAVELENGTHS if key in opened})
    count, second, third = data.shape
    bands = known_bands(name, count) if bands is None else bands

    def transposed(first: int, end: int) -> NDArray[np.float32]:
        return np.moveaxis(data[:, :, first:end], 0, -1).swapaxes(0, 1)

    def upright(first: int, end: int) -> NDArray[np.float32]:
        # rotated counter-clockwise: row r of the image is column third - 1 - r … of the stored planes
        part = data[:, second - end : second - first, :]
        return np.moveaxis(part, 0, -1)[::-1]

    if name == "rad":  # ICVL: the image lies on its side
        return CubeFile(file, (second, third, count), bands, upright, "ICVL")
    if name == "mcCOEF":
        group = opened.get("basis")
        parts = {
            key: _whole(group, key, file).T
            for key in ("wave", "basis")
            if isinstance(group, h5py.Group) and key in group
        }
        mean = _whole(opened, "imgMean", file) if "imgMean" in opened else None
        return _of_basis(file, (third, second, count), transposed, parts, mean, None)
    if name == "photons" and bands is not None:
        return CubeFile(
            file, (third, second, count), bands, lambda a, b: np.asarray(transposed(a, b) / bands, np.float32),
            "ISETCam",
        )  # fmt: skip
    return CubeFile(file, (third, second, count), bands, transposed, "HDF5")


def _whole(group: Any, name: str, file: Path) -> NDArray:
    """A small data set."""
    result = dataset_of(group, name, file, "fui")
    require_memory(result.size * result.dtype.itemsize, name, file, _MOST_SMALL_BYTES)
    return np.asarray(result)


def _bands_in(data: dict[str, Any]) -> NDArray[np.float64] | None:
    for name in _WAVELENGTHS:
        if name in data and np.asarray(data[name]).dtype.kind in "fui":
            return np.asarray(data[name], dtype=np.float64).ravel()
    return None
