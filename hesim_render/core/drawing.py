"""Figures of the calibration report: drawn by matplotlib and written as SVG inside an HTML page.

Matplotlib is imported when a report is drawn, not before. Figures are built without ``pyplot``, so that no state of
the process changes and no display is needed.
"""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from hesim_render.core.guard import printable
from hesim_render.core.html import tick_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Colours that can be distinguished with any colour vision (Okabe and Ito).
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#6b6b6b", "#000000")
_SVG, _XLINK = "http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"
#: One unit of the drawing is one pixel of the page, and one point of matplotlib.
_PER_INCH = 72
#: Height of a line of the legend, px.
_LEGEND_LINE = 16
#: Logarithmic axes of a smaller range have numbers between powers of ten.
_FEW_DECADES, _ONE_DECADE = 100.0, 10.0
#: Least ratio of the ends of a logarithmic axis; others are drawn from half to twice the middle.
_LEAST_SPAN = 1.3
#: What every figure looks like, whatever the user's own ``matplotlibrc`` says. Text stays text, is never read as
#: mathematics (a name may hold a $), and identifiers follow from the content alone: the same data give the same bytes.
_SETTINGS: dict[Any, Any] = {
    "svg.fonttype": "none", "svg.hashsalt": "hesim_render", "text.parse_math": False, "figure.dpi": _PER_INCH,
    "font.sans-serif": ["DejaVu Sans"], "font.size": 9.5, "axes.titlesize": 11, "axes.titleweight": "bold",
    "axes.titlelocation": "left", "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True,
    "axes.axisbelow": True, "grid.color": "#e4e4e4", "axes.edgecolor": "#555555", "lines.linewidth": 1.4,
    "lines.markeredgewidth": 0, "image.cmap": "cividis", "image.interpolation": "none",
    "image.composite_image": False, "axes.formatter.limits": (-3, 5), "axes.formatter.useoffset": False,
    "axes.unicode_minus": True,
}  # fmt: skip


@contextmanager
def report_style() -> Iterator[None]:
    """Settings for building and writing the figures of a report. The previous settings are restored afterwards."""
    import matplotlib

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_SETTINGS)
        yield


def new_figure(size_px: tuple[int, int]) -> "Figure":
    """An empty figure of `size_px` (width, height) whose parts are laid out so that texts do not overlap."""
    from matplotlib.figure import Figure

    return Figure(figsize=(size_px[0] / _PER_INCH, size_px[1] / _PER_INCH), layout="constrained")


def panel(title: str, x_label: str, y_label: str, size_px: tuple[int, int] = (420, 290)) -> "tuple[Figure, Axes]":
    """A figure with one pair of axes, size in px of the page."""
    figure = new_figure(size_px)
    axes = figure.subplots()
    axes.set(title=title, xlabel=x_label, ylabel=y_label)
    return figure, axes


def points(axes: "Axes", x: NDArray, y: NDArray, colour: str, label: str = "", size: float = 3.4) -> None:
    """Draw one dot per pair of numbers, half transparent where many overlap.

    Parameters
    ----------
    axes : where the dots are drawn.
    x, y : coordinates.
    colour, label : of the dots.
    size : diameter, px.
    """
    axes.plot(x, y, linestyle="none", marker="o", markersize=size, color=colour, alpha=0.55, label=label)


def logarithmic(axes: "Axes", *which: str) -> None:
    """Logarithmic axes, with numbers between the powers of ten where there are few of those."""
    from matplotlib.ticker import LogLocator

    for name in which:
        (axes.set_xscale if name == "x" else axes.set_yscale)("log")
        axis = axes.xaxis if name == "x" else axes.yaxis
        axis.set_major_formatter(tick_text)
        low, high = axis.get_view_interval()
        if high < _LEAST_SPAN * low:  # of equal values, ticks would all have one number
            low, high = np.sqrt(low * high) / 2, np.sqrt(low * high) * 2
            (axes.set_xlim if name == "x" else axes.set_ylim)(low, high)
        if high < _FEW_DECADES * low:
            axis.set_minor_locator(LogLocator(subs=(2, 5) if high > _ONE_DECADE * low else (2, 3, 4, 5, 7)))
            axis.set_minor_formatter(tick_text)
        else:
            axis.set_minor_formatter("")


def legend_below(figure: "Figure", axes: "Axes", columns: int) -> None:
    """Legend of the labelled artists below the axes, where it covers nothing; the figure grows by its height.

    Parameters
    ----------
    figure : to which the legend is added.
    axes : of the artists.
    columns : of the legend; fewer where the names are too long for the width of the figure.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    handles, labels = axes.get_legend_handles_labels()
    renderer = FigureCanvasAgg(figure).get_renderer()
    for fitting in range(columns, 0, -1):
        legend = figure.legend(
            handles, labels, loc="outside lower center", ncols=fitting, frameon=False, handlelength=1.2,
            columnspacing=1.2, handletextpad=0.4, borderpad=0.2, labelspacing=0.2, markerscale=1.8,
        )  # fmt: skip
        if fitting == 1 or legend.get_window_extent(renderer).width <= figure.bbox.width:
            break
        legend.remove()
    lines = -(-len(labels) // fitting)
    figure.set_figheight(figure.get_figheight() + lines * _LEGEND_LINE / _PER_INCH)


def picture(title: str, values: NDArray, unit: str, size_px: int = 400) -> Markup:
    """A map with a colour bar, its longer side `size_px`; colours span the 1st to the 99th percentile.

    Values that are not finite are grey.
    """
    from matplotlib import colormaps

    finite = values[np.isfinite(values)]
    low, high = (float(v) for v in np.quantile(finite, [0.01, 0.99])) if finite.size else (0.0, 1.0)
    rows, columns = values.shape
    scale = size_px / max(rows, columns)
    width, height = max(24, round(scale * columns)), max(24, round(scale * rows))
    figure = new_figure((width + 108, height + 26))
    axes = figure.subplots()
    shades = colormaps["cividis"].with_extremes(bad="#c8c8c8")
    image = axes.imshow(np.ma.masked_invalid(values), cmap=shades, vmin=low, vmax=high)
    axes.set_axis_off()
    axes.set_title(title)
    figure.colorbar(image, cax=axes.inset_axes((1 + 8 / width, 0, 12 / width, 1)), label=unit)
    return svg(figure)


def svg(figure: "Figure") -> Markup:
    """The figure as an SVG element for an HTML page, without prologue, metadata, date or styles of its own.

    The element needs no other file. Call this function within `report_style`, as all drawing functions.
    """
    from matplotlib.text import Text

    for text in figure.findobj(Text):  # not all characters can stand in XML
        text.set_text("\n".join(map(printable, text.get_text().split("\n"))))
    stream = io.BytesIO()
    nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    figure.savefig(stream, format="svg", metadata=nothing)
    root = ElementTree.fromstring(stream.getvalue())
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag in (f"{{{_SVG}}}metadata", f"{{{_SVG}}}style"):
                parent.remove(child)
        if parent.tag == f"{{{_SVG}}}g":  # named by their order, so that two figures of a page share the names
            parent.attrib.pop("id", None)
        if (link := parent.attrib.pop(f"{{{_XLINK}}}href", None)) is not None:
            parent.set("href", link)
    for name in ("width", "height"):
        root.set(name, root.get(name, "").removesuffix("pt"))
    root.set("role", "img")
    ElementTree.register_namespace("", _SVG)
    return Markup(ElementTree.tostring(root, encoding="unicode"))
