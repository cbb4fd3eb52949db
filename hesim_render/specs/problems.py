"""Validation errors as messages with file, line and key, all of a file at once."""

import re
import types
import typing
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError
from ruamel.yaml.comments import CommentedMap, CommentedSeq

from hesim_render.core.errors import SpecError, closest, did_you_mean

#: Largest number of characters of a wrong value that a message quotes.
_LONGEST = 60


def spec_error(
    error: ValidationError,
    model: type[BaseModel],
    data: Mapping[str, Any],
    file: str | Path | None = None,
    overrides: Iterable[str] = (),
) -> SpecError:
    """All errors of a validation, in order of lines.

    Parameters
    ----------
    error : from validating `data`, with the overrides already in it, as `model`.
    model : the model.
    data : the content.
    file : the file that `data` is from.
    overrides : dotted keys that did not come from the file.
    """
    result: dict[tuple[int, str, str], SpecError] = {}
    problems = _once(error.errors(include_url=False), data)
    places = [_keys_of(problem, data) for problem in problems]
    short_lists = [place for problem, place in zip(problems, places, strict=True) if _is_short_list(problem)]
    meant: set[tuple[Any, ...]] = set()
    for problem, place in zip(problems, places, strict=True):
        if problem["type"] == "extra_forbidden":
            guess = closest(str(problem["loc"][-1]), _known_keys(model, place[:-1]))
            meant.add((*place[:-1], guess))
    for problem, place in zip(problems, places, strict=True):
        if problem["type"] == "missing" and tuple(place) in meant:
            continue  # the key exists, but is misspelt
        if problem["type"] == "too_short" and any(_is_inside(other, place) for other in places):
            continue  # problems of single items are reported separately
        if _is_short_list(problem) and any(_is_inside(place, short) for short in short_lists):
            continue  # rows of a matrix: the matrix as a whole was reported already
        for message in problem["msg"].removeprefix("Value error, ").splitlines():
            own = _one(problem, message, model, data, file, overrides)
            result.setdefault((own.line or 0, own.key or "", str(own)), own)
    return SpecError.together([result[place] for place in sorted(result)])


def _once(problems: Iterable[Any], data: Any) -> list[Any]:
    """Each problem once. If a value may be written in several ways, only the problems of the intended way are kept.

    Pydantic reports such a value once for each alternative. An unknown key is the best sign of the intended
    alternative, then a problem inside one, the deeper the better.
    """
    groups: dict[Any, dict[Any, list[Any]]] = {}
    for number, problem in enumerate(problems):
        keys = _keys_of(problem, data)
        split = next((k for k, key in enumerate(problem["loc"]) if k >= len(keys) or key != keys[k]), None)
        if split is None:
            groups[number] = {None: [problem]}
        else:
            groups.setdefault(("alternatives", *keys[:split]), {}).setdefault(problem["loc"][split], []).append(problem)
    result: list[Any] = []
    for branches in groups.values():
        result += max(branches.values(), key=lambda branch: max(map(_telling, branch)))
    once: dict[tuple[Any, ...], Any] = {}
    for problem in sorted(result, key=_telling):  # keep one problem per value, the most informative one
        once[tuple(_keys_of(problem, data))] = problem
    return list(once.values())


def _telling(problem: Any) -> tuple[bool, bool, int]:
    return (
        problem["type"] == "extra_forbidden",
        not (problem["type"] == "literal_error" and isinstance(problem.get("input"), dict | list)),
        len(problem["loc"]),
    )


def _one(
    problem: Any,
    message: str,
    model: type[BaseModel],
    data: Any,
    file: str | Path | None,
    overrides: Iterable[str],
) -> SpecError:
    location = _keys_of(problem, data)
    if problem["type"] == "extra_forbidden":
        message = f"unknown key{_meant(str(problem['loc'][-1]), model, location[:-1])}"
    elif _is_short_list(problem):
        message = "the list is too short"
    elif problem["type"] == "missing":
        message = "required key is missing"
    else:
        inside, message = _key_in(message, _node_at(data, location))
        location += inside
        given = problem.get("input")
        if not isinstance(given, dict | list | BaseModel) and "," not in str(given):
            shown = repr(given)
            message += f" (got {shown if len(shown) <= _LONGEST else shown[:_LONGEST] + '…'})"
    dotted = ".".join(str(key) for key in location)
    if any(dotted == key or dotted.startswith(f"{key}.") or key.startswith(f"{dotted}.") for key in overrides):
        return SpecError(f"{message}; set by an override", file=file, key=dotted)
    line = None if file is None else line_of(data, location)
    return SpecError(message, file=file, line=line, key=dotted or None)


def _meant(key: str, model: type[BaseModel], section: list[Any]) -> str:
    """Text about the key that an unknown one may stand for: of the same section, or of one section inside it."""
    known = _known_keys(model, section)
    if closest(key, known) is None:
        known = {f"{part}.{key}" for part in known if key in _known_keys(model, [*section, part])}
        return f" (did you mean {min(known)!r}?)" if len(known) == 1 else ""
    return did_you_mean(key, known)


def _is_short_list(problem: Any) -> bool:
    return problem["type"] == "missing" and isinstance(problem["loc"][-1], int)


def _is_inside(place: list[Any], other: list[Any]) -> bool:
    return len(place) > len(other) and place[: len(other)] == other


def _known_keys(model: Any, location: Iterable[Any]) -> set[str]:
    """Keys that a model, or one of its alternatives, has at a place."""
    models = _models_in(model)
    for key in location:
        inner: set[type[BaseModel]] = set()
        for each in models:
            field = each.model_fields.get(str(key))
            if field is not None:
                inner |= _models_in(field.annotation)
        models = inner or models  # inside a list or a mapping the items have the same models
    return {name for each in models for name in each.model_fields}


def _models_in(annotation: Any) -> set[type[BaseModel]]:
    """All models that an annotation names: of optional values, alternatives, lists and mappings."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return {annotation}
    if isinstance(annotation, types.UnionType) or typing.get_args(annotation):
        return set().union(*map(_models_in, typing.get_args(annotation)))
    return set()


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
            break  # set by an override, which has no line
    return line


def _node_at(data: Any, location: Iterable[Any]) -> Any:
    """The part of `data` at `location`, None where there is none."""
    for key in location:
        try:
            data = data[key]
        except (KeyError, IndexError, TypeError):
            return None
    return data


def _key_in(message: str, node: Any) -> tuple[list[Any], str]:
    """The key below `node` that the message of a model's own check is about, and the message without the key.

    Pydantic reports a check of a whole section (``tile: the letter 'X' is not defined``) for the section.
    The text of such a message begins with the dotted key, says ``key is required``, or contains names of keys.
    """
    if not isinstance(node, Mapping):
        return [], message
    leading = re.match(r"([A-Za-z_]\w*(?:\.\w+)*)(: | is required)?", message)
    if leading and (leading[1].split(".")[0] in node or leading[2] == " is required"):
        path = _path_in(node, leading[1].split("."))
        return path, message[leading.end() :] if leading[2] == ": " else message
    named = [word for word in re.findall(r"[A-Za-z_]\w*", message) if word in node]
    # a word with an underscore is certainly a key; a plain word may be just a word
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
    if problem["type"] == "missing" and isinstance(problem["loc"][-1], str):
        keys.append(problem["loc"][-1])
    return keys
