"""Imports point down only, nothing imports itself in a circle, and one package alone knows Mitsuba."""

import ast
import json
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "hesim_render"

MAP = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
#: Lowest first; a module may import its own package and those before it.
ORDER = re.findall(r"^\| `([a-z_.]+)` \|", MAP, re.MULTILINE)
LEVEL = {name: level for level, name in enumerate(ORDER)}


def dotted(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


#: Modules; `__init__` files only hand on what their packages have.
MODULES = {dotted(path): path for path in sorted(PACKAGE.rglob("*.py")) if path.name != "__init__.py"}
PACKAGES = {dotted(path) for path in PACKAGE.rglob("__init__.py")}
EVERY = sorted(MODULES)


def package_of(name):
    return name.removeprefix("hesim_render").strip(".").rpartition(".")[0]


@cache
def tree_of(path):
    return ast.parse(path.read_text(encoding="utf-8"))


def statements(node):
    """All statements within a node but those under TYPE_CHECKING; expressions hold none."""
    for child in ast.iter_child_nodes(node):
        typing_only = isinstance(child, ast.If) and getattr(child.test, "id", "") == "TYPE_CHECKING"
        if isinstance(child, (ast.stmt, ast.excepthandler, ast.match_case)) and not typing_only:
            yield child
            yield from statements(child)


@cache
def imports(path):
    """Dotted names imported anywhere in a module but under TYPE_CHECKING; of packages, what is taken from them."""
    found = []
    for node in statements(tree_of(path)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found += [f"{node.module}.{alias.name}" for alias in node.names]
    return tuple(found)


def modules_imported(name):
    """Modules of ours; a package's own names are those of its `__init__`."""
    found = set()
    for full in imports(MODULES[name]):
        if full in MODULES:
            found.add(full)
        elif full.rpartition(".")[0] in MODULES:
            found.add(full.rpartition(".")[0])
        elif full.rpartition(".")[0] in PACKAGES and full.startswith("hesim_render."):
            found.add(full.rpartition(".")[0] + ".__init__")
    return found - {name}


def test_the_map_has_every_package_and_no_other():
    packages = {name.removeprefix("hesim_render.") for name in PACKAGES} - {"hesim_render"}
    empty = {name for name in packages if not any(package_of(module) == name for module in EVERY)}
    assert set(ORDER) == packages - empty and len(ORDER) == len(LEVEL)


def test_the_map_names_modules_that_exist():
    named = [name for name in re.findall(r"`((?:[a-z_]+/)+[a-z_]+\.py)`", MAP) if not name.startswith("tests/")]
    assert len(named) > 20
    paths = [path.relative_to(ROOT).as_posix() for path in PACKAGE.rglob("*.py")]
    for name in named:
        assert any(path == name or path.endswith(f"/{name}") for path in paths), name


def test_the_map_names_every_module_in_the_row_of_its_package():
    """A reader chooses from the whole list: no module is left out, named twice, or named without being there."""
    rows = dict(re.findall(r"^\| `([a-z_.]+)` \| (.+) \|$", MAP, re.MULTILINE))
    assert list(rows) == ORDER
    for package, text in rows.items():
        has = sorted(name.rpartition(".")[2] for name in EVERY if package_of(name) == package)
        assert sorted(re.findall(r"`([^`]+)`", text)) == has, package


def test_imports_point_down_only():
    """The face of the package is not judged."""
    assert not [
        f"{name} imports {other}, which is above it"
        for name in EVERY
        for other in (modules_imported(name) if package_of(name) else ())
        if package_of(other) and LEVEL[package_of(other)] > LEVEL[package_of(name)]
    ]


def test_no_modules_import_each_other_in_a_circle():
    waiting = {name: modules_imported(name) & set(MODULES) for name in EVERY}
    while waiting:
        free = [name for name, needed in waiting.items() if not needed & set(waiting)]
        assert free, f"in a circle, or above one: {sorted(waiting)}"
        for name in free:
            del waiting[name]


def importers_of(*packages):
    """Modules that import one of these packages or a part of it."""
    return [name for name in EVERY if any(f"{full}.".startswith(packages) for full in imports(MODULES[name]))]


def test_only_the_renderer_imports_mitsuba():
    users = importers_of("mitsuba.")
    assert users and all(package_of(name).startswith("sources.render") for name in users), users


def test_no_module_picks_a_drjit_backend_itself():
    """`backend.jit` probes the library first; importing drjit.llvm directly may abort the process."""
    assert importers_of("drjit.") and not importers_of("drjit.llvm", "drjit.cuda")


def test_importing_the_package_loads_nothing_heavy():
    """Dr.Jit above all: it takes an LLVM when it is imported, and the choice must come first."""
    heavy = ("drjit", "mitsuba", "numpy", "scipy", "colour", "pydantic", "rich", "matplotlib")
    code = f"import sys, hesim_render; print([name for name in {heavy} if name in sys.modules])"
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert child.stdout.strip() == "[]"


def test_calibration_reads_formulas_of_the_pixels_alone():
    """It must run on captures of real sensors, on any machine, and not load samplers.

    `test_formulas.py` fits captures in a process where Dr.Jit and Mitsuba cannot be imported.
    """
    for name in EVERY:
        if package_of(name).split(".")[0] == "calibrate":
            used = {package_of(other).split(".")[0] for other in modules_imported(name)}
            assert not used & {"sources", "capture", "sensor", "isp"}, name
            pixels = {other for other in modules_imported(name) if package_of(other).split(".")[0] == "pixels"}
            assert all(other.endswith(".formulas") for other in pixels), name


def test_a_class_has_a_name_of_its_own():
    """Two things of one name cannot be distinguished in a search, a traceback or a sentence."""
    homes = {}
    for name, path in MODULES.items():
        for node in tree_of(path).body:
            if isinstance(node, ast.ClassDef):
                homes.setdefault(node.name, []).append(name)
    assert not {name: found for name, found in homes.items() if len(found) > 1}


@pytest.mark.parametrize("kind", ("aps", "evs"))
def test_formulas_draw_nothing_and_need_no_device(kind):
    """They stand on the array namespace alone: no generator, no backend, no sampler."""
    used = modules_imported(f"hesim_render.pixels.{kind}.formulas")
    assert used == {"hesim_render.core.device_types"}


#: What keeps the state of any object, and loop states that hold values of several kinds.
OF_ANY_KIND = {"saved", "restore", "_off_device", "_on_device"}


def test_values_on_the_device_have_named_types():
    """`Any` tells a reader nothing; `core/device_types.py` has a name for each kind of array."""
    places = ("pixels", "sensor", "sources.render.transport", "sources.render.sampling")
    names = [name for name in EVERY if f"{package_of(name)}.".startswith(tuple(f"{place}." for place in places))]
    assert len(names) > 30
    for name in names:
        for node in ast.walk(tree_of(MODULES[name])):
            if isinstance(node, ast.FunctionDef) and node.name not in OF_ANY_KIND:
                given = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                for annotation in [node.returns, *(argument.annotation for argument in given)]:
                    is_any = isinstance(annotation, ast.Name) and annotation.id == "Any"
                    assert not is_any, f"{name}: {node.name}, {node.lineno}"


def test_hooks_need_nothing_but_the_checkouts_own_environment():
    from ruamel.yaml import YAML

    for repository in YAML(typ="safe").load(ROOT / ".pre-commit-config.yaml")["repos"]:
        assert repository["repo"] == "local"
        for hook in repository["hooks"]:
            assert hook["language"] == "system" and hook["entry"].startswith(".venv/bin/")


def test_the_content_of_a_recording_does_not_know_its_pictures():
    """Pictures, pages and exports are functions over a recording; its content imports none of them."""
    reached, waiting = set(), ["hesim_render.recording.recorded"]
    while waiting:
        name = waiting.pop()
        if name in MODULES and name not in reached:
            reached.add(name)
            waiting += modules_imported(name)
    assert "hesim_render.recording.frame" in reached
    drawn = {"preview", "showcase", "page", "plots", "movie", "exports"}
    assert not reached & {f"hesim_render.recording.{name}" for name in drawn}


#: Modules that import by a name that is computed: the names of the package's face, and the backend that was chosen.
BY_NAME = {"hesim_render/__init__.py", "hesim_render/core/backend.py"}


def test_no_import_hides_behind_a_text():
    for path in PACKAGE.rglob("*.py"):
        if path.relative_to(ROOT).as_posix() not in BY_NAME:
            text = path.read_text(encoding="utf-8")
            assert "import_module" not in text and "__import__" not in text, path


#: Runs the command line when it is imported.
PROGRAM = "hesim_render.cli.__main__"
#: Imports every module, and tells which module has asked for which while it was loaded.
RUN = """
import builtins, json, sys
asked, plain = set(), builtins.__import__

def noted(name, globals=None, locals=None, fromlist=(), level=0):
    found = plain(name, globals, locals, fromlist, level)
    if globals is not None and name.startswith("hesim_render"):
        here = globals.get("__name__", "")
        asked.update((here, other) for other in (name, *(f"{name}.{one}" for one in fromlist or ())))
    return found

builtins.__import__ = noted
for name in json.loads(sys.argv[1]):
    plain(name)
print(json.dumps([sorted(asked), [name for name in ("drjit", "mitsuba") if name in sys.modules]]))
"""


@pytest.mark.slow
def test_imports_point_down_when_they_run():
    """What the text of a module says, seen while every module is loaded: hooks and helpers cannot hide an arrow.

    Dr.Jit looks for GPUs when it is loaded: a worker of a benchmark chooses its own before, and a data loader forks.
    """
    child = subprocess.run(
        [sys.executable, "-c", RUN, json.dumps([name for name in EVERY if name != PROGRAM])],
        capture_output=True,
        text=True,
        check=True,
    )
    asked, heavy = json.loads(child.stdout)
    asked = [(here, other) for here, other in asked if here in MODULES]
    assert heavy == []
    assert len(asked) > 1000
    for here, other in asked:
        if other in MODULES and package_of(here) and package_of(other):
            assert LEVEL[package_of(other)] <= LEVEL[package_of(here)], f"{here} asks for {other}, which is above it"
            assert other in modules_imported(here) | {here}, f"{here} asks for {other}, which its text does not say"


def test_the_capture_knows_the_types_of_what_it_handles():
    for name in EVERY:
        if package_of(name) == "capture":
            used = {node.id for node in ast.walk(tree_of(MODULES[name]))
                    if isinstance(node, ast.Name)}  # fmt: skip
            assert not used & {"getattr", "isinstance", "Any"}, name


def test_a_module_has_a_size_that_one_reads():
    sizes = {name: len(path.read_text(encoding="utf-8").splitlines()) for name, path in MODULES.items()}
    assert {name: size for name, size in sizes.items() if size > 350} == {} and len(sizes) > 400


#: What replaces files, reads or runs what a file names, leaves noise out, or changes the output of a command.
ASKED_FOR = {
    "overwrite", "allow_outside", "run_programs", "clean", "exact", "live", "yes", "dry_run", "quiet", "json_",
    "help_all",
}  # fmt: skip


def test_nothing_is_replaced_run_or_left_out_until_it_is_asked_for():
    """Every function of the package that has such a parameter with a default has False."""
    found = dict.fromkeys(ASKED_FOR, 0)
    for name, path in MODULES.items():
        for node in ast.walk(tree_of(path)):
            if not isinstance(node, ast.FunctionDef):
                continue
            plain = [*node.args.posonlyargs, *node.args.args]
            pairs = [*zip(reversed(plain), reversed(node.args.defaults), strict=False)]
            pairs += zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True)
            for argument, default in pairs:
                if argument.arg in ASKED_FOR and default is not None:
                    found[argument.arg] += 1
                    assert isinstance(default, ast.Constant) and default.value is False, f"{name}.{node.name}"
    assert min(found.values()) >= 2 and found["overwrite"] > 40
