"""Hyperspectral cubes in files, read by bands of rows: ENVI, MATLAB, HDF5, EXR, NPY, and folders of pictures.

Layouts are those in which CAVE, ICVL, KAIST, Harvard, ARAD-1K and ISETCam store their images. None of these sets is
needed: a file says by its names and shapes which layout it has.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError, how_to_install
from hesim_render.core.guard import MOST_TEXT_BYTES, WholeFile, reading, require_memory
from hesim_render.targets.matlab_cube import read_hdf5, read_matlab
from hesim_render.targets.opened_cube import CubeFile, Rows, known_bands

#: Channels of a spectral EXR file, [fichet2021], and those of the EXR files of KAIST.
EXR_CHANNELS = (re.compile(r"(?:T|S0)\.(\d+(?:,\d+)?)nm"), re.compile(r"w(\d+(?:\.\d+)?)nm"))
#: A plane of a folder of CAVE.
_CAVE = re.compile(r"(.+)_ms_(\d\d)\.png")
#: Attribute emissiveUnits of spectral EXR files in absolute units.
RADIANCE_UNITS = "W.m^-2.sr^-1.nm^-1"


def open_cube(file: Path, wavelength_nm: Sequence[float] | None = None) -> CubeFile:
    """A hyperspectral cube in a file or a folder; the end of its name tells the kind.

    Parameters
    ----------
    file : ``.hdr`` (ENVI), ``.mat``, ``.h5``, ``.exr``, ``.npy``, or a folder of ``NAME_ms_01.png`` …
    wavelength_nm : of the bands, where the file does not say.

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
        cube = reader(file)
    if min(cube.shape) < 1 or cube.shape[2] < 2:
        raise SpecError(f"expected a cube [row, col, wavelength], found {cube.shape}", file=file)
    if wavelength_nm is not None:
        if cube.wavelength_nm is not None:
            raise SpecError("has wavelengths of its own: leave wavelength_nm out", file=file, key="wavelength_nm")
        cube = replace(cube, wavelength_nm=np.asarray(wavelength_nm, dtype=np.float64))
    bands = cube.wavelength_nm
    if bands is None:
        raise SpecError("says no wavelengths: give them (wavelength_nm)", file=file, key="wavelength_nm")
    if bands.shape != (cube.shape[2],):
        raise SpecError(
            f"the cube has {cube.shape[2]} planes and wavelength_nm {bands.size} values", file=file,
            key="wavelength_nm",
        )  # fmt: skip
    if not (np.isfinite(bands).all() and np.all(np.diff(bands) > 0)):
        raise SpecError("the wavelengths of a cube must increase", file=file, key="wavelength_nm")
    return cube


def _npy(file: Path) -> CubeFile:
    mapped = np.load(file, mmap_mode="r", allow_pickle=False)
    if mapped.ndim != 3 or mapped.dtype.kind not in "fui":
        raise SpecError(f"expected numbers [row, col, wavelength], found {mapped.dtype} {mapped.shape}", file=file)

    def read(first: int, end: int) -> NDArray[np.float32]:
        # mapped again for each band of rows: pages of a map that stays open count as memory of the process
        return np.array(np.load(file, mmap_mode="r", allow_pickle=False)[first:end], dtype=np.float32)

    return CubeFile(file, mapped.shape, None, read, "NPY")


def _envi(file: Path) -> CubeFile:
    try:
        from spectral.io import envi
    except ImportError:
        raise SpecError(f"ENVI files need the package spectral: {how_to_install('cubes')}", file=file) from None
    image = envi.open(str(WholeFile(file, MOST_TEXT_BYTES).checked()))
    header = image.metadata
    bands = None
    if "wavelength" in header:
        bands = np.array([float(value) for value in header["wavelength"]])
        unit = str(header.get("wavelength units", "")).lower()
        if unit in ("micrometers", "um", "µm", "micrometres") or (not unit and bands.max() < 100):
            bands = bands * 1e3
    factor = np.float32(1 / float(header.get("reflectance scale factor", 1) or 1))
    shape = int(image.nrows), int(image.ncols), int(image.nbands)

    def read(first: int, end: int) -> NDArray[np.float32]:
        mapped = image.open_memmap(interleave="bip", writable=False)  # see _npy
        return np.array(mapped[first:end], dtype=np.float32) * factor

    return CubeFile(file, shape, bands, read, "ENVI")


def _exr(file: Path) -> CubeFile:
    """Spectral EXR; scan lines are read as they are asked for."""
    import Imath
    import OpenEXR

    opened = OpenEXR.InputFile(str(file))
    header = opened.header()
    names = header["channels"]
    units = header.get("emissiveUnits", b"")
    is_absolute = (units.decode() if isinstance(units, bytes) else units) == RADIANCE_UNITS
    for pattern in EXR_CHANNELS:
        channels = sorted(
            (float(match[1].replace(",", ".")), name) for name in names if (match := pattern.fullmatch(name))
        )
        if len(channels) >= 2:
            break
    else:
        some = ", ".join(sorted(names)[:8])
        raise SpecError(f"expected channels T.550,0nm … or w550nm … (a picture: R, G, B); found {some}", file=file)
    if any((names[name].xSampling, names[name].ySampling) != (1, 1) for _, name in channels):
        raise SpecError("its channels do not have the same pixels", file=file)
    window = header["dataWindow"]
    top, rows, cols = window.min.y, window.max.y - window.min.y + 1, window.max.x - window.min.x + 1
    chosen = [name for _, name in channels]

    def read(first: int, end: int) -> NDArray[np.float32]:
        kind = Imath.PixelType(Imath.PixelType.FLOAT)
        lines = opened.channels(chosen, kind, top + first, top + end - 1)
        return np.stack([np.frombuffer(each, np.float32).reshape(end - first, cols) for each in lines], axis=-1)

    bands = np.array([wavelength for wavelength, _ in channels])
    return CubeFile(file, (rows, cols, len(channels)), bands, read, "EXR", is_absolute=is_absolute)


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
            if image.mode not in ("I;16", "I", "L", "LA", "RGBA"):
                raise SpecError(f"expected grey codes of 16 bits, found mode {image.mode}", file=path)
            require_memory(4 * image.width * image.height * len(names), "the cube", file)
            codes = np.asarray(image)
            # one scene of the set has 8 bits and an alpha channel
            codes = codes if codes.ndim == 2 else codes[..., 0]
            planes.append(codes * np.float32(1 / (65535 if image.mode in ("I;16", "I") else 255)))
    if len({plane.shape for plane in planes}) != 1:
        raise SpecError("its pictures differ in size", file=file)
    shape = (*planes[0].shape, len(planes))
    return CubeFile(file, shape, known_bands("CAVE", len(planes)), _of_planes(planes), "CAVE")


#: Reader for each end of a file name.
READERS: dict[str, Callable[[Path], CubeFile]] = {
    ".hdr": _envi,
    ".mat": read_matlab,
    ".h5": read_hdf5,
    ".hdf5": read_hdf5,
    ".exr": _exr,
    ".npy": _npy,
}
