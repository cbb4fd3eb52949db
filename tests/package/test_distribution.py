"""What is given away is whole: wheel and source archive, citation, the container's steps, installation by uv."""

import importlib.metadata
import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from ruamel.yaml import YAML
from source_trees import source_tree

from hesim_render.core.shipped import FOLDERS, list_names

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
INSTALLED = {found.metadata["Name"] for found in importlib.metadata.distributions()}
#: Steps of the Dockerfile that need root.
NEEDS_ROOT = ("useradd",)


def outside():
    """The environment without what points to this tree."""
    return {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "VIRTUAL_ENV")}


def test_one_version_stands_everywhere():
    citation = YAML(typ="safe").load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == PROJECT["version"] and citation["license"] == PROJECT["license"]
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    headings = re.findall(r"^## \[([\d.]+)\]", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert headings[0] == PROJECT["version"] and len(headings) == len(set(headings))


def test_every_package_of_a_run_has_an_upper_bound():
    """Another release may change bytes; the viewer and PyTorch only read what is there."""
    extras = PROJECT["optional-dependencies"]
    for name in ("view", "torch", "docs", "test", "dev"):
        assert name in extras
    of_a_run = [*PROJECT["dependencies"], *(package for name, packages in extras.items() for package in packages
                                            if name not in ("view", "torch", "docs", "test", "dev"))]  # fmt: skip
    assert len(of_a_run) > 25
    for package in map(Requirement, of_a_run):
        assert any(part.operator in ("<", "==", "~=") for part in package.specifier), package.name
        installed = importlib.metadata.version(package.name) if package.name in INSTALLED else None
        assert installed is None or package.specifier.contains(installed), (package.name, installed)


def test_the_container_has_extras_that_exist_and_runs_the_program():
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    extras = set(re.search(r"'\.\[([\w,]+)\]'", text).group(1).split(","))
    assert "llvm" in extras and extras <= set(PROJECT["optional-dependencies"])
    assert 'ENTRYPOINT ["/opt/hesim/bin/hesim-render"]' in text
    assert re.search(r"^FROM python:3\.1[123]-slim", text, re.MULTILINE)


@pytest.mark.slow
def test_wheel_and_source_archive_are_whole_and_pass_twine(tmp_path):
    tree, out = source_tree(tmp_path / "tree"), tmp_path / "dist"
    subprocess.run([sys.executable, "-m", "build", "--outdir", str(out), str(tree)], check=True, env=outside())
    wheel, archive = next(out.glob("*.whl")), next(out.glob("*.tar.gz"))
    subprocess.run([sys.executable, "-m", "twine", "check", "--strict", str(wheel), str(archive)], check=True)
    names = set(zipfile.ZipFile(wheel).namelist())
    shipped = {path.relative_to(ROOT) for folder in FOLDERS.values() for path in (ROOT / folder).glob("*.yaml")}
    assert {name for name in names if name.endswith(".yaml")} == {f"hesim_render/shipped/{path}" for path in shipped}
    data = {
        path.relative_to(ROOT).as_posix()
        for kind in ("html", "css", "npz")
        for path in (ROOT / "hesim_render").rglob(f"*.{kind}")
    }
    assert len(data) > 10 and data <= names
    assert "hesim_render/py.typed" in names and not [name for name in names if name.startswith("tests/")]
    zipfile.ZipFile(wheel).extractall(tmp_path / "installed")
    code = (
        "from hesim_render.core.shipped import FOLDERS, list_names; print({kind: list_names(kind) for kind in FOLDERS})"
    )
    environment = outside() | {"PYTHONPATH": str(tmp_path / "installed")}
    told = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert told.stdout.strip() == str({kind: list_names(kind) for kind in FOLDERS}), told.stderr
    with tarfile.open(archive) as whole:
        within = {name.partition("/")[2] for name in whole.getnames()}
    assert set(map(str, shipped)) <= within
    assert {"mkdocs.yml", "CITATION.cff", "Dockerfile", "docs/hooks.py", "tests/package/test_pages.py"} <= within


@pytest.mark.slow
def test_the_steps_of_the_dockerfile_in_a_fresh_environment(tmp_path):
    """RUN, WORKDIR, ENTRYPOINT and CMD with the folders of the image under `tmp_path`; not the image's system."""
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    source_tree(tmp_path / "src")
    steps = [step for step in re.findall(r"^RUN (.*)$", text, re.MULTILINE) if not step.startswith(NEEDS_ROOT)]
    assert len(steps) == 3
    python = Path(sys.executable).resolve()
    environment = outside() | {"PATH": f"{tmp_path}/bin:{os.environ['PATH']}"}
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "python").symlink_to(python)
    for step in steps:
        step = step.replace("/opt/", f"{tmp_path}/opt/")
        subprocess.run(["bash", "-ec", step], cwd=tmp_path / "src", env=environment, check=True)
    program = str(tmp_path) + re.search(r'ENTRYPOINT \["([^"]+)', text).group(1)
    command = re.search(r'CMD \["([^"]+)"\]', text).group(1)
    done = subprocess.run([program, command], cwd=tmp_path, env=environment, check=True, capture_output=True, text=True)
    assert "simulate" in done.stdout
    scene = ["simulate", "dark", "--sensor", "reference-mono", "--roi", "8x8", "--duration", "0.002", "--out", "o"]
    subprocess.run([program, *scene], cwd=tmp_path, env=environment, check=True)
    assert (tmp_path / "o" / "recording.json").is_file()


@pytest.mark.slow
def test_the_uv_commands_of_the_page(tmp_path):
    text = (ROOT / "docs" / "install.md").read_text(encoding="utf-8")
    block = re.search(r"## uv\n\n```bash\n(.*?)```", text, re.DOTALL).group(1)
    environment = outside() | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    block = block.replace("uv venv", f"uv venv --python {Path(sys.executable).resolve()}")
    subprocess.run(["bash", "-euc", block], cwd=source_tree(tmp_path), env=environment, check=True)
