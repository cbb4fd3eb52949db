"""A scene comes from a stranger: no library of theirs runs, wherever it lies and whatever names it.

The attempts are real: a library that leaves a mark when it is loaded lies under the names that Mitsuba looks for.
"""

import os
import shutil
import subprocess
import sys

import pytest

from hesim_render.sources.render.scene import plugin_tables
from hesim_render.sources.render.scene.mitsuba_version import mitsuba

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs a compiler to make the attempt")

SOURCE = """
#include <stdio.h>
#include <stdlib.h>
__attribute__((constructor)) static void run(void) {
    FILE *mark = fopen(getenv("MARK"), "a");
    if (mark) fclose(mark);
}
"""
#: Shipped names that the scenes below use, and one that is nobody's.
NAMES = ("constant", "perspective", "sphere", "roughplastic", "hair", "path", "hdrfilm", "uniform", "mine")
ATTEMPT = """
import sys
import hesim_render as hr
from hesim_render.core.errors import HesimError
sensor = hr.load_sensor("reference-mono").crop(8, 8)
for given in eval(sys.argv[1]):
    try:
        is_file = str(given).endswith(".yaml") or given == "dark"
        scene = hr.load_scene(given) if is_file else hr.Scene.from_mitsuba(given)
        hr.simulate(scene, sensor, duration_s=0.001, samples=2)
        print("rendered")
    except HesimError as error:
        print("refused" if "not known here" in str(error) or "no plugin of Mitsuba's" in str(error) else error)
"""
LIT = '<emitter type="constant"/><sensor type="perspective"/>'
ROUGH = '<shape type="sphere"><bsdf type="roughplastic"/></shape>'


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    folder = tmp_path_factory.mktemp("library")
    (folder / "mine.c").write_text(SOURCE)
    subprocess.run(["gcc", "-shared", "-fPIC", "-o", folder / "mine.so", folder / "mine.c"], check=True)
    return folder / "mine.so"


def attempt(library, folder, scenes, working=None):
    """What a child process says of each scene; it must not have run the library, which lies everywhere around it."""
    (folder / "plugins").mkdir(exist_ok=True)
    for name in NAMES:
        for place in (folder / f"{name}.so", folder / "plugins" / f"{name}.so", folder.parent / f"{name}.so"):
            shutil.copy(library, place)
    mark = folder / "mark"
    done = subprocess.run(
        [sys.executable, "-c", ATTEMPT, repr(scenes)],
        cwd=working or folder,
        env={**os.environ, "MARK": str(mark)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert not mark.exists(), f"ran native code: {done.stdout}"
    return done.stdout.splitlines()


def test_the_library_would_run_if_it_were_loaded(library, tmp_path):
    """Else the tests below could not fail."""
    code = f"import ctypes; ctypes.CDLL({str(library)!r})"
    subprocess.run([sys.executable, "-c", code], env={**os.environ, "MARK": str(tmp_path / "mark")}, check=True)
    assert (tmp_path / "mark").exists()


def test_xml_files_run_no_library_beside_them(library, tmp_path):
    folder, elsewhere = tmp_path / "scene", tmp_path / "elsewhere"
    folder.mkdir(), elsewhere.mkdir()
    (folder / "inner.xml").write_text('<scene version="3.0.0"><shape type="mine"/></scene>')
    foreign = [
        '<shape type="mine"/>', '<shape type="./mine"/>', '<shape type="../mine"/>', f'<shape type="{folder}/mine"/>',
        '<shape type="plugins/mine"/>', '<shape type="sphere"><bsdf type="mine"/></shape>',
        '<include filename="inner.xml"/>', '<default name="t" value="mine"/><shape type="$t"/>',
        '<path value="."/><shape type="mine"/>', '<integrator type="mine"/>', '<bsdf type="mine" id="a"/>',
    ]  # fmt: skip
    shipped = [
        ROUGH,
        f'<path value="."/>{ROUGH}',
        f'{ROUGH}<integrator type="path"/>',
        f'<path value="plugins"/>{ROUGH}',
    ]
    files = []
    for number, body in enumerate(foreign + shipped):
        files.append(str(folder / f"{number}.xml"))
        (folder / f"{number}.xml").write_text(f'<scene version="3.0.0">{LIT}{body}</scene>')
    expected = ["refused"] * len(foreign) + ["rendered"] * len(shipped)
    assert attempt(library, folder, files) == expected
    assert attempt(library, folder, files[-2:], elsewhere) == ["rendered"] * 2


def test_dictionaries_and_scene_files_run_no_library_beside_them_or_where_the_program_was_started(library, tmp_path):
    folder = tmp_path / "scene"
    folder.mkdir()
    lit = {"light": {"type": "constant"}, "camera": {"type": "perspective"}}
    names = ["mine", "./mine", "../mine", f"{folder}/mine", "plugins/mine", ["mine"], {"type": "mine"}]
    foreign = [{**lit, "a": {"type": name}} for name in names]
    foreign += [{**lit, "a": {"type": "sphere", "b": {"type": name}}} for name in names[:5]]
    (folder / "scene.yaml").write_text(
        "schema_version: 1\nname: x\ndescription: x\nmitsuba:\n  inline:\n    light: {type: constant}\n"
        "    camera: {type: perspective}\n    ball: {type: sphere, bsdf: {type: roughplastic}}\n"
    )
    (folder / "foreign.yaml").write_text((folder / "scene.yaml").read_text().replace("roughplastic", "../mine"))
    rough = {**lit, "a": {"type": "sphere", "b": {"type": "roughplastic"}}}
    said = attempt(library, folder, [*foreign, "foreign.yaml", rough, "scene.yaml", "dark"])
    assert said == ["refused"] * (len(foreign) + 1) + ["rendered"] * 3


def test_every_plugin_that_is_rendered_is_a_file_of_mitsubas_own():
    """One that is not would be looked for in other folders."""
    from pathlib import Path

    shipped = {path.stem for path in (Path(mitsuba().__file__).parent / "plugins").glob("*.so")}
    for table in (plugin_tables.HONOURED, plugin_tables.EXACT, plugin_tables.OF_THE_SENSOR_FILE):
        for names in table.values():
            assert set(names) <= shipped
