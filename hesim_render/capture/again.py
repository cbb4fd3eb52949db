"""A recording made again from its manifest alone."""

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal, TypedDict, Unpack

from hesim_render.capture.simulate import simulate
from hesim_render.core import backend
from hesim_render.core.errors import HesimWarning, SpecError
from hesim_render.core.progress import Progress
from hesim_render.core.units import S_PER_US
from hesim_render.mosaic.layout import Layout
from hesim_render.recording import manifest as manifests
from hesim_render.recording.rebuilt_scene import scene_of
from hesim_render.recording.recording import Recording, as_recording
from hesim_render.sensor.lens import Lens
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.scene import Scene
from hesim_render.specs.files import content_hash


class RerunOptions(TypedDict, total=False):
    """Options of `simulate` that do not change the result."""

    overwrite: bool
    progress: Progress | Literal[False] | None
    on_estimate: Callable[[object], None] | None
    max_minutes: float | None
    resume: bool


def simulate_again(
    recording: Recording | str | Path,
    out: str | Path | None = None,
    scene: Scene | None = None,
    **options: Unpack[RerunOptions],
) -> Recording:
    """Simulate a recording again: same scene, sensor, region, times, seed, terms and quality.

    On the same backend and versions every file has the same bytes; otherwise a `HesimWarning` names what differs.

    Parameters
    ----------
    recording : a recording of a scene, or its folder.
    out : folder of the new one; None keeps it in memory.
    scene : the scene, if it needs files that a recording does not hold.
    options : `overwrite`, `progress`, `on_estimate`, `max_minutes` and `resume` of `simulate`.

    Raises
    ------
    SpecError
        If the recording is of a video, is imported or calibrated, does not begin at 0, or needs another scene.
    OutputError
        If `out` exists or cannot be written.
    """
    recording = as_recording(recording)
    manifest, folder = recording.manifest, recording.path
    file = None if folder is None else folder / manifests.MANIFEST_NAME
    settings, stored = manifest["settings"], manifest.get("scene")
    if stored is None or "mode" not in settings:
        raise SpecError("only a recording of a scene can be made again; this one is of a video, or imported", file=file)
    if manifest["time"]["begin_us"] != 0:
        raise SpecError(
            "the recording goes on from an earlier run, whose state it does not hold", file=file, key="time"
        )
    spec = manifests.sensor_spec(manifest, folder)
    if spec.noise is not None:
        raise SpecError("the sensor is calibrated, and the maps of its calibration are not in the recording", file=file,
                        key="sensor.spec.noise")  # fmt: skip
    if scene is None:
        scene = scene_of(stored, file, "--scene PATH, or scene=load_scene(PATH)")
    elif content_hash(scene.spec) != stored["sha256"]:
        raise SpecError(
            f"scene {scene.name!r} is not the one of the recording, {stored['name']!r}, or was changed since", file=file
        )
    roi = manifest["roi"]
    layout = Layout(spec, roi["y"], roi["x"], roi["height_px"], roi["width_px"])
    sensor = Sensor(layout, Lens.of(spec), manifest["sensor"]["file"])
    truth = settings.get("truth") or {}
    exact = settings["mode"] == "exact" and "exact_because" not in settings
    again = simulate(
        scene, sensor, duration_s=manifest["time"]["end_us"] * S_PER_US, seed=manifest["seed"], clean=settings["clean"],
        without=settings["without"], quality=None if settings["mode"] == "exact" else settings["quality"],
        exact=exact, samples=settings["samples"] if exact else None, truth=truth.get("kinds", ()),
        truth_every_us=truth.get("every_us"), out=out, **options,
    )  # fmt: skip
    _warn_of_differences(manifest, again.manifest)
    return again


def _warn_of_differences(before: Mapping[str, Mapping[str, object]], now: Mapping[str, Mapping[str, object]]) -> None:
    """Warn where other software or another backend may give other bits."""
    others = [
        f"{name} {before['software'].get(name, 'none')} and now {version}"
        for name, version in now["software"].items()
        if before["software"].get(name) != version
    ]
    if before["settings"].get("backend") != now["settings"].get("backend"):
        others.append(f"backend {before['settings'].get('backend')} and now {backend.select().describe()}")
    if others:
        warnings.warn(
            f"made with {'; '.join(others)}: values may differ in their last bits", HesimWarning, stacklevel=3
        )
