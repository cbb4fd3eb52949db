"""Other event simulators in the same light: what they are given, what they give back, and how it is measured."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from steps import Steps

import hesim_render as hr
from hesim_render import cli
from hesim_render.benchmark import peers
from hesim_render.benchmark.metrics import nearest_us, quiet_rates, timing
from hesim_render.benchmark.peer_run import (
    PeerError,
    encoded,
    exposures_us,
    pictures,
    read_events,
    run_peer,
    version_of,
)
from hesim_render.benchmark.peers import compare_peers, peers_table
from hesim_render.capture.scene_renderer import scene_renderer
from hesim_render.core.errors import SpecError
from hesim_render.pixels.evs.events import EVENT_DTYPE
from hesim_render.sources.render.light_level import in_absolute_light
from hesim_render.specs.peers import PeersSpec, read_peers

SHAPE = (12, 16)
#: An ideal event pixel, written for this test: log intensity is linear between pictures, and each crossing is an event.
IDEAL = """
import json, sys
from pathlib import Path
import numpy as np
from PIL import Image

if sys.argv[1:] == ["--version"]:
    print("ideal 1.0")
    sys.exit()
folder, out = map(Path, sys.argv[1:])
told = json.loads((folder / "settings.json").read_text())
times = np.loadtxt(folder / "timestamps.txt")
top = 2 ** told["bits"] - 1
level = [np.log(np.maximum(np.asarray(Image.open(folder / f"{k:06d}.png")) / top, 1e-6)) for k in range(len(times))]
found = []
for y, x in np.ndindex(level[0].shape):
    reference = level[0][y, x]
    for k in range(1, len(times)):
        a, b = level[k - 1][y, x], level[k][y, x]
        while b - reference >= told["contrast_threshold_on"]:
            reference += told["contrast_threshold_on"]
            found.append((times[k - 1] + (reference - a) / (b - a) * (times[k] - times[k - 1]), x, y, 1))
        while reference - b >= told["contrast_threshold_off"]:
            reference -= told["contrast_threshold_off"]
            found.append((times[k - 1] + (reference - a) / (b - a) * (times[k] - times[k - 1]), x, y, 0))
np.save(out, np.array(found).reshape(-1, 4))
"""


def stream(*events):
    made = np.zeros(len(events), EVENT_DTYPE)
    for k, (t, x, y, p) in enumerate(events):
        made[k] = (t, x, y, p)
    return made


def random_stream(rng, count):
    made = np.zeros(count, EVENT_DTYPE)
    made["t_us"], made["x"] = np.sort(rng.integers(0, 20_000, count)), rng.integers(0, SHAPE[1], count)
    made["y"], made["polarity"] = rng.integers(0, SHAPE[0], count), rng.choice([-1, 1], count)
    return made


def test_nearest_events_are_those_of_a_search_one_by_one():
    rng = np.random.default_rng(1)
    a, b = random_stream(rng, 300), random_stream(rng, 500)
    found = nearest_us(a, b, SHAPE)
    for event, time in zip(a, found, strict=True):
        same = b[(b["x"] == event["x"]) & (b["y"] == event["y"]) & (b["polarity"] == event["polarity"])]
        off = same["t_us"] - event["t_us"]
        assert abs(time) == (np.abs(off).min() if len(off) else np.inf)
        assert not np.isfinite(time) or time in off
    assert np.isinf(nearest_us(a, b[:0], SHAPE)).all() and len(nearest_us(b[:0], a, SHAPE)) == 0


def test_times_and_rates_of_streams_made_by_hand():
    truth = stream((1000, 2, 3, 1), (2000, 2, 3, 1), (3000, 5, 5, -1), (4000, 9, 9, 1))
    made = stream((1100, 2, 3, 1), (2300, 2, 3, 1), (3000, 5, 5, 1), (7000, 9, 9, 1), (8000, 13, 2, -1))
    found = timing(made, truth, SHAPE, 1000)
    # the OFF event has the wrong sign, and the last true one is answered 3 ms late
    assert found["missed"] == 0.5 and found["extra"] == 0.6
    assert found["delay_us"] == 200 and found["timing_us"] == 200 and found["timing_90_us"] == pytest.approx(280)
    early = timing(stream((900, 2, 3, 1)), truth[:1], SHAPE, 1000)
    assert early["delay_us"] == -100 and early["timing_us"] == 100
    assert np.isnan(timing(made[:0], truth, SHAPE, 1000)["timing_us"])
    quiet = quiet_rates(made, truth, SHAPE, 500_000)
    # 192 pixels less three blocks of 3×3, which do not overlap
    assert quiet["quiet_pixels"] == 192 - 27 and quiet["quiet_on_hz"] == 0
    assert quiet["quiet_off_hz"] == pytest.approx(1 / (165 * 0.5))


def test_what_a_peer_loses_is_named():
    """Streams of one law lose nothing that matters; twice the rate does; few events have a reason."""
    rng = np.random.default_rng(4)
    truth, same, half = (peers._statistics(random_stream(rng, n)[:n], SHAPE, 0, 20_000) for n in (60, 60, 30))
    assert (
        "no_distances" in peers._distances(truth, same)
        and "true events" in peers._distances(truth, same)["no_distances"]
    )

    def long(count):
        made = random_stream(rng, count)
        made["t_us"] = np.sort(rng.integers(0, 90_000, count))
        return made

    truth, same, half = (peers._statistics(long(n), SHAPE, 0, 90_000) for n in (6000, 6000, 3000))
    assert "rate" not in peers._distances(truth, same)["loses"]
    found = peers._distances(truth, half)
    assert "rate" in found["loses"] and found["distances"]["rate"]["value"] == pytest.approx(np.log(2), rel=0.02)
    rows = [{"scene": "s", "fps": 9.0, "peer": "p", "events": 3, "true_events": 6000, **found}]
    table = peers_table({"rows": rows, "peers": {"p": {"version": "1"}}})
    assert "| distance from the true events | rate |" in table and "| p | 0.69" in table and "*" in table


def test_pictures_are_encoded_as_asked_for():
    values = np.array([[0.0, 50.0, 100.0, 250.0]], np.float32)
    assert encoded(values, 100, "linear", 8).tolist() == [[0, 128, 255, 255]]
    assert encoded(values, 100, "linear", 16).tolist() == [[0, 32768, 65535, 65535]]
    # IEC 61966-2-1 of 0.5
    assert encoded(values, 100, "srgb", 8)[0, 1] == round(255 * (1.055 * 0.5 ** (1 / 2.4) - 0.055))
    assert exposures_us(10_000, 300, 0.5) == pytest.approx(np.array([[0, 5e3], [1e4, 1.5e4], [2e4, 2.5e4]]) / 3)


@pytest.fixture
def spec(tmp_path):
    """A comparison with the ideal peer, one that is not there, and one that fails."""
    (tmp_path / "ideal.py").write_text(IDEAL)
    (tmp_path / "broken.py").write_text("import sys\nprint('1') if '--version' in sys.argv else sys.exit('no light')")
    content = {
        "schema_version": 1, "name": "test", "description": "", "scenes": ["rotating-star"],
        "sensor": {"sensor": "davis346", "roi": f"{SHAPE[1]}x{SHAPE[0]}"}, "duration_s": 0.05, "fps": [500],
        "peers": [
            {"name": "ideal", "command": [sys.executable, "ideal.py"], "bits": 16},
            {"name": "coarse", "command": [sys.executable, "ideal.py"], "bits": 8, "encoding": "srgb"},
            {"name": "absent", "command": ["venv-none/bin/python", "x.py"]},
            {"name": "broken", "command": [sys.executable, "broken.py"]},
        ],
    }  # fmt: skip
    return PeersSpec.model_validate(content).model_copy(update={"folder": tmp_path})


@pytest.fixture
def light(monkeypatch):
    """A wave in closed form in place of the render: ln Φ = 14 + 0.8 sin(2π (40 t + x / 9)), the top rows still.

    The truth has an event at each crossing of a multiple of the threshold from the value at the first picture.
    """
    y, x = np.indices(SHAPE)
    depth = np.where(y < 4, 0.0, 0.8)

    def level(t_us):
        return 14 + depth * np.sin(2 * np.pi * (40e-6 * np.asarray(t_us)[..., None, None] + x / 9))

    def true_events(spec):
        times = np.arange(1000, spec.duration_us, 2.0)  # dense: at most 0.0004 of log intensity from one to the next
        found = []
        values = level(times)
        for row, col in np.ndindex(SHAPE):
            reference = values[0, row, col]
            steps = np.trunc((values[:, row, col] - reference) / 0.2).astype(int)
            held = 0
            for k in np.flatnonzero(np.diff(steps, prepend=0)):
                # an event where the level is a whole threshold from that of the last event
                while (values[k, row, col] - reference) / 0.2 - held >= 1:
                    held += 1
                    found.append((times[k], col, row, 1))
                while (values[k, row, col] - reference) / 0.2 - held <= -1:
                    held -= 1
                    found.append((times[k], col, row, -1))
        return np.sort(np.array(found, dtype=EVENT_DTYPE), order="t_us")

    def ours(scene, sensor, spec):
        truth = true_events(spec)
        return peers._Ours(truth, truth, {}, 0.0)

    def given(scene, sensor, times, seed, quality):
        yield from np.exp(level(times.mean(axis=1))).astype(np.float32)

    monkeypatch.setattr(peers, "_our_events", ours)
    monkeypatch.setattr(peers, "pictures", given)


def test_an_ideal_peer_agrees_and_coarse_pictures_cost_events(spec, light, tmp_path):
    """500 pictures/s of a wave of 40 Hz; the ideal pixel interpolates ln Φ between them, within 0.003 of it."""
    told = Steps()
    result = compare_peers(spec, tmp_path / "r.json", run_programs=True, progress=told)
    told.count(last=1)  # our own events come first, then those of one rate of pictures
    assert told[0][:2] == (1, 2)
    rows = {row["peer"]: row for row in result["rows"]}
    assert rows[peers.OURS]["count_error"] == 0 and rows[peers.OURS]["timing_us"] == 0
    ideal, coarse = rows["ideal"], rows["coarse"]
    assert ideal["true_events"] > 1500 and abs(ideal["count_error"]) < 0.03
    assert ideal["timing_us"] < 150 and ideal["missed"] < 0.02 and ideal["extra"] < 0.02
    assert ideal["quiet_on_hz"] == ideal["quiet_off_hz"] == 0 and ideal["quiet_pixels"] == 3 * 16
    # sRGB has 0.42 of the contrast or so, and a pixel needs a whole threshold before its first event
    assert -0.75 < coarse["count_error"] < -0.5
    assert "no light" in rows["broken"]["error"] and "absent" not in rows
    assert result["peers"]["ideal"] == {"version": "ideal 1.0"} and "missing" in result["peers"]["absent"]
    stored = json.loads((tmp_path / "r.json").read_text())
    assert stored["rows"][1]["events"] == ideal["events"]
    table = peers_table(result)
    assert "| ideal |" in table and "failed: exit status 1: no light" in table and "absent: missing" in table


def test_what_a_peer_writes_is_checked(spec, tmp_path):
    peer, out = spec.peers[0], tmp_path / "e.npy"
    for table, message in (
        (np.zeros((3, 3)), r"expected numbers \[event, 4\]"),
        (np.array([[0, 16, 0, 1.0]]), "x 16 in event 0; expected 0 to 15"),
        (np.array([[0, 0, 0, 1.0], [9e6, 0, 0, 1]]), "t_us 9e[+]06 in event 1"),
        (np.array([[np.nan, 0, 0, 1.0]]), "t_us nan"),
    ):
        np.save(out, table)
        with pytest.raises(PeerError, match=message):
            read_events(out, SHAPE, 50_000)
    np.save(out, np.array([[200.4, 1, 2, 0], [100, 3, 4, 1.0]]))
    assert read_events(out, SHAPE, 50_000).tolist() == [(100, 3, 4, 1), (200, 1, 2, -1)]
    np.save(out, np.array([{}]), allow_pickle=True)
    with pytest.raises(SpecError, match="is an array of objects"):
        read_events(out, SHAPE, 50_000)
    with pytest.raises(PeerError, match="wrote no events file"):
        read_events(tmp_path / "none.npy", SHAPE, 50_000)
    slow = peer.model_copy(update={"command": (sys.executable, "-c", "import time; time.sleep(60)"), "timeout_s": 0.3})
    with pytest.raises(PeerError, match=r"took more than 0\.3 s"):
        run_peer(slow, tmp_path, tmp_path, out, SHAPE, 50_000)
    # a peer must not find modules of this process
    told = (sys.executable, "-c", "import os; print('PYTHONPATH' in os.environ)")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", "/somewhere")
        assert version_of(peer.model_copy(update={"command": told}), tmp_path) == "False"


def test_the_command_reports_and_refuses(tmp_path, spec, light, capsys):
    file = tmp_path / "peers.yaml"
    content = spec.model_dump(mode="json") | {"peers": [spec.model_dump(mode="json")["peers"][0]]}
    file.write_text(json.dumps(content))
    with pytest.raises(SystemExit) as end:
        cli.main(["benchmark", "peers", str(file), "--run-programs", "--out", str(tmp_path / "o.json")])
    assert not end.value.code and "| ideal |" in capsys.readouterr().out and (tmp_path / "o.json").is_file()
    broken = content["peers"][0] | {"command": [sys.executable, "broken.py"]}
    file.write_text(json.dumps(content | {"peers": [broken]}))
    with pytest.raises(SystemExit) as end:
        cli.main(["benchmark", "peers", str(file), "--run-programs"])
    assert end.value.code == 1 and "no light" in capsys.readouterr().out
    file.write_text(json.dumps(content | {"fps": [10]}))
    with pytest.raises(SpecError, match="fewer than three pictures"):
        read_peers(file)
    file.write_text(json.dumps(content | {"peers": [content["peers"][0]] * 2}))
    with pytest.raises(SpecError, match="each name once"):
        read_peers(file)
    with pytest.raises(SpecError, match="has no event pixels"):
        compare_peers(
            spec.model_copy(update={"sensor": spec.sensor.model_copy(update={"sensor": "imx477"})}), run_programs=True
        )


def test_a_file_runs_no_program_unless_told_so(tmp_path, spec, capsys):
    """Not even to ask for a version."""
    mark = tmp_path / "ran"
    touch = [sys.executable, "-c", f"open({str(mark)!r}, 'w')"]
    content = spec.model_dump(mode="json")
    file = tmp_path / "peers.yaml"
    file.write_text(json.dumps(content | {"peers": [content["peers"][0] | {"command": touch}]}))
    with pytest.raises(SystemExit) as end:
        cli.main(["benchmark", "peers", str(file)])
    told = capsys.readouterr().err
    assert end.value.code == 2 and "give --run-programs" in told and sys.executable in told
    with pytest.raises(SpecError, match="run_programs=True"):
        compare_peers(file)
    assert not mark.exists()


@pytest.mark.slow
def test_pictures_are_the_light_of_the_sensor(tmp_path):
    """Pictures of a turning star against the mean flux of a source of its own seed, over more than two blocks."""
    sensor, scene = hr.load_sensor("davis346").crop(24, 16), hr.load_scene("rotating-star")
    times = exposures_us(40_000, 1000, 1.0)
    made = np.stack(list(pictures(scene, sensor, times, 7, 0.5)))
    assert made.shape == (40, 16, 24)
    flux = scene_renderer(in_absolute_light(scene)[0], sensor, 8, 0.25)
    pixel = sensor.layout.evs_pixel.ravel()
    for k in (0, 17, 39):
        a, b = flux.mean_flux(pixel, *times[k])
        expected = 0.5 * (np.array(a) + np.array(b)).reshape(16, 24)
        off = np.log(made[k] / expected)
        assert np.sqrt(np.mean(off**2)) < 0.02 and abs(off.mean()) < 0.004, k
    assert np.abs(np.log(made[39] / made[0])).max() > 0.3  # the star has turned


@pytest.mark.slow
def test_the_noise_free_events_are_those_of_an_ideal_pixel_in_the_same_light(spec):
    """The truth of the comparison against a pixel written for this test, in 4000 pictures/s of 16 bit."""
    sized = {"sensor": spec.sensor.model_copy(update={"roi": "24x18"}), "duration_s": 0.03, "fps": (4000.0,)}
    result = compare_peers(
        spec.model_copy(update={**sized, "peers": spec.peers[:2], "quality": 0.25}), run_programs=True
    )
    print(peers_table(result))
    rows = {row["peer"]: row for row in result["rows"]}
    assert rows["ideal"]["true_events"] > 200
    assert abs(rows["ideal"]["count_error"]) < 0.05 and rows["ideal"]["timing_us"] < 200
    assert rows["coarse"]["count_error"] < -0.3


@pytest.mark.slow
def test_programs_that_are_installed_here_run():
    """Those of benchmarks/peers/peers.yaml whose environments lie beside it, as the file says."""
    file = Path(__file__).parents[2] / "benchmarks" / "peers" / "peers.yaml"
    spec = read_peers(file, {"sensor.roi": "24x18", "duration_s": 0.02, "fps": [1000]})
    there = tuple(peer for peer in spec.peers if (file.parent / peer.command[0]).exists())
    if not there:
        pytest.skip("no peer is installed")
    result = compare_peers(spec.model_copy(update={"peers": there}), run_programs=True)
    print(peers_table(result))
    rows = {row["peer"]: row for row in result["rows"]}
    assert not [row for row in result["rows"] if "error" in row]
    # those that keep a reference level, without noise; one that compares neighbouring pictures alone gives none here
    for name in {"evlib-linear", "eventcv"} & set(rows):
        assert abs(rows[name]["count_error"]) < 0.2 and rows[name]["timing_us"] < 1500, rows[name]
