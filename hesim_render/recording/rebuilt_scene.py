"""The scene of a recording, made again from its manifest: geometric truth at any time."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hesim_render.core.errors import SpecError
from hesim_render.mosaic.layout import Layout
from hesim_render.recording import manifest as manifests
from hesim_render.sensor.lens import Lens
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.render.truth.scene_truth import SceneTruth
from hesim_render.sources.scene import Scene
from hesim_render.specs.files import content_hash
from hesim_render.specs.scene import SceneSpec


def geometry_of(manifest: Mapping[str, Any], folder: Path | None, scene: Scene | None) -> SceneTruth:
    """Geometry that the sensor of a recording sees.

    Parameters
    ----------
    manifest : the manifest.
    folder : folder of the recording, for errors; None for one in memory.
    scene : the scene; None makes it from the manifest. Its `labels` may be others than those of the recording.

    Raises
    ------
    SpecError
        If there is no scene (a video), `scene` is another one, or it names files that a manifest does not hold.
    """
    file = None if folder is None else folder / manifests.MANIFEST_NAME
    section = manifest["scene"]
    if section is None:
        raise SpecError("the recording was made from a video, which has no geometry", file=file)
    # classes, which no ray sees, may be others than those of the recording
    labels = {"labels": (section["spec"] or {}).get("labels", {})}
    if scene is None:
        scene = scene_of(section, file, "recording.truth_with(load_scene(PATH))")
    elif content_hash(scene.spec.model_copy(update=labels)) != section["sha256"]:
        raise SpecError(
            f"scene {scene.name!r} is not the one of the recording, {section['name']!r}, or was changed since",
            file=file,
        )
    spec, roi = manifests.sensor_spec(manifest, folder), manifest["roi"]
    layout = Layout(spec, roi["y"], roi["x"], roi["height_px"], roi["width_px"])
    sensor = Sensor(layout, Lens.of(spec)).without(manifests.lens_terms_off(manifest))
    return SceneTruth(scene, sensor)


def scene_of(section: Mapping[str, Any], file: Path | None, remedy: str) -> Scene:
    """The scene that a manifest holds.

    Parameters
    ----------
    section : the manifest's section on the scene.
    file : the manifest, for errors.
    remedy : how a scene that needs other files can be given.

    Raises
    ------
    SpecError
        If the scene needs files that a manifest does not hold, or is not valid.
    """
    if section.get("files_sha256"):
        raise SpecError(
            f"the scene needs files that are not in the recording ({', '.join(sorted(section['files_sha256']))}): give "
            f"the scene, {remedy}",
            file=file,
            key="scene.files_sha256",
        )
    return Scene(manifests.model_of(SceneSpec, section["spec"], file, "scene.spec"))
