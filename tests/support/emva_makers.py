"""EMVA 1288 sets as programs of several makers might write them: lists, paths and pictures of many forms.

NumPy, Pillow and tifffile alone; the frames are those of `emva_camera`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import tifffile
from PIL import Image


def save(file, frame, form, bits):
    """Write a frame in one of the forms that makers use."""
    narrow = frame.astype(np.uint8) if bits <= 8 else frame
    if form == "rgb":
        Image.fromarray(np.repeat(narrow[..., None], 3, axis=2)).save(file)
    elif form == "left":
        Image.fromarray((frame << (16 - bits)).astype(np.uint16)).save(file)
    elif form == "packed":
        tifffile.imwrite(file, narrow, photometric="minisblack", compression="zlib", predictor=True)
    elif form == "tiled":
        tifffile.imwrite(file, narrow, photometric="minisblack", tile=(32, 16))
    elif form == "wide":
        tifffile.imwrite(file, frame.astype(np.int32), photometric="minisblack", rowsperstrip=5)
    elif form == "pgm":
        rows, cols = frame.shape
        kind = ">u2" if bits > 8 else "u1"
        head = f"P5\n# a maker\n{cols} {rows}\n{2**bits - 1}\n".encode()
        file.write_bytes(head + frame.astype(kind).tobytes())
    elif form == "ascii":
        rows, cols = frame.shape
        text = "\n".join(" ".join(map(str, row)) for row in frame.tolist())
        file.write_text(f"P2 {cols} {rows} {2**bits - 1}\n{text}\n", encoding="ascii")
    else:
        Image.fromarray(narrow).save(file)


def nanoseconds(us):
    return f"{1000 * us:.1f}"


def with_backslashes(path):
    return "i " + path.replace("/", "\\")


@dataclass(frozen=True)
class Maker:
    """How a program writes a set.

    Attributes
    ----------
    name, encoding, ends : of the list.
    exposure : text of an exposure of so many µs.
    number : text of a number of photons.
    between : what separates values.
    picture : text of a picture's line, of its path with slashes.
    suffix, form : of the pictures.
    each : the line of the exposure stands before every picture.
    head : lines before the first exposure, after the size.
    capture : text of ``capture.yaml``, if any.
    """

    name: str = "EMVA1288_Data.txt"
    encoding: str = "utf-8"
    ends: str = "\r\n"
    exposure: Callable = nanoseconds
    number: Callable = "{:.6f}".format
    between: str = " "
    picture: Callable = with_backslashes
    suffix: str = ".png"
    form: str = ""
    each: bool = False
    head: tuple[str, ...] = ("# a maker", "v 3.1")
    capture: str = ""
    upper: bool = False

    def write(self, folder, series, bits, shape):
        """Write series, each (lit, exposure_us, photons, frames), and return the folder."""
        (folder / "images").mkdir(parents=True)
        lines = [*self.head, self.between.join(("n", str(bits), str(shape[1]), str(shape[0])))]
        for k, (lit, us, photons, frames) in enumerate(series):
            values = (self.exposure(us), self.number(photons)) if lit else (self.exposure(us),)
            own = self.between.join(("b" if lit else "d", *values))
            for number, frame in enumerate(frames):
                path = f"images/{'bd'[not lit]}_{k:03}_snap_{number:03}{self.suffix}"
                save(folder / path, frame, self.form, bits)
                if number == 0 or self.each:
                    lines.append(own[0].upper() + own[1:] if self.upper else own)
                lines.append(self.picture(path))
        (folder / self.name).write_bytes((self.ends.join(lines) + self.ends).encode(self.encoding))
        if self.capture:
            (folder / "capture.yaml").write_text(self.capture, encoding="utf-8")
        return folder


def comma(text):
    return text.replace(".", ",")


#: Of 12 bit: pictures of 16.
MAKERS = {
    "the standard's own": Maker(),
    "commas, tabs, microseconds, TIFF": Maker(
        name="Messung 7.txt", encoding="cp1252", between="\t", suffix=".tif", form="wide",
        exposure=lambda us: comma(f"{us:.3f}") + " µs", number=lambda n: comma(f"{n:.6f}"),
        picture=lambda path: "i\t" + path.upper(), head=("% Gerät Nº 7, µ = 4,2", "", "V 4.0"), upper=True,
    ),
    "a table of semicolons with paths of another machine": Maker(
        name="emva.csv", between=";", suffix=".tiff", form="packed", head=("v;4.0;;",), encoding="utf-8-sig",
        picture=lambda path: f'i;"D:\\Labor\\Kamera 3\\{path}";;'.replace("/", "\\"),
        exposure=lambda us: f"{us * 1e3:g}",
    ),
    "PGM, a line for each picture, UTF-16": Maker(
        name="list.txt", encoding="utf-16", ends="\r", suffix=".pgm", form="pgm", each=True, between="   ",
        picture=lambda path: "I ./" + path, exposure=lambda us: f"{us / 1e3:.6f}ms", head=("// x",),
    ),
    "values to the left, milliseconds": Maker(
        form="left", suffix=".PNG", exposure=lambda us: f"{us / 1e3:.6f}", ends="\n",
        capture="bit_depth: 12\ntile_rows: 1\ntile_cols: 1\nexposure_unit: ms\n",
        picture=lambda path: "i /home/lab/set 3/" + path,
    ),
    "values apart by commas, PGM as text, in tiles": Maker(
        between=", ", suffix=".pgm", form="ascii", exposure=lambda us: f"{us * 1e-6:.9f} s",
        picture=lambda path: "i, " + path,
    ),
    "TIFF in tiles": Maker(name="Data.TXT", suffix=".TIF", form="tiled"),
}  # fmt: skip
#: Of 8 bit.
NARROW = {
    "PNG": Maker(),
    "BMP": Maker(suffix=".bmp", name="emva1288descriptor.txt"),
    "BMP of three equal colours": Maker(suffix=".BMP", form="rgb"),
    "TIFF": Maker(suffix=".tif"),
    "PGM": Maker(suffix=".pgm", form="pgm", exposure=lambda us: comma(f"{1000 * us:.2f}")),
}
