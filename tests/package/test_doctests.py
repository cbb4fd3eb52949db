"""Every public name has an example that runs, and so has every other docstring with a prompt in it."""

import doctest
import importlib
import re
from pathlib import Path

import pytest

import hesim_render as hr

PACKAGE = Path(hr.__file__).parent
#: Modules with prompts in their docstrings.
WITH_EXAMPLES = sorted(
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")
    for path in PACKAGE.rglob("*.py")
    if ">>> " in path.read_text(encoding="utf-8")
)


@pytest.mark.parametrize("name", hr.__all__)
def test_every_public_name_has_an_example_that_uses_it(name):
    thing = getattr(hr, name)
    text = hr.__doc__ if isinstance(thing, str) else thing.__doc__
    code = "".join(example.source for example in doctest.DocTestParser().get_examples(text))
    assert re.search(rf"\bhr\.{name}\b", code) or (name in ("Scene", "Sensor") and f"hr.load_{name.lower()}(" in code)
    assert "doctest: +SKIP" not in code


@pytest.mark.parametrize("module", WITH_EXAMPLES)
def test_examples_run(module):
    found = doctest.testmod(importlib.import_module(module), optionflags=doctest.ELLIPSIS)
    assert found.attempted > 1 and found.failed == 0
