"""Works are cited by keys of one bibliography, `docs/references.bib`: every key stands there, every entry is cited."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
BIBLIOGRAPHY = (ROOT / "docs" / "references.bib").read_text(encoding="utf-8")
ENTRIES = dict(re.findall(r"^@\w+\{(\w+),\n(.*?)^\}", BIBLIOGRAPHY, re.MULTILINE | re.DOTALL))
#: One or more keys in brackets: [kirk1991], [lichtsteiner2008, graca2021].
CITED = re.compile(r"\[([a-z]+(?:1[789]|20)\d\d[a-z]?(?:, [a-z]+(?:1[789]|20)\d\d[a-z]?)*)(?:[,;][^\]]*)?\]")


def cited():
    """Each key with the files that cite it."""
    found = {}
    files = [ROOT / "README.md", ROOT / "CHANGELOG.md", *ROOT.glob("docs/**/*.md"), *ROOT.glob("benchmarks/*.py")]
    for path in files + list(ROOT.glob("hesim_render/**/*.py")):
        for keys in CITED.findall(path.read_text(encoding="utf-8")):
            for key in keys.split(", "):
                found.setdefault(key, set()).add(path.relative_to(ROOT).as_posix())
    return found


def test_every_cited_key_is_in_the_bibliography():
    missing = {key: files for key, files in cited().items() if key not in ENTRIES}
    assert not missing


def test_every_entry_is_cited_and_whole():
    assert set(ENTRIES) == set(re.findall(r"^@\w+\{(\w+)", BIBLIOGRAPHY, re.MULTILINE)) and len(ENTRIES) > 30
    assert not set(ENTRIES) - set(cited())
    for key, entry in ENTRIES.items():
        year = re.search(r"\byear = \{(\d{4})\}", entry)
        assert year and year.group(1) in key, key
        assert re.search(r"\bauthor = \{", entry) and re.search(r"\btitle = \{", entry), key


def test_no_paper_is_cited_outside_the_bibliography():
    """A name and a year in brackets or quotes beside them would be a work without a key."""
    names = r"\((?:[A-Z][\wäöüç-]+(?:,? (?:and|&) |, | et al\. ))+[^()]{0,40}"
    pattern = re.compile(names + r"\b(?:1[789]|20)\d\d\b[^()]*\)|et al\. (?:1|2)\d{3}")
    for path in [*ROOT.glob("docs/**/*.md"), *ROOT.glob("hesim_render/**/*.py"), ROOT / "README.md"]:
        found = pattern.findall(path.read_text(encoding="utf-8"))
        assert not found, f"{path.relative_to(ROOT)}: {found}"
