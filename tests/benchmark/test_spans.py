"""Spans of a clip: a build that was killed between two of them goes on, and the clip has the bytes of a whole build."""

import numpy as np
import pytest
from pydantic import ValidationError

import hesim_render as hr
from benchmarks import small
from hesim_render.benchmark.clip import build_clip, clip_folder
from hesim_render.benchmark.plan import Plan
from hesim_render.core.errors import SpecError
from hesim_render.sources.render.change_driven.adaptive import AdaptiveRenderer
from hesim_render.sources.render.change_driven.estimates import Flux
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.journal import Journal, key_of
from hesim_render.sources.render.light_level import in_absolute_light

STAR = {"given": [{"scene": "rotating-star", "split": "train"}]}
CLIPS = {
    "ticks": {
        "scenes": STAR, "duration_s": 0.04, "sharp": {"times_us": [5000, 25000], "window_us": 500}, "truth": ["events"],
        "audit": 0,
    },
    "asynchronous": {
        "scenes": STAR, "duration_s": 0.03, "sharp": {"times_us": [5000, 25000], "window_us": 500},
        "sensors": [{"sensor": "davis346", "roi": "16x12"}],
    },
    "flicker": {
        "scenes": {"count": 1, "objects": 1, "textured": 0}, "motions": {"speed": 1, "camera": 0}, "sharp": None,
        "lights": {"flicker": 1, "lamps": 2, "illuminance_lux": 500}, "duration_s": 0.04,
        "splits": {"train": 1, "val": 0, "test": 0},
    },
}  # fmt: skip
#: Passes of the renderer after which the builds of a clip are killed, one after the other, as parts of all passes.
KILLS = {"ticks": [0.5], "asynchronous": [0.1, 0.4], "flicker": [0.02, 0.5, 0.4]}


class KilledError(Exception):
    pass


def build(plan, root, most=None):
    """Build the only clip; killed when the renderer begins its pass number `most`. Returns the number of passes."""
    passes, render = [], AdaptiveRenderer.render

    def counted(self, *arguments, **options):
        if most is not None and len(passes) >= most:
            raise KilledError
        passes.append(1)
        return render(self, *arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(AdaptiveRenderer, "render", counted)
        if most is None:
            build_clip(plan, plan.clips[0], root)
        else:
            with pytest.raises(KilledError):
                build_clip(plan, plan.clips[0], root)
    return len(passes)


def bytes_of(root, plan):
    folder = clip_folder(root, plan.clips[0])
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", ["ticks", *(pytest.param(name, marks=pytest.mark.slow) for name in list(CLIPS)[1:])])
def test_a_clip_in_spans_that_was_killed_has_the_bytes_of_a_whole_one(name, tmp_path):
    """Audit, labels, and the work that its manifest states are among these bytes."""
    whole, plan = Plan(small(**CLIPS[name])), Plan(small(**CLIPS[name], span_s=0.01))
    passes = build(whole, tmp_path / "whole")
    root = tmp_path / "spans"
    kills = [max(1, int(part * passes)) for part in KILLS[name]]
    for most in kills:
        assert build(plan, root, most) == most
        assert not clip_folder(root, plan.clips[0]).exists()
    last = build(plan, root)
    assert bytes_of(root, plan) == bytes_of(tmp_path / "whole", whole)
    assert not (root / "spans").exists()
    assert last < passes
    if name == "ticks":  # a pass before the kill may be of a span that had not ended
        assert last <= passes - kills[0] + 2


def test_spans_decide_no_byte_and_need_a_quality():
    assert small(span_s=0.01).content == small().content
    assert Plan(small(span_s=0.01)).clips == Plan(small()).clips
    with pytest.raises(ValidationError, match="span_s: spans are kept of renders with a quality"):
        small(span_s=0.01, samples=8, sharp=None)


def test_a_renderer_knows_again_which_pixels_rest():
    sensor = hr.load_sensor("reference-mono").crop(24, 16)
    scene = in_absolute_light(hr.load_scene("rotating-star"))[0]
    one, other = (ChangeDrivenFlux(scene, sensor, seed=3)._renderer for _ in range(2))
    rng, pixels = np.random.default_rng(1), 24 * 16
    for role in ("any", "events"):
        still = one.still(role)
        still.known[rng.random(pixels) < 0.3] = True
        still.flux.put(still.known, Flux(*rng.random((3, 1, int(still.known.sum())), np.float32)))
    other.restore(one.state())
    for role in ("any", "events"):
        assert one.still(role).known.sum() > 50 and np.array_equal(one.still(role).known, other.still(role).known)
        for values, told in zip(one.still(role).flux.arrays, other.still(role).flux.arrays, strict=True):
            assert np.array_equal(values, told)


# ---- the journal alone ------------------------------------------------------------------------------------


def question(number):
    return key_of([np.arange(number, dtype=np.uint32), np.array([float(number)])])


def filled(folder, count=5, span_us=20):
    """Answers that end at 10, 20, … µs; files end with the second, the fourth and so on."""
    journal = Journal(folder, span_us)
    for number in range(count):
        assert journal.recall(question(number)) is None
        answer = {"values": np.full(3, number, np.float32)}
        journal.add(question(number), answer, 10.0 * (number + 1), lambda number=number: {"last": np.array(number)})
    return journal


def recalled(folder, count):
    """Numbers and states of the answers that are there, up to the first that is not."""
    journal, found = Journal(folder, 20), []
    for number in range(count):
        got = journal.recall(question(number))
        if got is None:
            break
        assert np.array_equal(got.answer["values"], np.full(3, number))
        found.append((number, None if got.state is None else int(got.state["last"])))
    return found


def test_finished_spans_are_told_again_with_the_state_at_their_end(tmp_path):
    journal = filled(tmp_path)
    assert recalled(tmp_path, 9) == [(0, None), (1, 1), (2, None), (3, 3)]  # the fifth was held in memory alone
    journal.flush(lambda: {"last": np.array(7)})
    assert recalled(tmp_path, 9)[-1] == (4, 7)
    # the next answers go on where the files end
    again = Journal(tmp_path, 20)
    for number in range(5):
        assert again.recall(question(number)) is not None
    assert again.recall(question(5)) is None
    again.add(question(5), {"values": np.full(3, 5, np.float32)}, 60.0, lambda: {"last": np.array(5)})
    assert recalled(tmp_path, 9)[-2:] == [(4, 7), (5, 5)]


def test_a_damaged_span_is_dropped_with_all_later_ones(tmp_path):
    filled(tmp_path, 6)
    files = sorted(tmp_path.glob("*.npz"))
    assert [file.name for file in files] == ["000000.npz", "000001.npz", "000002.npz"]
    data = bytearray(files[1].read_bytes())
    data[len(data) // 2 :] = b""
    files[1].write_bytes(data)
    assert recalled(tmp_path, 9) == [(0, None), (1, 1)]
    assert [file.name for file in sorted(tmp_path.glob("*"))] == ["000000.npz"]


def test_spans_of_another_run_are_refused(tmp_path):
    filled(tmp_path)
    with pytest.raises(SpecError, match="another run"):
        Journal(tmp_path, 20).recall(question(1))
