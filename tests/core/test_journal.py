"""The journal of an interrupted run: what it keeps, what it refuses, and what damage does to it."""

import numpy as np
import pytest

from hesim_render.core.errors import OutputError, SpecError
from hesim_render.core.journal import Journal, key_of

RUN = {"seed": 3, "scene": {"name": "a", "sha256": "0"}}
FIRST, SECOND = key_of("a", np.arange(3)), key_of("a", np.arange(3.0))


def interrupted(target, run=RUN):
    """A journal of two results, whose run was ended by Ctrl-C."""
    with pytest.raises(KeyboardInterrupt), Journal(target, run) as journal:
        journal.keep(FIRST, [np.arange(5, dtype=np.float32), np.ones(3, np.bool_)])
        journal.keep(SECOND, [np.arange(2.0)])
        raise KeyboardInterrupt
    return journal.path


def first_of(journal):
    values, marks = np.zeros(5, np.float32), np.zeros(3, np.bool_)
    return (values, marks) if journal.recall(FIRST, [values, marks]) else None


def test_results_outlive_an_interrupt_and_not_a_success(tmp_path):
    path = interrupted(tmp_path / "out")
    assert path.name == ".out.unfinished" and path.is_file()
    with Journal(tmp_path / "out", RUN) as journal:
        assert journal.count == 2
        values, marks = first_of(journal)
        np.testing.assert_array_equal(values, np.arange(5))
        assert marks.all()
        assert not journal.recall(key_of("b"), [np.zeros(5)])
        third = np.arange(4.0)
        journal.keep(key_of("c"), [third])
        assert journal.recall(key_of("a", np.arange(3.0)), [np.zeros(2)])
    assert list(tmp_path.iterdir()) == []


def test_a_second_interrupt_adds_to_the_first(tmp_path):
    interrupted(tmp_path / "out")
    with pytest.raises(KeyboardInterrupt), Journal(tmp_path / "out", RUN) as journal:
        journal.keep(key_of("c"), [np.arange(4.0)])
        raise KeyboardInterrupt
    with Journal(tmp_path / "out", RUN) as journal:
        found = np.zeros(4)
        assert journal.count == 3 and journal.recall(key_of("c"), [found]) and found[3] == 3


def test_keys_tell_types_shapes_and_places_apart():
    some = [np.arange(4), np.arange(4, dtype=np.int32), np.arange(4).reshape(2, 2), np.arange(5), "x", None, 1, 1.0]
    keys = [key_of(each) for each in some]
    keys += [key_of("x", "y"), key_of("xy"), key_of(np.arange(2), np.arange(2)), key_of(np.array([0, 1, 0, 1]))]
    assert len(set(keys)) == len(keys)
    assert key_of(np.arange(8)[::2]) == key_of(np.array([0, 2, 4, 6]))


@pytest.mark.parametrize("cut", range(1, 70, 4))
def test_a_file_cut_anywhere_keeps_its_whole_entries(cut, tmp_path):
    path = interrupted(tmp_path / "out")
    data = path.read_bytes()
    path.write_bytes(data[:-cut])
    entry = 28 + 16  # the second one; before it lies the first one of 28 + 23 bytes
    with Journal(tmp_path / "out", RUN) as journal:
        assert journal.count == (1 if cut <= entry else 0)
        assert (first_of(journal) is not None) == (cut <= entry)
        journal.keep(SECOND, [np.arange(2.0)])
        found = np.zeros(2)
        assert journal.recall(SECOND, [found]) and found[1] == 1


def test_a_damaged_entry_is_calculated_again(tmp_path):
    path = interrupted(tmp_path / "out")
    data = bytearray(path.read_bytes())
    data[data.index(b"\n") + 1 + 28 + 2] ^= 1
    path.write_bytes(data)
    with Journal(tmp_path / "out", RUN) as journal:
        assert first_of(journal) is None
        journal.keep(FIRST, [np.arange(5, dtype=np.float32), np.ones(3, np.bool_)])
        assert first_of(journal) is not None


def test_another_run_is_refused_by_what_differs_or_begun_anew(tmp_path):
    path = interrupted(tmp_path / "out")
    before = path.read_bytes()
    other = {"seed": 4, "scene": {"name": "b", "sha256": "1"}}
    with pytest.raises(OutputError, match=r"differs in seed, scene; .*--overwrite"):
        Journal(tmp_path / "out", other)
    assert path.read_bytes() == before
    with Journal(tmp_path / "out", other, overwrite=True) as journal:
        assert journal.count == 0
    assert not path.exists()
    path.write_bytes(b"something else")  # not a journal: nothing to go on from
    with Journal(tmp_path / "out", RUN) as journal:
        assert journal.count == 0


def test_two_runs_at_a_time_do_not_share_a_journal(tmp_path):
    interrupted(tmp_path / "out")
    with Journal(tmp_path / "out", RUN), pytest.raises(OutputError, match="another run is writing"):
        Journal(tmp_path / "out", RUN)


def test_mistakes_leave_no_journal_and_full_disks_do(tmp_path):
    for error, stays in ((SpecError("wrong"), False), (OutputError("full"), True), (MemoryError(), True)):
        with pytest.raises(type(error)), Journal(tmp_path / "out", RUN) as journal:
            journal.keep(FIRST, [np.arange(5.0)])
            raise error
        assert journal.path.is_file() == stays
        journal.path.unlink(missing_ok=True)


def test_long_names_have_a_journal(tmp_path):
    path = interrupted(tmp_path / ("x" * 250))
    assert path.is_file() and len(path.name) < 120


def test_a_result_of_another_size_is_not_recalled_and_forgotten(tmp_path):
    interrupted(tmp_path / "out")
    with Journal(tmp_path / "out", RUN) as journal:
        values = np.full(3, 7.0)
        assert not journal.recall(SECOND, [values]) and values.tolist() == [7, 7, 7]
        assert not journal.recall(SECOND, [np.zeros(2)])
        parts = np.zeros(2, np.float32), np.zeros(3, np.float32), np.zeros(3, np.bool_)
        assert journal.recall(FIRST, parts)
        assert parts[0].tolist() == [0, 1] and parts[1].tolist() == [2, 3, 4] and parts[2].all()
