"""Results of tracing pairs of a pixel and a window: flux, and the statistics of a pilot pass."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, UInt32
from hesim_render.core.host_arrays import from_host
from hesim_render.core.journal import Journal, key_of
from hesim_render.sources.render.change_driven.aim import PairAims
from hesim_render.sources.render.change_driven.edges import EdgeFit, PairEdges
from hesim_render.sources.render.change_driven.ray_statistics import RayStatistics
from hesim_render.sources.render.change_driven.windows import Windows

#: What a pair shows, by `PilotFlux`, and how its rays differ from the same rays in another window.
STATISTICS = ("controlled", "plain", "controlled_scatter", "plain_scatter", "unshadowed")
BOUNCED = "bounced_scatter"
CHANGES = ("controlled_change", "plain_change")


@dataclass(frozen=True)
class PairFlux:
    """Flux of pairs, one entry per pair.

    Parameters
    ----------
    half_a, half_b : two independent estimates of the mean flux, e⁻/s, float32.
    met : True if any path came through the box of a moving object.
    """

    half_a: NDArray[np.float32]
    half_b: NDArray[np.float32]
    met: NDArray[np.bool_]

    @property
    def mean(self) -> NDArray[np.float32]:
        return np.float32(0.5) * (self.half_a + self.half_b)

    @classmethod
    def empty(cls, count: int) -> "PairFlux":
        """Flux to be filled in."""
        return cls(np.empty(count, np.float32), np.empty(count, np.float32), np.zeros(count, np.bool_))

    def at(self, place: NDArray[np.int64]) -> "PairFlux":
        """Flux of some pairs."""
        return PairFlux(self.half_a[place], self.half_b[place], self.met[place])

    def set_apart(self, part: np.float32, wanted: NDArray[np.float32]) -> None:
        """Set the halves of pairs whose halves are below a part of the wanted error apart by it; their means stay."""
        unseen = np.maximum(np.abs(self.half_a), np.abs(self.half_b)) < part * wanted
        self.half_a[unseen] += wanted[unseen]
        self.half_b[unseen] -= wanted[unseen]

    def put_at(self, place: NDArray[np.int64], flux: "PairFlux") -> None:
        """Set the flux of some pairs."""
        self.half_a[place], self.half_b[place], self.met[place] = flux.half_a, flux.half_b, flux.met

    def put(
        self, part: slice | NDArray[np.int64], flux: Float, met: UInt32, packets: NDArray[np.int64], packet_rays: int
    ) -> None:
        """Put in the means over rays, the first half of which belong to half a.

        Parameters
        ----------
        part : pairs that were traced.
        flux, met : of each ray, one pair after the other; `met` is 1 where the ray came near a moving object.
        packets, packet_rays : number of packets of each pair, and of rays in a packet.
        """
        # sums over half packets: a half of a pair is never smaller
        sums = np.array(dr.block_sum(flux, packet_rays // 2))
        bits = np.array(dr.block_reduce(dr.ReduceOp.Or, met, packet_rays))
        starts = np.cumsum(packets) - packets
        # a pair of one packet is half a then half b; longer ones have their first packets in half a
        halves = np.add.reduceat(sums.astype(np.float64), np.stack([2 * starts, 2 * starts + packets], axis=1).ravel())
        halves = halves.reshape(-1, 2) / (packets * (packet_rays / 2))[:, None]
        self.half_a[part], self.half_b[part] = halves[:, 0], halves[:, 1]
        self.met[part] = np.bitwise_or.reduceat(bits, starts)


@dataclass(frozen=True)
class PilotFlux:
    """Statistics of a few rays of each pair, one entry per pair, for both estimators of `DiffuseIntegrator`.

    Parameters
    ----------
    controlled, plain : mean flux, e⁻/s, float32.
    controlled_scatter, plain_scatter : scatter of single rays, e⁻/s, float32: the root of the mean fourth power of
        deviations over their mean square. It equals the standard deviation if half of the rays give one value and half
        another. It is larger if few rays deviate, because stratification then gains less. A *mild* scatter is the
        geometric mean of the two, the fourth root of the mean fourth power.
    unshadowed : flux if nothing hid any light, e⁻/s, float32.
    met : see `PairFlux`.
    controlled_change, plain_change : standard deviation of the difference of single rays to the same rays in another
        window, e⁻/s, float32; 0 where there is none to compare with.
    bounced_scatter : scatter, never mild, of what paths find beside closed forms, e⁻/s, float32; None for nothing.
    """

    controlled: NDArray[np.float32]
    plain: NDArray[np.float32]
    unshadowed: NDArray[np.float32]
    controlled_scatter: NDArray[np.float32]
    plain_scatter: NDArray[np.float32]
    met: NDArray[np.bool_]
    controlled_change: NDArray[np.float32]
    plain_change: NDArray[np.float32]
    bounced_scatter: NDArray[np.float32] | None = None

    @classmethod
    def empty(cls, count: int, has_bounced: bool = False) -> "PilotFlux":
        """Statistics to be filled in."""
        controlled, plain, unshadowed, *others = (np.zeros(count, np.float32) for _ in range(7))
        bounced, met = np.zeros(count, np.float32) if has_bounced else None, np.zeros(count, np.bool_)
        return cls(controlled, plain, unshadowed, others[0], others[1], met, others[2], others[3], bounced)

    @property
    def statistics(self) -> tuple[str, ...]:
        """Names of what a pair shows."""
        return STATISTICS if self.bounced_scatter is None else (*STATISTICS, BOUNCED)

    @property
    def tables(self) -> dict[str, NDArray]:
        """All values by name."""
        return {each.name: values for each in fields(self) if (values := getattr(self, each.name)) is not None}

    def with_means(self, place: NDArray[np.int64], others: "PilotFlux", chosen: NDArray[np.bool_]) -> "PilotFlux":
        """The same, but for what some pairs show, which is that of those that are `chosen` among others; changes and
        `met` stay.
        """
        tables = {name: getattr(self, name).copy() for name in self.statistics}
        for name, values in tables.items():
            values[place] = getattr(others, name)[chosen]
        return replace(self, **tables)

    def with_pairs(self, place: NDArray[np.int64], others: "PilotFlux") -> "PilotFlux":
        """The same, but for some pairs, which show what others do."""
        tables = {name: values.copy() for name, values in self.tables.items()}
        for name, values in tables.items():
            values[place] = getattr(others, name)
        return PilotFlux(**tables)

    def put(
        self,
        part: slice | NDArray[np.int64],
        controlled: Float,
        plain: Float,
        unshadowed: Float,
        met: UInt32,
        samples: int,
        alike: int,
        before: "tuple[PilotRays, NDArray[np.integer]] | None" = None,
        mild: bool = False,
        bounced: Float | None = None,
    ) -> None:
        """Put in the statistics of pairs.

        Parameters
        ----------
        part : pairs that were traced.
        controlled, plain, unshadowed, met : of each ray, one pair after the other; `met` is 1 where the ray came near a
            moving object.
        samples : number of rays of each pair.
        alike : number of successive rays that are of one kind, all or half of them. Scatter is that within each kind.
        before : the same rays in other windows, and [n] the pair among them to compare each pair with; None where there
            is none.
        mild : take the mild scatter.
        bounced : of each ray, what paths find beside closed forms; None if there is nothing.
        """
        types, rays = jit(), RayStatistics(len(met) // samples, samples, alike)
        dr.eval(controlled, plain, unshadowed, met, bounced)
        # place of the first ray of each pair among the rays to compare with
        others: tuple[Float, ...] = ()
        first = None
        if before is not None:
            others = before[0].controlled, before[0].plain
            first = from_host(types.UInt32, before[1]) * dr.opaque(types.UInt32, samples)
        # both estimators from the same rays; the plan chooses by their scatter
        estimates = [controlled, plain] if bounced is None else [controlled, plain, bounced]
        means, bits, scattered, changes = rays.of([unshadowed], met, estimates, others, first, 2 if mild else 0)
        results: dict[str, Float | UInt32] = {"unshadowed": means[0], "met": bits}
        for name, (mean, scatter) in zip(("controlled", "plain"), scattered, strict=False):
            results[name], results[f"{name}_scatter"] = mean, scatter
        if bounced is not None:
            results[BOUNCED] = scattered[2][1]
        results.update(zip(CHANGES, changes, strict=False))
        dr.eval(*results.values())
        for name, each in results.items():
            getattr(self, name)[part] = np.array(each)


def not_negative(flux: PairFlux) -> None:
    """Raise negative means to 0, in place, and keep the difference of the halves as far as possible.

    An estimate with a control variate may be negative; a flux is not.
    """
    below = np.minimum(flux.mean, 0)
    flux.half_a[:] -= below
    flux.half_b[:] = np.maximum(flux.half_b - below, -flux.half_a)


@dataclass(frozen=True)
class PilotRays:
    """Fluxes of the pilot's single rays, on the device, one pair after the other, e⁻/s on the optical axis.

    Parameters
    ----------
    controlled, plain : by both estimators of `DiffuseIntegrator`.
    samples : rays of each pair.
    spans_us : begins and ends of the windows, µs.
    """

    controlled: Float
    plain: Float
    samples: int
    spans_us: tuple[float, ...]


def joined(first: PilotRays, second: PilotRays) -> PilotRays:
    """Rays of two lists of pairs, one after the other."""
    controlled, plain = (
        dr.concat([getattr(each, name) for each in (first, second)]) for name in ("controlled", "plain")
    )
    return PilotRays(controlled, plain, first.samples, first.spans_us + second.spans_us)


def remembered(
    journal: Journal | None,
    inputs: tuple[object, ...],
    out: PairFlux | PilotFlux | EdgeFit,
    part: slice | NDArray[np.int64],
    trace: Callable[[], object],
) -> None:
    """Put the results of some pairs into `out`: those of an interrupted run, or new ones, which the journal keeps.

    Parameters
    ----------
    journal : None where none is written.
    inputs : all that the results depend on.
    out, part : results of all pairs, and which of them are meant.
    trace : puts new ones into `out`.
    """
    if journal is None:
        trace()
        return
    every = list(out.tables.values()) if isinstance(out, PilotFlux) else [getattr(out, f.name) for f in fields(out)]
    key, kept = key_of(*inputs), [values[part].copy() for values in every]
    if journal.recall(key, kept):
        for values, known in zip(every, kept, strict=True):
            values[part] = known
    else:
        trace()
        journal.keep(key, [values[part] for values in every])


def flux_inputs(
    windows: Windows, span_us: tuple[float, float] | None, aims: PairAims | PairEdges | None
) -> tuple[object, ...]:
    """What the flux of pairs depends on besides the pairs themselves."""
    aimed = () if aims is None else tuple(getattr(aims, each.name) for each in fields(aims))
    return windows.begin_us, windows.end_us, span_us, *aimed
