"""Tasks of a clip on stand-ins: which sharp image is a truth, which times, events and channels a baseline takes."""

from types import SimpleNamespace

import numpy as np
import pytest

from hesim_render.benchmark import tasks


def frame(start_us, exposure_us=4_000, raw=0.0, index=0, line_time_us=0.0, shape=(3, 5)):
    return SimpleNamespace(
        exposure_start_us=start_us, exposure_us=exposure_us, raw=np.full(shape, raw), index=index,
        line_time_us=line_time_us,
    )  # fmt: skip


def clip_tasks(frames=(), times=(), development=None, **clip):
    """Tasks whose sharp image at a time is that time, and whose measures are the result and the truth themselves."""
    times = np.array(times, dtype=float)
    made = tasks.ClipTasks.__new__(tasks.ClipTasks)
    sharp = SimpleNamespace(
        time_us=times, nearest=lambda t_us: int(np.argmin(np.abs(times - t_us))), raw_dn=lambda k: np.float64(times[k])
    )
    recording = SimpleNamespace(frames=list(frames), mosaic=clip.pop("mosaic", None), event_shape=(2, 4))
    made._clip = SimpleNamespace(name="c", sharp=sharp, recording=recording, **clip)
    made._predictions, made._longer = None, ()
    made._development = development or SimpleNamespace(
        sensor=SimpleNamespace(evs=SimpleNamespace(contrast_threshold_on=0.2, contrast_threshold_off=0.3)),
        scores=lambda raw, truth: {"raw": float(np.mean(raw)), "truth": float(truth)},
    )
    return made


def test_the_truth_of_a_frame_is_near_its_middle_in_parts_of_its_exposure():
    """A quarter of the exposure: 1000 µs of 4000, 75 of 300."""
    made = clip_tasks(times=[150.0, 9_151.0, 30_000.0])
    assert made._truth(frame(40, 300)) == (150.0, 150.0)
    assert made._truth(frame(9_151 - 151 - 75, 300)) is None and made._truth(frame(9_151 - 150 - 75, 300))[0] == 9_151
    for start, seen in ((26_999, False), (27_000, True), (29_000, True), (29_001, False)):
        assert (made._truth(frame(start)) is not None) == seen
    made._clip.sharp = None
    assert made._truth(frame(28_000)) is None


def test_a_frame_between_two_is_made_at_its_own_time():
    """Each neighbour sharpened is here its own middle: their weighted mean is the time of the truth."""
    starts = (500, 9_000, 31_000, 33_000, 48_000, 60_000)
    frames = [frame(start, raw=start / 7, index=k) for k, start in enumerate(starts)]
    made = clip_tasks(frames, [11_700.0, 35_200.0])
    made._sharpened = lambda given, t_us: np.full(given.raw.shape, given.exposure_start_us + 2_000.0)
    found = {(score.item, score.method): score.values for score in made.interpolate()}
    for item, t_us, before, after in ((1, 11_700, 500, 31_000), (3, 35_200, 31_000, 48_000)):
        expected = {"hold": before / 7, "average": (before + after) / 14, "double-integral": t_us}
        for method, value in expected.items():
            assert found.pop((item, method)) == pytest.approx({"raw": value, "truth": t_us})
    assert not found


@pytest.mark.parametrize("t_us", [800.0, 9_300.0, 40_000.0])
def test_a_frame_is_sharpened_with_the_events_of_its_rows(monkeypatch, t_us):
    """Event pixels in rows 1 and 4 of the mosaic; a row's exposure begins 250 µs after that of the row before."""
    asked, given = [], []
    layout = SimpleNamespace(evs_pixel=np.array([[8, 9, 10, 11], [29, 30, 31, 32]]), cols=7)
    made = clip_tasks(mosaic=SimpleNamespace(black_level_dn=60))
    made._development.layout, made._development.on_mosaic = layout, lambda ratio: ratio * np.full((6, 7), 2.0)
    made._clip.recording.event_slice = lambda *times: asked.append(times) or "events"
    monkeypatch.setattr(tasks, "sharp_over_blurred", lambda *args: given.append(args) or [0.75])
    found = made._sharpened(frame(8_000, raw=100.0, line_time_us=250.0, shape=(6, 7)), t_us)
    np.testing.assert_allclose(found, 60 + 40 * 1.5)
    ((begin, end),) = asked
    # row 4 is exposed from 9000 to 13,000 µs, and is wanted 1000 µs after row 0
    assert min(t_us, 8_250) - 1_000 <= begin <= min(t_us + 250, 8_250)
    assert max(t_us + 1_000, 13_000) < end < max(t_us, 12_000) + 6 * 250 + 10
    ((events, shape, starts, exposure_us, (at,), thresholds),) = given
    assert (events, shape, exposure_us, at, thresholds) == ("events", (2, 4), 4_000, t_us + 250, (0.2, 0.3))
    np.testing.assert_array_equal(starts, [8_250, 9_000])


def test_the_flow_of_events_is_that_of_the_time_between_two_frames(monkeypatch):
    """Planes give px/µs; the flow is valid where the point is seen again."""
    asked = []
    frames = [frame(1_000, index=0), frame(8_000, 2_000, index=1)]
    made = clip_tasks(frames)
    made._development.grey_pair = lambda *raws: raws
    made._development.flow_on_mosaic = lambda flow: flow
    made._clip.recording.event_slice = lambda *times: asked.append(times) or "events"
    truth = np.full((3, 5, 2), 4.0)
    truth[0, 1, 1] = np.nan
    seen = np.ones((3, 5), bool)
    seen[2, 3] = False
    stored = {"frames/flow_forward_px": truth, "frames/visible_forward": seen}
    made._clip.recording.stored_truth = SimpleNamespace(names=list(stored), read=lambda name, index: stored[name])
    monkeypatch.setattr(tasks, "picture_methods", dict)
    monkeypatch.setattr(tasks, "plane_fit", lambda events, shape: np.array([2e-3, -3e-3]))
    monkeypatch.setattr(tasks, "flow_scores", lambda *given: {"given": given})
    found = {score.method: score.values["given"] for score in made.flow()}
    np.testing.assert_allclose(found["plane-fit"][0], [12.0, -18.0])  # 3000 to 9000 µs
    assert asked == [(3_000, 9_001)] and not np.any(found["zero"][0]) and found["zero"][0].shape == truth.shape
    for _, expected, valid in found.values():
        assert expected is truth
        np.testing.assert_array_equal(np.argwhere(~valid), [[0, 1], [2, 3]])


def test_channels_of_a_demosaiced_image_are_those_of_the_mosaic_whatever_order_is_stored(monkeypatch):
    """With the exposure of the clip, or of its sensor."""
    mosaic = SimpleNamespace(channels=("red", "green", "blue"), tile_channel=[[0, 1], [1, 2]])
    stored = np.broadcast_to([30.0, 10.0, 20.0], (2, 4, 3))
    colours = SimpleNamespace(channels=["blue", "red", "green"], time_us=[5], flux_e_per_s=lambda k: stored)
    development = SimpleNamespace(
        sensor=SimpleNamespace(aps=SimpleNamespace(exposure_us=700)),
        full_dn=lambda flux, exposure_us: flux * exposure_us,
        demosaiced=lambda raw: raw,
        channel_scores=lambda channels, truth: {"truth": truth},
    )
    monkeypatch.setattr(tasks, "bilinear", lambda raw, tile: raw)
    for own_us, exposure_us in ((None, 700), (250, 250)):
        content = {"exposure_us": own_us}
        made = clip_tasks([], [9.0], development, mosaic=mosaic, colours=colours, content=content)
        for score in made.demosaic():
            np.testing.assert_array_equal(score.values["truth"][1, 3], np.array([10, 20, 30]) * exposure_us)
