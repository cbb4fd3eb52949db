"""Advice to install something names what exists: packages of an index, not this package before its release."""

import re
import tomllib
from pathlib import Path

from hesim_render.core import errors

ROOT = Path(__file__).resolve().parents[2]


def test_an_extra_is_advised_by_the_names_of_its_packages(monkeypatch):
    lines = ["numpy>=2.1", "mcap >=1.2 ; extra == 'ros'", 'trimesh>=4.5; extra == "meshes"',
             "networkx (>=3) ; extra == 'meshes'",
             "colour-science[plotting]>=0.4; python_version < '4' and extra == 'ros-more'"]  # fmt: skip
    monkeypatch.setattr(errors, "requires", lambda name: lines)
    assert errors.how_to_install("meshes") == "pip install 'trimesh>=4.5' 'networkx>=3'"
    assert errors.how_to_install("ros") == "pip install 'mcap>=1.2'"
    assert errors.how_to_install("ros-more") == "pip install 'colour-science[plotting]>=0.4'"
    monkeypatch.setattr(errors, "requires", lambda name: None)
    assert errors.how_to_install("ros") == "pip install '.[ros]'"


def test_no_advice_names_a_release_that_does_not_exist():
    files = [*(ROOT / "hesim_render").rglob("*.py"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "examples").glob("*.py")]
    assert len(files) > 300
    advice = [
        file.name for file in files if re.search(r"pip install.*hesim_render\[", file.read_text(encoding="utf-8"))
    ]
    assert advice == []
    known = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    asked = {
        name for file in files for name in re.findall(r"how_to_install\('(\w+)'\)", file.read_text(encoding="utf-8"))
    }
    assert len(asked) > 8 and asked <= set(known)
