"""Design of filters: families against other programs, cost and gradients against central differences on float64."""

import itertools
import json
from dataclasses import replace
from types import SimpleNamespace

import drjit as dr
import numpy as np
import pytest
from scipy.optimize import minimize

import hesim_render as hr
from hesim_render import cli
from hesim_render.core.backend import jit
from hesim_render.core.errors import SpecError
from hesim_render.core.host_arrays import from_host
from hesim_render.specs.design import CostSpec, DesignSpec
from hesim_render.specs.files import list_names, read_spec
from hesim_render.specs.filter_set import read_filter_set
from hesim_render.specs.run import StudyKind, study_kind
from hesim_render.spectral import spectrum as spectra
from hesim_render.spectral.colorimetry import delta_e_2000, lab
from hesim_render.spectral.physical import dye_transmittance, silicon_index, thin_film_transmittance
from hesim_render.studies import ChannelNoise, Table, reflectance_set
from hesim_render.studies.colour_samples import colour_samples
from hesim_render.studies.design import BANDS_NM as DESIGN_NM
from hesim_render.studies.design import Problem, optimise, silicon_depth
from hesim_render.studies.design_cost import Condition, DesignCost, best_matrix, difference_weights
from hesim_render.studies.design_filters import Dyes, FreeCurves, ThinFilms
from hesim_render.studies.design_run import CHART_PX, _judgement, _verdicts, design, designed_set
from hesim_render.studies.design_tile import counts_of, spread_tile
from hesim_render.studies.verdict import design_verdict

BANDS = np.arange(360.0, 831.0, 10.0)
FAMILIES = {"dye": Dyes(BANDS, 2, 0.95), "film": ThinFilms(BANDS, 5, 0.97), "free": FreeCurves(BANDS, 0.01, 0.95)}


def numbers(values):
    return [jit().Float64(float(value)) for value in values]


def drawn(family, seed=1):
    low, high = np.array(family.bounds()).T
    return np.random.default_rng(seed).uniform(low + 0.1 * (high - low), high - 0.1 * (high - low))


def test_families_are_the_filters_that_files_name():
    values = drawn(FAMILIES["dye"])
    expected = 0.95 * dye_transmittance(values.reshape(2, 3), grid_nm=BANDS).values
    np.testing.assert_allclose(FAMILIES["dye"].transmittance(numbers(values)).numpy(), expected, rtol=2e-5, atol=1e-7)
    values = drawn(FAMILIES["film"])
    indices = [2.35 if k % 2 == 0 else 1.46 for k in range(5)]
    expected = 0.97 * thin_film_transmittance(indices, values, 1.52, 1.52, grid_nm=BANDS).values
    np.testing.assert_allclose(FAMILIES["film"].transmittance(numbers(values)).numpy(), expected, rtol=2e-5)
    # what passes a filter where it is darkest
    for family, bare in ((Dyes(BANDS, 2, 0.95, 0.05), FAMILIES["dye"]),
                         (ThinFilms(BANDS, 5, 0.97, 0.05), FAMILIES["film"])):  # fmt: skip
        values = drawn(bare)
        share = bare.transmittance(numbers(values)).numpy() / bare.most
        expected = 0.05 + (bare.most - 0.05) * share
        np.testing.assert_allclose(family.transmittance(numbers(values)).numpy(), expected, rtol=1e-6)
    values = drawn(FAMILIES["free"])
    expected = np.interp(BANDS, FAMILIES["free"].knots_nm, values)
    np.testing.assert_allclose(FAMILIES["free"].transmittance(numbers(values)).numpy(), expected, rtol=1e-5)


@pytest.mark.parametrize("family", FAMILIES.values(), ids=FAMILIES)
def test_starts_lie_within_bounds_and_near_what_is_wanted(family):
    wanted = np.where(BANDS > 580, 0.9, 0.05)
    low, high = np.array(family.bounds()).T
    for seed in range(5):
        values = family.start(wanted, np.random.default_rng(seed))
        assert np.all(values >= low) and np.all(values <= high)


def test_weights_are_the_derivative_of_colour_differences():
    """Against ΔE2000 of small changes: its rotation term and its stretch of a* are left out, so 15 % (greys: 50 %)."""
    patches = list(reflectance_set("colorchecker").values())
    d65 = spectra.illuminant("D65")
    samples = colour_samples([d65], d65, patches)
    weights = difference_weights(samples.xyz, samples.white_xyz)
    rng = np.random.default_rng(2)
    ratios = []
    for _ in range(20):
        change = 1e-4 * rng.normal(size=samples.xyz.shape) * samples.xyz
        exact = delta_e_2000(lab(samples.xyz + change, samples.white_xyz), lab(samples.xyz, samples.white_xyz))
        ratios.append(np.linalg.norm(np.einsum("sij,sj->si", weights, change), axis=1) / exact)
    ratios = np.array(ratios)
    assert abs(np.median(ratios[:, :18]) - 1) < 0.15 and np.all((ratios > 0.5) & (ratios < 2))
    # without the weights of ΔE2000 it is ΔE*ab: of a pure change of lightness both are dL/S_L
    lighter = 1e-5 * samples.xyz[20:21]
    step = np.linalg.norm(weights[20] @ lighter[0])
    exact = delta_e_2000(
        lab(samples.xyz[20:21] + lighter, samples.white_xyz), lab(samples.xyz[20:21], samples.white_xyz)
    )
    assert step == pytest.approx(float(exact[0]), rel=0.02)


def test_the_best_matrix_is_that_of_a_general_minimiser():
    rng = np.random.default_rng(3)
    electrons, xyz = rng.uniform(10, 100, (12, 4)), rng.uniform(0.1, 1, (12, 3))
    weights, variance = rng.normal(size=(12, 3, 3)), rng.uniform(5, 30, (12, 4))

    def cost(values):
        matrix = values.reshape(3, 4) / 50
        off = np.einsum("sij,sj->si", weights, electrons @ matrix.T - xyz)
        gain = np.sum(np.einsum("sij,jc->sic", weights, matrix) ** 2, axis=1)
        return np.sum(off**2) + np.sum(gain * variance)

    found = minimize(cost, np.zeros(12), method="BFGS", options={"gtol": 1e-9})
    np.testing.assert_allclose(best_matrix(electrons, variance, xyz, weights) * 50, found.x.reshape(3, 4), atol=1e-4)


def cost_of(weights, events=True):
    sensor = hr.load_sensor("eiger").crop(8, 8)
    patches = list(reflectance_set("colorchecker").values())
    conditions = [Condition.of(patches, spectra.illuminant(name), BANDS) for name in ("D65", "A")]
    noise = ChannelNoise(np.array([30.0, 25.0, 30.0]), np.ones(3), np.array([1e-5] * 3), np.array([1.0, 2.0, 1.0]))
    return DesignCost(
        sensor, BANDS, conditions, (20.0, 1000.0), 10_000.0, noise, (0, 1, 2), (1,) if events else (),
        (0.22, 12.0), 1000.0, CostSpec(**dict(zip(("colour", "noise", "events"), weights, strict=True))),
    )  # fmt: skip


def test_the_cost_is_that_of_its_formula():
    """All written out again in NumPy, with the matrix of a least-squares solver."""
    rng = np.random.default_rng(5)
    curves = np.exp(-(((BANDS - np.array([[600], [540], [460]])) / 50) ** 2)) * 1e7 * rng.uniform(0.8, 1.2, (3, 1))
    for weights in ((1, 0, 0), (0, 1, 0), (0, 0, 1), (0.3, 0.5, 0.2)):
        cost = cost_of(weights)
        found = float(cost([from_host(jit().Float64, curve) for curve in curves])[0])
        assert found == pytest.approx(reference(cost, curves), rel=2e-4)


def reference(cost, curves, bands=BANDS):
    """The cost on float64."""
    total, lights, levels = 0.0, len(cost.conditions), len(cost.illuminance_lux)
    for condition in cost.conditions:
        electrons = np.stack([
            hr.photocurrent(condition.radiance, bands, cost.sensor, cost.exposure_us,
                            filter=cost.sensor.layout.filters[0], responses=curve)
            for curve in curves
        ], axis=1)  # fmt: skip
        patches, grey = electrons[:-1], electrons[-1]

        def root(c, noisy, condition=condition):
            variance = cost.noise.variance_e2(c) if noisy else np.full_like(c, 1e-3)
            rows, wanted = [], []
            for s in range(len(c)):
                rows.append(np.einsum("ij,c->ijc", condition.weights[s], c[s]).reshape(3, -1))
                wanted.append(condition.weights[s] @ condition.xyz[s])
                for k in range(c.shape[1]):
                    part = np.zeros((3, 3, c.shape[1]))
                    part[:, :, k] = condition.weights[s] * np.sqrt(variance[s, k])
                    rows.append(part.reshape(3, -1))
                    wanted.append(np.zeros(3))
            a, b = np.concatenate(rows), np.concatenate(wanted)
            size = np.linalg.norm(a, axis=0)
            solution = np.linalg.lstsq(a / size, b, rcond=None)[0] / size
            return np.sqrt(np.sum((a @ solution - b) ** 2) / len(c))

        if cost.weights.colour:
            total += cost.weights.colour * root(patches * 1e4 / patches.mean(axis=0).max(), False) / lights
        for lux in cost.illuminance_lux:
            total += cost.weights.noise * root(patches * lux, True) / lights / levels
            if cost.events:
                window = grey[list(cost.events)] * lux * cost.event_window_us / cost.exposure_us
                total += cost.weights.events * np.mean(0.22 * (1 + 12.0 / window)) / lights / levels
    return total


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES.values(), ids=FAMILIES)
def test_gradients_of_the_cost_are_central_differences(family):
    """Through filters, Eq. 1 and the best matrix: 1e-3 of the gradient's norm, on a float64 copy of everything."""
    cost = cost_of((0.3, 0.5, 0.2))
    values = [drawn(family, seed) for seed in (11, 12, 13)]
    scale = 1e7 * np.exp(-(((BANDS - 560) / 140) ** 2))

    def on_host(parameters):
        curves = []
        for own in parameters:
            if isinstance(family, Dyes):
                filters = 0.95 * dye_transmittance(own.reshape(-1, 3), grid_nm=BANDS).values
            elif isinstance(family, ThinFilms):
                filters = (
                    0.97
                    * thin_film_transmittance([2.35, 1.46, 2.35, 1.46, 2.35], own, 1.52, 1.52, grid_nm=BANDS).values
                )
            else:
                filters = np.interp(BANDS, family.knots_nm, own)
            curves.append(filters * scale)
        return reference(cost, curves)

    tensors = [numbers(own) for own in values]
    for own in tensors:
        dr.enable_grad(own)
    curves = [family.transmittance(own) * from_host(jit().Float64, scale) for own in tensors]
    dr.backward(cost(curves))
    found = np.array([float(dr.grad(value)[0]) for own in tensors for value in own])
    expected = np.empty_like(found)
    flat = np.concatenate(values)
    for k in range(flat.size):
        step = np.zeros(flat.size)
        step[k] = 1e-4 * max(abs(flat[k]), 0.1)
        ends = [on_host(np.split(flat + sign * step, 3)) for sign in (1, -1)]
        expected[k] = (ends[0] - ends[1]) / (2 * step[k])
    # parameters differ in unit: each is weighed by its range
    low, high = np.array(family.bounds() * 3).T
    assert np.linalg.norm((found - expected) * (high - low)) < 1e-3 * np.linalg.norm(expected * (high - low))


def test_gradients_of_shares_and_depth_are_central_differences():
    """Every parameter of a problem: filters, depth of the silicon and tile shares, against a float64 copy of it all."""
    problem = Problem(DesignSpec.model_validate({
        **SMALL, "family": "free", "tile_px": [4, 4], "silicon_depth_um": [1.0, 6.0], "slope_max_per_nm": 1.0,
    }))  # fmt: skip
    count = problem.filter_size
    parameters = np.random.default_rng(8).uniform(0.2, 0.8, count + 4)
    _, found = problem(parameters)
    n, k = silicon_index()
    alpha = 4 * np.pi * np.exp(np.interp(DESIGN_NM, k.wavelength_nm, np.log(k.values))) / DESIGN_NM * 1e3
    assert n.at(500) > 4
    open_response = problem.open_response / -np.expm1(-alpha * 3.0)
    noise, cost = problem.cost.noise, problem.cost

    def on_host(values):
        own = values[:count].reshape(3, -1)
        filters = [np.interp(DESIGN_NM, problem.family.knots_nm, 0.95 * row) for row in own]
        light = open_response * -np.expm1(-alpha * (1 + 5 * values[count]))
        weights = values[count + 1 :] + 1e-3
        shares = 0.05 + 0.85 * weights / weights.sum()
        assert shares.sum() == pytest.approx(1)
        counted = replace(cost, noise=replace(noise, count=4 * shares))
        return reference(counted, [each * light for each in filters], DESIGN_NM)

    expected = np.empty_like(found)
    for number in range(parameters.size):
        step = np.zeros(parameters.size)
        step[number] = 1e-4
        expected[number] = (on_host(parameters + step) - on_host(parameters - step)) / 2e-4
    assert np.linalg.norm(found - expected) < 1e-3 * np.linalg.norm(expected)
    # each group on its own: the filters do not hide the others
    for part in (np.s_[:count], np.s_[count : count + 1], np.s_[count + 1 :]):
        assert np.linalg.norm((found - expected)[part]) < 3e-3 * np.linalg.norm(expected[part])
        assert np.abs(expected[part]).max() > 1e-3 * np.abs(expected).max()


def test_shares_begin_with_those_of_the_tile():
    """The cost of a hybrid tile is the same, whether its shares are varied or not; event pixels have none."""
    hybrid = {**SMALL, "sensor": "eiger", "filter_set": "quad-bayer-white-event", "palette": "dyes"}
    fixed, varied = (Problem(DesignSpec.model_validate({**hybrid, **more})) for more in ({}, {"tile_px": [4, 4]}))
    start = varied.starts()[0]
    assert start.size == varied.filter_size + 3
    assert varied(start)[0] == pytest.approx(fixed(start[: fixed.filter_size])[0], rel=1e-3)


def test_shares_become_whole_pixels_that_lie_apart():
    assert counts_of(np.array([0.5, 0.25, 0.25]), 16).tolist() == [8, 4, 4]
    assert counts_of(np.array([0.97, 0.01, 0.02]), 16).sum() == 16
    assert counts_of(np.array([0.97, 0.01, 0.02]), 16).tolist() == [14, 1, 1]
    assert counts_of(np.array([0.334, 0.284, 0.331, 0.051]), 16).tolist() == [5, 5, 5, 1]
    assert counts_of(np.array([0.41, 0.30, 0.29]), 4).tolist() == [2, 1, 1]
    every = np.ones((4, 4), bool)
    tile = spread_tile(np.full((4, 4), "x"), every, {"G": 8, "R": 4, "B": 4})
    assert {name: int((tile == name).sum()) for name in "RGB"} == {"R": 4, "G": 8, "B": 4}
    # half of the pixels on a chessboard, as Bayer has them
    row, col = np.nonzero(tile == "G")
    assert len(set((row + col) % 2)) == 1
    # other pixels stay where they are
    letters = np.full((4, 4), "x")
    letters[1, 2] = "w"
    held = spread_tile(letters, letters != "w", {"R": 5, "G": 5, "B": 5})
    assert held[1, 2] == "w" and "x" not in held


def test_no_exchange_of_two_pixels_spreads_a_tile_more():
    """Of a tile of 3 × 5 px with two that stay: repulsion of equal letters over 25 repetitions, pair by pair."""
    letters = np.full((3, 5), "x")
    letters[0, 3], letters[2, 1] = "w", "v"
    free = [(i, j) for i, j in np.ndindex(3, 5) if letters[i, j] == "x"]
    tile = spread_tile(letters, letters == "x", {"R": 4, "G": 6, "B": 3})
    assert tile[0, 3] == "w" and tile[2, 1] == "v" and (tile == "G").sum() == 6

    def energy(given):
        total = 0.0
        for a in free:
            for b in free:
                if a != b and given[a] == given[b]:
                    for i in range(-2, 3):
                        for j in range(-2, 3):
                            square = (a[0] - b[0] + 3 * i) ** 2 + (a[1] - b[1] + 5 * j) ** 2
                            total += np.exp(-square / (2 * 1.2**2))
        return total

    least = energy(tile)
    for a, b in itertools.combinations(free, 2):
        other = tile.copy()
        other[a], other[b] = tile[b], tile[a]
        assert energy(other) > least - 1e-3  # what lies farther than one repetition is not counted there


@pytest.mark.slow
def test_a_design_of_shares_ends_in_a_tile_of_its_own(tmp_path):
    """Noise alone: the share of a filter follows from its electrons and its part in the matrix."""
    spec = {**SMALL, "tile_px": [4, 4], "silicon_depth_um": [2.0, 4.0], "steps": 8, "demosaic": False,
            "illuminance_lux": [20], "cost": {"colour": 0.2, "noise": 1.0}, "repeats": 2, "compare": []}  # fmt: skip
    found = design(spec, out=tmp_path / "out")
    result = found.result
    assert sum(result.shares.values()) == pytest.approx(1) and min(result.shares.values()) >= 0.05
    assert 2 <= result.silicon_depth_um <= 4 and result.silicon_depth_um != 3
    sensor = hr.load_sensor(tmp_path / "out" / "sensor.yaml")
    assert sensor.layout.tile_shape == (4, 4)
    shares = counts_of(np.array(list(result.shares.values())), 16)
    tile = [sensor.spec.pixels[letter].filter for letter in "".join(sensor.spec.tile_rows)]
    assert [tile.count(name) for name in result.shares] == shares.tolist()
    assert silicon_depth(sensor.spec.quantum_efficiency) == pytest.approx(result.silicon_depth_um, abs=1e-4)
    assert [verdict["against"] for verdict in found.verdicts] == ["start"]
    stored = json.loads((tmp_path / "out" / "design.json").read_text())
    assert stored["shares"] == result.shares
    # the set can be studied again
    assert read_filter_set(tmp_path / "out" / "filter_set.yaml").tile == sensor.spec.tile


def test_the_best_shares_are_those_of_a_closed_form():
    """Fixed filters: J = Σ_c a_c/s_c is least at s_c ∝ √a_c if the matrix does not change, as at many electrons."""
    free = {**SMALL, "family": "free", "tile_px": [4, 4], "illuminance_lux": [3000], "share_min": 0.01,
            "cost": {"colour": 0, "noise": 1}, "vary": ["blue"]}  # fmt: skip
    problem = Problem(DesignSpec.model_validate(free))
    start = problem.starts()[0]
    size = problem.filter_size

    def cost(shares):
        weights = (np.array(shares) - 0.01) / 0.97
        return problem(np.concatenate([start[:size], weights]))[0] ** 2

    even = np.full(3, 1 / 3)
    # the part of each channel in J, from changes of its share alone would need shares that do not sum to 1: three pairs
    points = [even, [0.5, 0.25, 0.25], [0.25, 0.5, 0.25], [0.25, 0.25, 0.5]]
    table = np.array([[1.0, *(1 / np.array(point))] for point in points])
    _, *parts = np.linalg.solve(table, [cost(point) for point in points])
    expected = np.sqrt(parts) / np.sqrt(parts).sum()
    found = minimize(lambda values: cost([*values, 1 - values.sum()]), even[:2], method="Nelder-Mead",
                     options={"xatol": 1e-4, "maxfev": 80})  # fmt: skip
    np.testing.assert_allclose([*found.x, 1 - found.x.sum()], expected, atol=0.02)


SMALL = {
    "schema_version": 1, "name": "small", "sensor": "reference-bayer", "filter_set": "rggb",
    "palette": "nikon-5100-silicon", "family": "dye", "bands": 3, "starts": 1, "steps": 40,
    "fit": {"reflectances": "colorchecker", "illuminants": ["D65"]},
    "judge": {"reflectances": "cie-tcs", "illuminants": ["A"]}, "repeats": 4, "demosaic": False,
    "compare": [{"set": "rggb", "palette": "nikon-5100-silicon", "name": "Nikon"}],
}  # fmt: skip


@pytest.mark.parametrize("family", [
    "dye", pytest.param("thin_film", marks=pytest.mark.slow), pytest.param("free", marks=pytest.mark.slow),
])  # fmt: skip
def test_every_family_lowers_the_cost_within_its_constraints(family):
    spec = DesignSpec.model_validate({**SMALL, "family": family, "slope_max_per_nm": 0.02, "transmittance_min": 0.02})
    problem = Problem(spec)
    result = optimise(problem)
    before, after = result.costs[0]
    assert after < 0.8 * before
    for curve in result.filters.values():
        assert curve.min() >= 0.02 - 1e-9 and curve.max() <= 0.95 + 1e-6
        # the penalty is soft: a tenth above at most
        assert np.abs(np.diff(curve)).max() / 5 < 0.022 if family != "thin_film" else True


def test_slopes_above_the_largest_cost_their_square():
    """Of 94 steps of 5 nm, 20 rise 1.5 times as fast as allowed and 7 fall 3 times as fast; others are as allowed."""
    problem = Problem.__new__(Problem)
    problem.spec = SimpleNamespace(slope_max_per_nm=0.002)
    assert DESIGN_NM.size == 95 and np.all(np.diff(DESIGN_NM) == 5)
    slopes = np.zeros(94)
    slopes[3:23], slopes[40:47], slopes[60:75] = 0.003, -0.006, 0.00199
    curve = 0.3 + np.append(0, np.cumsum(5 * slopes))
    found = problem._steepness(from_host(jit().Float64, curve))[0]
    assert found == pytest.approx(1000 * (20 * 0.5**2 + 7 * 2.0**2) / 94, rel=1e-9)


def test_a_design_starts_with_its_depth_and_shares_as_parts_of_their_ranges():
    """Depth 1.6 of 1 to 3.5 µm. Shares above the least one, 0.1, over the largest of them: 8, 5 and 3 of 16 pixels."""
    problem = Problem.__new__(Problem)
    problem.spec = SimpleNamespace(silicon_depth_um=(1.0, 3.5), tile_px=(4, 4), share_min=0.1)
    problem._start_depth_um, problem.frames = 1.6, ["g", "r", "b"]
    problem.tile = lambda rows, cols: (np.array(list("GGGGGGGGRRRRRBBB")).reshape(4, 4), np.ones((4, 4), bool))
    problem.filter_set = SimpleNamespace(pixels={name.upper(): SimpleNamespace(filter=name) for name in "grb"})
    depth, shares = problem._other_starts()
    np.testing.assert_allclose(depth, [0.6 / 2.5])
    np.testing.assert_allclose(shares, np.array([0.4, 5 / 16 - 0.1, 3 / 16 - 0.1]) / 0.4)


def test_fresh_parameters_compile_nothing():
    """Numbers that change from step to step are data of the kernels, not parts of their code."""
    problem = Problem(DesignSpec.model_validate(SMALL))
    start = problem.starts()[0]
    rng = np.random.default_rng(3)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for number in range(3):
            dr.kernel_history_clear()
            problem(np.clip(start + 0.05 * rng.normal(size=start.size), 0, 1))
            new = [entry for entry in dr.kernel_history() if not entry.get("cache_hit", True)]
            assert number == 0 or not new


@pytest.mark.parametrize("steps", (5, pytest.param(100, marks=pytest.mark.slow)))
def test_a_design_is_a_sensor_file_and_a_verdict(tmp_path, capsys, steps):
    """Three dyes against a camera, on colours and a light that they were not fitted to; few steps do not win yet."""
    file = tmp_path / "small.yaml"
    file.write_text(json.dumps({**SMALL, "starts": 2 if steps > 5 else 1, "steps": steps, "demosaic": steps > 5}))
    with pytest.raises(SystemExit) as stop:
        cli.main(["study", str(file), "--out", str(tmp_path / "out")])
    assert stop.value.code == 0, capsys.readouterr().err
    told = capsys.readouterr().out
    found = json.loads((tmp_path / "out" / "design.json").read_text())
    verdict = found["verdicts"][0]
    assert " ".join(design_verdict(verdict)) in " ".join(told.split("\n")) and "Nikon" in told
    assert verdict["cost_difference_low"] < verdict["cost_difference"] < verdict["cost_difference_high"]
    if steps > 5:
        assert verdict["cost_difference_high"] < 0 and verdict["delta_e_mean"] < verdict["delta_e_mean_against"]
        assert "mtf50_cy_per_px" in verdict and verdict["zone_plate_colour"] > 0
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count("<h2>Verdict</h2>") == 1 and "<h2>Verdict for each light</h2>" in page
    assert f"<p>{' '.join(design_verdict(verdict))}</p>" in page
    sensor = hr.load_sensor(tmp_path / "out" / "sensor.yaml")
    assert sensor.spec.tile == "RG\nGB" and list(sensor.spec.filters) == ["red", "green", "blue"]
    # the figures of the file are those of the judgement
    table = hr.study({**STUDY, "sensors": [str(tmp_path / "out" / "sensor.yaml")]})
    own = (tmp_path / "out" / "results.csv").read_text().splitlines()
    column = own[0].split(",").index("delta_e_mean")
    assert table["delta_e_mean"][0] == pytest.approx(float(own[1].split(",")[column]), rel=1e-6)


def test_a_verdict_says_what_got_better_and_worse():
    """One per cent is no difference; a cost whose interval holds 0 is as good; saturation is named."""
    verdict = {
        "against": "bayer", "cost": 1.2, "cost_against": 1.5, "cost_difference": -0.3, "cost_difference_low": -0.4,
        "cost_difference_high": -0.2, "delta_e_mean": 2.31, "delta_e_mean_against": 2.1, "clipped_lux": [200.0, 1000.0],
        "ysnr_noise_aware_ratio_5_lux": 1.12, "ysnr_noise_aware_ratio_80_lux": 0.995, "ysnr_ratio_5_lux": 0.93,
        "mtf50_cy_per_px": 0.31, "mtf50_cy_per_px_against": 0.28, "false_colour": 4.0, "false_colour_against": 5.0,
    }  # fmt: skip
    assert design_verdict(verdict) == [
        "The designed set has a lower cost than bayer (1.2 and 1.5, difference -0.4 to -0.2).",
        "Better: noise-aware YSNR at 5 lx 1.12 times, MTF50, cy/px 0.31 against 0.28, false colour, C*ab 4 against 5.",
        "Worse: YSNR with the matrix of colour at 5 lx 0.93 times, mean ΔE2000 without noise 2.31 against 2.1.",
        "White saturates at 200, 1000 lx: take a shorter exposure.",
    ]
    same = verdict | {"cost_difference_high": 0.1, "clipped_lux": []}
    assert design_verdict(same)[0].startswith("The designed set is as good as bayer") and len(design_verdict(same)) == 3
    assert "a higher cost than" in design_verdict(same | {"cost_difference_low": 0.05})[0]


@pytest.mark.slow
def test_the_shipped_design_beats_the_camera_on_colours_and_lights_that_it_has_not_seen(tmp_path):
    """Weights, levels and both sets of colours are those of the shipped file; 95 reflectances under three lights."""
    spec = read_spec(DesignSpec, "rggb-dyes", "studies")
    assert spec.fit.reflectances != spec.judge.reflectances
    assert not {light.name for light in spec.fit.illuminants} & {light.name for light in spec.judge.illuminants}
    (verdict,) = design(spec, out=tmp_path / "out").verdicts
    assert verdict["against"] == "Nikon 5100"
    ratios = [verdict["ysnr_ratio_20_lux"], verdict["ysnr_ratio_1000_lux"]]
    better_colour = verdict["delta_e_mean"] < verdict["delta_e_mean_against"]
    assert (better_colour and min(ratios) > 0.95) or (
        min(ratios) > 1 and verdict["delta_e_mean"] < 1.05 * verdict["delta_e_mean_against"]
    )
    assert verdict["cost_difference_low"] < verdict["cost_difference"] < verdict["cost_difference_high"] < 0


STUDY = {"schema_version": 1, "name": "again", "surfaces": ["cie-tcs"], "illuminants": ["A"], "figures": ["colour"]}


def test_events_count_only_against_sets_that_have_event_pixels():
    spec = DesignSpec.model_validate({**SMALL, "illuminance_lux": [20], "cost": {"events": 2.0, "colour": 1.7}})
    row = {"illuminance_lux": 20, "delta_e_mean": 1.3, "ysnr_simulated": 5.0, "ysnr_noise_aware_simulated": 6.0,
           "delta_e_noisy_noise_aware_simulated": 3.0, "delta_e_noisy_noise_aware_low": 2.9,
           "delta_e_noisy_noise_aware_high": 3.1}  # fmt: skip
    table = Table([
        {**row, "filter_set": "designed", "event_contrast_on": 0.3, "mtf50_cy_per_px": 0.41},
        {**row, "filter_set": "with", "event_contrast_on": 0.5, "ysnr_simulated": 4.0,
         "ysnr_noise_aware_simulated": 7.5, "mtf50_cy_per_px": 0.57},
        {**row, "filter_set": "without", "mtf50_cy_per_px": 0.63},
    ])  # fmt: skip
    both, frames_alone = _verdicts(spec, table)
    assert both["ysnr_noise_aware_ratio_20_lux"] == pytest.approx(6.0 / 7.5)
    assert both["ysnr_ratio_20_lux"] == pytest.approx(5.0 / 4.0)
    assert both["cost"] == pytest.approx(1.7 * 1.3 + 0.5 * 3 + 2 * 0.3) and both["cost_difference"] == pytest.approx(
        -0.4
    )
    assert frames_alone["cost"] == frames_alone["cost_against"] == pytest.approx(1.7 * 1.3 + 1.5)
    assert (both["mtf50_cy_per_px"], both["mtf50_cy_per_px_against"]) == (0.41, 0.57)
    half = 0.5 * 0.1 * np.sqrt(2)
    assert both["cost_difference_high"] - both["cost_difference_low"] == pytest.approx(2 * half)


@pytest.mark.parametrize(("rows", "cols", "fits"), [(0, 0, True), (-1, 9, False), (7, -1, False)])
def test_a_design_is_judged_on_the_chart_where_the_sensor_holds_it(tmp_path, rows, cols, fits):
    """By the pixels that it has more or fewer than the chart; not at all where the design says so."""
    geometry = SimpleNamespace(rows=CHART_PX[0] + rows, cols=CHART_PX[1] + cols)
    problem = SimpleNamespace(sensor=SimpleNamespace(spec=SimpleNamespace(geometry=geometry)))
    spec = DesignSpec.model_validate({**SMALL, "demosaic": True, "exposure_us": 1234, "repeats": 5})
    judged = _judgement(spec, problem, tmp_path)
    assert judged.figures == ["colour", "noise", "events", *(["demosaic"] if fits else [])]
    assert (
        judged.exposures_us == [1234] and judged.noise.repeats == 5 and judged.illuminance_lux == spec.illuminance_lux
    )
    assert [use.name for use in judged.filter_sets] == ["designed", "Nikon"]
    assert "demosaic" not in _judgement(DesignSpec.model_validate(SMALL), problem, tmp_path).figures


@pytest.mark.parametrize(("changes", "message"), [
    ({"vary": ["read"]}, "vary: no filter 'read'.*did you mean 'red'"),
    ({"cost": {"colour": 0, "noise": 0}}, "at least one weight"),
    ({"transmittance_min": 0.97}, "must be below transmittance_max"),
    ({"family": "glass"}, "family"),
    ({"tile_px": [3, 4]}, r"a tile of 3x4 px is no multiple of the 2x2 px of 'rggb'"),
    ({"tile_px": [4, 4], "share_min": 0.4}, "no shares of 3 filters"),
    ({"silicon_depth_um": [4, 2]}, "least and the largest depth"),
    ({"palette": "dyes", "sensor": "eiger", "filter_set": "quad-bayer-white-event", "tile_px": [8, 8]},
     "numbers its event pixels by its tile of 4x4 px"),
    ({"filter_set": "cygm"}, "the palette 'nikon-5100-silicon' has no filter 'cyan'"),
    ({"fit": {"reflectances": "none", "illuminants": ["D65"]}}, "no set of reflectances named 'none'"),
])  # fmt: skip
def test_bad_designs_are_one_clear_line(tmp_path, changes, message):
    with pytest.raises(SpecError, match=message) as caught:
        design({**SMALL, **changes}, out=tmp_path / "out")
    assert "\n" not in str(caught.value) and not (tmp_path / "out").exists()


def test_shipped_designs_load():
    designs = [name for name in list_names("studies") if study_kind(name) is StudyKind.design]
    assert len(designs) == 3
    for name in designs:
        assert Problem(read_spec(DesignSpec, name, "studies")).starts()


@pytest.mark.parametrize(("tile_px", "shares"), [(None, {"red": 0.5}), ([4, 4], None), (None, None)])
def test_a_set_whose_shares_are_not_varied_or_drawn_is_kept(tile_px, shares):
    own = object()
    problem = SimpleNamespace(filter_set=own, spec=SimpleNamespace(tile_px=tile_px))
    assert designed_set(problem, SimpleNamespace(shares=shares)) is own
