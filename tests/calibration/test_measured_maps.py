"""Measured maps of a part of a sensor whose tile, event grid, region and crop are all different in rows and columns."""

import numpy as np
import pytest

from hesim_render.calibration.measured import MeasuredMaps
from hesim_render.calibration.spec import Defect
from hesim_render.core.errors import SpecError
from hesim_render.mosaic.layout import Layout
from hesim_render.pixels.measured import frame_maps, measured_part, relative_threshold, telegraph_rates
from hesim_render.sensor.reading import read_sensor
from hesim_render.specs.geometry import Region

#: 2 rows of 3 pixels with an event pixel in each row; rows 4 to 23 and columns 9 to 41 were captured.
ROWS, COLS, REGION = 40, 66, Region(x=9, y=4, width_px=33, height_px=20)


def layout(**changed):
    spec = read_sensor("mipi-hybridevs", {"geometry.rows": ROWS, "geometry.cols": COLS, "tile": "R e G\nB G e"})
    rng = np.random.default_rng(6)
    frames = {name: rng.normal(5, 2, (20, 33)) for name in ("n_blc", "n_dp", "response")}
    frames |= {"n_row": rng.normal(5, 2, 20), "telegraph_amplitude_dn": rng.uniform(1, 3, (20, 33))}
    frames |= {"telegraph_high_share": rng.random((20, 33)), "telegraph_correlation": rng.random((20, 33))}
    events = {name: rng.normal(1.3, 0.2, (20, 11)) for name in ("threshold_on_rel", "threshold_off_rel")}
    events["bad_pixels"] = rng.random((20, 11)) < 0.1
    sections = {"aps": frames, "evs": events | changed}
    maps = MeasuredMaps("", "c.yaml", REGION, sections, {"aps": 0.04, "evs": 0.003})
    return Layout.full(spec.model_copy(update={"noise": "c.yaml"}), maps), sections


def test_the_region_of_the_maps_is_cut_in_pixels_and_in_event_pixels():
    whole, sections = layout()
    part = measured_part(whole)
    assert (part.row0, part.col0, part.rows, part.cols) == (4, 9, 20, 33)
    crop = part.crop(15, 6, 12, 8)
    here = np.s_[8:14, 12:27]
    found = frame_maps(crop)
    for name in ("n_blc", "n_dp", "response"):
        np.testing.assert_array_equal(found[name], sections["aps"][name][here].astype(np.float32))
    np.testing.assert_array_equal(found["n_row"], sections["aps"]["n_row"][8:14, None].astype(np.float32))
    # correlation c from frame to frame, 40 ms apart: the state changes at −ln c/0.04 s
    telegraph = telegraph_rates(crop)
    np.testing.assert_allclose(telegraph.change_hz, -np.log(sections["aps"]["telegraph_correlation"][here]) / 0.04)
    for polarity in ("on", "off"):
        values, good = sections["evs"][f"threshold_{polarity}_rel"], ~sections["evs"]["bad_pixels"]
        expected = 1 + (values - values[good].mean()) / values[good].std() * 0.07
        np.testing.assert_allclose(relative_threshold(crop, polarity, 0.07), expected[8:14, 4:9], rtol=1e-6)


def test_pixels_with_events_of_their_own_have_the_mean_threshold():
    defect = np.zeros((20, 11), np.uint8)
    defect[3, 7], defect[12, 2], defect[5, 5] = Defect.HOT, Defect.FLICKERING, Defect.STUCK
    plain, found = (
        relative_threshold(measured_part(layout(**given)[0]), "off", 0.07) for given in ({}, {"defect": defect})
    )
    own = np.isin(defect, (Defect.HOT, Defect.FLICKERING))
    np.testing.assert_array_equal(found, np.where(own, 1, plain))
    assert np.all(plain[own] != 1)


def test_maps_of_another_size_are_refused_with_the_size_that_fits():
    whole, _ = layout(threshold_on_rel=np.ones((11, 20)))
    with pytest.raises(SpecError, match=r"is of size \(11, 20\), the region captured of \(20, 11\)"):
        relative_threshold(measured_part(whole), "on", 0.07)


@pytest.mark.parametrize(("name", "largest"), [
    ("n_row", 65535), ("n_blc", 65535), ("n_dp", 1e9), ("response", 1e3), ("telegraph_amplitude_dn", 65535),
    ("telegraph_high_share", 1), ("telegraph_correlation", 1), ("threshold_on_rel", 1e3),
])  # fmt: skip
def test_values_of_maps_have_a_largest_size(name, largest):
    def read(value):
        whole, sections = layout()
        of_events = name.startswith("threshold")
        sections["evs" if of_events else "aps"][name].flat[7] = value
        part = measured_part(whole)
        return relative_threshold(part, "on", 0.07) if of_events else (frame_maps(part), telegraph_rates(part))

    read(-largest if name[0] in "nr" else largest)
    with pytest.raises(SpecError, match=f"map {name} holds values that are not finite, or beyond"):
        read(1.001 * largest)
