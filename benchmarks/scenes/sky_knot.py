"""Writes `knot.ply` and `sky.exr`, the mesh and the sky of `sky-knot.xml`, into the folder of this script."""

from pathlib import Path

import mitsuba as mi
import numpy as np

FOLDER = Path(__file__).parent


def write_knot(along=110, around=10, radius_m=0.13):
    """A tube of triangles along a trefoil knot."""
    t = np.linspace(0, 2 * np.pi, along, endpoint=False)
    path = 0.21 * np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)], 1)
    ahead = np.roll(path, -1, 0) - np.roll(path, 1, 0)
    across = np.cross(ahead, [0.3, 0.2, 0.93])
    across /= np.linalg.norm(across, axis=1)[:, None]
    other = np.cross(ahead / np.linalg.norm(ahead, axis=1)[:, None], across)
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)[None, :, None]
    points = path[:, None] + radius_m * (np.cos(angle) * across[:, None] + np.sin(angle) * other[:, None])
    i, j = np.indices((along, around))
    here, beside = i * around + j, i * around + (j + 1) % around
    beyond, askew = (here + around) % points[..., 0].size, (beside + around) % points[..., 0].size
    corners = (here, beyond, askew), (here, askew, beside)
    faces = np.concatenate([np.stack(three, -1).reshape(-1, 3) for three in corners])
    rows = np.empty(len(faces), [("count", "u1"), ("corner", "<i4", 3)])
    rows["count"], rows["corner"] = 3, faces
    head = [
        "ply", "format binary_little_endian 1.0",
        f"element vertex {points[..., 0].size}", *(f"property float {axis}" for axis in "xyz"),
        f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", "",
    ]  # fmt: skip
    (FOLDER / "knot.ply").write_bytes("\n".join(head).encode() + points.astype("<f4").tobytes() + rows.tobytes())


def write_sky(height=48):
    """Blue above, brown below, a small sun and a cloud."""
    theta, phi = np.meshgrid(
        (np.arange(height) + 0.5) / height * np.pi, (np.arange(2 * height) + 0.5) / height * np.pi, indexing="ij"
    )
    towards = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], -1)
    up = towards[..., 1:2]

    def lobe(middle, width):
        return np.exp((towards @ (np.array(middle) / np.linalg.norm(middle)) - 1) / width)[..., None]

    sky = np.where(up > 0, [0.35, 0.45, 0.6] + np.clip(up, 0, 1) * [0.1, 0.25, 0.6], [0.16, 0.13, 0.1])
    sky += 60 * lobe([0.45, 0.62, -0.64], 0.006) * [1, 0.93, 0.8] + 1.5 * lobe([-0.7, 0.5, 0.5], 0.08)
    half = mi.Bitmap(sky.astype(np.float32)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float16, False)
    half.write(str(FOLDER / "sky.exr"))


if __name__ == "__main__":
    mi.set_variant("scalar_rgb")
    write_knot()
    write_sky()
