"""Reference flux of time windows: Mitsuba's own cameras, films and integrators, averaged over instants.

The reference shares nothing with the tracers of this package: neither rays, wavelengths, random numbers, films nor
motion within a window. Mitsuba gets the poses of objects and camera for one instant after the other. This is slow
for whole pictures and quick for some pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, log2

import numpy as np
from mitsuba_frozen import FrozenPixels, Work
from mitsuba_specfilm import require_plain_lens, using_variant
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.errors import RangeError
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.scene import Scene, light_parts

VARIANT = "scalar_spectral"
#: Number of independent renders, whose scatter gives the error; and of the pilot, which decides their length.
REPEATS, _PILOT_REPEATS = 16, 8
#: Least number of instants of a repeat; and, for each pixel of motion in a window, of all repeats together.
_LEAST_INSTANTS, _INSTANTS_PER_PX = 4, 16
#: Least and largest number of rays at an instant.
SAMPLES, _MOST_SAMPLES = 16, 1024
#: Largest number of rays of a pixel in a window and repeat.
MOST_RAYS = 1 << 15
#: Factor on the wanted error, because the scatter from the pilot is uncertain.
_MARGIN = 0.8


@dataclass(frozen=True)
class WindowFlux:
    """Flux of pixels in windows, arrays [window, pixel].

    Parameters
    ----------
    flux : mean Φ of each pixel through its own filter, e⁻/s.
    stderr : standard error from the scatter of `repeats` independent estimates, e⁻/s. A deviation over it has Student's
        t distribution with `repeats` - 1 degrees of freedom. Pixels in a window share some instants, and in a static
        scene all windows are equal, so their errors are not independent.
    instants : number of instants of each value, over all repeats and waveforms.
    repeats : number of independent estimates.
    """

    flux: NDArray[np.float64]
    stderr: NDArray[np.float64]
    instants: NDArray[np.int64]
    repeats: int


class WindowReference:
    """Mean Φ of pixels over windows, in e⁻/s, by Mitsuba alone.

    Instants are drawn at random in equal parts of a window, so the mean over them is unbiased for any number of
    instants; more of them only reduce the error. A pilot that is not part of the estimate decides their number.
    Flickering light weights instants by its power.

    Parameters
    ----------
    scene : shapes, emitting shapes and the camera may move.
    sensor : relative illumination, transmittance, f-number and responses apply as in the renderer.
    samples : rays per pixel and instant, a power of 4.
    repeats : independent estimates, 2 or more.
    most_rays : largest number of rays of a pixel in a window and repeat; the error tells where it was not enough.

    Attributes
    ----------
    sensor : the sensor, with the lens in use.

    Raises
    ------
    SpecError
        If the scene is not valid, or the lens has effects that Mitsuba's cameras lack.
    RangeError
        If a number is out of range.
    """

    def __init__(
        self,
        scene: Scene,
        sensor: Sensor,
        *,
        samples: int = SAMPLES,
        repeats: int = REPEATS,
        most_rays: int = MOST_RAYS,
    ) -> None:
        if samples < 1 or log2(samples) % 2:
            raise RangeError("samples", samples, "a power of 4")
        if repeats < 2:
            raise RangeError("repeats", repeats, "2 or more")
        if most_rays < samples:
            raise RangeError("most_rays", most_rays, f"{samples} or more")
        require_plain_lens(sensor)
        self._samples, self._repeats, self._most_rays = samples, repeats, most_rays
        with using_variant(VARIANT) as mi:
            self._parts = [FrozenPixels(mi, waveform, part, sensor) for waveform, part in light_parts(scene)]
        self.sensor = self._parts[0].view.sensor

    def flux(
        self,
        windows_us: ArrayLike,
        pixel: ArrayLike,
        error_wanted: ArrayLike,
        seed: int = 0,
        *,
        instants: int | None = None,
    ) -> WindowFlux:
        """Flux of pixels in windows.

        Parameters
        ----------
        windows_us : [window, 2], begin and end of each, µs.
        pixel : [n], mosaic indices (row · cols + col of the region).
        error_wanted : wanted standard error, e⁻/s; one number, or [window, n].
        seed : seed of all random numbers, which otherwise depend only on the window and on the pixel's place on the
            full sensor.
        instants : number of instants per repeat; default: what the pilot finds necessary.

        Returns
        -------
        Flux and standard error, [window, n].

        Raises
        ------
        RangeError
            If a pixel lies outside the region, a window ends before it begins, or the wanted error is not above 0.
        """
        windows = np.asarray(windows_us, dtype=np.float64).reshape(-1, 2)
        pixels = np.asarray(pixel, dtype=np.int64).ravel()
        shape = len(windows), pixels.size
        wanted = np.broadcast_to(np.asarray(error_wanted, dtype=np.float64), shape)
        count = self.sensor.rows * self.sensor.cols
        if pixels.size and not (pixels.min() >= 0 and pixels.max() < count):
            raise RangeError("pixel", int(pixels.max()), f"0 to {count - 1}, inside the region")
        if np.any(windows[:, 1] < windows[:, 0]):
            raise RangeError("end_us - begin_us", float(np.min(np.diff(windows))), "0 or more")
        if not np.all(wanted > 0):
            raise RangeError("error_wanted", float(wanted.min()), "an error above 0, e⁻/s")
        total, variance, used = np.zeros(shape), np.zeros(shape), np.zeros(shape, np.int64)
        each = wanted / np.sqrt(len(self._parts))
        with using_variant(VARIANT):
            for number, part in enumerate(self._parts):
                if part.is_dark:
                    continue
                for index, spans in enumerate([windows] if part.is_static else windows[:, None]):
                    # in a static scene, one window stands for all
                    place = slice(None) if part.is_static else slice(index, index + 1)
                    found = self._window(part, spans, pixels, each[place], [seed, number], instants)
                    total[place] += found.flux
                    variance[place] += found.stderr**2
                    used[place] += found.instants
        return WindowFlux(total, np.sqrt(variance), used, self._repeats)

    def _window(
        self,
        part: FrozenPixels,
        windows: NDArray[np.float64],
        pixels: NDArray[np.int64],
        wanted: NDArray[np.float64],
        key: list[int],
        instants: int | None,
    ) -> WindowFlux:
        """Flux in a single window; in a static scene, in any number of windows."""
        power = np.ones(len(windows)) if part.waveform is None else part.waveform.mean(windows[:, 0], windows[:, 1])
        span = (float(windows[0, 0]), float(windows[0, 1]))
        begin = self._least(part, *span)
        if instants is not None:
            ladder, step = [Work(instants, self._samples)], np.zeros(pixels.size, np.int64)
        else:
            ladder = self._ladder(begin, part.is_static)
            pilot = part.repeats(span, pixels, begin, _PILOT_REPEATS, [*key, 0])
            if part.is_static:
                wanted = (wanted / np.maximum(power, 1e-300)[:, None]).min(axis=0, keepdims=True)
            error = pilot.std(axis=0, ddof=1) / np.sqrt(self._repeats)
            # the variance falls at least as fast as 1/rays, and faster with stratification
            step = np.searchsorted([work.rays for work in ladder], begin.rays * (error / (_MARGIN * wanted[0])) ** 2)
            step = np.minimum(step, len(ladder) - 1)
        flux, stderr = np.zeros(pixels.size), np.zeros(pixels.size)
        for number in np.unique(step):
            own = step == number
            found = part.repeats(span, pixels[own], ladder[number], self._repeats, [*key, 1])
            flux[own], stderr[own] = found.mean(axis=0), found.std(axis=0, ddof=1) / np.sqrt(self._repeats)
        times = self._repeats * np.array([work.instants for work in ladder])[step]
        times = np.broadcast_to(times, (len(windows), pixels.size))
        if part.is_static:
            return WindowFlux(power[:, None] * flux, power[:, None] * stderr, times, self._repeats)
        return WindowFlux(flux[None], stderr[None], times, self._repeats)

    def _least(self, part: FrozenPixels, begin_us: float, end_us: float) -> Work:
        if part.is_static:
            return Work(1, self._samples)
        wanted = max(_LEAST_INSTANTS, _INSTANTS_PER_PX * part.motion_px(begin_us, end_us) / self._repeats)
        return Work(max(1, min(1 << ceil(log2(wanted)), self._most_rays // self._samples)), self._samples)

    def _ladder(self, work: Work, is_static: bool) -> list[Work]:
        """Steps from the least to the most work. With motion, the number of instants and the rays at each grow in
        turn.
        """
        found = [work]
        while 4 * work.rays <= self._most_rays:
            more_rays = work.samples < _MOST_SAMPLES and (is_static or len(found) % 2 == 0)
            more = (1, 4) if more_rays else (4, 1) if is_static else (2, 1)
            work = Work(more[0] * work.instants, more[1] * work.samples)
            found.append(work)
        return found


def reference_windows(
    scene: Scene,
    sensor: Sensor,
    windows_us: ArrayLike,
    pixel: ArrayLike,
    error_wanted: ArrayLike,
    seed: int = 0,
    *,
    instants: int | None = None,
) -> WindowFlux:
    """Mean Φ of pixels over windows by Mitsuba's own cameras and integrators; see `WindowReference` and its `flux`."""
    return WindowReference(scene, sensor).flux(windows_us, pixel, error_wanted, seed, instants=instants)
