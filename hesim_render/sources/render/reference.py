"""What flux windows really have: Mitsuba's own cameras, films and integrators, averaged over instants.

Nothing of it comes from the tracers of this package: neither rays, wavelengths, random numbers, films nor motion
within a window. Objects and camera are moved by giving Mitsuba their poses, one instant after the other. It is slow
for whole pictures and quick for some pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, log2

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.errors import RangeError, SpecError
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.light_parts import light_parts
from hesim_render.sources.render.frozen import FrozenPixels, Work
from hesim_render.sources.render.scene.mitsuba_version import using_variant
from hesim_render.sources.scene import Scene

VARIANT = "scalar_spectral"
#: Independent renders whose scatter is the error; of the pilot, which says how long each of them is.
REPEATS, _PILOT_REPEATS = 16, 8
#: Fewest instants of a repeat, and for each pixel that anything moves in a window, in all repeats together.
_LEAST_INSTANTS, _INSTANTS_PER_PX = 4, 16
#: Rays at an instant: at least, and at most.
SAMPLES, _MOST_SAMPLES = 16, 1024
#: Rays of a pixel in a window and repeat at most.
MOST_RAYS = 1 << 15
#: The pilot's own scatter is not exact: so much less is asked for.
_MARGIN = 0.8


@dataclass(frozen=True)
class WindowFlux:
    """Flux of pixels in windows, arrays [window, pixel].

    Parameters
    ----------
    flux : mean Φ of each pixel through its own filter, e⁻/s.
    stderr : standard error of each from the scatter of `repeats` independent estimates, so a ratio with it is
        distributed as Student's t with `repeats` - 1 degrees of freedom. Of pixels in a window some instants are the
        same, and where nothing moves all windows are: their errors are not independent.
    instants : at which each was rendered, in all repeats and for all waveforms together.
    repeats : see `stderr`.
    """

    flux: NDArray[np.float64]
    stderr: NDArray[np.float64]
    instants: NDArray[np.int64]
    repeats: int


class WindowReference:
    """Mean Φ of pixels over windows, in e⁻/s, by Mitsuba alone.

    Instants are drawn at random in equal parts of a window, so that the mean over them is that over the window however
    few they are: more of them make the error smaller and change nothing else. How many there are is decided by a pilot
    that is not in the estimate. Flickering light weights instants by its power.

    Parameters
    ----------
    scene : shapes and camera may move, emitting shapes as well.
    sensor : relative illumination, transmittance, f-number and responses apply as in the renderer.
    samples : rays of a pixel at an instant, a power of 4.
    repeats : independent estimates, 2 or more.
    most_rays : of one pixel in one window and repeat; the error says where that was not enough.

    Attributes
    ----------
    sensor : with the lens in use.

    Raises
    ------
    SpecError
        If the scene is not valid or the lens blurs (Mitsuba's camera has no PSF).
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
        if sensor.spec.lens.psf_fwhm_um > 0:
            raise SpecError("the reference renders no lens PSF; set it to 0", key="lens.psf_fwhm_um")
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
        error_wanted : standard error that is asked for, e⁻/s; one for all, or [window, n].
        seed : of everything random, which depends besides on the pixel's place on the full sensor and the window alone.
        instants : of each repeat, in place of what the pilot finds necessary.

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
                    # where nothing moves, one window stands for all
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
        """Of a single window; of any number of them where nothing moves."""
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
            # the variance falls with the number of rays or, as they are stratified, faster
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
        """From the least work to the most; where anything moves, instants become more and rays at each of them."""
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
    """Mean Φ of pixels over windows by Mitsuba's own cameras and integrators; see `WindowReference.flux`."""
    return WindowReference(scene, sensor).flux(windows_us, pixel, error_wanted, seed, instants=instants)
