"""What comes in: every kind of input read to the last code, every kind of broken input refused in one sentence."""

import hashlib
import time
import warnings

import av
import numpy as np
import OpenEXR
import pytest
import tifffile
from PIL import Image
from videos import TAGS, encode, grey_frames, moving_bar, rgb_frames, yuv_frame

import hesim_render as hr
from hesim_render.core.errors import HesimError, RangeError, SpecError
from hesim_render.sources.video import VideoFlux, VideoOptions, open_video
from hesim_render.sources.video.colours import ColourTags
from hesim_render.sources.video.digest import Digest, Hashed
from hesim_render.sources.video.folder import FolderVideo
from hesim_render.sources.video.linear import Lineariser
from hesim_render.sources.video.picture_layout import PictureFormat


def opened(source, **options):
    return open_video(source, VideoOptions.of(**options))


def random_planes(shapes, bits, seed=0):
    rng = np.random.default_rng(seed)
    dtype = np.uint8 if bits <= 8 else np.uint16
    return [rng.integers(0, 2**bits, shape).astype(dtype) for shape in shapes]


# -- files


@pytest.mark.parametrize(
    ("name", "bits", "chroma"),
    [
        ("yuv420p", 8, (12, 16)),
        ("yuv422p", 8, (24, 16)),
        ("yuv444p", 8, (24, 32)),
        ("yuv420p10le", 10, (12, 16)),
        ("yuv444p16le", 16, (24, 32)),
        ("yuv422p12le", 12, (24, 16)),
        ("gray", 8, None),
        ("gray16le", 16, None),
        ("gbrp10le", 10, (24, 32)),
        ("gbrp16le", 16, (24, 32)),
    ],
)
def test_every_code_of_a_lossless_file_arrives(name, bits, chroma, tmp_path):
    shapes = [(24, 32)] + ([] if chroma is None else [chroma] * 2)
    pictures = [random_planes(shapes, bits, seed) for seed in range(3)]
    path = encode(tmp_path / "a.mkv", [yuv_frame(planes, name) for planes in pictures])
    video = opened(path)
    assert video.count == 3 and video.format.bits == bits and (video.format.width, video.format.height) == (32, 24)
    for k in (0, 2, 1):  # forward, and back
        expected = pictures[k]
        if name.startswith("gbr"):
            expected = [expected[2], expected[0], expected[1]]
        for found, plane in zip(video.read(k), expected, strict=True):
            np.testing.assert_array_equal(found, plane)


@pytest.mark.parametrize(
    ("name", "like"), [("nv12", "yuv420p"), ("yuyv422", "yuv422p"), ("rgb24", "gbrp"), ("bgra", "gbrp")]
)
def test_packed_formats_are_only_put_in_order(name, like, tmp_path):
    rng = np.random.default_rng(1)
    bytes_per_pixel = {"nv12": 1, "yuyv422": 2, "rgb24": 3, "bgra": 4}[name]
    if name == "nv12":
        planes = [rng.integers(0, 256, (24, 32), dtype=np.uint8), rng.integers(0, 256, (12, 32), dtype=np.uint8)]
        frame = av.VideoFrame(32, 24, name)
        for plane, values in zip(frame.planes, planes, strict=True):
            wide = np.zeros((values.shape[0], plane.line_size), np.uint8)
            wide[:, :32] = values
            plane.update(wide)
        expected = [planes[0], planes[1][:, ::2], planes[1][:, 1::2]]
    else:
        codes = rng.integers(0, 256, (24, 32 * bytes_per_pixel), dtype=np.uint8)
        if name == "bgra":
            codes[:, 3::4] = 255
        frame = av.VideoFrame(32, 24, name)
        wide = np.zeros((24, frame.planes[0].line_size), np.uint8)
        wide[:, : codes.shape[1]] = codes
        frame.planes[0].update(wide)
        if name == "yuyv422":
            expected = [codes[:, ::2], codes[:, 1::4], codes[:, 3::4]]
        else:
            step, order = (3, (0, 1, 2)) if name == "rgb24" else (4, (2, 1, 0))
            expected = [codes[:, k::step] for k in order]
    video = opened(encode(tmp_path / "a.nut", [frame], "rawvideo"))
    for found, plane in zip(video.read(0), expected, strict=True):
        np.testing.assert_array_equal(found, plane)
    assert video.format.layout == ("planar" if like == "gbrp" else "yuv")


@pytest.mark.parametrize(
    ("codec", "suffix", "name"),
    [
        ("libx264", "mp4", "yuv420p"),
        ("libx265", "mp4", "yuv420p10le"),
        ("libvpx-vp9", "webm", "yuv420p"),
        ("prores_ks", "mov", "yuv422p10le"),
    ],
)
def test_usual_codecs(codec, suffix, name, tmp_path):
    """Lossy: within 3 % of the moving bar at both of its levels; times from the file."""
    options = {"x265-params": "log-level=none"} if codec == "libx265" else {}
    path = encode(tmp_path / f"a.{suffix}", rgb_frames(moving_bar(8), name), codec, 50, options=options)
    sensor = hr.load_sensor("reference-mono").crop(64, 48)
    flux = VideoFlux(path, sensor, VideoOptions.of(white_e_per_s=1.0, white_filter="clear"))
    assert flux.tags.as_dict() == {
        "transfer": "srgb", "gamma": None, "primaries": "bt709", "matrix": "bt709", "range": "limited"
    }  # fmt: skip
    assert flux.clock.count == 8 and flux.clock.end_us == pytest.approx(160_000, abs=1000)
    pixels = np.arange(64 * 48, dtype=np.uint32)
    for k in (0, 5):
        found = np.array(flux.mean_flux(pixels, 20_000 * k + 2000, 20_000 * k + 18_000)[0]).reshape(48, 64)
        for column, level in ((2 * k + 8, 0.8), (2 * k + 32, 0.2)):
            tint = level * np.array([1, 0.9, 0.8])
            linear = np.where(tint <= 0.04045, tint / 12.92, ((tint + 0.055) / 1.055) ** 2.4)
            assert found[24, column % 64] == pytest.approx(linear @ (0.2126, 0.7152, 0.0722), rel=0.03, abs=0.003)


def test_missing_tags_are_named_and_can_be_given(tmp_path):
    path = encode(tmp_path / "a.mp4", grey_frames([100] * 4), "libx264", tags=None)
    sensor = hr.load_sensor("reference-mono").crop(8, 8)
    with pytest.raises(SpecError, match=r"missing: transfer, primaries, matrix, range; give them .*limited or full"):
        hr.simulate_video(path, sensor)
    given = {"transfer": "bt709", "primaries": "bt709", "matrix": "bt601", "range": "limited"}
    recording = hr.simulate_video(path, sensor, **given)
    assert recording.manifest["settings"]["video"]["colour"] == {**given, "gamma": None}


def test_a_given_tag_overrules_the_file(tmp_path):
    path = encode(tmp_path / "a.mkv", grey_frames([126] * 2))
    sensor = hr.load_sensor("reference-mono").crop(8, 8)
    one = np.zeros(1, np.uint32)
    value = (126 - 16) / 219
    unit = {"white_e_per_s": 1.0, "white_filter": "clear"}
    for options, expected in (
        ({}, ((value + 0.055) / 1.055) ** 2.4),
        ({"transfer": "gamma"}, value**2.2),
        ({"transfer": "gamma", "gamma": 1.8}, value**1.8),
        ({"transfer": "linear", "range": "full"}, 126 / 255),
    ):
        found = VideoFlux(path, sensor, VideoOptions.of(**unit, **options)).mean_flux(one, 0, 1)[0]
        assert float(np.array(found)[0]) == pytest.approx(expected, rel=1e-5)


def test_unsupported_tags_are_refused(tmp_path):
    path = encode(tmp_path / "a.mkv", grey_frames([126] * 2), tags={**TAGS, "transfer": 9})
    with pytest.raises(SpecError, match="transfer code 9"):
        opened(path)


def test_variable_frame_rate_is_honoured(tmp_path):
    """Pictures at 0, 40, 50 and 130 ms: each is seen until the next begins."""
    levels = [40, 90, 140, 190]
    stamps = [0, 40, 50, 130]
    path = encode(tmp_path / "a.mkv", grey_frames(levels), pts=stamps, time_base="1/1000")
    sensor = hr.load_sensor("reference-mono").crop(8, 8)
    flux = VideoFlux(path, sensor, VideoOptions.of(white_e_per_s=1.0, white_filter="clear", transfer="linear"))
    np.testing.assert_allclose(flux.slice_edges_us(0, 1e6), [40_000, 50_000, 130_000])
    one = np.zeros(1, np.uint32)
    for t_us, level in ((39_000, 40), (41_000, 90), (51_000, 140), (129_000, 140), (131_000, 190)):
        assert float(np.array(flux.mean_flux(one, t_us, t_us + 500)[0])[0]) == pytest.approx(
            (level - 16) / 219, rel=1e-5
        )
    assert any("irregular" in note for note in flux.notes())
    regular = VideoFlux(path, sensor, VideoOptions.of(fps=3200))
    np.testing.assert_allclose(regular.slice_edges_us(0, 1e6), [312.5, 625, 937.5])


def test_stamps_too_coarse_for_the_rate_need_it(tmp_path):
    """Matroska counts milliseconds: pictures of 3200 fps share them."""
    path = encode(tmp_path / "a.mkv", grey_frames([100] * 10), fps=3200)
    sensor = hr.load_sensor("reference-mono").crop(8, 8)
    with pytest.raises(SpecError, match="frame rate"):
        hr.simulate_video(path, sensor)
    assert hr.simulate_video(path, sensor, fps=3200).duration_us == 3125


def test_odd_sizes(tmp_path):
    """37 × 21 in 4:2:0: chroma has half a sample more."""
    planes = [np.full((21, 37), 126, np.uint8), np.full((11, 19), 100, np.uint8), np.full((11, 19), 150, np.uint8)]
    video = opened(encode(tmp_path / "a.mkv", [yuv_frame(planes, "yuv420p")]))
    assert video.format.chroma_size == (19, 11)
    for found, expected in zip(video.read(0), planes, strict=True):
        np.testing.assert_array_equal(found, expected)
    sensor = hr.load_sensor("eiger").crop(36, 20)
    flux = VideoFlux(tmp_path / "a.mkv", sensor, VideoOptions.of(fit="pixel"))
    found = np.array(flux.mean_flux(np.arange(720, dtype=np.uint32), 0, 1)[0]).reshape(20, 36)
    assert np.ptp(found[0:20:4, 0:36:4]) < 1e-5 * found.max()  # one flat colour, one filter


def damaged(path, to, keep=1.0, noise_at=None):
    data = bytearray(path.read_bytes())
    if noise_at is not None:
        place = int(noise_at * len(data))
        data[place : place + 4000] = np.random.default_rng(1).bytes(4000)
    to.write_bytes(bytes(data[: int(keep * len(data))]))
    return to


def noisy_frames(count):
    rng = np.random.default_rng(0)
    sizes = ((96, 128), (48, 64), (48, 64))
    return [
        yuv_frame([rng.integers(16, 235, size).astype(np.uint8) for size in sizes], "yuv420p") for _ in range(count)
    ]


@pytest.mark.parametrize(
    ("suffix", "codec", "options", "words"),
    [
        ("mkv", "ffv1", {}, "its header gives it 0.4 s"),
        ("mkv", "libx264", {}, "its header gives it 0.4 s"),
        ("mp4", "libx264", {}, "cannot be opened"),  # its index was at the end
        ("mp4", "libx264", {"movflags": "faststart"}, "a packet is damaged"),
        ("avi", "mjpeg", {}, "a packet is damaged"),
    ],
)
def test_truncated_files_are_refused(suffix, codec, options, words, tmp_path):
    frames = noisy_frames(20)
    if codec == "mjpeg":
        frames = [frame.reformat(format="yuvj420p") for frame in frames]
    whole = encode(tmp_path / f"a.{suffix}", frames, codec, 50, container_options=options)
    sensor = hr.load_sensor("reference-mono").crop(8, 8)
    tags = {"transfer": "srgb", "primaries": "bt709", "matrix": "bt709", "range": "full"}
    hr.simulate_video(whole, sensor, **tags)
    part = damaged(whole, tmp_path / f"part.{suffix}", keep=0.6)
    with pytest.raises(SpecError, match=words) as caught:
        hr.simulate_video(part, sensor, out=tmp_path / "out", **tags)
    assert str(part) in str(caught.value) and not (tmp_path / "out").exists()


def test_the_intact_part_of_a_truncated_file_can_be_used(tmp_path):
    whole = encode(tmp_path / "a.mkv", noisy_frames(20), "ffv1", 50)
    part = damaged(whole, tmp_path / "part.mkv", keep=0.6)
    sensor = hr.load_sensor("reference-mono").crop(8, 8)
    with pytest.raises(SpecError, match=r"it once was longer .* give a duration within that time"):
        hr.simulate_video(part, sensor)
    recording = hr.simulate_video(part, sensor, duration_s=0.15)
    assert recording.duration_us == 150_000 and recording.manifest["settings"]["video"]["cut_short"]
    with pytest.raises(RangeError, match="at most the video's"):
        hr.simulate_video(part, sensor, duration_s=0.39)


@pytest.mark.parametrize(
    ("suffix", "codec"), [("mkv", "ffv1"), ("mp4", "libx264"), ("mkv", "libx264"), ("mp4", "mpeg4")]
)
def test_corrupt_files_are_refused(suffix, codec, tmp_path):
    """4000 random bytes in the middle: an error that says where, and no picture made of them."""
    whole = encode(tmp_path / f"a.{suffix}", noisy_frames(20), codec, 50)
    broken = damaged(whole, tmp_path / f"b.{suffix}", noise_at=0.5)
    sensor = hr.load_sensor("reference-mono").crop(8, 8)
    with pytest.raises(SpecError, match=r"damaged|once was longer") as caught:
        hr.simulate_video(broken, sensor, out=tmp_path / "out")
    assert str(broken) in str(caught.value) and not (tmp_path / "out").exists()


def test_a_wrong_checksum_is_seen_where_the_codec_has_one(tmp_path):
    """One byte of FFV1 changed: its decoder logs the checksum and hands the picture out."""
    whole = encode(tmp_path / "a.mkv", noisy_frames(20), "ffv1", 50)
    data = bytearray(whole.read_bytes())
    data[len(data) // 2] ^= 1
    broken = tmp_path / "b.mkv"
    broken.write_bytes(bytes(data))
    with pytest.raises(SpecError, match=r"picture \d+ or one soon after it is damaged"):
        hr.simulate_video(broken, hr.load_sensor("reference-mono").crop(8, 8))


def test_things_that_are_no_video(tmp_path):
    text = tmp_path / "a.mp4"
    text.write_text("no video")
    sound = tmp_path / "a.wav"
    with av.open(str(sound), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), "s16", "mono")
        frame.sample_rate = 8000
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    for path, words in (
        (text, "cannot be opened as a video"),
        (sound, "no video"),
        (tmp_path / "none.mp4", "no such file"),
    ):
        with pytest.raises(SpecError, match=words):
            opened(path)
    empty = tmp_path / "empty.mp4"
    empty.write_bytes(b"")
    with pytest.raises(SpecError, match="cannot be opened"):
        opened(empty)


def test_what_would_be_silently_wrong_is_refused(tmp_path):
    wide = encode(tmp_path / "wide.mkv", grey_frames([100] * 2))
    with av.open(str(tmp_path / "sar.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.sample_aspect_ratio = 2
        for frame in grey_frames([100] * 2):
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    with pytest.raises(SpecError, match="not square"):
        opened(tmp_path / "sar.mp4")
    with av.open(str(wide)) as source, av.open(str(tmp_path / "turned.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.set_display_rotation(90)
        for frame in source.decode(video=0):
            frame.pts = None
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    with pytest.raises(SpecError, match="rotated"):
        opened(tmp_path / "turned.mp4")
    frames = grey_frames([100] * 2)
    path = encode(tmp_path / "inter.mp4", frames, "libx264", options={"x264-params": "tff=1"})
    with pytest.raises(SpecError, match="interlaced"):
        opened(path)


# -- folders


def png_folder(folder, pictures, pattern="frame_{:04d}.png", first=0, mode=None):
    folder.mkdir(exist_ok=True)
    for k, picture in enumerate(pictures):
        Image.fromarray(picture, mode).save(folder / pattern.format(first + k))
    return folder


def codes(count=4, height=24, width=32, channels=3, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (count, height, width, channels), dtype=np.uint8)


def test_png_folder_equals_the_array(tmp_path):
    pictures = codes()
    folder = png_folder(tmp_path / "a", pictures, first=7)
    (folder / "notes.txt").write_text("left alone")
    video, array = opened(folder, fps=10), opened(pictures, fps=10)
    assert video.count == 4 and video.format.layout == "planar"
    for k in range(4):
        np.testing.assert_array_equal(np.dstack(video.read(k)), array.read(k)[0])
    sensor = hr.load_sensor("eiger").crop(32, 24)
    with pytest.raises(SpecError, match="missing: transfer"):
        hr.simulate_video(folder, sensor, fps=10)
    with pytest.raises(SpecError, match="frame rate"):
        hr.simulate_video(folder, sensor, transfer="srgb")
    one, other = (hr.simulate_video(source, sensor, fps=10, transfer="srgb") for source in (folder, pictures))
    np.testing.assert_array_equal(one.frames[0].raw, other.frames[0].raw)
    np.testing.assert_array_equal(one.events, other.events)


def test_numbers_decide_the_order_and_need_no_zeros(tmp_path):
    pictures = codes(12)
    video = opened(png_folder(tmp_path / "a", pictures, "shot{}.png", first=95), fps=10)
    np.testing.assert_array_equal(np.dstack(video.read(11)), pictures[11])


def test_a_gap_in_the_numbering_is_named(tmp_path):
    folder = png_folder(tmp_path / "a", codes(6))
    (folder / "frame_0003.png").unlink()
    with pytest.raises(SpecError, match=r"picture number 3 is missing \(5 pictures, 0 to 5\)"):
        opened(folder, fps=10)


def test_folders_that_are_no_series(tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(SpecError, match="no pictures"):
        opened(empty, fps=10)
    two = png_folder(tmp_path / "two", codes(2), "left_{}.png")
    png_folder(two, codes(2), "right_{}.png")
    with pytest.raises(SpecError, match=r"not of the same series as left_0\.png"):
        opened(two, fps=10)
    twice = png_folder(tmp_path / "twice", codes(1), "a1.png")
    png_folder(twice, codes(1), "a01.png")
    with pytest.raises(SpecError, match=r"same number as a01\.png"):
        opened(twice, fps=10)
    nameless = png_folder(tmp_path / "nameless", codes(1), "cover.png")
    with pytest.raises(SpecError, match="no number"):
        opened(nameless, fps=10)


def test_pictures_of_another_size_or_broken_ones(tmp_path):
    folder = png_folder(tmp_path / "a", codes(2))
    png_folder(folder, codes(1, 16, 16), first=2)
    (folder / "frame_0003.png").write_bytes((folder / "frame_0000.png").read_bytes()[:100])
    video = opened(folder, fps=10)
    with pytest.raises(SpecError, match=r"frame_0002.png: is 16x16 planar, 8 bit, unlike the first picture \(32x24"):
        video.read(2)
    with pytest.raises(SpecError, match=r"frame_0003.png: .*(cannot be read|damaged)"):
        video.read(3)


@pytest.mark.parametrize("kind", ["folder", "array", "grey and alpha", "tiff", "16 bit"])
def test_alpha_must_be_opaque(kind, tmp_path):
    """Opaque alpha is left out, transparency is refused: nobody said what shines through."""
    pictures = codes(2, channels=4)
    if kind == "16 bit":
        pictures = pictures.astype(np.uint16) * 257
    if kind == "grey and alpha":
        pictures = pictures[..., :2].copy()
    pictures[..., -1] = np.iinfo(pictures.dtype).max
    for opaque in (True, False):
        if not opaque:
            pictures[1, 5, 5, -1] = 128
        folder = tmp_path / f"{kind}{opaque}"
        if kind in ("tiff", "16 bit"):
            folder.mkdir()
            for k, picture in enumerate(pictures):
                tifffile.imwrite(folder / f"{k}.tif", picture, photometric="rgb")
        elif kind != "array":
            png_folder(folder, pictures)
        video = opened(pictures if kind == "array" else folder, fps=10)
        found = video.read(0)
        expected = pictures[0, ..., :-1]
        found = np.dstack(found) if len(found) > 1 else np.atleast_3d(found[0])
        np.testing.assert_array_equal(found[..., : expected.shape[2]], expected)
        if opaque:
            video.read(1)
            continue
        with pytest.raises(SpecError, match="transparent"):
            video.read(1)


def test_tiff_of_16_and_12_bit(tmp_path):
    rng = np.random.default_rng(2)
    folder = tmp_path / "a"
    folder.mkdir()
    pictures = rng.integers(0, 4096, (3, 24, 32, 3)).astype(np.uint16)
    for k, picture in enumerate(pictures):
        tifffile.imwrite(folder / f"x{k}.tiff", picture, photometric="rgb")
    video = opened(folder, fps=10, bit_depth=12)
    np.testing.assert_array_equal(video.read(1)[0], pictures[1])
    assert video.format.bits == 12 and opened(folder, fps=10).format.bits == 16
    with pytest.raises(RangeError, match="bit_depth"):
        opened(folder, fps=10, bit_depth=8)
    (folder / "x1.tiff").write_bytes(b"II*\0broken")
    with pytest.raises(SpecError, match=r"x1\.tiff"):
        opened(folder, fps=10).read(1)


def test_png_of_16_bit(tmp_path):
    """Many readers make 8 bits of it."""
    rng = np.random.default_rng(3)
    picture = rng.integers(0, 65536, (24, 32, 3)).astype(np.uint16)
    folder = tmp_path / "a"
    folder.mkdir()
    frame = av.VideoFrame.from_ndarray(picture, "rgb48le")
    encode(folder / "1.png", [frame.reformat(format="rgb48be")], "png", tags=None)
    video = opened(folder, fps=10)
    assert video.format.bits == 16
    np.testing.assert_array_equal(np.dstack(video.read(0)), picture)


def test_jpeg_keeps_its_own_matrix(tmp_path):
    """JFIF is full-range BT.601 with centred chroma, as its standard says; flat colours come back within 2 codes."""
    folder = tmp_path / "a"
    folder.mkdir()
    colours = [(200, 40, 90), (20, 180, 60), (128, 128, 128)]
    for k, colour in enumerate(colours):
        Image.new("RGB", (32, 24), colour).save(folder / f"{k}.jpg", quality=100)
    video = FolderVideo(folder, fps=10.0)
    assert video.tags.matrix == "bt601" and video.tags.range == "full" and not video.format.chroma_left
    sensor = hr.load_sensor("reference-bayer").crop(8, 8)
    from_jpeg = VideoFlux(folder, sensor, VideoOptions.of(fps=10, transfer="linear", fit="pixel"))
    array = np.array(colours, np.uint8)[:, None, None].repeat(24, 1).repeat(32, 2)
    from_array = VideoFlux(array, sensor, VideoOptions.of(fps=10, transfer="linear", fit="pixel"))
    pixels = np.arange(64, dtype=np.uint32)
    for k in range(3):
        found, expected = (np.array(f.mean_flux(pixels, 1e5 * k, 1e5 * k + 1)[0]) for f in (from_jpeg, from_array))
        np.testing.assert_allclose(found, expected, atol=2 / 255 * from_array.filter_matrix.sum(axis=1).max())


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_exr_is_linear_and_keeps_its_range(dtype, tmp_path):
    rng = np.random.default_rng(4)
    folder = tmp_path / "a"
    folder.mkdir()
    pictures = rng.uniform(0, 20, (3, 24, 32, 3)).astype(dtype)
    for k, picture in enumerate(pictures):
        channels = {name: np.ascontiguousarray(picture[..., j]) for j, name in enumerate("RGB")}
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, channels) as file:
            file.write(str(folder / f"hdr.{k:04d}.exr"))
    video = opened(folder, fps=10)
    assert video.tags.transfer == "linear" and video.format.bits == 0
    np.testing.assert_array_equal(video.read(2)[0], pictures[2])
    sensor = hr.load_sensor("reference-mono").crop(32, 24)
    options = VideoOptions.of(fps=10, white_e_per_s=1.0, white_filter="clear")
    found = np.array(VideoFlux(folder, sensor, options).mean_flux(np.arange(768, dtype=np.uint32), 0, 1)[0])
    expected = pictures[0].astype(np.float64) @ (0.2126, 0.7152, 0.0722)
    np.testing.assert_allclose(found.reshape(24, 32), expected, rtol=1e-5)


def test_exr_without_colours_and_values_that_are_none(tmp_path):
    for name, channels, words in (
        ("z", {"Z": np.ones((8, 8), np.float32)}, "expected R, G, B or Y"),
        ("nan", {"Y": np.full((8, 8), np.nan, np.float32)}, "not finite"),
    ):
        folder = tmp_path / name
        folder.mkdir()
        with OpenEXR.File({"type": OpenEXR.scanlineimage}, channels) as file:
            file.write(str(folder / "1.exr"))
        with pytest.raises(SpecError, match=words):
            opened(folder, fps=10)


# -- arrays


def test_npy_is_mapped_and_equals_the_array(tmp_path):
    pictures = (codes(3).astype(np.uint16) * 257)[..., :1]
    np.save(tmp_path / "a.npy", pictures)
    video = opened(str(tmp_path / "a.npy"), fps=10)
    assert isinstance(video._array, np.memmap) and video.format.layout == "grey"
    np.testing.assert_array_equal(video.read(2)[0], pictures[2, ..., 0])
    assert video.describe()["sha256"] == opened(pictures, fps=10).describe()["sha256"]
    (tmp_path / "b.npy").write_bytes((tmp_path / "a.npy").read_bytes()[:300])
    with pytest.raises(SpecError, match="cannot be read"):
        opened(tmp_path / "b.npy", fps=10)


@pytest.mark.parametrize(
    ("array", "text"),
    [
        (np.zeros((4, 8), np.uint8), r"expected \[time, row, col\]"),
        (np.zeros((2, 8, 8, 5), np.uint8), "3 or 4 channels"),
        (np.zeros((0, 8, 8), np.uint8), "shape"),
        (np.zeros((2, 8, 8), np.int32), "int32"),
        (np.full((2, 8, 8), np.inf, np.float32), "not finite"),
    ],
)
def test_arrays_that_are_no_video(array, text):
    sensor = hr.load_sensor("reference-mono").crop(8, 8)
    with pytest.raises(SpecError, match=text):
        hr.simulate_video(array, sensor, fps=10, transfer="linear")


def test_large_finite_values_are_no_error():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        video = opened(np.full((1, 8, 8), 3e38, np.float32), fps=1)
        assert video.read(0)[0].max() > 1e38


def test_pictures_smaller_than_the_mosaic_are_enlarged_or_refused():
    """Documented: 'cover' enlarges and notes it, 'pixel' refuses."""
    sensor = hr.load_sensor("eiger").crop(64, 48)
    pictures = codes(2, 3, 4)
    recording = hr.simulate_video(pictures, sensor, fps=10, transfer="srgb")
    assert any("enlarged 16 times" in note for note in recording.manifest["settings"]["video"]["notes"])
    with pytest.raises(HesimError, match="at least the 64x48 px read out"):
        hr.simulate_video(pictures, sensor, fps=10, transfer="srgb", fit="pixel")


@pytest.mark.parametrize("size", [(5, 4), (4, 4), (1, 1), (3, 7)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("offset", [0, 1, 2, 3])
def test_pictures_of_any_size_at_any_address_are_read_as_they_are(size, dtype, offset):
    """Words are taken where they lie if they are whole and aligned; the last pixel's bytes end where the array ends."""
    rng = np.random.default_rng(5)
    count = 2 * size[0] * size[1] * 3
    store = rng.integers(0, 256, count * np.dtype(dtype).itemsize + offset, dtype=np.uint8)
    pictures = store[offset:].view(dtype).reshape(2, *size, 3)
    top = np.iinfo(dtype).max
    for number in range(2):
        found = Lineariser(
            PictureFormat("interleaved", size[1], size[0], 8 * np.dtype(dtype).itemsize),
            ColourTags("linear", None, "bt709", "rgb", "full"),
        ).linear((pictures[number],))
        for channel in range(3):
            expected = pictures[number][..., channel].ravel() / top
            np.testing.assert_allclose(np.array(found[channel]), expected, atol=1e-6)


def test_the_hash_is_made_beside_the_run_and_its_errors_are_told():
    pieces = [b"abc", np.arange(5, dtype=np.uint8).data]
    assert Digest(lambda: pieces).hexdigest() == hashlib.sha256(b"abc" + bytes(range(5))).hexdigest()

    def broken():
        yield b"abc"
        raise OSError("gone")

    with pytest.raises(OSError, match="gone"):
        Digest(broken).hexdigest()
    seen = []

    def endless():
        while True:
            seen.append(1)
            yield b"x" * 1000

    digest = Digest(endless)
    digest.stop()
    count = len(seen)
    time.sleep(0.05)
    assert len(seen) == count


def test_an_input_without_its_data_cannot_be_made():
    with pytest.raises(TypeError, match="_pieces"):
        Hashed()


def test_a_folder_names_its_first_and_last_picture(tmp_path):
    for name in ("11.png", "9.png", "10.png"):
        Image.fromarray(np.zeros((4, 6), np.uint8)).save(tmp_path / name)
    facts = opened(tmp_path, fps=10).describe()
    assert (facts["first"], facts["last"], facts["pictures"], facts["size_px"]) == ("9.png", "11.png", 3, [6, 4])
