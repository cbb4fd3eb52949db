"""Sweeps: one simulation or study for each combination of keys and seeds, with figures of each; they can be resumed."""

import hashlib
import itertools
import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from hesim_render.capture.simulate import simulate
from hesim_render.core.errors import HesimError, OutputError, SpecError, did_you_mean
from hesim_render.core.guard import WholeFile
from hesim_render.core.output import check_target, output_errors, write_whole
from hesim_render.core.progress import Progress, shown
from hesim_render.core.region import parse_roi
from hesim_render.core.yaml_file import read_yaml
from hesim_render.isp.pipeline import DEFAULT, Pipeline, load_pipeline
from hesim_render.recording.recording import Recording
from hesim_render.sensor.sensor import Sensor, load_sensor
from hesim_render.sources.scene import Scene, load_scene
from hesim_render.specs.files import content_hash, locate, read_spec, validate
from hesim_render.specs.filter_set import read_filter_set, read_palette
from hesim_render.specs.study import StudySpec
from hesim_render.specs.sweep import RangeSpec, SweepSpec
from hesim_render.studies.run import study
from hesim_render.studies.sweep_metrics import RunFigures, changed_pipeline
from hesim_render.studies.table import Cell, Table

#: File that marks the folder of a sweep.
MARKER = "sweep.json"
#: Column of what the audit of a run found: met, not met, not shown or not audited.
VERDICT = "audit"
_SENSOR, _ISP = "sensor.", "isp."


@dataclass(frozen=True)
class Run:
    """One simulation or study of a sweep.

    Parameters
    ----------
    scene, sensor : names or paths as in the file; empty in a sweep of a study.
    changes : values of the varied keys.
    seed : seed of the run.
    """

    scene: str
    sensor: str
    changes: tuple[tuple[str, Any], ...]
    seed: int

    @property
    def cells(self) -> dict[str, Cell]:
        """The run's own columns; values that are no numbers or texts as JSON."""
        named = {key: value for key, value in (("scene", self.scene), ("sensor", self.sensor)) if value}
        varied = {
            key: value if isinstance(value, str | float | int | bool | None) else json.dumps(value)
            for key, value in self.changes
        }
        return {**named, **varied, "seed": self.seed}

    def keys(self, prefix: str) -> dict[str, Any]:
        """Values of the keys with a prefix, without it; with an empty one, of those that have neither."""
        if prefix:
            return {key.removeprefix(prefix): value for key, value in self.changes if key.startswith(prefix)}
        return {key: value for key, value in self.changes if not key.startswith((_SENSOR, _ISP))}

    @property
    def simulation(self) -> str:
        """What decides the recording: all but the keys of the ISP."""
        changes = [[key, value] for key, value in self.changes if not key.startswith(_ISP)]
        return json.dumps([self.scene, self.sensor, changes, self.seed])


def runs_of(spec: SweepSpec) -> Iterator[Run]:
    """All combinations of a sweep, seeds fastest."""
    keys = list(spec.vary)
    lists = [each.values() if isinstance(each, RangeSpec) else list(each) for each in spec.vary.values()]
    for scene, sensor, *values, seed in itertools.product(
        spec.scenes or [""], spec.sensors or [""], *lists, spec.seeds
    ):
        yield Run(scene, sensor, tuple(zip(keys, values, strict=True)), seed)


def sweep(
    spec: str | Path | Mapping[str, Any] | SweepSpec,
    *,
    out: str | Path,
    progress: Progress | Literal[False] | None = None,
) -> Table:
    """Simulate or study every combination of a sweep, and tabulate its figures; runs that are there are not repeated.

    Parameters
    ----------
    spec : path of a file, or its content as a dictionary (``docs/studies.md``).
    out : folder for ``results.csv``, ``results.json`` and a file per run. A sweep that was ended is resumed by calling
        it again; one whose file has changed computes only the runs that are new.
    progress : called with (done, total, what). None shows a bar in notebooks only, False never shows one.

    Returns
    -------
    A row for each run: scene, sensor, varied keys, seed, the metrics, and what its audit found (`VERDICT`). Runs of a
    study have a row for each of its combinations.

    Raises
    ------
    SpecError
        If a file is not valid; a run that fails is named.
    RangeError
        If a value is out of range.
    OutputError
        If `out` holds other things, or cannot be written.
    """
    read = read_spec(SweepSpec, spec, "studies")
    folder = check_target(out, MARKER, overwrite=True)
    runs = list(runs_of(read))
    made = _made(read, folder, runs)
    with output_errors(folder):
        (folder / "runs").mkdir(parents=True, exist_ok=True)
        write_whole(folder / MARKER, json.dumps(json.loads(read.model_dump_json()), indent=1) + "\n")
    # runs that differ in the ISP alone come one after the other, so that they share a recording
    first = {run.simulation: k for k, run in reversed(list(enumerate(runs)))}
    order = sorted(range(len(runs)), key=lambda k: (first[runs[k].simulation], k))
    result: dict[int, list[dict[str, Cell]]] = {}
    with shown(progress, read.name) as report:
        for done, k in enumerate(order):
            if report is not None:
                report(done, len(runs), f"run {done + 1} of {len(runs)}")
            result[k] = _rows(made, runs[k], folder)
    table = Table(run.cells | row for k, run in enumerate(runs) for row in result[k])
    table.write(folder / "results.csv", overwrite=True)
    table.write(folder / "results.json", overwrite=True)
    return table


def check_sweep(spec: str | Path | Mapping[str, Any] | SweepSpec, out: str | Path) -> tuple[int, int]:
    """What `sweep` would do; nothing is written or simulated.

    Returns
    -------
    Number of runs, and of those among them that are still to be made.
    """
    read = read_spec(SweepSpec, spec, "studies")
    folder, runs = check_target(out, MARKER, overwrite=True), list(runs_of(read))
    made = _made(read, folder, runs)
    return len(runs), sum(not _file_of(folder, made, run).is_file() for run in runs)


def _made(spec: SweepSpec, folder: Path, runs: Sequence["Run"]) -> "_Studies | _Recordings":
    """What makes the runs, each of whose values was taken once: a mistake in the last ends no sweep half-way."""
    made = _Recordings(spec, folder) if spec.study is None else _Studies(spec)
    seen = set[str]()
    for run in runs:
        values = {json.dumps(value) for value in (("", run.scene, run.sensor), *run.changes)}
        if not values <= seen:
            seen |= values
            with _named(run), warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the run itself repeats them
                made.check(run)
    return made


@contextmanager
def _named(run: Run) -> Iterator[None]:
    """Name the run in the error of its files or keys."""
    try:
        yield
    except OutputError:
        raise
    except HesimError as error:
        combination = ", ".join(f"{key}={value}" for key, value in run.cells.items())
        raise SpecError(f"run with {combination}: {str(error).splitlines()[0]}") from None


def _file_of(folder: Path, made: "_Studies | _Recordings", run: Run) -> Path:
    return folder / "runs" / f"{_digest(made.identity(run))}.json"


def _rows(made: "_Studies | _Recordings", run: Run, folder: Path) -> list[dict[str, Cell]]:
    """Rows of a run, from its file if there is one."""
    with _named(run):
        file = _file_of(folder, made, run)
        if file.is_file():
            try:
                stored = WholeFile(file).json()
                if stored["run"] == json.loads(json.dumps(run.cells)):
                    return [dict(row) for row in stored["rows"]]
            except (ValueError, KeyError, TypeError):
                raise OutputError(f"{file}: is damaged; remove it to repeat the run") from None
        rows = made.rows(run)
    write_whole(file, json.dumps({"run": run.cells, "rows": rows}) + "\n")
    return rows


def _digest(identity: Any) -> str:
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:20]


class _Recordings:
    """Runs that simulate recordings."""

    def __init__(self, spec: SweepSpec, folder: Path) -> None:
        self._spec, self._folder = spec, folder
        contents = {name: content_hash(load_scene(spec.beside(name)).spec) for name in spec.scenes}
        self._contents = contents | {name: content_hash(load_sensor(spec.beside(name)).spec) for name in spec.sensors}
        self._pipeline = DEFAULT if spec.isp is None else load_pipeline(spec.beside(spec.isp, shipped=False))
        self._last: tuple[str, Recording] | None = None

    def identity(self, run: Run) -> Any:
        """All that decides the figures of a run: the content of its files, too."""
        spec = self._spec
        return [
            self._contents[run.scene], self._contents[run.sensor], run.scene, run.sensor, run.changes, run.seed,
            spec.duration_s, spec.roi, sorted(spec.options.items()), sorted(spec.wanted),
            self._pipeline.model_dump(mode="json"), VERDICT,
        ]  # fmt: skip

    def rows(self, run: Run) -> list[dict[str, Cell]]:
        """The one row of a run."""
        recording = self._recording(run)
        figures = RunFigures(recording, self._developed(run))
        audit = recording.manifest["settings"].get("render", {}).get("audit", {})
        row: dict[str, Cell] = {name: cell for metric in self._spec.wanted for name, cell in figures(metric).items()}
        return [row | {VERDICT: audit.get("verdict", "not audited")}]

    def _developed(self, run: Run) -> Pipeline:
        return changed_pipeline(self._pipeline, run.keys(_ISP))

    def check(self, run: Run) -> tuple[Scene, Sensor]:
        """Scene and sensor of a run, whose keys, those of the ISP too, are right."""
        self._developed(run)
        sensor = load_sensor(self._spec.beside(run.sensor), run.keys(_SENSOR))
        if self._spec.roi is not None:
            sensor = sensor.crop(*parse_roi(self._spec.roi, "roi"))
        return load_scene(self._spec.beside(run.scene), run.keys("")), sensor

    def _recording(self, run: Run) -> Recording:
        if self._last is not None and self._last[0] == run.simulation:
            return self._last[1]
        scene, sensor = self.check(run)
        spec = self._spec
        place = self._folder / "recordings" / _digest(run.simulation)
        recording = simulate(
            scene, sensor, duration_s=spec.duration_s, seed=run.seed, out=place if spec.keep else None,
            overwrite=True, progress=False, **spec.options,  # type: ignore[arg-type]
        )  # fmt: skip
        self._last = run.simulation, recording
        return recording


class _Studies:
    """Runs of a study of filter sets."""

    def __init__(self, spec: SweepSpec) -> None:
        assert spec.study is not None
        self._spec = spec
        self._file = locate(spec.beside(spec.study), "studies")

    def check(self, run: Run) -> StudySpec:
        """The study with the keys of a run; those that begin with sensor. change its sensors."""
        keys = run.keys("")
        if run.keys(_ISP):
            raise SpecError("keys of the ISP are for sweeps of recordings")
        data = read_yaml(self._file)
        if run.keys(_SENSOR):
            data["sensor_keys"] = {**data.get("sensor_keys", {}), **run.keys(_SENSOR)}
        if "seeds" in self._spec.model_fields_set:
            keys = {**keys, "noise.seed": run.seed}
        return validate(StudySpec, data, self._file, keys)

    def identity(self, run: Run) -> Any:
        """All that decides the figures of a run: the content of its files, too."""
        read = self.check(run)
        sets = [read_filter_set(use.beside(use.set)) for use in read.filter_sets]
        palettes = {use.palette or read.palette: use for use in read.filter_sets}
        files = [read_palette(use.beside(name)) for name, use in palettes.items()]
        sensors = [load_sensor(read.beside(name), read.sensor_keys).spec for name in read.sensors]
        named = [
            item.beside(name) for item in read.surfaces for name in (item.reflectances, item.cube, item.scene) if name
        ]
        stamps = [
            [name, path.stat().st_size, path.stat().st_mtime_ns] for name in named if (path := Path(name)).exists()
        ]
        return [
            json.loads(read.model_dump_json()), [content_hash(each) for each in (*sets, *files, *sensors)], stamps,
            sorted(self._spec.metrics), run.seed,
        ]  # fmt: skip

    def rows(self, run: Run) -> list[dict[str, Cell]]:
        """A row for each combination of the study."""
        table = study(self.check(run), progress=False)
        wanted = self._spec.metrics
        for name in wanted:
            if name not in table.columns:
                raise SpecError(f"metrics: the study has no column {name!r}{did_you_mean(name, table.columns)}")
        names = [name for name in _NAMES if name in table.columns] + wanted if wanted else table.columns
        return [{name: row[name] for name in names} for row in table]


#: Columns of a study that say which combination a row is.
_NAMES = (
    "surfaces", "illuminant", "illuminance_lux", "sensor", "filter_set", "crosstalk", "equal", "exposure_us",
)  # fmt: skip
