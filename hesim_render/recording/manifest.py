"""``recording.json``: specifications, seed, versions and units of a recording; written, read and checked."""

import json
import platform
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ValidationError

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import WholeFile, inside
from hesim_render.mosaic import description as mosaic
from hesim_render.recording.dng import noise_profile
from hesim_render.recording.manifest_spec import RecordingSpec
from hesim_render.specs.files import Model, content_hash, validate
from hesim_render.specs.lens import LENS_TERMS
from hesim_render.specs.light import mixed_light
from hesim_render.specs.reflectance import TextureSpec, leaves_of
from hesim_render.specs.scene import SceneSpec
from hesim_render.specs.sensor import SensorSpec

if TYPE_CHECKING:
    from hesim_render.sensor.sensor import Sensor

MANIFEST_NAME = "recording.json"
SCHEMA_VERSION = 1

UNITS = {
    "raw": "DN",
    "electrons_mean": "e-, noise-free signal of the frame's exposure",
    "electrons_stderr": "e-, standard error of electrons_mean (Monte-Carlo render)",
    "flux_mean_e_per_s": "e-/s, mean noise-free flux of an event pixel over the recording",
    "flux_stderr_e_per_s": "e-/s, standard error of flux_mean_e_per_s",
    "t_us": "µs from the start; the end of an integration window (of row 0 for a frame)",
    "exposure_start_us": "µs, begin of row 0's exposure",
    "exposure_us": "µs",
    "line_time_us": "µs from one row's exposure to the next; 0 for a global shutter",
    "x": "column of the event grid, 0 at the left",
    "y": "row of the event grid, 0 at the top",
    "polarity": "+1 ON, -1 OFF (events.h5: p 1 and 0)",
}

MASKS = {
    "truth/valid.npy": "bool [row, col]: True where the pixel gives a frame value; elsewhere raw is 0 and the "
    "truth of frames is NaN",
}


def build(
    sensor: "Sensor",
    *,
    scene: SceneSpec | None,
    seed: int,
    duration_us: int,
    settings: Mapping[str, Any],
    begin_us: int = 0,
) -> dict[str, Any]:
    """The manifest of a new recording; frames and counts are added as it grows."""
    layout, spec = sensor.layout, sensor.spec
    light = None if scene is None else mixed_light(scene.lights)
    if light is None and scene is not None and scene.lamps:
        light = scene.lamps[0].illuminant.load()
    described = mosaic.describe(sensor, light)
    if not settings.get("clean"):
        profile = noise_profile(sensor, settings.get("without", ()))
        described = described.model_copy(update={"noise_profile": profile})
    return {
        "schema_version": SCHEMA_VERSION,
        "software": software_versions(),
        "seed": seed,
        "settings": dict(settings),
        "time": {"begin_us": begin_us, "end_us": begin_us + duration_us},
        "roi": {"x": layout.col0, "y": layout.row0, "width_px": layout.cols, "height_px": layout.rows},
        "event_grid": {"width": layout.evs_shape[1], "height": layout.evs_shape[0]},
        "mosaic": described.model_dump(mode="json"),
        "lens": {
            "f_number": sensor.lens.f_number,
            "focal_length_mm": sensor.lens.focal_length_mm,
            "magnification": sensor.lens.magnification,
            "axis_mm": list(sensor.lens.axis_mm),
            "effects": spec.lens.without(sensor.lens.off).used_effects(),
        },
        "sensor": {"name": spec.name, "file": sensor.file, "sha256": content_hash(spec), "spec": _dump(spec)},
        "scene": None
        if scene is None
        else {
            "name": scene.name,
            "sha256": content_hash(scene),
            "files_sha256": _file_hashes(scene),
            "spec": _dump(scene),
        },
        "counts": {"frames": 0, "events": 0, "events_on": 0, "events_off": 0, "events_dropped": 0},
        "frames": [],
        "units": UNITS,
        "masks": MASKS,
    }


def _dump(spec: BaseModel) -> dict[str, Any]:
    return spec.model_dump(mode="json", exclude_none=True)


def _file_hashes(scene: SceneSpec) -> dict[str, str]:
    """SHA-256 of each file of geometry, pictures and patches that a scene names (a Mitsuba XML file's own includes are
    not followed).
    """
    names = [None if scene.mitsuba is None else scene.mitsuba.file, *(item.mesh for item in scene.objects)]
    # targets of two kinds are made from files
    names += [getattr(scene.target, key, None) for key in ("file", "patches")]
    names += [light.file for light in scene.lights]
    for item in scene.objects:
        names += [item.texture.file if item.texture is not None else None]
        names += item.deformation.files if item.deformation is not None else []
        names += [texture.file for _, texture in leaves_of(item.material or {}, TextureSpec)]
        names += [name for key, name in leaves_of(item.material or {}, str) if key.split(".")[-1] == "filename"]
    return {name: WholeFile(scene.folder / name).sha256() for name in names if name is not None}


def software_versions() -> dict[str, str]:
    """Versions of all software whose change may change the bits of a recording."""
    result = {"python": platform.python_version()}
    for name in ("hesim_render", "mitsuba", "drjit", "numpy"):
        try:
            result[name] = version(name)
        except PackageNotFoundError:
            result[name] = "unknown"
    return result


def to_text(value: Any, indent: str = "") -> str:
    """JSON, indented, with lists of plain values on one line."""
    deeper = indent + "  "
    if isinstance(value, Mapping) and value:
        items = [f"{json.dumps(str(k), ensure_ascii=False)}: {to_text(v, deeper)}" for k, v in value.items()]
    elif isinstance(value, list | tuple) and any(isinstance(item, Mapping | list | tuple) for item in value):
        items = [to_text(item, deeper) for item in value]
    else:
        return json.dumps(value, ensure_ascii=False)
    begin, end = "{}" if isinstance(value, Mapping) else "[]"
    body = ",".join(f"\n{deeper}{item}" for item in items)
    return f"{begin}{body}\n{indent}{end}"


def read(folder: Path) -> dict[str, Any]:
    """Read the manifest of a recording folder and check it against `RecordingSpec`.

    Raises
    ------
    SpecError
        If it is not a recording, or has another schema; the message names the key.
    """
    file = folder / MANIFEST_NAME
    if not file.is_file():
        raise SpecError(f"is not a recording (no {MANIFEST_NAME} in it)", file=folder)
    manifest = WholeFile(inside(folder, MANIFEST_NAME)).json()
    result = manifest.get("schema_version") if isinstance(manifest, dict) else None
    if result != SCHEMA_VERSION or isinstance(result, bool):
        raise SpecError(f"schema_version is {result!r}; this version reads {SCHEMA_VERSION}", file=file)
    return validate(RecordingSpec, manifest, file, {}).model_dump(mode="json", exclude_unset=True)


def lens_terms_off(manifest: Mapping[str, Any]) -> list[str]:
    """Effects of the lens that were switched off in a run, such as ``lens.distortion``."""
    return [term for term in manifest["settings"].get("without", []) if term in LENS_TERMS]


def sensor_spec(manifest: Mapping[str, Any], folder: Path | None = None) -> SensorSpec:
    """The sensor of a recording, without the path of its calibration.

    Parameters
    ----------
    manifest : the manifest.
    folder : folder of the recording, for the error.

    Raises
    ------
    SpecError
        If the manifest holds no sensor that this version knows.
    """
    file = None if folder is None else folder / MANIFEST_NAME
    return model_of(SensorSpec, manifest["sensor"]["spec"], file, "sensor.spec")


def model_of(model: type[Model], content: Any, file: Path | None, place: str) -> Model:
    """The model of a part of a manifest.

    Parameters
    ----------
    model, content : what is made of what.
    file, place : the manifest and the dotted key of the part, for the error.

    Raises
    ------
    SpecError
        If the content is not valid; the message names the first wrong key.
    """
    try:
        return model.model_validate(content)
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        key = ".".join([place, *map(str, problem["loc"])])
        raise SpecError(problem["msg"].removeprefix("Value error, "), file=file, key=key) from None
