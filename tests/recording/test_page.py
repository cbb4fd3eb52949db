"""Plots, web page and short forms of a recording."""

import re
import sys
from html.parser import HTMLParser

import numpy as np
import pytest
import recordings

import hesim_render as hr
from hesim_render.cli import main
from hesim_render.recording.outline import parameters
from hesim_render.recording.page import write_page
from hesim_render.recording.recording import Recording


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page") / "recording"
    sensor = hr.load_sensor("gen2", {"evs.contrast_threshold_on": 0.03}).crop(64, 48)
    hr.simulate(hr.load_scene("colorchecker"), sensor, duration_s=0.06, out=folder, exact=True, samples=512)
    return Recording.load(folder)


class Checker(HTMLParser):
    """Fails where elements are not closed in order; keeps what the page refers to."""

    def __init__(self):
        super().__init__()
        self.open, self.sources = [], []

    def handle_starttag(self, tag, attrs):
        self.sources += [
            value for key, value in attrs if key in ("src", "href") and not value.startswith(("#", "data:"))
        ]
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_is_whole_and_names_only_files_of_the_recording(recording, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["view", str(recording.path)])
    assert stop.value.code == 0 and "recording.html" in capsys.readouterr().out
    text = (recording.path / "recording.html").read_text(encoding="utf-8")
    page = Checker()
    page.feed(text)
    assert page.open == [] and "preview.png" in page.sources
    assert all((recording.path / source).is_file() for source in page.sources)
    for _, value in parameters(recording):
        assert value in text
    assert text.count("<svg") == 2 and "colorchecker" in text and "contrast_threshold_on" in text
    assert "max-width:none" in text and "grid-template-columns" in text  # the whole window, with parts side by side
    # twice the same bytes
    write_page(recording, recording.path)
    assert (recording.path / "recording.html").read_text(encoding="utf-8") == text


def test_the_page_has_the_audit_in_the_words_of_the_commands(tmp_path):
    made = recordings.make("davis346", tmp_path / "r")
    part = {"deviation_noise": {"rms": 0.4}, "off": 0.03, "off_at_most": 0.041}
    audit = {"tolerance_noise": 1.5, "verdict": "not met", "quality_needed": 0.21, "frames": part}
    render = {"error_noise": {"frames": {"rms": 0.3, "p95": 0.6, "p99": 0.8}}, "quality": 0.5, "audit": audit}
    for given, told in (
        (
            render,
            ["audit, frames: true deviation rms 0.4; 3 % of values are off", "<p class=findings>NOT MET: this run is"],
        ),
        ({**render, "audit": {}}, ["No audit: nothing was rendered again"]),
    ):
        made.manifest["settings"]["render"] = given
        text = write_page(made, made.path).read_text(encoding="utf-8")
        assert all(words in text for words in told)


def test_plots_hold_all_events_and_all_pixels(recording):
    figure = recording.plot()
    drawn = {axes.get_title(loc="left"): axes for axes in figure.axes}
    rates = drawn["Events"]
    total = 0.0
    for artist in rates.patches:
        values, edges, _ = artist.get_data()
        total += np.sum(values * np.diff(edges))
    assert total == pytest.approx(recording.events.size, rel=1e-6) and recording.events.size > 10
    (histogram,) = (axes for title, axes in drawn.items() if title.startswith("RAW values"))
    counted = sum(np.sum(artist.get_data()[0]) for artist in histogram.patches)
    assert counted == recording.frames[len(recording.frames) // 2].valid.sum()


def test_recordings_without_frames_or_without_events_have_plots_and_pages(tmp_path):
    for name in ("imx636", "reference-bayer"):
        sensor = hr.load_sensor(name).crop(24, 16)
        found = hr.simulate(hr.load_scene("dark"), sensor, duration_s=0.002, out=tmp_path / name)
        found.plot().savefig(tmp_path / f"{name}.png")
        assert write_page(found, found.path).is_file()
        assert "no frames" in repr(sensor) or "events on" not in repr(found)


def test_short_forms_say_what_a_thing_is(recording):
    assert re.match(r"<Recording of 'colorchecker' by 'gen2': 0\.06 s; \d+ frames? of 64x48 px; ", repr(recording))
    assert str(recording.path) in repr(recording)
    for thing, text in (
        (recording, "colorchecker"), (recording.frames[0], "exposure_us"), (hr.load_sensor("eiger"), "eiger"),
        (hr.load_scene("dark"), "dark"),
    ):  # fmt: skip
        html = thing._repr_html_()
        page = Checker()
        page.feed(html)
        assert page.open == [] and text in html
        assert ("data:image/png" in html) == (thing is recording or "exposure" in html)


def test_the_picture_of_a_frame_is_not_that_of_a_dark_one():
    frame = recordings.frame_of(recordings.sensor_like("gen2"))
    dark = type(frame)(
        np.zeros_like(frame.raw), frame.valid, frame.electrons_mean, frame.electrons_stderr, **frame.times
    )
    assert len(frame._repr_html_()) > 3 * len(dark._repr_html_())


def test_without_rerun_a_view_is_as_before_and_its_file_is_refused(recording, capsys, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "rerun", None)
    for more, status in (["--no-viewer"], 0), (["--rrd", str(tmp_path / "r.rrd")], 2):
        with pytest.raises(SystemExit) as ended:
            main(["view", str(recording.path), *more])
        assert ended.value.code == status
    assert "pip install 'rerun-sdk>=" in capsys.readouterr().err and not any(tmp_path.iterdir())
