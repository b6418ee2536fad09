import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
import soundfile
from rigs import nameless

from gesturekit.corpus import Manifest, prepare
from gesturekit.errors import CorpusError
from gesturekit.motion.parts.body_size import body_height


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
    out = tmp_path / "out" / "corpus.jsonl"
    report = prepare(tmp_path / "in", out, speaker="ann")
    assert report.is_complete and not report.problems
    manifest = Manifest.load(out)
    assert [item.id for item in manifest] == [f"take{i}" for i in range(4)]
    assert {item.speaker for item in manifest} == {"ann"}
    assert len(manifest.paired("train")) == 3 and len(manifest.paired("test")) == 1
    for item in manifest:
        assert item.load_wave().n_frames(30) == item.load_motion().n_frames == 120
    first = out.read_bytes()
    prepare(tmp_path / "in", out, speaker="ann")
    assert out.read_bytes() == first, "the same folders give the same bytes"


def test_words_beside_a_recording_become_features_on_motion_frames(tmp_path, write_pair):
    import audio_features as af
    from gesturekit.corpus.speech import extract

    write_pair(tmp_path / "in", "take", 4.0)
    (tmp_path / "in" / "take.ctm").write_text("take 1 0.5 0.3 so\ntake 1 2.5 0.2 well\n")
    report = prepare(tmp_path / "in", tmp_path / "corpus.jsonl", hold_out_seconds="2-")
    assert report.is_complete and "ctm" in dict(report.rows())["side files"]
    for item, onset in zip(Manifest.load(tmp_path / "corpus.jsonl"), (15, 15), strict=True):
        assert item.conditions["words"] == tmp_path / "in" / "take.ctm"
        values, _ = extract(item.load_wave(), af.Words(), 30.0, "mean")
        np.testing.assert_array_equal(np.flatnonzero(values[:, 1]), [onset])


def test_bad_files_are_reported_once_and_others_used(tmp_path, write_pair, write_speech):
    for name in ("fine", "text", "cut", "apart", "twice", "brief"):
        write_pair(tmp_path, name, **({"t_pose": 110} if name == "brief" else {}))
    (tmp_path / "text.wav").write_text("this is no sound\n" * 100)
    rows = (tmp_path / "cut.bvh").read_text().rstrip().splitlines()
    (tmp_path / "cut.bvh").write_text("\n".join([*rows[:-1], rows[-1][:40]]) + "\n")
    write_speech(tmp_path / "apart.wav", 6.0)
    write_speech(tmp_path / "twice.flac", 4.0)
    report = prepare(tmp_path, holdout=0.0)
    assert [item.id for item in report.manifest] == ["cut", "fine"]
    assert not report.is_complete
    (warning,) = [text for text in texts(report, "warning") if "cut" in text]
    assert re.search(r"(?=.*\b120\b).*119", warning)
    output = "\n".join(problem.text for problem in errors(report))
    assert len(errors(report)) == 4
    for name in ("text.wav", "apart.bvh", "twice.wav", "twice.flac"):
        assert str(tmp_path / name) in output
    for fact in ("6.00 s", "4.00 s", "2.00 s", "0.33 s", "0.5 s"):
        assert fact in output


def test_a_small_difference_in_length_is_trimmed_and_a_later_one_named(
    tmp_path, write_pair, write_speech
):
    write_pair(tmp_path, "a", 4.0)
    write_speech(tmp_path / "a.wav", 3.1)
    report = prepare(tmp_path, holdout=0.0)
    (item,) = report.manifest
    assert item.duration == pytest.approx(3.1, abs=1e-5)
    assert item.load_wave().n_frames(30) == item.load_motion().n_frames == 93
    assert "3.10 s" in texts(report, "warning")[0] and report.is_complete
    write_speech(tmp_path / "a.wav", 2.0)
    with pytest.raises(CorpusError, match=r"(?=.*'a')(?=.*\b3.10 s)(?=.*a\.wav).*\b2.00 s"):
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
    assert "--trim b" not in done.err and len(Manifest.load(tmp_path / "c.jsonl")) == 1
    gesturekit(*command, "--trim", "a, b").ok()
    gesturekit(*command, "--existing", "replace", "--trim", "c").fails(2, "'c'")


@pytest.fixture
def copied(tmp_path, write_pair):
    """A folder of five recordings: b is a copy of a, and e has the sound of d."""
    for name in "acde":
        write_pair(tmp_path / "in", name, 4.0)
    for new, old in (("b.wav", "a.wav"), ("b.bvh", "a.bvh"), ("e.wav", "d.wav")):
        shutil.copy(tmp_path / "in" / old, tmp_path / "in" / new)
    return tmp_path / "in"


def test_copies_are_named_and_stay_in_one_split(copied):
    for seed in range(2):
        report = prepare(copied, seed=seed, holdout=0.4, unpaired=copied)
        splits = {item.id: item.split for item in report.manifest}
        assert splits["a"] == splits["b"] and splits["d"] == splits["e"], seed
        assert {"train", "test"} <= set(splits.values())
    (text,) = texts(report, "warning")
    assert re.search(rf"(?=.*\b3\b)(?=.*{copied / 'b.bvh'}).*{copied / 'a.bvh'}", text)
    assert prepare(copied, hold_out_pattern="^b$").manifest.paired("test")[0].id == "a"


def test_a_leading_t_pose_is_trimmed_from_sound_and_motion(tmp_path, write_pair, gesture):
    write_pair(tmp_path, "a", 4.0, t_pose=20)
    write_pair(tmp_path, "still", 2.0, t_pose=60)
    report = prepare(tmp_path, holdout=0.0)
    item, still = report.manifest
    assert item.motion_start == item.audio_start == pytest.approx(20 / 30, abs=1e-6)
    assert item.load_motion().n_frames == 100
    assert abs(item.load_motion().positions() - gesture(4.0).positions()[20:]).max() < 1e-4
    assert (still.motion_start, still.duration) == (0.0, 2.0) and report.is_complete
    warnings = "\n".join(texts(report, "warning"))
    assert re.search(r"a.bvh.*(?=.*\b20\b).*0.67 s", warnings) and "still.bvh" in warnings


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("part", r"(?=.*\b1.33 s).*2.67 s"),
        ("whole", r"(?=.*\b120\b).*pose"),
        ("once", r"(?=.*\b1 of 120).*\b2.00 s"),
        ("often", r"(?=.*\b119 of 120)(?=.*--in-unit).*--height"),
        ("pop", r"(?=.*\b1.00 s)(?=.*\b3.00 s)(?=.*'Head').*\d\d°"),
        ("shake", r"(?=.*jitter).*\d\d%"),
    ],
)
def test_faults_of_a_motion_are_warned_about(tmp_path, write_pairs, gesture, fault, says):
    motion = gesture(4.0)
    rotations, translation = motion.rotations.copy(), motion.translation.copy()
    if fault == "part":
        rotations[40:80] = rotations[40]
    elif fault == "whole":
        rotations[:] = rotations[:1]
    elif fault == "pop":
        rotations[[30, 90], motion.skeleton.index("Head")] = [0.0, 0.5, 0.0, 0.75**0.5]
    elif fault == "once":
        translation[60:] += [1.0, 0.0, 0.0]
    else:
        translation[::2] += [1.0 if fault == "often" else 0.004, 0.0, 0.0]
    write_pairs(a=replace(motion, rotations=rotations, translation=translation))
    report = prepare(tmp_path, holdout=0.0)
    assert len(report.manifest) == 1 and report.is_complete
    assert any(re.search(f"a.bvh.*{says}", text) for text in texts(report, "warning"))


def test_unidentified_parts_are_reported_and_can_be_specified(tmp_path, write_pairs, gesture):
    motion, by_hand = nameless(gesture(4.0))  # without toes nothing tells left from right
    write_pairs(a=motion)
    report = prepare(tmp_path, holdout=0.0)
    (note,) = texts(report, "note")
    says = r"a.bvh(?=.*arms).*left_elbow"
    assert len(report.manifest) == 1 and re.search(says, note)
    prepare(tmp_path, tmp_path / "m.jsonl", holdout=0.0, parts=by_hand, read={"height": 1.75})
    (item,) = Manifest.load(tmp_path / "m.jsonl")
    assert body_height(item.load_motion().skeleton.with_parts(by_hand)) == pytest.approx(1.75)
    wrong = prepare(tmp_path, holdout=0.0, parts={"left_elbow": "Joint99"})
    assert "Joint99" in texts(wrong, "error")[0]


def test_one_channel_of_a_shared_file_is_checked_and_remembered(tmp_path, write_pair):
    write_pair(tmp_path, "a")
    sound, rate = soundfile.read(tmp_path / "a.wav")
    two = np.stack([np.zeros_like(sound), sound + 0.1], axis=1)
    soundfile.write(tmp_path / "a.wav", two, rate)
    for channel, says, wanted in ((1, "silence", 0 * two[:, 0]), (2, "DC", two[:, 1])):
        report = prepare(tmp_path, tmp_path / "m.jsonl", holdout=0.0, channel=channel)
        (item,) = Manifest.load(tmp_path / "m.jsonl")
        assert item.channel == channel and says in texts(report, "warning")[0]
        found = item.load_wave().samples
        np.testing.assert_allclose(found, wanted[: len(found)], atol=1e-4)
    report = prepare(tmp_path, holdout=0.0, channel=3)
    assert len(report.manifest) == 0 and "channel 3" in texts(report, "error")[0]


def test_the_odd_skeleton_is_left_out_and_its_first_difference_named(tmp_path, write_pair):
    for name in ("a", "b", "odd"):
        write_pair(tmp_path, name)
    text = (tmp_path / "odd.bvh").read_text()
    (tmp_path / "odd.bvh").write_text(text.replace("JOINT Chest", "JOINT Thorax"))
    report = prepare(tmp_path)
    assert {item.id for item in report.manifest} == {"a", "b"}
    (problem,) = errors(report)
    assert problem.file == tmp_path / "odd.bvh"
    assert re.search("(?=.*'Thorax').*'Chest'", problem.message)


def test_the_last_fifth_of_a_single_recording_is_held_out(tmp_path, write_pair):
    write_pair(tmp_path, "a", 10.0)
    report = prepare(tmp_path)
    train, test = report.manifest
    assert (train.split, test.split) == ("train", "test")
    paired = dict(report.rows())["paired"]
    assert all(fact in paired for fact in ("10.0 s", "train 1", "8.0 s", "test 1", "2.0 s"))
    assert (train.audio_start, train.duration) == (0.0, 8.0)
    assert (test.audio_start, test.motion_start, test.duration) == (8.0, 8.0, 2.0)
    assert prepare(tmp_path, holdout=0.0).manifest.items[0].split == "train"


def test_labels_come_from_names(tmp_path, write_pair):
    for name in ("ann/calm_1", "bob/lively_1", "bob/other"):
        write_pair(tmp_path, name, 2.0)
    pattern = r"(?P<speaker>\w+)/(?P<style>calm|lively)_.*"
    report = prepare(tmp_path, style_pattern=pattern, speaker="somebody")
    labels = [(item.id, item.speaker, item.style) for item in report.manifest]
    calm, lively = ("ann/calm_1", "ann", "calm"), ("bob/lively_1", "bob", "lively")
    assert labels == [calm, lively, ("bob/other", "somebody", None)]
    assert "other.bvh" in texts(report, "note")[0]
    report = prepare(tmp_path, style_pattern="(?P<style>x|y)-")
    assert re.search(r"(?=.*\b3\b).*ann/calm_1", texts(report, "warning")[0])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"holdout": 1.0}, r"(?=.*holdout).*\b1.0"),
        ({"holdout": -0.1}, "(?=.*holdout).*-0.1"),
        ({"seed": -1}, "(?=.*seed).*-1"),
        ({"workers": 0}, r"(?=.*workers).*\b0"),
        ({"workers": 1025}, "(?=.*workers).*1025"),
        ({"shift": "left"}, "(?=.*shift).*left"),
        ({"tolerance": float("inf")}, "(?=.*tolerance).*inf"),
        ({"tolerance": -1.0}, "(?=.*tolerance).*-1"),
        ({"tolerance": float("nan")}, "(?=.*tolerance).*nan"),
        ({"style_pattern": "calm"}, "(?=.*calm).*style"),
        ({"unpaired": ["nowhere"]}, "nowhere"),
        ({"take_table": "none.csv"}, "none.csv"),
        ({"read": {"animation": 1}}, "'animation'"),
        ({"read": {"body_model": "none.npz"}}, "none.npz"),
        ({"hold_out_seconds": "1-2", "hold_out_pattern": "a"}, "(?=.*seconds).*names"),
    ],
)
def test_invalid_arguments_are_refused_before_anything_is_read(tmp_path, options, message):
    with pytest.raises(CorpusError, match=message):
        prepare(tmp_path, **options)


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


def test_reading_options_are_stored_with_the_items(tmp_path, write_speech, gesture, save_as_others):
    big = gesture(4.0).with_height(3.4)
    save_as_others(big, tmp_path / "a.bvh")
    write_speech(tmp_path / "a.wav", 4.0)
    assert "guess" in texts(prepare(tmp_path, holdout=0.0), "note")[0]
    for read, height in (({"height": 1.75}, 1.75), ({"unit": "mm"}, 0.34)):
        prepare(tmp_path, tmp_path / "corpus.jsonl", holdout=0.0, read=read)
        (item,) = Manifest.load(tmp_path / "corpus.jsonl")
        assert item.reading == read
        assert body_height(item.load_motion().skeleton) == pytest.approx(height)
    prepare(tmp_path, tmp_path / "corpus.jsonl", holdout=0.0, tolerance=2.0, read={"fps": 60})
    (item,) = Manifest.load(tmp_path / "corpus.jsonl")
    assert item.load_motion().fps == 60 and item.duration == pytest.approx(2.0)


def test_bodies_that_differ_evenly_are_named_by_the_ends(tmp_path, write_pairs, gesture):
    """1.3 times the usual is a person, but 1.69 times from end to end are two units."""
    sizes = {"a": 1.3, "b": 1.69, "c": 2.197}
    write_pairs(**{name: gesture(4.0, seed=ord(name)).with_height(h) for name, h in sizes.items()})
    report = prepare(tmp_path, holdout=0.0)
    (said,) = (text for text in texts(report, "warning") if "factor" in text)
    assert re.search(
        r"factor of 1\.69; the usual is 1\.69 m.*a.bvh \(1.3 m\).*c.bvh \(2.2 m\)", said
    )
    assert "b.bvh" not in said


def test_every_file_that_looks_like_sound_or_motion_is_used_or_named(tmp_path, write_pair):
    write_pair(tmp_path, "a")
    for name in ("a.mp4", "b.m4a", "deep/c.m4a", "d.c3d", "notes.txt", ".hidden.m4a"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    report = prepare([tmp_path], unpaired=[tmp_path], holdout=0.0)
    assert {path.name for path in report.left_over} == {"b.m4a", "d.c3d", "c.m4a"}
    assert not report.is_complete
    lines = "\n".join(report.problem_lines())
    for says in ("b.m4a.*ffmpeg", "d.c3d.*bvh", "a.mp4"):
        assert re.search(says, lines)


def test_of_a_bvh_and_an_npz_of_one_name_one_is_used(tmp_path, write_pair, gesture):
    for seed, name in enumerate("ab"):
        write_pair(tmp_path, name, seed=seed)
        gesture(4.0, seed=seed).save(tmp_path / f"{name}.npz")
    report = prepare(tmp_path, holdout=0.0)
    assert [item.motion.name for item in report.manifest.paired()] == ["a.npz", "b.npz"]
    (note,) = texts(report, "note")
    assert "bvh" in note and "npz" in note and report.is_complete
    alone = prepare([], unpaired_motion=[tmp_path], holdout=0.5)
    assert [item.motion.name for item in alone.manifest] == ["a.npz", "b.npz"]
