"""Copies of colour-science's tables are its tables; they are made anew by ``python tests/spectral/test_named.py``."""

import re

import colour
import numpy as np
import pytest

from hesim_render.core.errors import SpecError
from hesim_render.core.npz import read_arrays
from hesim_render.core.shipped import data_folder
from hesim_render.spectral import spectrum as spectra


def tables():
    """(name of the copy, spectral distributions of colour-science)"""
    yield "V", [colour.SDS_LEFS["CIE 1924 Photopic Standard Observer"]]
    yield "CIE 1931", colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].to_sds()
    yield "sRGB", colour.recovery.MSDS_BASIS_FUNCTIONS_sRGB_MALLETT2019.to_sds()
    for name in ("A", "D50", "D65", "HP1", "LED-B2", "LED-B3"):
        yield f"illuminant {name}", [colour.SDS_ILLUMINANTS[name]]
    yield "camera Nikon 5100 (NPL)", colour.MSDS_CAMERA_SENSITIVITIES["Nikon 5100 (NPL)"].to_sds()
    yield "ColorChecker ISO 17321-1", colour.SDS_COLOURCHECKERS["ISO 17321-1"].values()


def copies():
    """Rows of wavelengths, nm, and values by the name of their array, in the order of colour-science."""
    return {
        f"{table}/{curve.name}": np.array([curve.wavelengths, curve.values], np.float64)
        for table, curves in tables()
        for curve in curves
    }


def test_copies_are_the_tables_of_colour_science():
    kept, own = read_arrays(spectra.NAMED_FILE), copies()
    assert list(kept) == list(own)
    for name, rows in own.items():
        np.testing.assert_array_equal(kept[name], rows)


def test_every_curve_is_the_one_that_was_asked_for(monkeypatch):
    """By its place in the tables of colour-science, whose rows are read here in another way."""
    monkeypatch.setattr(spectra, "colour_science", lambda: pytest.fail("not copied"))
    checker = colour.SDS_COLOURCHECKERS["ISO 17321-1"]
    for name, curve in spectra.colorchecker_reflectances().items():
        assert [tuple(pair) for pair in checker[name]] == list(zip(curve.wavelength_nm, curve.values, strict=True))
    nikon = colour.MSDS_CAMERA_SENSITIVITIES["Nikon 5100 (NPL)"]
    for channel in ("red", "green", "blue"):
        curve = spectra.camera_sensitivity("Nikon 5100 (NPL)", channel)
        np.testing.assert_array_equal(curve.values, nikon.signals[channel].values)
    x, y, z = spectra.colour_matching_functions()
    np.testing.assert_allclose(spectra.photopic().values, y.values, rtol=1e-6)  # some are rounded to six digits
    assert x.at(600) == 1.0622 and y.at(600) == 0.631 and z.at(600) == 0.0008  # CIE 015, table 5
    assert spectra.illuminant("D65").at(560) == 100 and spectra.illuminant("A").at([500, 560])[0] == 59.8611
    red, green, blue = (basis.at([450, 530, 620]) for basis in spectra.srgb_reflectances())
    assert np.all(np.argmax([red, green, blue], axis=0) == [2, 1, 0])


@pytest.mark.parametrize("name", ["V", "sRGB", "ISO 17321-1", "illuminant D65", "Nikon 5100 (NPL)"])
def test_a_table_of_another_kind_is_no_light(name):
    with pytest.raises(SpecError, match="unknown illuminant"):
        spectra.illuminant(name)


def test_shipped_sensors_and_scenes_need_no_other_tables():
    """The import of colour-science takes as long as all else that a command loads."""
    files = [file for kind in ("sensors", "scenes") for file in data_folder(kind).glob("*.yaml")]
    named = re.compile(r'\b((?:illuminant: |colorchecker: |camera: ")\w[^",}\n]*)')
    used = {re.sub('[:"]', "", text).lower() for file in files for text in named.findall(file.read_text())}
    assert len(used) > 4 and used <= {table.lower() for table, _ in tables()}, used


if __name__ == "__main__":
    np.savez_compressed(spectra.NAMED_FILE, **copies())
