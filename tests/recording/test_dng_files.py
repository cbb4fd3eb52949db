"""DNG files as others read them: tags, levels and noise, and files of cameras that this program did not write."""

import json
import shutil
import subprocess

import numpy as np
import pytest
import rawpy
import recordings
import tifffile
from PIL import Image

import hesim_render as hr
from hesim_render.core.errors import HesimWarning, SpecError
from hesim_render.recording import camera_raw
from hesim_render.recording.dng import is_packed, noise_profile, write_dng
from hesim_render.recording.imports import import_recording
from hesim_render.recording.outline import scene_name
from hesim_render.recording.showcase import needs_preview, write_preview_dng

NOISE = 51041


def four_colours(name="reference-bayer"):
    """A sensor with a white pixel in place of the second green one."""
    white = {"pixels.W": {"filter": "white", "roles": ["aps"]}, "filters.white": {"flat": 0.9, "band_nm": [380, 730]}}
    return hr.load_sensor(name, {"tile": "R W\nG B\n", **white})


def small(sensor):
    scene = hr.load_scene("colorchecker")
    return hr.simulate(scene, sensor.crop(96, 64), duration_s=0.04, samples=2, seed=2)


def test_the_noise_of_frames_is_the_profile_of_their_file():
    """Pixels of equal light from black to white: their variance in DN against that of the tag, read by tifffile.

    Of 40,000 pixels the variance has a relative error of 0.7 %; the fit of the law leaves 1.5 %. Five signals.
    """
    plain = {"aps.prnu_rel": 0, "aps.dsnu_e": 0, "aps.read_noise_e": 12}
    sensor = hr.load_sensor("reference-mono", plain).crop(200, 200)
    aps = sensor.spec.aps
    slope, offset = noise_profile(sensor)
    span = sensor_span(sensor)
    assert slope == pytest.approx(aps.system_gain_dn_per_e / span, rel=1e-3)
    # six digits, so that other builds of NumPy and LAPACK write the same bytes
    assert [float(f"{value:.5e}") for value in (slope, offset)] == [slope, offset]
    for share in (0.0, 0.05, 0.2, 0.5, 0.8):
        electrons = np.full((200, 200), share * span / aps.system_gain_dn_per_e, np.float32)
        raw = sensor.aps.sample(electrons, aps.exposure_us, seed=5, frame=1).astype(np.float64)
        if share == 0 and raw.min() == 0:
            continue  # clipped at 0 DN: the law is that of the signal without clipping
        assert raw.var() / span**2 == pytest.approx(slope * share + offset, rel=0.05), share
    assert noise_profile(sensor, ["aps.shot"]) is None or noise_profile(sensor, ["aps.shot"])[0] < slope / 100
    assert noise_profile(hr.load_sensor("dvs128")) is None
    dark = [f"aps.{term}" for term in ("read", "dark_current", "row_noise", "residual", "telegraph")]
    assert noise_profile(sensor, dark)[1] * span**2 == pytest.approx(1 / 12, rel=1e-3)  # rounding to whole DN is left


def sensor_span(sensor):
    aps = sensor.spec.aps
    white = min(2**aps.bit_depth - 1, round(aps.black_level_dn + aps.system_gain_dn_per_e * aps.full_well_e))
    return white - aps.black_level_dn


def test_tags_of_noise_and_pitch(tmp_path):
    sensor = hr.load_sensor("eiger").crop(128, 96)
    recording = recordings.make("eiger", tmp_path / "r")
    with tifffile.TiffFile(tmp_path / "r" / "frames" / "000000.dng") as file:
        tags = {tag.code: tag.value for tag in file.pages[0].tags}
        exif = file.pages[0].tags[34665].value
    assert tags[NOISE] == pytest.approx(noise_profile(sensor)) == recording.mosaic.noise_profile
    numerator, denominator = exif["FocalPlaneXResolution"]
    assert exif["FocalPlaneResolutionUnit"] == 3 and exif["FocalPlaneYResolution"] == (numerator, denominator)
    assert 10_000 / (numerator / denominator) == pytest.approx(1.4, rel=1e-6)
    with tifffile.TiffFile(tmp_path / "r" / "preview.dng") as file:  # quad: 4 pixels, or 3 and an event pixel, are one
        small = {tag.code: tag.value for tag in file.pages[0].tags}
    wide = small[34665]["FocalPlaneXResolution"]
    assert 10_000 / (wide[0] / wide[1]) == pytest.approx(2.8, rel=1e-6)
    assert small[NOISE][0] == pytest.approx(tags[NOISE][0] / 3, rel=1e-6)
    clean = hr.simulate(hr.load_scene("dark"), hr.load_sensor("reference-mono").crop(8, 8), duration_s=0.02, clean=True)
    assert clean.mosaic.noise_profile is None


def test_a_mosaic_of_four_colours_has_a_preview_that_developers_open(tmp_path):
    recording = small(four_colours())
    frame, mosaic = recording.frames[0], recording.mosaic
    assert needs_preview(mosaic) and not needs_preview(hr.Recording.load(saved(tmp_path)).mosaic)
    write_preview_dng(tmp_path / "p.dng", frame, mosaic)
    with rawpy.imread(str(tmp_path / "p.dng")) as file:
        picture = file.postprocess(use_camera_wb=True, no_auto_bright=True, output_bps=8)
        assert picture.shape == (32, 48, 3)
    if shutil.which("dcraw"):
        subprocess.run(["dcraw", "-w", "-W", "-o", "0", "-c", tmp_path / "p.dng"], check=True, capture_output=True)
    white, blue = np.median(picture[:16], axis=(0, 1)), picture.reshape(-1, 3).astype(int)
    assert white.max() > 10 and (blue.max(axis=0) > 60).all()


def saved(tmp_path):
    return small(hr.load_sensor("reference-bayer")).save(tmp_path / "bayer")


@pytest.mark.skipif(shutil.which("exiftool") is None, reason="exiftool is no Python package")
def test_exiftool_finds_no_fault(tmp_path):
    for name in ("eiger", "reference-mono"):
        recordings.make(name, tmp_path / name)
        for file in sorted((tmp_path / name).rglob("*.dng")):
            done = subprocess.run(
                ["exiftool", "-validate", "-warning", "-error", "-a", "-j", "-NoiseProfile", "-FocalPlaneXResolution",
                 file], capture_output=True, text=True, check=True,
            )  # fmt: skip
            found = json.loads(done.stdout)[0]
            assert "Error" not in found, found
            assert found["NoiseProfile"] and found["FocalPlaneXResolution"] > 0
            assert found["Validate"] == "OK", found


def test_files_of_cameras_are_read_through_rawpy(tmp_path):
    sensor = hr.load_sensor("reference-bayer").crop(96, 64)
    recording = small(hr.load_sensor("reference-bayer"))
    frame, mosaic = recording.frames[0], recording.mosaic
    write_dng(tmp_path / "a.dng", frame.raw, mosaic, exposure_us=10, description={})
    as_cameras_write(tmp_path / "a.dng", tmp_path / "camera.dng")
    made = import_recording(tmp_path / "r", sensor, frames=[tmp_path / "camera.dng"])
    np.testing.assert_array_equal(made.frames[0].raw, frame.raw)
    other = hr.load_sensor("reference-bayer", {"tile": "G R\nB G\n"}).crop(96, 64)
    with pytest.raises(SpecError, match=r"begins with the colours R G / G B; .* has G R / B G"):
        import_recording(tmp_path / "s", other, frames=[tmp_path / "camera.dng"])
    high = hr.load_sensor("reference-bayer", {"aps.black_level_dn": 100}).crop(96, 64)
    with pytest.warns(HesimWarning, match="black level"):
        import_recording(tmp_path / "t", high, frames=[tmp_path / "camera.dng"])
    with pytest.raises(SpecError, match="of 96x64 px"):
        import_recording(
            tmp_path / "u", hr.load_sensor("reference-bayer").crop(128, 64), frames=[tmp_path / "camera.dng"]
        )
    assert scene_name(made) == "camera.dng"
    for name in ("x.nef", "x.kdc"):
        (tmp_path / name).write_bytes(b"no picture of any camera")
        with pytest.raises(SpecError, match=rf"{name}: cannot be read .*camera"):
            import_recording(tmp_path / "v", sensor, frames=[tmp_path / name])
    assert not any((tmp_path / name).exists() for name in "suv")


def as_cameras_write(source, target):
    """The file again with a small picture as first image, and the mosaic below it in a SubIFD."""
    with tifffile.TiffFile(source) as file:
        page = file.pages[0].aspage()
        raw = page.asarray()
        mosaic = (33421, 33422, 50710, 50711, 50714, 50717)
        camera = (271, 272, 50706, 50707, 50708, 50721, 50728, 50778)
        tags = {tag.code: (tag.code, tag.dtype, tag.count, tag.value, True) for tag in page.tags}
    with tifffile.TiffWriter(target, byteorder="<") as file:
        first = np.zeros((8, 12, 3), np.uint8)
        file.write(first, photometric="rgb", subfiletype=1, subifds=1, metadata=None,
                   extratags=[tags[code] for code in camera])  # fmt: skip
        file.write(raw, photometric=32803, subfiletype=0, metadata=None, extratags=[tags[code] for code in mosaic])


def test_the_memory_of_a_png_is_asked_for_before_it_is_read(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(camera_raw, "require_memory", lambda size, *words: asked.append(size))
    Image.fromarray(np.arange(15, dtype=np.uint16).reshape(3, 5)).save(tmp_path / "a.png")
    frame = camera_raw._png(tmp_path / "a.png", (3, 5))
    assert asked == [30] and frame[2].tolist() == [10, 11, 12, 13, 14]


def test_directories_of_exposures_begin_at_even_places(tmp_path):
    """Behind descriptions of any length; all files have the same directory, which ends with the file."""
    recording, path, lengths = recordings.make("reference-bayer"), tmp_path / "a.dng", []
    for number in range(6):
        text = {"a": "x" * (2 * number)}
        write_dng(path, recording.frames[0].raw, recording.mosaic, exposure_us=4000, description=text)
        with tifffile.TiffFile(path) as file:
            tag = file.pages[0].tags[34665]
            assert tag.value["ExposureTime"] == (1, 250)
            begin = tag.valueoffset
        assert begin % 2 == 0
        lengths.append(path.stat().st_size - begin)
    assert len(set(lengths)) == 1


def test_what_is_no_tiff_file_is_named_before_it_is_imported(tmp_path):
    (tmp_path / "a.dng").write_text("words")
    with pytest.raises(SpecError, match=r"a\.dng: cannot be read as a DNG file \("):
        is_packed(tmp_path / "a.dng")
