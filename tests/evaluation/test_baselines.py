"""Baselines made from recordings, as models of a report."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gesturekit.corpus import Item, Manifest
from gesturekit.errors import EvaluationError
from gesturekit.evaluation import evaluate, hand_movement, load_clip
from gesturekit.evaluation.measuring.made_motion import mean_pose
from gesturekit.motion import Motion

BOTH = ("mean_pose", "other_utterance")


@pytest.fixture(scope="module")
def folders(tmp_path_factory, gesture) -> Path:
    """Three recordings of different length, and two samples of other motion for two of them."""
    root = tmp_path_factory.mktemp("baselines")
    for i, seconds in enumerate((3.0, 4.0, 2.0)):
        gesture(seconds, 25.0, seed=i).save(root / "recordings" / f"clip{i}.npz")
        for sample in (1, 2) if i else ():
            gesture(seconds, 25.0, seed=9 * i + sample).save(
                root / "made" / f"clip{i}_s{sample}.npz"
            )
    return root


@pytest.fixture(scope="module")
def found(folders):
    return evaluate(
        folders / "made", folders / "recordings", baselines=("generated", *BOTH), cheap=True
    )


def test_baselines_are_models_with_one_clip_a_recording(found):
    assert [model.label for model in found.models] == ["generated", *BOTH]
    assert found.settings["baselines"] == ["generated", *BOTH], "as given"
    for model in found.models[1:]:
        assert [clip.pair.name for clip in model.clips] == ["clip1", "clip2"]
        assert model.metrics["reach"].recording == found.models[0].metrics["reach"].recording
        assert model.verdict


def test_the_mean_pose_is_held_in_every_frame(found, folders):
    clips = [load_clip(clip.pair, 25.0) for clip in found.models[1].clips]
    assert [clip.generated.n_frames for clip in clips] == [100, 50]
    recorded = [Motion.load(folders / "recordings" / f"clip{i}.npz") for i in range(3)]
    joint = recorded[0].skeleton.index("LeftArm")
    mean = Rotation.from_quat(np.concatenate([m.rotations[:, joint] for m in recorded])).mean()
    for clip in clips:
        away = mean.inv() * Rotation.from_quat(clip.generated.rotations[:, joint])
        assert away.magnitude() == pytest.approx(0.0, abs=1e-5)
    assert found.models[1].metrics["near_still"].interval.value == 100.0


def test_the_mean_pose_keeps_joints_that_move_at_their_mean_place(gesture):
    motions = [
        replace(motion, joint_translations={"LeftHand": np.full((motion.n_frames, 3), place)})
        for motion, place in ((gesture(1.0, 25.0, seed=1), 0.1), (gesture(3.0, 25.0, seed=2), 0.2))
    ]
    places = mean_pose(motions).joint_translations["LeftHand"]
    assert places == pytest.approx(np.full((1, 3), 0.175), abs=1e-3), "by their lengths"


def test_the_other_utterance_is_the_next_recording_cut_to_length(found, folders):
    one, two = (load_clip(clip.pair, 25.0).generated for clip in found.models[2].clips)
    recorded = [Motion.load(folders / "recordings" / f"clip{i}.npz") for i in range(3)]
    assert one.rotations == pytest.approx(recorded[2].rotations)  # 2 s for a recording of 4 s
    assert two.rotations == pytest.approx(recorded[0].rotations[:50])  # 2 of its 3 s
    assert any(re.search(r"\b2(\.0+)? s\b", note) for note in found.models[2].clips[0].notes)


def test_two_recordings_are_enough_for_each_other(gesture, tmp_path):
    for name, seed in (("a", 0), ("b", 1)):
        gesture(2.0, 25.0, seed=seed).save(tmp_path / f"{name}.npz")
    baselines = ["other_utterance"]
    (_, other) = evaluate(tmp_path, tmp_path, baselines=baselines, cheap=True).models
    first, second = (load_clip(clip.pair, 25.0) for clip in other.clips)
    assert first.generated.rotations == pytest.approx(second.recording.rotations)
    assert second.generated.rotations == pytest.approx(first.recording.rotations)


def test_a_single_held_out_item_is_compared_with_training_recordings(folders, tmp_path):
    items = [
        Item(
            id=f"clip{i}", audio=None, motion=folders / "recordings" / f"clip{i}.npz",
            duration=2.0, split="test" if i == 1 else "train",
        )
        for i in range(3)
    ]  # fmt: skip
    Manifest(items).save(tmp_path / "corpus.jsonl")
    made = Motion.load(folders / "made" / "clip1_s1.npz")[:50]
    made.save(tmp_path / "made" / "clip1.npz")
    found = evaluate(tmp_path / "made", tmp_path / "corpus.jsonl", baselines=BOTH, cheap=True)
    other = load_clip(found.models[2].clips[0].pair, 25.0).generated
    assert hand_movement(other) == hand_movement(items[0].load_motion())


def test_baselines_that_cannot_be_made_are_errors(folders):
    with pytest.raises(EvaluationError, match="mean_pose.*label"):
        evaluate({"mean_pose": folders / "made"}, folders / "recordings", baselines=["mean_pose"])
    one = folders / "made" / "clip1_s1.npz", folders / "recordings" / "clip1.npz"
    with pytest.raises(EvaluationError, match="other_utterance.*'clip1'"):
        evaluate(*one, baselines=["other_utterance"])


def test_a_mean_pose_of_two_rigs_is_refused(folders, tmp_path, gesture):
    """The rigs differ in the name of a joint only."""
    motion = gesture(1.0, 25.0, seed=1)
    names = tuple(name.replace("Neck", "Throat") for name in motion.skeleton.names)
    other = replace(motion, skeleton=replace(motion.skeleton, names=names))
    assert names != motion.skeleton.names
    for name, one in (("a", motion), ("b", other)):
        one.save(tmp_path / "recordings" / f"{name}.npz")
        one.save(tmp_path / "made" / f"{name}.npz")
    with pytest.raises(EvaluationError, match="mean_pose.*rig"):
        evaluate(tmp_path / "made", tmp_path / "recordings", baselines=["mean_pose"])
