"""A scene ready to render: its validated file, or a Mitsuba scene given directly."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from hesim_render.core.errors import SpecError
from hesim_render.specs.problems import spec_error
from hesim_render.specs.scene import CameraSpec, SceneSpec, TrackSpec, read_scene

#: Most things a short description names.
_MOST_PARTS = 6


@dataclass(frozen=True, repr=False)
class Scene:
    """What is seen, how it is lit, from where, and how it moves.

    Parameters
    ----------
    spec : the validated scene file.

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
        if moving:
            parts.append(f"moving: {', '.join(moving)}")
        if len(parts) > _MOST_PARTS:
            parts = [*parts[: _MOST_PARTS - 1], f"{len(parts) - _MOST_PARTS + 1} more"]
        return f"<Scene {self.name!r}: {'; '.join(parts)}>"

    @property
    def name(self) -> str:
        return self.spec.name

    @property
    def file(self) -> str:
        """The file it was read from, empty where it was given directly."""
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
    ) -> Scene:
        """A scene that Mitsuba itself can load.

        Parameters
        ----------
        scene : a dictionary as for ``mitsuba.load_dict`` (such as ``mitsuba.cornell_box()``), or the
            path of an XML file.
        camera : keys of `CameraSpec`; default the scene's first sensor, whose whole picture then just
            fits into the read-out region.
        motion : tracks (keys of `TrackSpec`) of shapes, by their id, and of ``camera``.
        max_depth : path length; default the scene's own path tracer with its depth, else 8.
        radiance_scale : multiplies all radiance, which is taken as W m⁻² sr⁻¹ nm⁻¹.
        illuminance_lux, irradiance_w_m2 : in its place: the level that all light of the scene together makes, lx or
            W m⁻² (360 to 830 nm), on the plane through `plane_point_m` [3] with the normal `plane_normal` [3].
        waveforms : flicker of emitters (keys of a scene file's ``waveform``), by the id of their shape or their own.
        allow_outside : let an XML file name files outside of its folder; a dictionary may.

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
    """A scene by shipped name (``hesim-render list scenes``) or path of a YAML file.

    Parameters
    ----------
    overrides : dotted keys and their values, applied before validation (``camera.f_number``).
    allow_outside : let the scene name files (spectra, meshes, textures, includes) outside of its folder.

    Examples
    --------
    >>> import hesim_render as hr
    >>> hr.load_scene("flat-field", {"light.illuminance_lux": 50}).spec.lights[0].illuminance_lux
    50.0

    Raises
    ------
    SpecError
        With file, line and key of what is wrong.
    """
    return Scene(read_scene(name_or_path, overrides, allow_outside))
