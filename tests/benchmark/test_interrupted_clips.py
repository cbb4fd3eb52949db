"""A build that was killed within a clip goes on there, and the clip has the bytes of a whole build."""

import pytest

from benchmarks import small
from hesim_render.benchmark import clip as clips
from hesim_render.benchmark.clip import build_clip, clip_folder
from hesim_render.benchmark.plan import BenchmarkPlan
from hesim_render.core.journal import Journal, journal_of
from hesim_render.sources.render.change_driven.pair_tracer import PairTracer

STAR = {"given": [{"scene": "rotating-star", "split": "train"}]}
CLIPS = {
    "ticks": {
        "scenes": STAR, "duration_s": 0.02, "sharp": {"times_us": [5000, 15000], "window_us": 500}, "truth": ["events"],
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
#: Blocks of rays after which the builds of a clip are killed, one after the other, as parts of all blocks.
KILLS = {"ticks": [0.5], "asynchronous": [0.1, 0.4], "flicker": [0.02, 0.5, 0.4]}


class KilledError(Exception):
    pass


def build(plan, root, most=None):
    """Build the only clip; killed at the block of rays number `most`. Returns the number of blocks traced.

    Pilots are not counted: those whose single rays are compared are not kept.
    """
    blocks = []

    def counted(name):
        trace = getattr(PairTracer, name)

        def traced(self, *arguments):
            if most is not None and len(blocks) >= most:
                raise KilledError
            blocks.append(1)
            return trace(self, *arguments)

        return traced

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(clips, "_KEPT_AFTER_S", 0.0)
        for name in ("_trace_block", "_edge_block"):
            patch.setattr(PairTracer, name, counted(name))
        if most is None:
            build_clip(plan, plan.clips[0], root)
        else:
            with pytest.raises(KilledError):
                build_clip(plan, plan.clips[0], root)
    return len(blocks)


def bytes_of(root, plan):
    folder = clip_folder(root, plan.clips[0])
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
@pytest.mark.parametrize("name", CLIPS)
def test_a_clip_whose_build_was_killed_has_the_bytes_of_a_whole_one(name, tmp_path):
    """Audit, labels, and the work that its manifest states are among these bytes."""
    plan = BenchmarkPlan(small(**CLIPS[name]))
    blocks = build(plan, tmp_path / "whole")
    root = tmp_path / "killed"
    journal, kills = journal_of(clip_folder(root, plan.clips[0])), [max(1, int(part * blocks)) for part in KILLS[name]]
    for most in kills:
        assert build(plan, root, most) == most
        assert not clip_folder(root, plan.clips[0]).exists() and journal.stat().st_size > 0
    # no block that is kept is traced twice
    assert build(plan, root) == blocks - sum(kills)
    assert bytes_of(root, plan) == bytes_of(tmp_path / "whole", plan)
    assert not journal.exists()


def test_a_short_clip_keeps_nothing_and_two_workers_do_not_disturb_each_other(tmp_path):
    with Journal(tmp_path / "clip", {"clip": 1}, shared=True, after_s=60) as late:
        late.keep(b"k" * 16, [])
        assert not late.path.exists()
    with Journal(tmp_path / "clip", {"clip": 1}, shared=True) as one:
        one.keep(b"k" * 16, [])
        with Journal(tmp_path / "clip", {"clip": 1}, shared=True) as other:
            other.keep(b"l" * 16, [])
            assert not other.recall(b"k" * 16, [])
        assert one.path.exists() and one.recall(b"k" * 16, []) and not one.recall(b"l" * 16, [])
    assert not one.path.exists()
