"""The report as a PDF of A4 pages, drawn by matplotlib."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, BinaryIO

from hesim_render.core.guard import printable
from hesim_render.report.drawings import Draw
from hesim_render.report.texts import ReportTable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: A4, margins, in points.
_WIDTH, _HEIGHT, _MARGIN = 595.0, 842.0, 42.0
_PER_INCH = 72
#: Sizes of text, points, and height of a line over that.
_TITLE, _HEADING, _BODY, _SMALL, _LINE = 15.0, 10.5, 8.0, 6.3, 1.32
#: Space between cells of a table, and height of a row of drawings, points.
_GAP, _ROW = 5.0, 158.0
_DRAWINGS_A_ROW = 3


class Document:
    """Pages that fill from top to bottom.

    Parameters
    ----------
    file : to write to.
    title : for the file's metadata.
    """

    def __init__(self, file: BinaryIO, title: str) -> None:
        from matplotlib.backends.backend_pdf import PdfPages

        self._pages = PdfPages(file, metadata={"Title": title, "CreationDate": None, "Creator": None, "Producer": None})
        self._figure: Figure | None = None
        self._y = 0.0
        self.count = 0

    def _page(self) -> "Figure":
        if self._figure is None:
            from matplotlib.figure import Figure

            self._figure = Figure(figsize=(_WIDTH / _PER_INCH, _HEIGHT / _PER_INCH))
            self._y = _HEIGHT - _MARGIN
            self.count += 1
        return self._figure

    def new_page(self) -> None:
        """End the present page, if there is one."""
        if self._figure is not None:
            self._figure.text(
                (_WIDTH - _MARGIN) / _WIDTH, 0.5 * _MARGIN / _HEIGHT, str(self.count), ha="right", fontsize=_SMALL
            )
            self._pages.savefig(self._figure)
            self._figure = None

    def close(self) -> None:
        """End the document."""
        self.new_page()
        self._pages.close()

    def _room(self, height: float) -> None:
        self._page()
        if self._y - height < _MARGIN:
            self.new_page()
            self._page()

    def text(self, text: str, size: float = _BODY, bold: bool = False) -> None:
        """A paragraph."""
        for line in wrapped(text, size, _WIDTH - 2 * _MARGIN, bold):
            self._room(size * _LINE)
            self._line(line, _MARGIN, self._y, size, bold)
            self._y -= size * _LINE
        self._y -= 0.4 * size

    def _line(self, text: str, x: float, y: float, size: float, bold: bool = False) -> None:
        weight = "bold" if bold else "normal"
        self._page().text(x / _WIDTH, y / _HEIGHT, text, fontsize=size, va="top", ha="left", fontweight=weight)

    def table(self, table: ReportTable) -> None:
        """A table with its title; its head is repeated on a new page."""
        total = _WIDTH - 2 * _MARGIN
        widths = [total * part / sum(table.widths) for part in table.widths]
        rows = [
            [wrapped(cell, _SMALL, width - _GAP) for cell, width in zip(row, widths, strict=True)] for row in table.rows
        ]
        head = [wrapped(cell, _SMALL, width - _GAP, True) for cell, width in zip(table.head, widths, strict=True)]
        first = _height(head) + (_height(rows[0]) if rows else 0.0)
        self._room(2 * _HEADING * _LINE + first)
        self._y -= 0.5 * _HEADING
        self.text(table.title, _HEADING, True)
        self._row(head, widths, True)
        for row in rows:
            if self._y - _height(row) < _MARGIN:
                self.new_page()
                self._row(head, widths, True)
            self._row(row, widths)
        self._y -= _HEADING

    def _row(self, cells: list[list[str]], widths: list[float], bold: bool = False) -> None:
        from matplotlib.lines import Line2D

        figure, x = self._page(), _MARGIN
        for lines, width in zip(cells, widths, strict=True):
            for k, line in enumerate(lines):
                self._line(line, x, self._y - k * _SMALL * _LINE, _SMALL, bold)
            x += width
        self._y -= _height(cells)
        y = (self._y + 1.5) / _HEIGHT
        ends = _MARGIN / _WIDTH, (_WIDTH - _MARGIN) / _WIDTH
        figure.add_artist(Line2D(ends, (y, y), color="#cccccc", linewidth=0.4, transform=figure.transFigure))

    def drawings(self, draws: Sequence[Draw]) -> None:
        """Drawings, three in a row."""
        import matplotlib

        small: dict[Any, Any] = {
            "font.size": 6.5,
            "axes.titlesize": 7.5,
            "legend.fontsize": 6.0,
            "lines.linewidth": 1.0,
        }
        each = (_WIDTH - 2 * _MARGIN) / _DRAWINGS_A_ROW
        with matplotlib.rc_context(small):
            for k, draw in enumerate(draws):
                column = k % _DRAWINGS_A_ROW
                if column == 0:
                    self._room(_ROW)
                    self._y -= _ROW
                left, bottom = _MARGIN + column * each + 30, self._y + 34
                place = left / _WIDTH, bottom / _HEIGHT, (each - 42) / _WIDTH, (_ROW - 56) / _HEIGHT
                draw(self._page().add_axes(place))


def _height(cells: list[list[str]]) -> float:
    return max(map(len, cells)) * _SMALL * _LINE + 2.5


def wrapped(text: str, size: float, width: float, bold: bool = False) -> list[str]:
    """Lines of a text that are no wider than `width`, points; a longer word is cut."""
    lines: list[str] = []
    for word in printable(text).split(" "):
        while _width(word, size, bold) > width and len(word) > 1:
            keep = len(word) - 1
            while keep > 1 and _width(word[:keep], size, bold) > width:
                keep -= 1
            lines.append(word[:keep])
            word = word[keep:]
        together = f"{lines[-1]} {word}" if lines else word
        if lines and _width(together, size, bold) <= width:
            lines[-1] = together
        else:
            lines.append(word)
    return lines or [""]


def _width(text: str, size: float, bold: bool) -> float:
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    font = FontProperties(family=["DejaVu Sans"], size=size, weight="bold" if bold else "normal")
    return float(text_to_path.get_text_width_height_descent(text, font, ismath=False)[0])
