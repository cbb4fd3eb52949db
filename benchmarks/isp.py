"""The ISP's round trips beside their bounds, and the time of one 3264×2448 frame.

    python benchmarks/isp.py [--bits 8 10] [--repeat 5]

sRGB pictures go through the inverse pipeline of `tests/isp_images.py` (white balance of the H-ESIM paper; identity
and the paper's matrix) into a RAW frame without noise and through the default pipeline back. The ceiling is the same
quantisation without a mosaic. With colour-demosaicing installed, its Menon (2007) stands beside the Bayer figures;
with scikit-image, four photographs of its package are reported too.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
import isp_images as pictures  # the generator of the tests

from hesim_render.isp import DEFAULT, Camera, Pipeline, process
from hesim_render.isp.steps import Development

FLOAT = Pipeline.of(*[item.step for item in DEFAULT.steps[:-1]], {"step": "encode", "depth": "float"})
TILES = {"Quad-Bayer": pictures.QUAD, "with event pixels": pictures.MIPI, "Bayer": pictures.BAYER}


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


def round_trips(bits):
    for name, matrix in (("identity", pictures.IDENTITY), ("the paper's matrix", pictures.PAPER_MATRIX)):
        print(f"\nRound trip at {bits} bit, {name}; PSNR in dB")
        print(f"  {'':10} {'ceiling':>8} " + " ".join(f"{tile:>18}" for tile in TILES) + f" {'Menon (Bayer)':>14}")
        for picture_name, picture in {**pictures.images(), **pictures.photographs()}.items():
            found = []
            for tile in TILES.values():
                raw = pictures.mosaic_of(pictures.captured(picture, matrix, bits), tile)
                found.append(pictures.psnr(process(raw, camera(tile, matrix, bits), FLOAT), picture))
            reference = menon(picture, matrix, bits)
            last = "-" if reference is None else f"{reference:.2f}"
            print(
                f"  {picture_name:10} {pictures.ceiling(picture, matrix, bits):8.2f} "
                + " ".join(f"{value:18.2f}" for value in found)
                + f" {last:>14}",
                flush=True,
            )
    print("  bounds at 8 bit, identity: natural and checker >= 33, the others >= ceiling - 1 (Quad-Bayer);")
    print("  event pixels <= 1.5 below Quad-Bayer; Bayer >= Menon - 0.2")


def speed(repeat):
    rng = np.random.default_rng(1)
    coarse = rng.uniform(0.05, 0.9, (52, 69, 3)).repeat(48, 0).repeat(48, 1)[:2448, :3264]
    print("\nOne frame of 3264x2448, RAW to 8-bit sRGB, best and median of", repeat)
    for name, tile in TILES.items():
        raw = pictures.mosaic_of(pictures.captured(coarse, bits=10), tile)
        seconds, steps = [], {}
        for _ in range(repeat + 1):
            state = Development(raw, camera(tile, pictures.PAPER_MATRIX, 10), np.array(tile))
            begin = time.perf_counter()
            for item in DEFAULT.steps:
                start = time.perf_counter()
                item.run(state)
                steps.setdefault(item.step, []).append(time.perf_counter() - start)
            seconds.append(time.perf_counter() - begin)
        parts = ", ".join(f"{step} {min(spent):.2f}" for step, spent in steps.items())
        # the first run also solves for the weights and is left out
        print(f"  {name:18} {min(seconds[1:]):.2f} s, {np.median(seconds[1:]):.2f} s (bound 1 s; {parts})", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bits", type=int, nargs="+", default=[8, 10])
    parser.add_argument("--repeat", type=int, default=5)
    given = parser.parse_args()
    speed(given.repeat)
    for bits in given.bits:
        round_trips(bits)


if __name__ == "__main__":
    main()
