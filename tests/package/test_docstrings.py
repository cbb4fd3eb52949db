"""Every public name has a numpydoc docstring: parameters, results and errors, as CONTRIBUTING.md defines "public"."""

import ast
import importlib
import inspect
import re
import textwrap
from pathlib import Path

import pytest
from numpydoc.docscrape import NumpyDocString

import hesim_render as hr
from hesim_render.core import errors

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "hesim_render"
DOCS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def names_in_code():
    """Identifiers in the code of README and docs: in backticks and in code blocks."""
    found = set()
    for file in DOCS:
        text = file.read_text(encoding="utf-8")
        code = re.findall(r"```.*?```|`[^`\n]+`", text, re.DOTALL) + re.findall(r"^    \S.*$", text, re.MULTILINE)
        found.update(*(re.findall(r"[A-Za-z_]\w*", part) for part in code))
    return found


def public():
    """What a user calls: names of the top package, and names of other packages that README or docs use."""
    things, mentioned = {}, names_in_code()
    for file in sorted(PACKAGE.rglob("__init__.py")):
        package = importlib.import_module(".".join(file.parent.relative_to(ROOT).parts))
        for name in getattr(package, "__all__", ()):
            thing = getattr(package, name)
            if (package is hr or name in mentioned) and (inspect.isclass(thing) or inspect.isfunction(thing)):
                things[f"{thing.__module__}.{thing.__qualname__}"] = thing
    return things


def members(cls):
    """Public methods and properties that the classes of this package define, not those of pydantic and others."""
    for base in cls.__mro__:
        if base.__module__.startswith("hesim_render"):
            for name, member in vars(base).items():
                function = getattr(member, "__func__", None) or getattr(member, "fget", None)
                function = function or getattr(member, "func", member)
                if not name.startswith("_") and inspect.isfunction(function):
                    yield name, function, function is not member and not isinstance(member, classmethod | staticmethod)


CLASSES = {name: thing for name, thing in public().items() if inspect.isclass(thing)}
FUNCTIONS = {name: (thing, False) for name, thing in public().items() if inspect.isfunction(thing)} | {
    f"{owner}.{name}": (function, is_property)
    for owner, cls in CLASSES.items()
    for name, function, is_property in members(cls)
}


def parsed(thing):
    assert thing.__doc__, "no docstring"
    return NumpyDocString(inspect.cleandoc(thing.__doc__))


def listed(section):
    """Names of a section; ``a, b : text`` documents both."""
    return {name.strip(" *") for entry in section for name in (entry.name or entry.type).split(",")}


def arguments(thing):
    if inspect.isclass(thing) and issubclass(thing, Exception) and "__init__" not in vars(thing):
        return set()  # a message alone; Python does not know the signature
    return {name for name in inspect.signature(thing).parameters if name not in ("self", "cls")}


def raised(*functions):
    """Errors of ours that functions raise by name."""
    found = set()
    for function in functions:
        for node in ast.walk(ast.parse(textwrap.dedent(inspect.getsource(function)))):
            if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and isinstance(node.exc.func, ast.Name):
                kind = getattr(errors, node.exc.func.id, None)
                if inspect.isclass(kind) and issubclass(kind, errors.HesimError):
                    found.add(kind.__name__)
    return found


def test_the_public_names_are_found():
    """An empty list would pass every test below."""
    assert {"Recording", "Scene", "Sensor"} <= {name.rpartition(".")[2] for name in CLASSES}
    expected = {"simulate", "simulate_video", "load_scene", "photocurrent", "calibrate_aps", "render_cube", "demosaic"}
    assert expected | {"crop", "event_slice", "load"} <= {name.rpartition(".")[2] for name in FUNCTIONS}


@pytest.mark.parametrize("name", sorted(CLASSES))
def test_classes_document_their_arguments_and_errors(name):
    cls = CLASSES[name]
    text = parsed(cls)
    assert arguments(cls) <= listed(text["Parameters"])
    by_hand = "__post_init__" if hasattr(cls, "__dataclass_fields__") else "__init__"
    assert raised(*filter(inspect.isfunction, [vars(cls).get(by_hand)])) <= listed(text["Raises"])


@pytest.mark.parametrize("name", sorted(FUNCTIONS))
def test_functions_document_arguments_results_and_errors(name):
    """A property, or a method without arguments, may say in its first line what it returns."""
    function, is_property = FUNCTIONS[name]
    text = parsed(function)
    expected = arguments(function)
    assert expected <= listed(text["Parameters"]), sorted(expected - listed(text["Parameters"]))
    if expected and not is_property and inspect.signature(function).return_annotation not in (None, "None"):
        assert text["Returns"] or text["Yields"], "no Returns"
    missing = raised(function) - listed(text["Raises"])
    assert not missing, missing
