"""A twin: calibrated on half of EMVA 1288 captures, tested on the other half."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

from hesim_render.calibrate.aps.long_series import long_series
from hesim_render.calibrate.aps.pair_levels import both_levels, without_stuck
from hesim_render.calibrate.aps.pairs import DARK_NOISE_LIMIT_DN, PairCalibration
from hesim_render.calibrate.aps.pairs_findings import findings, missing_codes
from hesim_render.calibrate.aps.pairs_output import calibrate_pairs
from hesim_render.calibrate.aps.sensor_file import write_sensor
from hesim_render.calibrate.estimate import Finding
from hesim_render.calibrate.moments import Progress
from hesim_render.calibrate.result import plain
from hesim_render.calibration.file import read_maps
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.output import OutputFolder, output_errors
from hesim_render.recording.pair_set import read_pair_set
from hesim_render.sensor.sensor import load_sensor
from hesim_render.twin.comparison import ALARM, Check, Half, compare
from hesim_render.twin.page import page
from hesim_render.twin.simulated import TwinBench

RESULT_NAME = "twin.json"
#: Lit pairs of whose every second one a calibration follows.
_FEWEST_PAIRS = 9


@dataclass(frozen=True)
class Twin:
    """A twin and how it did.

    Attributes
    ----------
    folder : holds ``calibration.yaml``, ``sensor.yaml``, ``twin.json`` and ``twin.html``.
    checks : one a statistic.
    findings : what the sensor, or the bench, has beyond a linear model.
    """

    folder: Path
    checks: list[Check]
    findings: list[Finding]

    @property
    def passed(self) -> bool:
        return all(check.passed for check in self.checks)


def make_twin(
    captures: str | Path, out: str | Path, *, seed: int = 7, overwrite: bool = False, progress: Progress | None = None
) -> Twin:
    """Calibrate a sensor on every second exposure and half of the long series, simulate the rest, and compare.

    Parameters
    ----------
    captures : folder of EMVA 1288 captures.
    out : folder to write.
    seed : of the simulated noise.
    overwrite : replace an existing twin.
    progress : called with a text that names the current work and the fraction done.

    Raises
    ------
    RangeError
        If the seed is out of range.
    SpecError
        If the captures cannot be used, or are too few for two halves.
    OutputError
        If `out` exists or cannot be written.
    """
    if not 0 <= seed < 2**64:
        raise RangeError("seed", seed, "0 to 2^64 - 1")
    pairs = read_pair_set(captures)
    if min(len(pairs.spatial_lit.files), len(pairs.spatial_dark.files)) < 8:
        raise pairs.spatial_lit.error("a series of fewer than 8 frames has no two halves")
    if len(pairs.lit) < _FEWEST_PAIRS:
        problem = (
            f"{len(pairs.lit)} lit pairs; a twin is fitted to every second one, and {_FEWEST_PAIRS} are the fewest"
        )
        raise SpecError(problem, file=pairs.file)
    fitted, held = pairs.half(0), pairs.half(1)
    with OutputFolder(out, RESULT_NAME, overwrite) as folder, output_errors(folder.target):
        calibration = folder.path / "calibration.yaml"
        result = calibrate_pairs(fitted, calibration, progress=progress)
        held = held.with_long_of(result.pairs)
        sensor_file = write_sensor(folder.path / "sensor.yaml", calibration, result)
        bench = TwinBench(load_sensor(sensor_file), result, read_maps(calibration, "aps")["light_rel"], seed)
        real = Half(*both_levels(held, progress), *long_series(held, progress))
        simulated = without_stuck(bench.pairs(held, True, progress), bench.pairs(held, False, progress))
        twin = Half(*simulated, bench.long(held, False), bench.long(held, True))
        checks = compare(result, held, real, twin)
        own_findings = findings(result)
        # grey values near the levels that were held out alone
        unknown = tuple(sorted(set(real.lit.missing) - set(result.lit.missing)))
        own_findings += [Finding(*named, None) for named in missing_codes(replace(real.lit, missing=unknown))]
        if result.dark_noise_is_rounded_off:
            text = _under_rounding(result)
            own_findings.append(Finding("twin", text, None))
        (folder.path / RESULT_NAME).write_text(_json(checks, seed), encoding="utf-8")
        texts = [finding.text for finding in own_findings]
        (folder.path / "twin.html").write_text(page(checks, texts), encoding="utf-8")
    return Twin(folder.target, checks, own_findings)


def _under_rounding(result: PairCalibration) -> str:
    """What a twin can tell in the dark where rounding hides the noise."""
    noise = result.rounded_noise
    if noise is None:
        limit = f"at most {DARK_NOISE_LIMIT_DN} DN, which is not compared"
        return f"rounding hides the dark noise: no grey value changes in the dark, so that it is {limit}"
    interval = f"{noise.value:.3g} DN ({noise.low:.3g} to {noise.high:.3g})"
    return (
        f"rounding hides the variance of the dark noise: by the probabilities of grey values it is {interval}, and "
        "nothing else is compared in the dark"
    )


def _json(checks: list[Check], seed: int) -> str:
    """The result for programs."""
    listed = [
        {
            "name": check.name, "passed": check.passed, "unit": check.unit, "place": check.place, "limit": check.limit,
            "rms": check.rms, "most_rms": check.most_rms,
            "places": check.places, "captures": check.real, "twin": check.twin, "error": check.error, "z": check.z,
        }
        for check in checks
    ]  # fmt: skip
    whole = {"passed": all(check.passed for check in checks), "seed": seed, "false_alarm": ALARM, "checks": listed}
    return json.dumps(plain(whole), indent=1, ensure_ascii=False) + "\n"
