"""Flicker: lights whose power follows a waveform, exactly, at the cost of one render for each waveform.

Light adds up: Φ(t) = Σ w(t)·Φ_w, where Φ_w is the flux with only the lights of waveform w lit at their mean level and
all others dark, and w has the time mean 1. While the geometry stands still each Φ_w is rendered once and the
mean over an interval is exact: Φ_w times the mean of w, in closed form. Where something moves, the mean of a
product is taken as the product of the means over pieces of time in which the image hardly moves, or ln w departs from
a straight line by 0.002 or less: in each cell of time (`schedule.CELL_US`) those that are fewer.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device_types import Float, Halves
from hesim_render.mosaic.schedule import CELL_US, Block
from hesim_render.sources.protocol import AuditableFlux, FluxSource, Sample, SampledFlux
from hesim_render.sources.scene import Scene
from hesim_render.specs.light import LightSpec
from hesim_render.specs.waveform import WaveformSpec
from hesim_render.spectral.waveform import Waveform

#: Most steps in which an event window that is passing a jump is followed.
_WINDOW_STEPS = 8


def light_parts(scene: Scene) -> list[tuple[Waveform | None, Scene]]:
    """The scene once for each different waveform, lit only by the lights that have it; first those without any.

    Scenes without flicker are one part, themselves. A level of a Mitsuba scene is of all its light: it has to be a
    factor already (`in_absolute_light`).
    """
    own = scene.spec.mitsuba
    if own is not None:
        assert not own.has_level
        return _mitsuba_parts(scene)
    lights = scene.spec.lights
    flickering = [_flicker(light.waveform) for light in lights]
    if not any(flickering):
        return [(None, scene)]
    parts: list[tuple[Waveform | None, Scene]] = []
    for kind in _different(flickering):
        lit = [
            light.model_copy(update={"waveform": None}) if has == kind else light.unlit()
            for light, has in zip(lights, flickering, strict=True)
        ]
        if any(light.is_lit for light in lit):
            parts.append((kind.load() if kind else None, _with_lights(scene, lit)))
    return parts or [(None, scene)]


def _flicker(spec: WaveformSpec | None) -> WaveformSpec | None:
    """A waveform that changes, or None."""
    return None if spec is None or spec.load().is_constant else spec


def _different(kinds: Sequence[WaveformSpec | None]) -> list[WaveformSpec | None]:
    """Each once, None first."""
    found: list[WaveformSpec | None] = [None] if None in kinds else []
    for kind in kinds:
        if kind not in found:
            found.append(kind)
    return found


def _with_lights(scene: Scene, lights: list[LightSpec]) -> Scene:
    return Scene(scene.spec.model_copy(update={"light": tuple(lights)}))


def _mitsuba_parts(scene: Scene) -> list[tuple[Waveform | None, Scene]]:
    own = scene.spec.mitsuba
    assert own is not None
    named = {name: spec for name, spec in own.waveforms.items() if _flicker(spec) is not None}
    if not named:
        return [(None, scene)]
    parts: list[tuple[Waveform | None, Scene]] = []
    for kind in _different([None, *named.values()]):
        lights = (
            {"unlit": (*own.unlit, *named)}
            if kind is None
            else {"lit": tuple(name for name, spec in named.items() if spec == kind and own.may_shine(name))}
        )
        part = own.model_copy(update={"waveforms": {}, **lights})
        parts.append((kind.load() if kind else None, Scene(scene.spec.model_copy(update={"mitsuba": part}))))
    return parts


def flickering(scene: Scene, make: Callable[[Scene, float], FluxSource], window_us: float = 1.0) -> FluxSource:
    """The source of a scene's flux, whatever its lights do.

    Parameters
    ----------
    scene : with or without waveforms.
    make : builds the source of one part of it, called once where no light flickers; the second argument is the
        highest power of the part's light over its mean.
    window_us : in which event pixels integrate; a jump of the light is followed through it.
    """
    parts = light_parts(scene)
    if len(parts) == 1 and parts[0][0] is None:
        return make(parts[0][1], 1.0)
    waveforms = [waveform for waveform, _ in parts]
    sources = [make(part, 1.0 if waveform is None else waveform.highest) for waveform, part in parts]
    if sources[0].is_static or all(isinstance(source, SampledFlux) for source in sources):
        return SampledFlickerFlux(waveforms, sources, window_us)
    return FlickerFlux(waveforms, sources, window_us)


class FlickerFlux:
    """Sources of one scene under its different lights, each times its waveform; implements `FluxSource`.

    Parameters
    ----------
    waveforms : of each source; None is steady.
    sources : of the same geometry and camera.
    window_us : in which event pixels integrate.

    Attributes
    ----------
    sources : as given.
    sensor, view : of the first source, where it has any.
    is_static : False.
    """

    def __init__(
        self, waveforms: Sequence[Waveform | None], sources: Sequence[FluxSource], window_us: float = 1.0
    ) -> None:
        self.sources, self._waveforms, self._window_us = tuple(sources), tuple(waveforms), window_us
        first = self.sources[0]
        self.sensor, self.view = getattr(first, "sensor", None), getattr(first, "view", None)
        self.is_static = False
        self._still = _StillFlux(self.sources) if first.is_static else None

    def slice_edges_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Those of the scene's motion, µs."""
        return self.sources[0].slice_edges_us(begin_us, end_us)

    def sample_times_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Times strictly inside the interval that follow motion and light, µs.

        Around a jump of the light they are whole µs: the last before it, and some until a window that
        begins after it has passed.
        """
        times = [self.sources[0].sample_times_us(begin_us, end_us), self._follow_us(begin_us, end_us)]
        steps = max(1, min(_WINDOW_STEPS, round(self._window_us)))
        after = np.ceil(self._window_us * np.arange(steps + 1) / steps)
        for waveform in self._waveforms:
            if waveform is not None:
                jumps = waveform.jumps_us(begin_us, end_us)
                times += [np.floor(jumps), (np.ceil(jumps)[:, None] + after).ravel()]
        every = np.unique(np.concatenate(times))
        return every[(every > begin_us) & (every < end_us)]

    def _follow_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        lists = [waveform.follow_us(begin_us, end_us) for waveform in self._waveforms if waveform is not None]
        return np.unique(np.concatenate(lists))

    def _weights(self, begin_us: ArrayLike, end_us: ArrayLike) -> list[NDArray[np.float64]]:
        """Mean of each source's waveform over the intervals."""
        shape = np.broadcast_shapes(np.shape(begin_us), np.shape(end_us))
        return [np.ones(shape) if w is None else w.mean(begin_us, end_us) for w in self._waveforms]

    def mean_flux(self, pixel: NDArray[np.uint32], begin_us: ArrayLike, end_us: ArrayLike) -> Halves:
        """Mean Φ of each listed pixel over its own interval; see `FluxSource.mean_flux`."""
        pixels = np.ascontiguousarray(pixel, dtype=np.uint32).ravel()
        begin, end = np.asarray(begin_us, dtype=np.float64), np.asarray(end_us, dtype=np.float64)
        if pixels.size == 0:
            return self.sources[0].mean_flux(pixels, begin, end)
        if self._still is not None:
            return _weighted(self._still.halves(pixels), self._weights(begin, end))
        low, high = float(begin.min()), float(end.max())
        cuts = self._cuts_us(low, high)
        if cuts.size == 0:
            return self._piece(pixels, begin, end, self._weights(begin, end))
        return self._pieces(pixels, begin, end, np.concatenate([[low], cuts, [high]]))

    def _cuts_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Times strictly inside an interval between which image or light hardly change: in every cell the fewer."""
        light = self._follow_us(begin_us, end_us)
        if light.size == 0:
            return light
        cuts = [np.empty(0)]
        for number in range(int(begin_us // CELL_US), -(-int(np.ceil(end_us)) // CELL_US)):
            low, high = number * CELL_US, (number + 1) * CELL_US
            # of whole cells, whatever part of them is asked for
            bright = self._follow_us(low, high)
            motion = self.sources[0].sample_times_us(low, high) if bright.size else bright
            cuts += [min(bright, motion, key=len), np.array([high], np.float64)]
        every = np.unique(np.concatenate(cuts))
        return every[(every > begin_us) & (every < end_us)]

    def _piece(
        self, pixel: NDArray[np.uint32], begin: NDArray, end: NDArray, weights: list[NDArray[np.float64]]
    ) -> Halves:
        """Every source's mean times that of its waveform; sources that are dark meanwhile are not asked."""
        lit = [number for number, weight in enumerate(weights) if np.any(weight)]
        halves = [self.sources[number].mean_flux(pixel, begin, end) for number in lit]
        if not lit:
            types = jit()
            return types.Float(np.zeros(pixel.size, np.float32)), types.Float(np.zeros(pixel.size, np.float32))
        return _weighted(halves, [weights[number] for number in lit])

    def _pieces(self, pixel: NDArray[np.uint32], begin: NDArray, end: NDArray, bounds: NDArray[np.float64]) -> Halves:
        """The same piece by piece; a pixel takes part in those that meet its interval."""
        import drjit as dr

        types = jit()
        begin, end = (np.broadcast_to(times, pixel.shape) for times in (begin, end))
        length = end - begin
        totals = [types.Float(np.zeros(pixel.size, np.float32)) for _ in range(2)]
        for number, (low, high) in enumerate(zip(bounds[:-1], bounds[1:], strict=True)):
            first, last = np.clip(begin, low, high), np.clip(end, low, high)
            # an interval without length lies in the piece that begins there, or before the very end
            instant = (length == 0) & (begin >= low) & ((begin < high) | (number == bounds.size - 2))
            share = np.divide(last - first, length, out=instant.astype(np.float64), where=length > 0)
            where = np.flatnonzero(share)
            if where.size == 0:
                continue
            weights = [weight * share[where] for weight in self._weights(first[where], last[where])]
            index = types.UInt32(where.astype(np.uint32))
            for total, half in zip(totals, self._piece(pixel[where], first[where], last[where], weights), strict=True):
                # every index occurs once, so this is no race and the sum's order is that of time
                dr.scatter(total, dr.gather(types.Float, total, index) + half, index)
            dr.eval(totals)
        return totals[0], totals[1]


class SampledFlickerFlux(FlickerFlux):
    """The same where the sources take many windows at once, or nothing moves; implements `SampledFlux`."""

    def instants_us(self, begin_us: float, end_us: float) -> NDArray[np.int64]:
        """See `SampledFlux.instants_us`."""
        inner = np.rint(self.sample_times_us(begin_us - 1, end_us + 1)).astype(np.int64)
        cells = np.arange(begin_us // CELL_US, end_us // CELL_US + 1, dtype=np.int64) * CELL_US
        every = np.unique(np.concatenate([np.rint([begin_us, end_us]).astype(np.int64), inner, cells]))
        return every[(every >= begin_us) & (every <= end_us)]

    def flux_of_blocks(self, pixel: NDArray[np.uint32], blocks: Iterable[Block]) -> Iterator[Sample]:
        """See `SampledFlux.flux_of_blocks`.

        Windows in which light and image both change are cut into pieces, which are windows of their own.
        """
        pixels = np.ascontiguousarray(pixel, dtype=np.uint32).ravel()
        if self._still is not None:
            halves = self._still.halves(pixels)
            for block in blocks:
                begin, end = block.begin_us[block.wanted], block.end_us[block.wanted]
                for weights in np.stack(self._weights(begin, end), axis=1):
                    yield Sample(*_weighted(halves, list(weights)), np.zeros(pixels.size, np.float32))
            return
        mine, *others = itertools.tee(map(self._cut, blocks), 1 + len(self.sources))
        streams = []
        for source, cut in zip(self.sources, others, strict=True):
            assert isinstance(source, SampledFlux)
            streams.append(source.flux_of_blocks(pixels, (pieces for pieces, _ in cut)))
        samples = zip(*streams, strict=True)
        for pieces, counts in mine:
            begin, end = pieces.begin_us[pieces.wanted], pieces.end_us[pieces.wanted]
            weights = np.stack(self._weights(begin, end), axis=1)
            for first, count in zip(np.cumsum(counts) - counts, counts, strict=True):
                length = end[first + count - 1] - begin[first]
                share = (end - begin)[first : first + count] / length if length > 0 else np.ones(1)
                yield self._sum([next(samples) for _ in range(count)], weights[first : first + count] * share[:, None])

    def _cut(self, block: Block) -> tuple[Block, NDArray[np.int64]]:
        """Pieces of a block's windows; and how many each wanted one has.

        Of the first window, which belongs to the block before, there is the last piece: where that one ends.
        """
        begin, end, wanted, counts = [], [], [], []
        for number, (low, high, asked) in enumerate(zip(block.begin_us, block.end_us, block.wanted, strict=True)):
            bounds = np.concatenate([[low], self._cuts_us(low, high), [high]])
            if number == 0 and not asked:
                bounds = bounds[-2:]
            begin.append(bounds[:-1])
            end.append(bounds[1:])
            wanted.append(np.full(bounds.size - 1, asked))
            if asked:
                counts.append(bounds.size - 1)
        return Block(*map(np.concatenate, (begin, end, wanted))), np.array(counts, np.int64)

    def _sum(self, samples: Sequence[tuple[Sample, ...]], weights: NDArray[np.float64]) -> Sample:
        """Of all sources, [source] each, in the pieces of a window; `weights` [piece, source]."""
        every = [sample for piece in samples for sample in piece]
        half_a, half_b = _weighted([(one.half_a, one.half_b) for one in every], list(weights.ravel()))
        # the halves of all pieces have the same random numbers: their errors add up; those of two sources do not
        of_sources = np.zeros((len(self.sources), len(every[0].error) if every[0].error is not None else 0), np.float32)
        for number, total in enumerate(of_sources):
            for piece, weight in zip(samples, weights[:, number], strict=True):
                error = piece[number].error
                if error is not None:
                    total += np.float32(weight) * error
        return Sample(half_a, half_b, np.sqrt(np.sum(of_sources**2, axis=0)))

    # ---- for the audit, where the sources have what it takes ---------------------------------------

    @property
    def _auditable(self) -> list[AuditableFlux]:
        return [source for source in self.sources if isinstance(source, AuditableFlux)]

    @property
    def rays_traced(self) -> int:
        """Of all sources."""
        return sum(source.rays_traced for source in self._auditable)

    def still_pixels(self, pixel: NDArray[np.uint32]) -> NDArray[np.bool_]:
        """None: light changes everywhere."""
        return np.zeros(pixel.size, np.bool_)

    def noise_unit(self, pixel: NDArray[np.uint32], flux: NDArray[np.float64], events: bool) -> NDArray[np.float64]:
        """See `ChangeDrivenFlux.noise_unit`."""
        return self._auditable[0].noise_unit(pixel, flux, events)

    def reference_flux(
        self,
        pixel: NDArray[np.uint32],
        begin_us: NDArray[np.float64],
        end_us: NDArray[np.float64],
        quality: float,
        events: bool,
    ) -> NDArray[np.float64]:
        """See `ChangeDrivenFlux.reference_flux`."""
        if self._still is not None:
            asked, place = np.unique(pixel, return_inverse=True)
            zero = np.zeros(asked.size)
            parts = [
                source.reference_flux(asked, zero, zero + 1.0, quality, events)[place] for source in self._auditable
            ]
            return np.sum([w * part for w, part in zip(self._weights(begin_us, end_us), parts, strict=True)], axis=0)
        spans, number = np.unique(np.stack([begin_us, end_us]), axis=1, return_inverse=True)
        bounds = [np.concatenate([[low], self._cuts_us(low, high), [high]]) for low, high in spans.T]
        counts = np.array([each.size - 1 for each in bounds])[number.ravel()]
        pair = np.repeat(np.arange(pixel.size), counts)
        low, high = (np.concatenate([bounds[k][part] for k in number.ravel()]) for part in (slice(-1), slice(1, None)))
        length = (end_us - begin_us)[pair]
        share = np.divide(high - low, length, out=np.ones_like(length), where=length > 0)
        total = np.zeros(pixel.size)
        for source, weight in zip(self._auditable, self._weights(low, high), strict=True):
            np.add.at(total, pair, share * weight * source.reference_flux(pixel[pair], low, high, quality, events))
        return total


class _StillFlux:
    """Flux of sources that stand still: every pixel is rendered once, when it is first asked for."""

    def __init__(self, sources: Sequence[FluxSource]) -> None:
        self._sources = sources
        self._known = np.zeros(0, dtype=np.bool_)
        self._kept: list[list[Float]] = [[] for _ in sources]  # both halves of each source, by mosaic index

    def halves(self, pixel: NDArray[np.uint32]) -> list[Halves]:
        """Both halves of each source, Dr.Jit Float [n] each."""
        import drjit as dr

        types = jit()
        self._reach(int(pixel.max()) + 1 if pixel.size else 0)
        fresh = np.unique(pixel[~self._known[pixel]])
        if fresh.size:
            where = types.UInt32(fresh)
            for source, kept in zip(self._sources, self._kept, strict=True):
                for whole, half in zip(kept, source.mean_flux(fresh, 0.0, 1.0), strict=True):
                    dr.scatter(whole, half, where)
                dr.eval(kept)
            self._known[fresh] = True
        index = types.UInt32(pixel)
        found = [(dr.gather(types.Float, a, index), dr.gather(types.Float, b, index)) for a, b in self._kept]
        dr.eval(found)
        return found

    def _reach(self, size: int) -> None:
        """Make room for mosaic indices below `size`."""
        import drjit as dr

        missing = size - self._known.size
        if missing <= 0:
            return
        types = jit()
        self._known = np.concatenate([self._known, np.zeros(missing, dtype=np.bool_)])
        for kept in self._kept:
            room = [types.Float(np.zeros(missing, np.float32)) for _ in range(2)]
            kept[:] = [dr.concat([*old]) for old in zip(kept, room, strict=True)] if kept else room


def _weighted(halves: Sequence[Halves], weights: Sequence[ArrayLike]) -> Halves:
    """Σ weight · half, of both halves; weights are one number or one for each pixel."""
    import drjit as dr

    types = jit()
    # opaque: a number inside the kernel would make it a new one at every time
    factors = [
        dr.opaque(types.Float, float(np.asarray(w)))
        if np.ndim(w) == 0
        else types.Float(np.asarray(w, dtype=np.float32))
        for w in weights
    ]
    total_a, total_b = (
        sum((pair[k] * factor for pair, factor in zip(halves, factors, strict=True)), types.Float(0.0)) for k in (0, 1)
    )
    dr.eval(total_a, total_b)
    return total_a, total_b
