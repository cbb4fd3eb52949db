"""Sharp images, colours and figures of clips from sources whose values are known at every pixel and time."""

from types import SimpleNamespace

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.benchmark import sharp, statistics
from hesim_render.specs.benchmark import SharpSpec

WINDOW_US = 300


class Known:
    """A source whose halves are 90 000 + 1100 per pixel index + 2 per µs of the middle of the window, ± an error."""

    def __init__(self, error):
        self.error = error

    def mean_flux(self, pixel, begin_us, end_us):
        assert np.all(end_us - begin_us == WINDOW_US)
        value = 90_000 + 1100.0 * pixel + 2.0 * (begin_us + end_us) / 2
        return value + self.error, value - 0.5 * self.error


@pytest.mark.parametrize("shutter", ("sensor", "global"))
def test_sharp_images_are_those_of_their_windows(shutter, tmp_path):
    """Each row of a rolling shutter later by its line time; RAW of a whole exposure; NaN and 0 at event pixels."""
    sensor = hr.load_sensor("eiger", {"aps.line_time_us": 12.5, "aps.exposure_us": 2600}).crop(8, 4)
    aps, mask = sensor.spec.aps, sensor.layout.aps_mask
    assert aps.shutter == "rolling" and 0 < mask.sum() < mask.size
    spec = SharpSpec(times_us=[2000, 3100], window_us=WINDOW_US, shutter=shutter)
    assert sharp.write_sharp(tmp_path / "sharp.h5", Known(40.0), sensor, spec, 9000, 5, 0.7) == 2
    images = sharp.SharpImages(tmp_path / "sharp.h5")
    delay = np.arange(4) * (12.5 if shutter == "sensor" else 0.0)
    assert images.time_us.tolist() == [2000, 3100] and images.row_offset_us.tolist() == delay.tolist()
    assert [images.nearest(t) for t in (0, 2540, 2560, 1e6)] == [0, 0, 1, 1]
    for number, middle in enumerate((2000, 3100)):
        flux = 90_000 + 1100.0 * np.arange(32).reshape(4, 8) + 2.0 * (middle + delay[:, None]) + 0.25 * 40
        np.testing.assert_allclose(images.flux_e_per_s(number), np.where(mask, flux, np.nan), rtol=1e-6)
        np.testing.assert_allclose(images.stderr_e_per_s(number), np.where(mask, 0.75 * 40, np.nan), rtol=1e-3)
        level = aps.black_level_dn + aps.system_gain_dn_per_e * flux * 2600e-6
        assert level.max() < 2**aps.bit_depth - 1 and level.min() > aps.black_level_dn + 20
        assert np.abs(images.raw_dn(number) - np.where(mask, level, 0)).max() <= 0.501


def test_colours_are_those_of_each_filter_with_random_numbers_of_their_own(monkeypatch, tmp_path):
    sensor, seeds = hr.load_sensor("mipi-hybridevs").crop(8, 4), []
    names = sharp.frame_filters(sensor)
    assert len(names) == 3

    def renderer(scene, one, seed, quality):
        seeds.append(seed)
        assert scene == "lit" and quality == 0.7 and one.layout.aps_mask.all() and one.spec.evs is None
        assert {letter for row in one.spec.tile_rows for letter in row} == {"F"}
        assert one.spec.pixels["F"].filter == names[len(seeds) - 1]
        return Known(40.0 * len(seeds))

    monkeypatch.setattr(sharp, "scene_renderer", renderer)
    monkeypatch.setattr(sharp, "in_absolute_light", lambda scene: ("lit", None))
    spec = SharpSpec(times_us=[2000, 3100], window_us=WINDOW_US, shutter="global")
    assert sharp.write_colours(tmp_path / "colours.h5", "scene", sensor, spec, 9000, 5, 0.7) == 2
    truth = sharp.ColourTruth(tmp_path / "colours.h5")
    assert truth.channels == names and len(set(seeds)) == 3 and truth.time_us.tolist() == [2000, 3100]
    for channel in range(3):
        error = 40.0 * (channel + 1)
        flux = 90_000 + 1100.0 * np.arange(32).reshape(4, 8) + 2.0 * 3100 + 0.25 * error
        np.testing.assert_allclose(truth.flux_e_per_s(1)[..., channel], flux, rtol=1e-6)
        np.testing.assert_allclose(truth.stderr_e_per_s(1)[..., channel], 0.75 * error, rtol=1e-3)


@pytest.mark.parametrize("duration_us", (8000, 400))
def test_figures_of_a_clip_follow_their_definitions(duration_us, monkeypatch):
    """Flux per second, its spread over each position of the tile, events per pixel and second, widths per second."""
    sensor = hr.load_sensor("eiger").crop(8, 4)
    electrons = np.random.default_rng(2).uniform(20, 90, (4, 8)).astype(np.float32)
    electrons[~sensor.layout.aps_mask] = np.nan
    recording = SimpleNamespace(
        manifest={"counts": {"events": 310}}, duration_us=duration_us, event_shape=(2, 4), event_truth=None,
        frames=[SimpleNamespace(electrons_mean=electrons, exposure_us=2600)],
    )  # fmt: skip
    flow, asked = np.zeros((2, 4, 2)), []
    flow[..., 0], flow[..., 1], flow[1, 2] = 0.3, -0.4, np.nan

    class Truth:
        def __init__(self, scene, given):
            assert scene == "scene" and given is sensor

        def flow(self, begin, end, grid):
            asked.append((begin, end, grid))
            return SimpleNamespace(flow_px=flow)

    monkeypatch.setattr(statistics, "SceneTruth", Truth)
    found = statistics.figures(recording, "scene", sensor)
    assert list(found) == list(statistics.FIGURES)
    assert found["brightness_e_per_s"] == pytest.approx(np.nanmean(electrons) / 2600e-6, rel=1e-5)
    rows, cols = sensor.layout.tile_shape
    parts = [electrons[i::rows, j::cols] for i in range(rows) for j in range(cols)]
    spreads = [part.std() / part.mean() for part in parts if np.isfinite(part).any()]
    assert found["contrast"] == pytest.approx(np.mean(spreads), rel=1e-5)
    assert found["activity_hz"] == pytest.approx(310 / 8 / (duration_us * 1e-6))
    span = min(1000, duration_us)
    assert asked == [((duration_us - span) // 2, (duration_us + span) // 2, "events")]
    # half a pixel in the span, of a width of 4 pixels
    assert found["speed_widths_per_s"] == pytest.approx(0.5 / 4 / (span * 1e-6))
    # without frames: the mean flux of event pixels, all of one position
    recording.frames, flux = [], np.array([[3.0, 5.0, 4.0, 9.0], [2.0, 8.0, 6.0, 1.0]], np.float32)
    recording.event_truth = SimpleNamespace(flux_mean_e_per_s=flux)
    found = statistics.figures(recording, "scene", sensor)
    assert found["brightness_e_per_s"] == pytest.approx(4.75)
    assert found["contrast"] == pytest.approx(flux.std() / flux.mean())
