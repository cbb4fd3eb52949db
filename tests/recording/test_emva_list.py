"""Lists of EMVA 1288 pictures, line by line, and the grey pictures that they name."""

import numpy as np
import pytest
import tifffile
from PIL import Image

from hesim_render.core.errors import SpecError
from hesim_render.recording.emva_list import _Pictures, find_list, read_list
from hesim_render.recording.grey_picture import grey_size, read_grey

SHAPE = 5, 7


def listed(folder, text, unit=None, encoding="utf-8"):
    (folder / "list.txt").write_bytes(text.encode(encoding))
    for name in ("a", "b", "c"):
        (folder / f"{name}.png").touch()
    return read_list(folder / "list.txt", unit)


def one(folder, line, unit=None):
    """The series of one line with a picture."""
    return listed(folder, f"n 12 7 5\n{line}\ni a.png\n", unit)[2][0]


@pytest.mark.parametrize("line,unit,exposure_s,photons", [
    ("b 40500 118.4", None, 40.5e-6, 118.4),
    ("b 40,5us 118,4", None, 40.5e-6, 118.4),
    ("b 40.5 µs 118.4", None, 40.5e-6, 118.4),
    ("b\t0.0405ms\t118.4", None, 40.5e-6, 118.4),
    ("B;0,0000405s;118,4;;", None, 40.5e-6, 118.4),
    ("b, 40500, 118.4", None, 40.5e-6, 118.4),
    ("b,40500,118.4", None, 40.5e-6, 118.4),
    ("b 4.05e4 1.184e2  # a remark, 3", None, 40.5e-6, 118.4),
    ("b 40.5 118.4", "us", 40.5e-6, 118.4),
    ("b 40500ns 118.4", "ms", 40.5e-6, 118.4),
    ("b 7", "ms", 7e-3, None),
    ("d 40500", None, 40.5e-6, None),
    ("d 40500 0", None, 40.5e-6, None),
    ("b 40500 0.0", None, 40.5e-6, None),
])  # fmt: skip
def test_an_exposure_is_read_in_its_unit(tmp_path, line, unit, exposure_s, photons):
    series = one(tmp_path, line, unit)
    assert series.exposure_s == exposure_s and series.photons == photons  # to the last bit, so that they match
    assert series.lit == ((line[0] in "bB" and photons is not None) or line == "b 7")


def test_the_size_may_be_apart_by_commas(tmp_path):
    bits, shape, _ = listed(tmp_path, "# n 8 1 1\nV 4.0\nN,12,7,5\n")
    assert (bits, shape) == (12, (5, 7))


@pytest.mark.parametrize("text,counts", [
    ("b 1 2\ni a.png\nb 1 2\ni b.png\nb 1 2\ni c.png\n", [3]),
    ("b 1 2\ni a.png\ni b.png\nb 1 2\ni c.png\n", [2, 1]),
    ("b 1 2\ni a.png\nb 1 3\ni b.png\n", [1, 1]),
    ("d 1\ni a.png\nb 1 3\ni b.png\nd 1\ni c.png\n", [1, 1, 1]),
])  # fmt: skip
def test_lines_of_one_exposure_before_each_picture_are_one_series(tmp_path, text, counts):
    assert [len(series.files) for series in listed(tmp_path, "n 12 7 5\n" + text)[2]] == counts


@pytest.mark.parametrize("encoding", ("utf-8-sig", "utf-16", "cp1252"))
def test_a_list_may_have_other_encodings(tmp_path, encoding):
    (tmp_path / "Müll.png").touch()
    series = listed(tmp_path, "% Gerät\nn 12 7 5\nb 1 µs 2\ni Müll.png\n", encoding=encoding)[2]
    assert series[0].files[0].name == "Müll.png" and series[0].exposure_s == 1e-6
    assert find_list(tmp_path) == tmp_path / "list.txt"


def test_the_name_in_the_same_letters_goes_first(tmp_path):
    for name in ("A.png", "x.png"):
        (tmp_path / name).touch()
    assert [f.name for f in listed(tmp_path, "n 12 7 5\nb 1 2\ni a.png\ni A.png\ni X.PNG\n")[2][0].files] == [
        "a.png", "A.png", "x.png",
    ]  # fmt: skip
    with pytest.raises(SpecError, match=r"list.txt:3: no such file: 'A.PNG'"):
        listed(tmp_path, "n 12 7 5\nb 1 2\ni A.PNG\n")


def values(high, seed=2):
    return np.random.default_rng(seed).integers(0, high, SHAPE, np.uint16)


def pgm(kind, data, largest=4095):
    return b"%b # x\n# y\n7\t5\n%d\n%b" % (kind, largest, data)


@pytest.mark.parametrize("name", ("P5", "P5 of 8 bit", "P2", "tiles", "int32", "RGB", "palette"))
def test_grey_values_are_as_stored(tmp_path, name):
    frame = values(256 if name in ("P5 of 8 bit", "RGB", "palette") else 4096)
    file = tmp_path / "a.pgm"
    if name == "P5":
        file.write_bytes(pgm(b"P5", frame.astype(">u2").tobytes()))
    elif name == "P5 of 8 bit":
        file.write_bytes(pgm(b"P5", frame.astype("u1").tobytes(), 255))
    elif name == "P2":
        file.write_bytes(pgm(b"P2", (" ".join(map(str, frame.ravel())) + " # end\n").encode()))
    elif name in ("tiles", "int32"):
        file = tmp_path / "a.TIF"
        kind = {"tile": (16, 16)} if name == "tiles" else {}
        tifffile.imwrite(
            file, frame.astype(np.int32 if name == "int32" else np.uint16), photometric="minisblack", **kind
        )
    else:
        file = tmp_path / "a.bmp"
        picture = Image.fromarray(frame.astype(np.uint8))
        picture.convert("RGB" if name == "RGB" else "P").save(file)
    np.testing.assert_array_equal(read_grey(file, SHAPE), frame)
    assert grey_size(file) == SHAPE
    with pytest.raises(SpecError, match="expected a grey one of 7x6 px"):
        read_grey(file, (6, 7))


@pytest.mark.parametrize("channel", (1, 2))
def test_one_channel_that_differs_is_a_colour(tmp_path, channel):
    picture = np.repeat(values(250).astype(np.uint8)[..., None], 3, axis=2)
    picture[4, 6, channel] += 1
    Image.fromarray(picture).save(tmp_path / "a.png")
    with pytest.raises(SpecError, match=r"a\.png: is a colour picture"):
        read_grey(tmp_path / "a.png", SHAPE)


@pytest.mark.parametrize("largest,message", [(0, "states the largest value 0"), (70_000, "the largest value 70000")])
def test_a_largest_value_of_other_bits_is_refused(tmp_path, largest, message):
    (tmp_path / "a.pgm").write_bytes(pgm(b"P5", bytes(70), largest))
    with pytest.raises(SpecError, match=message):
        read_grey(tmp_path / "a.pgm", SHAPE)


def test_the_list_of_a_folder_is_a_text_file_with_a_line_of_sizes(tmp_path):
    """Not a folder that is called like one, no file of another kind, and no text without such a line."""
    (tmp_path / "old.txt").mkdir()
    (tmp_path / "notes.txt").write_text("n pictures were taken\n")
    (tmp_path / "copy.md").write_text("n 12 7 5\n")
    assert find_list(tmp_path) is None
    (tmp_path / "pairs.CSV").write_text("# camera\nN;12;7;5\n")
    assert find_list(tmp_path) == find_list(tmp_path / "pairs.CSV") == tmp_path / "pairs.CSV"
    assert find_list(tmp_path / "copy.md") is None and find_list(tmp_path / "none") is None
    (tmp_path / "more.lst").write_text("n 12 7 5\n")
    with pytest.raises(SpecError, match=r"holds 2 lists of EMVA 1288 pictures, more\.lst and pairs\.CSV"):
        find_list(tmp_path)
    (tmp_path / "EMVA1288_Data.txt").write_text("n 12 7 5\n")
    assert find_list(tmp_path) == tmp_path / "EMVA1288_Data.txt"


def test_a_name_through_a_link_that_leads_out_is_refused_even_if_its_end_is_here(tmp_path):
    """Of a path of another machine, the end is taken; a relative one stays in the folder."""
    (tmp_path / "outside").mkdir()
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "link").symlink_to(tmp_path / "outside")
    (tmp_path / "set" / "a.png").touch()
    pictures = _Pictures(tmp_path / "set" / "list.txt")
    for name in ("C:\\lab\\A.png", "/lab/a.png", "a.png", "'lab/a.png'"):
        assert pictures.find(3, name) == tmp_path / "set" / "a.png"
    for name in ("link/a.png", "../set/a.png", ""):
        with pytest.raises(SpecError, match="leads out of its folder"):
            pictures.find(3, name)
    with pytest.raises(SpecError, match=r"no such file: 'b\.png'"):
        pictures.find(3, "b.png")
