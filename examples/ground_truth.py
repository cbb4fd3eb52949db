"""A picture of every kind of ground truth: depth, normals, flow with occlusion, boxes, labels of events and more.

A camera moves over a floor with boxes and balls; truth is computed for any time, without rendering, and labels come
from a short run.

Run: python examples/ground_truth.py [picture.png]
"""

import sys

import matplotlib
import numpy as np

import hesim_render as hr

matplotlib.use("Agg")
import matplotlib.pyplot as plt

sensor = hr.load_sensor("gen2").crop(512, 384)
scene = hr.load_scene("camera-sweep")
rec = hr.simulate(scene, sensor, duration_s=0.08, seed=7, truth=["events"])
truth, frame = rec.truth, rec.frames[0]

depth, ids, flow = truth.depth(frame), truth.ids(frame), truth.flow(frame, frame.row_times_us + 50_000)
boxes, labels = truth.boxes(frame), rec.event_labels


def hue(vectors_px):
    """Direction of flow as a colour, its length as the strength."""
    length = np.linalg.norm(vectors_px, axis=-1)
    angle = np.arctan2(vectors_px[..., 1], vectors_px[..., 0]) / (2 * np.pi) % 1
    strength = np.clip(length / np.nanpercentile(length, 99), 0, 1)
    hsv = np.stack([angle, strength, np.ones_like(angle)], axis=-1)
    return matplotlib.colors.hsv_to_rgb(np.nan_to_num(hsv))


def signed(values):
    return (np.nan_to_num(values) + 1) / 2


figure, axes = plt.subplots(3, 4, figsize=(16, 10.2), layout="constrained")
position = truth.position(frame)
low, high = (np.nanpercentile(position, share, axis=(0, 1)) for share in (1, 99))
hidden = np.where(flow.visible[..., None], hue(flow.flow_px), 0.15)
pictures = (
    ("frame 0, DN", frame.raw, {"cmap": "gray"}),
    ("depth, m", np.where(np.isfinite(depth), depth, np.nan), {"cmap": "viridis_r"}),
    ("normals (x, y, z as red, green, blue)", signed(truth.normals(frame)), {}),
    ("position (scaled to the view)", np.clip(np.nan_to_num((position - low) / (high - low)), 0, 1), {}),
    ("objects and their boxes", ids.object, {"cmap": "tab20", "interpolation": "nearest"}),
    ("materials", ids.material, {"cmap": "tab20", "interpolation": "nearest"}),
    ("mixed pixels", truth.mixed(frame), {"cmap": "gray_r", "interpolation": "nearest"}),
    ("flow to 50 ms later (hue: direction)", hue(flow.flow_px), {}),
    ("the same, dark where it is not seen again", hidden, {}),
)
for axis, (title, picture, options) in zip(axes.flat, pictures, strict=False):
    drawn = axis.imshow(picture, **options)
    axis.set_title(title, fontsize=10)
    axis.set_axis_off()
    if title.startswith("depth"):
        figure.colorbar(drawn, ax=axis, shrink=0.8)
for left, top, right, bottom in boxes.visible_px:
    axes.flat[4].add_patch(plt.Rectangle((left, top), right - left, bottom - top, fill=False, color="k"))

axis = axes.flat[9]
for name, colour in (("signal", "tab:blue"), ("mismatch", "tab:green"), ("noise", "tab:red")):
    own = rec.events[labels.label == ["signal", "mismatch", "leak", "hot", "noise"].index(name)]
    own = own[(own["t_us"] > 20_000) & (own["t_us"] <= 30_000)]
    axis.plot(own["x"], own["y"], ".", ms=1.5, color=colour, label=f"{name}: {own.size}")
axis.set(xlim=(0, rec.event_shape[1]), ylim=(rec.event_shape[0], 0), aspect="equal", xticks=[], yticks=[])
axis.legend(fontsize=8, loc="lower right", markerscale=5)
axis.set_title("labels of the events of 10 ms", fontsize=10)

times = np.arange(0, 80_001, 1_000)
poses, imu = truth.camera_pose(times), truth.imu(0, 80_000)
axes.flat[10].plot(times / 1000, poses[:, :3, 3] - poses[0, :3, 3], label=("x", "y", "z"))
axes.flat[10].set_title("way of the camera, m, over ms", fontsize=10)
axes.flat[11].plot(imu.t_us / 1000, imu.gyro_rad_per_s, lw=0.7)
axes.flat[11].set_prop_cycle(None)
axes.flat[11].plot(imu.t_us / 1000, imu.gyro_ideal_rad_per_s, lw=1.5, label=("x", "y", "z"))
axes.flat[11].set_title("angular rate, rad/s, ideal and with noise, over ms", fontsize=10)
for axis in axes.flat[10:12]:
    axis.legend(fontsize=8)

print(f"{np.isfinite(depth).mean():.1%} of the pixels show a surface, {truth.mixed(frame).mean():.1%} are mixed, "
      f"{flow.visible.mean():.1%} are seen again after 50 ms; events: {labels.counts()}")  # fmt: skip
if len(sys.argv) > 1:
    figure.savefig(sys.argv[1], dpi=80)
    print("saved to", sys.argv[1])
