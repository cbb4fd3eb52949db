"""Design of filters by gradients: from a file to a sensor file, judged by full simulation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device_types import Float64
from hesim_render.core.errors import SpecError, did_you_mean
from hesim_render.core.tables import table
from hesim_render.sensor import lens as optics
from hesim_render.sensor.sensor import Sensor, load_sensor
from hesim_render.specs.design import DesignSpec
from hesim_render.specs.filter_set import FilterSetSpec, PaletteSpec, read_filter_set, read_palette
from hesim_render.specs.spectrum import SpectrumSpec
from hesim_render.studies.colour_noise import channel_noise
from hesim_render.studies.design_cost import Condition, DesignCost, Weights
from hesim_render.studies.design_filters import Dyes, Family, FreeCurves, ThinFilms
from hesim_render.studies.filter_sets import filters_of, with_filter_set
from hesim_render.studies.surfaces import reflectances_of

#: Bands of all spectra of a design, nm.
BANDS_NM = np.arange(360.0, 831.0, 5.0)
#: Weight of the mean squared excess of a slope, in units of the largest slope.
_SLOPE_WEIGHT = 1000.0


@dataclass(frozen=True, eq=False)
class DesignResult:
    """Filters found by a design.

    Parameters
    ----------
    filters : transmittance at `BANDS_NM` of each varied filter.
    cost : of the best start.
    costs : of each start, before and after, [start, 2].
    evaluations : of the cost and its gradient, in all.
    """

    filters: dict[str, NDArray[np.float64]]
    cost: float
    costs: NDArray[np.float64]
    evaluations: int


class Problem:
    """Parameters, constraints and cost of a design.

    Parameters
    ----------
    spec : the design.

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
        frames, events = filters_of(sensor, "aps"), filters_of(sensor, "evs")
        reflectances = list(reflectances_of(spec.fit.surfaces()).values())
        conditions = [Condition.of(reflectances, each.spectrum.load(), BANDS_NM) for each in spec.fit.illuminants]
        aps, evs = sensor.spec.aps, sensor.spec.evs
        assert aps is not None
        exposure_us = float(spec.exposure_us or aps.exposure_us)
        scale, window_us = (0.0, 0.0), 1.0
        if evs is not None:
            table = sensor.evs.table
            scale = float(np.expm1(evs.contrast_threshold_on)), float(np.mean(table.base / table.slope))
            window_us = float(evs.window_us)
        return DesignCost(
            sensor, BANDS_NM, conditions, spec.illuminance_lux, exposure_us,
            channel_noise(sensor, frames, exposure_us, spec.area_px), [self.names.index(name) for name in frames],
            [self.names.index(name) for name in events], scale, window_us,
            Weights(spec.cost.colour, spec.cost.noise, spec.cost.events),
        )  # fmt: skip

    def transmittances(self, parameters: Float64) -> dict[str, Float64]:
        """Transmittance of each varied filter from all parameters, each 0 to 1 between its bounds."""
        import drjit as dr

        types = jit()
        bounds = self.family.bounds()
        found = {}
        for number, name in enumerate(self.vary):
            own = []
            for k, (low, high) in enumerate(bounds):
                share = dr.gather(types.Float64, parameters, types.UInt32(number * len(bounds) + k))
                own.append(low + (high - low) * share)
            found[name] = self.family.transmittance(own)
        return found

    def __call__(self, parameters: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """Cost and gradient with respect to parameters between 0 and 1."""
        import drjit as dr

        types = jit()
        given = table(types.Float64, parameters)
        dr.enable_grad(given)
        filters = self.transmittances(given)
        light = table(types.Float64, self.open_response)
        responses = [
            filters[name] * light if name in filters else table(types.Float64, self.start_transmittance[name]) * light
            for name in self.names
        ]
        total = self.cost(responses)
        for each in filters.values():
            total += self._steepness(each) / len(filters)
        dr.backward(total)
        return float(total[0]), np.array(dr.grad(given), dtype=np.float64)

    def _steepness(self, transmittance: Float64) -> Float64:
        """Penalty of slopes above the largest one."""
        import drjit as dr

        types = jit()
        place = dr.arange(types.UInt32, BANDS_NM.size - 1)
        step = float(BANDS_NM[1] - BANDS_NM[0]) * self.spec.slope_max_per_nm
        change = dr.gather(types.Float64, transmittance, place + 1) - dr.gather(types.Float64, transmittance, place)
        return _SLOPE_WEIGHT * dr.mean(dr.square(dr.maximum(dr.abs(change) / step - 1, 0)))

    def starts(self) -> list[NDArray[np.float64]]:
        """Parameters to start from, each 0 to 1."""
        rng = np.random.default_rng(self.spec.seed)
        low, high = np.array(self.family.bounds()).T
        found = []
        for _ in range(self.spec.starts):
            own = [(self.family.start(self.start_transmittance[name], rng) - low) / (high - low) for name in self.vary]
            found.append(np.clip(np.concatenate(own), 0, 1))
        return found


def optimise(problem: Problem, told: Callable[[float, float, str], None] | None = None) -> DesignResult:
    """The filters with the least cost over several starts, by L-BFGS-B [byrd1995] within bounds.

    Parameters
    ----------
    problem : the design.
    told : called with (done, total, what).

    Returns
    -------
    The best filters.
    """
    from scipy.optimize import minimize

    spec = problem.spec
    best, costs, evaluations = None, [], 0
    for number, start in enumerate(problem.starts()):
        if told is not None:
            told(number, spec.starts, f"start {number + 1} of {spec.starts}")
        found = minimize(
            problem, start, jac=True, method="L-BFGS-B", bounds=[(0.0, 1.0)] * start.size,
            options={"maxiter": spec.steps, "maxfun": 4 * spec.steps, "ftol": 1e-10, "gtol": 1e-8},
        )  # fmt: skip
        costs.append([problem(start)[0], float(found.fun)])
        evaluations += int(found.nfev) + 1
        if best is None or found.fun < best.fun:
            best = found
    assert best is not None
    curves = problem.transmittances(jit().Float64(np.ascontiguousarray(best.x)))
    filters = {name: np.clip(np.array(each, dtype=np.float64), 0.0, 1.0) for name, each in curves.items()}
    return DesignResult(filters, float(best.fun), np.array(costs), evaluations)


def designed_palette(problem: Problem, result: DesignResult) -> dict[str, object]:
    """The content of a palette file with the filters of a result, in place of those of the palette."""
    palette = problem.palette.model_dump(mode="json", exclude_none=True)
    filters = {}
    for name in problem.names:
        values = result.filters.get(name, problem.start_transmittance[name])
        filters[name] = {"wavelength_nm": BANDS_NM.tolist(), "value": np.round(values, 6).tolist()}
    return {
        **palette, "name": problem.spec.name, "filters": filters, "sources": {},
        "description": f"{', '.join(problem.vary)} designed as {problem.spec.family}; start {problem.palette.name}",
        "assumptions": {"filters": "designed by gradients; no filter of these curves has been made"},
    }  # fmt: skip


def designed_sensor(problem: Problem, palette: PaletteSpec) -> Sensor:
    """The sensor with the filters of a result."""
    return with_filter_set(problem.base, problem.filter_set, palette)


def _family(spec: DesignSpec) -> Family:
    if spec.family == "dye":
        return Dyes(BANDS_NM, spec.bands, spec.transmittance_max)
    if spec.family == "thin_film":
        return ThinFilms(BANDS_NM, spec.layers, spec.transmittance_max)
    return FreeCurves(BANDS_NM, spec.transmittance_min, spec.transmittance_max)
