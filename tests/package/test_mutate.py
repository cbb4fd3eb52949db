"""The mutation script: what it changes, that its targets exist, and that what once survived is killed today."""

import ast

import mutate
import pytest


def test_targets_and_fixed_mutations_fit_the_code():
    """A line that was changed, moved into two places or is gone has to be written anew in `tests/mutate.py`."""
    for target, tests in mutate.TARGETS.items():
        assert len(mutate.mutants(target)) > 3, target
        assert all((mutate.ROOT / test).is_file() for test in tests)
    for one in mutate.FIXED:
        mutant = mutate.of_fixed(one)
        assert mutant.make() != mutate.path_of(mutant.module).read_text(encoding="utf-8")
        ast.parse(mutant.make())


def test_every_kind_of_change_is_made(tmp_path, monkeypatch):
    code = "def f(x: int = 2) -> float:\n    '''Text 3.'''\n    return -x + max(x, 1.5) if x < 4 and True else x @ x\n"
    monkeypatch.setattr(mutate, "path_of", lambda module: tmp_path / "m.py")
    (tmp_path / "m.py").write_text(code)
    found = mutate.mutants("m:f")
    changes = {mutant.change for mutant in found}
    assert changes == {
        "2  ->  3", "-x  ->  x", "-x + max(x, 1.5)  ->  -x - max(x, 1.5)", "max  ->  min", "1.5  ->  3.0",
        "x < 4  ->  x <= 4", "4  ->  5", "x < 4 and True  ->  x < 4 or True", "True  ->  False", "x @ x  ->  x - x",
    }  # fmt: skip
    sources = [mutant.make() for mutant in found]
    assert len(set(sources)) == len(changes) and all("Text 3." in source for source in sources)
    assert (tmp_path / "m.py").read_text() == code


@pytest.mark.slow
def test_a_change_reaches_the_tests_and_leaves_no_trace(tmp_path, monkeypatch):
    """Through the hook, in a process of its own: the module has the source that it was given."""
    test = tmp_path / "test_one.py"
    test.write_text(
        "from hesim_render.core.units import photons_per_joule\ndef test(): assert photons_per_joule(1e9) > 1\n"
    )
    source = mutate.path_of("core.units").read_text(encoding="utf-8")
    more = "\ndef photons_per_joule(wavelength_nm): return 0\n"
    changed = mutate.Mutant("core.units", 1, "", lambda: source + more)
    assert mutate.run_tests((str(test),), None) == "passed"
    assert mutate.run_tests((str(test),), changed) == "failed"
    assert mutate.path_of("core.units").read_text(encoding="utf-8") == source


@pytest.mark.slow
def test_what_once_survived_is_killed():
    assert not mutate.survivors([(mutate.of_fixed(one), one.tests) for one in mutate.FIXED])
