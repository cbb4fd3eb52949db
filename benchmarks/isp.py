"""The ISP's round trips beside their bounds, noisy frames beside other filters, and the time of one 3264×2448 frame.

    python benchmarks/isp.py [speed] [clean] [patterns] [noisy] [--bits 8 10] [--repeat 5]

`clean`: sRGB pictures go through the inverse pipeline of `tests/support/isp_images.py` (white balance of the H-ESIM
paper; identity and the paper's matrix) into a RAW frame without noise and through the default pipeline back. The
ceiling is the same quantisation without a mosaic. With colour-demosaicing installed, its Menon (2007) stands beside
the Bayer figures; with scikit-image, four photographs of its package are reported too. `patterns` are pictures that
are hard for a mosaic: a zone plate, diagonals, text, slanted edges, beside a linear oracle fitted to the very
picture. `noisy`: a photograph, still for 60 ms, goes as a video of 20 and 100 lux (white) into `eiger` and through
the ISP. The reference is the frame without noise (`clean=True`) through the same pipeline, at the same exposure gain;
PSNR of 8-bit sRGB. Judged on astronaut, cat, coffee and rocket of scikit-image; the constants of `denoise` were
fitted on its motorcycle and on matplotlib's portrait of Grace Hopper. The filters beside it have the best figures of
a grid for each picture and light, which a person at the picture could at best find by hand.
"""

import argparse
import itertools
import resource
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "support"))
import isp_images as pictures  # the generator of the tests

import hesim_render as hr
from hesim_render.isp import DEFAULT, DENOISED_PICTURE, PICTURE, Camera, FrameNoise, Pipeline, develop, process
from hesim_render.isp.denoise import reduce_noise
from hesim_render.isp.steps import Development

FLOAT = Pipeline.of(*[item.step for item in DEFAULT.steps[:-1]], {"step": "encode", "depth": "float"})
TILES = {"Quad-Bayer": pictures.QUAD, "gen2": pictures.GEN2, "mipi-hybridevs": pictures.MIPI,
         "eiger": pictures.EIGER, "Bayer": pictures.BAYER}  # fmt: skip
LUX = (20, 100)


def camera(tile, matrix, bits):
    return Camera(
        channels=list("RGB"),
        tile=[["." if c < 0 else "RGB"[c] for c in row] for row in tile],
        white_level_dn=2**bits - 1,
        white_balance=list(pictures.PAPER_BALANCE),
        matrix=[list(row) for row in matrix],
    )


def menon(picture, matrix, bits):
    try:
        from colour_demosaicing import demosaicing_CFA_Bayer_Menon2007
    except ImportError:
        return None
    red, green, blue = pictures.PAPER_BALANCE
    gains = np.tile([[red, green], [green, blue]], [n // 2 for n in picture.shape[:2]])
    raw = pictures.mosaic_of(pictures.captured(picture, matrix, bits), pictures.BAYER) / (2**bits - 1) * gains
    return pictures.psnr(pictures.srgb(demosaicing_CFA_Bayer_Menon2007(raw, "RGGB") @ np.array(matrix).T), picture)


def round_trip(picture, tile, matrix, bits):
    raw = pictures.mosaic_of(pictures.captured(picture, matrix, bits), tile)
    return pictures.psnr(process(raw, camera(tile, matrix, bits), FLOAT), picture)


def head(*columns):
    print(f"  {'':12} " + " ".join(f"{name:>14}" for name in columns))


def row(name, *values):
    cells = " ".join(f"{'-' if value is None else f'{value:.2f}':>14}" for value in values)
    print(f"  {name:12} {cells}", flush=True)


def round_trips(bits):
    for name, matrix in (("identity", pictures.IDENTITY), ("the paper's matrix", pictures.PAPER_MATRIX)):
        print(f"\nRound trip at {bits} bit, {name}; PSNR in dB")
        head("ceiling", *TILES, "Menon (Bayer)")
        for picture_name, picture in {**pictures.images(), **pictures.photographs()}.items():
            found = [round_trip(picture, tile, matrix, bits) for tile in TILES.values()]
            row(picture_name, pictures.ceiling(picture, matrix, bits), *found, menon(picture, matrix, bits))
    print("  bounds at 8 bit, identity: natural and checker >= 33, the others >= ceiling - 1 (Quad-Bayer);")
    print("  event pixels <= 1.5 below Quad-Bayer; Bayer >= Menon - 0.2")


def patterns():
    print("\nPatterns at 10 bit, identity matrix; PSNR in dB of what lies 8 px inside; in turn ours and the oracle")
    head(*itertools.chain.from_iterable((name, "oracle") for name in TILES), "Menon (Bayer)")
    for name, picture in {"natural": pictures.images()["natural"], **pictures.patterns()}.items():
        found = []
        for tile in TILES.values():
            raw = pictures.mosaic_of(pictures.captured(picture, bits=10), tile)
            ours = process(raw, camera(tile, pictures.IDENTITY, 10), FLOAT)
            found += [pictures.inner_psnr(ours, picture), pictures.lmmse_oracle(picture, tile)]
        row(name, *found, menon(picture, pictures.IDENTITY, 10))


# -- noisy frames --------------------------------------------------------------------------------------------------


def photographs():
    """Judged and tuned on: {name: uint8 [row, col, 3]}, in whole tiles."""
    from skimage import data

    judged = {name: getattr(data, name)() for name in ("astronaut", "cat", "coffee", "rocket")}
    tuned = {"motorcycle": data.stereo_motorcycle()[0][:, 100:740]}
    try:
        from matplotlib import cbook
        from PIL import Image

        with cbook.get_sample_data("grace_hopper.jpg") as file:
            tuned["hopper"] = np.asarray(Image.open(file).convert("RGB"))
    except ImportError:
        pass
    return [{k: v[: v.shape[0] // 4 * 4, : v.shape[1] // 4 * 4] for k, v in some.items()} for some in (judged, tuned)]


def still(photograph, lux, **noise):
    """The one frame of a still video into the middle of `eiger`, and its recording."""
    sensor = hr.load_sensor("eiger").crop(photograph.shape[1], photograph.shape[0])
    recording = hr.simulate_video(
        np.repeat(photograph[None], 2, 0), sensor, fps=10, transfer="srgb", white_lux=lux, fit="pixel",
        duration_s=0.06, seed=7, **noise,
    )  # fmt: skip
    return recording.frames[0], recording


def psnr8(one, other):
    return 20 * np.log10(255) - 10 * np.log10(np.mean((one.astype(np.float64) - other) ** 2))


def by_hand(linear, gain, matrix, reference):
    """Best PSNR of each filter over its grid; `linear` are balanced channels, black 0, white 1."""
    from skimage.restoration import denoise_bilateral, denoise_nl_means

    from hesim_render.isp.colour import colour_matrix
    from hesim_render.spectral.transfer import encode

    bright = linear * np.float32(gain)
    coded = encode(colour_matrix(bright, matrix))

    def smoothed(luma, share, radius):
        return encode(colour_matrix(reduce_noise(bright, luma, luma * share, radius), matrix))

    tried = {
        "luma/chroma": (smoothed(*k) for k in itertools.product((0.05, 0.1, 0.15, 0.25, 0.4), (1, 2), (2, 3, 6))),
        "nl-means": (denoise_nl_means(coded, size, reach, h, fast_mode=True, channel_axis=-1)
                     for (size, reach), h in itertools.product(((5, 8), (7, 10)), (0.04, 0.06, 0.08, 0.1, 0.15))),
        "bilateral": (denoise_bilateral(coded, sigma_color=c, sigma_spatial=s, bins=1000, channel_axis=-1)
                      for c, s in itertools.product((0.1, 0.2, 0.4, 0.8), (1, 2, 3))),
    }  # fmt: skip
    return [max(psnr8(np.rint(255 * np.clip(p, 0, 1)), reference) for p in some) for some in tried.values()]


def noisy():
    only_maps = {"step": "denoise", "strength": 0}
    balanced = Pipeline.of("black_level", only_maps, "white_balance", "demosaic")
    maps = Pipeline.of("black_level", only_maps, *PICTURE.model_dump()["steps"][1:])
    for kind, some in zip(("judged", "tuned on"), photographs(), strict=True):
        for lux in LUX:
            print(f"\nNoisy frames of eiger at {lux} lux, pictures {kind}; PSNR in dB against the frame without noise")
            head("no denoise", "maps alone", "denoise", "maps unknown", "luma/chroma", "nl-means", "bilateral",
                 "true: denoise", "true: clean")  # fmt: skip
            for name, photograph in some.items():
                frame, recording = still(photograph, lux)
                clean = develop(still(photograph, lux, clean=True)[0], recording.mosaic, PICTURE)
                gain, manifest = clean.exposure_gain, recording.manifest
                noise = FrameNoise.of_recording(manifest)
                spec, layout = recording_sensor(manifest)

                def picture(chain, noise=noise, frame=frame, recording=recording, gain=gain):
                    return develop(frame, recording.mosaic, chain, noise=noise, exposure_gain=gain).image

                unknown = FrameNoise.of_sensor(spec, layout, maps=False)
                truth = black_and_signal(frame, spec)
                true = develop(truth, recording.mosaic, PICTURE, exposure_gain=gain).image
                ours = picture(DENOISED_PICTURE)
                row(name, *(psnr8(p, clean.image) for p in (
                    picture(PICTURE), picture(maps), ours, picture(DENOISED_PICTURE, unknown))),
                    *by_hand(picture(balanced), gain, Camera.of(recording.mosaic).matrix, clean.image),
                    psnr8(ours, true), psnr8(clean.image, true))  # fmt: skip
    print("  the filters had the frame without what the maps know; 'true': against the frame before rounding to DN")


def recording_sensor(manifest):
    from hesim_render.mosaic.layout import Layout
    from hesim_render.specs.sensor import SensorSpec

    spec, roi = SensorSpec.model_validate(manifest["sensor"]["spec"]), manifest["roi"]
    return spec, Layout(spec, roi["y"], roi["x"], roi["height_px"], roi["width_px"])


def black_and_signal(frame, spec):
    """The frame without noise, before its electrons were rounded to DN."""
    return np.float32(spec.aps.black_level_dn) + np.float32(spec.aps.system_gain_dn_per_e) * np.nan_to_num(
        frame.electrons_mean
    )


# -- speed ---------------------------------------------------------------------------------------------------------


def speed(repeat):
    rng = np.random.default_rng(1)
    coarse = rng.uniform(0.05, 0.9, (52, 69, 3)).repeat(48, 0).repeat(48, 1)[:2448, :3264]
    print("\nOne frame of 3264x2448, RAW to 8-bit sRGB, best and median of", repeat)
    steps = ("black_level", "denoise", *[item.step for item in DEFAULT.steps[1:]])
    for name, tile in TILES.items():
        noise = FrameNoise(np.tile([0.64, 0.16, 0, 0, 0, 0], (*np.shape(tile), 1)), 10_000.0)
        clean = pictures.mosaic_of(pictures.captured(coarse, bits=10), tile)
        raw = np.rint(np.maximum(clean + rng.normal(0, np.sqrt(0.64 + 0.16 * clean)), 0)).astype(np.uint16)
        for chain in (DEFAULT, Pipeline.of(*steps)):
            seconds, parts = [], {}
            for _ in range(repeat + 1):
                state = Development(raw, camera(tile, pictures.PAPER_MATRIX, 10), np.array(tile), noise=noise)
                begin = time.perf_counter()
                for item in chain.steps:
                    start = time.perf_counter()
                    item.run(state)
                    parts.setdefault(item.step, []).append(time.perf_counter() - start)
                seconds.append(time.perf_counter() - begin)
            detail = ", ".join(f"{step} {min(spent):.2f}" for step, spent in parts.items())
            # the first run also solves for the weights and is left out
            print(f"  {name:18} {min(seconds[1:]):.2f} s, {np.median(seconds[1:]):.2f} s ({detail})", flush=True)
    print(f"  peak memory of the process {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.2f} GB")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=["speed", "clean", "patterns", "noisy", []])
    parser.add_argument("--bits", type=int, nargs="+", default=[8, 10])
    parser.add_argument("--repeat", type=int, default=5)
    given = parser.parse_args()
    parts = given.parts or ["speed", "clean", "patterns", "noisy"]
    if "speed" in parts:
        speed(given.repeat)
    if "clean" in parts:
        for bits in given.bits:
            round_trips(bits)
    if "patterns" in parts:
        patterns()
    if "noisy" in parts:
        noisy()


if __name__ == "__main__":
    main()
