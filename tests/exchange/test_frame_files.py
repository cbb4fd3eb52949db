"""RAW frames as files of other programs, read back by libraries that are not ours."""

import json

import numpy as np
import pytest
import recordings
import tifffile
from PIL import Image

from hesim_render.core.errors import SpecError
from hesim_render.exchange.frame_files import write_mipi
from hesim_render.recording.recording import Recording


def mipi(path):
    words = np.fromfile(path, dtype="<u2")
    return words[2:].reshape(words[1], words[0])


READERS = {
    "tiff": (tifffile.imread, "tiff"),
    "png": (lambda path: np.asarray(Image.open(path)), "png"),
    "npy": (np.load, "npy"),
    "mipi": (mipi, "bin"),
}


@pytest.mark.parametrize("sensor", ["eiger", "reference-mono"])
@pytest.mark.parametrize("name", READERS)
def test_frames_come_back_exactly(name, sensor, tmp_path):
    made = recordings.make(sensor, tmp_path / "r", width=128, height=64)
    folder = Recording.load(tmp_path / "r").export(name, tmp_path / "out")
    read, suffix = READERS[name]
    facts = json.loads((folder / "frames.json").read_text(encoding="utf-8"))
    assert [entry["file"] for entry in facts["frames"]] == [f"000000.{suffix}", f"000001.{suffix}"]
    assert sorted(path.name for path in folder.iterdir()) == [f"000000.{suffix}", f"000001.{suffix}", "frames.json"]
    for entry, frame in zip(facts["frames"], made.frames, strict=True):
        found = read(folder / entry["file"])
        assert found.dtype == np.uint16 and found.max() > 255
        np.testing.assert_array_equal(found, frame.raw)
        assert {key: value for key, value in entry.items() if key != "file"} == frame.times
    assert facts["black_level_dn"] == made.mosaic.black_level_dn
    assert facts["tile_filter"] == made.mosaic.tile_filter and facts["bit_depth"] == made.mosaic.bit_depth
    # the same folder again, asked for
    assert made.export(name, tmp_path / "out", overwrite=True) == folder


@pytest.mark.parametrize("shape", [(1 << 16, 2), (2, 1 << 16)])
def test_frames_of_a_file_of_mipi_have_at_most_65535_rows_and_columns(tmp_path, shape):
    with pytest.raises(SpecError, match=f"at most 65535 rows and columns, not {shape[1]}x{shape[0]} px"):
        write_mipi(tmp_path / "a.bin", np.zeros(shape, np.uint16))
    most = tuple(min(size, 65535) for size in shape)
    write_mipi(tmp_path / "a.bin", np.zeros(most, np.uint16))
    assert np.fromfile(tmp_path / "a.bin", "<u2", 2).tolist() == [most[1], most[0]]
