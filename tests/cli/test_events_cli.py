"""``calibrate recording`` and ``compare`` from the command line."""

import contextlib
import json

import numpy as np
import pytest

from hesim_render.cli import main
from hesim_render.cli.console import Console
from tests.support.bench_pixels import Pixels
from tests.support.event_files import written
from tests.support.still_pixels import random_events

SHAPE = (15, 21)


def call(capsys, *arguments):
    with pytest.raises(SystemExit) as stop:
        main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return stop.value.code, out, err


@pytest.fixture
def recordings(tmp_path):
    found = []
    for k, rate_hz in enumerate((24.0, 31.0)):
        (tmp_path / str(k)).mkdir()
        rates = np.full(SHAPE[0] * SHAPE[1], rate_hz)
        events = random_events(np.random.default_rng(k), rates, 180.0, seconds=1.2, shape=SHAPE)
        found.append(written(events, ("evt3", "npz")[k], tmp_path / str(k), SHAPE))
    return found


def test_calibrate_recording_prints_and_writes_every_figure(capsys, tmp_path, recordings):
    out = tmp_path / "found.yaml"
    options = ("--lux", "3,90", "--size", "21x15", "--out", out)
    status, text, _ = call(capsys, "calibrate", "recording", *recordings, *options)
    assert status == 0 and out.exists()
    assert "3 lx" in text and "θ₊                   not identifiable: it takes a recording of a moving target" in text
    status, text, _ = call(capsys, "calibrate", "recording", *recordings, *options, "--overwrite", "--json")
    found = json.loads(text)
    assert [one["lux"] for one in found["recordings"]] == [3.0, 90.0]
    assert found["recordings"][0]["on_rate_hz"]["value"] == pytest.approx(12, rel=0.1)
    status, _, err = call(capsys, "calibrate", "recording", *recordings, "--size", "21x15", "--lux", "3;90")
    assert status == 2 and "numbers with commas" in err
    np.savez(tmp_path / "bare.npz", t=[1, 2], x=[0, 1], y=[0, 1], p=[True, False])
    status, _, err = call(capsys, "calibrate", "recording", tmp_path / "bare.npz")
    assert status == 2 and "bare.npz" in err and "does not state the size" in err


def test_compare_prints_a_line_a_distance(capsys, recordings):
    status, text, _ = call(capsys, "compare", *recordings, "--size", "21x15")
    assert status == 0
    lines = {line.split("  ")[0]: line for line in text.splitlines()}
    assert lines["rate"].endswith("differs") and not lines["hot pixels"].endswith("differs")
    status, text, _ = call(capsys, "compare", *recordings, "--size", "21x15", "--json")
    seconds = json.loads(text)["seconds"]
    assert (
        f"over the first {seconds:.4g} s of each, which is all of the shorter one" in lines
        and seconds == pytest.approx(1.2, abs=0.01)
    )
    for one in json.loads(text)["distances"]:
        low, high = (f"{end:.4g}" for end in one["interval_95"])
        assert f"{one['value']:.4g}" in lines[one["name"]] and f" {low} to {high} " in lines[one["name"]]
        assert one["interval_95"][0] <= one["interval_95"][1]
    rate = json.loads(text)["distances"][0]
    assert rate["name"] == "rate" and rate["value"] == pytest.approx(np.log(31 / 24), abs=0.06)


def test_report_prints_its_figures_and_where_they_are(capsys, tmp_path):
    steady = Pixels(6)
    steady.steady_file(2.0, 20.0, (3.0, 2.0), 0.5, "a.npz")
    folder = steady.write(tmp_path / "captures")
    status, text, _ = call(capsys, "report", folder, "--out", tmp_path / "made")
    assert status == 0 and "threshold" in text and "in " in text
    assert {file.name for file in (tmp_path / "made").iterdir()} == {"report.html", "report.pdf", "report.json"}
    status, text, _ = call(capsys, "report", folder, "--out", tmp_path / "made", "--overwrite", "--json", "--quiet")
    assert json.loads(text)["pages"] >= 2
    status, _, err = call(capsys, "report", tmp_path / "gone", folder, "--out", tmp_path / "more")
    assert status == 2 and "gone" in err


def test_the_progress_of_a_comparison_rises_to_its_end(capsys, recordings, monkeypatch):
    shown = []

    @contextlib.contextmanager
    def display(self, title):
        yield lambda done, total, what: shown.append((done / total, what))

    monkeypatch.setattr(Console, "progress", display)
    assert call(capsys, "compare", *recordings, "--size", "21x15")[0] == 0
    parts, names = zip(*shown, strict=True)
    assert parts == pytest.approx((0, 0.4, 0.8)) and names == (*(f"read {file.name}" for file in recordings), "compare")
