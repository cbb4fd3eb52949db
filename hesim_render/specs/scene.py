"""The scene file: geometry, lights, camera and motion.

Lengths are in metres, y is up. A target lies in the plane z = 0, its centre at the origin, its
face towards +z; the camera looks at it along −z with +x to the right of the image.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    Discriminator,
    Field,
    Tag,
    ValidationInfo,
    model_validator,
)

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import leads_out, reading
from hesim_render.core.yaml_file import read_yaml
from hesim_render.specs.files import NamedSpec, Strict, apply_overrides, locate, validate
from hesim_render.specs.geometry import Direction, Size, Vector
from hesim_render.specs.light import LampSpec, LightSpec
from hesim_render.specs.mitsuba_scene import MitsubaSpec
from hesim_render.specs.motion import DeformationSpec, TrackSpec
from hesim_render.specs.problems import line_of
from hesim_render.specs.reflectance import Count, MaterialSpec, ReflectanceSpec, TextureSpec
from hesim_render.specs.spectrum import SpectrumSpec
from hesim_render.specs.target import TargetSpec, lamps_of

#: Path of a file that a scene names.
OUTSIDE = "lies outside of the scene's folder; put it there, or let it (--allow-outside, allow_outside=True)"


class ObjectSpec(Strict):
    """A solid beside or in front of the target: diffuse, with a picture on it, or of a material of Mitsuba."""

    name: str = Field(min_length=1)
    shape: Literal["sphere", "box", "rectangle", "mesh"]
    size_m: Vector = Field((0.1, 0.1, 0.1), description="extent along x, y, z before rotation")
    position_m: Vector = (0.0, 0.0, 0.0)
    rotation_axis: Direction = (0.0, 1.0, 0.0)
    rotation_deg: float = Field(0.0, ge=-1e9, le=1e9)
    reflectance: ReflectanceSpec = SpectrumSpec(flat=0.5)
    pattern: ReflectanceSpec | None = Field(None, description="second reflectance: checks over the shape's own u, v")
    pattern_count: tuple[Count, Count] = (8, 8)
    texture: TextureSpec | None = Field(None, description="in place of reflectance: a picture over the shape's u, v")
    material: MaterialSpec | None = Field(None, description="in place of reflectance: a BSDF of Mitsuba")
    emission: LampSpec | None = Field(None, description="light that its surface gives, the same in all directions")
    mesh: str | None = Field(None, description="OBJ, PLY, STL, GLB or glTF file, relative to this file")
    materials: Literal["own", "file"] = Field(
        "own", description="of a mesh: the reflectance above, or the materials of a GLB or glTF file"
    )

    deformation: DeformationSpec | None = Field(None, description="of a PLY or OBJ mesh: its shape at other times")

    @model_validator(mode="after")
    def _check(self) -> "ObjectSpec":
        if (self.shape == "mesh") != (self.mesh is not None):
            raise ValueError("shape 'mesh' and the key 'mesh' go together")
        if self.materials == "file" and not str(self.mesh).lower().endswith((".glb", ".gltf")):
            raise ValueError("materials: only GLB and glTF files have materials that are read")
        if self.deformation is not None and not str(self.mesh).lower().endswith((".ply", ".obj")):
            raise ValueError("deformation: it is for meshes of PLY and OBJ files")
        surfaces = self.model_fields_set & {"reflectance", "texture", "material"}
        surfaces -= {key for key in surfaces if getattr(self, key) is None}
        if len(surfaces) + (self.materials == "file") > 1:
            raise ValueError("give one of reflectance, texture, material and materials: file")
        if self.pattern is not None and (self.texture is not None or self.material is not None):
            raise ValueError("pattern: it goes with reflectance")
        if min(self.size_m) < 0 or (min(self.size_m) == 0 and self.shape not in ("rectangle", "mesh")):
            raise ValueError("size_m must be above 0")
        if self.shape == "sphere" and len(set(self.size_m)) != 1:
            raise ValueError("a sphere's size_m is three times its diameter; use a mesh for an ellipsoid")
        return self


class CameraSpec(Strict):
    """Pose and lens of the camera. `fit: target` ignores `origin_m` and moves back along +z until the target fills the
    view.

    Focal length, f-number and focus default to the sensor file's lens; a value here replaces them.
    """

    fit: Literal["target"] | None = None
    fit_margin: float = Field(1.0, ge=1e-3, le=1e3, description="target size over view size; below 1 leaves a border")
    origin_m: Vector = (0.0, 0.0, 1.0)
    target_m: Vector = (0.0, 0.0, 0.0)
    up: Vector = (0.0, 1.0, 0.0)
    focal_length_mm: float | None = Field(None, ge=0.01, le=1e5)
    f_number: float | None = Field(None, ge=0.1, le=1000)
    horizontal_fov_deg: float | None = Field(
        None, ge=1e-4, lt=170, description="view across the read-out region; replaces the focal length"
    )
    focus_distance_m: Size | None = Field(None, description="default: distance from origin to target")

    @model_validator(mode="after")
    def _check(self) -> "CameraSpec":
        if self.focal_length_mm is not None and self.horizontal_fov_deg is not None:
            raise ValueError("give focal_length_mm or horizontal_fov_deg, not both")
        if self.fit is None and all(a == b for a, b in zip(self.origin_m, self.target_m, strict=True)):
            raise ValueError("origin_m and target_m are the same point")
        return self


def _check_parents(parents: Mapping[str, str | None]) -> None:
    """Refuse parents without a track, and objects that are their own ancestors."""
    for name, parent in parents.items():
        seen = [name]
        while parent is not None:
            if parent not in parents:
                raise ValueError(f"motion: {parent!r}, the parent of {seen[-1]!r}, has no track")
            if parent in seen:
                raise ValueError(f"motion: {' rides on '.join([*seen, parent])}")
            seen.append(parent)
            parent = parents[parent]


def _one_or_several(light: Any) -> str:
    return "several" if isinstance(light, list | tuple) else "one"


class SceneSpec(NamedSpec):
    """A whole scene file."""

    target: TargetSpec | None = None
    objects: list[ObjectSpec] = []
    mitsuba: MitsubaSpec | None = None
    light: (
        Annotated[
            Annotated[LightSpec, Tag("one")] | Annotated[tuple[LightSpec, ...], Tag("several"), Field(min_length=1)],
            Discriminator(_one_or_several),
        ]
        | None
    ) = Field(None, description="one light or a list")
    camera: CameraSpec | None = None
    motion: list[TrackSpec] = []
    labels: dict[str, Annotated[str, Field(min_length=1)] | None] = Field(
        {}, description="class of an object in boxes and masks, by its name; null: it has none"
    )
    max_depth: int | None = Field(
        None,
        ge=2,
        le=64,
        description="path length: 2 is direct light, more adds interreflection; default 2, 8 where an object has a "
        "material, or a Mitsuba scene's own",
    )
    folder: Path = Field(Path(), exclude=True)
    file: Path | None = Field(None, exclude=True)
    allow_outside: bool = Field(False, exclude=True)

    @model_validator(mode="before")
    @classmethod
    def _where_it_lies(cls, data: Any, info: ValidationInfo) -> Any:
        if isinstance(data, dict) and info.context:
            for key in ("folder", "file", "allow_outside"):
                if key in data:
                    raise ValueError(f"unknown key '{key}'")
        return data

    @model_validator(mode="after")
    def _check(self) -> "SceneSpec":
        tracks = [track.object for track in self.motion]
        if len(set(tracks)) != len(tracks):
            raise ValueError("motion: one track for each object; put all its keyframes into that")
        _check_parents({track.object: track.parent for track in self.motion})
        if self.mitsuba is not None:
            if self.target is not None or self.objects or any(light.type != "none" for light in self.lights):
                raise ValueError("a Mitsuba scene brings its own shapes and lights: drop target, objects and light")
            if self.camera is not None and self.camera.fit is not None:
                raise ValueError("camera.fit is 'target' but the scene has no target")
            return self
        if self.target is None and not self.objects:
            raise ValueError("a scene needs a target, objects or a Mitsuba scene")
        if self.light is None:
            raise ValueError("light is required (type 'none' is darkness)")
        if len(self.lights) > 1 and any(light.type == "none" for light in self.lights):
            raise ValueError("light: type 'none' is darkness and stands alone")
        kinds = [light.type for light in self.lights]
        if kinds.count("environment") + ("uniform" in kinds) > 1:
            raise ValueError("light: one environment, and no uniform light beside it (both come from everywhere)")
        if self.camera is None:
            raise ValueError("camera is required")
        if self.camera.fit == "target" and self.target is None:
            raise ValueError("camera.fit is 'target' but the scene has no target")
        names = [item.name for item in self.objects]
        if len(set(names)) != len(names) or "target" in names or "camera" in names:
            raise ValueError("objects: names must be unique and not 'target' or 'camera'")
        known = [*(["target"] if self.target else []), "camera", *names]
        for track in self.motion:
            if track.object not in known:
                raise ValueError(f"motion: no object {track.object!r} in the scene; there are {', '.join(known)}")
        seen = [each for each in known if each != "camera"]
        if unknown := [name for name in self.labels if name not in seen]:
            raise ValueError(f"labels: no object {unknown[0]!r} in the scene; there are {', '.join(seen)}")
        return self

    @property
    def named_lamps(self) -> list[tuple[str, LampSpec]]:
        """All that shines besides the lights, by key: the target, and objects."""
        target = lamps_of(self.target)
        own = [] if target is None else [("target", target)]
        return own + [(f"objects.{item.name}", item.emission) for item in self.objects if item.emission is not None]

    @property
    def lamps(self) -> tuple[LampSpec, ...]:
        """The values of `named_lamps`."""
        return tuple(lamp for _, lamp in self.named_lamps)

    @property
    def moves(self) -> bool:
        """True if something has a track, or changes its shape."""
        return bool(self.motion) or any(item.deformation is not None for item in self.objects)

    @property
    def depth(self) -> int:
        """Path length of a scene of this project's own objects."""
        return self.max_depth or (8 if any(item.material for item in self.objects) else 2)

    @property
    def lights(self) -> tuple[LightSpec, ...]:
        """All lights, none for a Mitsuba scene's own."""
        if self.light is None:
            return ()
        return (self.light,) if isinstance(self.light, LightSpec) else self.light


def read_scene(
    name_or_path: str | Path, overrides: Mapping[str, Any] | None = None, allow_outside: bool = False
) -> SceneSpec:
    """Read a scene file, by shipped name or path, with dotted `overrides` applied before validation.

    Parameters
    ----------
    name_or_path : name of a shipped scene, or path of a YAML file.
    overrides : dotted keys and their values.
    allow_outside : let the scene name files (spectra, meshes, textures, includes) outside its folder.

    Raises
    ------
    SpecError
        If the file is not valid; the message names file, line and key.
    """
    file = locate(name_or_path, "scenes")
    data, changes = read_yaml(file), overrides or {}
    if "pixels" in data and "tile" in data:
        raise SpecError("is a sensor file; expected a scene file", file=file)
    if not allow_outside:
        apply_overrides(data, changes)
        for location, name in _named_files(data):
            if any(leads_out(file.parent, path) for path in _with_inner(file.parent, name)):
                raise SpecError(
                    f"{name!r} {OUTSIDE}",
                    file=file,
                    line=line_of(data, location),
                    key=".".join(map(str, location)),
                )
    spec = validate(SceneSpec, data, file, changes)
    return spec.model_copy(update={"folder": file.parent, "file": file, "allow_outside": allow_outside})


def _with_inner(folder: Path, name: str) -> list[Path]:
    """A named file; of a folder, what is in it as well."""
    path = folder / name
    with reading(path):
        return [path, *path.iterdir()] if path.is_dir() else [path]


def _is_file(location: tuple[Any, ...]) -> bool:
    """True for the place of the name of a trajectory, of a picture on an object, or of one light of several."""
    return location[-1:] == ("file",) and location[0] in ("motion", "objects", "light")


def _named_files(node: Any, location: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], str]]:
    """Every file that a scene file names, with its place in it."""
    if isinstance(node, Mapping | list):
        for key, value in node.items() if isinstance(node, Mapping) else enumerate(node):
            yield from _named_files(value, (*location, key))
    elif isinstance(node, str):
        key = location[-1] if location else None
        files = ("mitsuba", "file"), ("target", "file"), ("target", "patches"), ("light", "file")
        if key in ("csv", "mesh", "filename") or location in files or node.endswith(".csv") or _is_file(location):
            yield location, node
