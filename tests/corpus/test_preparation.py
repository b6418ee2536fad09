from __future__ import annotations

import json
import os
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
import soundfile
from rigs import nameless, rig_of

from gesturekit.corpus import Manifest, prepare
from gesturekit.corpus.preparation import PrepareOptions
from gesturekit.errors import ConfigError, CorpusError
from gesturekit.inspection.corpus import inspect_recordings
from gesturekit.motion import Motion
from gesturekit.motion.parts.body_size import body_height
from gesturekit.training.data.sources import TrainedSegment, is_trained_on


def errors(report):
    return [problem for problem in report.problems if problem.severity == "error"]


def texts(report, severity):
    return [problem.text for problem in report.problems if problem.severity == severity]


@pytest.fixture
def write_pairs(tmp_path, write_speech):
    """write_pairs(NAME=motion, ...): each with 4 s of speech beside it."""

    def write(**motions) -> None:
        for name, motion in motions.items():
            motion.save(tmp_path / f"{name}.bvh")
            write_speech(tmp_path / f"{name}.wav", 4.0)

    return write


def test_pairs_become_items_of_a_manifest_that_loads(tmp_path, write_pair):
    for i in range(4):
        write_pair(tmp_path / "in", f"take{i}", seed=i)
    report = prepare(tmp_path / "in", tmp_path / "out" / "corpus.jsonl", speaker="ann")
    assert report.is_complete and not report.problems
    manifest = Manifest.load(tmp_path / "out" / "corpus.jsonl")
    assert [item.id for item in manifest] == [f"take{i}" for i in range(4)]
    assert {item.speaker for item in manifest} == {"ann"}
    assert len(manifest.paired("train")) == 3 and len(manifest.paired("test")) == 1
    for item in manifest:
        assert item.load_wave().n_frames(30) == item.load_motion().n_frames == 120


def test_an_easymocap_folder_is_a_recording(tmp_path, write_speech, gesturekit):
    """It pairs with a sound of its name; --person chooses, and the manifest keeps it."""
    folder = tmp_path / "in" / "take.1" / "smpl"
    folder.mkdir(parents=True)
    for t in range(60):
        turns = [[0.2 + 0.01 * t * person] * 72 for person in (1, 2)]
        people = [
            {"id": i, "Rh": [[1.5, 0, 0]], "Th": [[0, 0, 1]], "poses": [turn], "shapes": [[0] * 10]}
            for i, turn in enumerate(turns)
        ]
        (folder / f"{t:06d}.json").write_text(json.dumps(people))
    write_speech(tmp_path / "in" / "take.1.wav", 2.0)
    prepared = ("prepare", tmp_path / "in", "--out", tmp_path / "c.jsonl", "--person", 1)
    gesturekit(*prepared, "--in-fps", 30).ok()
    (item,) = Manifest.load(tmp_path / "c.jsonl").paired()
    assert item.motion == folder.parent and item.reading == {"person": 1, "fps": 30.0}
    read, want = item.load_motion(), Motion.load(folder.parent, person=1, fps=30.0)
    first = round(item.motion_start * 30)  # a rest pose is trimmed
    np.testing.assert_array_equal(read.rotations, want.rotations[first : first + read.n_frames])
    shutil.copytree(folder.parent, tmp_path / "in" / "copy")
    write_speech(tmp_path / "in" / "copy.wav", 2.0)
    named = f"{folder.parent} (of {tmp_path / 'in' / 'copy'})"
    assert named in gesturekit(*prepared, "--in-fps", 30).ok().err
    segment = TrainedSegment.of(item, 30.0)
    assert is_trained_on([segment], item.motion)
    (folder / "000000.json").write_text("[]")
    assert not is_trained_on([segment], item.motion)


def test_words_beside_a_recording_become_features_on_motion_frames(tmp_path, write_pair):
    import audio_features as af
    from gesturekit.corpus.speech import extract

    write_pair(tmp_path / "in", "take", 4.0)
    (tmp_path / "in" / "take.ctm").write_text("take 1 0.5 0.3 so\ntake 1 2.5 0.2 well\n")
    report = prepare(tmp_path / "in", tmp_path / "corpus.jsonl", hold_out_seconds="2-")
    assert report.is_complete and "side files    words from .ctm (1)" in report.table()
    for item, onset in zip(Manifest.load(tmp_path / "corpus.jsonl"), (15, 15), strict=True):
        assert item.conditions["words"] == tmp_path / "in" / "take.ctm"
        values, _ = extract(item.load_wave(), af.Words(), 30.0, "mean")
        np.testing.assert_array_equal(np.flatnonzero(values[:, 1]), [onset])


def test_the_same_folders_give_the_same_bytes(tmp_path, write_pair):
    for name in ("b", "a", "c"):
        write_pair(tmp_path / "in", name, 1.0)
    prepare([tmp_path / "in"], tmp_path / "one.jsonl", seed=3)
    prepare([tmp_path / "in"], tmp_path / "two.jsonl", seed=3)
    assert (tmp_path / "one.jsonl").read_bytes() == (tmp_path / "two.jsonl").read_bytes()


def test_bad_files_are_reported_once_and_others_used(tmp_path, write_pair, write_speech, gesture):
    write_pair(tmp_path, "fine")
    for name in ("text", "empty", "cut", "apart", "twice"):
        write_pair(tmp_path, name)
    (tmp_path / "text.wav").write_text("this is no sound\n" * 100)
    (tmp_path / "empty.wav").write_bytes(b"")
    rows = (tmp_path / "cut.bvh").read_text().rstrip().splitlines()
    (tmp_path / "cut.bvh").write_text("\n".join([*rows[:-1], rows[-1][:40]]) + "\n")
    write_speech(tmp_path / "apart.wav", 6.0)
    write_speech(tmp_path / "twice.flac", 4.0)
    report = prepare(tmp_path, holdout=0.0)
    assert [item.id for item in report.manifest] == ["cut", "fine"]
    assert not report.is_complete
    (warning,) = [text for text in texts(report, "warning") if "cut" in text]
    assert "declares 120 frames and holds 119, and its last line is incomplete" in warning
    told = "\n".join(problem.text for problem in errors(report))
    assert len(errors(report)) == 4
    for name in ("text.wav", "empty.wav", "apart.bvh", "twice.wav", "twice.flac"):
        assert str(tmp_path / name) in told
    assert "6.00 s of sound and 4.00 s of motion differ by 2.00 s" in told
    assert all("\n" not in problem.message for problem in errors(report))


def test_a_small_difference_in_length_is_trimmed_to_the_shorter(tmp_path, write_pair, write_speech):
    write_pair(tmp_path, "a", 4.0)
    write_speech(tmp_path / "a.wav", 3.1)
    report = prepare(tmp_path, holdout=0.0)
    (item,) = report.manifest
    assert item.duration == pytest.approx(3.1, abs=1e-5)
    assert item.load_wave().n_frames(30) == item.load_motion().n_frames == 93
    assert "trimmed to the shorter" in texts(report, "warning")[0] and report.is_complete


def test_a_file_that_was_shortened_after_prepare_is_named(tmp_path, write_pair, write_speech):
    write_pair(tmp_path, "a", 4.0)
    (item,) = prepare(tmp_path, holdout=0.0).manifest
    write_speech(tmp_path / "a.wav", 3.95)  # as another decoder may read it
    assert item.load_wave().duration == pytest.approx(3.95, abs=1e-3)
    write_speech(tmp_path / "a.wav", 3.0)
    with pytest.raises(CorpusError, match=r"'a' is 4.00 s of .*a\.wav .*only 3.00 s.*prepare"):
        item.load_wave()


def test_a_cut_file_is_let_through_by_its_name_alone(
    gesturekit, tmp_path, write_pair, write_speech
):
    for name in "ab":
        write_pair(tmp_path / "in", name, 4.0)
        write_speech(tmp_path / "in" / f"{name}.wav", 5.23)
    command = ("prepare", tmp_path / "in", "--out", tmp_path / "c.jsonl", "--holdout", 0)
    advice = re.findall("--trim [ab]$", gesturekit(*command).fails(2).err, re.MULTILINE)
    assert advice == ["--trim a", "--trim b"]
    done = gesturekit(*command, *advice[1].split()).fails(1, "--trim a")
    assert "paired        1 recording, 4.0 s" in done.out and "--trim b" not in done.err
    gesturekit(*command, "--trim", "a, b").ok()
    gesturekit(*command, "--existing", "replace", "--trim", "c").fails(2, "no recording 'c'")


@pytest.fixture
def copied(tmp_path, write_pair):
    """A folder of five recordings: b is a copy of a, and e has the sound of d."""
    for name in "acde":
        write_pair(tmp_path / "in", name, 4.0)
    for new, old in (("b.wav", "a.wav"), ("b.bvh", "a.bvh"), ("e.wav", "d.wav")):
        shutil.copy(tmp_path / "in" / old, tmp_path / "in" / new)
    return tmp_path / "in"


def test_copies_are_named_and_stay_in_one_split(copied):
    for seed in range(8):
        report = prepare(copied, seed=seed, holdout=0.4, unpaired=copied)
        splits = {item.id: item.split for item in report.manifest}
        assert splits["a"] == splits["b"] and splits["d"] == splits["e"], seed
        assert {"train", "test"} <= set(splits.values())
    (text,) = texts(report, "warning")
    assert text.startswith("3 files with the content of another: ")
    assert all(
        f"{copied / f'b.{kind}'} (of {copied / f'a.{kind}'})" in text for kind in ("wav", "bvh")
    )
    assert prepare(copied, hold_out_pattern="^b$").manifest.paired("test")[0].id == "a"


def test_of_copies_alone_the_same_end_is_held_out(copied):
    for name in "cde":
        (copied / f"{name}.bvh").unlink()
    alike = [(item.split, item.duration) for item in prepare(copied).manifest]
    assert alike == [("train", 3.2), ("test", 0.8)] * 2


def test_a_leading_t_pose_is_trimmed_from_sound_and_motion(tmp_path, write_pair, gesture):
    write_pair(tmp_path, "a", 4.0, t_pose=20)
    report = prepare(tmp_path, holdout=0.0)
    (item,) = report.manifest
    assert item.motion_start == item.audio_start == pytest.approx(20 / 30, abs=1e-6)
    assert item.load_motion().n_frames == 100
    assert abs(item.load_motion().positions() - gesture(4.0).positions()[20:]).max() < 1e-4
    assert "20 frames (0.67 s) of T-pose or rest pose at the start" in texts(report, "warning")[0]


def test_a_t_pose_of_an_actor_is_found_though_not_the_rest_pose(tmp_path, write_pairs, gesture):
    motion = gesture(4.0, t_pose=20)
    rng = np.random.default_rng(0)
    rotations = motion.rotations.copy()
    # A few degrees of sway in every joint, and the whole body turned by a right angle.
    rotations[:20, 1:, :3] += rng.normal(0.0, 0.01, (motion.skeleton.n_joints - 1, 3))
    rotations[:20, 0] = [0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5)]
    rotations /= np.linalg.norm(rotations, axis=-1, keepdims=True)
    write_pairs(a=replace(motion, rotations=rotations))
    (item,) = prepare(tmp_path, holdout=0.0).manifest
    assert item.motion_start == pytest.approx(20 / 30, abs=1e-6)


def test_a_motion_that_is_t_pose_throughout_is_warned_about_and_not_trimmed(tmp_path, write_pair):
    write_pair(tmp_path, "a", 2.0, t_pose=60)
    report = prepare(tmp_path, holdout=0.0)
    (item,) = report.manifest
    assert (item.motion_start, item.duration) == (0.0, 2.0) and report.is_complete
    assert "T-pose or rest pose throughout" in texts(report, "warning")[0]


def test_frozen_motion_is_warned_about(tmp_path, write_pairs, gesture):
    motion = gesture(4.0)
    rotations = motion.rotations.copy()
    rotations[40:80] = rotations[40]
    still = np.broadcast_to(rotations[:1], rotations.shape).copy()
    write_pairs(part=replace(motion, rotations=rotations), whole=replace(motion, rotations=still))
    report = prepare(tmp_path, holdout=0.0)
    assert [item.id for item in report.manifest] == ["part", "whole"] and report.is_complete
    part, whole = texts(report, "warning")
    assert part == f"{tmp_path / 'part.bvh'}: frozen (no joint moves at all) from 1.33 s to 2.67 s"
    assert "all 120 frames hold one and the same pose" in whole


def test_jumps_are_warned_about_with_what_to_check_if_many(tmp_path, write_pairs, gesture):
    motion = gesture(4.0)
    once, often = motion.translation.copy(), motion.translation.copy()
    once[60:] += [1.0, 0.0, 0.0]
    often[::2] += [1.0, 0.0, 0.0]
    write_pairs(once=replace(motion, translation=once), often=replace(motion, translation=often))
    report = prepare(tmp_path, holdout=0.0)
    assert [item.id for item in report.manifest] == ["often", "once"] and report.is_complete
    often, once = (text for text in texts(report, "warning") if "frames jump" in text)
    assert "119 of 120 frames jump (over 10 m/s) at" in often
    assert "--in-unit" in often and "--height" in often
    assert "1 of 120 frames jump (over 10 m/s) at 2.00 s" in once and "--in-unit" not in once


def test_pops_and_jitter_are_warned_about(tmp_path, write_pairs, gesture):
    motion = gesture(4.0)
    popping, shaking = motion.rotations.copy(), motion.translation.copy()
    popping[[30, 90], motion.skeleton.index("Head")] = [0.0, 0.5, 0.0, 0.75**0.5]
    shaking[::2] += [0.004, 0.0, 0.0]
    write_pairs(pop=replace(motion, rotations=popping), shake=replace(motion, translation=shaking))
    report = prepare(tmp_path, holdout=0.0)
    assert len(report.manifest) == 2 and not errors(report)
    pop, shake = sorted(texts(report, "warning"))
    assert re.search(r"pop.bvh: pops .* at 1.00 s, 3.00 s; most of all 'Head' by \d\d°", pop)
    assert re.search(r"shake.bvh: jitters in 9\d% of its frames", shake)


def test_unidentified_parts_are_reported_and_can_be_specified(tmp_path, write_pairs, gesture):
    motion, by_hand = nameless(gesture(4.0))  # without toes nothing tells left from right
    write_pairs(a=motion)
    report = prepare(tmp_path, holdout=0.0)
    (note,) = texts(report, "note")
    assert len(report.manifest) == 1
    says = r"a.bvh: cannot identify the arms.*which way is forward.*parts: \{left_elbow:"
    assert re.search(says, note) and note.endswith(", and in multires speech moves all joints")
    (note,) = texts(prepare([], unpaired_motion=tmp_path), "note")
    assert note.endswith("training leaves out what needs these parts"), "without speech"
    assert not prepare(tmp_path, holdout=0.0, parts=by_hand).problems
    wrong = prepare(tmp_path, holdout=0.0, parts={"left_elbow": "Joint99"})
    assert "Joint99" in texts(wrong, "error")[0]


def test_a_recording_with_too_little_of_use_is_left_out(tmp_path, write_pair):
    write_pair(tmp_path, "a", 2.0, t_pose=50)
    report = prepare(tmp_path)
    assert len(report.manifest) == 0
    assert "too short: 0.33 s can be used; at least 0.5 s" in texts(report, "error")[0]


def test_one_channel_of_a_shared_file_is_checked_and_remembered(tmp_path, write_pair):
    write_pair(tmp_path, "a")
    sound, rate = soundfile.read(tmp_path / "a.wav")
    two = np.stack([np.zeros_like(sound), sound + 0.1], axis=1)
    soundfile.write(tmp_path / "a.wav", two, rate)
    found = {}
    for channel in (None, 1, 2):
        report = prepare(tmp_path, tmp_path / "m.jsonl", holdout=0.0, channel=channel)
        (item,) = Manifest.load(tmp_path / "m.jsonl")
        assert item.channel == channel
        found[channel] = item.load_wave().samples
        (warning,) = texts(report, "warning")
        assert ("silence" if channel == 1 else "DC offset") in warning
    assert not found[1].any()
    np.testing.assert_allclose(found[2], two[: len(found[2]), 1], atol=1e-4)
    np.testing.assert_allclose(found[None], found[2] / 2, atol=1e-4)
    report = prepare(tmp_path, holdout=0.0, channel=3)
    assert len(report.manifest) == 0 and "the file has 2" in texts(report, "error")[0]


def test_the_odd_skeleton_is_left_out_and_its_first_difference_named(tmp_path, write_pair):
    for name in ("a", "b", "odd"):
        write_pair(tmp_path, name)
    text = (tmp_path / "odd.bvh").read_text()
    (tmp_path / "odd.bvh").write_text(text.replace("JOINT Chest", "JOINT Thorax"))
    report = prepare(tmp_path)
    assert {item.id for item in report.manifest} == {"a", "b"}
    (problem,) = errors(report)
    assert problem.file == tmp_path / "odd.bvh"
    assert "'Thorax' here and 'Chest' in the others" in problem.message


def test_different_frame_rates_are_noted(tmp_path, write_pair):
    write_pair(tmp_path, "a", fps=30.0)
    write_pair(tmp_path, "b", fps=120.0)
    write_pair(tmp_path, "c", fps=120.0)
    report = prepare(tmp_path)
    assert len(report.manifest) == 3
    (note,) = texts(report, "note")
    assert note == "frame rates differ: 30 (1), 120 (2); training resamples them to one"


def test_the_last_fifth_of_a_single_recording_is_held_out(tmp_path, write_pair):
    write_pair(tmp_path, "a", 10.0)
    report = prepare(tmp_path)
    train, test = report.manifest
    assert (train.split, test.split) == ("train", "test")
    paired = dict(report.rows())["paired"]
    assert paired == "1 recording in 2 parts, 10.0 s: train 1 (8.0 s), test 1 (2.0 s)"
    assert (train.audio_start, train.duration) == (0.0, 8.0)
    assert (test.audio_start, test.motion_start, test.duration) == (8.0, 8.0, 2.0)
    assert prepare(tmp_path, holdout=0.0).manifest.items[0].split == "train"


def test_named_seconds_are_held_out_and_parts_fit_together(tmp_path, write_pair, gesture):
    write_pair(tmp_path, "a", 6.0)
    report = prepare(tmp_path, hold_out_seconds=[(2.01, 4.02)])
    parts = sorted(report.manifest, key=lambda item: item.audio_start)
    assert [item.split for item in parts] == ["train", "test", "train"]
    # Cuts lie on motion frames: sound and motion of a part begin together.
    assert [item.audio_start * 30 for item in parts] == pytest.approx([0, 60, 121], abs=1e-4)
    joined = np.concatenate([item.load_motion().rotations for item in parts])
    assert joined.shape == gesture(6.0).rotations.shape
    assert sum(len(item.load_wave().samples) for item in parts) == pytest.approx(96000, abs=3)


def test_intervals_outside_every_recording_are_reported(tmp_path, write_pair):
    write_pair(tmp_path, "a", 3.0)
    report = prepare(tmp_path, hold_out_seconds=[(50.0, 60.0)])
    assert report.manifest.items[0].split == "train"
    assert "nothing of it lies in the seconds held out" in texts(report, "warning")[0]
    report = prepare(tmp_path, hold_out_seconds=[(0.3, 2.0)])
    assert {(i.split, round(i.duration, 3)) for i in report.manifest} == {
        ("test", 1.7), ("train", 1.0)
    }  # fmt: skip
    assert "0.00 to 0.30 s left out: too short a piece" in texts(report, "note")[0]


def test_speech_or_motion_alone_is_left_over_unasked(tmp_path, write_pair, write_speech, gesture):
    write_pair(tmp_path, "a")
    write_speech(tmp_path / "talk" / "b.flac", 2.0)
    gesture(2.0).save(tmp_path / "dance" / "c.bvh")
    report = prepare(tmp_path)
    assert set(report.left_over) == {tmp_path / "talk" / "b.flac", tmp_path / "dance" / "c.bvh"}
    assert not report.is_complete
    alone = {"unpaired": [tmp_path / "talk"], "unpaired_motion": [tmp_path / "dance"]}
    report = prepare(tmp_path, **alone, speaker="ann")
    assert report.is_complete
    assert [item.id for item in report.manifest.unpaired()] == ["b"]
    assert [item.id for item in report.manifest.motion_alone()] == ["c"]
    assert {item.id: item.speaker for item in report.manifest.unpaired()} == {"b": None}


def test_a_folder_given_as_unpaired_too_keeps_its_pairs(tmp_path, write_pair, write_speech):
    write_pair(tmp_path, "a")
    write_speech(tmp_path / "b.wav", 2.0)
    report = prepare(tmp_path, unpaired=[tmp_path], holdout=0.0)
    assert [item.id for item in report.manifest.paired()] == ["a"]
    assert [item.id for item in report.manifest.unpaired()] == ["b"]
    assert report.is_complete


def test_labels_come_from_names(tmp_path, write_pair):
    for name in ("ann/calm_1", "bob/lively_1", "bob/other"):
        write_pair(tmp_path, name, 2.0)
    pattern = r"(?P<speaker>\w+)/(?P<style>calm|lively)_.*"
    report = prepare(tmp_path, style_pattern=pattern, speaker="somebody")
    labels = [(item.id, item.speaker, item.style) for item in report.manifest]
    calm, lively = ("ann/calm_1", "ann", "calm"), ("bob/lively_1", "bob", "lively")
    assert labels == [calm, lively, ("bob/other", "somebody", None)]
    assert "other.bvh: name does not match" in texts(report, "note")[0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"holdout": 1.0}, "holdout is 1.0"),
        ({"tolerance": float("nan")}, "tolerance is nan"),
        ({"style_pattern": "("}, "not a regular expression"),
        ({"style_pattern": "calm"}, "no group named style"),
        ({"unpaired": ["nowhere"]}, "no such folder"),
        ({"take_table": "none.csv"}, "table of takes none.csv: no such file"),
        ({"seed": -1}, "seed is -1"),
        ({"workers": 0}, "workers is 0"),
        ({"workers": 1025}, "workers is 1025"),
        ({"holdout": -0.1}, "holdout is -0.1"),
        ({"read": {"animation": 1}}, "read: unknown option 'animation'"),
        ({"read": {"body_model": "none.npz"}}, "body model none.npz: no such file or folder"),
        ({"tolerance": -0.1}, "tolerance is -0.1"),
        ({"hold_out_seconds": "1-2", "hold_out_pattern": "a"}, "either seconds or names"),
    ],
)
def test_invalid_arguments_are_refused_before_anything_is_read(tmp_path, options, message):
    with pytest.raises(CorpusError, match=message):
        prepare(tmp_path, **options)


def test_the_ends_of_the_ranges_of_options_are_inside(tmp_path):
    ends = {"workers": 1024, "tolerance": 0.0, "holdout": 0.0, "seed": 0, "shift": -1}
    assert PrepareOptions(**ends).hold_out_seconds == ()
    assert PrepareOptions(read={"body_model": tmp_path}).read["body_model"] == tmp_path
    held = PrepareOptions(hold_out_speakers=" ann, ,bob").hold_out()
    assert held.speakers == ("ann", "bob")
    # What cannot be is an error before any file is looked for.
    for wrong, says in (
        ({"take_pattern": "("}, "take pattern"),
        ({"hold_out_seconds": "x"}, "'x'"),
    ):
        with pytest.raises(CorpusError, match=says):
            PrepareOptions(**wrong)


def test_the_report_reads_as_a_table_with_every_problem(tmp_path, write_pair, write_speech):
    for i in range(3):
        write_pair(tmp_path, f"take{i}", 2.0)
    for i in range(5):
        write_speech(tmp_path / "talk" / f"s{i}.wav", 1.0, rate=22050)
    report = prepare(tmp_path, style="calm")
    assert "takes" not in dict(report.rows()), "each file is a take of its own"
    text = str(report)
    assert "paired        3 recordings, 6.0 s: train 2 (4.0 s), test 1 (2.0 s)" in text
    assert "frame rates   30 fps (3)" in text
    assert "styles        calm (3)" in text and "speakers      none named" in text
    alone = f"speech without motion in {tmp_path / 'talk'}: s0.wav, s1.wav, s2.wav and 2 more"
    assert alone in text


def test_real_recordings_of_several_rigs_in_one_folder(tmp_path, shared_data):
    out = tmp_path / "corpus.jsonl"
    report = prepare(shared_data / "paired", out, unpaired=[shared_data / "speech" / "ljspeech"])
    assert report.is_complete
    train, test = report.manifest.paired()
    assert test.duration == pytest.approx(0.2 * 68.83, abs=0.05)
    assert len(report.manifest.unpaired()) == 25
    first = json.loads(out.read_text().splitlines()[1])
    assert not first["audio"].startswith("/")


def test_pipes_are_reported_and_never_opened(tmp_path, write_pair):
    write_pair(tmp_path, "fine")
    write_pair(tmp_path, "pipe")
    (tmp_path / "pipe.bvh").unlink()
    os.mkfifo(tmp_path / "pipe.npz")
    report = prepare(tmp_path, holdout=0.0)
    assert [item.id for item in report.manifest] == ["fine"]
    (problem,) = errors(report)
    assert problem.text == f"{tmp_path / 'pipe.npz'}: not a regular file"


def test_tables_beside_a_recording_go_with_it_and_are_cut_as_it_is(tmp_path, write_pair):
    write_pair(tmp_path / "in", "a", 6.0)
    rows = "1,kick,\n3.5,nod,1\n5,kick,\n"
    (tmp_path / "in" / "a.events.csv").write_text(f"time,name,duration\n{rows}")
    (tmp_path / "in" / "a.path.csv").write_text("time,x,z\n0,0,0\n6,0,3\n")
    report = prepare(tmp_path / "in", tmp_path / "c.jsonl", hold_out_seconds=[(4.0, 6.0)])
    assert report.is_complete, report.problems
    train, test = Manifest.load(tmp_path / "c.jsonl")
    assert (train.split, test.split) == ("train", "test")
    events = [[(e.time, e.name, e.duration) for e in item.load_events()] for item in (train, test)]
    assert events[0] == [(1.0, "kick", 0.0), (3.5, "nod", 1.0)]
    assert events[1] == [(0.0, "nod", 0.5), (1.0, "kick", 0.0)]
    path = test.load_path(30.0, 60)
    assert path.n_frames == 60 and np.allclose(path.positions[[0, 30]], [[0, 2.0], [0, 2.5]])


def test_a_table_that_cannot_be_read_leaves_its_recording_out(tmp_path, write_pair):
    write_pair(tmp_path, "a", 2.0)
    write_pair(tmp_path, "b", 2.0)
    (tmp_path / "b.events.csv").write_text("time,name\nsoon,kick\n")
    report = prepare(tmp_path, holdout=0.0)
    assert [item.id for item in report.manifest] == ["a"]
    (problem,) = errors(report)
    says = "line 2: time is 'soon'; expected seconds, 0 or more"
    assert problem.text == f"{tmp_path / 'b.events.csv'}, {says}"


def test_reading_options_for_unit_and_height_are_stored_with_the_items(
    tmp_path, write_speech, gesture, save_as_others
):
    big = gesture(4.0).with_height(3.4)
    save_as_others(big, tmp_path / "a.bvh")
    write_speech(tmp_path / "a.wav", 4.0)
    report = prepare(tmp_path, holdout=0.0)
    assert "read in cm, a guess" in texts(report, "note")[0]
    for read, height in (({"height": 1.75}, 1.75), ({"unit": "mm"}, 0.34)):
        report = prepare(tmp_path, tmp_path / "corpus.jsonl", holdout=0.0, read=read)
        assert not report.problems
        (item,) = Manifest.load(tmp_path / "corpus.jsonl")
        assert item.reading == read
        motion = item.load_motion()
        assert body_height(motion.skeleton) == pytest.approx(height)
        assert np.ptp(motion.positions()) == pytest.approx(np.ptp(big.positions()) * height / 3.4)
    prepare(tmp_path, tmp_path / "corpus.jsonl", holdout=0.0, tolerance=2.0, read={"fps": 60})
    (item,) = Manifest.load(tmp_path / "corpus.jsonl")
    assert item.load_motion().fps == 60 and item.duration == pytest.approx(2.0)


def test_a_height_by_parts_named_by_hand_is_the_same_in_training(tmp_path, write_pairs, gesture):
    motion, parts = nameless(gesture(4.0))
    write_pairs(a=motion)
    prepare(tmp_path, tmp_path / "m.jsonl", holdout=0.0, parts=parts, read={"height": 1.75})
    (item,) = Manifest.load(tmp_path / "m.jsonl")
    named = motion.with_parts(parts).skeleton
    assert body_height(named) != pytest.approx(body_height(motion.skeleton))
    assert body_height(item.load_motion().skeleton.with_parts(parts)) == pytest.approx(1.75)


def test_an_option_that_no_file_here_has_a_use_for_is_refused(tmp_path, write_speech, gesture):
    gesture(4.0).save(tmp_path / "a.npz")
    write_speech(tmp_path / "a.wav", 4.0)
    with pytest.raises(ConfigError, match=r"unit is an option of \.bvh, .*; only \.npz"):
        prepare(tmp_path, read={"unit": "cm"})


def test_every_file_that_looks_like_sound_or_motion_is_used_or_named(tmp_path, write_pair):
    write_pair(tmp_path, "a")
    for name in ("a.mp4", "a.fbx", "b.m4a", "deep/c.m4a", "d.c3d", "notes.txt", ".hidden.m4a"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    report = prepare([tmp_path], unpaired=[tmp_path], holdout=0.0)
    assert [path.name for path in report.left_over] == ["b.m4a", "d.c3d", "c.m4a"]
    assert not report.is_complete
    lines = "\n".join(report.problem_lines())
    for says in (
        f"left out: {tmp_path}: b.m4a: m4a is not read; make a wav of it: ffmpeg -i x.m4a x.wav",
        f"left out: {tmp_path}: d.c3d: c3d is not read; export it as bvh, for example from Blender",
        "a.mp4: mp4 is not read; a file of the same name is",
        "a.fbx: fbx is not read; a file of the same name is",
    ):
        assert says in lines
    for name in ("a.mp4", "a.fbx"):
        (tmp_path / name).unlink()
    for path in report.left_over:
        path.unlink()
    assert prepare(tmp_path, holdout=0.0).is_complete


def test_a_sound_is_missed_although_a_motion_has_its_name(tmp_path, write_pair, gesture):
    """A file that is not read is replaced by one of its own kind only."""
    write_pair(tmp_path, "a")
    gesture(4.0).save(tmp_path / "b.bvh")
    (tmp_path / "b.m4a").write_bytes(b"x")
    report = prepare([tmp_path], unpaired_motion=[tmp_path], holdout=0.0)
    assert [path.name for path in report.left_over] == ["b.m4a"]


def test_of_a_bvh_and_an_npz_of_one_name_one_is_used(tmp_path, write_pair, gesture):
    for seed, name in enumerate("ab"):
        write_pair(tmp_path, name, seed=seed)
        gesture(4.0, seed=seed).save(tmp_path / f"{name}.npz")
    report = prepare(tmp_path, holdout=0.0)
    assert len(report.manifest) == 2
    assert [item.motion.name for item in report.manifest.paired()] == ["a.npz", "b.npz"]
    (note,) = texts(report, "note")
    assert "of a bvh and an npz of one name" in note and report.is_complete
    for path in tmp_path.glob("*.wav"):
        path.unlink()
    alone = prepare([], unpaired_motion=[tmp_path], holdout=0.5)
    assert [item.motion.name for item in alone.manifest] == ["a.npz", "b.npz"]
    summary = inspect_recordings(tmp_path, parts=None, read=None, progress=iter)
    assert summary.facts["items"] == 2 and len(summary.problems) == 1


def test_a_file_that_is_left_out_gets_no_warnings_of_its_motion(
    tmp_path, write_pair, write_pairs, write_speech, gesture
):
    write_pair(tmp_path, "long", 4.0, t_pose=20)
    write_speech(tmp_path / "long.wav", 9.0)
    write_pair(tmp_path, "fine")
    write_pair(tmp_path, "also")
    odd = gesture(4.0, t_pose=20)
    names = ("Pelvis", *odd.skeleton.names[1:])
    write_pairs(odd=replace(odd, skeleton=replace(odd.skeleton, names=names)))
    report = prepare(tmp_path, holdout=0.0)
    assert len(errors(report)) == 2 and not texts(report, "warning")


def test_jumps_from_a_wrong_frame_rate_suggest_checking_it(tmp_path, gesture):
    replace(gesture(20.0), fps=900.0).save(tmp_path / "a.npz")
    assert "--in-fps" in texts(prepare([], unpaired_motion=[tmp_path]), "warning")[0]


def test_bodies_of_very_different_size_are_warned_about(gesture, tmp_path):
    for name, factor in (("a", 1.0), ("b", 1.05), ("c", 2.54)):
        gesture(2.0).scaled(factor).save(tmp_path / f"{name}.npz")
    report = prepare([], unpaired_motion=tmp_path)
    (warning,) = (text for text in report.problem_lines() if text.startswith("warning: "))
    assert "c.npz" in warning and "a.npz" not in warning
    assert "--in-unit" in warning and "--height" in warning
    heights = dict(report.rows())["body heights"].split()
    assert float(heights[2]) == pytest.approx(2.54 * float(heights[0]), rel=0.01)
    (tmp_path / "c.npz").unlink()
    alike = prepare([], unpaired_motion=tmp_path)
    assert not any("warning" in line for line in alike.problem_lines())


def test_bodies_of_several_shapes_are_counted(tmp_path):
    for k, beta in enumerate((1.0, 2.0, 2.0)):
        values = {"poses": np.zeros((40, 72)), "trans": np.zeros((40, 3)), "betas": [beta]}
        np.savez(tmp_path / f"{k}.npz", mocap_framerate=20, **values)
    shapes = dict(prepare([], unpaired_motion=tmp_path).rows())["body shapes"]
    assert shapes.startswith("2; training uses the mean of each speaker's (recordings without a")
    named = prepare([], unpaired_motion=tmp_path, style_pattern="(?P<speaker>.)")
    own = dict(named.rows())["body shapes"]
    assert own == "2; training uses the mean of each speaker's"
    (tmp_path / "0.npz").unlink()
    assert "body shapes" not in dict(prepare([], unpaired_motion=tmp_path).rows())


def test_sizes_that_spread_are_named_by_their_ends(gesture, tmp_path):
    """None of 1, 1.3 and 1.7 is far from the usual one, but the first is far from the last."""
    for name, factor in (("a", 1.3), ("b", 1.7), ("c", 1.0)):
        gesture(2.0).scaled(factor).save(tmp_path / f"{name}.npz")
    (line,) = (t for t in prepare([], unpaired_motion=tmp_path).problem_lines() if "heights" in t)
    assert "body heights differ by a factor of 1.7; " in line and "a.npz" not in line
    assert re.search(r"but not of \S+c.npz \(\S+ m\), \S+b.npz \(\S+ m\)\. If", line)
    gesture(2.0).scaled(1.4).save(tmp_path / "b.npz")
    assert not any(
        "heights differ" in t for t in prepare([], unpaired_motion=tmp_path).problem_lines()
    )


def test_a_rig_without_legs_is_noted_once(tmp_path):
    rig = rig_of(
        {
            "Spine": (None, (0, 0.9, 0)),
            "Chest": ("Spine", (0, 0.3, 0)),
            "Neck": ("Chest", (0, 0.2, 0)),
            "Head": ("Neck", (0, 0.1, 0)),
            **{
                f"{side}{part}": (f"{side}{above}" if above != "Chest" else above, (x * sign, y, 0))
                for side, sign in (("Left", 1), ("Right", -1))
                for part, above, x, y in (
                    ("Shoulder", "Chest", 0.05, 0.15),
                    ("Arm", "Shoulder", 0.15, 0.0),
                    ("ForeArm", "Arm", 0.28, 0.0),
                    ("Hand", "ForeArm", 0.25, 0.0),
                )
            },
        }
    )
    rng = np.random.default_rng(0)
    for name in "ab":
        turns = np.tile([0.0, 0, 0, 1], (60, rig.n_joints, 1)) + 0.02 * np.cumsum(
            rng.standard_normal((60, rig.n_joints, 4)), axis=0
        )
        turns /= np.linalg.norm(turns, axis=-1, keepdims=True)
        Motion(rig, turns, np.zeros((60, 3)), 30.0).save(tmp_path / f"{name}.npz")
    notes = texts(prepare([], unpaired_motion=tmp_path), "note")
    says = "the rig has no legs: foot contacts, foot locking and foot metrics are left out"
    assert [note for note in notes if "legs" in note] == [f"{tmp_path / 'a.npz'}: {says}"]


def test_a_style_pattern_that_fits_no_file_is_warned_about(gesture, tmp_path):
    for name in ("calm_1", "lively_1"):
        gesture(2.0, seed=len(name)).save(tmp_path / f"{name}.npz")

    def warnings(pattern: str) -> list[str]:
        report = prepare([], unpaired_motion=tmp_path, style_pattern=pattern)
        return [line for line in report.problem_lines() if line.startswith("warning: ")]

    (line,) = warnings("(?P<style>x|y)-")
    assert "matches none of 2 recordings, such as calm_1" in line
    assert warnings("(?P<style>calm)_") == []


@pytest.mark.stress
def test_processes_give_the_same_manifest_and_problems(tmp_path, write_pair):
    for name in "abcd":
        write_pair(tmp_path / "in", name, 1.0)
    (tmp_path / "in" / "b.bvh").write_text("Dear diary,\n")
    one = prepare(tmp_path / "in", tmp_path / "one.jsonl")
    two = prepare(tmp_path / "in", tmp_path / "two.jsonl", workers=2)
    assert (tmp_path / "one.jsonl").read_bytes() == (tmp_path / "two.jsonl").read_bytes()
    assert one.problems == two.problems and len(one.problems) >= 1
