"""Few rays that tell in which ticks pixels without neighbours show anything new, and pilots that are used again."""

from types import SimpleNamespace

import numpy as np
import pytest
from rendering import make_scene
from test_change_driven import ball_before_a_wall, fluxes
from test_differences import shadow_scene

import hesim_render as hr
from hesim_render.core.backend import jit
from hesim_render.core.host_arrays import from_host
from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven import one_window
from hesim_render.sources.render.change_driven import pilot as pilots
from hesim_render.sources.render.change_driven.adaptive import AdaptiveRenderer
from hesim_render.sources.render.change_driven.change_detector import windows_with_changes
from hesim_render.sources.render.change_driven.error_target import Noise
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.kept_pilots import Anchored
from hesim_render.sources.render.change_driven.neighbours import Lattice, Sites
from hesim_render.sources.render.change_driven.pair_flux import PilotFlux, PilotRays
from hesim_render.sources.render.change_driven.pilot import take_pilot
from hesim_render.sources.render.change_driven.windows import Windows

#: Wanted error, e⁻/s; a pixel is even up to six times this scatter, and more than it is a change.
WANTED = 6.0
COUNT, SITES = 10, 7


class Detected:
    """A tracer of pixels with the flux `light` [window, site]: the plain estimator is brighter by 5, and the set of
    rays with number 1 does not see what changes in site 4. `spread` replaces the scatter of the controlled estimator.
    """

    camera, knows_shadows = None, False

    def __init__(self, light, scatter=(24.0, 42.0), near=True, spread=None):
        self.light, self.scatter, self.near, self.traced, self.spread = light, scatter, near, [], spread
        self.rays, self.parts, self.mild = SimpleNamespace(spreads=False), SimpleNamespace(groups=[]), set()

    def pilot(self, index, window, windows, rays, width_px, stream=Stream.RENDER_PILOT, span_us=None, before=None,
              mild=False, repeat=0, shadows=None):  # fmt: skip
        self.mild.add(mild)
        pairs = zip(window.tolist(), index.tolist(), strict=True)
        self.traced += [(int(stream), rays, width_px, repeat, *pair) for pair in pairs]
        found = PilotFlux.empty(index.size)
        light = self.light[window, index]
        if repeat == 1:
            light = np.where(index == 4, self.light[0, index], light)
        found.controlled[:], found.plain[:] = light, light + 5
        found.controlled_scatter[:], found.plain_scatter[:] = self.scatter
        if self.spread is not None:
            found.controlled_scatter[:] = self.spread[window, index]
        found.met[:] = self.near
        return found

    def looked(self, rays):
        return sorted((window, index) for *_, count, _, _, window, index in self.traced if count == rays)


def light_of(sites=SITES, **changes):
    """Flux of all sites in all windows; `s3=(5, 12.0)` changes site 3 in window 5 by 12, `s3=(5, 8, 12.0)` in windows 5
    to 7.
    """
    light = np.full((COUNT, sites), 800.0, np.float32)
    for name, (window, *end, by) in changes.items():
        light[window : end[0] if end else window + 1, int(name[1:])] += by
    return light


def wanted_error(flux):
    """In proportion to the light, less below 796."""
    return np.where(flux > 796, WANTED * flux / 800, np.where(flux > 600, 4, 3)).astype(np.float32)


def found_by(light, sites=None, first=(35.4, 42.0), near=True, spread=None, mild=False, stride=1):
    sites = Sites.alone(np.arange(light.shape[1], dtype=np.uint32)) if sites is None else sites
    tracer, seen = Detected(light, spread=spread), PilotFlux.empty(sites.size)
    seen.controlled[:], seen.plain[:] = 800, 805
    seen.controlled_scatter[:], seen.plain_scatter[:] = first
    numbers = np.repeat(np.arange(COUNT)[:, None], sites.size, axis=1)
    windows = Windows(np.arange(COUNT) * 4.0, np.arange(COUNT) * 4.0 + 3)
    near = np.ones(sites.size, bool) & near
    given = tracer, sites, numbers, windows, seen, near, wanted_error, 1.6, mild
    marked = windows_with_changes(*given, stride=stride)
    return tracer, sorted(zip(*(each.tolist() for each in np.nonzero(marked)), strict=True))


def windows_of(found, site):
    return [window for window, each in found if each == site]


def test_windows_beside_a_change_are_looked_at():
    """More than the wanted error of 6 counts. A set of rays that saw a brief change sees its end two windows later;
    the first and the last window are no part of this.
    """
    _, found = found_by(light_of(s3=(5, -7.0), s1=(4, 5.5), s2=(1, 90.0), s6=(9, 90.0)))
    assert windows_of(found, 2) == [1, 2, 3, 4] and windows_of(found, 3) == [4, 5, 6, 7, 8] and len(found) == 9


def test_what_stays_after_a_change_is_not_looked_at_again():
    _, found = found_by(light_of(s3=(4, COUNT, 300.0), s5=(4, COUNT, -100.0)))
    # window 4 by one set, 5 by the other, and those beside
    assert windows_of(found, 3) == windows_of(found, 5) == [3, 4, 5, 6]
    # 5 less are no change for what was seen before, though the error that is wanted there is smaller
    assert not windows_of(found_by(light_of(s3=(4, COUNT, -5.0)))[1], 3)
    # beyond the change the error wanted there counts, 8.25
    for by, windows in ((8.0, [3, 4, 5, 6]), (8.5, [3, 4, 5, 6, 7, 8])):
        light = light_of(s3=(4, COUNT, 300.0))
        light[7:, 3] += by
        assert windows_of(found_by(light)[1], 3) == windows


def test_windows_take_turns_between_two_sets_of_rays():
    """Sites of even windows are seen by the second set, which misses a change of site 4; eight rays each, once in the
    first window.
    """
    tracer, found = found_by(light_of(s4=(6, 90.0), s5=(6, 90.0)))
    assert found == [(window, 5) for window in (5, 6, 7, 8)]
    _, found = found_by(light_of(s4=(5, 90.0)))
    assert found == [(window, 4) for window in (4, 5, 6, 7, 8)]
    sets = {(repeat, window) for _, _, _, repeat, window, _ in tracer.traced}
    assert sets == {(0, w) for w in (0, 1, 3, 5, 7)} | {(1, w) for w in (0, 2, 4, 6, 8)}
    assert len(tracer.traced) == len(sets) * SITES
    assert {each[:3] for each in tracer.traced} == {(int(Stream.RENDER_DETECTOR), 8, 1.6)}


def test_pixels_whose_rays_differ_are_looked_at_in_all_windows():
    """Six times the wanted error of 6 is even; nothing is looked at where nothing may change."""
    scatter = np.full(SITES, 35.4), np.full(SITES, 42.0)
    scatter[0][3] = 36.6
    scatter[0][[2, 5]], scatter[1][[2, 5]] = 54, (35.4, 37.8)
    near = np.arange(SITES) != 6
    tracer, found = found_by(light_of(s1=(2, 3, 50.0), s6=(2, 50.0)), first=scatter, near=near)
    inner = range(1, COUNT - 1)
    assert windows_of(found, 3) == windows_of(found, 5) == list(inner)
    assert windows_of(found, 1) == [1, 2, 3, 4, 5] and not windows_of(found, 6) and not windows_of(found, 2)
    assert not {3, 5, 6} & {index for *_, index in tracer.traced} and tracer.mild == {False}
    # a mild scatter is that of one ray in 32, whose fourth root is 0.42
    scatter[0][[1, 4]], scatter[1][[1, 4]] = (15.0, 15.3), 42
    scatter[0][[0, 2, 3, 5, 6]] = 12
    tracer, found = found_by(light_of(), first=scatter, mild=True, spread=np.full((COUNT, SITES), 12.0, np.float32))
    assert {site for _, site in found} == {4} and tracer.mild == {True}
    spread = np.full((COUNT, SITES), 12.0, np.float32)
    spread[3:5, 2], spread[3:5, 5] = 15.0, 15.3
    _, found = found_by(light_of(), first=(12.0, 42.0), mild=True, spread=spread)
    assert {site for _, site in found} == {5}


def test_windows_in_which_few_rays_differ_are_looked_at():
    """A window whose light is the same on the mean, at an edge that goes through the pixel."""
    spread = np.full((COUNT, SITES), 24.0, np.float32)
    spread[3, 2], spread[6, 5] = 35.4, 41.4
    # of the second set, plain rays scatter less there, and are brighter by 5: that is no change
    _, found = found_by(light_of(), spread=spread)
    assert found == [(5, 5), (6, 5), (7, 5)]


def board(rows=3, cols=5, step=(1, 1)):
    """Sites of all pixels of a small sensor, or of all that lie on a lattice."""
    first = (0, 0) if step == (1, 1) else (1, 2)
    lattice = Lattice(rows, cols, first, step, cols * step[1] + first[0])
    row, col = np.divmod(np.arange(rows * cols), cols)
    return Sites.around(lattice.index(row, col), lattice)


def test_each_site_is_looked_at_from_its_own_last_look_on():
    """The light of all changes in window 8, in which few rays look everywhere: sites of one field looked in window 7,
    those of the other in 6, and looks begin one window before what was not looked at.
    """
    sites = board()
    _, found = found_by(light_of(sites.size, **{f"s{site}": (8, 90.0) for site in range(sites.size)}), sites)
    odd = np.add(*np.divmod(np.arange(sites.size), 5)) % 2 == 1
    for site in range(sites.size):
        assert windows_of(found, site) == ([6, 7, 8] if odd[site] else [7, 8])


@pytest.mark.parametrize("step", [(1, 1), (2, 3)])
def test_neighbours_take_turns_like_the_fields_of_a_chequered_board(step):
    """Each site in about half of the windows, never in the same as the four beside it; all in the first and in the
    last but one; over three windows each site or the four beside it is always looked at.
    """
    sites = board(step=step)
    tracer, found = found_by(light_of(int(sites.index[-1]) + 1), sites)
    assert not found
    looked = np.zeros((COUNT, sites.size), bool)
    for *_, repeat, window, index in tracer.traced:
        assert repeat == 0
        looked[window, np.searchsorted(sites.index, index)] = True
    looked = looked.reshape(COUNT, 3, 5)
    assert looked[0].all() and looked[COUNT - 2].all() and not looked[-1].any()
    inner = looked[1 : COUNT - 2]
    # at most two windows in a row, and no turn that a motion of a pixel a window keeps pace with
    assert inner[:, 0, 0].tolist() == [True, True, False, True, False, False, True]
    assert np.all(inner[:, 1:] ^ inner[:, :-1]) and np.all(inner[:, :, 1:] ^ inner[:, :, :-1])


def test_what_a_site_misses_its_neighbours_see():
    """Site 7, in the middle, is looked at in windows 3, 5, 6 and 8."""
    sites = board()
    tracer, _ = found_by(light_of(15), sites)
    assert sorted(window for *_, window, index in tracer.traced if index == 7) == [0, 3, 5, 6, 8]
    # what comes and stays is seen the next time, and all windows since the last look are suspects
    for come, windows in ((2, [1, 2, 3, 4]), (4, [3, 4, 5, 6]), (7, [6, 7, 8])):
        _, found = found_by(light_of(15, s7=(come, COUNT, 90.0)), sites)
        assert windows_of(found, 7) == windows
    # in a window in which it is not looked at, a change beside it or diagonally is enough, two columns away is not
    for site, is_near in ((8, True), (2, True), (6, True), (12, True), (5, False), (0, False), (14, False)):
        _, found = found_by(light_of(15, **{f"s{site}": (2, 90.0)}), sites)
        assert (2 in windows_of(found, 7)) == is_near, site
    # in a window in which it is looked at, what it shows itself counts
    _, found = found_by(light_of(15, s13=(3, 90.0)), sites)
    assert 3 in windows_of(found, 13) and 3 not in windows_of(found, 7)
    # windows that a site only suspects say nothing of those beside it, nor does it look where nothing may change
    _, found = found_by(light_of(15, s8=(4, COUNT, 90.0)), sites, near=np.arange(15) != 3)
    assert windows_of(found, 8) == [2, 3, 4, 5] and 3 not in windows_of(found, 12) and not windows_of(found, 3)
    assert 4 in windows_of(found, 7)


@pytest.mark.parametrize("stride", [2, 4])
def test_where_things_move_slowly_few_rays_look_less_often(stride):
    """In every second or fourth window a site or the four beside it are looked at; what came since is a suspect."""
    tracer, _ = found_by(light_of(15), board(), stride=stride)
    looked = np.zeros((COUNT, 15), bool)
    for *_, window, index in tracer.traced:
        looked[window, index] = True
    windows = np.flatnonzero(looked.any(axis=1)).tolist()
    assert windows == ([0, 2, 4, 6, 8] if stride == 2 else [0, 4, 8])
    assert looked[0].all() and looked[8].all()
    fields = looked[windows[1:-1]].reshape(-1, 3, 5)
    assert np.all(fields[:, 1:] ^ fields[:, :-1]) and np.all(fields[:, :, 1:] ^ fields[:, :, :-1])
    # the sequence of Thue and Morse over the steps: 1, 1, 0 for the fields that begin
    own = [w for w in windows if looked[w, 7]]
    assert own == ([0, 6, 8] if stride == 2 else [0, 8])
    _, found = found_by(light_of(15, s7=(5, COUNT, 90.0)), board(), stride=stride)
    assert windows_of(found, 7) == ([1, 2, 3, 4, 5, 6, 7] if stride == 2 else list(range(1, COUNT - 1)))


@pytest.mark.parametrize(("few_stride", "inner"), [(1, [1, 2, 3, 4, 5, 6, 7]), (2, [2, 4, 6]), (4, [4])])
def test_the_pilot_says_how_often_few_rays_look(few_stride, inner):
    tracer, sites = Detected(light_of(15)), board()
    numbers = np.repeat(np.arange(COUNT)[:, None], 15, axis=1)
    windows = Windows(np.arange(COUNT) * 4.0, np.arange(COUNT) * 4.0 + 3)
    take_pilot(tracer, sites, windows, numbers, 16, 1.6, None, wanted=wanted_error, few_stride=few_stride)
    assert sorted({window for window, _ in tracer.looked(8)} - {0, 8}) == inner


def pilot_by(tracer, rays, anchored=None, known=None, span_us=None, stride=1, mild=False):
    sites = Sites.alone(np.arange(SITES, dtype=np.uint32))
    numbers = np.repeat(np.arange(COUNT)[:, None], SITES, axis=1)
    windows = Windows(np.arange(COUNT) * 4.0, np.arange(COUNT) * 4.0 + 3)
    given = sites, windows, numbers, rays, 1.6, span_us

    def wanted(flux):
        return np.full(flux.shape, WANTED, np.float32)

    return take_pilot(tracer, *given, anchored=anchored, known=known, stride=stride, wanted=wanted, mild=mild)[0]


def test_a_pilot_of_many_rays_looks_where_few_see_a_change_and_at_the_end():
    light = light_of(s3=(5, 44.0), s6=(9, 71.0))
    tracer = Detected(light)
    pilot = pilot_by(tracer, 32)
    np.testing.assert_array_equal(pilot.controlled, light)
    ends = [(window, site) for window in (0, 9) for site in range(SITES)]
    assert tracer.looked(32) == sorted([*ends, *((window, 3) for window in range(4, 9))]) and tracer.looked(8)
    # few rays do not look at a sensor without a tick, nor where the pilot has no more
    for rays, stride in ((8, 1), (32, 3)):
        tracer = Detected(light)
        pilot_by(tracer, rays, stride=stride)
        assert Stream.RENDER_DETECTOR not in {each[0] for each in tracer.traced}
    # pixels with neighbours have sixteen
    tracer = Detected(light)
    pilot_by(tracer, 16)
    assert Stream.RENDER_DETECTOR in {each[0] for each in tracer.traced}


def test_windows_between_looks_show_what_the_one_before_does():
    """A step of site 3 is looked at in four windows; later ones keep the light, and how its rays changed since the
    first window. Those before have that of the first, from which they do not differ.
    """
    light = light_of(s3=(4, COUNT, 300.0))
    tracer, zeros = Detected(light), from_host(jit().Float, np.zeros(32 * SITES, np.float32))
    own = tracer.pilot

    def pilot(index, window, *given, **more):
        found = own(index, window, *given, **more)
        found.unshadowed[:], found.controlled_change[:], found.plain_change[:] = 900 + window, 10 + window, 30 + window
        return found

    tracer.pilot = pilot
    tracer.pilot_rays = lambda *given, span_us=None, before=None, mild=False: (
        pilot(*given),
        PilotRays(zeros, zeros, 32, (0.0, 3)),
    )
    known = PilotRays(zeros, zeros, 32, (-4.0, -1.0))
    anchored = Anchored(pilot(np.arange(SITES), np.zeros(SITES, int), None, 32, 1.6), known, (-4.0, -1.0))
    taken = pilot_by(tracer, 32, anchored=anchored)
    np.testing.assert_array_equal(taken.controlled, light)
    assert taken.unshadowed[:, 3].tolist() == [900, 900, 900, 903, 904, 905, 906, 906, 906, 909]
    assert taken.change.controlled_scatter[:, 3].tolist() == [10, 0, 0, 13, 14, 15, 16, 16, 16, 19]
    assert taken.change.plain_scatter[:, 2].tolist() == [30, *[0] * 8, 39]


def test_a_block_that_begins_with_its_anchor_takes_its_pilot():
    """Of another window, or where the pilot did not look at the whole time, the first window is traced."""
    zeros, first = from_host(jit().Float, np.zeros(16 * SITES, np.float32)), PilotFlux.empty(SITES)
    first.controlled[:], first.plain[:], first.met[:] = 640.0, 655.0, True
    first.plain_scatter[:] = 9.0
    rays = PilotRays(zeros, zeros, 16, (0.0, 3.0))
    for window_us, near_us, is_known in (
        ((0.0, 3.0), (0.0, 39.0), True), ((0.0, 3.0), (-np.inf, np.inf), True), ((0.0, 2.0), (0.0, 39.0), False),
        ((0.0, 3.0), (0.0, 38.0), False), ((0.0, 3.0), (1.0, 39.0), False), ((0.0, 3.0), None, False),
    ):  # fmt: skip
        tracer = Detected(light_of())
        tracer.pilot_rays = lambda *given, span_us=None, before=None, mild=False, tracer=tracer: (
            tracer.pilot(*given),
            rays,
        )
        anchored = Anchored(first, rays, window_us, near_us)
        pilot = pilot_by(tracer, 16, anchored=anchored, span_us=(0.0, 39.0))
        assert pilot.controlled[0, 2] == (640 if is_known else 800), (window_us, near_us)
        assert any(count == 16 and window == 0 for _, count, _, _, window, _ in tracer.traced) != is_known
        assert np.all(pilot.change.controlled[0] == pilot.controlled[0] - 640)


@pytest.mark.parametrize("mild", [False, True])
def test_all_looks_take_the_same_scatter(mild):
    for rays, stride in ((32, 1), (8, 1), (8, 4)):
        tracer = Detected(light_of(s3=(5, 44.0)))
        pilot_by(tracer, rays, stride=stride, mild=mild)
        assert tracer.mild == {mild}
    # with the pilot of an anchor
    zeros = from_host(jit().Float, np.zeros(SITES * 32, np.float32))
    rays, told = PilotRays(zeros, zeros, 32, (0.0, 3.0)), set()
    tracer = Detected(light_of(s3=(5, 44.0)))

    def pilot_rays(*given, span_us=None, before=None, mild=False):
        told.add(mild)
        return tracer.pilot(*given, mild=mild), rays

    tracer.pilot_rays = pilot_rays
    anchored = Anchored(PilotFlux.empty(SITES), rays, (900.0, 903.0))
    pilot_by(tracer, 32, anchored=anchored, mild=mild)
    assert tracer.mild == told == {mild}


@pytest.mark.parametrize(("name", "depth", "events", "others"), [
    ("davis346", 2, True, False), ("gen2", 2, True, False), ("reference-mono", 2, False, False),
    ("davis346", 4, False, False), ("gen2", 4, False, False),
])  # fmt: skip
def test_who_takes_the_mild_scatter(name, depth, events, others):
    """Event pixels in whose windows no edge goes far, or whose pilot starts in a wide area; under direct light."""
    scene = hr.load_scene("rotating-star", {"max_depth": depth})
    renderer = ChangeDrivenFlux(scene, hr.load_sensor(name).crop(16, 8), seed=4)._renderer
    for role, mild in (("events", events), ("any", others)):
        assert {band.mild for band in renderer.bands(np.arange(8, dtype=np.uint32), role)} == {mild}


def test_a_known_first_window_is_not_traced():
    tracer, known = Detected(light_of(), near=False), PilotFlux.empty(SITES)
    known.controlled[:], known.met[:] = 533.0, False
    assert np.all(pilot_by(tracer, 16, known=known).controlled == 533) and not tracer.traced


@pytest.mark.parametrize(
    ("name", "changes", "expected"),
    [
        ("davis346", {}, ((0, 0), (1, 1), 260, 346)),
        ("gen2", {}, ((1, 2), (4, 4), 612, 816)),
        ("eiger", {}, ((1, 1), (2, 2), 1224, 1632)),
        # rows 0 and 3 of four are no lattice, nor are two pixels on a diagonal
        ("gen2", {"tile": "R R w G\nR R G G\nG G B B\nG G w B\n", "evs_grid.rows_per_tile": 2}, None),
        ("gen2", {"tile": "w R G G\nR R G G\nG G w B\nG G B B\n", "evs_grid.rows_per_tile": 2}, None),
    ],
)
def test_event_pixels_lie_on_a_lattice_or_on_none(name, changes, expected):
    lattice = Noise(hr.load_sensor(name, changes)).lattice("events")
    assert (lattice and (lattice.first, lattice.step, lattice.rows, lattice.cols)) == expected


def test_a_lattice_that_the_sensor_cuts_ends_with_its_last_pixel():
    lattice = Noise(hr.load_sensor("gen2", {"geometry.rows": 52, "geometry.cols": 56})).lattice("events")
    assert (lattice.rows, lattice.cols) == (13, 14)
    assert lattice.index(np.array([12]), np.array([13])).tolist() == [49 * 56 + 54]
    row, col = lattice.place(np.array([49 * 56 + 54], np.uint32))
    assert (row.tolist(), col.tolist()) == ([12], [13])


def test_pixels_that_lie_apart_have_the_same_flux_in_a_crop():
    """Those around a crop decide with it, and are no part of it."""
    whole = hr.load_sensor("gen2", {"evs.threshold_mismatch_rel": 0.02}).crop(72, 48)
    part = whole.crop(28, 20, 16, 12)
    inner = np.zeros((48 // 4, 72 // 4), bool)
    inner[3:8, 4:11] = True
    scene = shadow_scene(focal_length_mm=0.24)
    every, some = (fluxes(ChangeDrivenFlux(scene, sensor, seed=4), 0, 25_000) for sensor in (whole, part))
    assert np.ptp(some, axis=0).max() > 0.1 * some.max()
    np.testing.assert_array_equal(every[..., inner.ravel()], some)


@pytest.mark.parametrize(("name", "region"), [("gen2", (72, 48, 16, 8)), ("reference-mono", (44, 28, 7, 5))])
def test_ticks_keep_their_flux_with_a_detector(monkeypatch, name, region):
    """A shadow moves over pixels that lie apart, or side by side: the same flux to the bit but in a few pairs, for
    fewer pilot rays.
    """
    sensor = hr.load_sensor(name, {"evs.threshold_mismatch_rel": 0.02}).crop(*region)
    found = []
    for rays in (8, 1000):
        monkeypatch.setattr(pilots, "DETECTOR_RAYS", rays)
        source = ChangeDrivenFlux(shadow_scene(), sensor, seed=4)
        found.append((fluxes(source, 0, 25_000), source.counts.pilot_rays, source))
    (some, fewer, _), (every, most, source) = found
    # [tick, half, pixel]
    assert np.ptp(every, axis=0).max() > 0.2 * every.max() and fewer < 0.85 * most
    unit = source.noise_unit(source.sensor.layout.evs_pixel.ravel(), every.mean(axis=1), True)
    assert np.mean(every != some) < 0.1
    assert np.sqrt(np.mean(((every - some).mean(axis=1) / unit) ** 2)) < 0.05


def test_rays_of_constant_pixels_count_as_those_of_pilots():
    """28 before, 40 more of this band: manifest and estimate have the sum."""
    tracer = SimpleNamespace(rays_done=1000)

    def traced(index, window, windows, rays, width_px, near_us, mild):
        assert (rays, width_px, near_us, mild) == (8, 1.5, (3.0, 9.0), True) and window.tolist() == [0] * 5
        tracer.rays_done += rays * index.size
        return None, None

    tracer.pilot_rays = traced
    own = SimpleNamespace(tracer=tracer, counts=SimpleNamespace(pilot_rays=28), _footprint_px=lambda band: 1.5)
    band = SimpleNamespace(sites=SimpleNamespace(size=5, index=np.arange(5)), pilot_rays=8, mild=True)
    AdaptiveRenderer.pilot_rays(own, band, SimpleNamespace(span_us=(0.0, 10.0)), (3.0, 9.0))
    assert own.counts.pilot_rays == 68


@pytest.mark.parametrize(("px_per_s", "stride"), [(130, 4), (237, 2), (640, 1)])
def test_how_often_few_rays_look_follows_the_motion(monkeypatch, px_per_s, stride):
    """A card that slides in parallel to the picture, with ticks of 1 ms and blocks of 16 of them."""
    card = {"name": "card", "shape": "rectangle", "size_m": [0.07, 0.04, 0], "position_m": [0.01, 0, 0]}
    sensor, asked = hr.load_sensor("reference-mono").crop(24, 16), []
    m_per_s = px_per_s * sensor.spec.geometry.pitch_um * 1e-6 * 0.6 / 0.016  # 0.6 m away, 16 mm
    keys = [{"t_us": 0}, {"t_us": 400_000, "translation_m": [0.4 * m_per_s, 0, 0]}]
    camera = {"origin_m": [0, 0, 0.6], "target_m": [0, 0, 0], "focal_length_mm": 16}
    scene = make_scene(
        objects=[card], light={"type": "uniform", "illuminance_lux": 700}, camera=camera,
        motion=[{"object": "card", "keyframes": keys}],
    )  # fmt: skip
    own = pilots.windows_with_changes
    monkeypatch.setattr(pilots, "windows_with_changes", lambda *given: asked.append(given[-1]) or own(*given))
    source, bounds = ChangeDrivenFlux(scene, sensor, seed=4), []
    bound = source._clock.windows_of_a_pixel
    source._clock.windows_of_a_pixel = lambda *given: bounds.append(given[-1]) or bound(*given)
    # a frame is no block of ticks
    source.mean_flux(np.arange(24 * 16, dtype=np.uint32), 0, 2000.0)
    assert not bounds
    fluxes(source, 0, 16_000)
    assert asked == [stride] and bounds == [16]


def test_few_constant_pixels_go_on_with_the_pilot_of_all(monkeypatch):
    """As many as are constant here, by force: the same flux to the bit, whose first pilot is traced once."""
    sensor = hr.load_sensor("reference-mono", {"evs.threshold_mismatch_rel": 0.02}).crop(40, 24)
    found = []
    for few in (1.0, 0.0):
        monkeypatch.setattr(one_window, "FEW", few)
        source = ChangeDrivenFlux(ball_before_a_wall(), sensor, seed=4)
        found.append((fluxes(source, 0, 6000), source.counts.pilot_rays))
        constant = source.still_pixels(source.sensor.layout.evs_pixel.ravel())
        assert 0.1 < constant.mean() < 0.9
    (some, fewer), (every, most) = found
    np.testing.assert_array_equal(some, every)
    assert np.ptp(some, axis=0).max() > 0 and fewer != most


def test_a_run_begins_with_the_flux_of_its_anchor():
    """The first window is the anchor, which all pixels are rendered in: it takes no ray more, and all rays of a pilot
    there are cast once.
    """
    sensor = hr.load_sensor("gen2").crop(72, 48, 16, 8)
    source = ChangeDrivenFlux(shadow_scene(), sensor, seed=4)
    pixels, traced = source.sensor.layout.evs_pixel.ravel(), []
    blocks = source.sample_blocks(sensor.spec.evs.tick_us, 0, 4 * sensor.spec.evs.tick_us)
    tracer = source._tracer
    for name in ("trace", "pilot"):
        own = getattr(tracer, name)

        def noted(pixel, window, windows, *given, own=own, name=name, **more):
            first = windows.begin_us[window] == -float(sensor.spec.evs.tick_us)
            if name == "trace" or Stream.RENDER_DETECTOR not in given:
                traced.extend((name, int(p)) for p in np.asarray(pixel)[first])
            return own(pixel, window, windows, *given, **more)

        setattr(tracer, name, noted)
    for _ in source.flux_of_blocks(pixels, blocks):
        pass
    # the pilot looks at those around them as well: 12 × 18 of 14 × 20
    assert len(traced) == len(set(traced)) == pixels.size + 14 * 20 and pixels.size == 12 * 18
