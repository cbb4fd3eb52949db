"""Surfaces of a scene file's objects: paint, pictures, and materials of Mitsuba."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hesim_render.core.device_types import MitsubaModule, MitsubaObject
from hesim_render.core.errors import SpecError
from hesim_render.sources.render.scene.files import require_material
from hesim_render.sources.render.scene.mitsuba_version import as_spec_error, spectrum_dict, transform
from hesim_render.sources.render.scene.pictures import TextureData, picture_texture
from hesim_render.sources.render.scene.plugin_tables import HONOURED, REFUSED
from hesim_render.sources.render.scene.sizes import require_fits
from hesim_render.specs.reflectance import TextureSpec
from hesim_render.specs.scene import ObjectSpec, SceneSpec
from hesim_render.specs.spectrum import SpectrumSpec
from hesim_render.spectral.spectrum import Spectrum, constant
from hesim_render.targets.cube import read_picture
from hesim_render.targets.piece import Picture

#: Most numbers of all pictures of a scene whose texels are integrated for each light and filter, 256 MiB of them.
_MOST_ENTRIES = 1 << 26
#: Shapes without an inside; both of their sides are visible.
_OPEN_SHAPES = ("rectangle", "mesh")


@dataclass(frozen=True)
class Paint:
    """Paint of a shape: one diffuse colour, a checkerboard of two, or a picture.

    Parameters
    ----------
    shape : name of the shape in the Mitsuba scene.
    colours : one or two reflectances; 1 with a picture.
    scale : factors on (u, v) of the shape; the squares of the checkerboard then have a side of one half, the picture
        one of 1.
    two_sided : True if the back is painted as well; otherwise the back is black.
    picture : reflectances by place; None for none.
    repeats : True if the picture is seen again beyond 0 to 1, False if its rim is.
    """

    shape: str
    colours: tuple[Spectrum, ...]
    scale: tuple[float, float] = (1.0, 1.0)
    two_sided: bool = False
    picture: Picture | TextureData | None = None
    repeats: bool = False


def is_diffuse(item: ObjectSpec) -> bool:
    """True if an object is diffuse, of one or two colours or with a picture."""
    return item.material is None and item.materials == "own"


def reflects_diffusely(mi: MitsubaModule, bsdf: MitsubaObject | None) -> bool:
    """True if a BSDF has neither gloss nor mirror, glass or holes, so that rays of a pixel hardly differ on it; False
    without a BSDF.
    """
    flags = None if bsdf is None else bsdf.flags()
    others = mi.BSDFFlags.Glossy, mi.BSDFFlags.Delta, mi.BSDFFlags.Delta1D
    return flags is not None and not any(mi.has_flag(flags, other) for other in others)


def picture_of(item: ObjectSpec) -> Picture | None:
    """The picture on an object, read from its file; None for none."""
    return None if item.texture is None else read_picture(item.texture, f"objects.{item.name}.texture")


def pictured(shape: str, picture: Picture, repeat: tuple[int, int] | None = None, two_sided: bool = False) -> Paint:
    """The paint of a shape whose picture is seen `repeat` times along u and v; None: once, and its rim beyond."""
    across, up = repeat or (1, 1)
    white = constant(1.0)
    return Paint(shape, (white,), (float(across), float(up)), two_sided, picture, repeat is not None)


def paint_of(item: ObjectSpec, name: str, picture: Picture | None) -> Paint:
    """The paint of a diffuse object's shape; `picture` is the object's."""
    if picture is not None and item.texture is not None:
        return pictured(name, picture, item.texture.repeat, item.shape in _OPEN_SHAPES)
    colours = [source.load() for source in (item.reflectance, item.pattern) if source is not None]
    u, v = item.pattern_count
    return Paint(name, tuple(colours), (u / 2, v / 2), two_sided=item.shape in _OPEN_SHAPES)


def are_few(paints: Sequence[Paint], colours: int) -> bool:
    """True if the texels of all pictures fit into memory with `colours` numbers each, one for each light and filter; a
    grey texel has one.
    """
    pictures = {paint.picture for paint in paints if paint.picture is not None}
    sizes = [picture.values[..., 0].size * (1 if picture.kind == "grey" else colours) for picture in pictures]
    return sum(sizes) <= _MOST_ENTRIES


def radiance_of(item: ObjectSpec) -> Spectrum | None:
    """Radiance that an object's surface gives, W m⁻² sr⁻¹ nm⁻¹; None if it gives none."""
    return item.emission.radiance() if item.emission is not None and item.emission.is_on else None


def area_emitter(radiance: Spectrum | None) -> dict[str, Any] | None:
    """The emitter of a surface that gives a radiance in all directions of its outside."""
    return None if radiance is None else {"type": "area", "radiance": spectrum_dict(radiance)}


def bsdf_of(mi: MitsubaModule, item: ObjectSpec, spec: SceneSpec, picture: Picture | None) -> Any:
    """BSDF of an object, which may have a picture, or its dictionary for Mitsuba. Open shapes that reflect only do so
    on both sides.

    Raises
    ------
    SpecError
        If the material is no BSDF that is rendered, Mitsuba refuses its keys, or a file cannot be read.
    """
    key = f"objects.{item.name}.material"
    if item.material is not None:
        bsdf = _plugin(mi, item.material, item, spec, key, "BSDF")
    elif picture is not None and item.texture is not None:
        bsdf = {"type": "diffuse", "reflectance": picture_texture(mi, picture, item.texture.repeat)}
    else:
        bsdf = {"type": "diffuse", "reflectance": _colours(mi, item)}
    is_open = item.shape in _OPEN_SHAPES
    if item.material is None and item.texture is None:
        return {"type": "twosided", "material": bsdf} if is_open else bsdf
    with as_spec_error(spec.file, key):
        loaded = mi.load_dict(bsdf)
    if not is_open or bsdf["type"] == "twosided" or mi.has_flag(loaded.flags(), mi.BSDFFlags.Transmission):
        return loaded
    return {"type": "twosided", "material": loaded}


def _colours(mi: MitsubaModule, item: ObjectSpec) -> dict[str, Any]:
    """One reflectance, or a checkerboard of two."""
    texture = spectrum_dict(item.reflectance.load())
    if item.pattern is None:
        return texture
    scale = np.diag([item.pattern_count[0] / 2, item.pattern_count[1] / 2, 1.0, 1.0])
    return {
        "type": "checkerboard",
        "color0": texture,
        "color1": spectrum_dict(item.pattern.load()),
        "to_uv": transform(mi, scale),
    }


def _picture(mi: MitsubaModule, texture: TextureSpec, key: str) -> Any:
    return picture_texture(mi, read_picture(texture, key), texture.repeat)


def _plugin(
    mi: MitsubaModule, node: Mapping[str, Any], item: ObjectSpec, spec: SceneSpec, key: str, kind: str | None = None
) -> dict[str, Any]:
    """A description in a scene file as a dictionary for Mitsuba.

    Parameters
    ----------
    key : place of the description, for errors.
    kind : what it must be; None: a BSDF or a texture.
    """
    name = node["type"]
    kinds = ("BSDF", "Texture") if kind is None else (kind,)
    if not any(name in HONOURED[one] for one in kinds):
        why = REFUSED["BSDF"].get(str(name))
        known = ", ".join(sorted(known for one in kinds for known in HONOURED[one]))
        problem = why or f"it is not known here; use one of {known}"
        raise SpecError(f"{' or '.join(kinds)} {str(name)!r}: {problem}", file=spec.file, key=f"{key}.type")
    content: dict[str, Any] = {}
    for name_of_key, value in node.items():
        place = f"{key}.{name_of_key}"
        if isinstance(value, SpectrumSpec):
            content[name_of_key] = spectrum_dict(value.load())
        elif isinstance(value, TextureSpec):
            content[name_of_key] = _picture(mi, value, place)
        elif isinstance(value, Mapping):
            content[name_of_key] = _plugin(mi, value, item, spec, place)
        elif name_of_key == "filename":
            file = spec.folder / str(value)
            if not file.is_file():
                raise SpecError(f"no such file: {file}", file=spec.file, key=place)
            require_fits(file)
            content[name_of_key] = str(file)
        elif name_of_key == "material" and isinstance(value, str):
            content[name_of_key] = require_material(value, spec.file, place)
        elif isinstance(value, list) and np.shape(value) == (4, 4):
            content[name_of_key] = transform(mi, value)
        elif isinstance(value, list):
            content[name_of_key] = ",".join(f"{float(v):.9g}" for v in value)
        else:
            content[name_of_key] = value
    return content
