"""What tests of damaged and hostile files have in common."""

import pytest

from hesim_render.core.errors import SpecError

LIT = "light: {type: uniform, illuminance_lux: 100}"


def refused(call, match):
    with pytest.raises(SpecError, match=match) as caught:
        call()
    # a line for each mistake, each with the file's name
    lines = str(caught.value).splitlines()
    assert len(lines) == 1 or len({line.partition(": ")[0] for line in lines}) == 1


def scene_file(folder, body):
    folder.mkdir(exist_ok=True)
    (folder / "s.yaml").write_text(
        f"schema_version: 1\nname: s\ndescription: d\n{body}\ncamera: {{origin_m: [0, 0, 1]}}\n"
    )
    return folder / "s.yaml"
