"""A camera on the bench of EMVA 1288, in NumPy alone: pairs at many exposures and two long series.

It shares no code with the package. Values are drawn pixel by pixel from the textbook's model.
"""

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Camera:
    """A camera and its light; figures in the units of the standard."""

    rows: int = 36
    cols: int = 52
    bits: int = 12
    gain: float = 0.37  # DN/e-
    efficiency: float = 0.43
    photons_per_us: float = 1.13
    black: float = 52.0  # DN
    read_noise: float = 9.4  # e-
    dark_current: float = 5200.0  # e-/s
    dsnu: tuple[float, float, float] = (2.2, 3.1, 7.0)  # e-: rows, columns, pixels
    prnu: tuple[float, float, float] = (0.004, 0.003, 0.011)  # rows, columns, pixels
    row_noise: float = 0.8  # DN
    column_noise: float = 0.0  # DN
    bend: float = 0.0  # of the signal at full scale, relative
    late_us: float = 0.0  # longer exposure than stated
    light_scatter: float = 0.0  # relative, from frame to frame
    correlation: float = 0.0  # of the read noise of neighbours in a row
    full_well: float = np.inf  # e-
    hum: float = 0.0  # DN, of a checkerboard with a new phase in each frame
    hot: int = 0  # pixels of many times the dark current
    white: int = 0  # pixels that are always at full scale
    dead_row: int | None = None  # whose pixels are always 0
    lag: float = 0.0  # part of the electrons that stays for the next frame
    softness: float = 0.0  # e-, over which the full well is reached
    light_drift: float = 0.0  # relative, from no exposure to the longest; long series after it
    exposures_us: tuple[float, ...] = tuple(float(t) for t in np.linspace(400, 24_000, 18).round())
    long_us: float = 11_400.0
    long_frames: int = 12

    def but(self, **changes):
        return replace(self, **changes)

    def bench(self, seed):
        """A function of (lit, exposure_us, count, photons_per_us) that gives frames of one device."""
        rng = np.random.default_rng(seed)
        shape = self.rows, self.cols

        def pattern(parts):
            drawn = [rng.standard_normal(size) for size in ((self.rows, 1), (1, self.cols), shape)]
            return sum(part * (values - values.mean()) for part, values in zip(parts, drawn, strict=True))

        offset = self.black + self.gain * pattern(self.dsnu)
        response = 1 + pattern(self.prnu)
        currents = np.full(shape, self.dark_current)
        own = np.random.default_rng([seed, 1])
        currents.flat[own.integers(0, currents.size, self.hot)] *= own.uniform(20, 200, self.hot)
        white = np.random.default_rng([seed, 2]).integers(0, currents.size, self.white)
        longest = max(self.exposures_us)
        left = np.zeros(shape)
        grid = np.add.outer(np.arange(self.rows), np.arange(self.cols))

        def frame(lit, exposure_us, photons_per_us):
            light = 0.0
            if lit:
                light = self.efficiency * photons_per_us * (exposure_us + self.late_us) * response
                late = 1.0 if exposure_us == self.long_us else exposure_us / longest
                light = light * (1 + self.light_scatter * rng.standard_normal()) * (1 + self.light_drift * late)
            electrons = rng.poisson(light + currents * exposure_us * 1e-6)
            if self.lag:
                here, left[:] = left.copy(), self.lag * electrons
                electrons = electrons - left + here
            if self.softness:
                left_e = self.full_well - electrons
                electrons = self.full_well - self.softness * np.logaddexp(0, left_e / self.softness)
            signal = self.gain * np.minimum(electrons, self.full_well)
            signal = signal * (1 + self.bend * signal / (2**self.bits - 1))
            noise = rng.standard_normal((self.rows, self.cols + 1))
            root = np.sqrt(1 - 4 * self.correlation**2)
            own, other = np.sqrt((1 + root) / 2), np.copysign(np.sqrt((1 - root) / 2), self.correlation)
            noise = own * noise[:, 1:] + other * noise[:, :-1]
            value = signal + offset + self.gain * self.read_noise * noise
            value = value + self.row_noise * rng.standard_normal((self.rows, 1))
            value = value + self.column_noise * rng.standard_normal(self.cols)
            value = value + np.sqrt(2) * self.hum * np.cos(np.pi * grid + 2 * np.pi * rng.random())
            value.flat[white] = 2**self.bits
            if self.dead_row is not None:
                value[self.dead_row] = 0.0
            return np.clip(np.rint(value), 0, 2**self.bits - 1).astype(np.uint16)

        def frames(lit, exposure_us, count, photons_per_us=self.photons_per_us):
            return np.stack([frame(lit, exposure_us, photons_per_us) for _ in range(count)])

        return frames

    def set(self, seed):
        """All frames of one device: {(lit, exposure_us): uint16 [frame, row, col]}, pairs and long series apart."""
        frames = self.bench(seed)
        pairs = {(lit, t): frames(lit, t, 2) for t in self.exposures_us for lit in (True, False)}
        long = {lit: frames(lit, self.long_us, self.long_frames) for lit in (True, False)}
        return pairs, long

    def photons(self, exposure_us):
        return self.photons_per_us * exposure_us

    def write(self, folder, seed, listed=True):
        """Write the set: in the layout of the standard's data sets, with backslashes, or as a plain folder."""
        from PIL import Image

        pairs, long = self.set(seed)
        series = [(lit, t, stack) for (lit, t), stack in pairs.items()]
        series += [(lit, self.long_us + 0.5, stack) for lit, stack in long.items()]
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "images").mkdir(exist_ok=True)
        lines = ["# a camera of NumPy", "v 4.0", f"n {self.bits} {self.cols} {self.rows}"]
        for k, (lit, t, stack) in enumerate(series):
            photons = self.photons(t)
            lines.append(f"b {1000 * t} {photons}" if lit else f"d {1000 * t}")
            for number, image in enumerate(stack):
                name = f"images/{'bd'[not lit]}_{k:03}_{number:02}.png"
                if not listed:
                    light = f"lit_{t}us_{photons}ph" if lit else f"dark_{t}us"
                    name = f"{light}_{number:02}.png"
                lines.append("i " + name.replace("/", "\\"))
                Image.fromarray(image if self.bits > 8 else image.astype(np.uint8)).save(folder / name)
        if listed:
            (folder / "EMVA1288_Data.txt").write_text("\r\n".join(lines) + "\r\n", encoding="utf-8")
        else:
            (folder / "capture.yaml").write_text(f"bit_depth: {self.bits}\ntile_rows: 1\ntile_cols: 1\n", "utf-8")
        return folder


def in_memory(camera, seed):
    """The set as `read_pair_set` gives it, with its frames in memory."""
    from pathlib import Path

    from hesim_render.recording.pair_set import PairSet, Series
    from hesim_render.specs.capture import CaptureSpec

    pairs, long = camera.set(seed)
    where, store = Path("memory"), {}

    def series(lit, t, stack, name):
        files = tuple(Path(f"{name}-{number}") for number in range(len(stack)))
        store.update(zip(files, stack, strict=True))
        return Series(lit, t * 1e-6, camera.photons(t) if lit else None, files, where, None)

    class InMemory(PairSet):
        def frames(self, series):
            return (store[file] for file in series.files)

    lit = [series(True, t, pairs[True, t], f"b{t}") for t in camera.exposures_us]
    dark = [series(False, t, pairs[False, t], f"d{t}") for t in camera.exposures_us]
    spec = CaptureSpec(bit_depth=camera.bits, tile_rows=1, tile_cols=1)
    return InMemory(
        where, spec, (camera.rows, camera.cols), tuple(lit), tuple(dark),
        series(True, camera.long_us, long[True], "long b"), series(False, camera.long_us, long[False], "long d"),
    )  # fmt: skip
