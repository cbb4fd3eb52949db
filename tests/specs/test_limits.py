"""Types, limits and defaults of every key of every file, as they are written down in `tests/data/keys.txt`.

What a file may hold is decided by choice: no truth elsewhere tells whether a rate may be 0 or how long a list may be.
So that a slip of a digit or of a sign shows, each key has a line that a person reads once. After a change on purpose,
the lines are made anew: ``python tests/specs/test_limits.py``.
"""

import importlib
import types
import typing
from pathlib import Path

from pydantic import BaseModel
from pydantic.fields import FieldInfo

import hesim_render
from hesim_render.specs.files import Strict

KEYS = Path(__file__).parents[1] / "data" / "keys.txt"
SIGNS = {
    "gt": ">", "ge": ">=", "lt": "<", "le": "<=",
    "min_length": "items >=", "max_length": "items <=", "pattern": "~", "multiple_of": "multiple of",
}  # fmt: skip


def every_section(kind=Strict):
    for child in kind.__subclasses__():
        yield child
        yield from every_section(child)


def limits_of(metadata):
    for part in metadata:
        if isinstance(part, FieldInfo):
            yield from limits_of(part.metadata)
        else:
            for name, sign in SIGNS.items():
                value = getattr(part, name, None)
                if value is not None:
                    yield f"{sign} {value}"


def kind_of(annotation, metadata=()):
    """``list[float >= 0 <= 9] items >= 1`` of an annotation."""
    limits = " ".join(limits_of(metadata))
    origin, inner = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        text = kind_of(inner[0], inner[1:])
    elif origin in (typing.Union, types.UnionType):
        text = " | ".join(kind_of(one) for one in inner)
    elif origin is typing.Literal:
        text = "/".join(map(str, inner))
    elif origin is not None:
        text = f"{origin.__name__}[{', '.join('...' if one is ... else kind_of(one) for one in inner)}]"
    else:
        text = getattr(annotation, "__name__", str(annotation))
    return f"{text} {limits}".strip()


def default_of(field):
    if field.is_required():
        return ""
    value = field.get_default(call_default_factory=True)
    if isinstance(value, BaseModel):
        value = f"{type(value).__name__} {value.model_dump(mode='json', exclude_unset=True)}"
    return f" = {value}"


def modules():
    """Modules that define a section, by their text: which others are loaded depends on the tests before."""
    root = Path(hesim_render.__file__).parent
    for path in sorted(root.rglob("*.py")):
        if "(Strict" in path.read_text(encoding="utf-8") or path.parent.name == "specs":
            yield ".".join(("hesim_render", *path.relative_to(root).with_suffix("").parts)).removesuffix(".__init__")


def lines():
    """One line a key: ``Section.key: type and limits = default``."""
    for name in modules():
        importlib.import_module(name)
    return sorted(
        {
            f"{section.__name__}.{name}: {kind_of(field.annotation, field.metadata)}{default_of(field)}"
            for section in every_section()
            if section.__module__.startswith("hesim_render")
            for name, field in section.model_fields.items()
        }
    )


def test_types_limits_and_defaults_are_those_written_down():
    assert lines() == KEYS.read_text(encoding="utf-8").splitlines()


if __name__ == "__main__":
    KEYS.write_text("\n".join(lines()) + "\n", encoding="utf-8")
