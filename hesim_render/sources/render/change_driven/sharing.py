"""Which pixels of an anchor share what their paths find with those around, and with how many rays."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hesim_render.sources.render.change_driven.aim import PairAims
from hesim_render.sources.render.change_driven.edges import PairEdges
from hesim_render.sources.render.change_driven.error_target import Noise
from hesim_render.sources.render.change_driven.estimates import Band, Counts
from hesim_render.sources.render.change_driven.pair_flux import PairFlux
from hesim_render.sources.render.change_driven.plan import Plan
from hesim_render.sources.render.change_driven.shared_tracer import TRIAL_RAYS, SharedTracer, Tiles
from hesim_render.sources.render.change_driven.tuning import Gain, Tuning
from hesim_render.sources.render.change_driven.windows import Windows


class Sharing:
    """Event pixels that share, in anchors alone: there all pixels of a tile are rendered, in other windows few are.

    Parameters
    ----------
    tracer : traces tiles.
    noise, quality : noise of the sensor, and the wanted error over it.
    tuning : constants.

    Attributes
    ----------
    lattice : the event pixels; None if nothing is shared.
    """

    def __init__(self, tracer: SharedTracer, noise: Noise, quality: float, tuning: Tuning) -> None:
        lattice = None if tracer.sensor.spec.evs is None else noise.lattice("events")
        self.lattice = lattice if tracer.may_share(lattice) else None
        self._tracer, self._noise, self._quality, self._tuning = tracer, noise, quality, tuning
        #: Error law of paths.
        self._gain = Gain(*tuning.path_gain)
        #: Number of rays, 0 where sharing does not pay, and expected error of the tiles that were asked for, e⁻/s.
        self._known: dict[int, tuple[int, float]] = {}

    def planned(self, what: Plan, band: Band, counts: Counts) -> Plan:
        """The plan of an anchor in which pixels share where that pays; this traces rays, see `SharedTracer.trial`.

        Parameters
        ----------
        what, band : plan without sharing, and its pixels.
        counts : where these rays are counted, as those of pilots.
        """
        if self.lattice is None:
            return what
        asks = what.rays[0] >= self._tuning.least_shared_rays
        if what.aims is not None:
            # aimed rays are those of the pixel alone
            asks &= what.aims.at(np.zeros(asks.size, np.int64), band.sites.listed).count == 0
        place = np.flatnonzero(asks)
        before = self._tracer.rays_done
        rays, error = self._of_tiles(Tiles(self.lattice).of(band.index[place])[0])
        counts.pilot_rays += self._tracer.rays_done - before
        pays = rays > 0
        out, errors, shared = what.rays.copy(), what.error.copy(), np.zeros(what.rays.shape, np.bool_)
        out[0, place[pays]], errors[0, place[pays]] = rays[pays], error[pays]
        shared[0, place[pays]] = True
        return replace(what, rays=out, error=errors, shared=shared)

    def trace(
        self,
        pairs: tuple[NDArray[np.uint32], NDArray[np.integer], Windows, NDArray[np.integer], NDArray[np.bool_]],
        shared: NDArray[np.bool_] | None,
        span_us: tuple[float, float] | None,
        aims: PairAims | None,
        edges: PairEdges | None,
        shadows: NDArray[np.uint32] | None,
    ) -> PairFlux:
        """Flux of pairs; see `PairTracer.trace`.

        Parameters
        ----------
        pairs : pixels, windows, all windows, rays and estimators.
        shared : [n], pairs that share, unless they hold a known line; None for none.
        span_us, aims, edges, shadows : see `PairTracer.trace`.
        """
        pixel, window, windows, rays, controlled = pairs
        if shared is None or self.lattice is None:
            return self._tracer.trace(*pairs, span_us=span_us, aims=aims, edges=edges, shadows=shadows)
        is_shared = shared if edges is None else shared & ~edges.is_there
        together, alone, out = np.flatnonzero(is_shared), np.flatnonzero(~is_shared), PairFlux.empty(pixel.size)
        of = pixel[together], window[together], windows, rays[together], self.lattice
        out.put_at(together, self._tracer.shared(*of, span_us=span_us))
        given = pixel[alone], window[alone], windows, rays[alone], controlled[alone]
        aims = None if aims is None else aims.part(alone)
        edges = None if edges is None else edges.part(alone)
        shadows = None if shadows is None else shadows[alone]
        out.put_at(alone, self._tracer.trace(*given, span_us=span_us, aims=aims, edges=edges, shadows=shadows))
        return out

    def _of_tiles(self, tile: NDArray[np.int64]) -> tuple[NDArray[np.int16], NDArray[np.float32]]:
        """Rays of the pixels of some tiles, 0 where they do not share, and expected errors, e⁻/s. All pixels of a tile
        have the same number of rays, since they are traced together.
        """
        assert self.lattice is not None
        tuning, power = self._tuning, self._gain.power
        new = np.array(sorted(set(tile.tolist()) - self._known.keys()), np.int64)
        if new.size:
            flux, (shared, alone) = self._tracer.trial(new, self.lattice)
            pixel = Tiles(self.lattice).pixels(new).ravel()
            unit = self._noise.of("events", pixel)(flux.ravel().astype(np.float32)).reshape(flux.shape)
            # rms over the pixels of a tile, in wanted errors
            error = np.sqrt(np.mean(shared / (self._quality * unit) ** 2, axis=1))
            pays = alone.sum(axis=1) > tuning.least_sharing_gain * shared.sum(axis=1)
            # anchors are knots
            needed = TRIAL_RAYS * error ** (1 / power) * tuning.knot_factor
            bits = np.rint(np.log2(np.clip(needed, tuning.least_difference_rays, tuning.most_rays)))
            rays = np.where(pays, 2**bits, 0).astype(np.int64)
            # what this number of rays leaves
            left = error * self._quality * unit.mean(axis=1) * (np.maximum(rays, 1) / TRIAL_RAYS) ** -power
            self._known.update(zip(new.tolist(), zip(rays.tolist(), left.tolist(), strict=True), strict=True))
        known = np.array([self._known[each] for each in tile.tolist()]).reshape(-1, 2)
        return known[:, 0].astype(np.int16), known[:, 1].astype(np.float32)
