"""Sweeps: one simulation for each combination of keys and seeds, with figures of each; they can be resumed."""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hesim_render.capture.simulate import simulate
from hesim_render.core.errors import HesimError, OutputError, RangeError, SpecError
from hesim_render.core.output import check_target, output_errors, replacing
from hesim_render.core.progress import Progress, shown
from hesim_render.core.region import parse_roi
from hesim_render.measure import measure_mtf
from hesim_render.recording.recording import Recording
from hesim_render.sensor.sensor import load_sensor
from hesim_render.sources.scene import load_scene
from hesim_render.specs.files import content_hash, validate
from hesim_render.specs.sweep import RangeSpec, SweepSpec, read_sweep
from hesim_render.studies.table import Cell, Table

#: File that marks the folder of a sweep.
MARKER = "sweep.json"


@dataclass(frozen=True)
class Run:
    """One simulation of a sweep.

    Parameters
    ----------
    scene, sensor : names or paths as in the file.
    changes : values of the varied keys.
    seed : seed of the run.
    """

    scene: str
    sensor: str
    changes: tuple[tuple[str, Any], ...]
    seed: int

    @property
    def cells(self) -> dict[str, Cell]:
        """The run's own columns."""
        return {"scene": self.scene, "sensor": self.sensor, **dict(self.changes), "seed": self.seed}

    def number(self, spec: SweepSpec, contents: Mapping[str, str]) -> str:
        """A name that depends on all that decides the run's figures: the content of its files, too."""
        own: list[Any] = [
            contents[self.scene],
            contents[self.sensor],
            self.scene,
            self.sensor,
            list(map(list, self.changes)),
            self.seed,
            spec.duration_s,
            spec.roi,
        ]
        own += [dict(sorted(spec.options.items())), sorted(spec.metrics)]
        return hashlib.sha256(json.dumps(own, sort_keys=True).encode()).hexdigest()[:20]


def runs_of(spec: SweepSpec) -> Iterator[Run]:
    """All combinations of a sweep, seeds fastest."""
    keys = list(spec.vary)
    lists = [each.values() if isinstance(each, RangeSpec) else list(each) for each in spec.vary.values()]
    for scene, sensor, *values, seed in itertools.product(spec.scenes, spec.sensors, *lists, spec.seeds):
        yield Run(scene, sensor, tuple(zip(keys, values, strict=True)), seed)


def sweep(
    spec: str | Path | Mapping[str, Any] | SweepSpec,
    *,
    out: str | Path,
    progress: Progress | Literal[False] | None = None,
) -> Table:
    """Simulate every combination of a sweep and tabulate its figures; runs that are there already are not repeated.

    Parameters
    ----------
    spec : path of a file, or its content as a dictionary (``docs/studies.md``).
    out : folder for ``results.csv``, ``results.json`` and a file per run. A sweep that was ended is resumed by calling
        it again; one whose file has changed computes only the runs that are new.
    progress : called with (done, total, what). None shows a bar in notebooks only, False never shows one.

    Returns
    -------
    A row for each run: scene, sensor, varied keys, seed, and the metrics.

    Raises
    ------
    SpecError
        If a file is not valid; a run that fails is named.
    RangeError
        If a value is out of range.
    OutputError
        If `out` holds other things, or cannot be written.
    """
    read = _read(spec)
    folder = check_target(out, MARKER, overwrite=True)
    runs = list(runs_of(read))
    with output_errors(folder):
        (folder / "runs").mkdir(parents=True, exist_ok=True)
        content = json.dumps(json.loads(read.model_dump_json()), indent=1)
        with replacing(folder / MARKER) as unfinished:
            unfinished.write_text(content + "\n", encoding="utf-8")
    contents = _contents(read)
    rows: list[dict[str, Cell]] = []
    with shown(progress, read.name) as told:
        for done, run in enumerate(runs):
            if told is not None:
                told(done, len(runs), f"run {done + 1} of {len(runs)}")
            rows.append(run.cells | _figures(read, run, run.number(read, contents), folder))
    table = Table(rows)
    table.write(folder / "results.csv", overwrite=True)
    table.write(folder / "results.json", overwrite=True)
    return table


def check_sweep(spec: str | Path | Mapping[str, Any] | SweepSpec, out: str | Path) -> tuple[int, int]:
    """What `sweep` would do; nothing is written or simulated.

    Returns
    -------
    Number of runs, and of those among them that are still to be made.
    """
    read = _read(spec)
    folder, contents, runs = check_target(out, MARKER, overwrite=True), _contents(read), list(runs_of(read))
    missing = [run for run in runs if not _file_of(folder, run.number(read, contents)).is_file()]
    return len(runs), len(missing)


def _read(spec: str | Path | Mapping[str, Any] | SweepSpec) -> SweepSpec:
    if isinstance(spec, Mapping):
        return validate(SweepSpec, dict(spec), None, {})
    return spec if isinstance(spec, SweepSpec) else read_sweep(spec)


def _contents(spec: SweepSpec) -> dict[str, str]:
    """Hash of what each named scene and sensor holds."""
    found = {name: content_hash(load_scene(spec.beside(name)).spec) for name in spec.scenes}
    return found | {name: content_hash(load_sensor(spec.beside(name)).spec) for name in spec.sensors}


def _file_of(folder: Path, number: str) -> Path:
    return folder / "runs" / f"{number}.json"


def _figures(spec: SweepSpec, run: Run, number: str, folder: Path) -> dict[str, Cell]:
    """Figures of a run, from its file if there is one."""
    file = _file_of(folder, number)
    if file.is_file():
        try:
            stored = json.loads(file.read_text(encoding="utf-8"))
            if stored["run"] == json.loads(json.dumps(run.cells)):
                return dict(stored["figures"])
        except (ValueError, KeyError, TypeError):
            raise OutputError(f"{file}: is damaged; remove it to repeat the run") from None
    recording = _simulated(spec, run, folder / "recordings" / number)
    found = {name: each for metric in spec.metrics for name, each in _metric(recording, metric).items()}
    with replacing(file) as unfinished:
        unfinished.write_text(json.dumps({"run": run.cells, "figures": found}) + "\n", encoding="utf-8")
    return found


def _simulated(spec: SweepSpec, run: Run, place: Path) -> Recording:
    changes = dict(run.changes)
    sensor_changes = {key.removeprefix("sensor."): value for key, value in changes.items() if key.startswith("sensor.")}
    scene_changes = {key: value for key, value in changes.items() if not key.startswith("sensor.")}
    told = ", ".join(f"{key}={value}" for key, value in run.cells.items())
    try:
        sensor = load_sensor(spec.beside(run.sensor), sensor_changes)
        if spec.roi is not None:
            sensor = sensor.crop(*parse_roi(spec.roi, "roi"))
        scene = load_scene(spec.beside(run.scene), scene_changes)
        out = place if spec.keep else None
        return simulate(
            scene, sensor, duration_s=spec.duration_s, seed=run.seed, out=out, overwrite=True, progress=False,
            **spec.options,  # type: ignore[arg-type]
        )  # fmt: skip
    except HesimError as error:
        raise SpecError(f"run with {told}: {str(error).splitlines()[0]}") from None


def _metric(recording: Recording, metric: str) -> dict[str, Cell]:
    """One figure of a recording, None where it has no meaning."""
    frames, duration_s = recording.frames, recording.duration_us * 1e-6
    if metric == "frames":
        return {"frames": len(frames)}
    if metric in ("events", "event_rate"):
        height, width = recording.manifest["event_grid"]["height"], recording.manifest["event_grid"]["width"]
        if not width:
            return {metric: None}
        count = int(recording.manifest["counts"]["events"])
        return (
            {"events": count} if metric == "events" else {"event_rate_hz_per_px": count / (width * height * duration_s)}
        )
    names = {"electrons": "electrons_mean", "raw_mean": "raw_mean_dn", "raw_variance": "raw_variance_dn2", "snr": "snr",
             "mtf50": "mtf50_cy_per_px"}  # fmt: skip
    if not len(frames):
        return {names[metric]: None}
    first = frames[0]
    if metric == "electrons":
        return {"electrons_mean": float(first.electrons_mean[first.valid].mean(dtype=np.float64))}
    if metric == "raw_mean":
        return {"raw_mean_dn": float(first.raw[first.valid].mean(dtype=np.float64))}
    if metric == "mtf50":
        try:
            return {"mtf50_cy_per_px": measure_mtf(recording, signal="electrons").frequency_at(0.5)}
        except RangeError:
            return {"mtf50_cy_per_px": None}  # no edge, or a mosaic
    # temporal variance from the difference of two frames, EMVA 1288; a still scene is needed
    if len(frames) < 2:
        return {names[metric]: None}
    second = frames[1]
    both = first.valid & second.valid
    a, b = first.raw[both].astype(np.float64), second.raw[both].astype(np.float64)
    variance = float(((a - b).var()) / 2)
    if metric == "raw_variance":
        return {"raw_variance_dn2": variance}
    signal = float((a.mean() + b.mean()) / 2 - recording.mosaic.black_level_dn)
    return {"snr": signal / variance**0.5 if variance > 0 else None}
