"""The demo corpus: the talker must be worth learning from."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import audio_features as af
from gesturekit import Motion
from gesturekit.evaluation import arm_speed, speech_envelope, sync
from gesturekit.motion.rotations import rotation_angles

pytest.importorskip(
    "espeakng_loader", reason="espeak-ng not installed: pip install espeakng-loader"
)

RECIPE = Path(__file__).resolve().parents[2] / "recipes" / "demo"


@pytest.fixture(scope="module")
def recipe():
    """The recipe's modules, which import each other by their bare names."""
    sys.path.insert(0, str(RECIPE))
    import prepare
    import talker
    import voice

    yield {"prepare": prepare, "talker": talker, "voice": voice}
    sys.path.remove(str(RECIPE))
    for name in ("prepare", "talker", "rig", "texts", "voice"):
        sys.modules.pop(name, None)


@pytest.fixture(scope="module")
def corpus(recipe, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("corpus")
    recipe["prepare"].main([str(folder), "--minutes", "0.5"])
    return folder


def pairs(corpus: Path, style: str) -> list[tuple[af.Wave, Motion]]:
    """Everything of one style except the near-silence."""
    return [
        (af.Wave.load(path), Motion.load(path.with_suffix(".bvh")))
        for path in sorted((corpus / "paired").glob(f"{style}_*.wav"))
        if path.stem != "calm_00"
    ]


def test_files_are_as_promised(corpus):
    names = {path.relative_to(corpus).as_posix() for path in corpus.rglob("*") if path.is_file()}
    stems = ("paired/calm_00", "paired/calm_01", "paired/lively_01")
    expected = {stem + suffix for stem in stems for suffix in (".wav", ".bvh")}
    assert names == expected | {"unpaired/01.wav", "demo.wav"}
    seconds = sum(af.Wave.load(path).duration for path in (corpus / "paired").glob("*.wav"))
    assert 20 < seconds < 42
    for wave, motion in pairs(corpus, "calm") + pairs(corpus, "lively"):
        assert motion.n_frames == wave.n_frames(motion.fps)


def test_same_seed_same_bytes(recipe, corpus, tmp_path):
    recipe["prepare"].main([str(tmp_path), "--minutes", "0.5"])
    for path in corpus.rglob("*"):
        if path.is_file():
            again = tmp_path / path.relative_to(corpus)
            assert again.read_bytes() == path.read_bytes(), path.name


def test_another_seed_says_other_things(recipe, corpus):
    order = [recipe["prepare"].shuffled(range(64), np.random.default_rng([s, 0])) for s in (0, 1)]
    assert next(order[0]) != next(order[1])


def test_arms_follow_the_speech(corpus):
    results = [sync(motion, wave) for s in ("calm", "lively") for wave, motion in pairs(corpus, s)]
    for result in results:
        assert result.r >= 0.5
        assert -0.2 <= result.lag <= 0.0  # the hands lead the sound


def test_arms_rest_in_silence(corpus):
    idle = arm_speed(Motion.load(corpus / "paired" / "calm_00.bvh")).mean()
    talking = [
        arm_speed(motion)[speech_envelope(wave, motion.fps, motion.n_frames) > np.log(0.01)].mean()
        for style in ("calm", "lively")
        for wave, motion in pairs(corpus, style)
    ]
    assert idle < 0.1
    assert min(talking) > 0.5
    assert max(talking) < 4.0


def test_a_lively_voice_moves_more_than_a_monotone_one(recipe):
    sentences = [
        "So, let me tell you how the whole thing started, because it is a good story.",
        "There were hundreds of people on the bridge, all looking up at the sky.",
        "The trick is to wait, and nobody likes waiting, not even for a minute.",
    ]
    mean = {}
    for pitch_range in (0, 95):
        voice = recipe["voice"].Voice("en-us+m3", rate=160, pitch_range=pitch_range)
        spoken, rate = recipe["voice"].speak(sentences, voice)
        wave = af.Wave(np.concatenate(spoken), rate, None)
        speeds = [arm_speed(recipe["talker"].talk(wave, seed)).mean() for seed in range(8)]
        mean[pitch_range] = np.mean(speeds)
    assert mean[95] > 1.1 * mean[0]


def test_feet_stand_still(corpus):
    for path in (corpus / "paired").glob("*.bvh"):
        motion = Motion.load(path)
        positions = motion.positions()
        for foot in ("LeftFoot", "RightFoot", "LeftToeBase", "RightToeBase"):
            track = positions[:, motion.skeleton.index(foot)]
            speed = np.linalg.norm(np.diff(track, axis=0), axis=1) * motion.fps
            assert speed.max() < 0.01  # m/s
        floor = min(end[..., 1].min() for end in motion.end_positions().values())
        assert floor == pytest.approx(0.02, abs=0.005)  # the height of the toes' ends


def test_bodies_stay_possible(corpus):
    for path in (corpus / "paired").glob("*.bvh"):
        motion = Motion.load(path)
        index = motion.skeleton.index
        speed = rotation_angles(motion.rotations[:-1], motion.rotations[1:]) * motion.fps
        assert speed.max() < 12  # rad/s
        # No jerks: acceleration of any joint, smoothed by nothing, stays that of a person.
        acceleration = np.diff(motion.positions(), n=2, axis=0) * motion.fps**2
        assert np.linalg.norm(acceleration, axis=-1).max() < 60  # m/s²
        positions = motion.positions()
        for side in ("Left", "Right"):
            shoulder, elbow, wrist = (
                positions[:, index(side + name)] for name in ("Arm", "ForeArm", "Hand")
            )
            upper, fore = elbow - shoulder, wrist - elbow
            cosine = np.sum(upper * fore, axis=1) / (0.28 * 0.25)
            flexion = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
            assert flexion.min() > 5
            assert flexion.max() < 150
            for spine in ("Hips", "Spine", "Spine1", "Spine2"):
                aside = (wrist - positions[:, index(spine)])[:, [0, 2]]
                assert np.linalg.norm(aside, axis=1).min() > 0.18
        hands = positions[:, index("LeftHand")] - positions[:, index("RightHand")]
        assert np.linalg.norm(hands, axis=1).min() > 0.15
