"""calibration.yaml, its maps and the report: whole, readable, without anything from outside."""

import html
import os
import re
from html.parser import HTMLParser

import capture_sets
import numpy as np
import pytest

from hesim_render.calibrate import calibrate_aps, calibrate_evs, read_calibration, read_maps, write_report
from hesim_render.calibrate.report import events as event_report
from hesim_render.calibrate.report.parts import headline
from hesim_render.calibrate.result import plain
from hesim_render.core import drawing
from hesim_render.core.drawing import COLOURS
from hesim_render.core.errors import OutputError, SpecError
from hesim_render.core.html import number


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    capture_sets.write_frames(folder / "set", frames=16)
    capture_sets.write_events(folder / "set", size=64, trials=20000)
    told = []
    calibrate_aps(folder / "set", folder / "c.yaml", folder / "aps.html", lambda what, done: told.append((what, done)))
    calibrate_evs(folder / "set", folder / "c.yaml", folder / "both.html", lambda what, done: told.append((what, done)))
    return folder, told


def test_sections_stand_side_by_side(both):
    folder, told = both
    data = read_calibration(folder / "c.yaml")
    assert set(data) == {"schema_version", "capture", "aps", "evs"}
    assert np.array(data["aps"]["beta"]).shape == (2, 2, 6)
    assert np.array(data["evs"]["beta"]).shape == (4, 6)
    for section in ("aps", "evs"):
        maps = read_maps(folder / "c.yaml", section)
        for name, key in data[section]["maps"].items():
            assert name in ("file", "sha256") or key in maps
    assert read_maps(folder / "c.yaml", "aps")["n_dp"].shape == (56, 72)
    assert {what for what, _ in told} >= {"reading aps_dark.npz", "reading aps_lit.npz", "fitting", "done"}
    assert all(0 <= done <= 1 for _, done in told)
    calibrate_aps(folder / "set", folder / "c.yaml")
    assert "evs" in read_calibration(folder / "c.yaml")
    left = sorted(re.sub(r"-[0-9a-f]{12}\.npz", "-HASH.npz", p.name) for p in folder.iterdir())
    assert left == ["aps.html", "both.html", "c.yaml", "c_aps_maps-HASH.npz", "c_evs_maps-HASH.npz", "set"]


@pytest.mark.slow
def test_the_truth_of_a_virtual_session_stands_beside_its_estimates(both):
    """In the table of parameters, not as one line of all keys; one outside of its interval says so."""
    folder, _ = both
    text = (folder / "c.yaml").read_text(encoding="utf-8")
    gain = read_calibration(folder / "c.yaml")["aps"]["K"]["value"]
    truth = f"truth: {{aps: {{K: {gain:.8g}, read_noise_e: 99.0}}, evs: {{B: 7.0}}}}"
    (folder / "known.yaml").write_text(text.replace("capture: {", f"capture: {{{truth}, "), encoding="utf-8")
    page = write_report(folder / "known.yaml", folder / "known.html").read_text(encoding="utf-8")
    assert f"; truth {gain:.5g}</td>" in page and "; truth 99 (outside)</td>" in page
    assert "; truth 7 (outside)</td>" in page and "<td>truth</td>" not in page
    (folder / "known.html").unlink()
    (folder / "known.yaml").unlink()


class _Checker(HTMLParser):
    def __init__(self):
        super().__init__()
        self.open, self.links, self.images = [], [], 0

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        self.images += tag == "svg"
        self.links += [v for k, v in given.items() if k in ("src", "href", "xlink:href")]
        if tag not in ("meta", "br"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.links += [v for k, v in attributes if k in ("src", "href", "xlink:href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


@pytest.mark.parametrize(
    ("name", "headings"), [("aps.html", ["Frames (APS)"]), ("both.html", ["Frames (APS)", "Events (EVS)"])]
)
def test_the_report_is_one_whole_file(both, name, headings):
    page = (both[0] / name).read_text(encoding="utf-8")
    checker = _Checker()
    checker.feed(page)
    assert checker.open == []
    assert 'name="viewport"' in page and page.count('<div class="table"><table>') == page.count("<table>") > 0
    for link in checker.links:  # a mark is drawn once and used again: a link within the page
        assert link.startswith("data:image/png;base64,") or (link[0] == "#" and f'id="{link[1:]}"' in page)
    assert "<script" not in page and "nan" not in re.sub(r"base64,[^\"]*", "", page).lower().replace("nance", "")
    for heading in headings:
        assert f"<h2>{heading}</h2>" in page
    wanted = [
        "Row bias",
        "Temporal variance per pixel",
        "Noise of single values, dark",
        "residual, %",
        "PRNU",
        "β5 (t^2)",
    ]
    if "Events (EVS)" in headings:
        wanted += ["Event probability per trial", "Event probability against brightness", "Counts per pixel, lit",
                   "Counts per pixel, dark", "200 starts", "threshold mismatch"]  # fmt: skip
    else:
        assert "Events (EVS)" not in page
    for text in wanted:
        assert text in page
    assert checker.images >= 5 + 4  # one for each position, with variances above their residuals
    assert page.count("residual, %") == 4
    assert not re.search(r"https?://(?!www\.w3\.org/2000/svg)", page)


def test_cells_without_an_event_are_arrows_and_no_cell_is_missing(tmp_path, monkeypatch):
    """Few trials of a bright scene: most cells of it count nothing, and 0 is on no logarithmic axis."""
    capture_sets.write_events(tmp_path / "set", size=32, trials=2000, brightest=120.0, c=0.001)
    calibrate_evs(tmp_path / "set", tmp_path / "c.yaml")
    figures = _figures(tmp_path / "c.yaml", tmp_path / "r.html", monkeypatch)
    maps = read_maps(tmp_path / "c.yaml", "evs")
    signal, on, off, trials = maps["figure_rates"].T
    (axes,) = (f.axes[0] for f in figures if f.axes[0].get_title("left") == "Event probability against brightness")
    drawn = {line.get_label(): line.get_data() for line in axes.lines}
    points, arrows = ([drawn[label.format(name)] for name in ("ON", "OFF")] for label in ("{}", "_{} none counted"))
    assert all(y.min() > axes.get_ylim()[0] for _, y in points + arrows)
    for events, (x, y), (at, limit) in zip((on, off), points, arrows, strict=True):
        none = events == 0
        assert none.any() and not none.all()
        np.testing.assert_array_equal(x, signal[~none])
        np.testing.assert_allclose(y, events[~none] / trials[~none])
        np.testing.assert_array_equal(at, signal[none])
        # 95 %: (1 - P)^n = 0.05
        np.testing.assert_allclose((1 - limit) ** trials[none], 0.05, rtol=0.02)


def test_what_cannot_be_written_or_read(both, tmp_path):
    folder, _ = both
    if os.geteuid() != 0:
        tmp_path.chmod(0o500)
        with pytest.raises(OutputError):
            write_report(folder / "c.yaml", tmp_path / "r.html")
        tmp_path.chmod(0o700)
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError):
        write_report(folder / "c.yaml", tmp_path / "file" / "r.html")
    with pytest.raises(SpecError):
        read_calibration(tmp_path / "missing.yaml")
    (tmp_path / "old.yaml").write_text("schema_version: 7\n")
    with pytest.raises(SpecError, match="schema_version"):
        read_calibration(tmp_path / "old.yaml")
    (tmp_path / "lone.yaml").write_text((folder / "c.yaml").read_text())
    with pytest.raises(SpecError, match=r"c_aps_maps-[0-9a-f]{12}\.npz: no such file; it belongs to lone\.yaml"):
        read_maps(tmp_path / "lone.yaml", "aps")
    (tmp_path / "none.yaml").write_text("schema_version: 1\ncapture: {bit_depth: 10, tile_rows: 1, tile_cols: 1}\n")
    with pytest.raises(SpecError, match="no section 'evs'"):
        read_maps(tmp_path / "none.yaml", "evs")


def test_numbers_that_are_none_become_null():
    assert plain({"a": np.float32(0.1), "b": np.nan, "c": np.array([1, 2]), 5: np.bool_(True), "d": 1 / 3}) == {
        "a": 0.100000001, "b": None, "c": [1, 2], 5: True, "d": 0.333333333,
    }  # fmt: skip


def test_numbers_are_short():
    assert [number(v) for v in (0, 1234567, 34567.8, 1234.5, 0.25, 2e-4)] == [
        "0", "1.2e6", "34568", "1234", "0.25", "2.0e-4",
    ]  # fmt: skip


def _figures(calibration, report, monkeypatch):
    """The figures of a report as matplotlib had them when it wrote them."""
    from matplotlib.figure import Figure

    found, save = [], Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a, **more: found.append(self) or save(self, *a, **more))
    write_report(calibration, report, overwrite=True)
    return found


@pytest.fixture(scope="module")
def again(both, tmp_path_factory):
    """Figures of the report of both, and the page, drawn a second time."""
    page = tmp_path_factory.mktemp("again") / "again.html"
    with pytest.MonkeyPatch.context() as patch:
        return _figures(both[0] / "c.yaml", page, patch), page


def _texts(figure):
    """Each text of a figure that shows: its words and its box in the figure, px."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.text import Text

    canvas = FigureCanvasAgg(figure).get_renderer()
    inside = []
    for axes in [*figure.axes, *(child for a in figure.axes for child in a.child_axes)]:
        for axis, (low, high) in ((axes.xaxis, sorted(axes.get_xlim())), (axes.yaxis, sorted(axes.get_ylim()))):
            shown = axis.get_visible() and axes.axison
            for tick in axis.get_major_ticks() + axis.get_minor_ticks():
                if not shown or not low <= tick.get_loc() <= high:
                    inside += [tick.label1, tick.label2]
            inside += [] if shown else [axis.label]
    texts = [t for t in figure.findobj(Text) if t.get_visible() and t.get_text().strip() and t not in inside]
    return [(t.get_text(), t.get_window_extent(canvas)) for t in texts]


@pytest.mark.slow
def test_no_text_of_a_drawing_lies_on_another_or_beyond_its_edge(again, tmp_path, monkeypatch):
    capture_sets.write_events(tmp_path / "set", size=32, trials=2000, brightest=300.0, c=0.001)
    calibrate_evs(tmp_path / "set", tmp_path / "c.yaml")  # dark pixels on a logarithmic axis
    figures = again[0] + _figures(tmp_path / "c.yaml", tmp_path / "r.html", monkeypatch)
    assert len(figures) > 18
    seen = 0
    for figure in figures:
        figure.draw_without_rendering()
        width, height = figure.bbox.width, figure.bbox.height
        texts = _texts(figure)
        seen += len(texts)
        for k, (words, box) in enumerate(texts):
            assert box.x0 > -1 and box.y0 > -1 and box.x1 < width + 1 and box.y1 < height + 1, words
            for other, there in texts[:k]:
                apart = box.x1 <= there.x0 or there.x1 <= box.x0 or box.y1 <= there.y0 or there.y1 <= box.y0
                assert apart, (words, other)
    assert seen > 10 * len(figures)


def test_the_legend_stands_below_what_is_drawn():
    with drawing.report_style():
        figure, axes = drawing.panel("t", "x", "y", (300, 200))
        for k in range(9):
            drawing.points(axes, np.array([0.5]), np.array([0.5]), "#000", f"{k} milliseconds")
        drawing.legend_below(figure, axes, 2)
        drawing.svg(figure)
        boxes = [box for words, box in _texts(figure) if "milliseconds" in words]
        floor = min(box.y0 for words, box in _texts(figure) if words == "x")  # y counts from the bottom
    assert len(boxes) == 9 and max(box.y1 for box in boxes) < floor and max(box.x1 for box in boxes) < 300
    assert min(box.y0 for box in boxes) > 0 and axes.bbox.height > 120


def test_names_in_a_drawing_are_text_and_the_same_data_give_the_same_bytes(monkeypatch):
    import matplotlib

    def drawn():
        with drawing.report_style():
            figure, axes = drawing.panel("<script>$\\frac{1}{2}$ & x$", "a $ b", "")
            drawing.points(axes, np.arange(3.0), np.arange(3.0), "#000", "$\\notmath$")
            drawing.legend_below(figure, axes, 1)
            return drawing.svg(figure)

    first = drawn()
    assert ">&lt;script&gt;$\\frac{1}{2}$ &amp; x$</text>" in first and ">a $ b</text>" in first
    assert ">$\\notmath$</text>" in first and "<script" not in first
    assert not re.search(r"<metadata|<style|<!|<\?xml|date", first)
    with matplotlib.rc_context({"font.size": 30, "svg.fonttype": "path", "svg.hashsalt": "other", "text.usetex": True}):
        assert drawn() == first  # whatever the user's own settings are
        assert matplotlib.rcParams["font.size"] == 30
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "0")
    assert drawn() == first


def test_no_dictionary_is_printed_and_notes_cannot_break_the_page(tmp_path):
    keys = {
        "notes": "'<script>alert(1)</script>'",
        "roi": "{x: 0, y: 4, width_px: 32, height_px: 32}",
        "signal_reference": "{k: 0.25, t_ref_us: 1000}",
    }
    capture_sets.write_events(tmp_path / "set", size=32, **keys)
    calibrate_evs(tmp_path / "set", tmp_path / "c.yaml", tmp_path / "r.html")
    page = re.sub(r"<style>.*?</style>", "", (tmp_path / "r.html").read_text(), flags=re.S)
    assert "<script>" not in page and "alert(1)" in page
    text = re.sub(r"<[^>]*>", " ", page)
    assert not re.search(r"[{}\[\]]|\b(None|True|False|dict|array)\b", text)
    assert "x 0, y 4, width_px 32, height_px 32" in text and "k 0.25, t_ref_us 1000.0, filter own" in text


@pytest.mark.slow
def test_residuals_beyond_the_usual_are_drawn(again):
    """Every point handed to a panel lies within its axes."""
    drawn = 0
    for figure in again[0]:
        for axes in figure.axes:
            for line in axes.lines:
                if line.get_marker() == "o":
                    x, y = line.get_data()
                    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
                    assert np.all((x >= left) & (x <= right) & (y >= low) & (y <= high)), axes.get_title()
                    drawn += len(x) > 0
    assert drawn > 10


def test_a_report_is_the_same_bytes_again(both, again):
    assert again[1].read_bytes() == (both[0] / "both.html").read_bytes()


def test_histograms_of_counts_have_bins_of_whole_counts(both):
    maps = read_maps(both[0] / "c.yaml", "evs")
    with np.load(both[0] / "set" / "evs_static.npz") as data:
        on, off = data["n_on"], data["n_off"]
    good = ~maps["bad_pixels"]
    table, top = maps["figure_on_off_lit"], float(maps["figure_on_off_lit_top"])
    wide = (top + 0.5) / len(table)
    assert wide == int(wide) >= 1
    counted = np.zeros(table.shape)
    inside = good & (on < top) & (off < top)
    np.add.at(counted, ((off[inside] // wide).astype(int), (on[inside] // wide).astype(int)), 1)
    np.testing.assert_array_equal(table, counted)


def test_a_report_begins_with_the_figures_their_intervals_and_saturation(both):
    """Of the calibration itself, in words; what is not known has its reason."""
    folder, _ = both
    data, page = read_calibration(folder / "c.yaml"), (folder / "both.html").read_text()
    for section in (data["aps"], data["evs"]):
        sentences = headline(section)
        assert all(f"<li>{html.escape(text, quote=False)}</li>" in page.replace("&#39;", "'") for text in sentences)
    k = data["aps"]["K"]
    low, high = k["interval_95"]
    assert f"system gain K {k['value']:.4g} DN/e- ({low:.4g} to {high:.4g})" in headline(data["aps"])[0]
    assert any("aturation" in text for text in headline(data["aps"]))
    section = {
        "K": {"value": None, "reason": "there is one exposure"},
        "read_noise_e": {"value": 3.21, "interval_95": [3.1, 3.4], "unit": "e-"},
        "prnu_percent": {"value": 0.0, "upper_limit": 0.27, "unit": "%"},
        "full_well_e": {"value": 9800.0, "interval_95": [9600.0, 9900.0], "unit": "e-", "limited_by": "full well"},
    }
    assert headline(section) == [
        "With 95 % intervals: read noise 3.21 e- (3.1 to 3.4), PRNU below 0.27 %.",
        "Saturation is reached at 9800 e- (9600 to 9900); the limit is the full well.",
        "Not known is the system gain K: there is one exposure.",
    ]
    section["full_well_e"] = {"value": None, "reason": "no level is bright enough"}
    assert headline(section)[1] == "Not known is the saturation capacity: no level is bright enough."


def points_of(axes):
    """Colour and data of what has markers and what has a line, by colour."""
    marks, curves = {}, {}
    for line in axes.lines:
        kind = curves if line.get_linestyle() not in ("None", "none", "") else marks
        kind.setdefault(line.get_color(), []).append(line.get_xydata())
    return marks, curves


def test_counts_are_drawn_over_the_fit_of_their_own_polarity(monkeypatch):
    """S-curves and rates: ON in the second colour, OFF in the first; a triangle at 3/n where nothing was counted."""
    drawn = []
    monkeypatch.setattr(event_report, "svg", lambda figure: drawn.append(figure) or "")
    step, trials = np.array([-0.3, 0.1, 0.4]), 730
    on, off = np.array([11, 300, 721]), np.array([703, 250, 17])
    line = np.linspace(-0.3, 0.4, 5)
    fits = np.array([0.01, 0.2, 0.5, 0.7, 0.99]), np.array([0.97, 0.6, 0.4, 0.3, 0.02])
    steps = {"figure_steps": np.stack([step, on, off], axis=1), "figure_steps_trials": np.array(trials)}
    event_report._steps(steps | {"figure_steps_fit": np.stack([line, *fits], axis=1)})
    signal, many = np.array([3.0, 9.0, 20.0]), np.array([5_000, 7_000, 2_000])
    rates = {"figure_rates": np.stack([signal, on, [30, 0, 4], many], axis=1)}
    at = np.array([3.0, 7.0, 11.0, 20.0, 25.0])
    event_report._rates(rates | {"figure_rates_fit": np.stack([at, *fits], axis=1)})
    s_curve, rate = (points_of(figure.axes[0]) for figure in drawn)
    for colour, counts, fit in ((COLOURS[1], on, fits[0]), (COLOURS[0], off, fits[1])):
        np.testing.assert_allclose(s_curve[0][colour][0], np.stack([step, counts / trials], axis=1))
        np.testing.assert_allclose(s_curve[1][colour][0], np.stack([line, fit], axis=1))
        np.testing.assert_allclose(rate[1][colour][0], np.stack([at, fit], axis=1))
    np.testing.assert_allclose(rate[0][COLOURS[1]][0], np.stack([signal, on / many], axis=1))
    np.testing.assert_allclose(rate[0][COLOURS[0]][0], [[3, 30 / 5_000], [20, 4 / 2_000]])
    np.testing.assert_allclose(rate[0][COLOURS[0]][1], [[9, 3 / 7_000]])
    low, high = drawn[1].axes[0].get_ylim()
    assert low == pytest.approx(0.8 * 3 / 7_000) and high > 0.99  # the fit and all counts are seen


def test_counts_of_both_polarities_are_shaded_by_their_logarithm(monkeypatch):
    """None is the darkest, the most the brightest; squares lie about their whole counts, equal ones on the line."""
    counts = np.zeros((12, 12))
    counts[2, 9], counts[5, 5] = 399.0, 19.0
    monkeypatch.setattr(event_report, "svg", lambda figure: figure)
    axes = event_report._on_off("lit", {"figure_on_off_lit": counts, "figure_on_off_lit_top": np.array(11.5)}).axes[0]
    image, line = axes.images[0], axes.lines[0]
    np.testing.assert_allclose(image.norm([0.0, 19.0, 399.0]), [0, 0.5, 1])  # 20² is 400
    assert image.get_extent() == [-0.5, 11.5, -0.5, 11.5] and image.origin == "lower"
    assert np.array_equal(line.get_xydata(), [[0, 0], [11.5, 11.5]])
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("ON events", "OFF events")
    assert event_report._on_off("dark", {}) == ""
