"""Reading a YAML file into a pydantic model; every error names file, line and key."""

import hashlib
import io
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    ValidationError,
    ValidationInfo,
    model_validator,
)
from pydantic_core import CoreSchema, core_schema
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.error import YAMLError

from hesim_render.core.errors import SpecError, did_you_mean
from hesim_render.core.guard import printable
from hesim_render.core.shipped import data_folder, list_names
from hesim_render.core.yaml_file import read_yaml
from hesim_render.specs.problems import line_of, spec_error

#: Control characters but tabulators and ends of lines, and halves of characters.
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")


def _with_true_numbers(schema: Any) -> Any:
    """A pydantic schema that applies `_a_number` wherever a number is expected."""
    if isinstance(schema, list | tuple):
        return type(schema)(_with_true_numbers(item) for item in schema)
    if not isinstance(schema, dict) or _is_checked(schema):
        return schema
    inner = {key: _with_true_numbers(value) for key, value in schema.items() if key != "metadata"}
    inner |= {key: value for key, value in schema.items() if key == "metadata"}
    if inner.get("type") in ("float", "int"):
        return core_schema.no_info_before_validator_function(_a_number, inner)
    if inner.get("type") == "bool":
        inner["strict"] = True
    return inner


def _is_checked(schema: dict[str, Any]) -> bool:
    function = schema.get("function")
    return isinstance(function, dict) and function.get("function") is _a_number


def _a_number(value: Any) -> Any:
    """Refuse values that pydantic would convert to a number; pydantic refuses other text itself."""
    if isinstance(value, bool | np.bool_ | bytes):
        raise ValueError("expected a number, not true or false")
    if isinstance(value, str):
        try:
            float(value)
        except ValueError:
            return value
        raise ValueError("expected a number, not a text; leave the quotes away")
    return value


class Strict(BaseModel):
    """Base of all file models: unknown keys are errors, and neither text nor booleans count as numbers."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=False, allow_inf_nan=False, arbitrary_types_allowed=True
    )

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return _with_true_numbers(handler(source))


def text_means(*keys: str) -> Any:
    """A check of a model: a text in its place is the value of these keys."""

    def check(data: Any) -> Any:
        return dict.fromkeys(keys, data) if isinstance(data, str) else data

    return model_validator(mode="before")(check)


class InFolder(Strict):
    """Content that names files relative to the folder of the file itself."""

    folder: Path = Field(Path(), exclude=True)

    @model_validator(mode="before")
    @classmethod
    def _where_it_lies(cls, data: Any, info: ValidationInfo) -> Any:
        if isinstance(data, dict) and info.context:
            if "folder" in data:
                raise ValueError("unknown key 'folder'")
            data = {**data, "folder": info.context["folder"]}
        return data


class NamedSpec(Strict):
    """What the files of scenes, sensors, palettes and filter sets begin with."""

    schema_version: Literal[1]
    name: str = Field(min_length=1)
    description: str


Model = TypeVar("Model", bound=BaseModel)


def locate(name_or_path: str | Path, kind: str) -> Path:
    """The file of a shipped name or a path.

    Raises
    ------
    SpecError
        If there is no such file; the message lists the shipped names.
    """
    given = Path(name_or_path)
    if given.suffix in (".yaml", ".yml") or len(given.parts) > 1:
        if os.path.isfile(given):
            return given
        raise SpecError("no such file", file=given)
    shipped = data_folder(kind) / f"{name_or_path}.yaml"
    if os.path.isfile(shipped):  # also False if the name is too long
        return shipped
    if os.path.isfile(given):
        return given
    names = list_names(kind)
    one = "study" if kind == "studies" else kind[:-1].replace("_", " ")
    raise SpecError(
        f"no {one} named {str(name_or_path)!r}; shipped are {', '.join(names)}{did_you_mean(str(name_or_path), names)}"
    )


def apply_overrides(data: dict[str, Any], overrides: Mapping[str, Any]) -> None:
    """Set dotted keys (``aps.read_noise_e``; list items by number) in place, before validation."""
    for dotted, value in overrides.items():
        node: Any = data
        keys = dotted.split(".")
        for key in keys[:-1]:
            if isinstance(node, CommentedSeq):
                node = _item(node, key, dotted)
                continue
            if not isinstance(node.get(key), CommentedMap | CommentedSeq):
                node[key] = CommentedMap()
            node = node[key]
        if isinstance(node, CommentedSeq):
            _item(node, keys[-1], dotted)
            node[int(keys[-1])] = value
        else:
            node[keys[-1]] = value


def as_read(value: Any) -> Any:
    """A copy as if it had been read from a file, so that changes by `--set` reach into it."""
    if isinstance(value, dict):
        return CommentedMap({key: as_read(inner) for key, inner in value.items()})
    return CommentedSeq([as_read(inner) for inner in value]) if isinstance(value, list) else value


def _item(node: CommentedSeq, key: str, dotted: str) -> Any:
    try:
        return node[int(key)]
    except (ValueError, IndexError):
        raise SpecError(f"the list here has items 0 to {len(node) - 1}, not {key!r}", key=dotted) from None


def parse_override(text: str) -> tuple[str, Any]:
    """``key=value`` with the value read as YAML."""
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise SpecError(f"--set {text!r}: expected KEY=VALUE, such as camera.f_number=4")
    try:
        return key.strip(), YAML(typ="rt").load(io.StringIO(value))
    except YAMLError:
        raise SpecError(f"--set {text!r}: the value is not valid YAML") from None


def validate(model: type[Model], data: dict[str, Any], file: Path | None, overrides: Mapping[str, Any]) -> Model:
    """Apply overrides and build the model; all errors together become one `SpecError`."""
    apply_overrides(data, overrides)
    _require_plain_texts(data, data, file)
    try:
        return model.model_validate(_plain(data), context={"folder": file.parent if file else Path()})
    except ValidationError as error:
        raise spec_error(error, model, data, file, overrides) from None


def read_spec(
    model: type[Model], given: Any, kind: str | None = None, overrides: Mapping[str, Any] | None = None
) -> Model:
    """A model as it is, of its content, or of its file.

    Parameters
    ----------
    model : what is read.
    given : a model, its content as a dictionary, or a path; with `kind` also the name of a shipped file.
    kind : folder of the shipped files, such as ``studies``; None where none are shipped.
    overrides : dotted keys and their values, applied before validation; a model has had its own.

    Raises
    ------
    SpecError
        With file, line and key of all that is wrong.
    """
    if isinstance(given, model):
        return given
    if isinstance(given, Mapping):
        return validate(model, dict(given), None, overrides or {})
    file = Path(given) if kind is None else locate(given, kind)
    return validate(model, read_yaml(file), file, overrides or {})


def _require_plain_texts(node: Any, data: Any, file: Path | None, place: tuple[Any, ...] = ()) -> None:
    """Refuse texts with control characters: names stand in pages, drawings and messages."""
    if isinstance(node, str):
        if _CONTROL.search(node):
            where = ".".join(map(str, place))
            raise SpecError(f"{node[:60]!r} holds a control character", file=file, line=line_of(data, place),
                            key=printable(where) or None)  # fmt: skip
    elif isinstance(node, Mapping):
        for key, value in node.items():
            _require_plain_texts(key, data, file, (*place, key))
            _require_plain_texts(value, data, file, (*place, key))
    elif isinstance(node, list | tuple):
        for number, value in enumerate(node):
            _require_plain_texts(value, data, file, (*place, number))


def _plain(node: Any) -> Any:
    """ruamel's containers as plain dicts, lists and scalars."""
    if isinstance(node, Mapping):
        return {str(key) if not isinstance(key, str) else key: _plain(value) for key, value in node.items()}
    if isinstance(node, list):
        return [_plain(value) for value in node]
    if isinstance(node, bool) or node is None:
        return node
    if isinstance(node, int):
        return int(node)
    if isinstance(node, float):
        return float(node)
    return str(node) if isinstance(node, str) else node


def content_hash(spec: BaseModel) -> str:
    """SHA-256 of a model's content, independent of comments, order and file name."""
    text = json.dumps(spec.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
