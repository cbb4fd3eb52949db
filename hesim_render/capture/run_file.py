"""A whole run from one file: a recording, then pictures, exports and its page. A run that was ended goes on."""

import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ValidationError

from hesim_render.capture.run_settings import RunSettings
from hesim_render.capture.simulate import simulate
from hesim_render.capture.simulate_cube import simulate_cube
from hesim_render.capture.simulate_video import simulate_video
from hesim_render.core.errors import HesimError, OutputError, SpecError
from hesim_render.core.guard import WholeFile
from hesim_render.core.journal import journal_of
from hesim_render.core.output import check_target, output_errors, replacing
from hesim_render.core.progress import Progress, expect
from hesim_render.core.region import parse_roi
from hesim_render.core.yaml_file import read_yaml
from hesim_render.isp import DENOISED_PICTURE, Pipeline, develop_recording, load_pipeline
from hesim_render.mosaic.colour_profile import load_camera
from hesim_render.recording.exports import check_format, check_name
from hesim_render.recording.manifest import MANIFEST_NAME
from hesim_render.recording.page import write_page
from hesim_render.recording.recording import Recording
from hesim_render.sensor.sensor import Sensor, load_sensor
from hesim_render.sources.cube import CubeOptions
from hesim_render.sources.scene import Scene, load_scene
from hesim_render.sources.video import VideoOptions
from hesim_render.specs.files import content_hash, read_spec
from hesim_render.specs.problems import spec_error
from hesim_render.specs.run import PICTURES, RECORDING, STATE, FileInput, RunSpec


@dataclass(frozen=True)
class RunResult:
    """What a run has made.

    Parameters
    ----------
    recording : the recording.
    written : each step's file or folder, by the step's name.
    kept : steps that an earlier run had made already.
    """

    recording: Recording
    written: dict[str, Path]
    kept: tuple[str, ...]


@dataclass
class _Run:
    """A run that was read and checked.

    Parameters
    ----------
    spec, file : the content of its file, and the file.
    sensor, scene, options, pipeline : what it names, loaded; options of a video or cube.
    folder : of its results.
    done : names of the steps that are finished.
    """

    spec: RunSpec
    file: Path
    sensor: Sensor
    scene: Scene | None
    options: dict[str, object]
    pipeline: Pipeline | None
    folder: Path
    done: list[str] = field(default_factory=list)

    def identity(self) -> str:
        """A hash of all that decides the results: the file, and the content of the files that it names."""
        named: list[object] = [
            content_hash(self.sensor.spec),
            None if self.scene is None else content_hash(self.scene.spec),
        ]
        given = self.spec.video or self.spec.cube
        if given is not None:
            path = Path(given.beside(given.file, shipped=False))
            state = path.stat()
            named += [path.name, state.st_size, state.st_mtime_ns]
        if self.spec.isp is not None:
            named += [None if self.pipeline is None else self.pipeline.model_dump(mode="json")]
        text = json.dumps([self.spec.model_dump(mode="json"), named], sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()

    def note(self, step: str | None = None) -> None:
        """Write the state, with one more finished step."""
        if step is not None:
            self.done.append(step)
        state = {"schema_version": 1, "name": self.spec.name, "sha256": self.identity(), "done": self.done}
        with output_errors(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
        with replacing(self.folder / STATE) as unfinished:
            unfinished.write_text(json.dumps(state, indent=1) + "\n", encoding="utf-8")


def run(
    file: str | Path,
    out: str | Path,
    *,
    overrides: dict[str, object] | None = None,
    allow_outside: bool = False,
    overwrite: bool = False,
    max_minutes: float | None = None,
    progress: Progress | None = None,
    on_estimate: Callable[[object], None] | None = None,
) -> RunResult:
    """Do all that the file of a run asks for. Steps that are finished in `out` are not repeated.

    Parameters
    ----------
    file : YAML file (``docs/cli.md``).
    out : folder of the results: ``recording``, ``pictures``, exports, and the state of the run.
    overrides : dotted keys of the file and their values.
    allow_outside : let the scene name files outside of its folder; no key of the file, which may be somebody else's.
    overwrite : replace the results of a run of other content.
    max_minutes, progress : as for `simulate`.
    on_estimate : called with the estimate of the recording, or with a text where there is none; an exception that it
        raises ends the run before anything is written.

    Raises
    ------
    SpecError, RangeError
        If the file, or one that it names, is not valid; all of it is checked before anything is rendered.
    TooLongError
        If the recording would take longer than `max_minutes`.
    OutputError
        If `out` holds something else, or a run of other content, or cannot be written.
    """
    asked = _read(Path(file), Path(out), overrides or {}, allow_outside)
    _open(asked, overwrite)
    kept = tuple(asked.done)
    recording = _recorded(asked, max_minutes, progress, on_estimate)
    expect(progress, None)  # the estimate was that of the recording
    written = {RECORDING: asked.folder / RECORDING}
    for name, make in _steps(asked, recording, progress).items():
        target = written[name] = asked.folder / name
        if name not in asked.done or not target.exists():
            make(target)
            asked.note(name)
    return RunResult(recording, written, kept)


def _read(file: Path, out: Path, overrides: dict[str, object], allow_outside: bool) -> _Run:
    """The content of the file, and all files that it names, checked."""
    spec = read_spec(RunSpec, file, overrides=overrides)
    sets: dict[bool, dict[str, object]] = {True: {}, False: {}}
    for key, value in spec.set.items():
        sets[key.startswith("sensor.")][key.removeprefix("sensor.")] = value
    try:
        sensor = load_sensor(spec.beside(spec.sensor), sets[True])
        if spec.roi is not None:
            sensor = sensor.crop(*parse_roi(spec.roi, "roi"))
        scene = None
        if spec.scene is not None:
            scene = load_scene(spec.beside(spec.scene), sets[False], allow_outside=allow_outside)
        options: dict[str, object] = {}
        for key, given, model in (("video", spec.video, VideoOptions), ("cube", spec.cube, CubeOptions)):
            if given is not None:
                options = _options(file, key, given, model)
        for step in spec.export:
            check_format(step.format, sensor.spec.evs is not None, sensor.spec.aps is not None)
            check_name(step.format, step.out)
        pipeline = None
        if spec.isp is not None:
            if sensor.spec.aps is None:
                raise SpecError(f"{sensor.name} has no frame pixels to develop", file=file, key="isp")
            named = spec.isp.pipeline
            pipeline = DENOISED_PICTURE if named is None else load_pipeline(spec.beside(named, shipped=False))
            pipeline = pipeline if spec.isp.denoise else pipeline.without("denoise")
    except SpecError:
        raise
    except HesimError as error:
        raise SpecError(str(error).splitlines()[0], file=file) from None
    return _Run(spec, file, sensor, scene, options, pipeline, check_target(out, STATE, overwrite=True))


def _options(file: Path, key: str, given: FileInput, model: type[BaseModel]) -> dict[str, object]:
    """The options of a video or cube, checked here so that a mistake has its line."""
    if not Path(given.beside(given.file, shipped=False)).exists():
        raise SpecError(f"{given.file}: no such file", file=file, key=f"{key}.file")
    options = dict(given.options)
    match options.get("camera"):
        case str(name):
            options["camera"] = load_camera(Path(given.beside(name, shipped=False)))
    try:
        model.model_validate(options)
    except ValidationError as error:
        data = read_yaml(file).get(key, {}).get("options", {})
        raise spec_error(error, model, data, file) from None
    return options


def _open(asked: _Run, overwrite: bool) -> None:
    """Find the steps that are finished; refuse, or with `overwrite` remove, the results of another run."""
    state = asked.folder / STATE
    if not state.is_file():
        return
    try:
        result = WholeFile(state).json()
        identity, done = result["sha256"], [str(name) for name in result["done"]]
    except (OSError, ValueError, KeyError, TypeError):
        identity, done = None, []
    if identity == asked.identity():
        asked.done = done
        return
    if not overwrite:
        raise OutputError(
            f"{asked.folder}: holds a run of other content; give another folder, or overwrite it (--overwrite, "
            "overwrite=True)"
        )


def _recorded(
    asked: _Run,
    max_minutes: float | None,
    progress: Progress | None,
    on_estimate: Callable[[object], None] | None,
) -> Recording:
    """The recording of an earlier run, or a new one."""
    spec, place = asked.spec, asked.folder / RECORDING
    if RECORDING in asked.done and (place / MANIFEST_NAME).is_file():
        if on_estimate is not None:
            on_estimate("the recording is there already")
        return Recording.load(place)

    def begin(expected: object) -> None:
        if on_estimate is not None:
            on_estimate(expected)
        asked.done = []
        if asked.folder.is_dir():  # results of another run, or of one whose recording was removed
            _clear(asked.folder)
        asked.note()

    shown: Progress | Literal[False] = False if progress is None else progress
    video, cube = spec.video, spec.cube
    duration_s = RunSettings.duration_s if spec.duration_s is None else spec.duration_s  # a video has its own
    if asked.scene is not None:
        made = simulate(
            asked.scene, asked.sensor, duration_s=duration_s, seed=spec.seed,
            clean=spec.clean, without=spec.without, quality=spec.quality, exact=spec.exact, samples=spec.samples,
            truth=spec.truth, truth_every_us=spec.truth_every_us, out=place, overwrite=True, resume=True,
            max_minutes=max_minutes, on_estimate=begin, progress=shown,
        )  # fmt: skip
    elif video is not None:
        made = simulate_video(
            video.beside(video.file, shipped=False), asked.sensor, duration_s=spec.duration_s, seed=spec.seed,
            clean=spec.clean, without=spec.without, out=place, overwrite=True, resume=True, max_minutes=max_minutes,
            on_estimate=begin, progress=shown, live=False, **asked.options,
        )  # fmt: skip
    else:
        assert cube is not None
        made = simulate_cube(
            cube.beside(cube.file, shipped=False), asked.sensor, duration_s=duration_s,
            seed=spec.seed, clean=spec.clean, without=spec.without, out=place, overwrite=True, on_estimate=begin,
            progress=shown, live=False, **asked.options,
        )  # fmt: skip
    asked.note(RECORDING)
    return made


def _clear(folder: Path) -> None:
    """Remove all but the state, which marks the folder as that of a run, and what an interrupted recording goes on
    from.
    """
    with output_errors(folder):
        for path in folder.iterdir():
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            elif path.name not in (STATE, journal_of(folder / RECORDING).name):
                path.unlink()


def _steps(asked: _Run, recording: Recording, progress: Progress | None) -> dict[str, Callable[[Path], object]]:
    """What follows on the recording: names of files or folders, and what makes them."""
    spec = asked.spec
    steps: dict[str, Callable[[Path], object]] = {}
    assert recording.path is not None
    place = recording.path
    if spec.isp is not None:
        named = spec.isp.calibration
        maps = None if named is None else spec.isp.beside(named, shipped=False)
        steps[PICTURES] = lambda path: develop_recording(place, path, asked.pipeline, progress, True, maps)
    for step in spec.export:
        steps[step.out] = lambda path, step=step: recording.export(step.format, path, overwrite=True)  # type: ignore[misc]
    if spec.view:
        steps[f"{RECORDING}/recording.html"] = lambda path: write_page(recording, path.parent)
    return steps
