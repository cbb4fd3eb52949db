"""A video as a source of flux: Φ of any mosaic pixels over any time interval."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Halves
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.host_arrays import from_host
from hesim_render.core.progress import Progress
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.renderer import Demand, Renderer, Untraced
from hesim_render.sources.still import WindowByWindow, checked_windows
from hesim_render.sources.video.arrays import ArrayVideo
from hesim_render.sources.video.clock import Clock, picture_weights
from hesim_render.sources.video.colours import to_linear_srgb
from hesim_render.sources.video.estimate import VideoEstimate, estimate_of_counts, event_notes
from hesim_render.sources.video.file import FileVideo
from hesim_render.sources.video.folder import FolderVideo
from hesim_render.sources.video.geometry import Resampler, mapping
from hesim_render.sources.video.inversion import camera_matrix, lux_of, spectral_matrix
from hesim_render.sources.video.linear import Lineariser
from hesim_render.sources.video.motion import MotionVideo
from hesim_render.sources.video.options import WHITE_LUX, VideoOptions
from hesim_render.sources.video.picture_layout import Reader
from hesim_render.spectral import spectrum as spectra

Source = str | Path | NDArray

#: Number of pictures, and time, after which the measurement of their reading time ends.
_TIMED_PICTURES, _TIMED_S = 33, 0.5


def open_video(source: Source, options: VideoOptions) -> Reader:
    """The reader for a source: an array or ``.npy`` file, a folder of numbered pictures, or a video file.

    Raises
    ------
    SpecError
        If the source does not exist, or is none of these.
    """
    if isinstance(source, np.ndarray) or str(source).lower().endswith(".npy"):
        return ArrayVideo(source, options.bit_depth, options.fps)
    path = Path(source)
    if path.is_dir():
        return FolderVideo(path, options.bit_depth, options.fps)
    if not path.is_file():
        raise SpecError("no such file or folder", file=source)
    if options.bit_depth is not None:
        raise RangeError("bit_depth", options.bit_depth, "none for a video file, which says so itself")
    return FileVideo(path, options.fps)


class VideoFlux(WindowByWindow, Untraced):
    """Φ = V(x) · Σ_c M[filter, c] · (linear R, G, B averaged over the pixel's footprint); implements `FluxSource`.

    M comes from `hesim_render.sources.video.inversion`; V is 1 unless `lens_shading` is set. Negative rates, of
    colours outside the sensor's gamut, count as 0. Each picture is converted to the rates of all mosaic pixels once,
    when it is first needed. The maps of as many pictures are kept as an event window reaches back, so a run reads
    pictures in order, each once.

    Parameters
    ----------
    source : path of a video file, a folder or a ``.npy`` file, or an array [time, row, col(, channel)].
    sensor : the sensor, with region and lens.
    options : see `VideoOptions`.

    Attributes
    ----------
    name : of the source: its path, or ``array``.
    clock : times of the pictures.
    cut_short : evidence that the file once was longer, else empty.

    Raises
    ------
    SpecError
        If the video cannot be read, or lacks colour tags or a clock that were not given either.
    RangeError
        If options do not fit the video or the sensor.
    """

    is_static = False

    def __init__(self, source: Source, sensor: Sensor, options: VideoOptions | None = None) -> None:
        self.options = options = options or VideoOptions()
        self.sensor = sensor
        self._reader = open_video(source, options)
        self.name = name = self._reader.name
        self.tags = self._reader.tags.with_given(
            transfer=options.transfer, gamma=options.gamma, primaries=options.primaries, matrix=options.matrix,
            range=options.range,
        )  # fmt: skip
        self.tags.require(["transfer", "primaries", "matrix", "range"], name)
        shape = self._reader.format
        if (shape.layout == "yuv") == (self.tags.matrix == "rgb"):
            raise RangeError(
                "matrix", self.tags.matrix, f"one for {'YUV' if shape.layout == 'yuv' else 'RGB'} pictures"
            )
        timing = self._reader.timing
        if timing is None:
            raise SpecError("has no usable time stamps: give the frame rate (fps)", file=name)
        factor = 1
        if options.interpolation == "motion":
            factor = options.motion_factor
            self._reader = MotionVideo(self._reader, factor)
            shape = self._reader.format
        self._is_held = options.interpolation == "none"
        self.cut_short = timing.cut_short
        self.clock = Clock(timing, options.slow_motion, options.duty, factor)
        periods = np.diff(timing.begin_s)
        self._is_irregular = periods.size > 0 and periods.max() > 1.01 * periods.min()
        self.mapping = mapping(shape.width, shape.height, sensor.rows, sensor.cols, options.fit)
        self.filter_matrix = self._filter_matrix()

        types = jit()
        weights = self.filter_matrix @ to_linear_srgb(self.tags.primaries or "bt709")
        self._weights = from_host(types.Float, weights)
        self._filter = from_host(types.UInt32, sensor.layout.filter_index.ravel().astype(np.uint32) * 3)
        self._shading = from_host(types.Float, sensor.relative_illumination) if options.lens_shading else None
        self._lineariser, self._resample = Lineariser(shape, self.tags), Resampler(self.mapping)
        self._maps: dict[int, Float] = {}
        self._edges = self.clock.hold_us[1:-1] if self._is_held else self.clock.middle_us
        window_us = sensor.spec.evs.window_us if sensor.spec.evs is not None else 0
        # number of pictures before the latest one that may be asked for again: by frames, after an event window
        self._reach = 1 if self._is_held else 2
        if self._edges.size > 1:
            self._reach += int(window_us // np.diff(self._edges).min())
        dr.eval(self._weights, self._filter)

    def _filter_matrix(self) -> NDArray[np.float64]:
        """[filter, 3] of linear sRGB, e⁻/s."""
        options, filters = self.options, self.sensor.layout.filters
        light = spectra.illuminant(options.illuminant)
        self.white_lux = options.white_lux or WHITE_LUX
        if options.white_e_per_s is not None:
            self.white_lux = lux_of(self.sensor, light, options.white_e_per_s, options.white_filter or "")
        if options.mode == "spectral":
            return spectral_matrix(self.sensor, filters, light, self.white_lux)
        return camera_matrix(self.sensor, filters, light, self.white_lux, options.camera, options.others, options.luma)

    def notes(self) -> list[str]:
        """Notes for the user about the reliability of the result, in sentences."""
        notes = []
        scale = min(self.mapping.rows.scale, self.mapping.cols.scale)
        if scale < 1:
            notes.append(f"the pictures are enlarged {1 / scale:.3g} times: the sensor sees their pixels as squares")
        if self.sensor.spec.evs is not None:
            notes += event_notes(self.sensor.spec.evs, self.clock.period_us, self._is_held)
        effects = [name for name in self.sensor.optics.used_effects() if name != "relative_illumination"]
        if effects:
            notes.append(f"the pictures are the image on the chip: {', '.join(effects)} of the lens are not applied")
        if self._is_irregular:
            notes.append("the video's time stamps are irregular and were kept; fps makes them regular")
        return notes

    def slice_edges_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Times strictly inside the interval at which the next picture takes over, µs."""
        return self.clock.inner(self._edges, begin_us, end_us)

    def sample_times_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Middles of the exposures, µs: the times at which a picture equals the scene, whether it is held or not.

        Linear interpolation between these samples follows the scene. Samples at the end of a held picture would be half
        a picture late.
        """
        return self.clock.inner(self.clock.middle_us, begin_us, end_us)

    def mean_flux(self, pixel: NDArray[np.uint32], begin_us: ArrayLike, end_us: ArrayLike) -> Halves:
        """See `FluxSource.mean_flux`; an interval may span several pictures.

        The first picture is held before its time, the last one after its time. Both halves are the same, as a video has
        no Monte-Carlo error.
        """
        types = jit()
        pixels, begin, end = checked_windows(pixel, begin_us, end_us, self.sensor.rows * self.sensor.cols)
        if pixels.size == 0:
            nothing = dr.zeros(types.Float, 0)
            return nothing, nothing
        begin, end = _common(begin, end)
        index = from_host(types.UInt32, pixels)
        total: Float = 0.0
        for number, share in picture_weights(self._edges, self._is_held, begin, end).items():
            total = dr.fma(dr.gather(types.Float, self._flux_of(number), index), _device(share), total)
            dr.eval(total)  # evaluate here, so that the pictures of a long interval are freed one by one
        return total, total

    def _flux_of(self, number: int) -> Float:
        """Φ of all mosaic pixels in one picture, Dr.Jit Float [row · cols + col], e⁻/s."""
        cached = self._maps.get(number)
        if cached is not None:
            return cached
        types = jit()
        for old in [kept for kept in self._maps if abs(kept - number) > self._reach]:
            del self._maps[old]
        planes = self._resample(self._lineariser.linear(self._reader.read(number)))
        if len(planes) == 1:
            planes = planes * 3
        flux: Float = 0.0
        for channel, plane in enumerate(planes):
            flux = dr.fma(dr.gather(types.Float, self._weights, self._filter + channel), plane, flux)
        flux = dr.maximum(flux, 0.0)
        if self._shading is not None:
            flux *= self._shading
        dr.eval(flux)
        self._maps[number] = flux
        return flux

    def estimate(self, demand: Demand, progress: Progress | None = None) -> VideoEstimate:
        """See `Renderer.estimate`: from counts, and from the measured time to read the first pictures."""
        pictures = min(self.clock.count, int(np.searchsorted(self.clock.middle_us, demand.duration_us)) + 1)
        return estimate_of_counts(self.sensor, demand.duration_us, pictures, self.seconds_per_picture(pictures))

    def seconds_per_picture(self, count: int) -> float:
        """Measured time to read and decode a picture, s; 0 where only one is needed, which has been read already.

        Parameters
        ----------
        count : number of pictures of the run. No others are read, and reading ends after half a second or 32 pictures.

        Raises
        ------
        SpecError
            If one of the pictures is damaged.
        """
        begin, done = time.perf_counter(), 0
        while done + 1 < min(count, _TIMED_PICTURES) and time.perf_counter() - begin < _TIMED_S:
            done += 1
            self._reader.read(done)
        return (time.perf_counter() - begin) / done if done else 0.0

    def start_digest(self) -> None:
        """Start hashing the input in parallel to the run; `describe` waits for it."""
        self._reader.start_digest()

    def describe(self) -> dict[str, Any]:
        """The manifest's entry for the video: input and hash, colours, scale, times, interpolation."""
        return {**self._reader.describe(), **self.processing()}

    @property
    def settings(self) -> dict[str, object]:
        """See `Renderer.settings`; without the hash of the input, which is known at the end."""
        return {"video": self.processing()}

    def processing(self) -> dict[str, Any]:
        """The part of `describe` that does not wait for the hash of the input."""
        options = self.options
        return {
            "colour": self.tags.as_dict(),
            "mode": options.mode,
            "others": options.others if options.mode == "matrix" else None,
            "luma": list(options.luma) if options.mode == "matrix" and options.others == "luma" else None,
            "camera": None if options.camera is None else options.camera.model_dump(mode="json"),
            "illuminant": options.illuminant,
            "white_lux": self.white_lux,
            "white_e_per_s": options.white_e_per_s,
            "white_filter": options.white_filter,
            "filters": self.sensor.layout.filters,
            "linear_srgb_to_e_per_s": self.filter_matrix.tolist(),
            "lens_shading": options.lens_shading,
            "fit": options.fit,
            **self.mapping.describe(),
            "fps": options.fps,
            "slow_motion": options.slow_motion,
            "duty": options.duty,
            "picture_period_us": self.clock.period_us,
            "length_us": self.clock.end_us,
            "interpolation": options.interpolation,
            "motion_factor": options.motion_factor if options.interpolation == "motion" else None,
            "cut_short": self.cut_short or None,
            "notes": self.notes(),
        }

    def close(self) -> None:
        """Close the file and free the device memory."""
        self._maps.clear()
        self._reader.close()


def _common(begin: NDArray[np.float64], end: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Both ends of intervals, scalars where they are the same for all pixels."""
    if begin.ndim or end.ndim:
        ends = (begin.min(), begin.max(), end.min(), end.max())
        if ends[0] == ends[1] and ends[2] == ends[3]:
            return np.asarray(ends[0]), np.asarray(ends[2])
    return begin, end


def _device(share: NDArray[np.float64]) -> Float:
    types = jit()
    if share.ndim == 0:
        return dr.opaque(types.Float, float(np.float32(share)))
    return from_host(types.Float, share)


if TYPE_CHECKING:  # a type checker compares the two
    _RENDERER: type[Renderer] = VideoFlux
