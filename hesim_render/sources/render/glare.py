"""Veiling glare: a part of the light that the lens images onto the sensor is spread evenly over it.

With g that part, Φ' = (1 − g) Φ + g ⟨Φ⟩, where ⟨Φ⟩ is the mean over the whole sensor, not only over the region that is
read out, of what pixels with the same filter would get. Light from outside the picture is not part of it.
"""

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Bands, Float, Halves, UInt32
from hesim_render.core.distinct import distinct_columns
from hesim_render.core.host_arrays import from_host
from hesim_render.core.rng import Stream
from hesim_render.sensor.lens import relative_illumination_at
from hesim_render.sources.render.sampling.wavelengths import WavelengthSampler
from hesim_render.sources.render.tracer import PixelTracer

#: Pixels along each side of the sensor at which the mean is measured, one at random in each cell of an even grid; and
#: groups of intervals of time that are distinguished.
_CELLS, _GROUPS = 32, 16


class VeilingGlare:
    """Mean flux of the whole sensor behind each filter.

    Parameters
    ----------
    tracer : traces rays of any pixel of the full sensor.
    wavelengths : of the filters, in the order of the filter index.
    filters : numbers of the filters that pixels have.
    seed : decides the pixels.
    """

    def __init__(self, tracer: PixelTracer, wavelengths: WavelengthSampler, filters: list[int], seed: int) -> None:
        self._tracer, self._wavelengths, self._filters = tracer, wavelengths, filters
        geometry = tracer.sensor.spec.geometry
        rng = np.random.default_rng([seed, int(Stream.RENDER_GLARE)])
        cell = np.mgrid[:_CELLS, :_CELLS]
        place = (cell + rng.random(cell.shape)) / _CELLS * np.array([geometry.rows, geometry.cols])[:, None, None]
        row, col = place.astype(np.int64)
        self._index = (row * geometry.cols + col).ravel().astype(np.uint32)
        light = relative_illumination_at(tracer.sensor.spec, tracer.sensor.lens, row, col)
        self._light = from_host(jit().Float, light.ravel().astype(np.float32) * np.float32(tracer.radiance_scale))
        self._known: tuple[bytes, list[NDArray[np.float64]]] | None = None

    def added(
        self, pixel: NDArray[np.uint32], begin_us: NDArray[np.float64], end_us: NDArray[np.float64], pose_us: float
    ) -> Halves:
        """Mean flux of the whole sensor behind each listed pixel's filter, over its own interval, e⁻/s.

        Parameters
        ----------
        pixel : [n], mosaic indices of the region.
        begin_us, end_us : [n], µs. Where there are many intervals, neighbouring ones share a mean.
        pose_us : time at which moving objects stand.
        """
        types = jit()
        spans, which = distinct_columns(np.stack([begin_us, end_us]))
        group = np.arange(spans.shape[1]) * min(_GROUPS, spans.shape[1]) // spans.shape[1]
        key = spans.tobytes() + np.float64(pose_us).tobytes()
        if self._known is None or self._known[0] != key:
            self._known = key, [self._means(spans[:, group == number]) for number in range(int(group[-1]) + 1)]
        means = np.stack(self._known[1])
        filter_of = self._tracer.sensor.layout.filter_index.ravel()[pixel]
        own_means = means[group[which], filter_of]
        half_a, half_b = (from_host(types.Float, values) for values in own_means.T)
        return half_a, half_b

    def _means(self, spans_us: NDArray[np.float64]) -> NDArray[np.float64]:
        """Mean over the sensor and some intervals, [filter, half]."""
        types, count = jit(), self._index.size
        means = np.zeros((max(self._filters) + 1, 2))
        begin, end = spans_us[:, np.arange(count) % spans_us.shape[1]]
        for number in self._filters:
            own = dr.opaque(types.UInt32, number)

            def choose(pixel: UInt32, u: Float, own: UInt32 = own) -> list[Float]:
                return self._wavelengths.sample(own + 0 * pixel, u)

            def weigh(pixel: UInt32, radiance: Bands, own: UInt32 = own) -> list[Float]:
                light = dr.gather(types.Float, self._light, pixel) * self._wavelengths.total(own)
                return [dr.sum(radiance) / len(radiance) * light]

            (halves,) = self._tracer.trace(
                *(np.arange(count, dtype=np.uint32), begin, end, choose, weigh),
                elsewhere=self._index,
                name=f"glare of filter {number}",
            )
            means[number] = [np.array(half, np.float64).mean() for half in halves]
        return means
