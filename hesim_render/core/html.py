"""HTML from the templates that lie beside the modules that fill them; whatever is filled in is escaped."""

import base64
import io
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

if TYPE_CHECKING:
    from jinja2 import Environment

_PACKAGE = Path(__file__).parents[1]


@cache
def _environment() -> "Environment":
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    return Environment(
        loader=FileSystemLoader(_PACKAGE), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip


def filled(template: str, **values: object) -> Markup:
    """A template with values; texts are escaped, what is `Markup` already is not.

    Parameters
    ----------
    template : path of the file in the package, such as ``twin/page.html``.
    values : by their names in the template; one that is missing is an error.
    """
    return Markup(_environment().get_template(template).render(**values))


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> Markup:
    """An HTML table."""
    parts = _environment().get_template("core/parts.html").module
    return Markup(parts.table(head, rows))  # type: ignore[attr-defined]


def number(value: float) -> str:
    """A number with few digits."""
    if value == 0:
        return "0"
    if 1e3 <= abs(value) < 1e5:
        return f"{value:.0f}"
    return f"{value:.3g}" if 1e-3 <= abs(value) < 1e5 else f"{value:.1e}".replace("e-0", "e-").replace("e+0", "e")


def tick_text(value: float, _: float) -> str:
    """Text of a number on an axis: the formatter of logarithmic axes, whose own writes mathematics."""
    return number(value).replace(".0e", "e")


def inline_picture(values: NDArray[np.uint8], alt: str) -> Markup:
    """A picture [row, col] or [row, col, 3] as an HTML element that needs no other file."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(values).save(stream, format="PNG")
    data = base64.b64encode(stream.getvalue()).decode("ascii")
    return Markup('<img alt="{}" src="data:image/png;base64,{}">').format(alt, data)
