"""Spectral radiance cubes L(row, col, λ) of one instant, and spectral EXR files.

The files follow the OpenEXR layout of Fichet, Pacanowski and Wilkie [fichet2021]: one channel per band named
``S0.550,000000nm`` (Stokes component 0, decimal comma), and the attributes ``spectralLayoutVersion`` and
``emissiveUnits``. Compression is PIZ, which Mitsuba can read.
"""

from __future__ import annotations

import contextlib
import os
import re
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device_types import Bands, Float, UInt32
from hesim_render.core.errors import OutputError, RangeError, SpecError
from hesim_render.mosaic.layout import Layout
from hesim_render.sensor.lens import Lens
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.render.scene.builder import named_spectra
from hesim_render.sources.render.tracer import PixelTracer
from hesim_render.sources.scene import Scene
from hesim_render.specs.sensor import read_sensor
from hesim_render.spectral.spectrum import RENDERABLE_NM

EMISSIVE_UNITS = "W.m^-2.sr^-1.nm^-1"
_CHANNEL = re.compile(r"S0\.(\d*,?\d*(?:[eE][+-]?\d+)?)nm")
_BANDS_PER_RAY = 4


def _camera_of_size(rows: int, cols: int) -> Sensor:
    """An ideal sensor of any size: `reference-mono` with as many pixels on a chip of the same width."""
    ideal = read_sensor("reference-mono").geometry
    pitch_um = ideal.pitch_um * ideal.cols / cols
    overrides = {"geometry.rows": rows, "geometry.cols": cols, "geometry.pitch_um": pitch_um}
    spec = read_sensor("reference-mono", overrides)
    return Sensor(Layout.full(spec), Lens.of(spec))


def _check_bands(scene: Scene, bands: NDArray[np.float64]) -> None:
    if bands.ndim != 1 or bands.size == 0 or not np.all(np.diff(bands) > 0):
        raise RangeError("bands_nm", bands.tolist(), "a list of increasing wavelengths")
    low, high = RENDERABLE_NM
    if bands[0] < low or bands[-1] > high:
        raise RangeError("bands_nm", f"{bands[0]:g} to {bands[-1]:g}", f"{low:g} to {high:g} nm")
    for key, spectrum in named_spectra(scene.spec):
        first, last = spectrum.support_nm
        if bands[0] < first or bands[-1] > last:
            raise SpecError(
                f"this spectrum covers {first:g}-{last:g} nm, not the bands {bands[0]:g}-{bands[-1]:g} nm",
                file=scene.spec.file,
                key=key,
            )


def render_cube(
    scene: Scene,
    sensor: Sensor | tuple[int, int],
    bands_nm: ArrayLike,
    samples: int = 64,
    t_us: float = 0.0,
    *,
    seed: int = 0,
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
    """Spectral radiance of one instant on a pixel grid, at exact wavelengths.

    Each value is the radiance averaged over one pixel pitch (and the lens PSF). Filters and relative
    illumination are not applied.

    Parameters
    ----------
    scene : the scene; objects and camera are frozen at `t_us`.
    sensor : sensor whose pixel grid is used, or (rows, cols) of an ideal camera.
    bands_nm : [band], wavelengths in nm, increasing, 360 to 830.
    samples : rays per pixel and group of four bands, even.
    t_us : instant, µs.
    seed : seed of the random numbers; all bands share them.

    Returns
    -------
    wavelength_nm [band]; radiance [row, col, band], W m⁻² sr⁻¹ nm⁻¹; its standard error, from two
    independent halves (rough for one pixel: it has one degree of freedom).

    Raises
    ------
    SpecError
        If the scene cannot be loaded or a spectrum does not reach a band.
    RangeError
        If `bands_nm` or `samples` is out of range.
    """
    import drjit as dr

    bands = np.atleast_1d(np.asarray(bands_nm, dtype=np.float64))
    _check_bands(scene, bands)
    chosen = sensor if isinstance(sensor, Sensor) else _camera_of_size(*sensor)
    tracer = PixelTracer(scene, chosen, samples, seed, {})
    shape = (*chosen.layout.shape, bands.size)
    radiance, stderr = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.float32)
    if tracer.built.is_dark:
        return bands, radiance, stderr
    tracer.pose(t_us)
    pixels = np.arange(tracer.pixel_count, dtype=np.uint32)
    for first in range(0, bands.size, _BANDS_PER_RAY):
        group = bands[first : first + _BANDS_PER_RAY]
        padded = np.pad(group, (0, _BANDS_PER_RAY - group.size), mode="edge")
        wavelengths = [dr.opaque(jit().Float, float(band)) for band in padded]

        def choose(pixel: UInt32, u: Float, wavelengths: list[Float] = wavelengths) -> list[Float]:
            return wavelengths

        def weigh(pixel: UInt32, spectrum: Bands) -> list[Float]:
            return [spectrum[k] * tracer.radiance_scale for k in range(_BANDS_PER_RAY)]

        halves = tracer.trace(pixels, t_us, t_us, choose, weigh)
        for k in range(group.size):
            a, b = (np.array(half, dtype=np.float64).reshape(shape[:2]) for half in halves[k])
            radiance[:, :, first + k] = (a + b) / 2
            stderr[:, :, first + k] = np.abs(a - b) / 2
    return bands, radiance, stderr


def channel_name(wavelength_nm: float) -> str:
    """``S0.550,000000nm`` for 550 nm."""
    digits = f"{wavelength_nm:.6f}".replace(".", ",")
    return f"S0.{digits}nm"


def write_spectral_exr(path: str | Path, radiance: NDArray[np.float32], wavelength_nm: ArrayLike) -> Path:
    """Write a cube as a spectral EXR (32-bit float, PIZ), whole or not at all.

    Parameters
    ----------
    radiance : [row, col, band], W m⁻² sr⁻¹ nm⁻¹.
    wavelength_nm : [band].

    Raises
    ------
    RangeError
        If the shapes do not match.
    OutputError
        If the file cannot be written.
    """
    import OpenEXR

    target = Path(path)
    bands = np.atleast_1d(np.asarray(wavelength_nm, dtype=np.float64))
    cube = np.asarray(radiance, dtype=np.float32)
    if cube.ndim != 3 or cube.shape[2] != bands.size:
        raise RangeError("radiance.shape", cube.shape, f"[row, col, {bands.size}], one layer per wavelength")
    names = [channel_name(band) for band in bands]
    if len(set(names)) != len(names):
        raise RangeError("wavelength_nm", bands.tolist(), "different wavelengths, to 1e-6 nm")
    channels = {name: np.ascontiguousarray(cube[:, :, k]) for k, name in enumerate(names)}
    header = {
        "compression": OpenEXR.PIZ_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "spectralLayoutVersion": "1.0",
        "emissiveUnits": EMISSIVE_UNITS,
    }
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        with OpenEXR.File(header, channels) as file:
            file.write(str(temporary))
        os.replace(temporary, target)
    except (OSError, RuntimeError) as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise OutputError(f"{target}: cannot be written ({reason})") from None
    return target


def read_spectral_exr(path: str | Path) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """A cube from a spectral EXR file in the layout of Fichet et al.

    Returns
    -------
    wavelength_nm [band], increasing; radiance [row, col, band], in the file's `emissiveUnits`.

    Raises
    ------
    SpecError
        If the file cannot be read or holds no spectral channels.
    """
    import OpenEXR

    source = Path(path)
    if not source.is_file():
        raise SpecError("no such file", file=source)
    try:
        with OpenEXR.File(str(source), separate_channels=True) as file:
            is_spectral = "spectralLayoutVersion" in file.header()  # empty once the file is closed
            layers = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    except (OSError, RuntimeError, ValueError) as error:
        raise SpecError(f"not a readable EXR file ({str(error).splitlines()[0]})", file=source) from None
    bands = {float(match[1].replace(",", ".")): name for name in layers if (match := _CHANNEL.fullmatch(name))}
    if not bands or not is_spectral:
        raise SpecError("not a spectral EXR file (no channels S0.…nm, or no spectralLayoutVersion)", file=source)
    wavelengths = np.array(sorted(bands))
    return wavelengths, np.stack([layers[bands[band]].astype(np.float32) for band in wavelengths], axis=-1)
