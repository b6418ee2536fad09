"""What is done to a real recording moves each measure the way it should, or not at all; and putting
it on another frame rate moves none that is per second."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import soundfile

from audio_features import Wave
from gesturekit.evaluation import acceleration, arm_speed, foot_skate, jerk, joint_speed, sync
from gesturekit.evaluation import wrist_speed as wrist_speeds
from gesturekit.evaluation.definitions import GROUPS, Variants
from gesturekit.evaluation.measuring.clip_metrics import ClipMetrics
from gesturekit.evaluation.measuring.clips import Clip, read_semantic
from gesturekit.evaluation.measuring.inputs import ReferenceStatistics
from gesturekit.evaluation.metrics.rhythm import (
    beat_alignment,
    beat_consistency,
    music_beats,
    speech_onsets,
)
from gesturekit.evaluation.pairs import Pair
from gesturekit.motion import Motion
from gesturekit.motion.parts import body_joints
from gesturekit.motion.rotations import multiply_quaternions, quaternion_from_rotation_vector

SECONDS = 30


def slid(motion: Motion) -> Motion:
    """The feet glide: the whole body sways sideways by 20 cm, slowly."""
    sway = 0.2 * np.sin(2 * np.pi * 0.4 * motion.times)
    return replace(motion, translation=motion.translation + np.outer(sway, [1.0, 0.0, 0.0]))


def sunk(motion: Motion) -> Motion:
    """The whole body is 3 cm lower."""
    return replace(motion, translation=motion.translation - [0.0, 0.03, 0.0])


def jittered(motion: Motion) -> Motion:
    """Every joint shakes by 4 degrees, anew in each frame."""
    noise = np.random.default_rng(0).normal(0, 0.07, (*motion.rotations.shape[:2], 3))
    shaken = multiply_quaternions(motion.rotations, quaternion_from_rotation_vector(noise))
    return replace(motion, rotations=shaken)


def shifted(motion: Motion) -> Motion:
    """Four seconds late; what the end has too much comes first."""
    k = round(4 * motion.fps)
    return replace(
        motion,
        rotations=np.roll(motion.rotations, k, axis=0),
        translation=np.roll(motion.translation, k, axis=0),
    )


def frozen(motion: Motion) -> Motion:
    """The first pose, held."""
    return replace(
        motion,
        rotations=np.tile(motion.rotations[:1], (motion.n_frames, 1, 1)),
        translation=np.tile(motion.translation[:1], (motion.n_frames, 1)),
    )


DISTURBANCES = (slid, sunk, jittered, shifted, frozen)

# "+" rises, "-" falls, "0" stays within a hundredth (of the recording's own figure, or of 1 where
# that is 0), "?" may do either, "x" cannot be taken (the report says why). A shift leaves the
# recording's own movement as it is, but for the one jump where its ends meet. CCA is fitted on
# what it measures and hardly moves at all: for it a ten thousandth counts.
SIGNS = {
    "sync": "00---",
    "sync_z": "00---",
    "bas": "?0??-",
    "bc": "?0??-",
    "bc_z": "?0---",
    "srgr": "00---",
    "arm_speed": "00+?-",
    "wrist_speed": "+0+?-",
    "acceleration": "+0+?-",
    "jerk": "?0+?-",
    "acceleration_genea": "+0+?-",
    "jerk_genea": "?0+?-",
    "foot_skate": "+++?-",
    "floor_penetration": "0++0?",
    "joint_limits": "00+00",
    "l1_diversity": "00+0-",
    "hellinger": "+0+?+",
    "cca": "00--x",
    "coverage": "?0-0-",
    "global_diversity": "?0+?+",
    "local_diversity": "?0+?+",
}


@pytest.fixture(scope="module")
def pair_of_files(shared_data, tmp_path_factory):
    """Half a minute of a recording of speech, as motion and sound."""
    (bvh,) = shared_data.glob("paired/zeggs*/*.bvh")
    wave = Wave.load(bvh.with_suffix(".wav")).slice(0, SECONDS)
    sound = tmp_path_factory.mktemp("sound") / "speech.wav"
    soundfile.write(sound, wave.samples, wave.sample_rate)
    motion = Motion.load(bvh)
    return motion.slice(0, round(SECONDS * motion.fps)), sound


@pytest.fixture(scope="module")
def measured(pair_of_files, tmp_path_factory):
    """measured(motion): its figures beside the recording."""
    recording, sound = pair_of_files
    folder = tmp_path_factory.mktemp("recorded")
    recording.save(folder / "speech.npz")
    table = folder / "speech.txt"
    table.write_text("gesture\t5.0\t20.0\t15.0\t0.5\t\n")
    statistics = ReferenceStatistics.of({"speech": folder / "speech.npz"}, recording.fps)
    metrics = ClipMetrics(statistics, GROUPS, Variants())
    pair = Pair("speech", "speech", None, folder / "g.npz", folder / "speech.npz", sound)
    joints = body_joints(recording.skeleton)

    def measure(motion: Motion) -> dict[str, float]:
        clip = Clip(pair, motion, recording, joints, read_semantic(table), ())
        return metrics.generated(clip)[0]

    return measure


def test_every_measure_moves_the_way_it_should(pair_of_files, measured):
    recording, _ = pair_of_files
    base = measured(recording)
    found = {name.__name__: measured(name(recording)) for name in DISTURBANCES}
    wrong = []
    for key, signs in SIGNS.items():
        for disturbance, sign in zip(DISTURBANCES, signs, strict=True):
            value = found[disturbance.__name__].get(key)
            if sign == "x" or value is None:
                if (sign == "x") != (value is None):
                    wrong.append(f"{key}, {disturbance.__name__}: {value}, expected {sign}")
                continue
            step = (1e-4 if key == "cca" else 0.01) * (abs(base[key]) or 1.0)
            moved = "+" if value > base[key] + step else "-" if value < base[key] - step else "0"
            if sign not in ("?", moved):
                what = f"{key}, {disturbance.__name__}"
                wrong.append(f"{what}: {base[key]:.4g} -> {value:.4g}, expected {sign}")
    assert not wrong, "\n".join(wrong)


def test_speech_measures_stand_out_from_chance_on_the_recording_alone(pair_of_files, measured):
    recording, _ = pair_of_files
    own, late = measured(recording), measured(shifted(recording))
    assert own["sync_z"] > 2.0 and own["bc_z"] > 1.0
    assert abs(late["sync"] - late["sync_chance"]) < 0.25 and late["sync_z"] < 1.5
    assert late["bc_z"] < 1.0


@pytest.mark.parametrize("fps", [25, 60])
def test_frame_rate_moves_speeds_and_beats_by_less_than_a_twentieth(pair_of_files, fps):
    recording, sound = pair_of_files
    wave = Wave.load(sound)
    onsets, pulse = speech_onsets(wave), music_beats(wave)

    def metrics(motion: Motion) -> dict[str, float]:
        return {
            "arm speed": arm_speed(motion).mean(),
            "wrist speed": wrist_speeds(motion).mean(),
            "joint speed": joint_speed(motion).mean(),
            "foot skate": foot_skate(motion),
            "acceleration, 6 Hz": acceleration(motion, cutoff=6.0),
            "jerk, 6 Hz": jerk(motion, cutoff=6.0),
            "BAS": beat_alignment(motion, pulse).score,
            "BAS on onsets": beat_alignment(motion, onsets).score,
            "BC": beat_consistency(motion, onsets).score,
            "sync": sync(motion, wave).r,
        }

    assert recording.fps == pytest.approx(30, abs=0.01)
    at_30, other = metrics(recording), metrics(recording.resample(float(fps)))
    for name, value in other.items():
        assert value == pytest.approx(at_30[name], rel=0.05), name
    # The unfiltered forms are bound to their frame rate: they are marked so for a reason.
    assert jerk(recording.resample(60.0)) > 2 * jerk(recording)
