"""Objects from mesh files: OBJ and PLY by Mitsuba, STL, GLB and glTF by trimesh."""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device_types import MitsubaModule
from hesim_render.core.errors import SpecError, how_to_install
from hesim_render.core.guard import WholeFile, leads_out, reading, require_memory, require_plain
from hesim_render.sources.render.scene.deformation import Deformation, read_deformation
from hesim_render.sources.render.scene.mitsuba_version import as_spec_error, make_mesh, transform
from hesim_render.sources.render.scene.pictures import picture_texture
from hesim_render.sources.render.scene.sizes import require_fits
from hesim_render.sources.render.scene.surfaces import area_emitter, radiance_of
from hesim_render.specs.scene import OUTSIDE, ObjectSpec, SceneSpec
from hesim_render.spectral.transfer import decode
from hesim_render.targets.piece import Picture

_OF_MITSUBA, _OF_TRIMESH = ("obj", "ply"), ("stl", "glb", "gltf")
#: What Mitsuba says of PLY files with larger faces, binary ones and those of text.
_NO_TRIANGLES = ("is this a triangle mesh", "trailing tokens after end of PLY file")
#: Memory of a texel while its colour becomes linear, three numbers of float64 in two arrays, bytes.
_TEXEL_BYTES = 48
#: Textures of glTF materials that are not rendered, by trimesh's name.
_UNUSED = {
    "metallicRoughnessTexture": "metallic and roughness texture",
    "normalTexture": "normal texture",
    "occlusionTexture": "occlusion texture",
    "emissiveTexture": "emission texture",
}


def mesh_shapes(
    mi: MitsubaModule,
    item: ObjectSpec,
    name: str,
    placement: NDArray[np.float64],
    bsdf: Any,
    folder: Path,
    allow_outside: bool,
) -> tuple[dict[str, Any], Deformation | None]:
    """Shapes of a mesh file, scaled to a bounding box of `size_m` and centred on the object's place, and its
    deformation, if it has one.

    Faces of GLB, glTF and STL files are flat. A material of a GLB or glTF file becomes Mitsuba's ``principled``: base
    colour (factor times texture) by its sRGB, metallic and roughness by their factors; its other keys (normal maps,
    emission, transparency, textures of roughness) are not used.

    Parameters
    ----------
    mi : the mitsuba module.
    item : the object.
    name : beginning of the names of the shapes.
    placement : [4, 4], pose of the object at rest.
    bsdf : surface of the object, or its dictionary, where `materials` is ``own``.
    folder : folder of the scene file.
    allow_outside : let a glTF file name files outside of this folder.

    Raises
    ------
    SpecError
        If the file is missing, cannot be read, or has no surface; or if the deformation does not fit it.
    """
    path, key = folder / str(item.mesh), f"objects.{item.name}.mesh"
    emitter = area_emitter(radiance_of(item))
    if not path.is_file():
        raise SpecError(f"no such mesh file: {path}", key=key)
    kind = path.suffix.lower().lstrip(".")
    if kind in _OF_MITSUBA:
        require_fits(path)
        try:
            with as_spec_error(path, key):
                shape = mi.load_dict({"type": kind, "filename": str(path)})
        except SpecError as error:
            if not any(said in str(error) for said in _NO_TRIANGLES):
                raise
            problem = "has no triangles alone: export triangles (Triangulated Mesh in Blender), or a GLB file"
            raise SpecError(problem, file=path, key=key) from None
        box = shape.bbox()
        low, high = np.array(box.min, dtype=np.float64), np.array(box.max, dtype=np.float64)
        fit = placement @ _fit(item, low, high, int(shape.face_count()), path, key)
        deformation = None
        if item.deformation is not None:
            deformation = read_deformation(mi, item.deformation, shape, fit, f"objects.{item.name}.deformation")
        shape = {"type": kind, "filename": str(path), "to_world": transform(mi, fit), "bsdf": bsdf}
        return {name: shape if emitter is None else {**shape, "emitter": emitter}}, deformation
    if kind not in _OF_TRIMESH:
        known = ", ".join(end.upper() for end in (*_OF_MITSUBA, *_OF_TRIMESH))
        raise SpecError(f"a mesh must be one of {known}, not {path.name}", key=key)
    parts = _load(path, kind, None if allow_outside else folder, key)
    corners = np.concatenate([part.vertices for part in parts] or [np.empty((0, 3))]).astype(np.float64)
    low, high = (corners.min(axis=0), corners.max(axis=0)) if len(corners) else (np.zeros(3), np.zeros(3))
    fit = placement @ _fit(item, low, high, sum(len(part.faces) for part in parts), path, key)
    meshes = {}
    for number, part in enumerate(parts):
        own = f"{name}_{number}"
        vertices = np.asarray(part.vertices, dtype=np.float64) @ fit[:3, :3].T + fit[:3, 3]
        uv = getattr(part.visual, "uv", None)
        surface = bsdf if item.materials == "own" else _principled(mi, part, path)
        meshes[own] = make_mesh(mi, own, vertices, np.asarray(part.faces, dtype=np.uint32), surface, uv, emitter)
    return meshes, None


def _fit(
    item: ObjectSpec, low: NDArray[np.float64], high: NDArray[np.float64], faces: int, path: Path, key: str
) -> NDArray[np.float64]:
    """The map from a file's own coordinates to a box of `size_m` about the origin."""
    extent = high - low
    if faces == 0 or not np.isfinite(extent).all() or np.count_nonzero(extent > 0) < 2:
        what = "no faces" if faces == 0 else "no extent" if np.isfinite(extent).all() else "corners that are not finite"
        raise SpecError(f"the mesh has {what}, so there is nothing to see", file=path, key=key)
    factors = np.divide(item.size_m, extent, out=np.ones(3), where=extent > 0)
    fit = np.diag([*factors, 1.0])
    fit[:3, 3] = -factors * (low + high) / 2
    return fit


def _load(path: Path, kind: str, root: Path | None, key: str) -> list[Any]:
    """All meshes of a file at their places in it.

    Parameters
    ----------
    root : folder that must contain the files which a glTF file names; None allows all.
    """
    try:
        import trimesh
        from trimesh.resolvers import FilePathResolver
    except ImportError:
        problem = f"{kind.upper()} files are read by trimesh, which is not installed: {how_to_install('meshes')}"
        raise SpecError(problem, file=path, key=key) from None

    class Beside(FilePathResolver):
        """Files in the folder of the scene alone."""

        def get(self, name: str) -> bytes:
            if root is not None and leads_out(root, path.parent / name):
                raise SpecError(f"{name!r} {OUTSIDE}", file=path, key=key)
            require_plain(path.parent / name)
            return super().get(name)

    content = io.BytesIO(WholeFile(path).read())
    with reading(path, "as a mesh"):
        loaded = trimesh.load_scene(content, file_type=kind, resolver=Beside(str(path)))
        return [part for part in loaded.dump() if isinstance(part, trimesh.Trimesh)]


@dataclass(frozen=True)
class FileMaterial:
    """A material of a GLB or glTF file as it is rendered.

    Parameters
    ----------
    part, name : names of the part and of its material in the file.
    base_color : linear sRGB, [3]; multiplies the texture, where there is one.
    has_texture : True if a texture of the base colour is used.
    metallic, roughness : of Mitsuba's ``principled``.
    unused : what else the material has, which is not rendered.
    """

    part: str
    name: str
    base_color: tuple[float, float, float]
    has_texture: bool
    metallic: float
    roughness: float
    unused: tuple[str, ...]

    def __str__(self) -> str:
        colour = ", ".join(f"{value:.3g}" for value in self.base_color)
        picture = " times a texture" if self.has_texture else ""
        left = f"; not used: {', '.join(self.unused)}" if self.unused else ""
        return (
            f"{self.part}: {self.name}, base colour ({colour}){picture}, metallic {self.metallic:.3g}, "
            f"roughness {self.roughness:.3g}{left}"
        )


def file_materials(spec: SceneSpec) -> dict[str, list[FileMaterial]]:
    """Materials of all objects that take them from their files, by the object's name, part by part.

    Raises
    ------
    SpecError
        If a file is missing or cannot be read.
    """
    materials = {}
    for item in spec.objects:
        if item.materials == "file":
            path = spec.folder / str(item.mesh)
            if not path.is_file():
                raise SpecError(f"no such mesh file: {path}", key=f"objects.{item.name}.mesh")
            root = None if spec.allow_outside or spec.file is None else spec.folder
            parts = _load(path, path.suffix.lower().lstrip("."), root, f"objects.{item.name}.mesh")
            materials[item.name] = [_material_of(part) for part in parts]
    return materials


def _pbr(part: Any) -> Any:
    """The material of a part in the terms of glTF; None if it has none."""
    material: Any = getattr(part.visual, "material", None)
    return material.to_pbr() if hasattr(material, "to_pbr") else material


def _material_of(part: Any) -> FileMaterial:
    material = _pbr(part)
    factor = getattr(material, "baseColorFactor", None)
    # trimesh has the linear factors of the file in steps of 1/255
    colour = np.ones(3) if factor is None else np.asarray(factor, dtype=np.float64)[:3]
    if factor is not None and np.asarray(factor).dtype.kind in "ui":
        colour = colour / 255
    red, green, blue = colour.tolist()
    metallic, rough = getattr(material, "metallicFactor", None), getattr(material, "roughnessFactor", None)
    textured = getattr(material, "baseColorTexture", None) is not None
    has_uv = getattr(part.visual, "uv", None) is not None
    unused = [description for key, description in _UNUSED.items() if getattr(material, key, None) is not None]
    glow = getattr(material, "emissiveFactor", None)
    if glow is not None and np.any(np.asarray(glow) > 0):
        unused.append("emission")
    if getattr(material, "alphaMode", None) not in (None, "OPAQUE"):
        unused.append("transparency")
    if textured and not has_uv:
        unused.append("base colour texture (the part has no u, v)")
    return FileMaterial(
        str(part.metadata.get("name") or part.metadata.get("node") or "part"),
        str(getattr(material, "name", None) or "without a name"),
        (red, green, blue),
        textured and has_uv,
        0.0 if metallic is None else float(metallic),
        0.5 if rough is None else max(float(rough), 0.02),
        tuple(unused),
    )


def _principled(mi: MitsubaModule, part: Any, path: Path) -> dict[str, Any]:
    """The material of a part as Mitsuba's."""
    material = _material_of(part)
    base: Any = {"type": "rgb", "value": list(material.base_color)}
    if material.has_texture:
        picture = _pbr(part).baseColorTexture
        require_memory(_TEXEL_BYTES * picture.width * picture.height, "the texture", path)
        codes = np.asarray(picture.convert("RGB"), dtype=np.float64) / 255
        base = picture_texture(mi, Picture((decode(codes, "srgb") * material.base_color).astype(np.float32), "srgb"))
    surface = {"type": "principled", "base_color": base, "metallic": material.metallic, "roughness": material.roughness}
    return {"type": "twosided", "material": surface}
