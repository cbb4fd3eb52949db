"""Reading a YAML file into a pydantic model; every error names file, line and key."""

from __future__ import annotations

import hashlib
import io
import json
import re
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, GetCoreSchemaHandler, ValidationError
from pydantic_core import PydanticCustomError, core_schema
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.error import YAMLError

from hesim_render.errors import SpecError
from hesim_render.specs.yamlfile import read_yaml


def _number(value: Any, wanted: str) -> Any:
    """Neither text nor true and false are numbers, though pydantic would make some of them."""
    if isinstance(value, str | bytes | bool | np.bool_):
        raise PydanticCustomError("number", "expected {wanted}", {"wanted": wanted})
    return value


def _numbers_only(schema: Any) -> Any:
    """A pydantic schema in which every int and float takes numbers alone, whatever stands around it."""
    if isinstance(schema, list | tuple):
        return type(schema)(map(_numbers_only, schema))
    if not isinstance(schema, dict):
        return schema
    inner = {key: _numbers_only(part) for key, part in schema.items()}
    if schema.get("type") not in ("int", "float"):
        return inner
    wanted = "a number" if schema["type"] == "float" else "an integer"
    return core_schema.no_info_before_validator_function(partial(_number, wanted=wanted), inner)


class Strict(BaseModel):
    """Base of all file models: unknown keys are errors, values are never coerced from strings."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=False, allow_inf_nan=False, arbitrary_types_allowed=True
    )

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        return _numbers_only(handler(source))


Model = TypeVar("Model", bound=BaseModel)


def data_folder(kind: str) -> Path:
    """Folder of the shipped files: ``scenes`` or ``sensors`` (inside the wheel, or beside the sources)."""
    package = Path(__file__).resolve().parent.parent
    inside = package / kind
    return inside if inside.is_dir() else package.parent / kind


def list_names(kind: str) -> list[str]:
    """Names of the shipped files of a kind."""
    return sorted(path.stem for path in data_folder(kind).glob("*.yaml"))


def locate(name_or_path: str | Path, kind: str) -> Path:
    """The file meant by a shipped name or a path.

    Raises
    ------
    SpecError
        If there is no such file; the message lists the shipped names.
    """
    given = Path(name_or_path)
    if given.suffix in (".yaml", ".yml") or len(given.parts) > 1:
        if given.is_file():
            return given
        raise SpecError("no such file", file=given)
    shipped = data_folder(kind) / f"{name_or_path}.yaml"
    if shipped.is_file():
        return shipped
    if given.is_file():
        return given
    raise SpecError(f"no {kind[:-1]} named {str(name_or_path)!r}; shipped are {', '.join(list_names(kind))}")


def load_yaml(file: Path) -> CommentedMap:
    """The mapping in a YAML file, with line numbers kept."""
    return read_yaml(file)


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


def line_of(data: Any, location: Iterable[Any]) -> int | None:
    """1-based line of the deepest part of `location` that exists in `data`; 1 where none does, None for JSON."""
    if not isinstance(data, CommentedMap):
        return None
    line = 1
    node = data
    for key in location:
        try:
            if isinstance(node, CommentedMap) and key in node:
                line = node.lc.key(key)[0] + 1
                node = node[key]
            elif isinstance(node, CommentedSeq) and isinstance(key, int) and key < len(node):
                line = node.lc.item(key)[0] + 1
                node = node[key]
        except (AttributeError, KeyError, TypeError):
            break  # set by an override: it has no line
    return line


def validate(model: type[Model], data: dict[str, Any], file: Path | None, overrides: Mapping[str, Any]) -> Model:
    """Apply overrides and build the model; the first error becomes one `SpecError`."""
    apply_overrides(data, overrides)
    try:
        return model.model_validate(_plain(data), context={"folder": file.parent if file else Path()})
    except ValidationError as error:
        raise _first_error(error, data, file, overrides) from None


def _first_error(
    error: ValidationError, data: dict[str, Any], file: Path | None, overrides: Mapping[str, Any]
) -> SpecError:
    problems = error.errors(include_url=False)
    # A wrong value where there are several alternatives is reported once per alternative: an unknown key
    # says most, then what is wrong inside the alternative that was written, the deeper the better.
    problem = max(
        problems,
        key=lambda p: (
            p["type"] == "extra_forbidden",
            not (p["type"] == "literal_error" and isinstance(p.get("input"), dict | list)),
            len(p["loc"]),
        ),
    )
    location = _keys_of(problem, data)
    if problem["type"] == "extra_forbidden":
        message = "unknown key"
    elif problem["type"] == "missing":
        message = "required key is missing"
    else:
        message = problem["msg"].removeprefix("Value error, ")
        inside, message = _key_in(message, _node_at(data, location))
        location += inside
        given = problem.get("input")
        if not isinstance(given, dict | list) and "," not in str(given):
            message += f" (got {given!r})"
    dotted = ".".join(str(key) for key in location)
    if any(dotted == key or dotted.startswith(f"{key}.") or key.startswith(f"{dotted}.") for key in overrides):
        return SpecError(f"{message}; set by an override", file=file, key=dotted)
    return SpecError(message, file=file, line=line_of(data, location), key=dotted or None)


def _node_at(data: Any, location: Iterable[Any]) -> Any:
    """The part of `data` at `location`, None where there is none."""
    for key in location:
        try:
            data = data[key]
        except (KeyError, IndexError, TypeError):
            return None
    return data


def _key_in(message: str, node: Any) -> tuple[list[Any], str]:
    """Which key below `node` a message of a model's own check is about, and the message without it.

    A check of a whole section (``tile: the letter 'X' is not defined``) is reported by pydantic for the
    section; its text begins with the dotted key, says ``key is required``, or names keys on its way.
    """
    if not isinstance(node, Mapping):
        return [], message
    leading = re.match(r"([A-Za-z_]\w*(?:\.\w+)*)(: | is required)?", message)
    if leading and (leading[1].split(".")[0] in node or leading[2] == " is required"):
        path = _path_in(node, leading[1].split("."))
        return path, message[leading.end() :] if leading[2] == ": " else message
    named = [word for word in re.findall(r"[A-Za-z_]\w*", message) if word in node]
    # a word with an underscore is surely meant as a key; a plain one may be just a word
    return sorted(named, key=lambda word: "_" not in word)[:1], message


def _path_in(node: Any, parts: list[str]) -> list[Any]:
    """Parts of a dotted key as keys of `node`; a key of the file may itself hold dots (under sources)."""
    joined = ".".join(parts)
    if len(parts) <= 1 or (isinstance(node, Mapping) and joined in node):
        return [int(joined) if isinstance(node, list) and joined.isdigit() else joined]
    first: Any = int(parts[0]) if isinstance(node, list) and parts[0].isdigit() else parts[0]
    return [first, *_path_in(_node_at(node, [first]), parts[1:])]


def _keys_of(problem: Any, data: Any) -> list[Any]:
    """The parts of a pydantic location that are keys of the file, not names of alternatives."""
    keys: list[Any] = []
    node = data
    for key in problem["loc"]:
        below = _node_at(node, [key])
        if isinstance(node, Mapping | list) and (below is not None or (isinstance(node, Mapping) and key in node)):
            keys.append(key)
            node = below
    if problem["type"] == "missing":
        keys.append(problem["loc"][-1])
    return keys


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
