"""A scene ready to render: its validated file, or a Mitsuba scene given directly, and its parts by waveform."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from hesim_render.core.errors import ConflictError, RangeError, SpecError
from hesim_render.core.html import table
from hesim_render.core.shipped import list_names
from hesim_render.sensor.sensor import Sensor, as_sensor
from hesim_render.specs.light import WaveformSpec
from hesim_render.specs.motion import TrackSpec
from hesim_render.specs.problems import spec_error
from hesim_render.specs.scene import CameraSpec, SceneSpec, read_scene
from hesim_render.specs.target import lamps_of
from hesim_render.spectral.waveform import Waveform

#: Largest number of parts that a short description names.
_MOST_PARTS = 6


@dataclass(frozen=True, repr=False)
class Scene:
    """Geometry, lights, camera and motion of a scene.

    Parameters
    ----------
    spec : validated content of the scene file.

    Examples
    --------
    >>> import hesim_render as hr
    >>> hr.load_scene("rotating-star")
    <Scene 'rotating-star': target siemens-star; object wall; light uniform; moving: target>
    """

    spec: SceneSpec

    def __repr__(self) -> str:
        spec = self.spec
        if spec.mitsuba is not None:
            parts = ["a scene of Mitsuba's"]
        else:
            parts = [] if spec.target is None else [f"target {spec.target.type}"]
            parts += [f"object {item.name}" for item in spec.objects]
            parts += [f"light {light.type}" for light in spec.lights]
        moving = [track.object for track in spec.motion]
        moving += [item.name for item in spec.objects if item.deformation is not None and item.name not in moving]
        if moving:
            parts.append(f"moving: {', '.join(moving)}")
        if len(parts) > _MOST_PARTS:
            parts = [*parts[: _MOST_PARTS - 1], f"{len(parts) - _MOST_PARTS + 1} more"]
        return f"<Scene {self.name!r}: {'; '.join(parts)}>"

    def _repr_html_(self) -> str:
        rows = [("scene", self.name), ("description", self.spec.description), ("content", repr(self)[1:-1])]
        return table(("", ""), rows)

    @property
    def name(self) -> str:
        """Name of the scene, from its file."""
        return self.spec.name

    @property
    def file(self) -> str:
        """Path of the scene file; empty if the scene was given directly."""
        return str(self.spec.file) if self.spec.file else ""

    @classmethod
    def from_mitsuba(
        cls,
        scene: Mapping[str, Any] | str | Path,
        *,
        camera: CameraSpec | Mapping[str, Any] | None = None,
        motion: Sequence[TrackSpec | Mapping[str, Any]] = (),
        max_depth: int | None = None,
        radiance_scale: float = 1.0,
        illuminance_lux: float | None = None,
        irradiance_w_m2: float | None = None,
        plane_point_m: Sequence[float] | None = None,
        plane_normal: Sequence[float] | None = None,
        waveforms: Mapping[str, Any] | None = None,
        name: str = "mitsuba",
        allow_outside: bool = False,
    ) -> "Scene":
        """A scene in Mitsuba's own format.

        Parameters
        ----------
        scene : a dictionary as for ``mitsuba.load_dict`` (such as ``mitsuba.cornell_box()``), or the
            path of an XML file.
        camera : keys of `CameraSpec`. Default: the first sensor of the scene, with its whole picture fitted
            into the read-out region.
        motion : tracks (keys of `TrackSpec`) of shapes, by their id, and of ``camera``.
        max_depth : path length. Default: the depth of the scene's own path tracer, else 8.
        radiance_scale : factor on all radiance, which is then taken as W m⁻² sr⁻¹ nm⁻¹.
        illuminance_lux, irradiance_w_m2 : instead of `radiance_scale`: level that all light of the scene together
            makes on a plane, lx or W m⁻² (360 to 830 nm).
        plane_point_m, plane_normal : [3] each, a point and the normal of that plane, m.
        waveforms : flicker of emitters (keys of a scene file's ``waveform``), by the id of the emitter or of its shape.
        name : name of the scene.
        allow_outside : let an XML file name files outside its own folder. A dictionary always may.

        Returns
        -------
        The scene. Mitsuba loads it when it is rendered.

        Raises
        ------
        SpecError
            If the camera, the motion or the level is not valid, or the file is missing.
        """
        source: dict[str, Any] = {
            "radiance_scale": radiance_scale,
            "illuminance_lux": illuminance_lux,
            "irradiance_w_m2": irradiance_w_m2,
            "plane_point_m": plane_point_m,
            "plane_normal": plane_normal,
            "waveforms": dict(waveforms or {}),
        }
        if isinstance(scene, Mapping):
            source["inline"] = dict(scene)
        else:
            if not Path(scene).is_file():
                raise SpecError("no such file", file=scene)
            source["file"] = str(Path(scene).resolve())
        content = {
            "schema_version": 1,
            "name": name,
            "description": "a Mitsuba scene",
            "mitsuba": source,
            "camera": camera,
            "motion": list(motion),
            "max_depth": max_depth,
            "allow_outside": allow_outside,
        }
        try:
            return cls(SceneSpec.model_validate(content))
        except ValidationError as error:
            raise spec_error(error, SceneSpec, content) from None


def load_scene(
    name_or_path: str | Path, overrides: Mapping[str, Any] | None = None, *, allow_outside: bool = False
) -> Scene:
    """Load a shipped scene by name (``hesim-render info scenes``), or a scene file by path.

    Parameters
    ----------
    name_or_path : name of a shipped scene, or path of a YAML file.
    overrides : dotted keys and their values, applied before validation (``camera.f_number``).
    allow_outside : let the scene name files (spectra, meshes, textures, includes) outside its own folder.

    Examples
    --------
    >>> import hesim_render as hr
    >>> hr.load_scene("flat-field", {"light.illuminance_lux": 50}).spec.lights[0].illuminance_lux
    50.0

    Returns
    -------
    The scene.

    Raises
    ------
    SpecError
        If the file is not valid; the message names file, line and key.
    """
    return Scene(read_scene(name_or_path, overrides, allow_outside))


def scene_and_sensor(scene: Scene | str | Path, sensor: Sensor | str | Path) -> tuple[Scene, Sensor]:
    """Scene and sensor as they are, or loaded by their names or paths.

    Raises
    ------
    ConflictError
        If they are swapped.
    RangeError
        If something else is given.
    SpecError
        If a file is not valid.
    """
    if _is_a(scene, Sensor, "sensors", "scenes") or _is_a(sensor, Scene, "scenes", "sensors"):
        raise ConflictError("scene", scene, f"the scene comes first, then the sensor; given were {scene!r}, {sensor!r}")
    if isinstance(scene, str | Path):
        scene = load_scene(scene)
    if not isinstance(scene, Scene):
        raise RangeError(
            "scene", scene, "a scene from load_scene or Scene.from_mitsuba, a name, or the path of a scene file"
        )
    return scene, as_sensor(sensor)


def _is_a(given: object, kind: type, names: str, others: str) -> bool:
    """True for an object of a kind, and for a name that only things of this kind have."""
    return isinstance(given, kind) or (str(given) in list_names(names) and str(given) not in list_names(others))


def light_parts(scene: Scene) -> list[tuple[Waveform | None, Scene]]:
    """The scene once per different waveform, lit only by the lights with that waveform; lights without one come first.

    A scene without flicker is one part, the scene itself. A level of a Mitsuba scene holds for all of its light
    together, so it must already be converted to a factor (`in_absolute_light`).
    """
    own = scene.spec.mitsuba
    if own is not None:
        assert not own.has_level
        return _mitsuba_parts(scene)
    shining: list[Any] = [*scene.spec.lights, *scene.spec.lamps]
    flickering = [_flicker(light.waveform) for light in shining]
    if not any(flickering):
        return [(None, scene)]
    parts: list[tuple[Waveform | None, Scene]] = []
    for kind in _different(flickering):
        lights = [
            light.model_copy(update={"waveform": None}) if has == kind else light.switched_off()
            for light, has in zip(shining, flickering, strict=True)
        ]
        if any(light.is_on for light in lights):
            parts.append((kind.load() if kind else None, _with_lights(scene, lights)))
    return parts or [(None, scene)]


def _flicker(spec: WaveformSpec | None) -> WaveformSpec | None:
    """A waveform that changes, or None."""
    return None if spec is None or spec.load().is_constant else spec


def _different(kinds: Sequence[WaveformSpec | None]) -> list[WaveformSpec | None]:
    """Each waveform once, None first."""
    result: list[WaveformSpec | None] = [None] if None in kinds else []
    for kind in kinds:
        if kind not in result:
            result.append(kind)
    return result


def _with_lights(scene: Scene, lights: Sequence[Any]) -> Scene:
    """The scene with other lights: its own, then the target if that shines, then its objects that shine."""
    left = iter(lights)
    update: dict[str, Any] = {"light": tuple(next(left) for _ in scene.spec.lights)}
    if lamps_of(scene.spec.target) is not None:
        update["target"] = next(left)
    update["objects"] = [
        item if item.emission is None else item.model_copy(update={"emission": next(left)})
        for item in scene.spec.objects
    ]
    return Scene(scene.spec.model_copy(update=update))


def _mitsuba_parts(scene: Scene) -> list[tuple[Waveform | None, Scene]]:
    own = scene.spec.mitsuba
    assert own is not None
    named = {name: spec for name, spec in own.waveforms.items() if _flicker(spec) is not None}
    if not named:
        return [(None, scene)]
    parts: list[tuple[Waveform | None, Scene]] = []
    for kind in _different([None, *named.values()]):
        lights = (
            {"unlit": (*own.unlit, *named)}
            if kind is None
            else {"lit": tuple(name for name, spec in named.items() if spec == kind and own.may_shine(name))}
        )
        part = own.model_copy(update={"waveforms": {}, **lights})
        parts.append((kind.load() if kind else None, Scene(scene.spec.model_copy(update={"mitsuba": part}))))
    return parts
