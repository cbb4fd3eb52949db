"""Events as text in the forms of other programs, against NumPy's own reader."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from hesim_render.cli.commands import app
from hesim_render.core.errors import SpecError
from hesim_render.exchange import is_event_file, open_events, text_events, text_form

ROWS, COLS = 93, 211


def drawn(count, seed=3, last_us=3_700_000):
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(700, last_us, count))
    return t, rng.integers(0, COLS, count), rng.integers(0, ROWS, count), rng.integers(0, 2, count)


def lines(columns, form, ends="\n"):
    return "".join(form.format(*row) + ends for row in zip(*(c.tolist() for c in columns), strict=True))


def same(stream, columns):
    events = np.concatenate(list(stream))
    t, x, y, p = columns
    for name, column in (("t_us", t), ("x", x), ("y", y), ("polarity", np.where(p > 0, 1, -1))):
        np.testing.assert_array_equal(events[name], column, err_msg=name)


def seconds(columns, digits=6):
    return [c / 1e6 if k == 0 else c for k, c in enumerate(columns)]


T, X, Y, P = COLUMNS = drawn(4000)
SIGNED = np.where(P > 0, 1, -1)
#: Text, name of the file, and whether it states the size.
FORMS = {
    "E2VID": (f"{COLS} {ROWS}\n" + lines(seconds(COLUMNS), "{:.6f} {} {} {}"), "a.txt", True),
    "seconds": (lines(seconds(COLUMNS), "{:.9f} {} {} {}"), "a.txt", False),
    "whole seconds with an exponent": (lines(seconds(COLUMNS), "{:.12e} {} {} {}"), "a.txt", False),
    "microseconds": (lines(COLUMNS, "{} {} {} {}"), "a.txt", False),
    "microseconds with a point": (lines(COLUMNS, "{}.0 {} {} {}"), "a.txt", False),
    "tabs, -1 and 1, CRLF": (lines((T, X, Y, SIGNED), "{}\t{}\t{}\t{}", "\r\n"), "a.tsv", False),
    "CR": (lines(COLUMNS, "{},{},{},{}", "\r"), "a.csv", False),
    "commas and a header": ("t,x,y,p\n" + lines(COLUMNS, "{},{},{},{}"), "a.csv", False),
    "another order": ("x,y,p,t\n" + lines((X, Y, P, T), "{},{},{},{}"), "a.csv", False),
    "another order without a header": (lines((X, Y, P, T), "{},{},{},{}"), "a.csv", False),
    "more columns": (
        "index;polarity;row;column;timestamp_us\n"
        + lines((np.arange(4000), SIGNED, Y, X, T), "{};{};{};{};{}"), "a.csv", False,
    ),
    "milliseconds": ("time [ms] x y pol\n" + lines([T / 1000, X, Y, P], "{:.3f} {} {} {}"), "a.txt", False),
    "nanoseconds by name": ("t_ns,x,y,p\n" + lines([1000 * T + 400, X, Y, P], "{},{},{},{}"), "a.csv", False),
    "decimal commas": (lines(seconds(COLUMNS), "{:.6f};{};{};{}").replace(".", ","), "a.csv", False),
    "booleans": ("x,y,t,p\n" + lines((X, Y, T, P == 1), "{},{},{},{}"), "a.csv", False),
    "a size in a comment": (
        f"# camera 7\n# geometry {COLS}x{ROWS}\n#t x y p\n" + lines(COLUMNS, "{} {} {} {}"), "a.txt", True
    ),
    "a size by words, as other files begin": (
        f"% height {ROWS}\n% width: {COLS}, height: {ROWS}\n" + lines(COLUMNS, "{} {} {} {}"), "a.dat", True
    ),
    "a mark of UTF-8, spaces and empty lines": (
        "\ufeff" + lines(COLUMNS, "  {}   {} {}\t{}  ").replace("\n", "\n\n", 30), "a.txt", False
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FORMS)
def test_events_are_those_of_the_text(tmp_path, name):
    text, file, is_stated = FORMS[name]
    path = tmp_path / file
    path.write_bytes(text.encode("utf-8"))
    assert is_event_file(path)
    if not is_stated:
        with pytest.raises(SpecError, match=r"does not state the size of the sensor; give it \(--size"):
            open_events(path)
    stream = open_events(path, shape=None if is_stated else (ROWS, COLS))
    assert stream.shape == (ROWS, COLS)
    same(stream, COLUMNS)
    same(stream, COLUMNS)  # a stream starts anew


@pytest.mark.parametrize("form", ("{:.6f} {} {} {}", "{:.9f},{},{},{}"))
def test_blocks_end_where_lines_do_and_are_those_of_numpy(tmp_path, monkeypatch, form):
    """Pieces of 999 bytes; the last line has no end."""
    path = tmp_path / "a.txt"
    text = lines(seconds(COLUMNS), form)[:-1]
    path.write_text(text, encoding="ascii")
    monkeypatch.setattr(text_events, "_PIECE_BYTES", 999)
    stream = open_events(path, shape=(ROWS, COLS))
    assert max(block.size for block in stream) < 90 and sum(1 for _ in stream) > 50
    table = np.loadtxt(path, delimiter="," if "," in form else None)
    same(stream, [np.rint(table[:, 0] * 1e6), *table[:, 1:].T])


def test_nanoseconds_since_1970_are_exact(tmp_path):
    """Whole numbers of 19 digits, of which a double keeps 16."""
    path = tmp_path / "a.txt"
    begin = 1_700_000_000_123_456
    path.write_text(lines([(begin + T) * 1000 + 499, X, Y, P], "{} {} {} {}"), encoding="ascii")
    same(open_events(path, shape=(ROWS, COLS)), [begin + T, X, Y, P])


def test_times_are_rounded_to_the_nearest_microsecond(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("0.0000014 3 4 1\n0.0000016 3 4 0\n1.0000015001 5 2 1\n", encoding="ascii")
    same(
        open_events(path, shape=(ROWS, COLS)),
        [np.array(c) for c in ([1, 2, 1_000_002], [3, 3, 5], [4, 4, 2], [1, 0, 1])],
    )


def test_of_two_orders_that_have_polarities_that_whose_times_rise_is_taken(tmp_path):
    """``x y p t`` of times 0 and 1, which could be polarities."""
    path = tmp_path / "a.txt"
    path.write_text("5 3 1 0\n2 4 0 0\n9 8 1 1\n7 6 0 1\n", encoding="ascii")
    expected = [0, 0, 1, 1], [5, 2, 9, 7], [3, 4, 8, 6], [1, 0, 1, 0]
    same(open_events(path, shape=(ROWS, COLS)), [np.array(column) for column in expected])


GOOD = "9 3 4 1\n12 5 6 0\n"
BAD = {
    "a value too few": (GOOD + "13 4 4\n14 1 1 1\n", r"a.txt:3: 3 values; expected 4"),
    "a value too many": (GOOD + "\n13 4 4 1 1\n", r"a.txt:4: 5 values; expected 4"),
    "a word": (GOOD + "13 4 four 1\n", r"a.txt:3: y is 'four', and no number"),
    "two points": (GOOD + "1.3.1 4 4 1\n", r"a.txt:3: t is '1.3.1', and no number"),
    "a sign alone": (GOOD + "13 - 4 1\n", r"a.txt:3: x is '-', and no number"),
    "no number": (GOOD + "nan 4 4 1\n", r"a.txt:3: t is 'nan', and no number"),
    "an infinite time": (GOOD + "inf 4 4 1\n", r"a.txt:3: t is 'inf', and no number"),
    "a time of the year 3000": (GOOD + "32503680000000000 4 4 1\n", r"a.txt:3: t is 32503680000000000; expected 0 to"),
    "a place between pixels": (GOOD + "13 4.5 4 1\n", r"a.txt:3: x is 4.5; expected 0 to 65535"),
    "a place below 0": (GOOD + "13 4 -4 1\n", r"a.txt:3: y is -4; expected 0 to 65535"),
    "a polarity of 2": (GOOD + "13 4 4 2\n", r"a.txt:3: p is 2; expected -1 to 1"),
    "a time below 0": (GOOD.replace("9", "-9"), r"a.txt:1: t is -9; expected 0"),
    "a place outside": (GOOD + "13 211 4 1\n", r"event 2 \(x 211, y 4\) is outside of 211x93 px"),
    "out of order": (GOOD + "11 4 4 1\n", r"event 2, at 11 µs, comes after one at 12 µs; expected order of time"),
    "a line without end": (GOOD + "1" * 1200, r"a.txt:3: a line of more than 1000 bytes"),
    "CRLF": ((GOOD + "13 4 x 1\n").replace("\n", "\r\n"), r"a.txt:3: y is 'x', and no number"),
    "bytes of another kind": (GOOD + "13 4 \x1b[1m4 1\n", r"a.txt: is of no known event format"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_wrong_list_is_one_error_with_its_line(tmp_path, name):
    text, message = BAD[name]
    path = tmp_path / "a.txt"
    path.write_bytes(text.encode())
    with pytest.raises(SpecError, match=message) as error:
        for _ in open_events(path, shape=(ROWS, COLS)):
            pass
    assert "\n" not in str(error.value) and "\x1b" not in str(error.value)


@pytest.mark.parametrize(
    "text", ("", "hello\n", "1 2 3\n4 5 6\n", "n 12 640 480\nb 400 7\n", "0.5 0.2\n", "a,b,c,d\n1,2,3,1\n")
)
def test_other_text_is_no_list_of_events(tmp_path, text):
    path = tmp_path / "a.txt"
    path.write_text(text, encoding="ascii")
    assert not is_event_file(path)
    with pytest.raises(SpecError, match="is of no known event format"):
        open_events(path, shape=(ROWS, COLS))


def test_import_and_compare_take_text(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t_us,x,y,p\n" + lines(COLUMNS, "{},{},{},{}"), encoding="ascii")
    runner = CliRunner()
    outcome = runner.invoke(app, ["import", str(path), "--out", str(tmp_path / "e.h5"), "--json"])
    assert outcome.exit_code != 0 and "does not state the size" in str(outcome.exception)
    size = ["--size", f"{COLS}x{ROWS}", "--json"]
    outcome = runner.invoke(app, ["import", str(path), "--out", str(tmp_path / "e.h5"), *size])
    assert outcome.exit_code == 0, outcome.output
    facts = json.loads(outcome.stdout)
    assert (facts["events"], facts["events_on"]) == (4000, int(P.sum()))
    same(open_events(tmp_path / "e.h5"), COLUMNS)
    outcome = runner.invoke(app, ["compare", str(path), str(tmp_path / "e.h5"), "--quiet", *size])
    assert outcome.exit_code == 0, outcome.output
    assert not any(one["differs"] for one in json.loads(outcome.stdout)["distances"])


def test_columns_are_told_by_times_that_do_not_fall_and_whole_places():
    rows = [["1", "0.5", "7", "2"], ["0", "0.5", "3", "9"], ["-1", "1.25", "4", "5"], ["1", "0.1"]]
    assert text_form._fits(rows, (1, 2, 3, 0))
    assert not text_form._fits(rows, (2, 0, 3, 1))  # 7, 3, 4 is no time
    assert not text_form._fits([["0.5", "1.5", "2", "1"], *2 * [["0.6", "1", "2", "1"]]], (0, 1, 2, 3))
    assert not text_form._fits([["0.5", "1", "2.5", "1"], *2 * [["0.6", "1", "2", "1"]]], (0, 1, 2, 3))
    assert not text_form._fits([["0.5", "1", "2", "7"], *2 * [["0.6", "1", "2", "1"]]], (0, 1, 2, 3))
    assert not text_form._fits([["a", "1", "2", "1"]], (0, 1, 2, 3)) and not text_form._fits([["1"]], (0, 1, 2, 3))
    # the last line may be cut off, unless it is the only one
    assert text_form._fits([["4", "1", "2", "1"], ["3", "1", "2", "1"]], (0, 1, 2, 3))
    assert text_form._fits([["4", "1", "2", "1"]], (0, 1, 2, 3))


def test_arrays_are_events_unless_they_are_a_frame(tmp_path):
    for name, is_events in (("raw", False), ("aps_raw", False), ("t", True)):
        np.savez(tmp_path / f"{name}.npz", **{name: np.zeros(3), "x": np.zeros(3)})
        assert is_event_file(tmp_path / f"{name}.npz") == is_events
