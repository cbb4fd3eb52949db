"""Design by gradients: filters, depth of the silicon and tile shares, from a file to palette and filter set."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float64
from hesim_render.core.errors import SpecError, did_you_mean
from hesim_render.core.host_arrays import from_host
from hesim_render.sensor import lens as optics
from hesim_render.sensor.sensor import load_sensor
from hesim_render.specs.design import DesignSpec
from hesim_render.specs.filter_set import FilterSetSpec, PaletteSpec, read_filter_set, read_palette
from hesim_render.specs.spectrum import SpectrumSpec
from hesim_render.spectral.physical import silicon_quantum_efficiency
from hesim_render.studies.colour_noise import channel_noise
from hesim_render.studies.colour_samples import reflectances_of
from hesim_render.studies.design_cost import Condition, DesignCost
from hesim_render.studies.design_filters import Dyes, Family, FreeCurves, ThinFilms
from hesim_render.studies.design_tile import repeated
from hesim_render.studies.filter_sets import filters_of, with_filter_set

#: Bands of all spectra of a design, nm.
BANDS_NM = np.arange(360.0, 831.0, 5.0)
#: Added to the weight of each share, so that all can be 0.
_LEAST_WEIGHT = 1e-3
#: Weight of the mean squared excess of a slope, in units of the largest slope.
_SLOPE_WEIGHT = 1000.0


@dataclass(frozen=True, eq=False)
class DesignResult:
    """Filters found by a design.

    Parameters
    ----------
    filters : transmittance at `BANDS_NM` of each varied filter.
    shares : share of each frame filter in the frame pixels, where shares are varied.
    silicon_depth_um : depth of the silicon, where it is varied.
    cost : of the best start.
    costs : of each start, before and after, [start, 2].
    evaluations : of the cost and its gradient, in all.
    """

    filters: dict[str, NDArray[np.float64]]
    shares: dict[str, float] | None
    silicon_depth_um: float | None
    cost: float
    costs: NDArray[np.float64]
    evaluations: int


class Problem:
    """Parameters, constraints and cost of a design.

    Raises
    ------
    SpecError
        If a file is not valid, parts do not fit, or a varied filter does not exist.
    """

    def __init__(self, spec: DesignSpec) -> None:
        self.spec = spec
        self.filter_set: FilterSetSpec = read_filter_set(spec.filter_set.beside(spec.filter_set.set))
        self.palette: PaletteSpec = read_palette(spec.beside(spec.filter_set.palette or spec.palette))
        self.base = load_sensor(spec.beside(spec.sensor))
        self.sensor = with_filter_set(self.base, self.filter_set, self.palette)
        self.names = list(self.sensor.spec.filters)
        self.vary = list(spec.vary) or self.names
        for name in self.vary:
            if name not in self.names:
                raise SpecError(f"vary: no filter {name!r}{did_you_mean(name, self.names)}", key="vary")
        if self.sensor.spec.aps is None:
            raise SpecError("a design needs frame pixels", key="filter_set")
        self.family = _family(spec)
        self.frames = filters_of(self.sensor, "aps")
        self.filter_size = len(self.vary) * len(self.family.bounds())
        self._start_depth_um = 0.0
        if spec.silicon_depth_um is not None:
            self._start_depth_um = silicon_depth(self.sensor.spec.quantum_efficiency)
        if spec.tile_px is not None:
            self._require_shares(*spec.tile_px)

    def _require_shares(self, rows: int, cols: int) -> None:
        tile, free = self.tile(rows, cols)
        if len(self.frames) < 2 or len(self.frames) * self.spec.share_min >= 1:
            raise SpecError(f"no shares of {len(self.frames)} filters of frames can be varied", key="share_min")
        if free.sum() < len(self.frames):
            raise SpecError(f"{len(self.frames)} filters do not fit on {free.sum()} pixels", key="tile_px")
        if any(set(self.filter_set.pixels[letter].roles) == {"aps", "evs"} for letter in tile.ravel()):
            raise SpecError("shares of pixels that give frames and events cannot be varied", key="tile_px")

    def tile(self, rows: int, cols: int) -> tuple[NDArray[np.str_], NDArray[np.bool_]]:
        """The set's tile repeated over a larger one, and which pixels give frames, [row, col]."""
        tile = repeated(self.filter_set, rows, cols)
        roles = np.vectorize(lambda letter: "aps" in self.filter_set.pixels[str(letter)].roles)
        return tile, roles(tile)

    @cached_property
    def open_response(self) -> NDArray[np.float64]:
        """Response at `BANDS_NM` of a pixel without a filter."""
        clear = SpectrumSpec(flat=1.0)
        spec = self.sensor.spec.model_copy(update={"filters": dict.fromkeys(self.names, clear)})
        return optics.response(spec, self.names[0], self.sensor.lens).at(BANDS_NM)

    @cached_property
    def start_transmittance(self) -> dict[str, NDArray[np.float64]]:
        """Transmittance of the filters of the palette."""
        return {name: each.load().at(BANDS_NM) for name, each in self.sensor.spec.filters.items()}

    @cached_property
    def cost(self) -> DesignCost:
        """The cost as a function of the responses."""
        spec, sensor = self.spec, self.sensor
        events = filters_of(sensor, "evs")
        reflectances = list(reflectances_of(spec.fit.surfaces()).values())
        conditions = [Condition.of(reflectances, each.spectrum.load(), BANDS_NM) for each in spec.fit.illuminants]
        aps, evs = sensor.spec.aps, sensor.spec.evs
        assert aps is not None
        exposure_us = float(spec.exposure_us or aps.exposure_us)
        scale, window_us = (0.0, 0.0), 1.0
        if evs is not None:
            table = sensor.calibrated_part.evs.table
            scale = float(np.expm1(evs.contrast_threshold_on)), float(np.mean(table.base / table.slope))
            window_us = float(evs.window_us)
        return DesignCost(
            sensor, BANDS_NM, conditions, spec.illuminance_lux, exposure_us,
            channel_noise(sensor, self.frames, exposure_us, spec.area_px),
            [self.names.index(name) for name in self.frames],
            [self.names.index(name) for name in events], scale, window_us,
            spec.cost,
        )  # fmt: skip

    def transmittances(self, parameters: Float64) -> dict[str, Float64]:
        """Transmittance of each varied filter from all parameters, each 0 to 1 between its bounds."""
        types = jit()
        bounds = self.family.bounds()
        curves = {}
        for number, name in enumerate(self.vary):
            own = []
            for k, (low, high) in enumerate(bounds):
                share = dr.gather(types.Float64, parameters, types.UInt32(number * len(bounds) + k))
                own.append(low + (high - low) * share)
            curves[name] = self.family.transmittance(own)
        return curves

    def shares(self, parameters: Float64) -> list[Float64]:
        """Share of each frame filter in the frame pixels, at least `share_min`, sum 1."""
        first = parameters.shape[0] - len(self.frames)
        types = jit()
        weights = [
            dr.gather(types.Float64, parameters, types.UInt32(first + k)) + _LEAST_WEIGHT
            for k in range(len(self.frames))
        ]
        least = self.spec.share_min
        return [least + (1 - len(weights) * least) * each / sum(weights) for each in weights]

    def depth_um(self, parameters: Float64) -> Float64:
        """Depth of the silicon, µm."""
        assert self.spec.silicon_depth_um is not None
        low, high = self.spec.silicon_depth_um
        return low + (high - low) * dr.gather(jit().Float64, parameters, jit().UInt32(self.filter_size))

    def _light(self, parameters: Float64) -> Float64:
        """Response at the bands of a pixel without a filter, with the depth of the silicon."""
        light = from_host(jit().Float64, self.open_response)
        if self.spec.silicon_depth_um is None:
            return light
        thin_um = 0.01
        per_um = -np.log1p(-silicon_quantum_efficiency(thin_um).at(BANDS_NM)) / thin_um
        before = -np.expm1(-per_um * self._start_depth_um)
        absorbed = 1 - dr.exp(-from_host(jit().Float64, per_um) * self.depth_um(parameters))
        return light * absorbed / from_host(jit().Float64, before)

    def __call__(self, parameters: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """Cost and gradient with respect to parameters between 0 and 1: filters, depth of the silicon, tile shares."""
        types = jit()
        given = from_host(types.Float64, parameters)
        dr.enable_grad(given)
        filters = self.transmittances(given)
        light = self._light(given)
        responses = [
            filters[name] * light
            if name in filters
            else from_host(types.Float64, self.start_transmittance[name]) * light
            for name in self.names
        ]
        counts = None
        if self.spec.tile_px is not None:
            _, free = self.tile(*self.spec.tile_px)
            own = float(self.spec.area_px * free.mean())
            counts = [own * share for share in self.shares(given)]
        total = self.cost(responses, counts)
        for each in filters.values():
            total += self._steepness(each) / len(filters)
        dr.backward(total)
        return float(total[0]), np.array(dr.grad(given), dtype=np.float64)

    def _steepness(self, transmittance: Float64) -> Float64:
        """Penalty of slopes above the largest one."""
        types = jit()
        place = dr.arange(types.UInt32, BANDS_NM.size - 1)
        step = float(BANDS_NM[1] - BANDS_NM[0]) * self.spec.slope_max_per_nm
        change = dr.gather(types.Float64, transmittance, place + 1) - dr.gather(types.Float64, transmittance, place)
        return _SLOPE_WEIGHT * dr.mean(dr.square(dr.maximum(dr.abs(change) / step - 1, 0)))

    def starts(self) -> list[NDArray[np.float64]]:
        """Parameters to start from, each 0 to 1."""
        rng = np.random.default_rng(self.spec.seed)
        low, high = np.array(self.family.bounds()).T
        starts = []
        for _ in range(self.spec.starts):
            own = [(self.family.start(self.start_transmittance[name], rng) - low) / (high - low) for name in self.vary]
            starts.append(np.clip(np.concatenate([*own, *self._other_starts()]), 0, 1))
        return starts

    def _other_starts(self) -> list[NDArray[np.float64]]:
        """Depth and shares as they are, as parameters."""
        parameters = []
        if self.spec.silicon_depth_um is not None:
            least, most = self.spec.silicon_depth_um
            parameters.append(np.array([(self._start_depth_um - least) / (most - least)]))
        if self.spec.tile_px is not None:
            tile, free = self.tile(*self.spec.tile_px)
            filters = [self.filter_set.pixels[str(letter)].filter for letter in tile[free]]
            above = np.array([filters.count(name) / len(filters) for name in self.frames]) - self.spec.share_min
            parameters.append(np.maximum(above, 0.02) / above.max())
        return parameters


def optimise(problem: Problem, progress: Callable[[float, float, str], None] | None = None) -> DesignResult:
    """The filters with the least cost over several starts, by L-BFGS-B [byrd1995] within bounds.

    Parameters
    ----------
    problem : the design.
    progress : called with (done, total, what).
    """
    from scipy.optimize import minimize

    spec = problem.spec
    best, costs, evaluations = None, [], 0
    for number, start in enumerate(problem.starts()):
        if progress is not None:
            progress(number, spec.starts, f"start {number + 1} of {spec.starts}")
        optimum = minimize(
            problem, start, jac=True, method="L-BFGS-B", bounds=[(0.0, 1.0)] * start.size,
            options={"maxiter": spec.steps, "maxfun": 4 * spec.steps, "ftol": 1e-10, "gtol": 1e-8},
        )  # fmt: skip
        costs.append([problem(start)[0], float(optimum.fun)])
        evaluations += int(optimum.nfev) + 1
        if best is None or optimum.fun < best.fun:
            best = optimum
    assert best is not None
    given = from_host(jit().Float64, best.x)
    curves = problem.transmittances(given)
    filters = {name: np.clip(np.array(each, dtype=np.float64), 0.0, 1.0) for name, each in curves.items()}
    shares = depth_um = None
    if spec.tile_px is not None:
        shares = {name: float(each[0]) for name, each in zip(problem.frames, problem.shares(given), strict=True)}
    if spec.silicon_depth_um is not None:
        depth_um = float(problem.depth_um(given)[0])
    return DesignResult(filters, shares, depth_um, float(best.fun), np.array(costs), evaluations)


def silicon_depth(efficiency: SpectrumSpec) -> float:
    """Depth of the silicon in a quantum efficiency, µm.

    Raises
    ------
    SpecError
        If it is not computed from one.
    """
    for part in (efficiency, *(efficiency.product or [])):
        if part.silicon_depth_um is not None:
            return part.silicon_depth_um
    raise SpecError(
        "the quantum efficiency does not come from a silicon_depth_um, alone or in a product", key="silicon_depth_um"
    )


def _family(spec: DesignSpec) -> Family:
    if spec.family == "dye":
        return Dyes(BANDS_NM, spec.bands, spec.transmittance_max, spec.transmittance_min)
    if spec.family == "thin_film":
        return ThinFilms(BANDS_NM, spec.layers, spec.transmittance_max, spec.transmittance_min)
    return FreeCurves(BANDS_NM, spec.transmittance_min, spec.transmittance_max)
