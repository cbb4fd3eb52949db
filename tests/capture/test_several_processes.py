"""Runs that several processes render: the recording of one process, and one clear error where a process ends."""

import json
import os
import signal

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.core.errors import BackendError, ConflictError, RangeError
from hesim_render.core.journal import Journal
from hesim_render.core.workers import Workers
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.pair_tracer import PairTracer
from hesim_render.sources.render.change_driven.part_worker import start
from hesim_render.sources.render.change_driven.row_shares import RowShares, SharedBlocks

MAINS = {"light.waveform": {"type": "mains", "frequency_hz": 50, "depth": 0.4}}
#: Scene, its changes, sensor, region and length of the run: events and frames, ticks before a moving camera, a still
#: scene under two lights, and light that bounces.
RUNS = {
    "asynchronous": ("rotating-star", {}, "davis346", (52, 44, 130, 70), 0.011),
    "ticks": ("camera-sweep", {}, "gen2", (192, 160, 1600, 1000), 0.012),
    "flicker": ("colorchecker", MAINS, "gen2", (32, 48, 1200, 800), 0.008),
    "paths": ("glass-and-metal", {}, "davis346", (16, 34, 170, 110), 0.002),
}


def record(name, out=None, **options):
    scene, changes, sensor, region, duration_s = RUNS[name]
    cropped = hr.load_sensor(sensor).crop(*region)
    given = {"duration_s": duration_s, "seed": 11, "progress": False, "max_minutes": None, **options}
    return hr.simulate(hr.load_scene(scene, changes), cropped, out=out, **given)


def files_in(folder):
    """Bytes of all files, and what the manifest says but for the rays that neighbours of two workers took."""
    files = {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    manifest = json.loads(files.pop("recording.json"))
    return files, manifest, manifest["settings"]["render"].pop("pilot_rays")


@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n == "asynchronous" else pytest.mark.slow) for n in RUNS])
def test_the_recording_is_that_of_one_process(name, tmp_path, monkeypatch):
    record(name, tmp_path / "one")
    # this process traces nothing itself
    for method in ("_trace_block", "_edge_block", "_pilot_block"):
        monkeypatch.setattr(PairTracer, method, None)
    record(name, tmp_path / "three", workers=3)
    (files, manifest, rays), (others, stated, more) = (files_in(tmp_path / each) for each in ("one", "three"))
    assert files == others and len(files) > 3
    assert manifest == stated
    # rows beside those of another worker are looked at twice
    assert rays <= more < 2.5 * rays


def test_what_rests_and_how_many_rays_were_traced_is_known_here():
    """The audit asks this process which pixels are constant; progress counts the rays of all processes."""
    scene, _, sensor, region, _ = RUNS["asynchronous"]
    lamp = {"type": "point", "illuminant": "D65", "illuminance_lux": 1700, "position_m": [0.1, 0.2, 3]}
    scene = hr.load_scene(scene, {"light": lamp, "camera.fit_margin": 0.1})
    cropped, told = hr.load_sensor(sensor).crop(*region), []
    with start(2) as workers:
        one = ChangeDrivenFlux(scene, cropped, seed=3)
        two = ChangeDrivenFlux(scene, cropped, seed=3, workers=workers, progress=told.append)
        pixels = cropped.layout.evs_pixel.ravel()[5:]
        for flux in (one, two):
            for _ in flux.flux_of_blocks(pixels, flux.sample_blocks(30, 0, 1500)):
                pass
        rests = one.still_pixels(pixels)
        assert 0 < rests.sum() < rests.size
        np.testing.assert_array_equal(two.still_pixels(pixels), rests)
        assert told == sorted(told) and len(told) >= 4 and told[-1] == two.rays_traced > one.rays_traced


@pytest.mark.slow
def test_a_run_goes_on_with_what_its_workers_have_rendered(tmp_path, monkeypatch):
    out, entries, answers = tmp_path / "out", [0, 0, 0], 0
    keep, answer = Journal.keep, RowShares.answer

    def counted(journal, key, values):
        entries[run] += 1
        keep(journal, key, values)

    def stopped(shares, ticket):
        nonlocal answers
        answers += 1
        if run == 1 and answers == 10:
            raise KeyboardInterrupt
        return answer(shares, ticket)

    monkeypatch.setattr(Journal, "keep", counted)
    monkeypatch.setattr(RowShares, "answer", stopped)
    for run, target in enumerate((tmp_path / "whole", out, out)):
        if run == 1:
            answers = 0
            with pytest.raises(KeyboardInterrupt):
                record("asynchronous", target, workers=2, resume=True)
            assert [path.name for path in tmp_path.iterdir() if path.name != "whole"] == [".out.unfinished"]
        else:
            record("asynchronous", target, workers=2, resume=True)
    assert files_in(out) == files_in(tmp_path / "whole")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "whole"]
    # the third run has traced what the second one had not
    assert entries[1] > 0 and entries[2] == entries[0] - entries[1]


def test_estimates_are_measured_before_any_process_starts(monkeypatch):
    """Processes that start take the time of the rays whose speed is measured."""

    def told(expected):
        assert expected.rays > 0
        raise InterruptedError

    monkeypatch.setattr(Workers, "_start", None)
    with pytest.raises(InterruptedError):
        record("asynchronous", workers=2, on_estimate=told)


def test_a_worker_that_dies_ends_the_run_and_leaves_nothing(tmp_path, monkeypatch):
    through = SharedBlocks.through

    def killed(blocks, *given):
        os.kill(blocks._shares._workers._processes[1].pid, signal.SIGKILL)
        return through(blocks, *given)

    monkeypatch.setattr(SharedBlocks, "through", killed)
    with pytest.raises(BackendError, match=r"a worker process of the run has ended \(signal 9\)"):
        record("asynchronous", tmp_path / "out", workers=2)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("workers", [0, -2, 65, 1.5, "2"])
def test_numbers_of_workers_are_checked(workers):
    with pytest.raises(RangeError, match=r"workers is .* expected a whole number of processes, 1 to 64"):
        record("asynchronous", workers=workers)


def test_a_scene_that_needs_the_exact_mode_says_that_workers_change_nothing():
    sensor = hr.load_sensor("reference-bayer", {"lens.veiling_glare": 0.3}).crop(16, 12)
    with pytest.warns(hr.HesimWarning, match="needs the exact mode, which renders in one process"):
        hr.simulate(hr.load_scene("colorchecker"), sensor, duration_s=0.02, workers=2, progress=False)


def test_workers_render_in_the_default_mode_alone():
    with pytest.raises(ConflictError, match="the exact mode renders in one process"):
        record("asynchronous", workers=2, samples=8)
    with pytest.raises(ConflictError, match="a renderer that is given renders in this process"):
        record("asynchronous", workers=2, renderer=object())
