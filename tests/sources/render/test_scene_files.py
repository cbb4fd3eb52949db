"""Mitsuba scenes of strangers name files of their own folder, whatever way they name them."""

import json

import pytest
from damage import LIT, refused, scene_file

import hesim_render as hr
from hesim_render.core.errors import SpecError
from hesim_render.sources.render.scene.builder import build
from hesim_render.sources.render.scene.mitsuba_version import mitsuba

SPHERE = '<shape type="sphere"><bsdf type="diffuse">{}</bsdf></shape>'
INCLUDE = '<include filename="$p"/>'
PATH_SPECTRUM = SPHERE.format('<spectrum name="reflectance" filename="c.spd"/>')
#: Each leads to ../secret.spd, ../c.spd, ../part.xml or ../plate.obj, which Mitsuba would open.
LEADING_OUT = {
    "include": '<include filename="../part.xml"/>',
    "parameter": '<default name="p" value="../part.xml"/><include filename="$p"/>',
    "inner": '<include filename="own.xml"/>',
    "string": '<shape type="obj"><string name="filename" value="../plate.obj"/></shape>',
    "spectrum": SPHERE.format('<spectrum name="reflectance" filename="../c.spd"/>'),
    "first letters": '<default name="p" value="../"/><include filename="$part.xml"/>'.replace("$part", "$ppart"),
    "parameter of parameter": f'<default name="a" value=".."/><default name="p" value="$a/part.xml"/>{INCLUDE}',
    "longest first": '<default name="pp" value="../part"/><default name="p" value="x"/><include filename="$pp.xml"/>',
    "first counts": f'<default name="p" value="../part.xml"/><default name="p" value="own.xml"/>{INCLUDE}',
    "key": '<default name="f" value="filename"/><shape type="obj"><string name="$f" value="../plate.obj"/></shape>',
    "from an include": '<include filename="defaults.xml"/><include filename="$p"/>',
    "folder": f'<path value=".."/>{PATH_SPECTRUM}',
    "folder of a parameter": f'<default name="d" value=".."/><path value="$d"/>{PATH_SPECTRUM}',
    "folder in a folder": f'<path value="sub"/><path value="far"/>{PATH_SPECTRUM}',
    "folder by a link": f'<path value="up"/>{PATH_SPECTRUM}',
    "foreign bytes": PATH_SPECTRUM.replace("c.spd", "../secret.spd"),
    "foreign bytes by a folder": '<path value="up"/>' + PATH_SPECTRUM.replace("c.spd", "secret.spd"),
    "escaped": '<default name="p" value="x"/><include filename="..\\$p"/>',
}  # fmt: skip


@pytest.mark.parametrize("way", LEADING_OUT)
def test_mitsuba_files_name_files_of_their_own_folder(tmp_path, way):
    (tmp_path / "plate.obj").write_text("v -1 -1 0\nv 1 -1 0\nv 1 1 0\nf 1 2 3\n")
    (tmp_path / "c.spd").write_text("400 0.5\n700 0.5\n")
    (tmp_path / "secret.spd").write_text("root:x:0:0\n")
    (tmp_path / "part.xml").write_text('<scene version="3.0.0"><shape type="sphere"/></scene>')
    file = scene_file(tmp_path / "scene", "mitsuba: {file: main.xml}")
    (tmp_path / "scene" / "sub").mkdir()
    (tmp_path / "scene" / "up").symlink_to(tmp_path)
    (tmp_path / "scene" / "sub" / "far").symlink_to(tmp_path)
    (tmp_path / "scene" / "own.xml").write_text('<scene version="3.0.0"><include filename="../part.xml"/></scene>')
    (tmp_path / "scene" / "defaults.xml").write_text(
        '<scene version="3.0.0"><default name="p" value="../part.xml"/></scene>'
    )
    (tmp_path / "scene" / "main.xml").write_text(
        f'<scene version="3.0.0"><emitter type="constant"/>{LEADING_OUT[way]}</scene>'
    )
    said = "holds a '\\$'" if way == "escaped" else "lies outside of the scene's folder"
    with pytest.raises(SpecError, match=rf"(main|own)\.xml: .*{said}") as caught:
        build(mitsuba(), hr.load_scene(file).spec)
    assert "root:x" not in str(caught.value)
    direct = hr.Scene.from_mitsuba(tmp_path / "scene" / "main.xml", camera={"origin_m": [0, 0, 2]})
    refused(lambda: build(mitsuba(), direct.spec), said)
    if way != "escaped" and "foreign" not in way:
        assert build(mitsuba(), hr.load_scene(file, allow_outside=True).spec).scene is not None


@pytest.mark.parametrize(
    ("main", "part", "found"),
    [
        (
            '<include filename="sub/part.xml"/>',
            f'<path value="a"/>{PATH_SPECTRUM}',
            "sub/a",
        ),
        ('<include filename="sub/part.xml"/>', f'<path value="a"/>{PATH_SPECTRUM}', "a"),
        ('<path value="a"/><include filename="sub/part.xml"/>', PATH_SPECTRUM, "a"),
        (f'<path value="sub"/><path value="a"/>{PATH_SPECTRUM}', "", "sub/a"),
        (f'<include filename="sub/part.xml"/>{PATH_SPECTRUM}', '<path value="a"/>', None),
        ('<include filename="sub/part.xml"/>', PATH_SPECTRUM, None),
        (f'<default name="p" value="c"/><default name="e" value="\\"/>{PATH_SPECTRUM.replace("c.", "$p.")}', "", "."),
    ],
)
def test_files_are_found_where_mitsuba_finds_them(tmp_path, main, part, found):
    """Where it finds none, Mitsuba would look in the working folder, which is not told by its own error."""
    file = scene_file(tmp_path, "mitsuba: {file: main.xml}")
    for place in ("sub", *([found] if found else ["sub", "a"])):
        (tmp_path / place).mkdir(parents=True, exist_ok=True)
    (tmp_path / (found or "sub") / "c.spd").write_text("400 0.5\n700 0.5\n")
    (tmp_path / "sub" / "part.xml").write_text(f'<scene version="3.0.0">{part}</scene>')
    (tmp_path / "main.xml").write_text(f'<scene version="3.0.0"><emitter type="constant"/>{main}</scene>')
    if found:
        assert build(mitsuba(), hr.load_scene(file).spec).scene is not None
    else:
        refused(lambda: build(mitsuba(), hr.load_scene(file).spec), r"xml: no such file: 'c\.spd'")


def test_mitsuba_files_are_not_looked_for_where_the_program_was_started(tmp_path, monkeypatch):
    """Neither in the folder where Mitsuba was loaded, nor in that of now; a file of the scene is found."""
    mitsuba()
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    (tmp_path / "here" / "c.spd").write_text("400 0.5\n700 0.5\n")
    file = scene_file(tmp_path / "scene", "mitsuba: {file: main.xml}")
    (tmp_path / "scene" / "main.xml").write_text(
        f'<scene version="3.0.0"><emitter type="constant"/>{PATH_SPECTRUM}</scene>'
    )
    refused(lambda: build(mitsuba(), hr.load_scene(file).spec), r"main\.xml: .*(no such file|lies outside)")
    inline = "mitsuba: {inline: {a: {type: constant}, b: {type: sphere, c: {type: diffuse, reflectance: "
    for reflectance in ("{type: spectrum, filename: c.spd}", "{type: bitmap, filename: c.spd}"):
        given = scene_file(tmp_path / "other", inline + reflectance + "}}}}")
        refused(lambda given=given: build(mitsuba(), hr.load_scene(given).spec), r"(no such file|lies outside)")
    own = scene_file(
        tmp_path / "other",
        f"objects: [{{name: a, shape: sphere, material: {{type: measured, filename: c.spd}}}}]\n{LIT}",
    )
    refused(lambda: build(mitsuba(), hr.load_scene(own).spec), "no such file")
    for folder, name in (("scene", "c.spd"), ("scene/sub", "c.spd")):
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / name).write_text("400 0.5\n700 0.5\n")
        path = '<path value="sub"/>' if "sub" in folder else ""
        (tmp_path / "scene" / "main.xml").write_text(
            f'<scene version="3.0.0">{path}<emitter type="constant"/>{PATH_SPECTRUM}</scene>'
        )
        assert build(mitsuba(), hr.load_scene(file).spec).scene is not None


@pytest.mark.parametrize(
    "material", ["../../../../../../../tmp/x", "/tmp/x", "a/b", "..", "Au\x00"], ids=["up", "root", "in", "dots", "nul"]
)
def test_metals_are_names_and_no_paths(tmp_path, material):
    """Mitsuba reads data/ior/NAME.eta.spd."""
    given = json.dumps(material)
    for body in (
        f"objects: [{{name: a, shape: sphere, material: {{type: conductor, material: {given}}}}}]\n{LIT}",
        "mitsuba: {inline: {a: {type: constant}, b: {type: sphere, c: {type: roughconductor, material: "
        + given
        + "}}}}",
    ):
        file = scene_file(tmp_path / "scene", body)
        refused(lambda file=file: build(mitsuba(), hr.load_scene(file).spec), "no metal|control character")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ('<!DOCTYPE scene [<!ENTITY a "..">]><scene version="3.0.0"/>', "document type"),
        ('<?xml version="1.0" encoding="utf-7"?><scene version="3.0.0"/>', "encoding utf-7"),
        ('<scene version="3.0.0"><include filename="main.xml"/></scene>', "includes itself"),
        ('<scene version="3.0.0"><include filename="missing.xml"/></scene>', "no such file"),
        ('<scene version="3.0.0"><include filename="sub"/></scene>', "no such file"),
        ('<scene version="3.0.0"><path value="main.xml"/></scene>', "no such folder"),
        ('<scene version="3.0.0"><shape></scene>', "as XML"),
    ],
)
def test_xml_that_readers_may_understand_in_two_ways_is_refused(tmp_path, text, told):
    file = scene_file(tmp_path / "scene", "mitsuba: {file: main.xml}")
    (tmp_path / "scene" / "sub").mkdir()
    (tmp_path / "scene" / "main.xml").write_text(text)
    refused(lambda: build(mitsuba(), hr.load_scene(file).spec), told)
