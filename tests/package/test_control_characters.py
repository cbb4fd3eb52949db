"""Names and texts of others hold no control characters, no HTML and no elements of pages where they are shown."""

import os
import subprocess

import pytest

import hesim_render as hr
from benchmarks import small
from hesim_render.benchmark.card import card
from hesim_render.core.child import child_environment, python_command, with_package
from hesim_render.core.drawing import panel, report_style, svg
from hesim_render.core.errors import SpecError
from hesim_render.core.shipped import data_folder
from hesim_render.recording.movie import _MOST_PICTURES, _pictures


@pytest.mark.parametrize("text", ["n \\e", "\\x9b1m", "\\x7f", "a\\rb", "\\0"])
def test_files_with_control_characters_are_refused_by_line_and_key(tmp_path, text):
    """A sensor of such a name ended a study in a traceback: it stood in a drawing."""
    (tmp_path / "s.yaml").write_text(
        (data_folder("sensors") / "reference-mono.yaml").read_text().replace("name: reference-mono", f'name: "{text}"')
    )
    with pytest.raises(SpecError, match=r"s\.yaml:\d+: name: .*holds a control character"):
        hr.load_sensor(tmp_path / "s.yaml")
    study = {"schema_version": 1, "name": "a\x1bb", "sensors": ["reference-bayer"], "filter_sets": ["rggb"]}
    with pytest.raises(SpecError, match=r"name: .*holds a control character"):
        hr.study(study)
    with pytest.raises(SpecError, match="holds a control character"):
        hr.study({**study, "name": "x", "a\x1bb": 1})


def test_texts_of_other_languages_and_with_several_lines_are_read():
    study = {
        "schema_version": 1, "name": "ö\xa0中\u3000文", "description": "a\n\tb", "sensors": ["reference-bayer"],
        "filter_sets": ["rggb"], "figures": ["noise"],
    }  # fmt: skip
    assert len(hr.study(study)) == 1


def test_a_drawing_holds_every_text():
    with report_style():
        figure, axes = panel("a\x1b\x00\ud800<b>", "x\n\x9b", "y")
        axes.plot([1, 2], [3, 5], label="\x08l")
        axes.legend()
        text = svg(figure)
    assert "\x1b" not in text and "a\\x1b\\x00\\ud800&lt;b&gt;" in text and "\\x08l" in text


def test_a_card_shows_texts_as_they_are():
    spec = small(description="<script>alert(1)</script>\n# big | ![x](http://x/y) `c` \x1b[2J").model_dump(mode="json")
    clip = {
        "split": "train", "scene": 0, "files": {}, "render": {}, "figures": {}, "sensor": "<b>|s", "exposure_us": None,
        "noise": "n", "seed": 7,
    }  # fmt: skip
    text = card({"name": "x", "spec": spec, "versions": {"hesim_render": "1"}}, [clip])
    assert "<script>" not in text and "&lt;script&gt;alert(1)" in text and "\x1b" not in text
    assert "\\# big \\| \\!\\[x\\](http://x/y) \\`c\\`" in text and "&lt;b&gt;\\|s" in text


@pytest.mark.slow
def test_an_orphaned_worker_ends_in_silence():
    """Its answers are read by nobody; the parent was killed."""
    code = with_package("from hesim_render.benchmark.worker import main; main()")
    reading, writing = os.pipe()
    worker = subprocess.Popen(
        python_command(code), env=child_environment(), stdin=subprocess.PIPE, stdout=writing, stderr=subprocess.PIPE
    )
    os.close(writing)
    os.close(reading)
    _, err = worker.communicate(b"{}\n0\n{}\n", timeout=60)
    assert (err, worker.returncode) == (b"", 0)


class Long:
    """A recording of events alone, of 71 minutes."""

    manifest = {"time": {"begin_us": 0, "end_us": 4_294_967_295}}
    frames = ()
    event_shape = (4, 6)

    def __init__(self):
        self.asked = []

    def event_slice(self, first, last):
        self.asked.append((first, last))
        return __import__("numpy").empty(0, hr.events.EVENT_DTYPE)


def test_a_long_recording_becomes_no_film_of_hours(monkeypatch):
    """A picture for each 10 ms would be 429,496 pictures, 4.8 hours of video."""
    monkeypatch.setattr("hesim_render.recording.movie.black_picture", lambda *_: None)
    monkeypatch.setattr("hesim_render.recording.movie.events_picture", lambda *_: None)
    long = Long()
    assert len(list(_pictures(long, "mp4-events"))) <= _MOST_PICTURES == len(long.asked)
    assert [b[0] for b in long.asked[1:]] == [a[1] for a in long.asked[:-1]] and long.asked[-1][1] == 4_294_967_296


def test_a_scale_of_light_beyond_all_lamps_is_refused():
    with pytest.raises(SpecError, match="radiance_scale"):
        hr.load_scene("cornell-box", {"mitsuba.radiance_scale": 5e17})
