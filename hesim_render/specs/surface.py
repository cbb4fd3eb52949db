"""Surfaces of objects: pictures on them, and materials of Mitsuba by name."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, ValidationInfo

from hesim_render.specs.reflectance import PictureFile
from hesim_render.specs.spectrum import SpectrumSpec

#: Number of repetitions.
Count = Annotated[int, Field(ge=1, le=100_000)]
#: Depth of materials inside materials.
_DEEPEST = 8


class TextureSpec(PictureFile):
    """A picture over the u and v of a surface."""

    repeat: tuple[Count, Count] = Field((1, 1), description="how often it is seen along u and v")


def _material(value: Any, info: ValidationInfo) -> Any:
    """A description of a material: its spectra and pictures are read, the rest stays as it is."""
    if isinstance(value, str):
        value = {"type": value}
    if not isinstance(value, Mapping) or "type" not in value:
        raise ValueError("expected the name of a material of Mitsuba, or a mapping with its 'type' and its keys")
    return _plugin(value, info, 0)


def _plugin(node: Mapping[str, Any], info: ValidationInfo, depth: int) -> dict[str, Any]:
    if depth > _DEEPEST:
        raise ValueError(f"materials lie inside each other more than {_DEEPEST} deep")
    return {str(key): _value(str(key), value, info, depth) for key, value in node.items()}


def _value(key: str, value: Any, info: ValidationInfo, depth: int) -> Any:
    if isinstance(value, Mapping):
        if "type" in value:
            return _plugin(value, info, depth + 1)
        kind = TextureSpec if "file" in value else SpectrumSpec
        return kind.model_validate(dict(value), context=info.context)
    if isinstance(value, str) and value.endswith(".csv"):
        return SpectrumSpec.model_validate(value, context=info.context)
    if value is None or isinstance(value, bool | int | float | str | list | SpectrumSpec | TextureSpec):
        return value
    raise ValueError(f"{key}: expected a number, a text, a spectrum, a picture or a mapping with a 'type'")


#: A BSDF of Mitsuba by its plugin's name and keys. Its spectra are those of scene files, its pictures `TextureSpec`.
MaterialSpec = Annotated[dict[str, Any], BeforeValidator(_material)]


def leaves_of(material: Mapping[str, Any], kind: type) -> Iterator[tuple[str, Any]]:
    """Dotted keys and values of a material that are of a kind, such as `SpectrumSpec`."""
    for key, value in material.items():
        if isinstance(value, Mapping):
            yield from ((f"{key}.{inside}", found) for inside, found in leaves_of(value, kind))
        elif isinstance(value, kind):
            yield key, value
