"""Where many blocks have one anchor, its pilot tells what comes near in any of them; the others are not asked again."""

import numpy as np
import pytest
import rendering

import hesim_render as hr
from hesim_render.sources.render.change_driven import anchor
from hesim_render.sources.render.change_driven.adaptive import AdaptiveRenderer
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux

SUN = {"type": "directional", "direction": [0.2, 0.1, -1], "illuminance_lux": 1000}
SKY = {"type": "uniform", "illuminance_lux": 700}
PLASTIC = {"material": {"type": "roughplastic", "alpha": 0.3, "diffuse_reflectance": 0.7}}
PLATE = {"shape": "rectangle", "size_m": [0.09, 0.13, 0.0]}


def scene_of(light, thing):
    """Something that crosses the picture at 2 pixels a millisecond before a wall."""
    thing = {"name": "thing", "shape": "sphere", "size_m": [0.1] * 3, "position_m": [0, 0, 0.05], **thing}
    if "material" not in thing:
        thing["reflectance"] = 0.8
    wall = {"name": "wall", "shape": "rectangle", "size_m": [4, 4, 0], "position_m": [0, 0, -0.05], "reflectance": 0.3,
            "pattern": 0.6, "pattern_count": [80, 80]}  # fmt: skip
    keys = [{"t_us": 0, "translation_m": [-0.3, 0, 0]}, {"t_us": 120_000, "translation_m": [0.3, 0, 0]}]
    return rendering.make_scene(
        objects=[wall, thing],
        light=light,
        camera={"origin_m": [0, 0, 2], "target_m": [0, 0, 0], "horizontal_fov_deg": 22.62},
        motion=[{"object": "thing", "keyframes": keys}],
    )


def run(scene, begin_us, end_us):
    """Flux of a strip of pixels, [window, half a, half b and error, pixel], ends of windows, and numbers of rays."""
    sensor = hr.load_sensor("davis346", {"evs.threshold_mismatch_rel": 0.02}).crop(120, 8, 113, 126)
    source = ChangeDrivenFlux(scene, sensor, seed=6)
    blocks = list(source.sample_blocks(1, begin_us, end_us))
    flux = source.flux_of_blocks(source.sensor.layout.evs_pixel.ravel(), blocks)
    values = np.array([(np.array(one.half_a), np.array(one.half_b), one.error) for one in flux])
    ends_us = np.concatenate([block.end_us[block.wanted] for block in blocks])
    return values, ends_us, (source.counts.rays, source.counts.pilot_rays)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("light", "thing", "part"),
    [
        pytest.param(SUN, {}, 0.96, id="direct", marks=pytest.mark.slow),
        # nearly every pixel has a path that may meet the ball
        pytest.param(SUN, PLASTIC, 1.01, id="paths", marks=pytest.mark.slow),
        # what outlines hide of the sky changes where no ray meets them too
        pytest.param(SKY, PLATE, 1.0, id="outline"),
    ],
)
def test_values_are_the_same_and_pilots_take_fewer_rays(monkeypatch, light, thing, part):
    """Over an anchor, at 64 ms; but for outlines, also in runs that begin there, or between two anchors."""
    scene = scene_of(light, thing)
    values, ends_us, rays_now = run(scene, 60_100, 66_500)
    assert np.any(np.ptp(values, axis=0) > 0)
    for begin_us in (62_600, 64_000) if light is not SKY else ():
        later, later_us, _ = run(scene, begin_us, 66_500)
        # the first window of a run is a level at its begin, not a sample of the others
        np.testing.assert_array_equal(later[1:], values[np.isin(ends_us, later_us[1:])])
    monkeypatch.setattr(anchor, "_MANY_BLOCKS", np.inf)
    before, _, rays_before = run(scene, 60_100, 66_500)
    np.testing.assert_array_equal(before, values)
    assert rays_now[0] == rays_before[0] and rays_now[1] <= part * rays_before[1]


@pytest.mark.slow
def test_pilots_are_compared_with_the_same_rays_of_the_first_window(monkeypatch):
    """Where only some sites are traced in the first window, others keep what the anchor shows."""
    scene, pilot, seen = scene_of(SUN, {}), AdaptiveRenderer.pilot, []

    def watched(*given, **named):
        result = pilot(*given, **named)
        seen.append(result[0])
        return result

    monkeypatch.setattr(AdaptiveRenderer, "pilot", watched)
    for many in (anchor._MANY_BLOCKS, np.inf):
        monkeypatch.setattr(anchor, "_MANY_BLOCKS", many)
        run(scene, 60_100, 66_500)
    half = len(seen) // 2
    changes = [[one.change for one in part if one.change is not None] for part in (seen[:half], seen[half:])]
    assert len(changes[0]) >= 4
    for one, other in zip(*changes, strict=True):
        # from the first window to those between
        assert one.controlled.shape[0] < 3 or np.any(one.controlled_scatter[1:-1] > 0)
        for name in ("controlled", "plain", "controlled_scatter", "plain_scatter"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
