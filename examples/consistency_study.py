"""What does a video lose that a spectral render has? The same scene both ways, into the same sensor.

A moving scene is rendered spectrally into RAW frames and events. The same render through the CIE observer gives its
sRGB video; that goes through the video path into the same sensor. Compared are electrons per channel and events.
Then a fade of a grey field, by formula: what the steps of 8 bits do to the times of events.

Run: python examples/consistency_study.py [folder] (about three minutes on two cores; the figure needs matplotlib)
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

import hesim_render as hr
from hesim_render.sources.render.exact import RenderedFlux
from hesim_render.sources.video.inversion import white_flux
from hesim_render.spectral import spectrum as spectra
from hesim_render.spectral import transfer
from hesim_render.spectral.colorimetry import tristimulus, xyz_to_linear_srgb

SIZE = (144, 96)  # columns, rows
FPS, SECONDS, LUX = 1600, 0.05, 1500
SAMPLES = 64
SCENE = {"motion.0.keyframes.1.t_us": 200_000, "motion.0.keyframes.2.t_us": 400_000}  # 2.5 times as fast
SENSOR = {"aps.exposure_us": 4000, "aps.frame_rate_hz": 40}
#: Value of the pictures that a perfect diffuser under LUX gets: leaves room for what is nearer to the lamp.
WHITE_VALUE = 0.5


def observer(number):
    """The sensor with x̄, ȳ or z̄ (per watt) behind all its pixels, so that its flux is a tristimulus value."""
    curve = spectra.colour_matching_functions()[number]
    table = {"wavelength_nm": curve.wavelength_nm.tolist(), "value": curve.values.tolist(), "basis": "energy"}
    every = {f"pixels.{letter}.filter": "curve" for letter in "RGBrgb"}
    sensor = hr.load_sensor(
        "eiger", {"filters": {"curve": table}, "quantum_efficiency": 1.0, "lens.transmittance": 1.0, **every}
    )
    return sensor.crop(*SIZE)


def linear_video(scene, illuminant):
    """Linear sRGB [time, row, col, 3] of the rendered scene, adapted to its light; pictures are means over time."""
    cols, rows = SIZE
    pixels = np.arange(rows * cols, dtype=np.uint32)
    light = spectra.illuminant(illuminant)
    white = tristimulus(light, [spectra.constant(1.0)])[0]
    xyz = np.empty((round(FPS * SECONDS), rows, cols, 3))
    for number in range(3):
        sensor = observer(number)
        flux = RenderedFlux(scene, sensor, SAMPLES, seed=7)
        level = white_flux(flux.sensor, ["curve"], light, LUX)[0]
        for k in range(len(xyz)):
            edges = np.array([k, k + 1]) * 1e6 / FPS
            cuts = np.concatenate([edges[:1], flux.slice_edges_us(*edges), edges[1:]])
            parts = [
                np.mean(flux.mean_flux(pixels, a, b), axis=0) * (b - a)
                for a, b in zip(cuts[:-1], cuts[1:], strict=True)
            ]
            xyz[k, ..., number] = (np.sum(parts, axis=0) * FPS / 1e6 / level * white[number]).reshape(rows, cols)
    return WHITE_VALUE * xyz_to_linear_srgb(xyz, white)


def encoded(linear, bits):
    return np.rint((2**bits - 1) * transfer.encode_exactly(np.clip(linear, 0, 1))).astype(f"uint{bits}")


def h264(path, pictures):
    """The 8-bit pictures as most people have them: 4:2:0, high quality."""
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS, options={"crf": "16"})
        stream.width, stream.height, stream.pix_fmt = SIZE[0], SIZE[1], "yuv420p"
        context = stream.codec_context
        context.color_trc, context.color_primaries, context.colorspace, context.color_range = 13, 1, 1, 1
        for picture in pictures:
            frame = av.VideoFrame.from_ndarray(picture, "rgb24")
            frame = frame.reformat(format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG")
            frame.color_trc, frame.color_primaries = 13, 1
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def events_per_cell(recording):
    """Net events in cells of 8×8 event pixels and 5 ms."""
    events, (rows, cols) = recording.events, recording.event_shape
    axes = [events["t_us"] // 5000, events["y"] // 8, events["x"] // 8]
    bins = [np.arange(round(SECONDS * 200) + 1), np.arange(rows // 8 + 1), np.arange(cols // 8 + 1)]
    return np.histogramdd(axes, bins, weights=events["polarity"])[0].ravel()


def compare(exact, video, sensor):
    """Bias of R, G and B electrons (%), ratio of clean and of noisy events, correlation of the clean ones' places."""
    index, valid = sensor.layout.filter_index, sensor.layout.aps_mask
    bias = []
    for number in range(3):
        where = valid & (index == number)
        sums = [sum(f.electrons_mean[where].sum(dtype=np.float64) for f in run[0].frames) for run in (video, exact)]
        bias.append(100 * (sums[0] / sums[1] - 1))
    ratios = [ours.events.size / max(1, reference.events.size) for ours, reference in zip(video, exact, strict=True)]
    match = np.corrcoef(events_per_cell(video[0]), events_per_cell(exact[0]))[0, 1]
    return (*bias, *ratios, match)


def colours_and_events(illuminant, folder):
    """Rows of the table for one light: what is done to the same pictures, and what it does to electrons and events."""
    scene = hr.load_scene("camera-sweep", {**SCENE, "light.illuminant": illuminant, "light.illuminance_lux": LUX})
    sensor = hr.load_sensor("eiger", SENSOR).crop(*SIZE)
    same = {"duration_s": SECONDS, "seed": 7}
    exact = [hr.simulate(scene, sensor, samples=SAMPLES, clean=clean, **same) for clean in (True, False)]
    linear = linear_video(scene, illuminant)
    out = 100 * np.mean((linear < 0).any(axis=-1)), 100 * np.mean((linear > 1).any(axis=-1))
    events = [run.events.size for run in exact]
    print(f"\n{illuminant}: {len(exact[0].frames)} frames, {events[0]} clean and {events[1]} noisy events;")
    print(f"out of the sRGB gamut {out[0]:.2f} % of picture pixels, clipped at white {out[1]:.2f} %")
    print(f"{'':40}{'R %':>8}{'G %':>8}{'B %':>8}{'clean':>9}{'noisy':>9}{'match':>9}")
    rows = []

    def row(name, pictures, **options):
        options = {"transfer": "linear", "fps": FPS, "white_lux": LUX / WHITE_VALUE, "fit": "pixel", **options}
        video = [hr.simulate_video(pictures, sensor, clean=clean, **same, **options) for clean in (True, False)]
        rows.append((name, *compare(exact, video, sensor)))
        red, green, blue, *others = rows[-1][1:]
        figures = f"{red:+8.2f}{green:+8.2f}{blue:+8.2f}" + "".join(f"{value:9.3f}" for value in others)
        print(f"{name:40}{figures}", flush=True)

    light = linear.astype(np.float32)
    eight = encoded(linear, 8)
    if illuminant != "D65":  # nobody who is handed a video knows its light: it is taken for D65, as sRGB has it
        row("linear, matrix", light, mode="matrix")
        row("linear, spectral", light, mode="spectral")
        row("linear, spectral, light known", light, mode="spectral", illuminant=illuminant)
        row("8-bit sRGB, spectral, light known", eight, transfer="srgb", mode="spectral", illuminant=illuminant)
        return rows
    row("linear, matrix", light, mode="matrix")
    row("linear, spectral", light, mode="spectral")
    row("16-bit sRGB, matrix", encoded(linear, 16), transfer="srgb")
    row("8-bit sRGB, matrix", eight, transfer="srgb")
    row("H.264, 8-bit 4:2:0, matrix", h264(folder / "study.mp4", eight), transfer=None)
    for divisor in (2, 4):  # means of successive pictures are the pictures of a slower camera
        slower = light.reshape(-1, divisor, *light.shape[1:]).mean(axis=1)
        row(f"linear, {FPS // divisor} pictures/s, held", slower, fps=FPS // divisor)
        row(f"linear, {FPS // divisor} pictures/s, interpolated", slower, fps=FPS // divisor, interpolation="linear")
    return rows


def fade():
    """A grey field fades from 20 % to 0.2 % in a second, seen by `davis346`: when do its events come?"""
    fps, seconds = 200, 1.0
    sensor = hr.load_sensor("davis346").crop(32, 32)
    times = (np.arange(round(fps * seconds)) + 0.5) / fps
    level = 0.2 * np.exp(-np.log(100) * times / seconds)
    field = np.broadcast_to(level[:, None, None], (level.size, 32, 32))
    print("\nFade from 20 % to 0.2 % in 1 s, davis346 with its noise, 200 pictures/s; counts per ms")
    print(f"{'':40}{'events':>9}{'variance/mean':>15}")
    histograms = {}
    for name, bits, way in (
        ("linear, interpolated", 0, "linear"),
        ("16-bit sRGB, interpolated", 16, "linear"),
        ("8-bit sRGB, interpolated", 8, "linear"),
        ("linear, held", 0, "none"),
        ("8-bit sRGB, held", 8, "none"),
    ):
        pictures = encoded(field, bits) if bits else field.astype(np.float32)
        curve = "srgb" if bits else "linear"
        recording = hr.simulate_video(
            pictures, sensor, fps=fps, transfer=curve, white_lux=2000, interpolation=way, seed=7
        )
        counts = histograms[name] = np.bincount(recording.events["t_us"] // 1000, minlength=1000)[100:1000]
        print(f"{name:40}{recording.events.size:9d}{counts.var() / counts.mean():15.1f}", flush=True)
    return histograms


def figure(results, histograms, path):
    """Bias, event ratio and the fade in one picture."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    shown = plt.figure(figsize=(13, 4), layout="constrained")
    left, right = shown.subfigures(1, 2, width_ratios=(1.5, 1))
    axes = left.subplots(1, 2, sharey=True)
    colours = ("#c0392b", "#2e8b57", "#2c5fa8")
    rows = [(light, row) for light in results for row in results[light]]
    for place, (_, row) in enumerate(rows):
        for channel in range(3):
            axes[0].barh(place + 0.26 * (channel - 1), row[1 + channel], 0.25, color=colours[channel])
        axes[1].plot(row[4], place, "o", color="#333333", label="clean" if place == 0 else None)
        axes[1].plot(row[5], place, "s", mfc="none", color="#333333", label="with noise" if place == 0 else None)
    axes[0].set_yticks(range(len(rows)), [f"{light}: {row[0]}" for light, row in rows], fontsize=8)
    axes[0].invert_yaxis()
    for axis, label, line in ((axes[0], "bias of R, G, B electrons, %", 0), (axes[1], "events, video over render", 1)):
        axis.set_xlabel(label)
        axis.axvline(line, color="#999999", lw=0.8)
    axes[1].legend(frameon=False)
    names = ("linear, interpolated", "8-bit sRGB, interpolated", "8-bit sRGB, held")
    for axis, name in zip(right.subplots(3, 1, sharex=True, sharey=True), names, strict=True):
        axis.plot(100 + np.arange(900), histograms[name], lw=0.6, color="#333333")
        axis.set_title(name, fontsize=9, loc="left", pad=2)
    axis.set_xlabel("time of the fade, ms")
    right.supylabel("events per ms", fontsize=10)
    shown.savefig(path, dpi=100)


def main():
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else None
    with tempfile.TemporaryDirectory() as scratch:
        results = {light: colours_and_events(light, Path(scratch)) for light in ("D65", "LED-B3")}
    histograms = fade()
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        figure(results, histograms, folder / "video-consistency.png")
        print("\nfigure in", folder / "video-consistency.png")


if __name__ == "__main__":
    main()
