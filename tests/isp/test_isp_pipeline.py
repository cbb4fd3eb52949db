"""Pipelines from files, the camera's two directions, and pictures of recordings."""

import numpy as np
import pytest
import recordings
from isp_images import PAPER_BALANCE, PAPER_MATRIX, QUAD, captured, images, mosaic_of, psnr

from hesim_render.core.errors import RangeError, SpecError
from hesim_render.isp import (
    Camera,
    Pipeline,
    balance,
    colour,
    demosaic,
    develop,
    levels,
    load_camera,
    load_pipeline,
    process,
)
from hesim_render.spectral import transfer

CAMERA = """
channels: [R, G, B]
tile: |
  R R G G
  R . G G
  G G B B
  G G B .
black_level_dn: 64
white_level_dn: 1023
white_balance: [2.643, 1.0, 1.764]
matrix: [[1.2, -0.15, -0.05], [-0.1, 1.2, -0.1], [-0.05, -0.15, 1.2]]
"""


def write(path, text):
    path.write_text(text, encoding="utf-8")
    return path


# -- camera ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("curve", ["srgb", "bt709", "gamma", "linear"])
def test_both_directions_without_a_mosaic_meet_above_80_db(curve):
    camera = Camera(
        channels=list("RGB"), tile=[["R", "G"], ["G", "B"]], white_level_dn=255, transfer=curve,
        white_balance=PAPER_BALANCE, matrix=[list(row) for row in PAPER_MATRIX],
    )  # fmt: skip
    for picture in images().values():
        there = camera.from_linear(camera.decode(picture)).astype(np.float32)
        back = transfer.encode(camera.to_linear(there).astype(np.float32), curve)
        assert psnr(back, picture) > 80
        expected = camera.decode(picture) @ np.linalg.inv(PAPER_MATRIX).T / PAPER_BALANCE
        np.testing.assert_allclose(there, expected, atol=1e-6)


def test_camera_file(tmp_path):
    camera = load_camera(write(tmp_path / "camera.yaml", CAMERA))
    np.testing.assert_array_equal(camera.tile_channel, [[0, 0, 1, 1], [0, -1, 1, 1], [1, 1, 2, 2], [1, 1, 2, -1]])
    np.testing.assert_array_equal(camera.filled_tile, QUAD)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("R R G G", "R X G G", "'X' is not one of the channels R, G, B"),
        ("R R G G", "R R G", "rows must be of one length"),
        ("[2.643, 1.0, 1.764]", "[2.643, 1.0]", "expected 3 positive gains"),
        ("white_level_dn: 1023", "white_level_dn: 64", "must be above black_level_dn"),
        ("[[1.2, -0.15, -0.05], ", "[", "expected 3 rows of 3"),
        ("channels: [R, G, B]", "channels: [R, G, B]\ncolours: 3", "unknown key"),
    ],
)
def test_wrong_camera_files_are_explained(tmp_path, old, new, message):
    with pytest.raises(SpecError, match=message) as caught:
        load_camera(write(tmp_path / "camera.yaml", CAMERA.replace(old, new)))
    assert "camera.yaml" in str(caught.value)


def test_camera_of_a_recording_inverts_its_neutral():
    mosaic = recordings.make("mipi-hybridevs").mosaic
    camera = Camera.of(mosaic)
    np.testing.assert_allclose(np.array(mosaic.neutral) * camera.white_balance, 1.0, rtol=1e-9)
    np.testing.assert_allclose(camera.to_linear(mosaic.neutral), 1.0, rtol=1e-6)
    np.testing.assert_array_equal(camera.filled_tile, np.array(QUAD))
    assert (camera.tile_channel < 0).sum() == 2


def test_only_three_channels_can_be_inverted():
    camera = Camera(channels=["M"], tile=[["M"]], white_level_dn=255, white_balance=[1], matrix=[[1], [1], [1]])
    with pytest.raises(RangeError, match="can be inverted"):
        camera.from_linear(np.ones((2, 3)))


# -- pipelines ---------------------------------------------------------------------------------------------------


def test_default_pipeline_is_its_functions_one_after_the_other(tmp_path):
    camera = load_camera(write(tmp_path / "camera.yaml", CAMERA))
    raw = np.random.default_rng(3).integers(64, 700, (40, 48)).astype(np.uint16)
    tile = camera.tile_channel
    light = levels.black_level(raw, 64, 1023)
    picture = demosaic(balance.white_balance(light, tile, PAPER_BALANCE), tile)
    expected = transfer.encode(colour.colour_matrix(picture, camera.matrix), depth=8)
    np.testing.assert_array_equal(process(raw, camera), expected)


def test_a_file_changes_the_steps(tmp_path):
    np.save(tmp_path / "rows.npy", np.linspace(-3, 3, 96))
    np.savez(tmp_path / "maps.npz", bad=np.eye(96, 128, dtype=bool), n_blc=np.full((96, 128), 2.0))
    pipeline = load_pipeline(
        write(
            tmp_path / "pipeline.yaml",
            """
schema_version: 1
steps:
  - {step: black_level, row_map: {file: rows.npy}, pixel_map: {file: maps.npz, name: n_blc}}
  - {step: fill, event_pixels: true, bad_pixels: {file: maps.npz, name: bad}}
  - {step: lens_shading, focal_length_px: 400}
  - {step: white_balance, method: grey_world}
  - {step: demosaic, method: linear}
  - {step: noise_reduction}
  - {step: colour_matrix, method: given, matrix: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
  - {step: exposure, gain: 2}
  - {step: tone, method: local}
  - {step: tone, white: 2}
  - {step: encode, depth: 16, transfer: bt709}
""",
        )
    )
    recording = recordings.make("eiger")
    done = develop(recording.frames[0], recording.mosaic, pipeline)
    assert done.image.shape == (96, 128, 3) and done.image.dtype == np.uint16
    assert done.image.std() > 1000
    assert done.report["exposure_gain"] == 2
    assert len(done.report["white_balance"]) == 3


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        ("[{step: black_level}]", "exactly one of them must be demosaic"),
        ("[{step: demosaic}, {step: white_balance}]", "white_balance must come before demosaic"),
        ("[{step: tone}, {step: demosaic}]", "tone must come after demosaic"),
        ("[{step: demosaic}, {step: encode}, {step: exposure}]", "encode must come last"),
        ("[{step: demosaic}, {step: sharpen}]", "sharpen"),
        ("[{step: demosaic, kernel: 3}]", "unknown key"),
        ("[{step: demosaic}, {step: exposure, gain: -1}]", "greater than 0"),
        ("[{step: denoise}, {step: demosaic}]", "denoise must come after black_level"),
        (
            "[{step: black_level}, {step: white_balance}, {step: denoise}, {step: demosaic}]",
            "nothing but fill in between",
        ),
        ("[{step: black_level}, {step: denoise, strength: -1}, {step: demosaic}]", "greater than or equal to 0"),
    ],
)
def test_wrong_pipelines_are_explained(tmp_path, steps, message):
    with pytest.raises(SpecError, match=message) as caught:
        load_pipeline(write(tmp_path / "pipeline.yaml", f"schema_version: 1\nsteps: {steps}\n"))
    assert "pipeline.yaml:2" in str(caught.value)


def test_steps_say_what_they_lack():
    camera = Camera.of(recordings.make("reference-bayer").mosaic)
    raw = np.full((8, 8), 100, dtype=np.uint16)
    for step, key in (
        ({"step": "white_balance", "method": "given"}, "white_balance.gains"),
        ({"step": "white_balance", "method": "chart"}, "white_balance.corners"),
        ({"step": "lens_shading"}, "lens_shading"),
        ({"step": "fill", "bad_pixels": {"file": "nowhere.npy"}}, "nowhere.npy"),
    ):
        with pytest.raises(SpecError, match=key):
            process(raw, camera, Pipeline.of(step, "demosaic"))
    with pytest.raises(SpecError, match=r"colour_matrix\.corners"):
        process(raw, camera, Pipeline.of("demosaic", {"step": "colour_matrix", "method": "chart"}))
    for wrong in (raw[:1], raw[0], np.full((8, 8), np.nan), raw > 0):
        with pytest.raises(RangeError, match="RAW frame"):
            process(wrong, camera)


def test_chart_steps_balance_and_correct():
    """A chart through another matrix and balance than the camera's description has."""
    picture = images()["checker"]
    raw = mosaic_of(captured(picture, bits=12), QUAD)
    camera = Camera(
        channels=list("RGB"), tile=[["RGB"[c] for c in row] for row in QUAD], white_level_dn=4095,
        white_balance=[1, 1, 1], matrix=np.eye(3).tolist(),
    )  # fmt: skip
    corners = [(64, 64), (64, 704), (448, 704), (448, 64)]
    chain = Pipeline.of(
        "black_level", {"step": "white_balance", "method": "chart", "corners": corners}, "demosaic",
        {"step": "colour_matrix", "method": "chart", "corners": corners},
    )  # fmt: skip
    report = develop(raw, camera, chain).report
    # greys of the nominal sRGB values are not quite neutral (7a7a79, f3f3f2)
    np.testing.assert_allclose(report["white_balance"], PAPER_BALANCE, rtol=0.005)
    # nominal sRGB values against ISO 17321-1 reflectances: another chart, so not near zero
    assert report["mean_delta_e_2000"] < 3


def test_frames_may_hold_any_kind_of_number_and_must_hold_a_tile():
    """The same picture from signed and unsigned whole numbers and from floating point."""
    camera = Camera(
        channels=list("RGB"), tile=[["RGB"[c] for c in row] for row in QUAD], white_level_dn=4095,
        white_balance=[1.9, 1, 1.6], matrix=np.eye(3).tolist(),
    )  # fmt: skip
    raw = np.random.default_rng(2).integers(100, 4000, (16, 24))
    expected = process(raw.astype(np.uint16), camera)
    for kind in ("u2", "u4", "i2", "i8", "f4", "f8"):
        np.testing.assert_array_equal(process(raw.astype(kind), camera), expected)
    process(raw[:4, :4], camera)
    infinite = raw.astype(float)
    infinite[3, 5] = np.inf
    for wrong in (raw.astype(bool), raw.astype(complex), raw[:3], raw[:, :3], raw[None], infinite):
        with pytest.raises(RangeError):
            process(wrong, camera)
