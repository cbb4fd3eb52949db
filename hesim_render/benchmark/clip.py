"""One clip of a benchmark, built into a folder that appears whole or not at all."""

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hesim_render.benchmark.plan import BenchmarkPlan, Clip
from hesim_render.benchmark.sharp import (
    COLOURS_FILE,
    SHARP_FILE,
    frame_filters,
    sharp_flux,
    windows,
    write_colours,
    write_sharp,
)
from hesim_render.benchmark.spans import (
    Span,
    discard_spans,
    is_rendered,
    journals_in,
    note_rendered,
    scratch,
    span_journal,
)
from hesim_render.benchmark.statistics import figures
from hesim_render.capture.loop import Capture
from hesim_render.capture.run_settings import noise_models
from hesim_render.capture.scene_renderer import scene_renderer
from hesim_render.capture.simulate import simulate
from hesim_render.core.guard import WholeFile, reading
from hesim_render.core.journal import Journal
from hesim_render.core.output import OutputFolder, output_errors
from hesim_render.recording.manifest import software_versions
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.crosstalk import with_crosstalk
from hesim_render.sources.protocol import FluxSource
from hesim_render.sources.render.light_level import in_absolute_light
from hesim_render.sources.render.renderer import SceneRenderer
from hesim_render.sources.scene import Scene, load_scene
from hesim_render.specs.files import content_hash

CLIP_FILE, RECORDING, SCENE = "clip.json", "recording", "scene"
SCHEMA = 1
#: Time of a clip's build after which what is rendered is kept, for a build that goes on; most clips take less.
_KEPT_AFTER_S = 60.0
UNITS = {
    "t_us": "µs from the start of the clip; the end of an integration window",
    "raw": "DN",
    "electrons_mean": "e⁻",
    "flux_e_per_s": "e⁻/s of each pixel through its own filter",
    "flow_px": "px of its grid, between the times of two frames",
    "depth_m": "m along the camera's axis",
}


@dataclass(frozen=True)
class Built:
    """What building a clip took.

    Parameters
    ----------
    name : of the clip.
    seconds, bytes : time and size of this unit of work; 0 s where the clip was there already, 0 bytes for a span.
    """

    name: str
    seconds: float
    bytes: int


def clip_folder(root: Path, clip: Clip) -> Path:
    """The folder of a clip in a benchmark."""
    return root / "clips" / clip.name


def is_complete(root: Path, clip: Clip) -> bool:
    """True if a clip has been built: its folder appears only when all is in it."""
    return (clip_folder(root, clip) / CLIP_FILE).is_file()


def build_clip(plan: BenchmarkPlan, clip: Clip, root: Path) -> Built:
    """Build a clip, unless it is there. Its bytes depend on the plan alone, not on time, machine load or worker.

    Parameters
    ----------
    plan, clip : what to build.
    root : folder of the benchmark.

    Raises
    ------
    HesimError
        If the clip cannot be rendered or written; nothing is left then.
    """
    folder = clip_folder(root, clip)
    if is_complete(root, clip):
        with reading(folder / CLIP_FILE, "as JSON"):
            content = WholeFile(folder / CLIP_FILE).json()
            return Built(clip.name, 0.0, sum(entry["bytes"] for entry in content["files"].values()))
    begin = time.monotonic()
    # another worker may finish the same clip first
    with OutputFolder(folder, CLIP_FILE, overwrite=True) as output:
        content = _fill(plan, clip, output.path, folder)
        with output_errors(folder):
            text = json.dumps(content, indent=1, sort_keys=True, ensure_ascii=False) + "\n"
            (output.path / CLIP_FILE).write_text(text, encoding="utf-8")
    discard_spans(folder)
    size = sum(entry["bytes"] for entry in content["files"].values())
    return Built(clip.name, time.monotonic() - begin, size)


def render_span(plan: BenchmarkPlan, clip: Clip, span: Span, root: Path) -> Built:
    """Render the light of a span of a clip into a journal that `build_clip` reads, unless that has been done.

    Parameters
    ----------
    plan, clip, root : see `build_clip`.
    span : one of `spans_of`.

    Raises
    ------
    HesimError
        If it cannot be rendered or written.
    """
    begin, folder, spec = time.monotonic(), clip_folder(root, clip), plan.spec
    if is_complete(root, clip):
        return Built(clip.name, 0.0, 0)
    with scratch(folder) as place:
        scene, _ = _scene(plan, clip, place)
        sensor, level = plan.sensor(clip), spec.noise[clip.noise]
        with span_journal(folder, span, _run_of(plan, clip, scene, sensor)) as journal:
            if is_rendered(journal, span):
                return Built(clip.name, 0.0, 0)
            flux = _renderer(plan, clip, scene, sensor)
            if not flux.is_static:  # the light of a static scene is one render, of which there are no spans
                flux.go_on(journal)
                last = span[1] if span[1] < spec.duration_us else float("inf")
                noise = noise_models(sensor, level.clean, level.without)
                Capture(flux, flux.sensor, *noise, spec.duration_us, spec.seeds[clip.seed]).render(span[0], last)
                if spec.sharp is not None:
                    source = _sharp_source(plan, clip, flux, sensor)
                    for middle, first in windows(sensor, spec.sharp, spec.duration_us):
                        if span[0] <= middle < last:
                            sharp_flux(source, sensor, spec.sharp, first)
            note_rendered(journal, span)
    return Built(clip.name, time.monotonic() - begin, 0)


def _scene(plan: BenchmarkPlan, clip: Clip, folder: Path) -> tuple[Scene, tuple[str, ...]]:
    """The scene of a clip and its parts; a generated one is written into a folder."""
    generated = plan.scene_files(clip)
    if generated is None:
        return plan.given_scene(clip), plan.given_parts(clip)
    with output_errors(folder):
        return load_scene(generated.write(folder / SCENE)), generated.parts


def _renderer(plan: BenchmarkPlan, clip: Clip, scene: Scene, sensor: Sensor) -> SceneRenderer:
    """The renderer of a clip."""
    spec = plan.spec
    quality = spec.quality if spec.samples is None else None
    seed = spec.seeds[clip.seed]
    return scene_renderer(in_absolute_light(scene)[0], sensor, seed, quality, spec.samples)


def _sharp_source(plan: BenchmarkPlan, clip: Clip, renderer: SceneRenderer, sensor: Sensor) -> FluxSource:
    """The light of the sharp images: with the crosstalk that the frames of the clip have."""
    level = plan.spec.noise[clip.noise]
    aps, _ = noise_models(sensor, level.clean, level.without)
    return with_crosstalk(renderer, sensor.layout.shape, 0.0 if aps is None else aps.crosstalk)


def _fill(plan: BenchmarkPlan, clip: Clip, folder: Path, target: Path) -> dict[str, Any]:
    """Render a clip into a folder, which will be `target`; returns its description."""
    spec = plan.spec
    scene, parts = _scene(plan, clip, folder)
    sensor, level = plan.sensor(clip), spec.noise[clip.noise]
    seed = spec.seeds[clip.seed]
    # one renderer for both: what rests is rendered once
    renderer = _renderer(plan, clip, scene, sensor)
    run, others = _run_of(plan, clip, scene, sensor), journals_in(target)
    # what has been traced, here and in spans, for a build that goes on within a long clip
    with Journal(target, run, overwrite=True, shared=True, after_s=_KEPT_AFTER_S, others=others) as journal:
        renderer.go_on(journal)
        recording = simulate(
            scene, sensor, duration_s=spec.duration_s, seed=seed, clean=level.clean, without=level.without,
            quality=spec.quality if spec.samples is None else None, samples=spec.samples, truth=spec.truth,
            audit=plan.is_audited(clip), renderer=renderer,
            out=folder / RECORDING, progress=False,
        )  # fmt: skip
        sharp = 0
        if spec.sharp is not None:
            with output_errors(folder):
                source = _sharp_source(plan, clip, renderer, sensor)
                asked = spec.sharp, spec.duration_us, seed, spec.quality
                sharp = write_sharp(folder / SHARP_FILE, source, sensor, *asked)
        if spec.sharp is not None and spec.sharp.colours and len(frame_filters(sensor)) > 1:
            with output_errors(folder):
                write_colours(folder / COLOURS_FILE, scene, sensor, spec.sharp, spec.duration_us, seed, spec.quality)
    manifest = recording.manifest
    return {
        "schema_version": SCHEMA,
        **clip.as_dict(),
        "seed": seed,
        "noise": level.name,
        "sensor": sensor.name,
        "scene_name": scene.name,
        "parts": list(parts),
        "counts": {**manifest["counts"], "sharp": sharp},
        "figures": figures(recording, scene, sensor),
        "render": manifest["settings"].get("render", {}),
        "versions": manifest["software"],
        "units": UNITS,
        "files": {
            path.relative_to(folder).as_posix(): {"sha256": WholeFile(path).sha256(), "bytes": path.stat().st_size}
            for path in sorted(folder.rglob("*"))
            if path.is_file()
        },
    }


def _run_of(plan: BenchmarkPlan, clip: Clip, scene: Scene, sensor: Sensor) -> dict[str, Any]:
    """All that the light of a clip depends on."""
    hashes = {"scene_hash": content_hash(scene.spec), "sensor_hash": content_hash(sensor.spec)}
    return {
        "spec": plan.spec.model_dump(mode="json"),
        "clip": clip.as_dict(),
        **hashes,
        "software": software_versions(),
    }
