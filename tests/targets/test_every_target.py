"""Every kind of target renders on a hybrid and on an asynchronous sensor, from the command line."""

import typing

import numpy as np
import pytest
from PIL import Image

import hesim_render as hr
from hesim_render import cli
from hesim_render.cli.exit_status import ExitStatus
from hesim_render.specs.target import TargetSpec

KINDS = sorted(
    typing.get_args(model.model_fields["type"].annotation)[0]
    for model in typing.get_args(typing.get_args(TargetSpec)[0])
)


def content_of(kind, folder):
    if kind == "image":
        Image.fromarray(np.full((3, 4, 3), 180, np.uint8)).save(folder / "card.png")
        return "file: card.png"
    if kind == "patch-chart":
        (folder / "chart.csv").write_text("name,300,1100\ndark,0.1,0.1\nlight,0.8,0.8\n")
        return "patches: chart.csv, rows: 1, cols: 2"
    if kind == "dead-leaves":
        return "texels_across: 128, radius_min_m: 0.004"
    if kind == "zone-plate":  # finer rings than pixels can hold are another test
        return "cycles: 8, rotation_deg: 10"
    if kind == "led-grid":
        return "rows: 2, cols: 3, rotation_deg: 10"
    if kind == "dot-grid":
        return "rows: 5, cols: 7, rotation_deg: 10"
    return "rotation_deg: 10"


#: Each kind on one of two sensors in the fast tests, and on the other one in the slow ones.
RUNS = [
    pytest.param(kind, sensor, id=f"{kind}-{sensor}", marks=[pytest.mark.slow] if (number + other) % 2 else [])
    for number, kind in enumerate(KINDS)
    for other, sensor in enumerate(("eiger", "davis346"))
]


@pytest.mark.parametrize(("kind", "sensor"), RUNS)
def test_it_renders(kind, sensor, tmp_path, capsys):
    assert len(KINDS) == 19
    (tmp_path / "scene.yaml").write_text(
        f"schema_version: 1\nname: {kind}\ndescription: one of each\n"
        f"target: {{type: {kind}, {content_of(kind, tmp_path)}}}\n"
        "light: {type: uniform, illuminance_lux: 500}\ncamera: {fit: target}\n"
    )
    with pytest.raises(SystemExit) as caught:
        cli.main(["simulate", str(tmp_path / "scene.yaml"), "--sensor", sensor, "--roi", "32x24", "--samples", "2",
                  "--duration", "0.03", "--out", str(tmp_path / "out")])  # fmt: skip
    # two rays a pixel are few, which the run says; a flat target needs no more
    assert caught.value.code in (ExitStatus.DONE, ExitStatus.NOT_MET), capsys.readouterr().err
    frames = hr.Recording.load(tmp_path / "out").frames
    electrons = frames[0].electrons_mean[frames[0].valid]
    assert np.isfinite(electrons).all() and electrons.max() > 10
    if kind not in ("flat", "image"):
        assert np.ptp(electrons) > 0.05 * electrons.max()
