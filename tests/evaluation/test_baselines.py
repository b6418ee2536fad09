"""Baselines made from recordings, as models of a report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gesturekit.corpus import Item, Manifest
from gesturekit.errors import EvaluationError, MotionError
from gesturekit.evaluation import evaluate, hand_movement
from gesturekit.evaluation.measuring.baselines import baseline_pairs
from gesturekit.evaluation.measuring.clips import load_clip
from gesturekit.evaluation.pairs import Items, Pair, Pairs
from gesturekit.motion import Motion
from gesturekit.motion.rotations import mean_quaternion

BOTH = ("mean_pose", "other_utterance")


@pytest.fixture(scope="module")
def folders(tmp_path_factory, gesture) -> Path:
    """Three recordings of different length, and two samples of other motion for two of them."""
    root = tmp_path_factory.mktemp("baselines")
    for i, seconds in enumerate((5.0, 6.0, 4.0)):
        gesture(seconds, 25.0, seed=i).save(root / "recordings" / f"clip{i}.npz")
        for sample in (1, 2) if i else ():
            gesture(seconds, 25.0, seed=9 * i + sample).save(
                root / "made" / f"clip{i}_s{sample}.npz"
            )
    return root


def test_baselines_are_models_with_one_clip_a_recording(folders):
    found = evaluate(folders / "made", folders / "recordings", baselines=BOTH)
    assert [model.label for model in found.models] == ["generated", *BOTH]
    assert found.settings["baselines"] == list(BOTH)
    for model in found.models[1:]:
        assert [clip.pair.name for clip in model.clips] == ["clip1", "clip2"]
        assert model.metrics["reach"].recording == found.models[0].metrics["reach"].recording
        assert model.verdict


def test_the_mean_pose_is_held_in_every_frame(folders):
    found = evaluate(folders / "made", folders / "recordings", baselines=["mean_pose"])
    clips = [load_clip(clip.pair, 25.0) for clip in found.models[1].clips]
    assert [clip.generated.n_frames for clip in clips] == [150, 100]
    recorded = [Motion.load(folders / "recordings" / f"clip{i}.npz") for i in range(3)]
    joint = recorded[0].skeleton.index("LeftArm")
    expected = mean_quaternion(np.concatenate([motion.rotations[:, joint] for motion in recorded]))
    for clip in clips:
        assert clip.generated.rotations[:, joint] == pytest.approx(
            np.tile(expected, (clip.generated.n_frames, 1)), abs=1e-6
        )
    assert found.models[1].metrics["near_still"].interval.value == 100.0
    assert found.models[1].verdict == "The hands hardly move."


def test_the_other_utterance_is_the_next_recording_cut_to_length(folders):
    found = evaluate(folders / "made", folders / "recordings", baselines=["other_utterance"])
    one, two = (load_clip(clip.pair, 25.0).generated for clip in found.models[1].clips)
    recorded = [Motion.load(folders / "recordings" / f"clip{i}.npz") for i in range(3)]
    assert one.rotations == pytest.approx(recorded[2].rotations)  # 4 s for a recording of 6 s
    assert two.rotations == pytest.approx(recorded[0].rotations[:100])  # 4 of its 5 s
    assert any("2.00 s shorter" in note for note in found.models[1].clips[0].notes)


def test_a_single_held_out_item_is_compared_with_training_recordings(folders, tmp_path):
    items = [
        Item(
            id=f"clip{i}", audio=None, motion=folders / "recordings" / f"clip{i}.npz",
            duration=4.0, split="test" if i == 1 else "train",
        )
        for i in range(3)
    ]  # fmt: skip
    Manifest(items).save(tmp_path / "corpus.jsonl")
    made = Motion.load(folders / "made" / "clip1_s1.npz")[:100]
    made.save(tmp_path / "made" / "clip1.npz")
    found = evaluate(tmp_path / "made", tmp_path / "corpus.jsonl", baselines=BOTH)
    other = load_clip(found.models[2].clips[0].pair, 25.0).generated
    assert hand_movement(other) == hand_movement(items[0].load_motion())


def test_baselines_that_cannot_be_made_are_errors(folders):
    with pytest.raises(EvaluationError, match="label of a model"):
        evaluate({"mean_pose": folders / "made"}, folders / "recordings", baselines=["mean_pose"])
    one = folders / "made" / "clip1_s1.npz", folders / "recordings" / "clip1.npz"
    with pytest.raises(EvaluationError, match="needs a second recording; there is only 'clip1'"):
        evaluate(*one, baselines=["other_utterance"])


def test_a_mean_pose_of_two_rigs_is_refused(folders, tmp_path, gesture):
    """The rigs differ in the name of a joint only."""
    motion = gesture(3.0, 25.0, seed=1)
    names = tuple(name.replace("Neck", "Throat") for name in motion.skeleton.names)
    other = replace(motion, skeleton=replace(motion.skeleton, names=names))
    assert names != motion.skeleton.names
    for name, one in (("a", motion), ("b", other)):
        one.save(tmp_path / "recordings" / f"{name}.npz")
        one.save(tmp_path / "made" / f"{name}.npz")
    with pytest.raises(EvaluationError, match="mean_pose needs recordings of one rig"):
        evaluate(tmp_path / "made", tmp_path / "recordings", baselines=["mean_pose"])


def test_a_baseline_has_a_clip_for_each_recording_and_window(tmp_path, gesture):
    """Recordings of 5, 6 and 12 s; windows are of 10 s."""
    places = {f"clip{i}": tmp_path / "recordings" / f"clip{i}.npz" for i in range(3)}
    recorded = [gesture(seconds, 10.0, seed=i) for i, seconds in enumerate((5.0, 6.0, 12.0))]
    for motion, path in zip(recorded, places.values(), strict=True):
        motion.save(path)
    wanted = [("clip2", 1), ("clip2", 1), ("clip0", None), ("clip1", 1), ("clip2", 0)]
    first = Pairs([Pair(f"{stem}_s{k}", stem, window, tmp_path / "a", places[stem])
                   for k, (stem, window) in enumerate(wanted)])  # fmt: skip
    models = {"ours": first, "other": Pairs()}
    made = baseline_pairs(BOTH, models, tmp_path / "recordings", 10.0)
    assert list(made) == list(BOTH) and baseline_pairs([], models, tmp_path, 10.0) == {}
    for pairs in made.values():
        assert [(p.name, p.stem, p.window) for p in pairs.pairs] == [
            ("clip2_w001", "clip2", 1), ("clip0", "clip0", None), ("clip1_w001", "clip1", 1),
            ("clip2_w000", "clip2", 0),
        ]  # fmt: skip
        with pytest.raises(EvaluationError, match="clip2_w001: a baseline has no sound"):
            pairs.pairs[0].generated.item.load_wave()
        with pytest.raises(MotionError, match="clip1 ends before its window 1 begins"):
            pairs.pairs[2].generated.item.load_motion()
    still, other = (
        [made[name].pairs[k].generated.item.load_motion() for k in (0, 3, 1)] for name in BOTH
    )
    assert [motion.n_frames for motion in still] == [20, 100, 50]
    assert all(np.ptp(motion.rotations, axis=0).max() == 0 for motion in still)
    # The next recording, cyclically, from its start: clip0 has 50 frames.
    assert [motion.n_frames for motion in other] == [20, 50, 50]
    assert np.allclose(other[0].rotations, recorded[0].rotations[:20])
    assert np.allclose(other[2].rotations, recorded[1].rotations[:50])
    with pytest.raises(EvaluationError, match="baseline 'x'; expected one of mean_pose, other_utt"):
        baseline_pairs(["mean_pose", "x"], models, tmp_path, 10.0)


def test_the_only_recording_is_compared_with_the_first_of_training_and_keeps_its_body(
    tmp_path, gesture
):
    small, large = gesture(2.0, 10.0), gesture(3.0, 10.0, seed=1).scaled(1.5)
    small.save(tmp_path / "a.npz")
    large.save(tmp_path / "b.npz")
    about = {"audio": None, "duration": 2.0}
    items = [Item(id=n, motion=tmp_path / f"{n}.npz", split=split, **about)
             for n, split in (("a", "test"), ("b", "train"))]  # fmt: skip
    Manifest(items).save(tmp_path / "corpus.jsonl")
    reference = Items.of_manifest(tmp_path / "corpus.jsonl", "test")
    pair = Pair("a", "a", None, tmp_path / "made", reference.intervals["a"])
    made = baseline_pairs(BOTH, {"ours": Pairs([pair])}, reference, 10.0)
    still, other = (made[name].pairs[0].generated.item.load_motion() for name in BOTH)
    # The pose is that of training, on the recording's own body.
    assert np.allclose(still.skeleton.offsets, small.skeleton.offsets) and still.n_frames == 20
    joint = small.skeleton.index("LeftArm")
    assert np.allclose(still.rotations[0, joint], mean_quaternion(large.rotations[:20, joint]))
    assert np.allclose(other.rotations, large.rotations[:20])
    names = tuple(name.replace("Neck", "Throat") for name in small.skeleton.names)
    replace(small, skeleton=replace(small.skeleton, names=names)).save(tmp_path / "c.npz")
    odd = Pairs([Pair("c", "c", None, tmp_path / "made", tmp_path / "c.npz")])
    made = baseline_pairs(["mean_pose"], {"ours": odd}, reference, 10.0)
    with pytest.raises(MotionError, match="c: its rig differs from that of the mean pose"):
        made["mean_pose"].pairs[0].generated.item.load_motion()
