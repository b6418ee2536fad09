"""Clips as they are read: one frame rate, one rig, their part of the recording, and notes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
from rigs import without_joints

from audio_features import FeatureTrack
from gesturekit.errors import FormatError, MotionError
from gesturekit.evaluation.measuring.clips import (
    ByteCache,
    RecordedSound,
    clip_notes,
    forget_files,
    load_clip,
    read_semantic,
)
from gesturekit.evaluation.measuring.rigs import RETARGETED, matched
from gesturekit.evaluation.pairs import Pair
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.defects import MAX_SPEED
from gesturekit.motion.parts import body_joints
from gesturekit.motion.parts.body_size import body_scale


def test_the_values_used_last_are_kept_up_to_a_number_of_bytes():
    loaded = []

    def get(key: str, size: int) -> bytes:
        return cache.get(key, lambda: loaded.append(key) or bytes(size))

    cache = ByteCache[bytes](10, len)
    for key, size in (("a", 4), ("b", 6), ("a", 4), ("c", 6), ("a", 4), ("b", 6)):
        assert len(get(key, size)) == size
    # c took the place of b, which had not been used for longest; then b that of c.
    assert loaded == ["a", "b", "c", "b"]
    get("too large", 11)
    loaded.clear()
    get("too large", 11)
    get("a", 4)
    assert loaded == ["too large", "a"]
    cache.clear()
    get("a", 4)
    assert loaded == ["too large", "a", "a"]


@pytest.fixture
def pair(tmp_path, gesture):
    """pair(generated, recording, **more): both written to files."""
    forget_files()

    def make(generated: Motion, recording: Motion, window: int | None = None, **more) -> Pair:
        files = [tmp_path / "made" / "a.npz", tmp_path / "recorded" / "a.npz"]
        for motion, path in zip((generated, recording), files, strict=True):
            motion.save(path)
        return Pair("a", "a", window, *files, **more)

    return make


def test_a_clip_has_the_frame_rate_that_is_asked_for_or_its_own(pair, gesture):
    files = pair(gesture(2.0, 20.0), gesture(3.0, 40.0))
    clip = load_clip(files)
    assert (clip.generated.fps, clip.recording.fps, clip.notes) == (20, 20, ())
    assert (clip.generated.n_frames, clip.recording.n_frames, clip.n_frames) == (40, 60, 40)
    clip = load_clip(files, 40.0)
    assert (clip.generated.fps, clip.recording.fps) == (40, 40)
    assert clip.notes == ("resampled from 20 to 40 fps",) and clip.semantic is None
    assert clip.joints == body_joints(clip.recording.skeleton)


@pytest.mark.parametrize("short", ["made", "recorded"])
def test_one_frame_is_no_motion(pair, gesture, short):
    motions = {"made": gesture(1.0), "recorded": gesture(1.0)}
    motions[short] = motions[short][:1]
    with pytest.raises(FormatError, match="one frame; a motion to be measured has at least 2"):
        load_clip(pair(*motions.values()))
    motions[short] = gesture(1.0)[:2]
    forget_files()
    assert load_clip(pair(*motions.values())).n_frames == 2


def test_a_window_is_ten_seconds_of_the_recording_and_of_its_track(pair, gesture, tmp_path):
    whole = gesture(25.0, 10.0)
    track = FeatureTrack(np.arange(25.0)[:, None], np.arange(25.0), {"kind": "semantic"})
    track.save(tmp_path / "track.npz")
    for window, first, stop in ((0, 0, 100), (1, 100, 200), (2, 200, 250)):
        forget_files()
        clip = load_clip(pair(whole[:100], whole, window, semantic=tmp_path / "track.npz"))
        assert clip.recording.rotations == pytest.approx(whole.rotations[first:stop], abs=1e-6)
        assert clip.semantic.times[0] == 0 and clip.semantic.values[0, 0] == 10 * window
        assert len(clip.semantic.times) == 25 - 10 * window
    for seconds, window, ends in ((20.1, 2, True), (20.2, 2, False), (19.0, 2, True)):
        forget_files()
        recording = whole[: round(10 * seconds)]
        if ends:
            with pytest.raises(
                MotionError, match=r"a\.npz ends before its window 2 \(20 s\) begins"
            ):
                load_clip(pair(whole[:100], recording, window))
        else:
            assert load_clip(pair(whole[:100], recording, window)).n_frames == 2
    # The last value of a track that ends before the window stays.
    short = FeatureTrack(np.array([[1.0], [2.0]]), np.array([0.0, 1.0]), {"kind": "semantic"})
    short.save(tmp_path / "short.npz")
    forget_files()
    clip = load_clip(pair(whole[:100], whole, 1, semantic=tmp_path / "short.npz"))
    assert clip.semantic.values.tolist() == [[2.0]]


def test_joints_that_another_model_lacks_are_left_out(pair, gesture):
    files = pair(gesture(1.0), gesture(1.0))
    assert "Neck" not in load_clip(files, without=frozenset({"neck"})).joints
    every = frozenset(name.lower() for name in load_clip(files).joints[1:])
    with pytest.raises(MotionError, match="fewer than 2 joints are common to all models"):
        load_clip(files, without=every)
    assert len(load_clip(files, without=every - {"neck"}).joints) == 2


def test_bodies_are_the_same_whose_bones_agree_to_a_hundredth(pair, gesture):
    recording = gesture(1.0)
    for factor, same in ((1.0, True), (1.009, True), (1.02, False)):
        forget_files()
        assert load_clip(pair(recording.scaled(factor), recording)).same_body == same


@pytest.mark.parametrize(
    ("frames", "wanted", "note"),
    [
        (75, 1.0, None),
        (73, 1.0, None),
        (72, 1.0, "0.12 s shorter than its recording"),
        (78, 1.0, "0.12 s longer than its recording"),
        (150, 2.0, None),
        (75, 2.0, "3.00 s shorter than 2 times its recording"),
    ],
)
def test_another_length_than_expected_is_noted(pair, gesture, frames, wanted, note):
    clip = load_clip(pair(gesture(9.0, 25.0)[:frames], gesture(3.0, 25.0)))
    assert clip_notes(clip, wanted) == ([note] if note else [])


def test_two_frames_of_a_slow_rate_are_no_other_length(pair, gesture):
    """At 5 fps a frame is 0.2 s; only more than one and a half of them are noted."""
    clip = load_clip(pair(gesture(9.0, 5.0)[:14], gesture(3.0, 5.0)))
    assert clip_notes(clip) == []
    forget_files()
    clip = load_clip(pair(gesture(9.0, 5.0)[:13], gesture(3.0, 5.0)))
    assert clip_notes(clip) == ["0.40 s shorter than its recording"]


def test_frames_that_stand_still_and_jumps_are_noted(pair, gesture):
    motion = gesture(4.0, 25.0)

    def notes(still: int, jump: float) -> list[str]:
        rotations, path = motion.rotations.copy(), motion.translation.copy()
        rotations[20 : 20 + still + 1] = rotations[20]
        path[50:, 0] += jump
        forget_files()
        changed = replace(motion, rotations=rotations, translation=path)
        return clip_notes(load_clip(pair(changed, motion)))

    # Of 99 steps 4 are 4 %, and 5 are 5.05 %.
    assert notes(4, 0.0) == []
    (note,) = notes(5, 0.0)
    assert note == "stands still in 5 % of its frames"
    limit = MAX_SPEED * body_scale(motion.skeleton) / 25
    assert notes(0, 0.9 * limit) == []
    (note,) = notes(0, 1.2 * limit)
    assert note.startswith("jumps at 1.96 s (")


def test_a_table_of_gestures_is_a_track_of_hundredths(tmp_path):
    table = tmp_path / "a.txt"
    table.write_text("x\t0.1\t0.3\t0.2\t0.5\t\ny\t1.0\t1.23\t0.23\t0.9\tword\n")
    track = read_semantic(table)
    assert np.diff(track.times) == pytest.approx(0.01) and track.times[0] == 0
    assert track.times[-1] == pytest.approx(1.24), "it ends without a gesture"
    score = dict(zip(np.round(track.times, 2), track.values[:, 0]))
    assert [score[t] for t in (0.09, 0.11, 0.29, 0.32, 1.01, 1.22, 1.24)] == pytest.approx(
        [0, 0.5, 0.5, 0, 0.9, 0.9, 0]
    )
    FeatureTrack(np.zeros((3, 2)), np.arange(3.0)).save(tmp_path / "two.npz")
    with pytest.raises(FormatError, match="2 columns; a semantic track has one, the score"):
        read_semantic(tmp_path / "two.npz")


def test_the_sound_of_a_window_is_its_ten_seconds(tmp_path):
    samples = np.repeat([0.1, 0.2, 0.3], [40_000, 40_000, 16_000])
    soundfile.write(tmp_path / "a.wav", samples, 4000, subtype="FLOAT")
    whole = RecordedSound.load(tmp_path / "a.wav", None).wave
    assert whole.duration == pytest.approx(24)
    second = RecordedSound.load(tmp_path / "a.wav", 1).wave
    assert second.duration == pytest.approx(10) and second.samples == pytest.approx(0.2)
    assert RecordedSound.load(tmp_path / "a.wav", 2).wave.samples[0] == pytest.approx(0.3)


def with_names(motion: Motion, rename) -> Motion:
    names = {name: rename(name) for name in motion.skeleton.names}
    ends = {names[name]: sites for name, sites in motion.skeleton.end_sites.items()}
    rig = replace(motion.skeleton, names=tuple(names.values()), end_sites=ends)
    moved = {names[name]: places for name, places in motion.joint_translations.items()}
    return replace(motion, skeleton=rig, joint_translations=moved)


def test_names_in_any_case_and_name_space_are_the_recordings(gesture):
    recording, motion = gesture(1.0, seed=1), gesture(1.0)
    joints, found, notes = matched(with_names(motion, lambda n: f"rig:{n.upper()}"), recording)
    assert joints == body_joints(recording.skeleton) and notes == []
    assert found.skeleton.names == recording.skeleton.names
    assert found.skeleton.end_sites.keys() == recording.skeleton.end_sites.keys()
    assert np.array_equal(found.rotations, motion.rotations)
    moved = replace(motion, joint_translations={"Head": np.ones((30, 3))})
    _, found, _ = matched(with_names(moved, lambda n: f"rig:{n}"), recording)
    assert list(found.joint_translations) == ["Head"]


@pytest.mark.parametrize(("factor", "same"), [(1.0, True), (1.04, True), (1.09, False)])
def test_another_body_is_retargeted(gesture, factor, same):
    recording = gesture(1.0, seed=1)
    joints, found, notes = matched(gesture(1.0).scaled(factor), recording)
    assert joints == body_joints(recording.skeleton)
    assert notes == ([] if same else [RETARGETED])
    lengths = np.linalg.norm(found.skeleton.offsets[1:], axis=1)
    own = np.linalg.norm(recording.skeleton.offsets[1:], axis=1)
    assert lengths == pytest.approx(own * (factor if same else 1.0))


def test_bones_of_joints_that_move_are_not_compared(gesture):
    """A joint with places of its own has no bone of one length."""
    recording = gesture(1.0, seed=1)
    offsets = recording.skeleton.offsets.copy()
    offsets[recording.skeleton.index("Head")] *= 2
    longer = replace(recording, skeleton=replace(recording.skeleton, offsets=offsets))
    assert matched(longer, recording)[2] == [RETARGETED]
    moved = {"Head": np.tile([0.0, 0.1, 0.0], (30, 1))}
    assert matched(replace(longer, joint_translations=moved), recording)[2] == []
    assert matched(longer, replace(recording, joint_translations=moved))[2] == []


def test_joints_that_the_generated_rig_lacks_are_counted(gesture):
    recording = gesture(1.0, seed=1)
    n = len(body_joints(recording.skeleton))
    joints, _, notes = matched(without_joints(gesture(1.0), "Neck", "Head"), recording)
    assert notes == [f"2 of {n} body joints are not in the generated rig"]
    assert set(body_joints(recording.skeleton)) - set(joints) == {"Neck", "Head"}
    # A bone over a joint that is missing in one rig is that of both.
    kept = [name for name in recording.skeleton.names if "Shoulder" not in name]
    joints, _, notes = matched(gesture(1.0).keep(kept), recording)
    assert joints == tuple(kept) and notes == [f"2 of {n} body joints are not in the generated rig"]


def test_legs_are_not_compared_with_a_motion_that_has_none(gesture):
    recording = gesture(1.0, seed=1)
    bust = without_joints(gesture(1.0), "Leg", "Foot")
    joints, found, notes = matched(bust, recording)
    assert notes == ["the generated rig has no legs"]
    assert {n for n in recording.skeleton.names if "Leg" in n or "Foot" in n}.isdisjoint(joints)
    joints, found, notes = matched(bust.scaled(1.5), recording)
    assert notes == [RETARGETED, "the generated rig has no legs"]
    assert not [n for n in found.skeleton.names if "Leg" in n or "Foot" in n]
    assert joints == tuple(n for n in found.skeleton.names if n in body_joints(found.skeleton))


def test_rigs_without_common_names_or_body_parts_do_not_match(gesture):
    recording = gesture(1.0, seed=1)
    recording = replace(recording, skeleton=replace(recording.skeleton, end_sites={}))
    rig = recording.skeleton
    half = rig.n_joints // 2
    numbers = {name: f"bone{k}" for k, name in enumerate(rig.names)}
    with pytest.raises(MotionError, match=r"0 of 19 body joints .*\(missing: Hips, Spine, Chest,"):
        matched(with_names(recording, numbers.get), recording)
    # Half of the joints by name are enough for the same bones; one less is not.
    for kept, enough in ((half + 1, True), (half, False)):
        some = {n: n if k < kept else numbers[n] for k, n in enumerate(rig.names)}
        motion = with_names(recording, some.get)
        if enough:
            assert matched(motion, recording)[0] == rig.names[:kept]
        else:
            with pytest.raises(MotionError, match=f"{kept} of 19 body joints .*found by name"):
                matched(motion, recording)
    lone = Skeleton(("root",), (-1,), np.zeros((1, 3)))
    still = Motion(lone, np.tile([0.0, 0, 0, 1], (30, 1, 1)), np.zeros((30, 3)), 30.0)
    with pytest.raises(MotionError, match="the recording has 1 body joint"):
        matched(recording, still)


def test_a_file_that_cannot_be_read_is_named(tmp_path, gesture, pair):
    files = pair(gesture(1.0), gesture(1.0))
    Path(files.generated).write_bytes(b"no motion")
    with pytest.raises(FormatError, match=r"a\.npz"):
        load_clip(files)
