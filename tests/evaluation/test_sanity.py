"""Known-bad motion made from recordings: the headline figures notice it."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import soundfile

from audio_features import Wave
from gesturekit.errors import EvaluationError, GestureKitError
from gesturekit.evaluation import DEFINITIONS, Interval, MetricResult, ModelResult, arm_speed
from gesturekit.evaluation.measuring.made_motion import bad_motion
from gesturekit.evaluation.report.sanity import (
    conclusion,
    mark,
    noticed_by,
    run_sanity,
    table_lines,
)
from gesturekit.motion import Motion, Skeleton

ALL = {
    *("frozen", "mean pose", "noise", "jitter", "another utterance", "reversed", "half speed"),
    *("half reach", "foot slide", "training recording"),
}


@pytest.fixture(scope="module")
def spoken(shared_data, tmp_path_factory):
    """The ZEGGS recording, 34 s of it, with its sound."""
    folder = tmp_path_factory.mktemp("zeggs")
    (bvh,) = shared_data.glob("paired/zeggs*/*.bvh")
    Motion.load(bvh).trim(20.0, 54.0).save(folder / "speech.npz")
    wave = Wave.load(bvh.with_suffix(".wav")).slice(20.0, 34.0)
    soundfile.write(folder / "speech.wav", wave.samples, wave.sample_rate)
    return run_sanity(folder)[0]


@pytest.mark.stress
def test_all_bad_motion_is_detected(spoken):
    found = noticed_by(spoken)
    assert set(found) == ALL and all(found.values()), found
    assert found["another utterance"] == ["in_time"]
    assert found["foot slide"] == ["likeness"] and "novelty" in found["training recording"]


@pytest.mark.stress
def test_with_mismatched_speech_only_another_utterance_passes(shared_data, tmp_path):
    sounds = sorted(shared_data.glob("speech/librispeech*/*.flac"))
    for i, path in enumerate(sorted(shared_data.glob("motion/bandai/*.bvh"))):
        shutil.copy(path, tmp_path)
        samples, rate = soundfile.read(sounds[3 * i % len(sounds)])
        soundfile.write(tmp_path / f"{path.stem}.wav", samples, rate)
    done, _ = run_sanity(tmp_path)
    found = noticed_by(done)
    assert {key for key, by in found.items() if not by} == {"another utterance"}
    assert "novelty" in found["training recording"]
    assert "cannot be answered" in conclusion(done)


def test_held_out_recordings_are_spoiled_and_judged_beside_training(tmp_path, gesture):
    recorded = gesture(17.0, 10.0, seed=0)
    recorded.save(tmp_path / "a.npz")
    gesture(3.2, 10.0, seed=1).save(tmp_path / "b.npz")
    gesture(2.0, 10.0).save(tmp_path / "short.npz")
    done, left_out = run_sanity(tmp_path)
    recording, *bad = done.models
    assert recording.label == "recording" and {model.label for model in bad} == ALL
    assert all(len(model.clips) == len(recording.clips) for model in bad)
    # The only one that is held out is cut into two pieces; each has the other as its neighbour.
    halves = [arm_speed(half).mean() for half in (recorded[:85], recorded[85:])]
    (swapped,) = (model for model in bad if model.label == "another utterance")
    for model, order in ((recording, 1), (swapped, -1)):
        assert [c.pair.name for c in model.clips] == ["a_1", "a_2"]
        speeds = [c.metrics["arm_speed"] for c in model.clips]
        assert speeds == pytest.approx(halves[::order], rel=1e-3)
    assert "3 s" in left_out["short"] and done.reference == tmp_path
    (frozen,) = (model for model in bad if model.label == "frozen")
    assert frozen.metrics["near_still"].interval.value == 100.0
    asked = noticed_by(done)
    assert set(asked["frozen"]) <= {"in_time", "likeness", "novelty"} and asked["frozen"]
    lines = "\n".join(table_lines(done))
    assert all(name in lines for name in ALL) and f"of {len(ALL)}" in conclusion(done)


def test_bad_motions_match_their_names(gesture):
    recording, other, training = (gesture(4.0, 25.0, seed=i) for i in range(3))
    made = bad_motion(recording, other, training, 0)
    assert all(m.n_frames == 100 and m.fps == 25.0 for m in made.values())
    assert np.ptp(made["frozen"].rotations, axis=0).max() == 0.0
    assert np.ptp(made["mean pose"].rotations, axis=0).max() == 0.0
    assert made["reversed"].rotations[0] == pytest.approx(recording.rotations[-1])
    assert made["half speed"].positions()[40] == pytest.approx(recording.positions()[20], abs=1e-6)
    assert made["another utterance"].rotations == pytest.approx(other.rotations)
    assert made["training recording"].rotations == pytest.approx(training.rotations)
    hips = made["foot slide"].translation - recording.translation
    assert np.abs(hips[:, 0]).max() > 0.1 and not hips[:, 1:].any() and hips[0, 0] == 0.0
    # 0.4 Hz: a quarter of a turn after 0.625 s, sin(144°) = 0.588 after 1 s.
    assert hips[25, 0] > 0.0 and hips[25, 0] / hips[:, 0].max() == pytest.approx(0.588, abs=0.002)
    before, after = (m.rotations.std(axis=0).max(-1) for m in (recording, made["half reach"]))
    assert (after / before).min() == pytest.approx(0.5, rel=0.1)


def test_recordings_that_cannot_be_used_are_named(tmp_path, gesture):
    gesture(4.0).save(tmp_path / "broken sound.npz")
    (tmp_path / "broken sound.wav").write_bytes(b"RIFF")
    pole = Skeleton(("top", "end"), (-1, 0), np.array([[0, 0, 0], [0, 1, 0]]))
    still = np.tile([0.0, 0.0, 0.0, 1.0], (100, 2, 1))
    Motion(pole, still, np.zeros((100, 3)), 25.0).save(tmp_path / "pole.npz")
    with pytest.raises(EvaluationError, match=r"(?=.*broken sound\.wav).*\bpole\b"):
        run_sanity(tmp_path)
    with pytest.raises(GestureKitError, match="nowhere"):
        run_sanity(tmp_path, tmp_path / "nowhere")


def result(key: str, value: float, **more) -> MetricResult:
    return MetricResult(key, Interval(value, None, None, 1, 1, "takes"), **more)


def of_recordings(**values: MetricResult) -> ModelResult:
    return ModelResult("recording", Path(), metrics=values)


@pytest.mark.parametrize(
    ("key", "own", "bad"),
    [
        # A fifth of the recordings' value to either side, where that is the goal.
        ("reach", result("reach", 2.0), {1.4: "+", 1.8: ".", 2.2: ".", 2.6: "+"}),
        # The better direction beyond that.
        ("foot_skate", result("foot_skate", 2.0), {1.4: "!", 1.8: ".", 2.2: ".", 2.6: "+"}),
        # Enough of it is enough.
        ("coverage", result("coverage", 50.0, recording=40.0), {28.0: "+", 35.0: ".", 70.0: "!"}),
        ("coverage", result("coverage", 50.0), {1.0: " "}),
        ("fgd", result("fgd", 1.0, recording=2.0), {2.7: "+", 2.2: ".", 0.5: "!"}),
        ("likeness", result("likeness", 0.9), {0.75: "+", 0.88: ".", 1.2: "!"}),
        ("novelty", result("novelty", 2.0), {1.4: "+", 1.8: ".", 3.0: "."}),
        ("in_time", result("in_time", 0.4), {0.15: "+", 0.25: ".", 0.8: "."}),
        ("calm_lively_slope", result("calm_lively_slope", 1.0), {0.1: ".", 9.0: "."}),
    ],
)
def test_metrics_notice_changes_of_a_fifth(key, own, bad):
    recordings = of_recordings(**{key: own})
    found = {value: mark(DEFINITIONS[key], result(key, value), recordings) for value in bad}
    assert found == bad


def test_speech_metrics_notice_the_loss_of_half_of_what_is_above_chance():
    recordings = of_recordings(sync=result("sync", 0.5, chance=0.1))
    for value, chance, expected in ((0.25, 0.1, "+"), (0.35, 0.1, "."), (0.4, 0.25, "+")):
        bad = result("sync", value, chance=chance)
        assert mark(DEFINITIONS["sync"], bad, recordings) == expected


def test_nothing_is_said_of_what_was_not_measured():
    recordings = of_recordings(reach=result("reach", 1.0))
    reach, bad = DEFINITIONS["reach"], result("reach", 9.0)
    assert mark(reach, None, recordings) == mark(reach, bad, of_recordings()) == " "
    assert mark(reach, result("reach", 9.0, informative=False), recordings) == " "
