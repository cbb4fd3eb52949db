"""Names of files of others that become paths: one checked type, and what holds it."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hesim_render.core.names import file_name, path_below

BAD = ["", ".", "..", "../x", "a/b", "/etc", "/", "a\\b", "C:x", ".hidden", "a\0b", "a\nb", "\x1b[31m", "\ud800", " a",
       "a ", "a" * 181, "\u202eexe"]  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_a_name_that_leads_elsewhere_or_hides_or_moves_the_cursor_is_none(name):
    with pytest.raises(ValueError, match="is not the name of a file"):
        file_name(name)
    with pytest.raises(ValueError, match="is not the name of a file"):
        path_below(f"frames/{name}" if name != "a/b" else "a/b/")


@pytest.mark.parametrize("name", ["s000000-m0-l0-eiger-standard-r7", "c_aps_maps-0123456789ab.npz", "Bild 7 ö.png"])
def test_names_as_they_are_written_are_names(name):
    assert file_name(name) == name and path_below(f"truth/{name}") == f"truth/{name}"


@given(st.text(st.characters(), max_size=200))
def test_what_is_a_name_is_a_child_of_its_folder(tmp_path_factory, text):
    folder = tmp_path_factory.getbasetemp()
    try:
        found = folder / file_name(text)
    except ValueError:
        return
    assert found.resolve().parent == folder.resolve() and found.name == text
