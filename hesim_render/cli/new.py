"""Files to begin with: ``new``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hesim_render.cli.options import Overwrite, names_of
from hesim_render.cli.terminal import say
from hesim_render.core.errors import RangeError, did_you_mean
from hesim_render.core.output import free_place, replacing
from hesim_render.core.shipped import list_names

#: Kinds of sensors that there is a template for.
_KINDS = ("frames", "events", "hybrid")


def _kinds_and_names(incomplete: str) -> list[str]:
    return [kind for kind in _KINDS if kind.startswith(incomplete)] + names_of("sensors")(incomplete)


def new(
    out: Annotated[Path, typer.Argument(help="sensor file to write, such as mine.yaml")],
    like: Annotated[
        str,
        typer.Option(
            help=f"a template with comments for {', '.join(_KINDS)}, or a shipped sensor to copy (see 'info sensors')",
            autocompletion=_kinds_and_names,
        ),
    ] = "hybrid",
    overwrite: Overwrite = False,
) -> None:
    """Write a sensor file to start from.

    A template in which comments explain every key, or a copy of a shipped one.
    """
    free_place(out, overwrite, (".yaml", ".yml"))
    from hesim_render.sensor.template import sensor_copy, sensor_template

    if like in _KINDS:
        text = sensor_template(out.stem, like)
    elif like in list_names("sensors"):
        text = sensor_copy(out.stem, like)
    else:
        known = (*_KINDS, *list_names("sensors"))
        raise RangeError("--like", like, f"one of {', '.join(known)}{did_you_mean(like, known)}")
    with replacing(out) as unfinished:
        unfinished.write_text(text, encoding="utf-8")
    say(f"{out}: a sensor file; look at it with 'hesim-render info {out}'")
