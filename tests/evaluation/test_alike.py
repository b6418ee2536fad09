"""Unlike models are brought to one rig, set apart, marked, or refused."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rigs import with_rest_turned, without_joints

from gesturekit.errors import EvaluationError
from gesturekit.evaluation import DEFINITIONS, evaluate
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.retarget import retarget
from gesturekit.motion.rotations import multiply_quaternions


@pytest.fixture
def recordings(tmp_path, write_pair) -> Path:
    for i in range(3):
        write_pair(tmp_path / "recordings", f"clip{i}", 2.5, fps=15.0, seed=i)
    return tmp_path / "recordings"


def saved(folder: Path, motions: dict[str, Motion]) -> Path:
    for name, motion in motions.items():
        motion.save(folder / f"{name}.npz")
    return folder


def result(found, index: int, key: str) -> float:
    return found.models[index].metrics[key].interval.value


def test_another_rig_is_retargeted_before_anything_is_measured(recordings, tmp_path):
    own = {path.stem: Motion.load(path) for path in sorted(recordings.glob("*.bvh"))}
    rig = next(iter(own.values())).skeleton
    names = {name: name.replace("Left", "l_").replace("Right", "r_").lower() for name in rig.names}
    names |= {"LeftArm": "l_upperarm", "RightArm": "r_upperarm", "Hips": "pelvis"}
    ends = {names[name]: sites for name, sites in rig.end_sites.items()}
    larger = Skeleton(tuple(names.values()), rig.parents, 1.3 * rig.offsets, ends)
    other = {name: retarget(motion, larger) for name, motion in own.items()}
    made = saved(tmp_path / "made", other)
    found = evaluate({"same": recordings, "larger": made}, recordings, cheap=True)
    same, larger_one = found.models
    assert "retargeted" in larger_one.marks and not same.marks
    assert any("3 of 3" in note for note in larger_one.notes)
    # Retargeting there and back leaves the same movement, not one 1.3 times as fast.
    for key in ("wrist_speed", "reach"):
        assert result(found, 1, key) == pytest.approx(result(found, 0, key), rel=0.05), key


def test_a_head_turned_round_is_found_on_a_rig_that_lacks_a_joint(recordings, tmp_path):
    turned = {}
    for path in sorted(recordings.glob("*.bvh")):
        motion = Motion.load(path)
        rotations, head = motion.rotations.copy(), motion.skeleton.index("Head")
        half_turn = np.array([0.0, np.sin(np.deg2rad(75)), 0.0, np.cos(np.deg2rad(75))])
        rotations[:, head] = multiply_quaternions(rotations[:, head], half_turn)
        kept = [name for name in motion.skeleton.names if name != "RightFoot"]
        turned[path.stem] = replace(motion, rotations=rotations).keep(kept)
    found = evaluate(saved(tmp_path / "m", turned), recordings, cheap=True)
    assert result(found, 0, "worst_joint") == 100.0
    assert 0.0 < result(found, 0, "joint_limits") < 20.0


def test_a_body_that_is_three_percent_larger_is_the_same_body(recordings, tmp_path):
    own = {path.stem: Motion.load(path) for path in sorted(recordings.glob("*.bvh"))}
    made = saved(tmp_path / "m", {name: motion.scaled(1.03) for name, motion in own.items()})
    assert not evaluate(made, recordings, cheap=True).models[0].marks


def test_a_body_of_the_same_size_with_other_arms_is_retargeted_to_the_recordings(
    recordings, tmp_path
):
    """Upper arms of half of the length of both bones (squares added), and longer forearms."""
    own = {path.stem: Motion.load(path) for path in sorted(recordings.glob("*.bvh"))}
    rig = next(iter(own.values())).skeleton
    offsets = rig.offsets.copy()
    for side in ("Left", "Right"):
        bones = [rig.index(f"{side}ForeArm"), rig.index(f"{side}Hand")]
        lengths = np.linalg.norm(offsets[bones], axis=1, keepdims=True)
        offsets[bones] *= np.linalg.norm(lengths) * np.sqrt([[0.25], [0.75]]) / lengths
    other = Skeleton(rig.names, rig.parents, offsets, rig.end_sites)
    made = saved(tmp_path / "m", {name: replace(m, skeleton=other) for name, m in own.items()})
    assert "retargeted" in evaluate(made, recordings, cheap=True).models[0].marks


def test_the_recordings_in_another_rest_pose_move_as_the_recordings(recordings, tmp_path):
    own = {path.stem: Motion.load(path) for path in sorted(recordings.glob("*.bvh"))}
    quarter = np.array([0.0, 0.0, -np.sqrt(0.5), np.sqrt(0.5)])
    raised = {k: with_rest_turned(m, quarter, "LeftArm", "RightArm") for k, m in own.items()}
    made = saved(tmp_path / "raised", raised)
    found = evaluate({"same": recordings, "raised": made}, recordings, cheap=True)
    assert "retargeted" in found.models[1].marks
    for key in ("wrist_speed", "reach", "one_nn"):
        assert result(found, 1, key) == pytest.approx(result(found, 0, key), rel=0.01), key
    assert result(found, 1, "worst_joint") == 0.0


def test_a_rate_that_differs_by_a_rounding_is_not_resampled(recordings, tmp_path):
    own = {path.stem: Motion.load(path) for path in sorted(recordings.glob("*.bvh"))}
    for fps, is_resampled in ((15.01, False), (15.1, True)):
        clips = {name: replace(m, fps=fps if name == "clip1" else m.fps) for name, m in own.items()}
        made = saved(tmp_path / f"{fps}", clips)
        notes = evaluate(made, recordings, cheap=True).models[0].clips[1].notes
        assert any("resampled" in note for note in notes) == is_resampled


def test_all_models_are_measured_with_the_joints_that_all_have(recordings, gesture, tmp_path):
    motions = {f"clip{i}": gesture(2.5, 15.0, seed=10 + i) for i in range(3)}
    whole = saved(tmp_path / "whole", motions)
    kept = [n for n in motions["clip0"].skeleton.names if n != "Neck"]
    cut = {name: motion.keep(kept) for name, motion in motions.items()}
    fewer = saved(tmp_path / "fewer", cut)
    found = evaluate({"whole": whole, "fewer": fewer}, recordings)
    # The same motion: with and without the joints that one of them lacks.
    for key in ("acceleration", "hellinger", "coverage", "one_nn", "l1_diversity"):
        assert result(found, 0, key) == pytest.approx(result(found, 1, key), rel=0.05), key
    assert any("fewer" in note and "Neck" in note for note in found.models[1].notes)
    alone = evaluate({"whole": whole}, recordings, cheap=True)
    assert result(alone, 0, "l1_diversity") != pytest.approx(result(found, 0, "l1_diversity"))


def test_clips_that_another_model_lacks_are_set_apart(recordings, gesture, tmp_path):
    motions = {f"clip{i}": gesture(2.5, 15.0, seed=10 + i) for i in range(3)}
    one = saved(tmp_path / "one", motions)
    two = saved(tmp_path / "two", {name: motions[name] for name in ("clip0", "clip2")})
    found = evaluate({"one": one, "two": two}, recordings, cheap=True)
    assert [[clip.pair.stem for clip in m.clips] for m in found.models] == [["clip0", "clip2"]] * 2
    (item,) = (item for item in found.models[0].excluded if item.what == "clip")
    assert item.name == "clip1" and "two" in item.reason
    assert not found.is_complete
    assert any(re.search(r"\b2\b", note) for note in found.models[0].notes)
    three = saved(tmp_path / "three", {"clip1": motions["clip1"]})
    with pytest.raises(EvaluationError, match="two") as refused:
        evaluate({"two": two, "three": three}, recordings)
    assert all(fact in str(refused.value) for fact in ("clip0", "three", "clip1"))


@pytest.mark.parametrize(
    ("missing", "note", "lacks"),
    [
        (("Leg", "Foot"), "legs", {"foot_skate"}),
        (("Hand",), "2 of 19", {"reach", "rest"}),
    ],
)
def test_rigs_without_legs_or_hands_are_measured_as_far_as_they_go(
    recordings, gesture, tmp_path, missing, note, lacks
):
    """They lack the ends of the recordings' feet, too."""
    cut = {f"clip{i}": without_joints(gesture(2.5, 15.0, seed=9), *missing) for i in range(3)}
    (model,) = evaluate(saved(tmp_path / "cut", cut), recordings, cheap=True).models
    assert all(note in "; ".join(clip.notes) for clip in model.clips)
    assert {"arm_speed", "hellinger", "one_nn"} <= set(model.metrics)
    assert not lacks & set(model.metrics)
    if "reach" in lacks:
        assert "likeness" not in model.metrics, "a rig without hands is not unlike the speaker"
    # What compares single clips is listed with its reason; what pools them says it once.
    left_out = [item.what for item in model.excluded]
    assert ("Foot skate" in left_out) == ("foot_skate" in lacks)
    assert left_out.count(DEFINITIONS["reach"].name) == ("reach" in lacks)


def test_models_of_other_lengths_are_marked(recordings, gesture, tmp_path):
    one = saved(tmp_path / "one", {f"clip{i}": gesture(2.5, 15.0, seed=i) for i in range(3)})
    two = saved(tmp_path / "two", {f"clip{i}": gesture(1.5, 15.0, seed=i) for i in range(3)})
    found = evaluate({"one": one, "two": two}, recordings, cheap=True)
    assert [bool(model.marks) for model in found.models] == [False, True]
    assert all(seconds in " ".join(found.models[1].notes) for seconds in ("1.53 s", "2.53 s"))
    said = [any("shorter than" in note for note in model.notes) for model in found.models]
    assert said == [False, True]


def test_a_recording_without_sound_has_no_speech_metrics_and_counts_elsewhere(
    recordings, gesture, tmp_path
):
    made = saved(tmp_path / "made", {f"clip{i}": gesture(2.5, 15.0, seed=9) for i in range(3)})
    (recordings / "clip1.wav").unlink()
    (model,) = evaluate(made, recordings, audio=recordings, cheap=True).models
    assert model.metrics["sync"].interval.n == 2
    assert "2 of 3" in model.metrics["sync"].note
    assert model.metrics["arm_speed"].interval.n == 3
    assert [item.what for item in model.excluded if item.name == "clip1"] == ["speech"]


def test_recordings_of_another_rig_are_left_out_of_the_set(recordings, gesture, tmp_path):
    made = saved(tmp_path / "m", {f"clip{i}": gesture(2.5, 15.0, seed=9) for i in range(3)})
    last = Motion.load(recordings / "clip2.bvh")
    kept = [name for name in last.skeleton.names if name != "Neck"]
    last.keep(kept).save(recordings / "clip2.bvh")
    (model,) = evaluate(made, recordings, cheap=True).models
    reasons = {item.name: item.reason for item in model.excluded if "set" in item.what}
    assert set(reasons) == {"clip2"} and "rig differs" in reasons["clip2"]


def test_windows_belong_to_ten_seconds_of_their_recording(tmp_path, gesture):
    whole = gesture(25.0, 10.0, seed=1)
    whole.save(tmp_path / "recorded" / "a.npz")
    beats = tmp_path / "beats"
    beats.mkdir()
    (beats / "a.txt").write_text("gesture\t12.0\t14.0\t2.0\t0.5\t\n")
    for k, clip in enumerate((whole[100:200], whole[200:], whole[:100])):
        clip.save(tmp_path / "made" / f"a_w00{k + 1}.npz")
    options = {"semantic": beats, "baselines": ("mean_pose",), "cheap": False}
    own, still = evaluate(tmp_path / "made", tmp_path / "recorded", **options).models
    one, two = own.clips
    assert (one.pair.window, two.pair.window) == (1, 2)
    assert one.metrics["rmse"] == pytest.approx(0.0, abs=1e-6)
    assert one.metrics["srgr"] > 0.0, "its gesture is from 2 s to 4 s of the window"
    assert [round(clip.seconds) for clip in still.clips] == [10, 5]
    (late,) = (item for item in own.excluded if item.what == "clip")
    assert late.name == "a_w003" and "before its window 3 (30 s)" in late.reason


def test_models_in_folders_of_one_name_are_told_apart_on_the_page(recordings, tmp_path, page_of):
    models = {}
    for place in ("one", "two"):
        shutil.copytree(recordings, tmp_path / place / "clips")
        models[str(tmp_path / place / "clips")] = tmp_path / place / "clips"
    page = page_of(evaluate(models, recordings, cheap=True))
    assert "clips (1)" in page and "clips (2)" in page and str(tmp_path) not in page
