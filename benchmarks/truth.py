"""Time of the framing (`--framing`) of every shipped scene, and cost of all geometric truth and event labels on top
of a render, at the default quality.

Runs `rotating-star` and a scene with a mesh of 20 000 triangles on `gen2`, 512×384 pixels, 0.1 s, without truth and
with all kinds of it, and prints the time of both and the share on top. Processor time counts the work of all threads
and hardly depends on other work on the machine. A short run compiles the kernels first::

    python benchmarks/truth.py [--size 512x384] [--duration 0.1] [--only look|truth]

The framing is timed after the imports, with the first scene once more at the end: the first picture of all compiles and
loads what the others share.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

import hesim_render as hr
from hesim_render.specs.files import list_names

MESH_SCENE = """
schema_version: 1
name: bumpy-ball
description: a ball with bumps, 20 000 triangles, that turns and flies past a chequered wall
objects:
  - {name: ball, shape: mesh, mesh: ball.ply, size_m: [0.12, 0.12, 0.12], position_m: [-0.03, 0, 0.1], reflectance: 0.6}
  - {name: wall, shape: rectangle, size_m: [1, 1, 0], reflectance: 0.7, pattern: 0.1, pattern_count: [40, 40]}
light: {type: uniform, illuminant: D65, illuminance_lux: 2000}
camera: {origin_m: [0, 0.1, 1], target_m: [0, 0, 0.05], horizontal_fov_deg: 20}
motion:
  - object: ball
    pivot_m: [-0.03, 0, 0.1]
    keyframes:
      - {t_us: 0, rotation_axis: [0, 1, 0]}
      - {t_us: 200000, translation_m: [0.06, 0, 0], rotation_axis: [0, 1, 0], rotation_deg: 60}
"""


def write_ball(path, rings=100, around=100):
    """A sphere with bumps as PLY: 2 · rings · around triangles."""
    polar, turn = np.meshgrid(np.linspace(0, np.pi, rings + 1), np.arange(around) * 2 * np.pi / around, indexing="ij")
    radius = 1 + 0.05 * np.sin(8 * polar) * np.sin(9 * turn)
    x, y, z = np.sin(polar) * np.cos(turn), np.cos(polar), np.sin(polar) * np.sin(turn)
    vertices = (radius * np.stack([x, y, z])).reshape(3, -1).T
    row, col = (index.ravel() for index in np.mgrid[:rings, :around])
    corner = [r * around + (col + c) % around for r, c in ((row, 0), (row + 1, 0), (row + 1, 1), (row, 1))]
    faces = np.concatenate([np.stack([corner[k] for k in order], axis=1) for order in ((0, 2, 1), (0, 3, 2))])
    with path.open("w") as file:
        file.write(f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\n")
        file.write("property float x\nproperty float y\nproperty float z\n")
        file.write(f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n")
        np.savetxt(file, vertices, fmt="%.6f")
        np.savetxt(file, np.insert(faces, 0, 3, axis=1), fmt="%d")


def timed(scene, sensor, duration_s, out, kinds):
    begin, work = time.perf_counter(), time.process_time()
    recording = hr.simulate(scene, sensor, duration_s=duration_s, out=out, overwrite=True, truth=kinds, progress=False)
    return time.perf_counter() - begin, time.process_time() - work, recording


def framings(names):
    """Print the time of the framing of scenes by name, on a whole `eiger`: file, geometry and picture."""
    from hesim_render.sources.render.look import look

    worst = 0.0
    for name in (*names, names[0]):
        begin, work = time.perf_counter(), time.process_time()
        look(hr.load_scene(name), hr.load_sensor("eiger"))
        taken = time.perf_counter() - begin
        worst = max(worst, taken)
        print(f"  look {name:<18} {taken:6.2f} s, {time.process_time() - work:6.2f} s of the processor")
    print(f"  the slowest took {worst:.2f} s; wanted are less than 3 s")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=("look", "truth"), help="one of the two parts")
    parser.add_argument("--size", default="512x384", help="region, px")
    parser.add_argument("--duration", type=float, default=0.1, help="simulated time, s")
    given = parser.parse_args()
    if given.only != "truth":
        framings(list_names("scenes"))
    if given.only != "look":
        truth(given)


def truth(given):
    """Print what truth costs on top of a render."""
    sensor = hr.load_sensor("gen2").crop(*map(int, given.size.split("x")))
    with tempfile.TemporaryDirectory() as folder:
        write_ball(Path(folder) / "ball.ply")
        (Path(folder) / "ball.yaml").write_text(MESH_SCENE)
        for name in ("rotating-star", f"{folder}/ball.yaml"):
            scene, out = hr.load_scene(name), Path(folder) / "out"
            timed(scene, sensor, 0.07, out, ["all"])  # compiles
            plain_s, plain_work, _ = timed(scene, sensor, given.duration, out, [])
            truth_s, truth_work, recording = timed(scene, sensor, given.duration, out, ["all"])
            print(f"{scene.name} on gen2, {given.size}, {given.duration:g} s, {len(recording.frames)} frames, "
                  f"{recording.events.size} events")  # fmt: skip
            print(f"  without truth {plain_s:6.1f} s, {plain_work:6.1f} s of the processor")
            print(f"  with all      {truth_s:6.1f} s, {truth_work:6.1f} s of the processor: "
                  f"{100 * (truth_work / plain_work - 1):.1f} % on top ({100 * (truth_s / plain_s - 1):.1f} % of the "
                  "time)")  # fmt: skip


if __name__ == "__main__":
    main()
