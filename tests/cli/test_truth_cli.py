"""Truth from the command line: --truth, export, cube."""

import numpy as np
import pytest
from test_cli import call, fails

import hesim_render as hr
from hesim_render.cli.cube import parse_bands
from hesim_render.cli.exit_status import ExitStatus
from hesim_render.core.errors import RangeError
from hesim_render.recording.truth_file import TRUTH_KINDS
from hesim_render.specs.files import data_folder

RUN = ("simulate", "rotating-star", "--sensor", "gen2", "--roi", "32x24", "--duration", "0.02", "--samples", "2")


def test_truth_is_written_and_exported(capsys, tmp_path):
    out = tmp_path / "rec"
    assert (
        call(capsys, *RUN, "--out", out, "--truth", "depth, events", "--truth-every-us", "5000")[0]
        == ExitStatus.NOT_MET
    )
    recording = hr.Recording.load(out)
    assert recording.stored_truth.kinds == ("depth",)
    assert recording.stored_truth.read("events/depth_m").shape == (5, 6, 8)
    assert recording.event_labels.label.size == recording.manifest["counts"]["events"]
    status, told, _ = call(capsys, "export", out, "--format", "tum", "--out", tmp_path / "tum", "--every-us", "5000")
    assert status == 0 and told == f"tum in {tmp_path / 'tum'}\n"
    assert np.loadtxt(tmp_path / "tum" / "camera.txt").shape == (5, 8)
    star = ("--format", "kalibr", "--out", tmp_path / "k", "--scene")
    assert call(capsys, "export", out, *star, "rotating-star")[0] == 0
    assert "is not the one of the recording" in fails(capsys, "export", out, *star, "flat-field", "--overwrite")
    assert "exr, dsec-flow, tum, kalibr, opencv" in fails(
        capsys, "export", out, "--format", "bag", "--out", tmp_path / "x"
    )


def test_kinds_that_are_none_are_one_line(capsys, tmp_path):
    told = fails(capsys, *RUN, "--out", tmp_path / "rec", "--truth", "depht")
    assert "truth is 'depht'; expected one of depth, normals" in told and "did you mean 'depth'" in told
    assert list(tmp_path.iterdir()) == []


def test_kinds_are_listed_and_documented(capsys):
    lines = [line.split(maxsplit=1) for line in call(capsys, "info", "truth")[1].splitlines()]
    assert [name for name, _ in lines] == list(TRUTH_KINDS)  # each with what it is
    docs = (data_folder("sensors").parent / "docs" / "ground-truth.md").read_text()
    table = docs[docs.index("## Kinds") : docs.index("## Inertial")]
    assert all(f"| `{name}` |" in table for name in TRUTH_KINDS)


def test_cube_writes_a_spectral_exr(capsys, tmp_path):
    out = tmp_path / "cube.exr"
    run = ("cube", "colorchecker", "--sensor", "reference-mono", "--roi", "16x12", "--samples", "4", "--out", out)
    status, told, _ = call(capsys, *run, "--bands", "450:650:100", "--begin-us", "100", "--end-us", "300")
    assert status == 0 and told.startswith("3 bands of 16x12 px, mean ")
    bands, radiance = hr.read_spectral_exr(out)
    np.testing.assert_array_equal(bands, [450, 550, 650])
    assert radiance.shape == (12, 16, 3) and (radiance > 0).all()
    assert "exists; give another name" in fails(capsys, *run)
    assert call(capsys, *run, "--bands", "500", "--overwrite")[0] == 0
    assert "a time after the begin" in fails(capsys, *run, "--overwrite", "--begin-us", "9", "--end-us", "9")


@pytest.mark.parametrize("text", ["", "a", "400:700", "400:700:0", "700:400:10", "400:700:0.001", "1:2:3:4", "4,,5"])
def test_bands_that_are_none_are_refused(text):
    with pytest.raises(RangeError, match="--bands"):
        parse_bands(text)
    # the last one too where (400.7 - 400)/0.1 is below 7 in double precision
    assert parse_bands("400:400.7:0.1") == pytest.approx([400 + 0.1 * k for k in range(8)])
    assert parse_bands("400:420:10") == [400, 410, 420] and parse_bands("450, 550") == [450, 550]
