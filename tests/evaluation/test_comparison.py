"""Folders against folders, from end to end."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rigs import prefixed

from gesturekit.corpus import Item, Manifest
from gesturekit.errors import CorpusError, EvaluationError, GestureKitError
from gesturekit.evaluation import Variants, evaluate, interval_warnings
from gesturekit.motion import Motion, Skeleton


@pytest.fixture(scope="module")
def folders(tmp_path_factory, gesture, write_speech) -> Path:
    """Four recordings with sound, two samples of another motion for each, and the recordings."""
    root = tmp_path_factory.mktemp("folders")
    for i in range(4):
        stem = f"clip{i}"
        gesture(2.5, 15.0, seed=i).save(root / "recordings" / f"{stem}.bvh")
        write_speech(root / "sound" / f"{stem}.wav", 2.5)
        for sample in (1, 2):
            motion = gesture(2.5, 15.0, seed=10 * i + sample)
            motion.save(root / "samples" / f"{stem}_s{sample}.npz")
    return root


def test_recordings_against_themselves_are_perfect(folders):
    found = evaluate(folders / "recordings", folders / "recordings")
    (model,) = found.models
    assert found.is_complete and len(model.clips) == 4
    values = {key: result.interval.value for key, result in model.metrics.items()}
    for key in ("arm_speed", "wrist_speed", "jerk", "reach", "rest", "hand_q50", "l1_diversity"):
        assert values[key] == pytest.approx(model.metrics[key].recording), key
    for key in ("hellinger", "joint_limits", "one_nn", "raw_fgd", "local_diversity"):
        assert values[key] == pytest.approx(0.0, abs=1e-5), key
    for key in ("coverage", "within_reach"):
        assert values[key] == 100.0, key
    for key in ("likeness", "cca", "cca_global"):
        assert values[key] == pytest.approx(1.0), key


@pytest.fixture(scope="module")
def of_samples(folders):
    return evaluate(
        {"samples": folders / "samples"}, folders / "recordings", audio=folders / "sound"
    )


def test_samples_of_one_recording_count_as_one_draw(of_samples):
    (model,) = of_samples.models
    interval = model.metrics["arm_speed"].interval
    assert (interval.n, interval.units, interval.over) == (8, 4, "takes")
    clips = {clip.pair.name: clip.metrics["arm_speed"] for clip in model.clips}
    means = [np.mean([clips[f"clip{i}_s{k}"] for k in (1, 2)]) for i in range(4)]
    assert interval.value == pytest.approx(np.mean(means))
    assert (interval.low, interval.high) == (None, None)  # of four takes
    one = model.by_recording["clip2"]["coverage"]
    assert (one.n, one.over) == (2, "samples")
    assert "inter_diversity" in model.metrics
    sync = model.metrics["sync"]
    assert None not in (sync.recording, sync.chance, sync.mismatched)


@pytest.mark.parametrize("files", [1, 6])
def test_pieces_of_one_file_are_one_take(tmp_path, gesture, files):
    items = []
    for k in range(6):
        recording = tmp_path / f"take{k % files}.npz"
        if k < files:
            gesture(6.0, 10.0, seed=k).save(recording)
        items.append(
            Item(id=f"c{k}", audio=None, motion=recording, motion_start=1.0 * k, duration=1.0,
                 split="test")
        )  # fmt: skip
        gesture(1.0, 10.0, seed=50 + k).save(tmp_path / "made" / f"c{k}.npz")
    Manifest(items).save(tmp_path / "corpus.jsonl")
    found = evaluate(tmp_path / "made", tmp_path / "corpus.jsonl", split="test", cheap=True)
    metrics = found.models[0].metrics
    for interval in (metrics[key].interval for key in ("reach", "hellinger", "arm_speed")):
        assert (interval.units, interval.n) == (files, 6)
        assert (interval.low is None) is (files == 1)
    if files == 6:
        assert metrics["reach"].interval.low < metrics["reach"].interval.high
        assert metrics["reach"].recording_interval.low is not None
    assert any(interval_warnings(found)) is (files == 1)
    # Models are named where they have other numbers of takes.
    (model,) = found.models
    few = [replace(model, label=name, clips=model.clips[:n]) for name, n in (("a", 1), ("b", 4))]
    said = [*interval_warnings(replace(found, models=few))]
    if files == 6:
        assert [text[:3] for text in said] == ["a: ", "b: "] and "4 takes" in said[1]
    else:
        assert len(said) == 1 and "a" not in said[0].split(":")[0].split()


def test_the_same_seed_gives_the_same_json_whatever_other_files_exist(
    folders, tmp_path, monkeypatch
):
    Motion.load(folders / "samples" / "clip1_s1.npz").save(tmp_path / "made" / "clip1.npz")

    def written(name: str, models) -> dict:
        monkeypatch.setenv("GESTUREKIT_CACHE", str(tmp_path / f"{name} cache"))
        found = evaluate(models, folders / "recordings", seed=3, cheap=True)
        found.write_json(tmp_path / name)
        return json.loads((tmp_path / name).read_text())

    one = written("one.json", {"ours": tmp_path / "made"})
    both = written("both.json", {"ours": tmp_path / "made", "x": folders / "recordings"})
    assert both["models"][0] == one["models"][0]
    assert one["settings"]["seed"] == 3 and {"gesturekit", "numpy"} <= set(one["versions"])


def test_the_json_defines_each_of_its_figures(of_samples):
    whole = of_samples.to_json()
    assert set(whole["models"][0]["figures"]) <= set(whole["definitions"])
    variant = whole["definitions"]["coverage"]["variant"]
    assert "30 frames" in variant and re.search(r"\b2(\.0+)? s\b", variant)


def test_windows_are_compared_with_their_part_of_the_recording(tmp_path, gesture):
    whole = gesture(25.0, 15.0, seed=0)
    whole.save(tmp_path / "recordings" / "a.npz")
    for window in (0, 1):
        part = whole[150 * window : 150 * window + 150]
        for sample in (1, 2, 3):
            part.save(tmp_path / "made" / f"a_w{window:03d}_s{sample}.npz")
    (model,) = evaluate(tmp_path / "made", tmp_path / "recordings", protocol="lda").models
    assert model.metrics["arm_speed"].interval.value == pytest.approx(
        model.metrics["arm_speed"].recording
    )
    assert "coverage" not in model.metrics and "fid_k" in model.metrics
    assert model.notes == []  # three samples of each 10 s window, as the protocol says
    # The windows' own distance to the whole set is the top line.
    assert model.metrics["fid_k"].recording is not None


def test_windows_of_a_manifest_are_compared_with_all_of_its_splits(tmp_path, gesture):
    items = []
    for name, split, seconds in (("a", "test", 20.0), ("b", "train", 10.0), ("c", "valid", 10.0)):
        motion = tmp_path / "recordings" / f"{name}.npz"
        gesture(seconds, 15.0, seed=len(items)).save(motion)
        items.append(Item(id=name, audio=None, motion=motion, duration=seconds, split=split))
    Manifest(items).save(tmp_path / "corpus.jsonl")
    for window in (0, 1):
        path = tmp_path / "made" / f"a_w{window:03d}_s1.npz"
        gesture(10.0, 15.0, seed=10 + window).save(path)
    of_corpus = evaluate(tmp_path / "made", tmp_path / "corpus.jsonl", protocol="lda")
    of_folder = evaluate(tmp_path / "made", tmp_path / "recordings", protocol="lda")
    (one,), (other,) = of_corpus.models, of_folder.models
    assert one.excluded == other.excluded == []
    for key in ("fid_k", "fid_g", "raw_fgd", "joint_limits"):
        ours, theirs = one.metrics[key], other.metrics[key]
        assert ours.interval.value == pytest.approx(theirs.interval.value), key
        assert ours.recording == pytest.approx(theirs.recording), key
    assert one.metrics["fid_k"].recording > 0  # the windows' own distance to the full dataset


def test_the_multires_protocol_notes_missing_samples(folders):
    found = evaluate(folders / "samples", folders / "recordings", protocol="multires")
    (model,) = found.models
    assert any("200 samples" in note and "clip0" in note for note in model.notes)
    assert any("2.53 s" in note for note in model.clips[0].notes)
    assert set(model.by_recording) == {f"clip{i}" for i in range(4)}
    assert "sync" not in model.metrics and "fid_k" not in model.metrics
    with pytest.raises(EvaluationError, match="'genea'.*multires"):
        evaluate(folders / "samples", folders / "recordings", protocol="genea")


def test_takes_are_found_in_names_by_a_pattern(tmp_path, gesture):
    for k, name in enumerate(("day1_a", "day1_b", "day2_a", "x")):
        gesture(1.0, 10.0, seed=k).save(tmp_path / "recordings" / f"{name}.npz")
        gesture(1.0, 10.0, seed=9 + k).save(tmp_path / "made" / f"{name}.npz")
    options = {"take_pattern": r"(day\d)", "protocol": "multires", "cheap": True}
    found = evaluate(tmp_path / "made", tmp_path / "recordings", **options)
    takes = {clip.pair.name: clip.pair.take for clip in found.models[0].clips}
    assert takes == {"day1_a": "day1", "day1_b": "day1", "day2_a": "day2", "x": "x"}
    assert "3 takes" in found.basis and "4 clips" in found.basis
    (tmp_path / "takes.csv").write_text("id,take\nx,day1\nday2_a,day1\n")
    found = evaluate(tmp_path / "made", tmp_path / "recordings", **options,
                     take_table=tmp_path / "takes.csv")  # fmt: skip
    assert {clip.pair.take for clip in found.models[0].clips} == {"day1"}
    with pytest.raises(CorpusError, match=r"(?=.*nothing).*\b4\b"):
        evaluate(
            tmp_path / "made", tmp_path / "recordings", **options | {"take_pattern": "nothing"}
        )


def test_pieces_of_takes_are_asked_about(tmp_path, gesture):
    for k in range(4):
        for folder in ("recordings", "made"):
            gesture(1.0, 10.0, seed=k).save(tmp_path / folder / f"day{k // 2}_part{k % 2}.npz")
    options = {"protocol": "multires", "cheap": True}
    found = evaluate(tmp_path / "made", tmp_path / "recordings", **options)
    (said,) = (note for note in found.models[0].notes if "--take-pattern" in note)
    assert "4 files, perhaps 2 recordings" in said
    options |= {"take_pattern": re.search("'(.*)'", said)[1]}
    found = evaluate(tmp_path / "made", tmp_path / "recordings", **options)
    assert not any("--take-pattern" in note for note in found.models[0].notes)
    assert {clip.pair.take for clip in found.models[0].clips} == {"day0", "day1"}


def test_options_that_do_not_go_together_are_refused(tmp_path, gesture):
    motion = tmp_path / "a.npz"
    gesture(1.0, 10.0).save(motion)
    item = Item(id="a", audio=None, motion=motion, duration=1.0, split="valid")
    Manifest([item]).save(tmp_path / "corpus.jsonl")
    with pytest.raises(EvaluationError, match="audio"):
        evaluate(motion, tmp_path / "corpus.jsonl", split="valid", audio=motion)
    with pytest.raises(EvaluationError, match=r"(?=.*\btest\b).*manifest"):
        evaluate(motion, motion, split="test")
    with pytest.raises(GestureKitError, match=r"(?=.*\btest\b).*\bvalid\b"):
        evaluate(motion, tmp_path / "corpus.jsonl")
    found = evaluate(motion, tmp_path / "corpus.jsonl", split="valid", cheap=True)
    assert found.settings["split"] == "valid" and found.reference == tmp_path / "corpus.jsonl"
    assert [model.label for model in found.models] == ["generated"]
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "a.npz").write_bytes(b"no motion")
    with pytest.raises(EvaluationError, match="made.a.npz"):
        evaluate(tmp_path / "made", tmp_path / "corpus.jsonl", split="valid")


def test_a_file_that_has_changed_is_read_again(tmp_path, gesture):
    motion, speeds = tmp_path / "a.npz", []
    for seed in (1, 2):
        gesture(1.0, 10.0, seed=seed).save(motion)
        speeds.append(evaluate(motion, motion, cheap=True).models[0].metrics["arm_speed"])
    assert all(speed.recording == pytest.approx(speed.interval.value) for speed in speeds)
    assert speeds[0].recording != pytest.approx(speeds[1].recording)


def test_the_papers_patch_variant_has_no_coverage_without_a_threshold(folders):
    for threshold, has in ((None, False), (40.0, True)):
        found = evaluate(
            folders / "samples" / "clip0_s1.npz",
            folders / "recordings" / "clip0.bvh",
            variants=Variants("paper", threshold),
            protocol="multires",
        )
        assert ("coverage" in found.models[0].metrics) is has
        used = found.settings["variants"]
        assert (used["patches"], used["threshold"]) == ("paper", threshold)


def test_rigs_are_matched_by_name_whatever_their_name_space_and_order(folders, tmp_path):
    for path in sorted((folders / "recordings").glob("*.bvh")):
        motion = prefixed(Motion.load(path))
        rig = motion.skeleton
        order = [0, *range(13, 19), *range(1, 13)]  # the legs first
        parents = [order.index(rig.parents[j]) if j else -1 for j in order]
        names = tuple(rig.names[j] for j in order)
        legs_first = Skeleton(names, tuple(parents), rig.offsets[order], rig.end_sites)
        changed = replace(motion, skeleton=legs_first, rotations=motion.rotations[:, order])
        changed.save(tmp_path / "made" / f"{path.stem}.npz")
    found = evaluate(tmp_path / "made", folders / "recordings", protocol="multires")
    for key in ("hellinger", "joint_limits"):
        assert found.models[0].metrics[key].interval.value == pytest.approx(0.0, abs=1e-6), key


def test_bad_clips_are_left_out_with_their_reasons_and_the_rest_is_measured(folders, tmp_path):
    made = tmp_path / "made"
    good = Motion.load(folders / "samples" / "clip0_s1.npz")
    good.save(made / "clip0.npz")
    good[:1].save(made / "clip1.npz")
    good.save(made / "clip2.bvh")
    text = (made / "clip2.bvh").read_text().splitlines()
    text[-5] = text[-5].replace(text[-5].split()[3], "nan", 1)
    (made / "clip2.bvh").write_text("\n".join(text))
    rig = good.skeleton
    other = replace(rig, names=tuple(f"bone{j}" for j in range(rig.n_joints)), end_sites={})
    replace(good, skeleton=other).save(made / "clip3.npz")
    found = evaluate(made, folders / "recordings", cheap=True)
    (model,) = found.models
    assert not found.is_complete and [clip.pair.name for clip in model.clips] == ["clip0"]
    reasons = {item.name: item.reason for item in model.excluded if item.what == "clip"}
    for name, facts in (("clip1", ("clip1.npz", "frame")), ("clip2", ("clip2.bvh", "nan"))):
        assert all(fact in reasons[name] for fact in facts), name
    assert re.search(r"\b0 of 19\b", reasons["clip3"])
    (made / "clip0.npz").unlink()
    with pytest.raises(GestureKitError, match="clip1.npz"):
        evaluate(made, folders / "recordings")


def test_frame_rates_may_differ_and_the_first_model_says_at_which_it_is_measured(folders, tmp_path):
    one = Motion.load(folders / "samples" / "clip0_s1.npz")
    for name, motion in (("slow", one.resample(10.0)), ("fast", one)):
        motion.save(tmp_path / name / "clip0.npz")
    models = {name: tmp_path / name for name in ("slow", "fast")}
    found = evaluate(models, folders / "recordings", cheap=True)
    assert found.fps == 10.0
    assert any(re.search(r"(?=.*\b15\b).*\b10 fps", n) for n in found.models[1].clips[0].notes)


def test_capture_noise_of_a_faster_recording_is_not_folded_down(gesture, tmp_path):
    slow, fast = gesture(4.0, 25.0), gesture(4.0, 100.0)
    slow.save(tmp_path / "made" / "clip.npz")
    # A shake of 24 Hz, which every fourth frame would show as one of 1 Hz.
    shake = 0.2 * np.sin(2 * np.pi * 24.0 * fast.times)[:, None] * [1.0, 1.0, 1.0]
    noisy = replace(fast, translation=fast.translation + shake)
    noisy.save(tmp_path / "recordings" / "clip.npz")
    (model,) = evaluate(tmp_path / "made", tmp_path / "recordings", cheap=True).models
    result = model.metrics["wrist_speed"]
    assert result.recording == pytest.approx(result.interval.value, rel=0.2)


def test_a_model_of_fewer_joints_has_fréchet_distances_on_those_it_shares(gesture, tmp_path):
    for i in range(2):
        motion = gesture(10.0, 30.0, seed=i)
        motion.save(tmp_path / "recordings" / f"clip{i}.npz")
        kept = [name for name in motion.skeleton.names if name != "Neck"]
        motion.keep(kept).save(tmp_path / "made" / f"clip{i}.npz")
    (model,) = evaluate(tmp_path / "made", tmp_path / "recordings").models
    for key in ("raw_fgd", "fid_k"):
        assert model.metrics[key].interval.value == pytest.approx(0.0, abs=1e-6), key
    assert model.metrics["div_k"].interval.value == pytest.approx(model.metrics["div_k"].recording)
    assert any("1 of 19" in note for note in model.clips[0].notes)


@pytest.mark.parametrize(("seconds", "enough"), [(14.0, False), (34.0, True)])
def test_a_few_windows_are_not_informative(gesture, tmp_path, seconds, enough):
    """Windows of 2 s begin every second; patches take 32 s, FID 32 clips of 10 s."""
    gesture(seconds, 10.0).save(tmp_path / "recordings" / "clip.npz")
    gesture(seconds, 10.0, seed=1).save(tmp_path / "made" / "clip.npz")
    (model,) = evaluate(tmp_path / "made", tmp_path / "recordings", protocol="lda").models
    assert model.metrics["raw_fgd"].informative == enough
    assert model.metrics["raw_fgd"].recording is None, "halves are smaller sets"
    assert not any(model.metrics[key].informative for key in ("fid_k", "fid_g") if seconds > 30)
    (model,) = evaluate(tmp_path / "made", tmp_path / "recordings", protocol="multires").models
    assert model.metrics["coverage"].informative == enough


def test_a_body_that_floats_or_whose_bones_change_is_broken(gesture, tmp_path):
    def floating(motion: Motion) -> Motion:
        return replace(motion, translation=motion.translation + [0.0, 0.5, 0.0])

    def stretched(motion: Motion) -> Motion:
        """Each bone is 0.8 or 1.2 times as long: a standard deviation of 20 %."""
        rig, factor = motion.skeleton, np.where(np.arange(motion.n_frames) % 2, 1.2, 0.8)[:, None]
        moving = {name: rig.offsets[j] * factor for j, name in enumerate(rig.names) if j}
        return replace(motion, joint_translations=moving)

    for k in range(2):
        motion = gesture(2.0, 15.0, seed=k)
        for folder, made in (("recorded", motion), ("floating", floating(motion)),
                             ("stretched", stretched(motion))):  # fmt: skip
            made.save(tmp_path / folder / f"c{k}.npz")
    folders = {name: tmp_path / name for name in ("recorded", "floating", "stretched")}
    sound, *broken = evaluate(folders, tmp_path / "recorded", cheap=True).models
    assert "broken" not in sound.verdict
    for model, fact in zip(broken, (r"\b4\d\d mm", r"\b20 %"), strict=True):
        assert "broken" in model.verdict and re.search(fact, model.verdict)
    for k in range(2):  # recordings relative to a camera
        motion = Motion.load(tmp_path / "recorded" / f"c{k}.npz")
        low = replace(motion, translation=motion.translation - [0.0, 0.46, 0.0])
        low.save(tmp_path / "camera" / f"c{k}.npz")
    (sound,) = evaluate(tmp_path / "recorded", tmp_path / "camera", cheap=True).models
    assert "broken" not in sound.verdict
