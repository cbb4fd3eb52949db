"""Small SVG drawings for the calibration report: axes, points, lines, bars, boxes and images."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray
from PIL import Image

#: Colours told apart with any colour vision (Okabe and Ito).
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#6b6b6b", "#000000")
_MARGIN = (68, 12, 30, 40)  # left, right, top, bottom
#: Height of a line of the legend, and width of a character of it, px.
_LINE, _CHARACTER = 15, 6.4


class Plot:
    """One panel with axes; data are given in their own units.

    Parameters
    ----------
    x_range, y_range : ends of the axes. log_x, log_y : logarithmic axes; what lies below the start of a
        logarithmic x axis, such as 0, is drawn at its start. ticks_x : whether the x axis has numbers.
    The legend stands below the axis, where it hides nothing.
    """

    def __init__(
        self,
        title: str,
        x_label: str,
        y_label: str,
        x_range: tuple[float, float],
        y_range: tuple[float, float],
        log_y: bool = False,
        size: tuple[int, int] = (420, 290),
        ticks_x: bool = True,
        log_x: bool = False,
    ) -> None:
        self.width, self.height = size
        self._log, self._log_x = log_y, log_x
        left, right, top, bottom = _MARGIN
        x0, x1 = (float(np.log10(v)) for v in x_range) if log_x else _widened(*x_range)
        y0, y1 = y_range if log_y else _widened(*y_range)
        if log_y:
            y0, y1 = np.log10(max(y0, 1e-12)), np.log10(max(y1, 1e-12))
            y0, y1 = _widened(y0, y1)
        self._x = lambda v: left + (self._along(v, x0) - x0) / (x1 - x0) * (self.width - left - right)
        self._y = lambda v: self.height - bottom - (self._up(v) - y0) / (y1 - y0) * (self.height - top - bottom)
        across, down = (left + self.width - right) / 2, (top + self.height - bottom) / 2
        turned = f'transform="translate(12 {down:.0f}) rotate(-90)"'
        self._parts = [
            f'<text x="{left}" y="16" class="title">{escape(title)}</text>',
            f'<text x="{across:.0f}" y="{self.height - 6}" class="label">{escape(x_label)}</text>',
            f'<text {turned} class="label">{escape(y_label)}</text>',
        ]
        self._axes((x0, x1) if ticks_x else None, y0, y1)
        self._clip = (left, top, self.width - left - right, self.height - top - bottom)
        self._legend: list[tuple[str, str]] = []

    def _along(self, value: NDArray | float, start: float) -> NDArray:
        array = np.asarray(value, float)
        return np.log10(np.maximum(array, 10**start)) if self._log_x else array

    def _up(self, value: NDArray | float) -> NDArray:
        array = np.asarray(value, float)
        return np.log10(np.maximum(array, 1e-12)) if self._log else array

    def _axes(self, x_range: tuple[float, float] | None, y0: float, y1: float) -> None:
        left, right, top, bottom = _MARGIN
        floor, edge = self.height - bottom, self.width - right
        for v in () if x_range is None else log_ticks(*x_range) if self._log_x else ticks(*x_range):
            v = 10**v if self._log_x else v
            x = float(self._x(v))
            self._parts.append(f'<path d="M{x:.1f} {top}V{floor}" class="grid"/>')
            self._parts.append(f'<text x="{x:.1f}" y="{floor + 14}" class="tick">{number(v)}</text>')
        for v in log_ticks(y0, y1) if self._log else ticks(y0, y1, 5):
            y = float(self.height - bottom - (v - y0) / (y1 - y0) * (self.height - top - bottom))
            text = number(10**v) if self._log else number(v)
            self._parts.append(f'<path d="M{left} {y:.1f}H{edge}" class="grid"/>')
            self._parts.append(f'<text x="{left - 4}" y="{y + 3:.1f}" class="tick end">{text}</text>')
        self._parts.append(f'<path d="M{left} {top}V{floor}H{edge}" class="axis"/>')

    def points(self, x: NDArray, y: NDArray, colour: str, label: str = "", radius: float = 1.7) -> Plot:
        dots = "".join(
            f"M{a - radius:.1f} {b:.1f}a{radius} {radius} 0 1 0 {2 * radius} 0a{radius} {radius} 0 1 0 {-2 * radius} 0"
            for a, b in self._inside(x, y)
        )
        return self._add(f'<path d="{dots}" fill="{colour}" fill-opacity="0.55"/>', colour, label)

    def arrows_down(self, x: NDArray, y: NDArray, colour: str) -> Plot:
        """From upper limits."""
        path = "".join(f"M{a:.1f} {b:.1f}v7m-2 -3l2 3l2 -3" for a, b in self._inside(x, y))
        return self._add(f'<path d="{path}" fill="none" stroke="{colour}" stroke-opacity="0.7"/>', colour, "")

    def line(self, x: NDArray, y: NDArray, colour: str, label: str = "", dashed: bool = False) -> Plot:
        ok = np.isfinite(x) & np.isfinite(self._up(y))
        path = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(self._x(x[ok]), self._y(y[ok]), strict=True))
        dash = ' stroke-dasharray="5 3"' if dashed else ""
        return self._add(
            f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="1.4"{dash}/>', colour, label
        )

    def bars(self, x: NDArray, y: NDArray, colour: str, label: str = "") -> Plot:
        half = abs(float(self._x(x[1]) - self._x(x[0]))) / 2 if len(x) > 1 else 2.0
        floor = self.height - _MARGIN[3]
        path = "".join(
            f"M{a - half:.1f} {floor}V{b:.1f}H{a + half:.1f}V{floor}Z"
            for a, b in zip(self._x(x), self._y(y), strict=True)
            if b < floor
        )
        return self._add(f'<path d="{path}" fill="{colour}" fill-opacity="0.35"/>', colour, label)

    def box(self, x: float, values: NDArray, colour: str, name: str) -> Plot:
        """Median, quartiles and extremes, named under the axis."""
        low, q1, middle, q3, high = (float(v) for v in self._y(np.quantile(values, [0, 0.25, 0.5, 0.75, 1])))
        c = float(self._x(x))
        self._parts.append(
            f'<text x="{c:.1f}" y="{self.height - _MARGIN[3] + 16}" class="label">{escape(name)}</text>'
            f'<path d="M{c:.1f} {low:.1f}V{high:.1f}M{c - 8:.1f} {low:.1f}h16M{c - 8:.1f} {high:.1f}h16" '
            f'stroke="{colour}"/><rect x="{c - 12:.1f}" y="{min(q1, q3):.1f}" width="24" '
            f'height="{max(abs(q1 - q3), 1):.1f}" fill="#fff" stroke="{colour}"/>'
            f'<path d="M{c - 12:.1f} {middle:.1f}h24" stroke="{colour}" stroke-width="2"/>'
        )
        return self

    def image(
        self, values: NDArray, x_range: tuple[float, float], y_range: tuple[float, float], log: bool = False
    ) -> Plot:
        """An image whose first row lies at the low end of y."""
        x0, x1 = (float(v) for v in self._x(np.array(x_range)))
        y0, y1 = (float(v) for v in self._y(np.array(y_range)))
        uri = data_uri(np.log1p(values)[::-1] if log else values[::-1], None)
        self._parts.append(
            f'<image x="{x0:.1f}" y="{y1:.1f}" width="{x1 - x0:.1f}" height="{y0 - y1:.1f}" '
            f'preserveAspectRatio="none" style="image-rendering:pixelated" href="{uri}"/>'
        )
        return self

    def _inside(self, x: NDArray, y: NDArray) -> list[tuple[float, float]]:
        a, b = self._x(x), self._y(y)
        left, top, width, height = self._clip
        ok = (a >= left - 1) & (a <= left + width + 1) & (b >= top - 1) & (b <= top + height + 1)
        return list(zip(a[ok], b[ok], strict=True))

    def _add(self, part: str, colour: str, label: str) -> Plot:
        self._parts.append(part)
        if label:
            self._legend.append((label, colour))
        return self

    def svg(self) -> str:
        left, _, width, _ = self._clip
        x, y, parts = float(left), self.height + 4.0, []
        for label, colour in self._legend:
            size = 22 + _CHARACTER * len(label)
            if x > left and x + size > left + width:
                x, y = float(left), y + _LINE
            parts.append(f'<rect x="{x:.0f}" y="{y - 1:.0f}" width="8" height="8" fill="{colour}"/>')
            parts.append(f'<text x="{x + 12:.0f}" y="{y + 7:.0f}" class="tick start">{escape(label)}</text>')
            x += size
        height = round(y) + _LINE if parts else self.height
        return (
            f'<svg viewBox="0 0 {self.width} {height}" width="{self.width}" height="{height}" '
            f'xmlns="http://www.w3.org/2000/svg" role="img">{"".join(self._parts + parts)}</svg>'
        )


def picture(title: str, values: NDArray, unit: str, size_px: int = 400) -> str:
    """A map with a colour bar, its longer side `size_px`; colours span the 1st to the 99th percentile."""
    finite = values[np.isfinite(values)]
    low, high = (float(v) for v in np.quantile(finite, [0.01, 0.99])) if finite.size else (0.0, 1.0)
    rows, cols = values.shape
    scale = size_px / max(rows, cols)
    width, height = max(24, round(scale * cols)), max(24, round(scale * rows))
    bar = data_uri(np.linspace(1, 0, 64)[:, None], (0.0, 1.0))
    return (
        f'<svg viewBox="0 0 {width + 84} {height + 26}" width="{width + 84}" height="{height + 26}" '
        f'xmlns="http://www.w3.org/2000/svg" role="img"><text x="0" y="14" class="title">{escape(title)}</text>'
        f'<image x="0" y="24" width="{width}" height="{height}" preserveAspectRatio="none" '
        f'style="image-rendering:pixelated" href="{data_uri(values, (low, high))}"/>'
        f'<image x="{width + 8}" y="24" width="12" height="{height}" preserveAspectRatio="none" href="{bar}"/>'
        f'<text x="{width + 24}" y="34" class="tick start">{number(high)}</text>'
        f'<text x="{width + 24}" y="{24 + height / 2:.0f}" class="tick start">{escape(unit)}</text>'
        f'<text x="{width + 24}" y="{height + 24}" class="tick start">{number(low)}</text></svg>'
    )


def data_uri(values: NDArray, span: tuple[float, float] | None) -> str:
    """A PNG of the values in a blue–yellow scale even in brightness; not finite is grey."""
    low, high = span if span is not None else (float(np.nanmin(values)), float(np.nanmax(values)))
    scaled = np.clip((np.nan_to_num(values, nan=low) - low) / max(high - low, 1e-30), 0, 1)
    stops = np.array([[0, 32, 76], [60, 77, 110], [124, 123, 120], [187, 175, 113], [255, 234, 70]], float)  # cividis
    colour = np.stack([np.interp(scaled, np.linspace(0, 1, 5), stops[:, c]) for c in range(3)], axis=-1)
    colour[~np.isfinite(values)] = 200
    stream = io.BytesIO()
    Image.fromarray(np.rint(colour).astype(np.uint8)).save(stream, "PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(stream.getvalue()).decode("ascii")


def ticks(low: float, high: float, count: int = 6) -> list[float]:
    """Round numbers between two ends."""
    span = high - low
    raw = span / count
    power = 10.0 ** np.floor(np.log10(raw))
    step = next(s for s in (power, 2 * power, 5 * power, 10 * power) if s >= raw * 0.999)
    first = np.ceil(low / step - 1e-9)
    return [float(round((first + k) * step, 12)) for k in range(int((high - first * step) / step + 1e-9) + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """Logarithms of 1, 2 and 5 times the powers of ten between two logarithms; of the powers alone where many."""
    steps = (1, 2, 5) if high - low < 3 else (1,)
    values = [k + float(np.log10(s)) for k in range(int(np.floor(low)), int(np.ceil(high)) + 1) for s in steps]
    return [v for v in values if low <= v <= high]


def number(value: float) -> str:
    """A number short enough for an axis."""
    if value == 0:
        return "0"
    if 1e3 <= abs(value) < 1e5:
        return f"{value:.0f}"
    return f"{value:.3g}" if 1e-3 <= abs(value) < 1e5 else f"{value:.1e}".replace("e-0", "e-").replace("e+0", "e")


def table(head: Sequence[str], rows: Sequence[Sequence[object]], show: Callable[[object], str] = str) -> str:
    """An HTML table; text is escaped."""
    header = "".join(f"<th>{escape(h)}</th>" for h in head)
    body = "".join("<tr>" + "".join(f"<td>{escape(show(c))}</td>" for c in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{header}</tr></thead><tbody>{body}</tbody></table>"


def _widened(low: float, high: float) -> tuple[float, float]:
    if not (np.isfinite(low) and np.isfinite(high)) or high <= low:
        middle = low if np.isfinite(low) else 0.0
        return middle - 0.5 * max(abs(middle), 1), middle + 0.5 * max(abs(middle), 1)
    return low, high
