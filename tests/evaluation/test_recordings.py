"""What recordings are compared with: training motion, other takes, other speakers, bad motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from gesturekit.corpus import Item, Manifest
from gesturekit.errors import EvaluationError, MotionError
from gesturekit.evaluation.definitions import MOVEMENT, PATCHES, POOLED, SIMILARITY, Variants
from gesturekit.evaluation.measuring import speakers
from gesturekit.evaluation.measuring.baselines import held, mean_pose
from gesturekit.evaluation.measuring.ceilings import HALVES, OTHERS, PIECES, ceilings
from gesturekit.evaluation.measuring.clip_metrics import ClipMetrics
from gesturekit.evaluation.measuring.clips import forget_files
from gesturekit.evaluation.measuring.inputs import ReferenceStatistics
from gesturekit.evaluation.measuring.levels import likeness_levels
from gesturekit.evaluation.measuring.set_metrics import speeds_of, thinned
from gesturekit.evaluation.measuring.speakers import (
    SpeakerClips,
    TrainingMotion,
    backwards,
    own_windows,
)
from gesturekit.evaluation.metrics.distributions import SpeedHistogram, hellinger
from gesturekit.evaluation.metrics.patches import inter_diversity, patch_features
from gesturekit.evaluation.metrics.similarity import cca, pose_pair
from gesturekit.evaluation.pairs import ItemInterval, Items, Pair
from gesturekit.evaluation.report import bad_motion
from gesturekit.evaluation.report.bad_motion import run_sanity
from gesturekit.evaluation.statistics.levels import CEILING, MEAN_POSE, OTHER_SPEAKER
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.parts import body_joints

RIG = Skeleton(("hips", "head"), (-1, 0), [[0, 1, 0], [0, 0.5, 0]])


def gliding(seconds: float, fps: float = 25.0, start: float = 0.0) -> Motion:
    """A body whose height is the time, from `start`."""
    n = round(seconds * fps)
    path = np.zeros((n, 3))
    path[:, 1] = start + np.arange(n) / fps
    return Motion(RIG, np.tile([0.0, 0, 0, 1], (n, 2, 1)), path, fps)


@pytest.fixture(autouse=True)
def _no_files_in_memory() -> None:
    forget_files()


@pytest.fixture
def corpus(tmp_path) -> Callable[..., Items]:
    """corpus((id, split, seconds, speaker), ...): a manifest; the height of motion is 100 times
    the number of its item, and more."""

    def make(*rows: tuple[str, str, float, str | None]) -> Items:
        items = []
        for k, (name, split, seconds, speaker) in enumerate(rows):
            path = tmp_path / f"{name}.npz"
            if name == "broken":
                path.write_bytes(b"x")
            else:
                gliding(seconds, start=100.0 * k).save(path)
            items.append(Item(id=name, audio=None, motion=path, duration=seconds, split=split,
                              speaker=speaker))  # fmt: skip
        Manifest(items).save(tmp_path / "corpus.jsonl")
        return Items.of_manifest(tmp_path / "corpus.jsonl", "test")

    return make


def heights(motions: list[Motion]) -> list[float]:
    return [round(float(motion.translation[0, 1]), 2) for motion in motions]


def test_training_motion_is_that_of_the_training_split(corpus):
    reference = corpus(
        ("t", "test", 3.0, "ann"), ("a", "train", 4.0, "ann"), ("broken", "train", 4.0, "ann"),
        ("b", "train", 2.0, "ben"), ("v", "valid", 2.0, "ben"),
    )  # fmt: skip
    found = TrainingMotion.of(reference, 0)
    assert heights(found.motions) == [100.0, 300.0] and found.speakers == ["ann", "ben"]
    assert [m.duration for m in found.motions] == [4.0, 2.0] and found.note == ""
    (item,) = found.excluded
    assert (item.name, item.what) == ("broken", "the training split")
    own = {name: heights(found.of_speaker(name, ["head"])) for name in ("ann", "ben", "eve", None)}
    assert own == {"ann": [100], "ben": [300], "eve": [100, 300], None: [100, 300]}
    assert found.of_speaker("ann", ["tail"]) == []
    assert TrainingMotion.of(Path("a folder"), 0).motions == []


def test_of_long_training_motion_items_are_drawn_at_random_and_cut(corpus, monkeypatch):
    monkeypatch.setattr(speakers, "TRAINING_SECONDS", 9.0)
    rows = [(f"i{k}", "train", 4.0, None) for k in range(6)]
    reference = corpus(("t", "test", 3.0, None), *rows)
    found = [TrainingMotion.of(reference, seed) for seed in range(4)]
    for one in found:
        # 4, 4 and 1 of the last 4 seconds.
        assert [m.duration for m in one.motions] == [4.0, 4.0, 1.0]
        assert one.note == "0 of 0 min of it"
    assert len({tuple(heights(one.motions)) for one in found}) > 1
    monkeypatch.setattr(speakers, "TRAINING_SECONDS", 8.9)
    (*_, last) = TrainingMotion.of(reference, 0).motions
    assert last.duration == 4.0, "less than a second more is not taken"
    monkeypatch.setattr(speakers, "TRAINING_SECONDS", 24.0)
    assert heights(TrainingMotion.of(reference, 0).motions) == [100 * k for k in range(1, 7)]


def clips_of(takes: list[str], training: list[Motion] | None = None) -> SpeakerClips:
    recorded = [gliding(2.0, start=10.0 * k) for k in range(len(takes))]
    none = np.zeros(0, int)
    return SpeakerClips(recorded, none, takes, [], none, [], ("head",), training or [])


def test_recordings_are_compared_with_training_then_with_other_takes_then_by_halves():
    def splits(*takes: str, **more):
        return [tuple(map(heights, pair)) for pair in clips_of([*takes], **more).splits()]

    assert splits("a", "b", training=[gliding(1.0, start=7.0)]) == [([0, 10], [7])]
    assert splits("a", "b", "a") == [([0, 20], [10]), ([10], [0, 20])]
    assert splits("a", "a", "a") == [([0, 20], [10]), ([10], [0, 20])]
    assert splits("a") == [([0], [1]), ([1], [0])]
    many = splits(*(f"t{k:02}" for k in range(25)))
    # Every third take, so that there are at most twelve; each against all others.
    assert [held for held, _ in many] == [[10 * k] for k in range(0, 25, 3)]
    assert all(len(others) == 24 for _, others in many)
    assert len(splits(*(f"t{k:02}" for k in range(12)))) == 12
    assert clips_of(["a", "b"]).has_others and not clips_of(["a", "a"]).has_others
    assert clips_of(["a"], [gliding(1.0)]).has_others
    one = replace(clips_of(["a"]), recorded=[gliding(0.04)])
    with pytest.raises(MotionError, match="too short to be cut into halves"):
        one.splits()


def test_windows_of_recordings_backwards_are_not_those_forwards(gesture):
    motion = gesture(6.0, 25.0)
    moved = {"Head": np.arange(450.0).reshape(150, 3) / 1000}
    turned = backwards(replace(motion, joint_translations=moved))
    assert np.array_equal(turned.rotations, motion.rotations[::-1])
    assert np.array_equal(turned.joint_translations["Head"], moved["Head"][::-1])
    path = replace(motion, translation=moved["Head"])
    assert np.array_equal(backwards(path).translation, moved["Head"][::-1])
    joints = ["LeftHand", "RightHand"]
    same = own_windows([motion], [motion], joints, 0)
    assert same == {"one_nn": 0.0, "forward": 100.0, "within_reach": 100.0}
    against = own_windows([turned], [backwards(turned)], joints, 0, reach=False)
    assert against["forward"] == 0.0 and set(against) == {"one_nn", "forward"}


def measured(pairs: dict[str, tuple[str | None, str]], tmp_path: Path, groups=(), seconds=2.0):
    """Return {compared: with what} and the ceilings, of {name: (speaker, take)}."""
    sources = {}
    for k, (name, (speaker, take)) in enumerate(pairs.items()):
        path = tmp_path / f"{name}.npz"
        gliding(seconds, start=100.0 * k).save(path)
        item = Item(id=name, audio=None, motion=path, duration=seconds, split="test",
                    speaker=speaker, take=take)  # fmt: skip
        own = ItemInterval(item)
        sources[name] = Pair(name, name, None, own, own)
    seen = {}

    def against(clip) -> dict[str, float]:
        first = [float(m.translation[0, 1]) for m in (clip.recording, clip.generated)]
        seen[first[0]] = first[1]
        return {"coverage": first[1], "hellinger": 1.0}

    measure = SimpleNamespace(against=against, groups=groups, variants=Variants())
    return seen, ceilings(sources, 25.0, measure, None, 0)


def test_each_take_is_compared_with_the_next_other_one_of_its_speaker(tmp_path):
    seen, found = measured(
        {"a1": ("ann", "1"), "a2": ("ann", "1"), "b1": ("ben", "1"), "a3": ("ann", "3"),
         "b2": ("ben", "1")}, tmp_path,
    )  # fmt: skip
    # Ben has one take, so that only Ann's are compared: both pieces of 1 with 3, and it with 1.
    assert seen == {0: 300, 100: 300, 300: 0}
    interval, note = found["coverage"]
    assert note == OTHERS and interval.units == 2
    assert interval.value == pytest.approx((300 + 0) / 2), "the mean over takes"


def test_pieces_of_one_take_each_are_compared_with_the_next_of_the_speaker(tmp_path):
    speakers_ = {"a1": ("ann", "1"), "b1": ("ben", "1"), "a2": ("ann", "1"), "c": ("eve", "1")}
    seen, found = measured(speakers_, tmp_path)
    assert seen == {0: 200, 100: 200, 200: 0, 300: 0} and found["coverage"][1] == PIECES


def test_a_single_recording_is_compared_by_halves(tmp_path):
    seen, found = measured({"a": (None, "")}, tmp_path)
    assert seen == {0: 1, 1: 0}
    assert found["coverage"][1] == HALVES and found["coverage"][0].value == 0.5


def test_at_most_thirty_recordings_of_a_minute_are_compared(tmp_path):
    pairs = {f"r{k:02}": ("ann", f"{k}") for k in range(31)}
    seen, _ = measured(pairs, tmp_path, seconds=0.2)
    assert list(seen) == [100.0 * k for k in range(0, 31, 2)] and seen[3000.0] == 0
    pairs.popitem()
    assert len(measured(pairs, tmp_path, seconds=0.2)[0]) == 30
    assert ceilings({}, 25.0, None, None, 0) == {}
    lengths = []
    measure = SimpleNamespace(
        against=lambda clip: lengths.append(clip.generated.duration) or {}, groups=(),
        variants=Variants(),
    )  # fmt: skip
    gliding(70.0, 5.0).save(tmp_path / "long.npz")
    pair = Pair("long", "long", None, tmp_path / "long.npz", tmp_path / "long.npz")
    ceilings({"long": pair, "again": pair}, 5.0, measure, None, 0)
    assert lengths == [60.0, 60.0]


def test_diversity_of_recordings_is_that_of_twenty(tmp_path, gesture):
    sources = {}
    for k in range(22):
        gesture(0.8, 25.0, seed=k).save(tmp_path / f"{k:02}.npz")
        own = tmp_path / f"{k:02}.npz"
        sources[f"{k:02}"] = Pair(f"{k:02}", f"{k:02}", None, own, own)
    values = {}
    for groups in ((), (PATCHES,)):
        measure = SimpleNamespace(against=lambda clip: {}, groups=groups, variants=Variants())
        found = ceilings(sources, 25.0, measure, None, 0)
        values[groups] = found
    assert set(values[()]) == {"hellinger"}
    distance, note = values[()]["hellinger"]
    assert (distance.n, note) == (22, HALVES) and 0 < distance.value < 0.5
    assert set(values[PATCHES,]) == {"hellinger", "inter_diversity"}
    recorded = [gesture(0.8, 25.0, seed=k) for k in range(22)]
    joints = body_joints(recorded[0].skeleton)
    sides = [SpeedHistogram.of([speeds_of(m, joints) for m in recorded[k::2]]) for k in (0, 1)]
    assert distance.value == pytest.approx(hellinger(*sides))
    for name in ("ganimator", "paper"):
        measure.variants = Variants(name)
        features = [patch_features(motion, name, joints=joints) for motion in recorded[:20]]
        found = ceilings(sources, 25.0, measure, None, 0)["inter_diversity"][0].value
        assert found == pytest.approx(inter_diversity(features)), name
    measure.variants = Variants()
    both = SimpleNamespace(against=measure.against, groups=(SIMILARITY,), variants=Variants())
    # Each with the next of another take, the last with the first.
    poses = [pose_pair(recorded[(k + 1) % 22], motion, joints) for k, motion in enumerate(recorded)]
    expected = cca(*(np.concatenate(side) for side in zip(*poses, strict=True)))
    found = ceilings(sources, 25.0, both, None, 0)["cca_global"][0].value
    assert found == pytest.approx(expected, abs=1e-6)
    for name in ("20", "21"):
        sources.pop(name)
    forget_files()
    fewer = ceilings(sources, 25.0, measure, None, 0)
    assert fewer["inter_diversity"][0].value == values[PATCHES,]["inter_diversity"][0].value


@pytest.fixture
def levels(tmp_path, gesture):
    """levels(held_out, (name, speaker, take, seed, seconds), ...): levels of likeness."""

    def of(held_out: int, *rows: tuple[str, str, str, int, float]):
        pairs = []
        for name, speaker, take, seed, seconds in rows:
            path = tmp_path / f"{name}.npz"
            gesture(seconds, 25.0, seed=seed).save(path)
            item = Item(id=name, audio=None, motion=path, duration=seconds, split="test",
                        speaker=speaker, take=take)  # fmt: skip
            own = ItemInterval(item)
            pairs.append(Pair(name, name, None, own, own))
        measure = ClipMetrics(ReferenceStatistics(), [MOVEMENT, POOLED], Variants())
        return likeness_levels(pairs, held_out, 25.0, measure, 0)

    return of


def test_levels_are_of_the_takes_of_the_judged_speakers(levels):
    rows = [("a1", "ann", "1", 0, 3.0), ("a2", "ann", "2", 1, 3.0), ("b1", "ben", "1", 2, 3.0),
            ("b2", "ben", "2", 3, 3.0), ("c1", "eve", "1", 4, 3.0)]  # fmt: skip
    found = levels(4, *rows)
    # Two takes of two speakers; each speaker against three takes of the others.
    assert {name: (level.n, level.pieces) for name, level in found.items()} == {
        CEILING: (4, False), OTHER_SPEAKER: (6, False), MEAN_POSE: (4, False)
    }  # fmt: skip
    assert found[MEAN_POSE].value < found[CEILING].value
    only_ann = levels(2, *rows)
    assert {name: level.n for name, level in only_ann.items()} == {
        CEILING: 2, OTHER_SPEAKER: 3, MEAN_POSE: 2
    }  # fmt: skip


def test_a_single_take_is_judged_by_its_pieces(levels):
    found = levels(1, ("a", "ann", "1", 0, 8.0))
    assert {name: (level.n, level.pieces) for name, level in found.items()} == {
        CEILING: (4, True), MEAN_POSE: (4, True)
    }  # fmt: skip
    found = levels(3, *((f"a{k}", "ann", "1", k, 2.0) for k in range(3)))
    assert found[CEILING].n == 3 and found[CEILING].pieces
    # Beside a speaker of several takes, one with a single take has no ceiling.
    found = levels(3, ("a", "ann", "1", 0, 8.0), ("b1", "ben", "1", 1, 2.0),
                   ("b2", "ben", "2", 2, 2.0))  # fmt: skip
    assert (found[CEILING].n, found[CEILING].pieces) == (2, False)
    assert found[OTHER_SPEAKER].n == 3 and not found[OTHER_SPEAKER].pieces
    assert found[MEAN_POSE].n == 4 + 2


def test_some_takes_of_many_are_judged(levels):
    """Every second one of 7 takes; the first six of more speakers than five."""
    found = levels(7, *((f"a{k}", "ann", f"{k}", k, 1.2) for k in range(7)))
    assert found[CEILING].n == 4
    found = levels(1, *((f"s{k}", f"p{k}", "1", k, 1.2) for k in range(8)))
    assert found[OTHER_SPEAKER].n == 5


def test_the_mean_pose_is_that_of_all_frames_and_places():
    turns = np.tile([0.0, 0, 0, 1], (4, 2, 1))
    turns[:, 1, 0], turns[:, 1, 3] = np.sin(0.2), np.cos(0.2)
    one = Motion(RIG, np.tile([0.0, 0, 0, 1], (4, 2, 1)), np.zeros((4, 3)), 30,
                 {"head": np.zeros((4, 3))})  # fmt: skip
    other = Motion(RIG, turns, np.full((4, 3), 2.0), 30, {"head": np.full((4, 3), 3.0)})
    pose = mean_pose([one, other])
    assert (pose.n_frames, pose.fps) == (1, 30)
    assert pose.rotations[0, 1] == pytest.approx([np.sin(0.1), 0, 0, np.cos(0.1)], abs=1e-6)
    assert pose.translation.tolist() == [[1.0] * 3]
    assert pose.joint_translations["head"].tolist() == [[1.5] * 3]
    still = held(pose, 3)
    assert still.n_frames == 3 and np.ptp(still.rotations, axis=0).max() == 0
    assert still.joint_translations["head"].tolist() == [[1.5] * 3] * 3
    assert still.translation.tolist() == [[1.0] * 3] * 3
    # Every second of 1000 frames, every one of 999: those at odd places do not count.
    path = np.zeros((1000, 3))
    path[1::2] = 1.0
    long = Motion(RIG, np.tile([0.0, 0, 0, 1], (1000, 2, 1)), path, 30)
    assert mean_pose([long]).translation.tolist() == [[0.0] * 3]
    assert mean_pose([long[:999]]).translation[0] == pytest.approx([499 / 999] * 3)


def test_every_so_many_values_are_kept():
    parts = [np.arange(4.0), np.arange(4.0, 10.0)]
    assert thinned(parts, 10).tolist() == list(range(10))
    assert thinned(parts, 9).tolist() == [0, 2, 4, 6, 8] == thinned(parts, 5).tolist()
    assert thinned(parts, 4).tolist() == [0, 3, 6, 9] and len(thinned([])) == 0


@pytest.fixture
def written(monkeypatch, gesture):
    """written(folder, **options): {model: {clip: motion}} and items that are evaluated."""
    seen = {}

    def evaluate(models, corpus, split, **options):
        manifest = Manifest.load(corpus)
        seen["items"] = {item.id: item for item in manifest}
        seen["models"] = {
            name: {
                path.relative_to(folder).with_suffix("").as_posix(): Motion.load(path)
                for path in sorted(folder.rglob("*.npz"))
            }
            for name, folder in models.items()
        }
        seen["options"] = {"split": split, **options}
        return bad_motion.Evaluation([], corpus, 25.0, "", {}, None, None)

    monkeypatch.setattr(bad_motion, "evaluate", evaluate)

    def run(folder: Path, *sound: Path, **options):
        seen["result"] = run_sanity(folder, *sound, **options)
        return SimpleNamespace(**seen)

    return run


def spans(items: dict[str, Item], split: str) -> dict[str, tuple[float, float]]:
    return {
        name: (round(item.motion_start, 3), round(item.duration, 3))
        for name, item in items.items()
        if (item.split == "test") == (split == "test")
    }


def test_every_other_recording_is_held_out_and_the_rest_is_training(written, gesture, tmp_path):
    motions = {name: gesture(4.0, 10.0, seed=k) for k, name in enumerate("abcde")}
    motions["b"] = motions["b"][:35]
    for name, motion in motions.items():
        motion.save(tmp_path / "r" / f"{name}.npz")
    gesture(2.9, 10.0).save(tmp_path / "r" / "short.npz")
    found = written(tmp_path / "r", seed=5)
    assert spans(found.items, "test") == {name: (0, 4) for name in "ace"}
    assert spans(found.items, "train") == {"b": (0, 3.5), "d": (0, 4)}
    assert found.options == {"split": "test", "seed": 5}
    assert found.result.left_out == {"short": "short.npz: 2.9 s; at least 3 s are needed"}
    assert found.result.evaluation.reference == tmp_path / "r"
    models = found.models
    assert set(models) == {"recording", *bad_motion.BAD_MOTION}
    assert all(list(clips) == ["a", "c", "e"] for clips in models.values())

    def same(model: str, clip: str, name: str) -> bool:
        one, other = models[model][clip], motions[name]
        return one.n_frames == other.n_frames and np.allclose(one.rotations, other.rotations)

    assert all(same("recording", name, name) for name in "ace")
    # The next held-out one, cyclically; and the training recordings in turn.
    assert [same("another utterance", x, y) for x, y in ("ac", "ce", "ea")] == [True] * 3
    assert [same("training recording", x, y) for x, y in ("ab", "cd", "eb")] == [True] * 3
    noise = [models["jitter"][name].rotations - motions[name].rotations for name in "ac"]
    assert not np.allclose(*noise), "each clip has noise of its own"
    again = written(tmp_path / "r", seed=6).models["jitter"]["a"]
    assert not np.allclose(again.rotations, models["jitter"]["a"].rotations)


def test_a_single_recording_is_cut_into_training_and_pieces(written, gesture, tmp_path):
    gesture(40.0, 10.0).save(tmp_path / "r" / "a.npz")
    found = written(tmp_path / "r")
    # The second half, 20 s, in pieces of 8 s and more.
    assert spans(found.items, "test") == {"a_end_1": (20, 10), "a_end_2": (30, 10)}
    assert spans(found.items, "train") == {"a_start": (0, 20)}
    gesture(9.0, 10.0, seed=1).save(tmp_path / "s" / "day" / "a.npz")
    gesture(9.0, 10.0, seed=2).save(tmp_path / "s" / "b.npz")
    found = written(tmp_path / "s")
    assert spans(found.items, "test") == {"b_1": (0, 9)}
    assert spans(found.items, "train") == {"day/a": (0, 9)}
    (tmp_path / "s" / "b.npz").rename(tmp_path / "s" / "day" / "b.npz")
    found = written(tmp_path / "s")
    assert spans(found.items, "test") == {"day/a_1": (0, 9)}
    assert {name for clips in found.models.values() for name in clips} == {"day/a_1"}


def test_a_minute_of_a_recording_and_two_of_all_are_used(written, gesture, tmp_path):
    for name in "abcde":
        gesture(70.0, 5.0).save(tmp_path / "r" / f"{name}.npz")
    found = written(tmp_path / "r")
    assert spans(found.items, "test") == {name: (0, 40) for name in "ace"}
    assert spans(found.items, "train") == {"b": (0, 60), "d": (0, 60)}


def test_sound_beside_the_motion_or_in_a_folder_shortens_its_recording(
    written, gesture, write_speech, tmp_path
):
    for name in "ab":
        gesture(6.0, 10.0).save(tmp_path / "r" / f"{name}.npz")
    write_speech(tmp_path / "r" / "a.wav", 5.0)
    items = written(tmp_path / "r").items
    assert items["a_1"].duration == pytest.approx(5.0) and items["a_1"].audio.name == "a.wav"
    assert items["b"].audio is None and items["b"].duration == 6.0
    write_speech(tmp_path / "sound" / "b.wav", 4.0)
    items = written(tmp_path / "r", tmp_path / "sound").items
    assert items["a_1"].audio is None and items["b"].duration == pytest.approx(4.0)
    items = written(tmp_path / "r" / "a.npz").items
    assert {item.audio.name for item in items.values()} == {"a.wav"}
    assert spans(items, "train") == {"a_start": (0, 2.5)}
    write_speech(tmp_path / "r" / "a.wav", 2.9)
    with pytest.raises(EvaluationError, match="a: a.npz: 2.9 s; at least 3 s are needed"):
        written(tmp_path / "r" / "a.npz")
