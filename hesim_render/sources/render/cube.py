"""Spectral radiance cubes L(row, col, λ) of an instant or a window of time, and spectral EXR files.

The files follow the OpenEXR layout of Fichet, Pacanowski and Wilkie [fichet2021]: one channel per band named
``S0.550,000000nm`` (Stokes component 0, decimal comma), and the attributes ``spectralLayoutVersion`` and
``emissiveUnits``. Compression is PIZ, which Mitsuba can read.
"""

import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Bands, Float, UInt32
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.exr import require_exr_fits
from hesim_render.core.output import replacing
from hesim_render.mosaic.layout import Layout
from hesim_render.sensor.lens import Lens
from hesim_render.sensor.reading import read_sensor
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.render.exact import timeline_of
from hesim_render.sources.render.light_level import in_absolute_light
from hesim_render.sources.render.scene.scene_spectra import named_spectra
from hesim_render.sources.render.tracer import PixelTracer
from hesim_render.sources.scene import Scene, light_parts, scene_and_sensor
from hesim_render.spectral.spectrum import RENDERABLE_NM
from hesim_render.spectral.waveform import Waveform
from hesim_render.targets.cube_file import RADIANCE_UNITS

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
    scene: Scene | str | Path,
    sensor: Sensor | str | Path | tuple[int, int],
    bands_nm: ArrayLike,
    samples: int = 64,
    t_us: float = 0.0,
    *,
    end_us: float | None = None,
    seed: int = 0,
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
    """Spectral radiance on a pixel grid at exact wavelengths, at one instant or as the mean over a window of time.

    Each value is the radiance averaged over one pixel pitch, after the lens at that wavelength (PSF, diffraction,
    chromatic aberration, depth of field). Filters, relative illumination and veiling glare are not applied.

    Parameters
    ----------
    scene : the scene, or its name or path; lights with a waveform have their power of the instant, or their mean over
        the window.
    sensor : sensor whose pixel grid is used, or its name or path, or (rows, cols) of an ideal camera.
    bands_nm : [band], wavelengths in nm, increasing, 360 to 830.
    samples : rays per pixel, group of four bands and slice of time in which objects stand still, even.
    t_us : instant, or begin of the window, µs.
    end_us : end of the window, µs; None for an instant, at which objects and camera stand still.
    seed : seed of the random numbers; all bands share them.

    Examples
    --------
    >>> import hesim_render as hr
    >>> sensor = hr.load_sensor("reference-mono").crop(16, 12)
    >>> bands, radiance, stderr = hr.render_cube(hr.load_scene("flat-field"), sensor, [450, 550, 650], end_us=1000)
    >>> radiance.shape, bool((radiance > 0).all())
    ((12, 16, 3), True)

    Returns
    -------
    wavelength_nm [band]; radiance [row, col, band], W m⁻² sr⁻¹ nm⁻¹; its standard error, from two
    independent halves (rough for one pixel: it has one degree of freedom).

    Raises
    ------
    SpecError
        If the scene cannot be loaded or a spectrum does not reach a band.
    RangeError
        If `bands_nm` or `samples` is out of range, or the window ends before it begins.
    """
    bands = np.atleast_1d(np.asarray(bands_nm, dtype=np.float64))
    chosen = _camera_of_size(*sensor) if isinstance(sensor, tuple | list) else sensor
    scene, chosen = scene_and_sensor(scene, chosen)
    _check_bands(scene, bands)
    if end_us is not None and not end_us > t_us:
        raise RangeError("end_us", end_us, f"a time after the begin of the window, {t_us:g} µs")
    absolute, _ = in_absolute_light(scene)
    halves = np.zeros((2, *chosen.layout.shape, bands.size), np.float32)
    for waveform, part in light_parts(absolute):
        tracer = PixelTracer(part, chosen, samples, seed, {})
        if not tracer.built.is_dark:
            for begin, end, share in _slices(tracer, waveform, t_us, t_us if end_us is None else end_us):
                _add_slice(tracer, bands, begin, end, share, halves)
    return bands, (halves[0] + halves[1]) / 2, np.abs(halves[0] - halves[1]) / 2


def _slices(
    tracer: PixelTracer, waveform: Waveform | None, begin_us: float, end_us: float
) -> Iterator[tuple[float, float, float]]:
    """Begin, end and weight of parts of a window in which objects stand still; they are posed for each."""
    if begin_us == end_us:
        tracer.pose(begin_us)
        yield begin_us, end_us, 1.0 if waveform is None else float(waveform.mean(begin_us, begin_us))
        return
    timeline = timeline_of(tracer)
    edges = [begin_us, *timeline.edges_us(begin_us, end_us), end_us]
    for low, high in pairwise(edges):
        power = 1.0 if waveform is None else float(waveform.mean(low, high))
        if power > 0:
            tracer.pose(timeline.pose_time_us(low, high))
            yield low, high, power * (high - low) / (end_us - begin_us)


def _add_slice(
    tracer: PixelTracer,
    bands: NDArray[np.float64],
    begin_us: float,
    end_us: float,
    share: float,
    halves: NDArray[np.float32],
) -> None:
    """Add the radiance of one slice with a weight to `halves`, [half, row, col, band]."""
    shape = tracer.view.sensor.layout.shape
    pixels = np.arange(tracer.pixel_count, dtype=np.uint32)
    # where a ray's path depends on its wavelength, it has a single one
    together = 1 if tracer.rays.is_dispersive else _BANDS_PER_RAY
    for first in range(0, bands.size, together):
        group = bands[first : first + together]
        padded = np.pad(group, (0, _BANDS_PER_RAY - group.size), mode="edge")
        wavelengths = [dr.opaque(jit().Float, float(band)) for band in padded]

        def choose(pixel: UInt32, u: Float, wavelengths: list[Float] = wavelengths) -> list[Float]:
            return wavelengths

        def weigh(pixel: UInt32, spectrum: Bands) -> list[Float]:
            return [spectrum[k] * tracer.radiance_scale for k in range(_BANDS_PER_RAY)]

        traced = tracer.trace(pixels, begin_us, end_us, choose, weigh)
        for k in range(group.size):
            for half in (0, 1):
                halves[half, :, :, first + k] += np.float32(share) * np.array(traced[k][half]).reshape(shape)


def channel_name(wavelength_nm: float) -> str:
    """``S0.550,000000nm`` for 550 nm."""
    digits = f"{wavelength_nm:.6f}".replace(".", ",")
    return f"S0.{digits}nm"


def write_spectral_exr(path: str | Path, radiance: NDArray[np.float32], wavelength_nm: ArrayLike) -> Path:
    """Write a cube as a spectral EXR (32-bit float, PIZ), whole or not at all.

    Parameters
    ----------
    radiance : [row, col, band], W m⁻² sr⁻¹ nm⁻¹.
    path : the file.
    wavelength_nm : [band].

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> import hesim_render as hr
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = hr.write_spectral_exr(f"{folder}/cube.exr", np.ones((4, 6, 2), np.float32), [500, 600])
    ...     bands, radiance = hr.read_spectral_exr(path)
    >>> bands.tolist(), radiance.shape
    ([500.0, 600.0], (4, 6, 2))

    Returns
    -------
    The file.

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
        "emissiveUnits": RADIANCE_UNITS,
    }
    with replacing(target) as temporary, OpenEXR.File(header, channels) as file:
        file.write(str(temporary))
    return target


def read_spectral_exr(path: str | Path) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """A cube from a spectral EXR file in the layout of Fichet et al.

    Parameters
    ----------
    path : the file.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> import hesim_render as hr
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = hr.write_spectral_exr(f"{folder}/cube.exr", np.ones((4, 6, 1), np.float32), [550])
    ...     hr.read_spectral_exr(f"{folder}/cube.exr")[0].tolist()
    [550.0]

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
    require_exr_fits(source)
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
