"""YAML files: read without trust in their size, depth or aliases, and written."""

import functools
import io
import pickle
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import AliasEvent, CollectionEndEvent, CollectionStartEvent, NodeEvent, ScalarEvent

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import WholeFile, reading

#: Largest file; as Python objects with line numbers it takes about a hundred times as much memory.
_MOST_BYTES = 16 << 20
#: Length of a text from which its content is not kept for the next reader.
_MOST_KEPT = 1 << 16
#: Largest number of values after all aliases are expanded; a calibration of a 16 x 16 tile has a few thousand.
_MOST_VALUES = 1_000_000


def read_yaml(file: Path, with_lines: bool = True) -> Any:
    """The mapping in a YAML file.

    Parameters
    ----------
    file : the file.
    with_lines : keep line numbers (a `CommentedMap`), which is slower; otherwise plain dictionaries.

    Raises
    ------
    SpecError
        If it is not a YAML mapping, or its aliases expand to too much.
    """
    return parse_yaml(WholeFile(file, _MOST_BYTES).text(), file, with_lines)


def parse_yaml(text: str, file: Path, with_lines: bool) -> Any:
    """The mapping in a text; see `read_yaml`. `file` is for errors."""
    with reading(file, "as YAML"):
        try:
            if "*" in text:
                _check_aliases(text, file)
            kind = "rt" if with_lines else "safe"
            data = pickle.loads(_parsed(text, kind)) if len(text) < _MOST_KEPT else YAML(typ=kind).load(text)
        except MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            raise SpecError(
                f"not valid YAML: {error.problem or error.context}", file=file, line=mark.line + 1 if mark else None
            ) from None
        except YAMLError as error:
            raise SpecError(f"not valid YAML: {str(error).splitlines()[0]}", file=file) from None
    if not isinstance(data, CommentedMap if with_lines else dict):
        raise SpecError("expected a mapping of keys to values at the top level", file=file, line=1)
    return data


@functools.lru_cache(64)
def _parsed(text: str, kind: str) -> bytes:
    """The content of a text, pickled: a parse takes as long as fifty copies, and studies read the same files often."""
    return pickle.dumps(YAML(typ=kind).load(text))


def yaml_text(content: object, width: int = 110, is_sorted: bool = False) -> str:
    """Plain values as YAML, short lists and mappings on one line each.

    Parameters
    ----------
    content : mappings, lists, texts and numbers.
    width : of a line, characters.
    is_sorted : keys in alphabetical order; default in their own.
    """
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style, yaml.width = None, width
    yaml.sort_base_mapping_type_on_output = is_sorted  # type: ignore[assignment]  # ruamel declares None
    stream = io.StringIO()
    yaml.dump(content, stream)
    return stream.getvalue()


def _check_aliases(text: str, file: Path) -> None:
    """Refuse a file whose aliases expand it to a thousand times its size, or without end."""
    sizes: dict[str, int] = {}
    open_nodes: list[tuple[str | None, int]] = [(None, 0)]  # anchor, values so far
    for event in YAML(typ="rt").parse(text):
        if isinstance(event, CollectionStartEvent):
            open_nodes.append((event.anchor, 1))
            continue
        if isinstance(event, AliasEvent):
            if any(anchor == event.anchor for anchor, _ in open_nodes):
                raise SpecError(
                    f"the alias *{event.anchor} refers to a node that contains it", file=file, line=_line(event)
                )
            size = sizes.get(event.anchor, 1)
        elif isinstance(event, ScalarEvent):
            size = 1
            if event.anchor:
                sizes[event.anchor] = size
        elif isinstance(event, CollectionEndEvent):
            anchor, size = open_nodes.pop()
            if anchor:
                sizes[anchor] = size
        else:
            continue
        name, before = open_nodes[-1]
        open_nodes[-1] = name, before + size
        if before + size > _MOST_VALUES:
            raise SpecError(
                f"its aliases, written out, make more than {_MOST_VALUES} values", file=file, line=_line(event)
            )


def _line(event: NodeEvent) -> int | None:
    return event.start_mark.line + 1 if event.start_mark is not None else None
