"""Pictures: neutral stays neutral, colours come out right, no event gets lost, event pixels do not leak in."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import recordings
from PIL import Image

from hesim_render.mosaic import description as mosaic
from hesim_render.pixels.evs.events import EVENT_DTYPE
from hesim_render.recording import colour_view, preview, showcase
from hesim_render.recording.colour_view import colour_picture, thumbnail
from hesim_render.recording.recording import Recording
from hesim_render.spectral import colorimetry
from hesim_render.spectral import spectrum as spectra


def frame_under(name, light, reflectances, width=256, height=192):
    """Noise-free RAW of vertical bars of given reflectances under a light, brightest at 60 % of full scale."""
    sensor = recordings.sensor_like(name, width, height)
    described = mosaic.describe(sensor, light)
    names = sensor.layout.filters
    electrons = np.array(
        [[spectra.integrate_product(sensor.responses[n], light, r) for n in names] for r in reflectances]
    )
    span = described.white_level_dn - described.black_level_dn
    scale = 0.6 * span / electrons[:, [names.index(c) for c in described.channels]].max()
    bar = np.minimum(np.arange(width) * len(reflectances) // width, len(reflectances) - 1)
    dn = described.black_level_dn + scale * electrons[bar[None, :], sensor.layout.filter_index]
    return np.where(sensor.layout.aps_mask, np.rint(dn), 0).astype(np.uint16), described


def bars(picture, count):
    """Mean colour of the middle of each bar."""
    rows, cols = picture.shape[:2]
    centres = ((np.arange(count) + 0.5) * cols / count).astype(int)
    half = cols // (6 * count)
    return np.array([picture[rows // 4 : -rows // 4, c - half : c + half + 1].mean(axis=(0, 1)) for c in centres])


@pytest.mark.parametrize("name", ["eiger", "gen2", "mipi-hybridevs", "reference-bayer"])
@pytest.mark.parametrize("light", ["D65", "A", "FL11"])
def test_neutral_is_neutral_under_any_light(name, light):
    raw, described = frame_under(name, spectra.illuminant(light), [spectra.constant(v) for v in (0.9, 0.4, 0.1)])
    for picture in (colour_picture(raw, described), thumbnail(raw, described)):
        found = bars(picture, 3)
        assert np.ptp(found, axis=1).max() <= 3  # of 255; rounding to whole DN
        assert found[0].mean() > 230 and np.all(np.diff(found.mean(axis=1)) < -20)


def test_colorchecker_patches_come_out_in_their_colours():
    """Mean ΔE*ab below 6 against the patches' own sRGB: a 3×3 matrix cannot do much better."""
    import colour

    chart = list(spectra.colorchecker_reflectances().values())
    light = spectra.illuminant("D65")
    patches = [chart[k] for k in (18, 14, 13, 12, 15, 2, 8)]  # white, red, green, blue, yellow, blue sky, moderate red
    raw, described = frame_under("eiger", light, patches, width=448)
    found = bars(colour_picture(raw, described), len(patches)) / 255
    white = colorimetry.tristimulus(light, [spectra.constant(1.0)])[0]
    linear = colorimetry.xyz_to_linear_srgb(colorimetry.tristimulus(light, patches), white)
    # the picture sets its own exposure: compare at the exposure of the white patch
    shown = colour.models.eotf_sRGB(found)
    shown *= linear[0, 1] / shown[0, 1]
    difference = colour.delta_E(lab(colour, linear), lab(colour, shown), method="CIE 1976")
    assert difference.mean() < 6 and difference.max() < 14, difference


def lab(colour, linear):
    return colour.XYZ_to_Lab(np.clip(linear, 0, 1) @ np.linalg.inv(colorimetry._XYZ_TO_SRGB).T)


def test_xyz_to_srgb_against_colour_science():
    import colour

    rng = np.random.default_rng(4)
    xyz = rng.uniform(0.05, 0.9, (50, 3))
    white = np.array([1.0985, 1.0, 0.3558])  # illuminant A
    ours = colorimetry.xyz_to_linear_srgb(xyz, white)
    srgb_white = np.linalg.solve(colorimetry._XYZ_TO_SRGB, np.ones(3))
    adapted = colour.adaptation.chromatic_adaptation_VonKries(xyz, white, srgb_white, transform="Bradford")
    np.testing.assert_allclose(ours, adapted @ colorimetry._XYZ_TO_SRGB.T, atol=2e-6)
    linear = rng.uniform(0, 1, 1000)
    exact = 255 * colour.models.eotf_inverse_sRGB(linear)
    assert np.abs(colorimetry.encode_srgb(linear) - exact).max() <= 0.6
    assert colorimetry.encode_srgb([np.nan, -1.0, 2.0]).tolist() == [0, 0, 255]


@pytest.mark.parametrize("width", [256, 512])
def test_event_pixels_do_not_leak_into_the_picture(width):
    sensor = recordings.sensor_like("eiger", width, 192)
    frame, described = recordings.frame_of(sensor), mosaic.describe(sensor)
    poisoned = np.where(frame.valid, frame.raw, 1023).astype(np.uint16)
    for draw in (colour_picture, thumbnail):
        np.testing.assert_array_equal(draw(frame.raw, described, 300), draw(poisoned, described, 300))


def test_saturated_highlights_are_white_not_magenta():
    sensor = recordings.sensor_like("eiger", 64, 64)
    described = mosaic.describe(sensor)
    picture = colour_picture(np.full((64, 64), 1023, dtype=np.uint16), described)
    assert np.ptp(picture.astype(int), axis=2).max() <= 1 and picture.min() > 220


def test_a_dark_frame_stays_dark():
    sensor = recordings.sensor_like("eiger", 64, 64)
    noise = np.random.default_rng(1).normal(64, 1.0, (64, 64))
    picture = colour_picture(np.rint(noise).astype(np.uint16), mosaic.describe(sensor))
    assert picture.mean() < 60


def test_mosaic_picture_shows_each_filter_and_marks_event_pixels():
    sensor = recordings.sensor_like("gen2", 32, 32)
    described = mosaic.describe(sensor)
    raw = np.where(sensor.layout.aps_mask, 800, 0).astype(np.uint16)
    picture = preview.mosaic_picture(raw, described, 8)
    assert picture.shape == (256, 256, 3)
    pixel = picture.reshape(32, 8, 32, 8, 3).transpose(0, 2, 1, 3, 4)
    assert pixel[0, 0, 4, 4].argmax() == 0 and pixel[0, 2, 4, 4].argmax() == 1 and pixel[2, 2, 4, 4].argmax() == 2
    assert pixel[1, 2, 0, 0].max() < 60 < pixel[1, 2, 4, 4].min()  # dark with a pale dot
    every = preview.every_tile(np.arange(32 * 32).reshape(32, 32).astype(np.uint16), described, 2)
    assert every.shape == (16, 16) and every[0, 4] == 8 and every[4, 0] == 8 * 32


@pytest.mark.parametrize("size", [(96, 128), (20, 30), (97, 131)])
def test_events_land_where_they_are_and_none_is_lost(size):
    sensor = recordings.sensor_like("eiger")
    events = recordings.events_of(sensor, 1000, count=2)
    events["x"], events["y"], events["polarity"] = [3, 60], [5, 40], [1, -1]
    background = np.zeros((*size, 3), np.uint8)
    picture = colour_view.events_picture(background, events, sensor.layout.evs_shape).astype(int)
    blank = colour_view.events_picture(background, events[:0], sensor.layout.evs_shape).astype(int)
    changed = np.abs(picture - blank).sum(axis=2) > 0
    rows, cols = np.nonzero(changed)
    for k, warm in ((0, True), (1, False)):
        y, x = (events["y"][k] + 0.5) * size[0] / 48, (events["x"][k] + 0.5) * size[1] / 64
        near = np.hypot(rows - y, cols - x) < 3
        assert near.any()
        red, _, blue = picture[rows[near][0], cols[near][0]]
        assert (red - blue if warm else blue - red) > 100
    assert changed.sum() <= 2 * max(1, np.ceil(size[0] / 48)) * max(1, np.ceil(size[1] / 64))


def test_events_lie_over_the_luminance_of_a_frame():
    """18 + 0.3 Y of Rec. 709, rounded down."""
    pure = np.zeros((2, 3, 3), np.uint8)
    pure[0, [0, 1, 2], [0, 1, 2]] = 200
    found = colour_view.events_picture(pure, np.zeros(0, EVENT_DTYPE), (4, 9))
    assert found[0].tolist() == [[30] * 3, [60] * 3, [22] * 3] and (found[1] == 18).all()


@pytest.mark.parametrize(("name", "width", "height"), [("eiger", 512, 384), ("davis346", 346, 260), ("gen2", 1664, 64)])
def test_contact_sheet_of_any_size(name, width, height, tmp_path):
    recording = recordings.make(name, tmp_path / "r", width=width, height=height)
    with Image.open(tmp_path / "r" / "preview.png") as sheet:
        sheet.load()
        assert 900 < sheet.width < 1800 and sheet.mode == "RGB"
        assert np.asarray(sheet).std() > 15
    assert not showcase.moves(recording)


@pytest.mark.parametrize(("start_us", "first_us"), [(91_000, 87_500), (200, 0), (246_000, 240_000)])
def test_events_of_a_moving_scene_are_those_around_the_middle_of_the_frame(start_us, first_us, monkeypatch):
    """10 ms about the middle of an exposure of 3 ms, and as many where the run begins or ends beside it."""
    recording, asked = recordings.make("eiger", duration_us=250_000), []
    frame = replace(recording.frames[1], exposure_start_us=start_us, exposure_us=3_000)
    monkeypatch.setattr(showcase, "_middle", lambda _: frame)
    monkeypatch.setattr(showcase, "moves", lambda _: True)
    slices = type(recording).event_slice
    monkeypatch.setattr(type(recording), "event_slice", lambda self, *span: asked.append(span) or slices(self, *span))
    panels = showcase.middle_views(recording)
    assert asked == [(first_us, first_us + 10_001)] and panels[1].caption.endswith("in 10 ms: ON orange, OFF blue")
    # of a still scene all events, also where the recording goes on from another one
    monkeypatch.setattr(showcase, "moves", lambda _: False)
    recording.manifest["time"]["begin_us"] = 30_000
    panels = showcase.middle_views(recording)
    assert asked[1:] == [(30_000, 250_001)] and panels[1].caption.endswith("in 220 ms: ON orange, OFF blue")


def test_moving_scene_gets_an_animation(tmp_path):
    recording = recordings.make("gen2", width=128, height=96)
    recording.manifest["scene"] = {"name": "s", "sha256": 64 * "0", "spec": {"motion": [{"object": "target"}]}}
    recording.save(tmp_path / "r")
    with Image.open(tmp_path / "r" / "preview.gif") as picture:
        assert picture.n_frames >= 20 and picture.size == (640, 480)  # five times the frames
        first = np.asarray(picture.convert("RGB")).astype(int)
    small = showcase.animation(Recording.load(tmp_path / "r"))[0]  # 96 colours of it
    assert np.abs(first - small.repeat(5, axis=0).repeat(5, axis=1)).mean() < 2
    np.testing.assert_array_equal(first, first[::5, ::5].repeat(5, axis=0).repeat(5, axis=1))
    assert showcase.moves(Recording.load(tmp_path / "r"))


def test_an_animation_without_events_goes_through_the_whole_recording(monkeypatch):
    recording, shown = recordings.make("reference-bayer", frames=9), []
    monkeypatch.setattr(showcase, "colour_picture", lambda raw, *_: shown.append(raw))
    for steps, expected in ((4, [0, 3, 5, 8]), (30, list(range(9)))):
        monkeypatch.setattr(showcase, "_ANIMATION_STEPS", steps)
        showcase.animation(recording)
        assert [
            next(k for k, f in enumerate(recording.frames) if np.array_equal(f.raw, raw)) for raw in shown
        ] == expected
        shown.clear()


def test_no_frames_and_no_events_still_make_a_picture(tmp_path):
    recordings.make("eiger", tmp_path / "a", frames=0)
    recordings.make("reference-bayer", tmp_path / "b", frames=0)
    for name in "ab":
        assert (tmp_path / name / "preview.png").stat().st_size > 500


@pytest.mark.parametrize(
    ("name", "codes"),
    [
        ("eiger", {"red": 0, "green": 1, "blue": 2}),
        ("gen2", {"red": 0, "green": 1, "blue": 2, "white": 6}),
        ("reference-mono", {"clear": 6}),
    ],
)
def test_colour_codes_of_filters(name, codes):
    assert mosaic.describe(recordings.sensor_like(name, 64, 64)).cfa_code == codes


def test_colour_codes_of_ideal_bands():
    for band, code in (((580, 700), 0), ((500, 580), 1), ((400, 500), 2), ((400, 580), 3), ((500, 700), 5),
                       ((400, 700), 6)):  # fmt: skip
        assert mosaic.cfa_code(spectra.constant(1.0, *band)) == code
    magenta = spectra.Spectrum(np.array([400, 495, 500, 580, 585, 700.0]), np.array([1, 1, 0, 0, 1, 1.0]))
    assert mosaic.cfa_code(magenta) == 4


def test_wider_frames_are_binned_by_as_few_tiles_as_fit(monkeypatch):
    """1301 px of tiles of 4: four tiles a pixel make it 81 px wide, three would make it 108."""
    asked = []
    monkeypatch.setattr(colour_view, "_binned", lambda raw, mosaic, tiles: asked.append(tiles))
    monkeypatch.setattr(colour_view, "_smoothed", lambda raw, mosaic: asked.append("as it is"))
    monkeypatch.setattr(colour_view, "_developed", lambda channels, mosaic: np.zeros((1, 1, 3), np.float32))
    mosaic = SimpleNamespace(tile_shape=(2, 4))
    for width, most in ((1301, 100), (1200, 100), (101, 100), (100, 100)):
        colour_picture(np.zeros((6, width), np.uint16), mosaic, most)
    colour_view.thumbnail(np.zeros((6, 1301), np.uint16), mosaic, 100)
    assert asked == [4, 3, 1, "as it is", 4]
