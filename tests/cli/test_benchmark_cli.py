"""``benchmark`` on the command line: exit codes, one line for every mistake, and the whole way of a small benchmark."""

import json

import pytest
from test_cli import call, fails

from benchmarks import SMALL
from hesim_render.sources.render.audit.audit import Audit

#: One clip of a scene without motion.
TINY = SMALL | {
    "scenes": {"given": [{"scene": "flat-field", "split": "test"}]},
    "sensors": [{"sensor": "reference-mono", "roi": "16x16"}],
}


@pytest.fixture(scope="module")
def spec(tmp_path_factory):
    file = tmp_path_factory.mktemp("cli") / "tiny.yaml"
    file.write_text(json.dumps(TINY))
    return file


def test_a_benchmark_is_built_verified_evaluated_and_exported(spec, tmp_path, capsys):
    out = tmp_path / "b"
    status, text, _ = call(capsys, "benchmark", "build", spec, "--out", out, "--workers", 0)
    assert status == 0 and text.startswith("estimate: 1 clip, about") and "1 clip (0 train, 0 val, 1 test)" in text
    status, text, _ = call(capsys, "benchmark", "verify", out)
    assert status == 0 and "1 clip as built; digest" in text
    # the same command again builds nothing
    assert call(capsys, "benchmark", "build", spec, "--out", out, "--workers", 0)[0] == 0
    status, text, _ = call(capsys, "benchmark", "evaluate", out, "--out", tmp_path / "s.json", "--tasks", "deblur")
    assert status == 0 and "double-integral" in text and json.loads((tmp_path / "s.json").read_text())["clips"] == 1
    assert "--overwrite" in fails(capsys, "benchmark", "evaluate", out, "--out", tmp_path / "s.json")
    # a task that was asked for and cannot be scored is named; among all tasks it is left out
    status, text, err = call(capsys, "benchmark", "evaluate", out, "--tasks", "hdr,deblur")
    assert status == 0 and "double-integral" in text and err.endswith("hdr: no clip of this split has what it needs\n")
    assert "hdr" not in call(capsys, "benchmark", "evaluate", out)[2]
    status, text, _ = call(capsys, "benchmark", "export", out, "--format", "highrev", "--out", tmp_path / "x")
    assert status == 0 and text.startswith("1 pictures in")
    next(out.glob("clips/*/sharp.h5")).unlink()
    status, text, err = call(capsys, "benchmark", "verify", out)
    assert status == 1 and text == "" and err.endswith("sharp.h5: is missing\n") and err.count("\n") == 1


def test_clips_that_miss_their_quality_are_told_with_the_status_of_a_run(spec, tmp_path, capsys, monkeypatch):
    out, plain = tmp_path / "b", Audit.run
    monkeypatch.setattr(Audit, "run", lambda self: plain(self) | {"verdict": "not met", "quality_needed": 1.25})
    build = ("benchmark", "build", spec, "--out", out, "--workers", 0, "--no-estimate")
    for _ in range(2):  # a build that finds all clips there says the same
        status, text, _ = call(capsys, *build)
        name = next(out.glob("clips/*")).name
        told = f"  NOT MET: 1 of 1 clips are worse than asked for ({name}); quality 1.25 would do"
        assert status == 3 and text.splitlines()[-1] == told
    status, text, _ = call(capsys, *build, "--json")
    assert (status, json.loads(text)["status"], json.loads(text)["not_met"]) == (3, 3, [name])


def test_mistakes_are_one_line(spec, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("hesim_render.benchmark.cluster._PATIENCE_S", 1.5)
    out = tmp_path / "b"
    assert "no such file" in fails(capsys, "benchmark", "build", tmp_path / "none.yaml", "--out", out)
    assert "motions" in fails(capsys, "benchmark", "build", spec, "--out", out, "--set", "motion.speed=3")
    text = fails(capsys, "benchmark", "build", spec, "--out", out, "--no-estimate", "--scheduler", "tcp://127.0.0.1:9")
    assert "--scheduler" in text
    text = fails(capsys, "benchmark", "build", spec, "--out", out, "--scheduler", "x", "--workers", 3)
    assert "--workers" in text
    for option in ("--workers", "--span"):  # by a dry run as well
        text = fails(capsys, "benchmark", "build", spec, "--out", out, "--dry-run", option, -1)
        assert f"{option} is -1" in text
    assert "no benchmark" in fails(capsys, "benchmark", "verify", tmp_path)
    assert "split" in fails(capsys, "benchmark", "evaluate", tmp_path, "--split", "tets")


def test_a_long_build_has_to_be_wanted(spec, tmp_path, capsys, monkeypatch):
    from hesim_render.benchmark import build
    from hesim_render.benchmark.forecast import BuildEstimate

    monkeypatch.setattr(build, "estimate_build", lambda plan, clips, progress: BuildEstimate(1, 4000.0, 1e9))
    with pytest.raises(SystemExit) as stopped:
        from hesim_render import cli

        cli.main(["benchmark", "build", str(spec), "--out", str(tmp_path / "b"), "--workers", "0"])
    out, err = capsys.readouterr()
    assert stopped.value.code == 2 and "--yes" in err and out.startswith("estimate: 1 clip,")
    assert not list((tmp_path / "b" / "clips").iterdir())
