"""Mutation testing: change one operator or number of a statistical module, and see whether a test fails.

    python -m tests.mutate                    twenty random mutations of the targets below
    python -m tests.mutate --count 200 --seed 3 --only aps
    python -m tests.mutate --fixed            the mutations that once survived; all must be killed
    python -m tests.mutate --list             every mutation, not run

A mutation that no test notices is printed with its line; the command then ends with status 1. Some survivors are
equivalent to the original (a starting value of a search, a bound that is never reached): read the line before a test
is written. The working tree is not touched: pytest gets the changed module through an import hook, which this file
installs when pytest loads it as a plugin.
"""

from __future__ import annotations

import argparse
import ast
import copy
import importlib.abc
import importlib.util
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
#: Where the hook finds the changed module: its name, and the file with its source.
_NAME, _SOURCE = "HESIM_RENDER_MUTANT_NAME", "HESIM_RENDER_MUTANT_SOURCE"
#: A run of tests that takes so many times as long as the unchanged one hangs, and so many seconds more.
_PATIENCE, _GRACE_S = 4.0, 30.0

#: Functions that are mutated, "module:function" or "module" for all of it, and the tests that should notice.
TARGETS: dict[str, tuple[str, ...]] = {
    "calibrate.aps.variance": (
        "tests/calibrate/test_calibration_closed_forms.py",
        "tests/calibrate/test_calibrate_aps.py",
    ),
    "calibrate.aps.photon_transfer": (
        "tests/calibrate/test_calibration_closed_forms.py",
        "tests/calibrate/test_calibrate_aps.py",
    ),
    "calibrate.moments": ("tests/calibrate/test_calibrate_aps.py",),
    "calibrate.evs.model": (
        "tests/calibrate/test_calibration_closed_forms.py",
        "tests/calibrate/test_calibrate_evs.py",
    ),
    "calibrate.evs.fitted": (
        "tests/calibrate/test_calibration_closed_forms.py",
        "tests/calibrate/test_calibrate_evs.py",
    ),
    "calibrate.evs.thresholds": (
        "tests/calibrate/test_calibration_closed_forms.py",
        "tests/calibrate/test_calibrate_evs.py",
    ),
    "calibrate.evs.defects": (
        "tests/calibrate/test_calibration_closed_forms.py",
        "tests/calibrate/test_calibrate_evs.py",
    ),
    "calibrate.flicker": ("tests/pixels/test_pixel_defects.py",),
    "calibrate.aps.telegraph": ("tests/pixels/test_pixel_defects.py",),
    "pixels.poisson_points": ("tests/pixels/test_pixel_defects.py",),
    "sources.flicker": ("tests/sources/test_flicker.py",),
    "sources.render.audit.confidence": ("tests/sources/render/test_audit.py",),
    "sources.render.audit.compare": ("tests/sources/render/test_audit.py",),
    "sources.render.change_driven.plan": ("tests/sources/render/test_changes.py",),
    "sources.render.change_driven.tuning:Gain": ("tests/sources/render/test_changes.py",),
    "sources.render.sampling.sampler:surface_points": ("tests/sources/render/test_renderer_sampling.py",),
    "sensor.distortion": ("tests/sensor/test_distortion.py", "tests/sources/render/test_projection.py"),
    "sources.render.blur": ("tests/sources/render/test_blur.py",),
    "sources.render.primary_rays:RayFactory": (
        "tests/sources/render/test_thin_lens.py",
        "tests/sources/render/test_lens_effects.py",
        "tests/sources/render/test_aimed_rays.py",
        "tests/sources/render/test_projection.py",
    ),
    "sources.render.glare": ("tests/sources/render/test_lens_effects.py",),
    "core.rng:normal_pair": ("tests/pixels/test_noise_aps.py", "tests/pixels/test_noise_evs.py"),
    "calibrate.recordings.ramps": ("tests/calibrate/test_target_ramps.py",),
    "calibrate.recordings.rests": ("tests/calibrate/test_target_rests.py", "tests/calibrate/test_target_ramps.py"),
    "calibrate.recordings.stillness": ("tests/calibrate/test_still_closed_forms.py",),
    "measure.event_distance": ("tests/measure/test_event_distance.py",),
    "measure.event_statistics": ("tests/measure/test_event_distance.py",),
}


@dataclass(frozen=True)
class Fixed:
    """A mutation of a line, wherever in the package that stands.

    Parameters
    ----------
    why : what it breaks.
    before, after : the text, which one module has once.
    tests : that must notice.
    """

    why: str
    before: str
    after: str
    tests: tuple[str, ...]


_FORMS = "tests/calibrate/test_calibration_closed_forms.py"
#: Mutations that no test noticed once.
FIXED = (
    Fixed(
        "event probability: the asymmetry after the mean over thresholds",
        "v = over_thresholds(own, cells.relative, cells.spread, NUMPY)",
        "v = (1 - cells.polarity * rho) * over_thresholds(u, cells.relative, cells.spread, NUMPY)",
        ("tests/calibrate/test_event_closed_forms.py",),
    ),
    Fixed(
        "interference: a floor without the filter of the read-out",
        "floor = _floor(inside, (rows, cols), frames - 1, highest)",
        "floor = np.full(inside.shape, np.median(inside))",
        ("tests/calibrate/test_pairs_closed_forms.py",),
    ),
    Fixed(
        "variance polynomial: no correction for the noise of the signals",
        "result[:, n] += (-1) ** j * count * tau**j * sums[:, n - 2 * j]",
        "result[:, n] += 0 * sums[:, n - 2 * j]",
        (_FORMS,),
    ),
    Fixed(
        "system gain: no correction for the noise of the signals",
        "x2 = bins.powers[lit, 2] - bins.noise[lit] * bins.pixels[lit]",
        "x2 = bins.powers[lit, 2] + 0 * bins.noise[lit] * bins.pixels[lit]",
        (_FORMS,),
    ),
    Fixed(
        "error of θ: the covariance of both thresholds with the wrong sign",
        "return float(np.sqrt(self.covariance[:2, :2].sum())) / 2",
        "return float(np.sqrt(2 * np.trace(self.covariance[:2, :2]) - self.covariance[:2, :2].sum())) / 2",
        (_FORMS,),
    ),
    Fixed(
        "error of θ from the conversion to voltage: the covariance of A and B with the wrong sign",
        "variance = relative[0, 0] + relative[1, 1] - 2 * relative[0, 1]",
        "variance = relative[0, 0] + relative[1, 1] + 2 * relative[0, 1]",
        (_FORMS,),
    ),
    Fixed(
        "pixels that fire too little: the tail of the wrong threshold",
        "result[under] = binom.cdf(counts[under], trials, low[group[under]]) < _CHANCE",
        "result[under] = binom.cdf(counts[under], trials, high[group[under]]) < _CHANCE",
        (_FORMS,),
    ),
    Fixed(
        "pixels that fire too little over contrast steps: no tail",
        "poisson.cdf(total, least) < _CHANCE",
        "poisson.cdf(total, least) < 0",
        (_FORMS,),
    ),
    Fixed(
        "asymmetry: kept from a likelihood ratio of 1e-2 on",
        "enough = float(chi2_law.isf(1e-3, 1))",
        "enough = float(chi2_law.isf(1e-2, 1))",
        (_FORMS,),
    ),
    Fixed(
        "asymmetry: kept from a likelihood ratio of 1e-4 on",
        "enough = float(chi2_law.isf(1e-3, 1))",
        "enough = float(chi2_law.isf(1e-4, 1))",
        (_FORMS,),
    ),
    Fixed(
        "flicker: an instant on the border of two pieces counts twice",
        "(begin >= low) & ((begin < high) | (number == bounds.size - 2))",
        "(begin >= low) & ((begin <= high) | (number == bounds.size - 2))",
        ("tests/sources/test_flicker.py",),
    ),
    Fixed(
        "variance polynomial: its goodness of fit centred elsewhere",
        "return float(ndtr(-(chi2 - 1) * np.sqrt(dof / each)))",
        "return float(ndtr(-(chi2 + 1) * np.sqrt(dof / each)))",
        (_FORMS,),
    ),
    Fixed(
        "error of the read noise: a third instead of half",
        "noise_error = float(np.sqrt(np.sum(error**2)) / len(known) / (2 * noise))",
        "noise_error = float(np.sqrt(np.sum(error**2)) / len(known) / (3 * noise))",
        (_FORMS,),
    ),
    Fixed(
        "audit: events of one polarity are judged by the other's threshold",
        "for sign, theta in ((1.0, thresholds[0]), (-1.0, thresholds[1])):",
        "for sign, theta in ((1.0, thresholds[1]), (-1.0, thresholds[1])):",
        ("tests/sources/render/test_audit.py::test_each_polarity_has_its_own_threshold",),
    ),
    Fixed(
        "plan: a change is measured in the inverse of the noise",
        "np.float32(tuning.change * tuning.tolerance * quality) * units",
        "np.float32(tuning.change * tuning.tolerance * quality) / units",
        ("tests/sources/render/test_changes.py",),
    ),
    Fixed(
        "plan: large changes next to a pixel do not count by themselves",
        "near = sites.most(large[window], 1) | sites.most(extreme[window], 2)",
        "near = sites.most(large[window], 1) & sites.most(extreme[window], 2)",
        ("tests/sources/render/test_changes.py",),
    ),
    Fixed(
        "plan: half of what counts, in units that do not fit",
        "np.float32(0.5) * bound)",
        "np.float32(0.5) / bound)",
        ("tests/sources/render/test_changes.py",),
    ),
    Fixed(
        "the renderer's own error: half as large",
        "error = np.abs(one - other) / 2 / noise((one + other) / 2, place)",
        "error = np.abs(one - other) / 4 / noise((one + other) / 2, place)",
        ("tests/sources/render/test_hidden_scenes.py::test_the_stated_error_of_event_samples_is_the_true_one",),
    ),
    Fixed(
        "DSEC: the check of the index forgets the offset of the times",
        "int(times[last]) + offset < end_us",
        "int(times[last]) < end_us",
        ("tests/exchange/test_round_trips.py::test_an_interval_of_a_file_of_dsec_is_read_by_its_index",),
    ),
    Fixed(
        "frames: a region as wide as the sensor has the noise of the first rows",
        "self._layout.row0 * sensor_cols",
        "self._layout.row0",
        ("tests/pixels/test_noise_aps.py::test_bits_follow_from_the_seed_alone",),
    ),
    Fixed(
        "row offsets: a prior of another unit",
        "band[0] = 1 / row_std_dn**2",
        "band[0] = 1 / row_std_dn",
        ("tests/isp/test_isp_denoise.py",),
    ),
    Fixed(
        "row offsets: what is picture is judged in another unit",
        "spread = row_std_dn**2 * (1 + share**2",
        "spread = row_std_dn * (1 + share**2",
        ("tests/isp/test_isp_denoise.py",),
    ),
    Fixed(
        "audit: a false event of an asynchronous pixel is sure before it is",
        "sure = over & (own[around].max(axis=0) > goal + SURE * spread)",
        "sure = over & (own[around].max(axis=0) > goal - SURE * spread)",
        ("tests/sources/render/test_audit.py",),
    ),
    Fixed(
        "audit: most of what stands still is looked at, and counts four times",
        "(self._rng.random(some.size) < _STILL_PART)",
        "(self._rng.random(some.size) > _STILL_PART)",
        ("tests/sources/render/test_audit.py",),
    ),
    Fixed(
        "signals between pixels: noise of the frames counts as an edge",
        "- mean * mean - _NOISE_MARGIN * blur(noise * noise) / weight",
        "- mean * mean",
        (_FORMS,),
    ),
    Fixed(
        "dispersion in time: the trinomial variance of a difference",
        "n * (p_on + p_off - (p_on - p_off) ** 2)",
        "n * (p_on + p_off + (p_on - p_off) ** 2)",
        (_FORMS,),
    ),
    Fixed(
        "labels: the instant of the release does not belong to the dead time",
        "released = self._ready_us[pixel] < t_us",
        "released = self._ready_us[pixel] <= t_us",
        ("tests/pixels/test_labels.py::test_pairs_of_pixels_with_a_dead_time",),
    ),
    Fixed(
        "calibrated sensor: θ₊ is that of the other polarity",
        "theta * (1 - rho)",
        "theta * (1 + rho)",
        ("tests/calibration/test_calibrated_sensor.py::test_each_threshold_of_a_calibration_reaches_its_own_polarity",),
    ),
    Fixed(
        "row noise: the standard error of a variance",
        "error = scale * ratio * float(np.sqrt(2 / freedom))",
        "error = scale * ratio * float(np.sqrt(1 / freedom))",
        ("tests/calibrate/test_calibrate_checks.py::test_the_error_of_the_row_noise_is_its_scatter",),
    ),
    Fixed(
        "dark line: each row counts as a whole frame",
        "variance = (noise + rows / dark.mean.shape[1]) / dark.frames",
        "variance = (noise + rows) / dark.frames",
        (_FORMS,),
    ),
    Fixed(
        "S-curves: the ceiling lies above the floor",
        "p = values[floor] + (values[6] - values[floor]) * shape",
        "p = values[floor] + values[6] * shape",
        (_FORMS,),
    ),
    Fixed(
        "spread of thresholds: counting is added in place of taken off",
        "m**2 - own / u**2",
        "m**2 + own / u**2",
        (_FORMS,),
    ),
    Fixed(
        "first events: correlation of their noise", "return (1.0 + h) * math.exp(-h)", "return math.exp(-h)", (_FORMS,)
    ),
    Fixed(
        "signals of event pixels: µs taken for s",
        "np.maximum(rate.astype(np.float64), 0.0) * reference.t_ref_us * S_PER_US",
        "np.maximum(rate.astype(np.float64), 0.0) * reference.t_ref_us",
        (_FORMS,),
    ),
    Fixed(
        "noise reduction: its strength counts once in a variance",
        "residual_dn2=self.residual_dn2 * factor**2",
        "residual_dn2=self.residual_dn2 * factor",
        ("tests/isp/test_isp_denoise.py",),
    ),
    Fixed(
        "previews: the noise of a mean is that of one pixel",
        "(noise[0] * shares, noise[1] * shares)",
        "(noise[0] * shares, noise[1])",
        ("tests/recording/test_recording.py::test_preview_dng_is_the_binned_quad",),
    ),
    Fixed(
        "pictures of events: OFF is black",
        "share * ON_COLOUR + (1 - share) * OFF_COLOUR",
        "share * ON_COLOUR + share * OFF_COLOUR",
        ("tests/recording/test_preview.py",),
    ),
    Fixed(
        "event pixels: the signal of another filter, the wrong way round",
        "total[reference] / total[name]",
        "total[name] / total[reference]",
        ("tests/sensor/test_radiometry.py",),
    ),
    Fixed(
        "glare: rows and columns of the sensor in each other's place",
        "np.array([geometry.rows, geometry.cols])[:, None, None]",
        "np.array([geometry.cols, geometry.rows])[:, None, None]",
        ("tests/sources/render/test_lens_effects.py::test_glare_is_measured_all_over_a_sensor_that_is_not_square",),
    ),
    Fixed(
        "schedule: a frame has one row more",
        "self.start_us + (self.rows - 1) * self.line_time_us",
        "self.start_us + self.rows * self.line_time_us",
        ("tests/mosaic/test_schedule.py",),
    ),
    Fixed(
        "defects: what a good pixel gives leaves no room for its other polarity",
        "np.maximum(1.0 - on - off, 1e-9)",
        "np.maximum(1.0 - on, 1e-9)",
        ("tests/pixels/test_formulas.py",),
    ),
    Fixed(
        "thresholds of few events: their spread counts once",
        "1 - (spread * v) ** 2",
        "1 - (spread * v)",
        (_FORMS,),
    ),
    Fixed(
        "grey world: a tile counts where one channel is bright enough",
        "good = (means.min(axis=0) > _DARKEST)",
        "good = (means.max(axis=0) > _DARKEST)",
        ("tests/isp/test_isp_steps.py",),
    ),
    Fixed(
        "rates of events: intervals of another length",
        '((some["t_us"] - begin) / interval_us)',
        '((some["t_us"] - begin) / (interval_us + 1))',
        ("tests/events/test_event_arrays.py",),
    ),
    Fixed(
        "frames that scatter: the least likely position is named, not the likeliest",
        "worst = min(wide, key=lambda p: wide[p].p_value)",
        "worst = max(wide, key=lambda p: wide[p].p_value)",
        (_FORMS,),
    ),
    Fixed(
        "spread of thresholds: sought in however few counts",
        "if mixture.pixel.size < _FEWEST_COUNTS:",
        "if mixture.pixel.size < 0:",
        ("tests/calibrate/test_event_closed_forms.py",),
    ),
    Fixed(
        "simulated bench: the end of the light is stored in place of the events",
        'cycles)[0], "rapid")',
        'cycles)[1], "rapid")',
        ("tests/report/test_instrument.py",),
    ),
    Fixed(
        "EMVA frames: at the left of 16 bits if one pixel has no bit below",
        "not np.any(frame & low)",
        "not np.all(frame & low)",
        ("tests/calibrate/test_pairs_closed_forms.py",),
    ),
    Fixed(
        "flicker: the error of one light replaces that of its other pieces",
        "total += np.float32(weight) * error",
        "total[:] = np.float32(weight) * error",
        ("tests/sources/test_flicker.py",),
    ),
    Fixed(
        "curves of a sensor: a dead time of 1 µs where it has none",
        "(self.noise.refractory_period_us or 0) * S_PER_US\n        bandwidth_hz",
        "(self.noise.refractory_period_us or 1) * S_PER_US\n        bandwidth_hz",
        ("tests/describe/test_curves.py",),
    ),
)


@dataclass(frozen=True)
class Mutant:
    """A module with one change.

    Parameters
    ----------
    module : dotted name within the package.
    line : of the change; `change`, what it is, in words of code.
    make : gives the source of the whole module.
    """

    module: str
    line: int
    change: str
    make: Callable[[], str]


# ---- mutations ----------------------------------------------------------------------------------

_SWAPPED = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult, ast.MatMult: ast.Sub,
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.And: ast.Or, ast.Or: ast.And, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
_NAMES = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum", "cdf": "sf", "sf": "cdf"}


def _changed(node: ast.AST) -> Iterator[ast.AST]:
    """What may stand in place of one node."""
    other = copy.copy(node)
    if isinstance(other, ast.BinOp | ast.BoolOp) and type(other.op) in _SWAPPED:
        other.op = _SWAPPED[type(other.op)]()
        yield other
    elif isinstance(other, ast.Compare) and type(other.ops[0]) in _SWAPPED:
        other.ops = [_SWAPPED[type(other.ops[0])](), *other.ops[1:]]
        yield other
    elif isinstance(other, ast.UnaryOp) and isinstance(other.op, ast.USub | ast.Not | ast.Invert):
        yield other.operand
    elif isinstance(other, ast.Constant) and isinstance(other.value, bool):
        yield ast.Constant(not other.value)
    elif isinstance(other, ast.Constant) and isinstance(other.value, int | float):
        yield ast.Constant(other.value + 1 if isinstance(other.value, int) else 2 * other.value if other.value else 1.0)
    elif isinstance(other, ast.Attribute) and other.attr in _NAMES:
        other.attr = _NAMES[other.attr]
        yield other
    elif isinstance(other, ast.Name) and other.id in _NAMES:
        other.id = _NAMES[other.id]
        yield other


def _places(tree: ast.AST, parent: ast.AST | None = None) -> Iterator[tuple[ast.AST, str, int | None, ast.AST]]:
    """Nodes that compute something: (parent, field, place in a list, node); no annotations, texts or decorators."""
    for name, value in ast.iter_fields(tree):
        if name in ("annotation", "returns", "decorator_list", "type_params", "exc", "msg"):
            continue
        for place, node in enumerate(value) if isinstance(value, list) else [(None, value)]:
            if isinstance(node, ast.AST):
                yield tree, name, place, node
                if not isinstance(node, ast.JoinedStr):
                    yield from _places(node, tree)


def path_of(module: str) -> Path:
    return ROOT / "hesim_render" / Path(*module.split(".")).with_suffix(".py")


def mutants(target: str) -> list[Mutant]:
    """All of a target, in the order of the source."""
    module, _, function = target.partition(":")
    tree = ast.parse(path_of(module).read_text(encoding="utf-8"))
    part: ast.AST = tree
    if function:
        part = next(n for n in ast.walk(tree) if getattr(n, "name", None) == function)

    def source(parent: ast.AST, name: str, place: int | None, node: ast.AST, other: ast.AST) -> str:
        _put(parent, name, place, other)
        changed = ast.unparse(ast.fix_missing_locations(tree))
        _put(parent, name, place, node)
        return changed

    return [
        Mutant(
            module, getattr(node, "lineno", 0), f"{ast.unparse(node)}  ->  {ast.unparse(other)}",
            partial(source, parent, name, place, node, other),
        )
        for parent, name, place, node in list(_places(part))
        for other in _changed(node)
    ]  # fmt: skip


def _put(parent: ast.AST, name: str, place: int | None, node: ast.AST) -> None:
    if place is None:
        setattr(parent, name, node)
    else:
        getattr(parent, name)[place] = node


def of_fixed(one: Fixed) -> Mutant:
    """The module that has the text, changed.

    Raises
    ------
    ValueError
        If no module has it, or it stands in more than one place.
    """
    found = []
    for path in sorted((ROOT / "hesim_render").rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        found += [(path, source)] * source.count(one.before)
    if len(found) != 1:
        raise ValueError(f"{one.why}: {len(found)} places have {one.before!r}; write the line anew in tests/mutate.py")
    path, source = found[0]
    module = ".".join(path.relative_to(ROOT / "hesim_render").with_suffix("").parts)
    line = source[: source.index(one.before)].count("\n") + 1
    return Mutant(module, line, one.why, lambda: source.replace(one.before, one.after))


# ---- running ------------------------------------------------------------------------------------


def run_tests(tests: tuple[str, ...], mutant: Mutant | None, timeout_s: float | None = None) -> str:
    """``passed``, ``failed``, ``late``, or what else pytest said, with a module changed or not."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
        if mutant is not None:
            source = Path(folder) / "mutant.py"
            source.write_text(mutant.make(), encoding="utf-8")
            environment |= {_NAME: f"hesim_render.{mutant.module}", _SOURCE: str(source)}
        # a test that is named may be a slow one; of whole files the quick ones do
        chosen = ("-m", "slow or not slow") if any("::" in test for test in tests) else ()
        plugins = "-p", "tests.mutate", "-p", "no:cacheprovider"
        command = [sys.executable, "-m", "pytest", "-x", "-q", *chosen, *plugins, *tests]
        try:
            child = subprocess.run(
                command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=timeout_s
            )
        except subprocess.TimeoutExpired:
            return "late"
    # a module that cannot even be imported ends with status 2 or 4
    return {0: "passed", 1: "failed"}.get(child.returncode, "failed" if mutant is not None else child.stdout[-2000:])


class _Finder(importlib.abc.MetaPathFinder):
    """Gives one module another source."""

    def __init__(self, name: str, source: str) -> None:
        self._name, self._source = name, source

    def find_spec(self, fullname, path=None, target=None):
        if fullname == self._name:
            return importlib.util.spec_from_file_location(fullname, self._source)
        return None


if _NAME in os.environ and __name__ != "__main__":  # loaded by pytest as a plugin
    sys.meta_path.insert(0, _Finder(os.environ[_NAME], os.environ[_SOURCE]))


def survivors(chosen: list[tuple[Mutant, tuple[str, ...]]]) -> list[Mutant]:
    """Those that no test notices; one line each is printed."""
    usual: dict[tuple[str, ...], float] = {}
    found = []
    for mutant, tests in chosen:
        if tests not in usual:
            begin = time.perf_counter()
            told = run_tests(tests, None)
            if told != "passed":
                raise SystemExit(f"{' '.join(tests)} do not pass on the unchanged code: {told}")
            usual[tests] = time.perf_counter() - begin
        told = run_tests(tests, mutant, _PATIENCE * usual[tests] + _GRACE_S)
        print(
            f"{'SURVIVED' if told == 'passed' else 'killed':8} {mutant.module}:{mutant.line}  {mutant.change}",
            flush=True,
        )
        if told == "passed":
            found.append(mutant)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=20, help="random mutations to run")
    parser.add_argument("--seed", type=int, default=0, help="of the choice")
    parser.add_argument("--only", default="", help="targets whose name has this text")
    parser.add_argument("--fixed", action="store_true", help="the fixed list instead")
    parser.add_argument("--list", action="store_true", help="print all, run none")
    given = parser.parse_args()
    if given.fixed:
        chosen = [(of_fixed(one), one.tests) for one in FIXED]
    else:
        every = [(m, tests) for target, tests in TARGETS.items() if given.only in target for m in mutants(target)]
        if given.list:
            for mutant, _ in every:
                print(f"{mutant.module}:{mutant.line}  {mutant.change}")
            return 0
        chosen = random.Random(given.seed).sample(every, min(given.count, len(every)))
        chosen.sort(key=lambda pair: (pair[0].module, pair[0].line))
    left = survivors(chosen)
    print(f"{len(left)} of {len(chosen)} survived")
    return 1 if left else 0


if __name__ == "__main__":
    raise SystemExit(main())
