"""calibration.yaml, its maps and the report: whole, readable, without anything from outside."""

import os
import re
from html.parser import HTMLParser

import capture_sets
import numpy as np
import pytest

from hesim_render.calibrate import calibrate_aps, calibrate_evs, read_calibration, read_maps, write_report
from hesim_render.calibrate.report.svg import Plot, number, ticks
from hesim_render.calibrate.result import plain
from hesim_render.core.errors import OutputError, SpecError


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
    assert read_maps(folder / "c.yaml", "aps")["n_dp"].shape == (64, 64)
    assert {what for what, _ in told} >= {"reading aps_dark.npz", "reading aps_lit.npz", "fitting", "done"}
    assert all(0 <= done <= 1 for _, done in told)
    calibrate_aps(folder / "set", folder / "c.yaml")
    assert "evs" in read_calibration(folder / "c.yaml")
    left = sorted(re.sub(r"-[0-9a-f]{12}\.npz", "-HASH.npz", p.name) for p in folder.iterdir())
    assert left == ["aps.html", "both.html", "c.yaml", "c_aps_maps-HASH.npz", "c_evs_maps-HASH.npz", "set"]


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
    assert all(link.startswith("data:image/png;base64,") for link in checker.links)
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
    assert checker.images >= 5 + 2 * 4
    assert not re.search(r"https?://(?!www\.w3\.org/2000/svg)", page)


def test_notes_cannot_break_the_page(tmp_path):
    capture_sets.write_events(tmp_path / "set", size=32, notes="'<script>alert(1)</script>'")
    calibrate_evs(tmp_path / "set", tmp_path / "c.yaml", tmp_path / "r.html")
    assert "<script>" not in (tmp_path / "r.html").read_text()


def test_cells_without_an_event_are_arrows_and_no_cell_is_missing(tmp_path, monkeypatch):
    """Few trials of a bright scene: most cells of it count nothing, and 0 is on no logarithmic axis."""
    drawn = {"points": [], "arrows_down": []}
    for name in drawn:
        monkeypatch.setattr(
            f"hesim_render.calibrate.report.events.Plot.{name}",
            lambda self, x, y, *rest, name=name, **more: drawn[name].append((self, x, y)) or self,
        )
    capture_sets.write_events(tmp_path / "set", size=32, trials=2000, brightest=120.0, c=0.001)
    calibrate_evs(tmp_path / "set", tmp_path / "c.yaml", tmp_path / "r.html")
    maps = read_maps(tmp_path / "c.yaml", "evs")
    signal, on, off, trials = maps["figure_rates"].T
    first = drawn["points"][0][0]  # the plot of rates against brightness: ON, then OFF
    points, arrows = ([(x, y) for plot, x, y in drawn[name] if plot is first] for name in drawn)
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


def test_axis_ticks_are_round():
    assert ticks(0, 1, 5) == [0, 0.2, 0.4, 0.6, 0.8, 1.0]
    assert ticks(-0.011, 0.011) == [-0.01, -0.005, 0.0, 0.005, 0.01]
    assert [number(v) for v in (0, 1234567, 0.25, 2e-4)] == ["0", "1.2e6", "0.25", "2.0e-4"]


def _texts(svg):
    """Each text of a drawing: its words, class and box (left, top, right, bottom), turned ones where they stand."""
    found = []
    for attributes, words in re.findall(r"<text ([^>]*)>([^<]*)</text>", svg):
        kind = re.search(r'class="([^"]*)"', attributes).group(1)
        if words == "":
            continue
        turned = re.search(r"translate\(([\d.-]+) ([\d.-]+)\)", attributes)
        wide = 6.6 * len(words)
        if turned:
            x, y = float(turned.group(1)), float(turned.group(2))
            found.append((words, kind, (x - 10, y - wide / 2, x + 2, y + wide / 2)))
            continue
        x, y = (float(re.search(rf'\b{name}="([\d.-]+)"', attributes).group(1)) for name in "xy")
        left = x - (wide if "end" in kind else 0 if "start" in kind or kind == "title" else wide / 2)
        found.append((words, kind, (left, y - 9, left + wide, y + 2)))
    return found


def test_no_text_of_a_drawing_lies_on_another_or_beyond_its_edge(both):
    page = (both[0] / "both.html").read_text(encoding="utf-8")
    drawings = re.findall(r"<svg .*?</svg>", page, re.S)
    assert len(drawings) > 12
    for svg in drawings:
        width, height = (int(n) for n in re.search(r'width="(\d+)" height="(\d+)"', svg).groups())
        texts = _texts(svg)
        for k, (words, kind, (left, top, right, bottom)) in enumerate(texts):
            assert left > -2 and top > -2 and bottom < height + 2, words
            assert right < width + (40 if kind == "title" else 6), words
            for other, _, box in texts[:k]:
                apart = right <= box[0] or box[2] <= left or bottom <= box[1] or box[3] <= top
                assert apart, (words, other)


def test_the_legend_stands_below_what_is_drawn():
    plot = Plot("t", "x", "y", (0, 1), (0, 1), size=(300, 200))
    for k in range(9):
        plot.points(np.array([0.5]), np.array([0.5]), "#000", f"{k} milliseconds")
    svg = plot.svg()
    boxes = [box for words, _, box in _texts(svg) if "milliseconds" in words]
    assert len(boxes) == 9 and min(box[1] for box in boxes) > 190 and max(box[2] for box in boxes) < 300
    assert max(box[3] for box in boxes) < int(re.search(r'height="(\d+)"', svg).group(1))


def test_no_dictionary_is_printed(tmp_path):
    keys = {"roi": "{x: 0, y: 4, width_px: 32, height_px: 32}", "signal_reference": "{k: 0.25, t_ref_us: 1000}"}
    capture_sets.write_events(tmp_path / "set", size=32, **keys)
    calibrate_evs(tmp_path / "set", tmp_path / "c.yaml", tmp_path / "r.html")
    page = re.sub(r"<style>.*?</style>", "", (tmp_path / "r.html").read_text(), flags=re.S)
    text = re.sub(r"<[^>]*>", " ", page)
    assert not re.search(r"[{}\[\]]|\b(None|True|False|dict|array)\b", text)
    assert "x 0, y 4, width_px 32, height_px 32" in text and "k 0.25, t_ref_us 1000.0, filter own" in text


def test_residuals_beyond_the_usual_are_drawn(both, monkeypatch):
    """Every point handed to a panel lies within its axes."""
    outside = []
    points = Plot.points

    def checked(self, x, y, *rest, **more):
        outside.append(len(x) - len(self._inside(x, y)))
        return points(self, x, y, *rest, **more)

    monkeypatch.setattr(Plot, "points", checked)
    write_report(both[0] / "c.yaml", both[0] / "again.html")
    (both[0] / "again.html").unlink()
    assert len(outside) > 10 and not any(outside)


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
