"""A run that was interrupted and goes on gives the bytes of one that ran through."""

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.core.errors import OutputError
from hesim_render.core.journal import Journal
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.pair_tracer import PairTracer
from hesim_render.sources.render.exact import RenderedFlux
from hesim_render.sources.render.tracer import PixelTracer

MAINS = {"light.waveform": {"type": "mains", "frequency_hz": 50, "depth": 0.4}}
#: scene, its changes, sensor, options: the default mode, the exact one, static scenes, and two lights.
RUNS = {
    "moving": ("rotating-star", {}, "gen2", {"truth": ["depth", "events"]}),
    "exact": ("rotating-star", {}, "gen2", {"samples": 8192}),
    "static": ("colorchecker", {}, "eiger", {}),
    "exact static": ("colorchecker", {}, "eiger", {"samples": 8192}),
    "flicker": ("colorchecker", MAINS, "gen2", {}),
    "asynchronous": ("rotating-star", {}, "davis346", {}),
}


def record(name, out, *, stop_after=None, monkeypatch=None, **more):
    """Simulate; the calls of the tracer that did work which is kept. `stop_after` so many of them comes Ctrl-C.

    Pilots whose single rays are compared are not kept: they are a small part, and large.
    """
    scene, changes, sensor, options = RUNS[name]
    calls = 0
    with monkeypatch.context() as patch:
        for kind, method in ((PairTracer, "_trace_block"), (PairTracer, "_edge_block"), (PixelTracer, "_block")):
            work = getattr(kind, method)

            def counted(*given, call=work, **named):
                nonlocal calls
                if calls == stop_after:
                    raise KeyboardInterrupt
                calls += 1
                return call(*given, **named)

            patch.setattr(kind, method, counted)
        given = {"duration_s": 0.012, "seed": 5, "resume": True, **options, **more}
        hr.simulate(hr.load_scene(scene, changes), hr.load_sensor(sensor).crop(24, 16), out=out, **given)
    return calls


def bytes_in(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n == "moving" else pytest.mark.slow) for n in RUNS])
def test_an_interrupted_run_goes_on_and_gives_the_same_bytes(name, tmp_path, monkeypatch):
    every = record(name, tmp_path / "whole", monkeypatch=monkeypatch)
    stop, out = every // 3, tmp_path / "out"
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            record(name, out, stop_after=stop, monkeypatch=monkeypatch)
        assert [path.name for path in tmp_path.iterdir() if path.name != "whole"] == [".out.unfinished"]
    live = record(name, out, monkeypatch=monkeypatch)
    assert bytes_in(out) == bytes_in(tmp_path / "whole")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "whole"]
    # both interrupted runs have done their share
    assert stop > 0 and live <= every - 2 * stop


def test_filters_whose_glare_is_traced_at_the_same_pixels_are_told_apart(tmp_path):
    """Of one run, whose journal holds the glare of one filter when that of the next one is traced."""
    sensor = hr.load_sensor("reference-bayer", {"lens.veiling_glare": 0.3}).crop(16, 12)
    given = {"duration_s": 0.02, "seed": 3, "samples": 16, "clean": True}
    first, other = (
        hr.simulate(hr.load_scene("colorchecker"), sensor, out=tmp_path / str(resume), resume=resume, **given)
        for resume in (False, True)
    )
    np.testing.assert_array_equal(first.frames[0].electrons_mean, other.frames[0].electrons_mean)


def test_another_command_does_not_go_on(tmp_path, monkeypatch):
    with pytest.raises(KeyboardInterrupt):
        record("exact static", tmp_path / "out", stop_after=1, monkeypatch=monkeypatch, overwrite=True, samples=8192)
    (journal,) = tmp_path.iterdir()
    with pytest.raises(OutputError, match=r"interrupted run.*differs in seed;"):
        record("exact static", tmp_path / "out", monkeypatch=monkeypatch, seed=6, samples=8192)
    assert list(tmp_path.iterdir()) == [journal]
    record("exact static", tmp_path / "out", monkeypatch=monkeypatch, seed=6, samples=4, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.slow
@pytest.mark.parametrize("exact", [False, True])
def test_entries_are_told_apart_by_all_that_they_depend_on(exact, tmp_path):
    """The same pixels in other windows, and of another part of the light; each twice, the second time from the file."""
    sensor, pixel = hr.load_sensor("gen2").crop(24, 16), np.arange(384, dtype=np.uint32)
    scenes = [hr.load_scene("rotating-star", {"light.illuminance_lux": lux}) for lux in (100, 300)]

    def sources():
        if exact:
            return [RenderedFlux(scene, sensor, samples=4, seed=3) for scene in scenes]
        return [ChangeDrivenFlux(scene, sensor, seed=3) for scene in scenes]

    asked = [(number, window) for window in ((0, 1000), (0, 30_000), (9000, 30_000)) for number in (0, 1)]
    made = sources()
    expected = [np.array(made[number].mean_flux(pixel, *window)) for number, window in asked]
    assert len({values.tobytes() for values in expected}) == (4 if exact else 6)  # two windows in one slice of time
    for again in (False, True):
        with pytest.raises(KeyboardInterrupt), Journal(tmp_path / "out", {}) as journal:
            assert (journal.count > 0) == again
            made = sources()
            for number, source in enumerate(made):
                source.go_on(journal, number)
            for (number, window), values in zip(asked, expected, strict=True):
                np.testing.assert_array_equal(np.array(made[number].mean_flux(pixel, *window)), values)
            raise KeyboardInterrupt
