"""Identifiers have the words of the field: those below have a better one (`docs/glossary.md`)."""

import io
import re
import tokenize
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[2] / "hesim_render"
#: Words of everyday speech, and of what the literature calls diffuse, occluded or illuminated.
FORBIDDEN = re.compile(r"(?:^|_)(told|found|great|huge|closer|lit|unlit|hidden|matt)(?:_|$)")
#: Names that are not ours to choose, or that files have, and the packages that may use them; "" for all.
CAPTURES = ("calibrate/", "capture/", "cli/", "recording/", "report/", "twin/")
ALLOWED = {
    "found_events": ("recording/",),  # key of recording.json
    "hidden": ("cli/",),  # argument of typer: an option that only --help-all shows
    **dict.fromkeys(("PackageNotFoundError", "FileNotFoundError"), ("",)),  # of Python
    # captures with light: aps_lit.npz, and keys of sets of pairs
    **dict.fromkeys(
        ("is_lit", "lit_", "long_lit", "spatial_lit", "darkest_lit", "lit_freedom", "lit_exposures_us", "lit_ms",
         "lit_us", "LIT_EXPOSURES_US"),
        CAPTURES,
    ),
    # the same, and keys of Mitsuba scenes
    "lit": (*CAPTURES, "specs/mitsuba_scene", "sources/scene", "sources/render/scene/mitsuba_scene"),
    "unlit": ("specs/mitsuba_scene", "sources/scene", "sources/render/scene/mitsuba_scene"),
}  # fmt: skip


def parts(identifier):
    """``LastFound`` and ``last_found`` alike, in lower case."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", identifier).lower()


@pytest.mark.parametrize(("name", "is_forbidden"), [
    ("found", True), ("_found_pixels", True), ("LastFound", True), ("foundation", False), ("matte", False),
    ("split", False), ("told_once", True),
])  # fmt: skip
def test_a_word_is_a_whole_part_of_a_name(name, is_forbidden):
    assert bool(FORBIDDEN.search(parts(name))) == is_forbidden


def refused(words, place=""):
    """Those that a module must not use, by its path in the package."""
    return {word for word in words if FORBIDDEN.search(parts(word)) and not place.startswith(ALLOWED.get(word, ()))}


def test_a_word_of_files_or_tools_is_theirs_alone():
    assert refused({"hidden", "found_events", "is_lit"}, "sources/scene.py") == {"hidden", "found_events", "is_lit"}
    assert refused({"hidden", "found_events", "is_lit"}, "cli/calibrate.py") == {"found_events"}


def test_identifiers_have_the_words_of_the_field():
    wrong = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        text, place = path.read_text(encoding="utf-8"), path.relative_to(PACKAGE).as_posix()
        if not refused(set(re.findall(r"\w+", text)), place):
            continue  # not even in its comments
        tokens = tokenize.generate_tokens(io.StringIO(text).readline)
        if names := refused({token.string for token in tokens if token.type == tokenize.NAME}, place):
            wrong[place] = names
    assert not wrong
