"""What the pages say is so: commands exist and run, files of examples are valid, named tests and scripts exist."""

import functools
import re
import runpy
import shlex
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest
import run_page
from ruamel.yaml import YAML
from source_trees import source_tree

import hesim_render as hr
from hesim_render.cli.commands import program
from tests import claim

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
#: Pages whose blocks are run as they stand.
RUN = [ROOT / "docs" / "tutorial.md", *sorted((ROOT / "docs" / "how-to").glob("*.md"))]
RUN.remove(ROOT / "docs" / "how-to" / "README.md")


def name_of(page):
    return page.relative_to(ROOT).as_posix()


def commands_of(text):
    """Each command line of hesim-render in a bash block, without what the shell adds."""
    joined = text.replace("\\\n", " ")
    for line in re.findall(r"(?:^|[;&|] *|do |bin/)hesim-render +([^\n;&>]*)", joined, re.MULTILINE):
        yield shlex.split(re.sub(r"\$\{?\w+\}?", "1", line), comments=True)


def parsed(words):
    """Parse a command line as the program does, without running it: the command's name."""
    command, context = program(), None
    while hasattr(command, "commands") and words and words[0] in command.commands:
        context = command.context_class(command, parent=context, info_name="hesim-render")
        command, words = command.commands[words[0]], words[1:]
    try:
        command.make_context("hesim-render", list(words), parent=context)
    except Exception as error:
        if "does not exist" not in str(error):  # files of the examples exist only when they run
            raise
    return command.name


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_and_options_exist(page):
    for block in run_page.blocks_of(page):
        if block.kind == "bash":
            for words in commands_of(block.text):
                if words and words[0] not in ("--help", "--version", "COMMAND"):
                    assert parsed(words), words


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_tables_are_whole(page):
    """Every block of rows has its head: an empty line inside of a table ends it, and the rest is shown as text."""
    text = re.sub(r"(?ms)^```.*?^```", "", page.read_text(encoding="utf-8"))
    for block in re.split(r"\n(?!\|)", text):
        rows = [row for row in block.splitlines() if row.startswith("|")]
        assert not rows or (len(rows) > 1 and re.fullmatch(r"\|(\s*:?-+:?\s*\|)+", rows[1])), rows[0]


def test_the_commands_are_found_and_a_wrong_one_is_told():
    lines = "for x in a; do hesim-render info scenes; done\n.venv/bin/hesim-render demo --out demo\n"
    lines += "hesim-render isp a \\\n  --x"
    assert [words[0] for words in commands_of(lines)] == ["info", "demo", "isp"]
    with pytest.raises(Exception, match="wrong"):
        parsed(["simulate", "dark", "--sensor", "gen2", "--out", "o", "--wrong"])
    found = [
        words for page in PAGES for b in run_page.blocks_of(page) if b.kind == "bash" for words in commands_of(b.text)
    ]
    assert len(found) > 80 and {"simulate", "benchmark", "calibrate"} <= {words[0] for words in found}


@pytest.mark.parametrize("page", RUN, ids=name_of)
def test_files_of_a_page_are_valid(page, tmp_path):
    """Sensors, scenes and Python of the pages that are run; nothing is rendered."""
    blocks = run_page.blocks_of(page)
    for block in blocks:
        if block.title:
            (tmp_path / block.title).write_text(block.text)
        if block.kind == "bash":
            subprocess.run(["bash", "-n"], input=block.text, text=True, check=True)
        if block.kind == "python":
            compile(block.text, f"{page.name}, line {block.line}", "exec")
        if "pyramid.obj" in block.text and block.kind == "python":
            exec(block.text.replace('Path("', f'Path("{tmp_path}/'), {})
    for block in blocks:
        if block.kind == "yaml" and block.title:
            content = YAML(typ="safe").load(block.text)
            if "tile" in content:  # a calibration of the page exists only when it runs
                text = re.sub(r"^noise: .*\n", "", block.text, flags=re.MULTILINE)
                (tmp_path / block.title).write_text(text)
                hr.load_sensor(tmp_path / block.title)
            elif "camera" in content or "mitsuba" in content:
                hr.load_scene(tmp_path / block.title)


def test_the_site_does_not_cut_options_and_short_names():
    """At their hyphens, where browsers do; what is copied from a block stays the same."""
    pytest.importorskip("mkdocs")
    hooks = runpy.run_path(str(ROOT / "docs" / "hooks.py"))
    page = "<p><code>--roi</code> <code>view RECORDING --no-viewer</code></p>"
    page += "<td><code>python benchmarks/long_recording.py speed</code></td>"
    page += "<code>tests/package/a_test_of_many_words.py</code>"
    page += '<div class="language-bash highlight"><code>a<span class="w"> </span>--out<span class="w"> </span>b</div>'
    shown = hooks["on_page_content"](page)
    assert "<code class=whole>--roi</code>" in shown and " <span class=whole>--no-viewer</span></code>" in shown
    assert "<code>python <span class=whole>benchmarks/long_recording.py</span> speed<" in shown
    assert "<code>tests/package/a_test_of_many_words.py<" in shown
    assert "</span><span class=whole>--out</span><span" in shown and "<span class=whole>b<" not in shown
    assert hooks["plain_text"](shown) == hooks["plain_text"](page)
    symbols = hooks["INDEXED"].sub(r"\1<sub>\2</sub>", "Φ\u0302_a f_c, but a/b_c and name_of")
    assert symbols == "Φ\u0302<sub>a</sub> f<sub>c</sub>, but a/b_c and name_of"


def test_no_link_is_named_after_its_file():
    """The text of a link says what is behind it."""
    named = re.compile(r"\[[\w/-]+\.md\]\(")
    assert [name_of(page) for page in PAGES if named.search(page.read_text(encoding="utf-8"))] == []


def test_blocks_that_are_not_run_say_why():
    reasons = {block.reason for page in RUN for block in run_page.blocks_of(page) if block.reason}
    assert reasons == {"needs Blender", "needs SLURM", "needs an NVIDIA GPU", "ends with status 3"}


def test_a_page_that_fails_is_told(tmp_path):
    page = tmp_path / "page.md"
    page.write_text('```yaml title="a.yaml"\nx: 1\n```\n\n```bash\ngrep -q 1 a.yaml\n```\n\n```text\nfalse\n```\n')
    run_page.run(page, tmp_path / "out", installed=True)
    page.write_text(page.read_text() + "\n```python\nassert open('a.yaml').read() == ''\n```\n")
    with pytest.raises(subprocess.CalledProcessError):
        run_page.run(page, tmp_path / "out", installed=True)


@pytest.mark.slow
@pytest.mark.parametrize("page", RUN, ids=name_of)
def test_a_page_runs_as_it_stands(page, tmp_path):
    run_page.run(page, tmp_path, installed=True)


@pytest.mark.slow
def test_the_tutorial_begins_in_a_fresh_clone(tmp_path):
    """With its installation, and nothing of this environment but Python and pip's settings."""
    run_page.run(ROOT / "docs" / "tutorial.md", source_tree(tmp_path))


NAMED_TEST = re.compile(r"\b(tests/[\w/]+\.py)(?:::(\w+))?")
NAMED_SCRIPT = re.compile(r"\b((?:benchmarks|examples)/\w+\.py)\b")


@functools.cache
def names_of_tests(file):
    return set(re.findall(r"^def (test_\w+)\(", (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE))


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CHANGELOG.md", ROOT / "CONTRIBUTING.md"], ids=name_of)
def test_named_tests_and_scripts_exist(page):
    text = page.read_text(encoding="utf-8")
    for file, test in NAMED_TEST.findall(text):
        assert (ROOT / file).is_file(), file
        assert not test or test in names_of_tests(file), f"{file}::{test}"
    for script in NAMED_SCRIPT.findall(text):
        assert (ROOT / script).is_file(), script


def test_every_equation_of_the_theory_names_its_tests():
    text = (ROOT / "docs" / "physics.md").read_text(encoding="utf-8")
    parts = re.split(r"^```math\n.*?^```$", text, flags=re.MULTILINE | re.DOTALL)
    assert len(parts) > 18
    for before, after in zip(parts, parts[1:], strict=False):
        checked = re.search(r"^\*Checked by\* (.*)$", after, re.MULTILINE)
        assert checked and "::test_" in checked.group(1), before[-200:]


def test_every_claim_has_an_oracle_a_figure_and_a_command():
    text = (ROOT / "docs" / "validation.md").read_text(encoding="utf-8")
    rows = [
        [cell.strip() for cell in line.strip("|").split(" | ")] for line in text.splitlines() if line.startswith("| ")
    ]
    assert rows[0][0] == "Source"  # the page begins with real data, whose rows say what was fitted as well
    rows = [row for row in rows if row[0] and row[0] not in ("Claim", "Source")]
    assert len(rows) > 35
    for row in rows:
        assert len(row) in (4, 5) and all(row), row
        command, _, fold = row[-1].partition("<details><summary>tests</summary>")
        assert command.startswith(("`python ", "`hesim-render ")) and not NAMED_TEST.search(command), row
        assert bool(NAMED_TEST.search(fold)) == ("tests.claim" in command), row
    named = claim.claims()
    assert len(named) > 70 and all(tests for _, tests in named.values())
    assert named["grey-card"] == (
        "a grey card can be checked by hand",
        ["tests/capture/test_simulation.py::test_grey_card_electrons_by_hand"],
    )


def test_the_tests_of_a_claim_are_run_with_the_slow_ones(monkeypatch, capsys):
    asked = []
    monkeypatch.setattr(
        claim.subprocess, "run", lambda command, cwd: asked.append(command) or SimpleNamespace(returncode=5)
    )
    assert claim.main(["flow", "grey-card"]) == 5
    (command,) = asked
    assert command[1:3] == ["-m", "pytest"] and "slow or not slow" in command
    assert [part.rpartition("::")[2] for part in command[-2:]] == [
        "test_flow_equals_differences_of_projected_points",
        "test_grey_card_electrons_by_hand",
    ]
    assert claim.main([]) == 0 and claim.main(["crop", "wolf"]) == 2 and len(asked) == 1
    assert "crop" in capsys.readouterr().out


def test_the_readme_is_short_and_begins_with_two_commands_and_a_picture():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) < 130
    first, second = (block.text.strip() for block in run_page.blocks_of(ROOT / "README.md")[:2])
    assert (
        first == "python3 -m venv .venv && .venv/bin/pip install -q '.[llvm]' && .venv/bin/hesim-render demo --out demo"
    )
    assert second.endswith(".venv/bin/python -m pytest -q -n 3")
    assert text.index(second) < text.index("![") < text.index("\n## ") and text.count("![") == 1
    for linked in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text):
        assert (ROOT / linked).exists(), linked


def test_the_api_pages_have_every_public_name():
    shown = set(
        re.findall(r"^::: ([\w.]+)$", "\n".join(p.read_text() for p in (ROOT / "docs" / "api").glob("*.md")), re.M)
    )
    assert {f"hesim_render.{name}" for name in hr.__all__} - {
        "hesim_render.__version__",
        "hesim_render.events",
    } <= shown
    assert {f"hesim_render.events.{name}" for name in hr.events.__all__} - {"hesim_render.events.EVENT_DTYPE"} <= shown


@pytest.mark.slow
@pytest.mark.parametrize("notebook", sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")), ids=lambda path: path.stem)
def test_a_notebook_runs_and_is_stored_with_its_results(notebook, tmp_path):
    import nbclient
    import nbformat

    book = nbformat.read(notebook, 4)
    code = [cell for cell in book.cells if cell.cell_type == "code"]
    assert all(cell.execution_count for cell in code) and any(cell.outputs for cell in code)
    resources = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(book, timeout=900, kernel_name="python3", resources=resources).execute()
