"""Noise model of a sensor's frames for the ISP: variance against signal, and fixed maps."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.calibration.file import as_written, read_calibration, read_maps
from hesim_render.calibration.measured import MeasuredMaps, measured_maps
from hesim_render.core.bands import in_bands
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.units import S_PER_US
from hesim_render.mosaic.layout import Layout
from hesim_render.pixels.aps.formulas import ADC_VARIANCE_DN2, dark_variance_dn2, light_gain_dn
from hesim_render.pixels.aps.model import APS_TERMS, ApsNoise
from hesim_render.recording.manifest import sensor_spec
from hesim_render.specs.sensor import SensorSpec

Map = float | NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class FrameNoise:
    """Noise of frames over the read-out region, in the calibrated form (`hesim_render.pixels.aps.formulas`).

    Parameters
    ----------
    beta : [tile_row, tile_col, 6], temporal variance before the ADC over 1, I, t, I², I t, t²; DN and s.
    exposure_us : exposure of the frame, µs.
    residual_dn2 : further variance, DN²: noise that `beta` does not describe, and pixel offsets without a map.
    prnu_rel : standard deviation of pixel responses without a map over their mean.
    row_std_dn : standard deviation over rows of fixed offsets without a map, DN.
    row_noise_dn : standard deviation of row offsets that change from frame to frame (temporal row noise), DN.
    offset_dn : N_FP less the black level, [row, col], DN; 0 where it is not known.
    dark_dn_per_s : N_DP, mean signal of the dark current, [row, col] or a number, DN/s.
    response : relative response of each pixel, [row, col] or 1.

    Raises
    ------
    RangeError
        If `beta` has another shape, or a value that is not finite.
    """

    beta: NDArray[np.float64]
    exposure_us: float
    residual_dn2: float = 0.0
    prnu_rel: float = 0.0
    row_std_dn: float = 0.0
    row_noise_dn: float = 0.0
    offset_dn: Map = 0.0
    dark_dn_per_s: Map = 0.0
    response: Map = 1.0

    def __post_init__(self) -> None:
        if self.beta.ndim != 3 or self.beta.shape[2] != 6 or not np.isfinite(self.beta).all():
            raise RangeError("shape of beta", self.beta.shape, "(tile_row, tile_col, 6) of finite numbers")

    @classmethod
    def of_sensor(
        cls, spec: SensorSpec, layout: Layout, off: frozenset[str] = frozenset(), maps: bool = True
    ) -> "FrameNoise":
        """Noise of a sensor file's frame pixels.

        Parameters
        ----------
        spec : content of the sensor file.
        layout : read-out region.
        off : noise terms that are switched off (`APS_TERMS`).
        maps : take the device's maps as known; otherwise their spread counts as noise.

        Returns
        -------
        The noise, at the exposure of the file.

        Raises
        ------
        SpecError
            If the sensor has no frame pixels, or its measured maps cannot be read.
        """
        if spec.aps is None:
            raise SpecError(f"sensor {spec.name!r} has no frame pixels")
        aps = spec.aps
        model = ApsNoise(aps, layout, spec.device_seed, off)
        common: dict[str, Any] = {
            "beta": np.array(model.to_polynomial(), dtype=np.float64),
            "exposure_us": float(aps.exposure_us),
            "residual_dn2": 0.0 if "residual" in off else aps.residual_noise_dn**2,
            "row_noise_dn": model.row_noise_dn,
        }
        gain = aps.system_gain_dn_per_e
        if not maps:
            # unknown maps: their spread over pixels looks like noise in a single frame
            common["residual_dn2"] += 0.0 if "dsnu" in off else (gain * aps.dsnu_e) ** 2
            return cls(
                **common,
                prnu_rel=0.0 if "prnu" in off else aps.prnu_rel,
                row_std_dn=0.0 if "row" in off else aps.row_offset_std_dn,
                dark_dn_per_s=0.0 if "dark_current" in off else gain * aps.dark_current_now_e_per_s,
            )
        fixed = model.fixed_pattern
        return cls(
            **common,
            offset_dn=_map(fixed.offset_dn, 1.0, -aps.black_level_dn),
            dark_dn_per_s=_map(fixed.dark_e_per_s, gain, 0.0),
            response=fixed.response,
        )

    @classmethod
    def of_recording(
        cls, manifest: Mapping[str, Any], calibration: str | Path | None = None, folder: Path | None = None
    ) -> "FrameNoise":
        """Noise of the sensor that made a recording, without the terms that were switched off there.

        Parameters
        ----------
        manifest : manifest of the recording.
        calibration : ``calibration.yaml`` of a calibrated sensor, whose maps a recording does not hold; without
            it the maps are unknown.
        folder : folder of the recording, for error messages.

        Returns
        -------
        The noise, at the exposure of the recording's sensor.

        Raises
        ------
        SpecError
            If the manifest holds no sensor that this version knows, or the calibration is not the one that was used.
        """
        spec = sensor_spec(manifest, folder)
        settings, roi = manifest.get("settings", {}), manifest["roi"]
        without = (name.removeprefix("aps.") for name in settings.get("without", ()) if name.startswith("aps."))
        off = frozenset(APS_TERMS) if settings.get("clean") else frozenset(without)
        known, measured = spec.noise is None, None
        if calibration is not None:
            measured, known = _maps_of(spec, Path(calibration)), True
        layout = Layout(spec, roi["y"], roi["x"], roi["height_px"], roi["width_px"], measured)
        return cls.of_sensor(spec, layout, off, known)

    @classmethod
    def of_calibration(cls, file: str | Path, exposure_us: float) -> "FrameNoise":
        """Noise of frames of a real sensor, from ``calibrate aps``, for the captured region.

        Parameters
        ----------
        file : the calibration.
        exposure_us : exposure of the frames, µs.

        Returns
        -------
        The noise.

        Raises
        ------
        SpecError
            If the file has no calibration of frames.
        """
        path = Path(file)
        data = read_calibration(path)
        maps = read_maps(path, "aps", data, ("n_row", "n_blc", "n_dp"))
        with as_written(path):
            beta = np.array([[[b or 0.0 for b in cell] for cell in row] for row in data["aps"]["beta"]], np.float64)
            offset, dark = maps["n_row"][:, None] + maps["n_blc"], maps["n_dp"]
            row_noise_dn = data["aps"].get("row_noise_dn", {}).get("value") or 0.0
        if not (np.isfinite(offset).all() and np.isfinite(dark).all()):
            raise SpecError("its maps hold values that are not finite", file=path)
        return cls(
            beta, exposure_us, row_noise_dn=row_noise_dn,
            offset_dn=offset.astype(np.float32), dark_dn_per_s=dark.astype(np.float32),
        )  # fmt: skip

    def at(self, exposure_us: float) -> "FrameNoise":
        """The noise of the same sensor at another exposure.

        Parameters
        ----------
        exposure_us : exposure, µs.

        Returns
        -------
        The noise at that exposure.
        """
        return replace(self, exposure_us=float(exposure_us))

    def times(self, factor: float) -> "FrameNoise":
        """The same noise with all standard deviations multiplied by a factor; the maps are unchanged.

        Parameters
        ----------
        factor : 0 or more.

        Returns
        -------
        The scaled noise.
        """
        return replace(
            self,
            beta=self.beta * factor**2,
            residual_dn2=self.residual_dn2 * factor**2,
            prnu_rel=self.prnu_rel * factor,
        )

    @property
    def unknown_rows_dn(self) -> float:
        """Standard deviation over rows of all offsets that only the picture itself can show, DN."""
        return float(np.hypot(self.row_std_dn, self.row_noise_dn))

    @property
    def is_clean(self) -> bool:
        """True if there is nothing to smooth: no temporal noise, and no pixel pattern without a map."""
        return not (self.beta.any() or self.residual_dn2 or self.prnu_rel)

    def describe(self) -> dict[str, Any]:
        """The parameters of the noise as plain values, maps summarised."""
        known = any(isinstance(values, np.ndarray) for values in (self.offset_dn, self.dark_dn_per_s, self.response))
        unknown = self.row_std_dn > 0 or self.prnu_rel > 0
        return {
            "maps": "unknown" if unknown else "known" if known else "none",
            "row_std_dn": self.unknown_rows_dn,
            "clean": self.is_clean and not self.unknown_rows_dn,
        }

    def variance(self, position: tuple[int, int]) -> tuple[float, float, float]:
        """Coefficients of the variance a + b I + c I² at a tile position, rounding to whole DN included.

        Parameters
        ----------
        position : (tile_row, tile_col).

        Returns
        -------
        a, b, c : DN², DN and 1, for a signal I in DN.
        """
        beta, t = self.beta[position], self.exposure_us * S_PER_US
        constant = dark_variance_dn2(beta, t) + self.residual_dn2 + ADC_VARIANCE_DN2
        return float(constant), float(light_gain_dn(beta, 0.0, t)), float(beta[3] + self.prnu_rel**2)

    def corrected(self, signal_dn: NDArray[np.float32]) -> NDArray[np.float32]:
        """Remove the fixed pattern of the sensor's maps from a frame.

        Parameters
        ----------
        signal_dn : [row, col], DN above the black level.

        Returns
        -------
        float32 [row, col], DN.

        Raises
        ------
        RangeError
            If the maps have another size.
        """
        t = np.float32(self.exposure_us * S_PER_US)
        maps = [_fitting(name, getattr(self, name), signal_dn.shape) for name in
                ("offset_dn", "dark_dn_per_s", "response")]  # fmt: skip
        out = np.empty(signal_dn.shape, dtype=np.float32)

        def work(rows: slice) -> None:
            offset, dark, response = (part[rows] for part in maps)
            # in the order in which the sensor adds them: offset, dark signal, then the response to light
            np.subtract(signal_dn[rows], offset, out=out[rows])
            out[rows] -= dark * t
            out[rows] /= np.maximum(response, np.float32(0.1))  # a dead pixel stays dark

        in_bands(signal_dn.shape[0], work)
        return out


def _map(values: Map, factor: float, shift: float) -> Map:
    """values · factor + shift; float32 if `values` is a map."""
    if isinstance(values, np.ndarray):
        return values * np.float32(factor) + np.float32(shift)
    return values * factor + shift


def _fitting(name: str, values: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float32]:
    array = np.asarray(values, dtype=np.float32)
    if array.ndim and array.shape != shape:
        raise RangeError(f"shape of the map {name}", array.shape, f"{shape}, that of the frame")
    return np.broadcast_to(array, shape)


def _maps_of(spec: SensorSpec, path: Path) -> MeasuredMaps:
    """Maps of a recording's sensor, which the recording does not hold, from its calibration."""
    if spec.noise is None:
        raise SpecError("the recording's sensor has no calibration: its maps follow from its device seed", file=path)
    return measured_maps(spec.noise.model_copy(update={"file": path.name, "folder": path.parent}))
