"""One clip of a benchmark, built into a folder that appears whole or not at all."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hesim_render.benchmark.colour_truth import COLOURS_FILE, frame_filters, write_colours
from hesim_render.benchmark.generator import file_hash
from hesim_render.benchmark.plan import Clip, Plan
from hesim_render.benchmark.sharp import SHARP_FILE, write_sharp
from hesim_render.benchmark.statistics import figures
from hesim_render.capture.noise_terms import noise_models
from hesim_render.capture.simulate import flux_source, go_on, simulate
from hesim_render.core.journal import Journal
from hesim_render.core.output import OutputFolder, output_errors
from hesim_render.recording.manifest import software_versions
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.crosstalk import with_crosstalk
from hesim_render.sources.render.light_level import in_absolute_light
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
    seconds, bytes : time and size; the time is that of an earlier run, 0, where the clip was there already.
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


def build_clip(plan: Plan, clip: Clip, root: Path) -> Built:
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
        content = json.loads((folder / CLIP_FILE).read_text(encoding="utf-8"))
        return Built(clip.name, 0.0, sum(entry["bytes"] for entry in content["files"].values()))
    begin = time.monotonic()
    output = OutputFolder(folder, CLIP_FILE, overwrite=True)  # another worker may finish the same clip first
    try:
        content = _fill(plan, clip, output.path, folder)
        with output_errors(folder):
            text = json.dumps(content, indent=1, sort_keys=True, ensure_ascii=False) + "\n"
            (output.path / CLIP_FILE).write_text(text, encoding="utf-8")
        output.commit()
    except BaseException:
        output.discard()
        raise
    size = sum(entry["bytes"] for entry in content["files"].values())
    return Built(clip.name, time.monotonic() - begin, size)


def _fill(plan: Plan, clip: Clip, folder: Path, target: Path) -> dict[str, Any]:
    """Render a clip into a folder, which will be `target`; returns its description."""
    spec, generated = plan.spec, plan.scene_files(clip)
    if generated is not None:
        with output_errors(folder):
            scene = load_scene(generated.write(folder / SCENE))
        parts = generated.parts
    else:
        scene, parts = plan.given_scene(clip), plan.given_parts(clip)
    sensor, level = plan.sensor(clip), spec.noise[clip.noise]
    seed = spec.seeds[clip.seed]
    # one renderer for both: what rests is rendered once
    quality = spec.quality if spec.samples is None else None
    renderer = flux_source(in_absolute_light(scene)[0], sensor, seed, quality, spec.samples, False, None)
    with _journal(plan, clip, target, scene, sensor) as journal:
        go_on(renderer[0], journal)
        recording = simulate(
            scene, sensor, duration_s=spec.duration_s, seed=seed, clean=level.clean, without=level.without,
            quality=quality, samples=spec.samples, truth=spec.truth, audit=plan.is_audited(clip), renderer=renderer,
            out=folder / RECORDING, progress=False,
        )  # fmt: skip
        sharp = 0
        if spec.sharp is not None:
            with output_errors(folder):
                aps, _ = noise_models(sensor, level.clean, level.without)
                source = with_crosstalk(renderer[0], sensor.layout.shape, 0.0 if aps is None else aps.crosstalk)
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
            path.relative_to(folder).as_posix(): {"sha256": file_hash(path), "bytes": path.stat().st_size}
            for path in sorted(folder.rglob("*"))
            if path.is_file()
        },
    }


def _journal(plan: Plan, clip: Clip, target: Path, scene: Scene, sensor: Sensor) -> Journal:
    """What the renderer of a clip has traced, for a build that goes on within a long clip."""
    hashes = {"scene_hash": content_hash(scene.spec), "sensor_hash": content_hash(sensor.spec)}
    run = {"spec": plan.spec.model_dump(mode="json"), "clip": clip.as_dict(), **hashes, "software": software_versions()}
    return Journal(target, run, overwrite=True, shared=True, after_s=_KEPT_AFTER_S)
