"""Modules in the folder where a program is started never run in its child processes.

The attempts are real: every name that a child imports lies there, and leaves a mark when it is run.
"""

import os
import re
import sys
from pathlib import Path

import foreign_folder
import pytest

import hesim_render
from benchmarks import generated
from hesim_render.benchmark.local import LocalWorkers
from hesim_render.benchmark.plan import BenchmarkPlan
from hesim_render.benchmark.worker import order_of
from hesim_render.core import backend, child
from hesim_render.core.errors import OutputError

_STARTS = r"subprocess\.(?:run|Popen|call|check_\w+)|sys\.executable|multiprocessing|os\.(?:exec|spawn|system|popen)\w*"


@pytest.fixture
def working_folder(tmp_path, monkeypatch):
    """A working folder of a stranger, with paths of PYTHONPATH that lead to it."""
    mark = foreign_folder.fill(tmp_path)
    monkeypatch.chdir(tmp_path)
    kept = [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if os.path.isabs(path)]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(["", ".", *kept]))
    return mark


def test_the_modules_would_run_if_they_were_imported(working_folder):
    """Else the tests below could not fail."""
    import subprocess

    subprocess.run([sys.executable, "-c", "import numpy"], capture_output=True, env=os.environ)
    assert working_folder.read_text().split()


def test_the_probe_of_a_backend_runs_none(working_folder):
    chosen = backend.select()
    assert backend.probe(chosen).works
    assert not working_folder.exists(), working_folder.read_text()


@pytest.mark.slow
def test_a_worker_of_a_build_runs_none_and_has_the_package_of_its_parent(working_folder):
    """The worker is a real one; that its order is of another version shows that it got as far as that."""
    plan = BenchmarkPlan(generated(1))
    order = order_of(plan.spec, Path("/nowhere")).replace(hesim_render.__version__, "9.9.9")
    with pytest.raises(OutputError, match=r"9\.9\.9"):
        LocalWorkers(order, 1).run(plan.clips, lambda answer: None)
    assert not working_folder.exists(), working_folder.read_text()


def test_a_child_has_the_package_of_its_parent(tmp_path, monkeypatch):
    """Where Python would find another one first."""
    import subprocess

    (tmp_path / "hesim_render").mkdir()
    (tmp_path / "hesim_render" / "__init__.py").write_text("raise SystemExit('another one')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    code = child.with_package(
        "import hesim_render, hesim_render.core.units as u; print(hesim_render.__file__, u.__file__)"
    )
    done = subprocess.run(child.python_command(code), env=child.child_environment(), capture_output=True, text=True)
    own = Path(hesim_render.__file__)
    assert done.stdout.split() == [str(own), str(own.parent / "core" / "units.py")], done.stderr


def test_no_other_place_starts_python():
    """The program of a peer is one that the user names, and runs only with --run-programs."""
    package = Path(hesim_render.__file__).parent
    found = {}
    for file in package.rglob("*.py"):
        words = set(re.findall(_STARTS, file.read_text()))
        if words:
            found[str(file.relative_to(package))] = words
    assert found == {
        "core/child.py": {"sys.executable"},
        "core/backend.py": {"subprocess.run"},
        "core/workers.py": {"subprocess.Popen", "multiprocessing"},
        "benchmark/local.py": {"subprocess.Popen"},
        "benchmark/peer_run.py": {"subprocess.Popen"},
    }
