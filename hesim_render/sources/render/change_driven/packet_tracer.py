"""Rays of (pixel, time window) pairs, in packets. Each ray has its own instant inside the window of its pixel."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Ray, UInt32, UInt64
from hesim_render.core.host_arrays import from_host, spread_out
from hesim_render.core.method_cache import method_cache
from hesim_render.core.rng import Stream, stream_key
from hesim_render.sensor import lens as optics
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.render.change_driven.aim import Aim, LaneAims, PairAims
from hesim_render.sources.render.change_driven.edges import LaneEdges, PairEdges
from hesim_render.sources.render.change_driven.windows import Moments, Windows
from hesim_render.sources.render.sampling.wavelengths import WavelengthSampler
from hesim_render.sources.render.scene.mitsuba_version import mitsuba, path_depths
from hesim_render.sources.render.tracer import Tracer
from hesim_render.sources.render.transport.diffuse import DiffuseIntegrator
from hesim_render.sources.render.transport.moving_scene import MovingScene
from hesim_render.sources.render.transport.paths import PathIntegrator
from hesim_render.sources.render.transport.shared_paths import Groups
from hesim_render.sources.render.transport.swept_boxes import Moment
from hesim_render.sources.scene import Scene
from hesim_render.spectral.spectrum import Spectrum
from hesim_render.spectral.waveform import Waveform

#: Least and largest number of rays of a pair; one kernel serves all numbers at once.
LEAST_SAMPLES, MOST_SAMPLES = 8, 4096
#: Rays of a packet.
PACKET = LEAST_SAMPLES
#: Windows within which nothing moves far, µs: those of asynchronous sensors are much shorter.
_SHORT_US = 100.0


@dataclass(frozen=True)
class _Rays:
    """Rays before they are traced, one per lane.

    Parameters
    ----------
    ray : in world space.
    now : its time.
    filter : of its pixel.
    place : of its start, px from the centre of its pixel.
    share : of the window, at which it starts.
    weight : None for 1.
    model : flux of the model of an edge, e⁻/s on the optical axis; None for 0.
    """

    ray: Ray
    now: Moment
    filter: UInt32
    place: tuple[Float, Float]
    share: Float
    weight: Float | None
    model: Float | None


@dataclass(frozen=True)
class _Traced:
    """Results of rays, one per lane.

    Parameters
    ----------
    fluxes : the integrator's three fluxes, weighted, e⁻/s on the optical axis, and 1 where the ray met the box of a
        moving object, else 0.
    bounced : the part that paths find beside closed forms, weighted, e⁻/s on the optical axis; None if there is none.
    place : of its start, px from the centre of its pixel.
    share : of the window, at which it starts.
    """

    fluxes: tuple[Float, Float, Float, UInt32]
    bounced: Float | None
    place: tuple[Float, Float]
    share: Float


def pair_of_rays(packets: NDArray[np.int64]) -> UInt32:
    """Pair of each ray, where pairs [n] have some packets of rays each, one pair after the other."""
    types = jit()
    packet = dr.arange(types.UInt32, int(packets.sum()) * PACKET) // PACKET
    return spread_out(types.UInt32, np.repeat(np.arange(packets.size, dtype=np.uint32), packets), packet)


class PacketTracer(Tracer):
    """Traces paths from mosaic pixels into a `MovingScene`.

    Random numbers are a pure function of (seed, stream, pixel on the full sensor, half, sample), the same in every
    window, so a pixel whose paths no object crosses is exactly constant. Pixels are identified by their number on the
    full sensor, so a crop has the values of the full sensor to the bit.

    Parameters
    ----------
    scene, sensor, responses, progress, block_rays : see `Tracer`.
    seed : seed of the run.
    light : waveform of all lights of the scene, None if they are steady. The flux in a window is then the mean over
        instants whose density is the waveform.

    Attributes
    ----------
    traces : number of traces started so far.
    paths : traces light that has no closed form; None if all has.

    Raises
    ------
    SpecError
        If the scene cannot be loaded, does not cover a response, or needs the exact mode.
    """

    traces = 0

    def __init__(
        self,
        scene: Scene,
        sensor: Sensor,
        seed: int,
        responses: dict[str, Spectrum],
        progress: Callable[[int], None] | None = None,
        block_rays: int | None = None,
        light: Waveform | None = None,
    ) -> None:
        super().__init__(scene, sensor, responses, progress, block_rays)
        types, self._seed, self._light = jit(), seed, light
        self.rays.require_one_path()
        self.parts = MovingScene(self.built)
        (depth, roulette), diffuse = path_depths(self.built.integrator), self.built.diffuse
        self.paths: PathIntegrator | None = None
        self._direct: DiffuseIntegrator | None = None
        if diffuse is None or diffuse.needs_paths or depth != 2:
            self.paths = PathIntegrator(self.parts, depth, roulette, WavelengthSampler(self.sensor.responses))
        if diffuse is not None:
            self._direct = DiffuseIntegrator(self.parts, diffuse, self.sensor.responses, self.paths)
            # the integrator has what it needs of the pictures, which are large
            self.built.diffuse = None
        integrator = self._direct or self.paths
        assert integrator is not None
        self._integrator = integrator
        self._aim = Aim(self.parts, self.rays)
        self._boxes = method_cache(self.parts.box_rows_in, maxsize=8)
        layout = self.sensor.layout
        tile = np.array(layout.filter_index[: layout.tile_shape[0], : layout.tile_shape[1]], np.uint32)
        self._filter_tile = from_host(types.UInt32, tile)
        self._tile_rows, self._tile_cols = (dr.opaque(types.UInt32, count) for count in layout.tile_shape)
        dr.make_opaque(self._filter_tile)

    @property
    def is_diffuse(self) -> bool:
        """True if all visible light is direct light on diffuse surfaces."""
        return self.paths is None

    @property
    def has_bounced(self) -> bool:
        """True if some light is seen in closed form, and some by paths."""
        return self.paths is not None and self._direct is not None

    @property
    def is_plain(self) -> bool:
        """True if all visible light is direct light on diffuse surfaces without pictures."""
        return self.paths is None and self._direct is not None and not self._direct.has_pictures

    @property
    def moves_outlines(self) -> bool:
        """True if the same rays, which meet nothing that moves, may bring another flux at another time."""
        return self._direct is not None and self._direct.moves_outlines

    def moves_within(self, windows: Windows) -> bool:
        """True if edges may move by more than a small part of a pixel within a window."""
        something = bool(self.parts.groups) or self.camera is not None
        return something and bool(np.any(windows.end_us - windows.begin_us > _SHORT_US))

    def _key(self, stream: Stream) -> UInt64:
        mitsuba()  # the variant may have been changed by other code
        return dr.opaque(jit().UInt64, stream_key(self._seed, stream))

    def axis_factor(self, pixel: NDArray[np.uint32]) -> NDArray[np.float32]:
        """Factor from the flux on the optical axis to that of each pixel."""
        cols = np.uint32(self.sensor.spec.geometry.cols)
        row = pixel // cols
        col = pixel - row * cols
        return optics.relative_illumination_at(self.sensor.spec, self.sensor.lens, row, col) * np.float32(
            self.radiance_scale
        )

    def _moments(self, windows: Windows, span_us: tuple[float, float] | None) -> Moments:
        """Windows on the device, with the boxes that contain each object during each window, or during all of
        `span_us`.
        """
        tracks = [group.trajectory for group in self.parts.groups] + ([self.camera] if self.camera else [])
        # where nothing moves, any instant will do
        return Moments.of(windows, span_us, tracks, self._boxes, self._light if tracks else None)

    def _packets_of(
        self,
        lanes: Sequence[NDArray[np.uint32]],
        packets: NDArray[np.int64],
        half_rays: NDArray[np.int64],
        moments: Moments,
        key: UInt64,
        footprint: Float,
        aims: PairAims | PairEdges | None,
        is_weighted: bool = True,
        shadows: NDArray[np.uint32] | None = None,
    ) -> _Traced:
        """Trace pairs in packets of `PACKET` rays.

        The final render and the pilot pass share the kernel of the integrator, which takes seconds to compile.

        Parameters
        ----------
        lanes : pixel, window and repetition of each pair.
        packets, half_rays : number of packets of each pair, and of rays in its first half.
        moments, key, footprint, aims : see `trace` and `pilot`.
        is_weighted : take the model from the fluxes of pairs with an edge, and apply the weights of rays.
        shadows : of each pair, see `DiffuseIntegrator.flux`; None for none.

        Returns
        -------
        Of each ray.
        """
        self.traces += 1
        rays, pair = self._started(lanes, packets, half_rays, moments, key, footprint, aims)
        types, now = jit(), rays.now
        occluders = () if shadows is None else (spread_out(types.UInt32, shadows, pair),)
        dr.eval(*occluders)
        *fluxes, bounced, met = self._integrator.flux(self._sampler, rays.ray, now, rays.filter, *occluders)
        bits = dr.select(met, types.UInt32(1), dr.zeros(types.UInt32, int(packets.sum()) * PACKET))
        dr.eval(fluxes, bounced, bits)
        self._sampler.rest()
        if rays.weight is not None and is_weighted:
            model = 0 if rays.model is None else rays.model
            fluxes = [(flux - model) * rays.weight for flux in fluxes]
            bounced = None if bounced is None else bounced * rays.weight
            dr.eval(fluxes, bounced)
        return _Traced((fluxes[0], fluxes[1], fluxes[2], bits), bounced, rays.place, rays.share)

    def _started(
        self,
        lanes: Sequence[NDArray[np.uint32]],
        packets: NDArray[np.int64],
        half_rays: NDArray[np.int64],
        moments: Moments,
        key: UInt64,
        footprint: Float,
        aims: PairAims | PairEdges | None,
        groups: Groups | None = None,
    ) -> tuple[_Rays, UInt32]:
        """Rays of pairs, before they are traced, and the pair of each; see `_packets_of`. The sampler has drawn the
        numbers of their starts. Rays of a group have one time.
        """
        types = jit()
        used = int(packets.sum())
        ray_index = dr.arange(types.UInt32, used * PACKET)
        pair = pair_of_rays(packets)
        # the first ray of each pair, and what the pair has, side by side, so that one fetch brings them
        pixel_of, window_of, repeat_of = lanes
        columns = (np.cumsum(packets) - packets) * PACKET, pixel_of, window_of, half_rays
        heads = from_host(types.UInt32, np.stack(columns, axis=1).astype(np.uint32))
        start, pixel, window, per_half = dr.gather(types.Array4u, heads, pair)
        sample = ray_index - start
        half = dr.select(sample >= per_half, types.UInt32(1), types.UInt32(0))
        within_half, aimed, kinds = sample - half * per_half, None, 2
        if aims is not None:
            # rays of either kind have random numbers of their own, and are stratified among themselves
            per_half, kinds = per_half // 2, 4
            is_aimed = within_half >= per_half
            kind: type[LaneAims | LaneEdges] = LaneAims if isinstance(aims, PairAims) else LaneEdges
            aimed = kind.of(aims, pair, is_aimed)  # type: ignore[arg-type]
            within_half = dr.select(is_aimed, within_half - per_half, within_half)
            half += dr.select(is_aimed, types.UInt32(2), 0)
        keys = self._keys_of(key, heads, repeat_of, kinds)
        own_keys = dr.gather(types.Array4u, keys, dr.opaque(types.UInt32, kinds) * pair + half)
        self._sampler.start(tuple(own_keys), within_half, per_half, MOST_SAMPLES // 2)
        rays = self._rays_of(pixel, window, moments, footprint, aimed, groups)
        # A kernel of its own makes the rays, so that one kernel traces them however they were aimed. It brings the
        # numbers from which the next draws are made as well. Places and shares of the window are evaluated where they
        # are used, from the same numbers.
        now = rays.now
        dr.eval(
            self._sampler.state,
            rays.ray.o,
            rays.ray.d,
            now.instant_us,
            now.window,
            now.bin,
            rays.filter,
            rays.weight,
            rays.model,
        )
        return rays, pair

    def _keys_of(self, key: UInt64, heads: UInt32, repeat: NDArray[np.uint32], kinds: int) -> UInt32:
        """Keys of the random numbers of each pair and kind of ray, four numbers each: once for all rays of a kind.

        Parameters
        ----------
        heads : four numbers of each pair, of which the second one is its pixel.
        repeat : repetition of each pair.
        kinds : number of kinds of a pair.
        """
        types = jit()
        each = dr.arange(types.UInt32, repeat.size * kinds)
        pair = each // dr.opaque(types.UInt32, kinds)
        pixel = dr.gather(types.UInt32, heads, 4 * pair + 1)
        of_pair = pixel, each - pair * dr.opaque(types.UInt32, kinds), spread_out(types.UInt32, repeat, pair)
        keys: UInt32 = dr.ravel(types.Array4u(self._sampler.keys_of(key, *of_pair)))
        dr.eval(keys)
        return keys

    def _rays_of(
        self,
        pixel: UInt32,
        window: UInt32,
        moments: Moments,
        footprint: Float,
        aims: LaneAims | LaneEdges | None,
        groups: Groups | None,
    ) -> _Rays:
        """One ray per lane."""
        mi, types = self.built.mi, jit()
        row, col = self._row_and_col(pixel)
        sampler = self._sampler
        aperture, moment = sampler.start_3d()
        if groups is not None:
            moment = groups.of_first(moment)
        widened = (aperture - 0.5) * footprint + 0.5
        blur = self.rays.blur_numbers(sampler)
        centre = types.Float(col), types.Float(row)
        (x, y), weight, slot, model = self.rays.offset(widened, blur, centre), None, types.UInt32(0), None
        if isinstance(aims, LaneAims):
            slot, moment = self._aim.choose(aims, moment)
        elif isinstance(aims, LaneEdges):
            x, y, moment, weight, model = aims.place((x, y), aperture, moment)
        now = moments.at(window, moment)
        pose = None if self.camera is None else self.camera.pose_at(now.local_us(len(self.parts.groups)))
        if isinstance(aims, LaneAims):
            x, y, weight = self._aim.place(aims, slot, now, pose, centre, (x, y), aperture)
        origin, direction, weight = self.rays.through_lens(centre, (x, y), sampler, weight=weight)
        if pose is not None:
            origin, direction = pose.to_world(origin), pose.turn_to_world(direction)
        tile_row = row - row // self._tile_rows * self._tile_rows
        tile_col = col - col // self._tile_cols * self._tile_cols
        which = dr.gather(types.UInt32, self._filter_tile, tile_row * self._tile_cols + tile_col)
        primary = mi.Ray3f(mi.Point3f(*origin), mi.Vector3f(*direction))
        return _Rays(primary, now, which, (x, y), moment, weight, model)
