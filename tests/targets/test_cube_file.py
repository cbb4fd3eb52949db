"""Readers of hyperspectral cubes, on small files in the layouts of the public image sets, made by other programs."""

import h5py
import numpy as np
import OpenEXR
import pytest
import scipy.io
from PIL import Image

import hesim_render as hr
from hesim_render.core.errors import SpecError
from hesim_render.targets import matlab_cube
from hesim_render.targets.cube_file import open_cube

BANDS = np.arange(400.0, 701.0, 10.0)
#: [row, col, band], each value its own.
CUBE = np.random.default_rng(2).uniform(0.02, 0.98, (7, 5, 31)).astype(np.float32)


def check(file, expected=CUBE, bands=BANDS, rtol=1e-6, **options):
    found = open_cube(file, **options)
    assert found.shape == expected.shape
    np.testing.assert_allclose(found.wavelength_nm, bands)
    np.testing.assert_allclose(found.whole(), expected, rtol=rtol)
    np.testing.assert_array_equal(found.rows(2, 5), found.whole()[2:5])
    return found


@pytest.mark.parametrize("interleave", ("bil", "bip", "bsq"))
def test_envi(tmp_path, interleave):
    envi = pytest.importorskip("spectral").io.envi
    header = {"wavelength": [f"{band / 1000:.4f}" for band in BANDS], "wavelength units": "Micrometers"}
    envi.save_image(str(tmp_path / "a.hdr"), CUBE, interleave=interleave, metadata=header, dtype=np.float32)
    check(tmp_path / "a.hdr")
    # whole numbers with a scale factor, as reflectances are often stored; most significant byte first
    header = {"wavelength": list(BANDS), "wavelength units": "nm", "reflectance scale factor": 10000}
    codes = np.rint(CUBE * 10000).astype(np.uint16)
    envi.save_image(str(tmp_path / "b.hdr"), codes, interleave=interleave, metadata=header, byteorder=1)
    check(tmp_path / "b.hdr", codes / np.float32(10000))
    envi.save_image(str(tmp_path / "c.hdr"), CUBE, dtype=np.float32)
    with pytest.raises(SpecError, match="says no wavelengths"):
        open_cube(tmp_path / "c.hdr")
    check(tmp_path / "c.hdr", wavelength_nm=BANDS.tolist())
    # fewer values than the header says
    (tmp_path / "a.img").write_bytes((tmp_path / "a.img").read_bytes()[:-400])
    with pytest.raises(SpecError, match=r"a\.hdr: cannot be read"):
        open_cube(tmp_path / "a.hdr").whole()
    (tmp_path / "a.img").unlink()
    with pytest.raises(SpecError, match=r"a\.hdr: cannot be read"):
        open_cube(tmp_path / "a.hdr")


def test_matlab_v5_of_harvard_and_foster(tmp_path):
    scipy.io.savemat(tmp_path / "harvard.mat", {"ref": CUBE.astype(float), "lbl": np.ones((7, 5))})
    check(tmp_path / "harvard.mat", bands=420 + 10.0 * np.arange(31))
    for count, first in ((33, 400.0), (32, 410.0), (31, 410.0)):
        wide = np.concatenate([CUBE, CUBE[..., :2]], axis=2)[..., :count]
        scipy.io.savemat(tmp_path / f"foster{count}.mat", {"reflectances": wide})
        check(tmp_path / f"foster{count}.mat", wide, first + 10.0 * np.arange(count))
    scipy.io.savemat(tmp_path / "other.mat", {"cube": CUBE[..., :9]})
    with pytest.raises(SpecError, match="says no wavelengths"):
        open_cube(tmp_path / "other.mat")
    scipy.io.savemat(tmp_path / "none.mat", {"picture": np.ones((3, 3))})
    with pytest.raises(SpecError, match=r"expected one of cube, rad, ref.*; found picture"):
        open_cube(tmp_path / "none.mat")


def test_matlab_v5_is_refused_where_it_is_too_large(tmp_path, monkeypatch):
    scipy.io.savemat(tmp_path / "large.mat", {"ref": np.zeros((40, 50, 31)), "lbl": np.ones((40, 50))})
    monkeypatch.setattr(matlab_cube, "MOST_MATLAB_BYTES", 500_000)
    with pytest.raises(SpecError, match=r"MATLAB v5 file is read whole; this one would take 0\.000512 GB"):
        open_cube(tmp_path / "large.mat")


def test_isetcam_scenes(tmp_path):
    rng = np.random.default_rng(3)
    basis, coefficients, mean = rng.normal(size=(31, 4)), rng.normal(size=(7, 5, 4)), rng.uniform(5, 6, 31)
    photons = coefficients @ basis.T + mean
    light = np.linspace(1, 2, 31)
    scipy.io.savemat(tmp_path / "iset.mat", {
        "mcCOEF": coefficients, "basis": {"wave": BANDS, "basis": basis}, "imgMean": mean,
        "illuminant": {"data": light, "wave": BANDS},
    })  # fmt: skip
    found = check(tmp_path / "iset.mat", (photons / BANDS).astype(np.float32), rtol=1e-5)
    np.testing.assert_allclose(found.illuminant, light / BANDS)
    scipy.io.savemat(tmp_path / "photons.mat", {"photons": photons, "wave": BANDS})
    check(tmp_path / "photons.mat", (photons / BANDS).astype(np.float32), rtol=1e-6)
    scipy.io.savemat(tmp_path / "bad.mat", {"mcCOEF": coefficients, "basis": {"wave": BANDS[:-1], "basis": basis}})
    with pytest.raises(SpecError, match="does not fit 30 wavelengths"):
        open_cube(tmp_path / "bad.mat")
    # the same saved as v7.3: axes in the opposite order, the structure as a group
    with h5py.File(tmp_path / "iset73.mat", "w") as file:
        file["mcCOEF"], file["imgMean"] = coefficients.transpose(2, 1, 0), mean[:, None]
        file["basis/wave"], file["basis/basis"] = BANDS[None], basis.T
    check(tmp_path / "iset73.mat", (photons / BANDS).astype(np.float32), rtol=1e-5)
    with h5py.File(tmp_path / "photons73.mat", "w") as file:
        file["photons"], file["wave"] = photons.transpose(2, 1, 0), BANDS
    check(tmp_path / "photons73.mat", (photons / BANDS).astype(np.float32), rtol=1e-6)
    with h5py.File(tmp_path / "alone.mat", "w") as file:
        file["mcCOEF"] = coefficients
    with pytest.raises(SpecError, match="needs a structure basis"):
        open_cube(tmp_path / "alone.mat")


def test_matlab_v73_of_arad_and_icvl(tmp_path):
    """MATLAB stores its arrays [row, col, band] with the axes in the opposite order."""
    with h5py.File(tmp_path / "arad.mat", "w", userblock_size=512) as file:
        file["cube"], file["bands"] = CUBE.transpose(2, 1, 0), BANDS[:, None]
        file["norm_factor"] = np.array([[2.0]])
    check(tmp_path / "arad.mat")
    matlab = np.random.default_rng(4).uniform(0, 4095, (5, 7, 31)).astype(np.float32)
    with h5py.File(tmp_path / "icvl.mat", "w") as file:
        file.create_dataset("rad", data=matlab.transpose(2, 1, 0), chunks=(1, 3, 5), compression="gzip")
        file["bands"] = BANDS
    check(tmp_path / "icvl.mat", np.rot90(matlab))  # upright after a turn against the clock
    with h5py.File(tmp_path / "linked.mat", "w") as file:
        file["cube"] = h5py.ExternalLink("arad.mat", "cube")
    with pytest.raises(SpecError, match="link to elsewhere"):
        open_cube(tmp_path / "linked.mat")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["image"] = np.zeros((3, 3))
    with pytest.raises(SpecError, match=r"expected a data set cube, .*found image"):
        open_cube(tmp_path / "other.h5")


def test_cave_folders(tmp_path):
    codes = np.rint(CUBE * 65535).astype(np.uint16)
    for band in range(31):
        Image.fromarray(codes[..., band]).save(tmp_path / f"toy_ms_{band + 1:02}.png")
    Image.new("RGB", (5, 7)).save(tmp_path / "toy_RGB.bmp")
    check(tmp_path, codes / np.float32(65535))
    # watercolors_ms: 8 bits, with alpha
    (tmp_path / "water").mkdir()
    for band in range(31):
        grey = Image.fromarray((codes[..., band] >> 8).astype(np.uint8))
        Image.merge("RGBA", [grey, grey, grey, Image.new("L", (5, 7), 255)]).save(
            tmp_path / "water" / f"water_ms_{band + 1:02}.png"
        )
    check(tmp_path / "water", (codes >> 8) / np.float32(255))
    Image.fromarray(codes[:6, :, 6]).save(tmp_path / "toy_ms_07.png")
    with pytest.raises(SpecError, match="its pictures differ in size"):
        open_cube(tmp_path)
    (tmp_path / "toy_ms_07.png").unlink()
    with pytest.raises(SpecError, match=r"NAME_ms_01.png, 02"):
        open_cube(tmp_path)


def test_exr_whose_bands_have_other_pixels_is_refused(tmp_path):
    """One band of three has half as many columns and rows."""
    plane = np.full((8, 12), 0.3, np.float32)
    OpenEXR.File({}, {f"w{nm}nm": plane for nm in (400, 500, 600)}).write(str(tmp_path / "even.exr"))
    whole = (tmp_path / "even.exr").read_bytes()
    place = whole.index(b"w500nm\0") + len(b"w500nm\0") + 8  # behind type, flag and 3 bytes: x and y sampling
    assert whole[place : place + 8] == np.array([1, 1], "<i4").tobytes()
    (tmp_path / "uneven.exr").write_bytes(whole[:place] + np.array([2, 2], "<i4").tobytes() + whole[place + 8 :])
    with pytest.raises(SpecError, match="its channels do not have the same pixels"):
        open_cube(tmp_path / "uneven.exr")


def test_exr_of_kaist_and_of_the_renderer(tmp_path):
    bands = 420 + 10.0 * np.arange(31)
    channels = {f"w{band:.0f}nm": np.ascontiguousarray(CUBE[..., k]) for k, band in enumerate(bands)}
    half = {name: plane.astype(np.float16) for name, plane in channels.items()}
    OpenEXR.File({}, channels).write(str(tmp_path / "kaist.exr"))
    check(tmp_path / "kaist.exr", bands=bands)
    # halves, in a window that does not begin at 0
    window = np.array([3, 10], np.int32), np.array([7, 16], np.int32)
    OpenEXR.File({"dataWindow": window}, half).write(str(tmp_path / "part.exr"))
    check(tmp_path / "part.exr", CUBE.astype(np.float16).astype(np.float32), bands)
    hr.write_spectral_exr(tmp_path / "ours.exr", CUBE, BANDS)
    check(tmp_path / "ours.exr")


def test_npy_is_mapped_and_needs_wavelengths(tmp_path):
    np.save(tmp_path / "cube.npy", CUBE)
    check(tmp_path / "cube.npy", wavelength_nm=BANDS.tolist())
    for wavelengths, message in (
        (None, "says no wavelengths"), (BANDS[:-1].tolist(), "31 planes and wavelength_nm 30"),
        (BANDS[::-1].tolist(), "must increase"),
    ):  # fmt: skip
        with pytest.raises(SpecError, match=message):
            open_cube(tmp_path / "cube.npy", wavelengths)
    bad = CUBE.copy()
    bad[3, 2, 1] = np.nan
    np.save(tmp_path / "bad.npy", bad)
    opened = open_cube(tmp_path / "bad.npy", BANDS.tolist())
    opened.rows(0, 3)
    with pytest.raises(SpecError, match="not finite"):
        opened.rows(3, 4)
    np.save(tmp_path / "flat.npy", CUBE[..., 0])
    with pytest.raises(SpecError, match=r"expected numbers \[row, col, wavelength\]"):
        open_cube(tmp_path / "flat.npy", BANDS.tolist())
    with pytest.raises(SpecError, match="no such file"):
        open_cube(tmp_path / "missing.npy", BANDS.tolist())
    with pytest.raises(SpecError, match=r"must be one of \.hdr"):
        open_cube(tmp_path / "cube.raw")
    (tmp_path / "damaged.mat").write_bytes(b"MATLAB 5.0 MAT-file" + bytes(200))
    with pytest.raises(SpecError, match=r"damaged\.mat"):
        open_cube(tmp_path / "damaged.mat")
