"""Samples of the blocks of long runs, against blocks that are all listed."""

from itertools import islice, pairwise

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.capture.loop import Capture
from hesim_render.capture.run_settings import noise_models
from hesim_render.mosaic import schedule
from hesim_render.mosaic.schedule import blocks_of_run, exposures, instant_blocks, sample_of_blocks, tick_blocks
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux

#: 16 cells of 1 ms.
STRETCH_US = 16_000


def of_cells(pieces):
    """Blocks between two times where cell k of 1 ms has pieces(k) intervals; the calls are noted."""
    calls = []

    def instants(begin_us, end_us):
        calls.append((begin_us, end_us))
        cells = range(int(begin_us) // 1000, int(end_us) // 1000 + 1)
        times = [np.rint(np.linspace(1000 * k, 1000 * (k + 1), pieces(k) + 1)) for k in cells]
        found = np.unique(np.concatenate(times)).astype(np.int64)
        return found[(found >= begin_us) & (found <= end_us)]

    return calls, lambda begin_us, end_us: blocks_of_run(instants, 1, int(begin_us), int(end_us))


def listed(blocks, end_us):
    every = list(blocks(0, end_us))
    return len(every), sum(int(block.wanted.sum()) for block in every)


def test_a_short_run_is_listed_whole():
    """Up to 1024 stretches, of which this one has 1023.9."""
    _, blocks = of_cells(lambda k: 1 + k % 7)
    sample = sample_of_blocks(blocks, STRETCH_US, 0, 16_382_345, seed=1)
    assert sample.share == 1 and (sample.count, sample.windows) == listed(blocks, 16_382_345)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pieces", "rel"),
    [
        (lambda k: 3, 1e-3),
        # in step with the 1024 parts: fixed places, or parts of whole stretches, would see some phases more often
        (lambda k: 1 + 10 * ((k // 40) % 2), 0.03),
        # a tenth of the run has nine tenths of the windows: of 1024 stretches 102 ± 0.5 fall into it
        (lambda k: 90 if 4000 <= k < 8096 else 1, 0.03),
    ],
    ids=["even", "periodic", "burst"],
)
def test_the_numbers_of_a_long_run_come_from_a_part_of_it(pieces, rel):
    """40.96 s are 2560 stretches. Bounds are 4 standard errors of 1024 stratified stretches, at most."""
    calls, blocks = of_cells(pieces)
    end_us = 40_960_000
    sample = sample_of_blocks(blocks, STRETCH_US, 0, end_us, seed=2)
    assert len(calls) <= 3 * 1024  # one for the windows of a stretch, two at its end
    assert sample.share == pytest.approx(0.4)
    count, windows = listed(blocks, end_us)
    assert sample.count == pytest.approx(count, rel=rel)
    assert sample.windows == pytest.approx(windows, rel=rel)
    ends = [block.end_us[-1] for block in sample.blocks]
    assert np.all(np.diff(ends) >= -STRETCH_US) and ends[0] < 0.01 * end_us and ends[-1] > 0.99 * end_us


@pytest.mark.parametrize(("begin_us", "end_us"), [(5_000, 100_000), (0, 1_239), (1_239, 2_478), (13_000, 13_100)])
def test_fixed_ticks_after_one_time_and_up_to_another_are_asked_for(begin_us, end_us):
    """Each once, with its window before it; blocks of whole multiples that overlap by a window."""
    spec = hr.load_sensor("eiger").spec.evs
    assert spec.tick_us == 1239 and spec.window_us < 1239
    blocks = list(islice(tick_blocks(spec, begin_us, end_us), 30))
    assert len(blocks) < 30
    wanted = np.concatenate([block.end_us[block.wanted] for block in blocks]) if blocks else np.empty(0)
    np.testing.assert_array_equal(wanted, [k * 1239 for k in range(1, 99) if begin_us < k * 1239 <= end_us])
    for before, after in pairwise(blocks):
        assert before.end_us[-1] == after.end_us[0]
    for block in blocks:
        np.testing.assert_array_equal(block.end_us - block.begin_us, spec.window_us)
        np.testing.assert_array_equal(np.diff(block.end_us), 1239)


def test_fixed_ticks_are_sampled_like_instants():
    spec = hr.load_sensor("reference-mono").spec.evs
    begin_us, length_us = 1_000 * 1_000_000, 4_000 * 1_000_000
    stretch_us = 16 * spec.tick_us
    sample = sample_of_blocks(lambda a, b: tick_blocks(spec, a, b), stretch_us, begin_us, begin_us + length_us, seed=3)
    assert len(sample.blocks) == 1024
    part_us = length_us / 1024
    assert begin_us <= sample.blocks[0].end_us[-1] < begin_us + part_us + stretch_us
    assert begin_us + length_us - part_us < sample.blocks[-1].end_us[-1] <= begin_us + length_us
    assert sample.count == pytest.approx(length_us / stretch_us)
    assert sample.windows == pytest.approx(length_us / spec.tick_us)


@pytest.mark.parametrize(("name", "length_us"), [("davis346", 32_000), ("reference-mono", 16 * 2000)])
def test_a_stretch_of_a_capture_is_a_block(monkeypatch, name, length_us):
    """6.4 s in which hardly anything moves, of which 64 stretches are listed: blocks of 32 cells, or of 16 ticks."""
    monkeypatch.setattr(schedule, "_STRETCHES", 64)
    sensor = hr.load_sensor(name, {"evs.tick_us": 2000} if name == "reference-mono" else {}).crop(2, 2)
    keys = [{"t_us": 0, "rotation_deg": 0}, {"t_us": 70_000_000, "rotation_deg": 1}]
    scene = hr.load_scene("rotating-star", {"motion": [{"object": "target", "keyframes": keys}]})
    source = ChangeDrivenFlux(scene, sensor, seed=4)
    capture = Capture(source, source.sensor, *noise_models(sensor), 6_400_000, 5)
    sample = capture.sample_of_event_blocks()
    assert sample.share == pytest.approx(64 * length_us / 6.4e6) and len(sample.blocks) == 64
    assert sample.count == pytest.approx(6.4e6 / length_us)


def test_a_frame_ends_with_its_last_row():
    """32 rows, 7.5 µs apart: the last one begins 31 delays after the first; a run that ends there has the frame."""
    spec = hr.load_sensor("reference-mono").spec.aps.model_copy(
        update={"shutter": "rolling", "line_time_us": 7.5, "exposure_us": 1300, "frame_rate_hz": 70.0}
    )
    end_us = 1300 + 31 * 7.5
    assert [len(exposures(spec, 32, int(end_us) + more)) for more in (0, 1)] == [0, 1]
    first, second = exposures(spec, 32, 20_000)
    assert first.end_us == end_us and second.start_us == 14_286 and second.t_us == 15_586
    np.testing.assert_array_equal(second.row_begin_us(np.array([0, 31])), [14_286, 14_286 + 232.5])
    still = spec.model_copy(update={"shutter": "global"})
    assert exposures(still, 32, 1300)[0].end_us == 1300


@pytest.mark.parametrize(("begin_us", "end_us"), [(0, 5), (0, 16_000), (0, 16_001), (3, 47_999.5), (16_000, 33_300)])
def test_windows_of_instants_end_at_every_instant_of_a_run(begin_us, end_us):
    """Each instant after the begin, up to the end, is wanted once, however the run lies in blocks of 16 ms."""
    every = np.arange(0, 64_001, 250)  # four of each cell

    def instants(first, last):
        return every[(every >= first) & (every <= last)]

    found = [block.end_us[block.wanted] for block in instant_blocks(instants, 7, begin_us, end_us)]
    expected = every[(every > begin_us) & (every <= end_us)]
    np.testing.assert_array_equal(np.concatenate([np.empty(0), *found]), expected)
