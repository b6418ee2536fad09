"""The demo corpus: the talker must be worth learning from."""

import sys
from pathlib import Path

import numpy as np
import pytest
from hinges import bent_backwards

import audio_features as af
import gesturekit as gk
import gesturekit.systems
from gesturekit import Motion
from gesturekit.evaluation import arm_speed, sync
from gesturekit.motion.rotations import rotation_angles

pytest.importorskip(
    "espeakng_loader", reason="espeak-ng not installed: pip install espeakng-loader"
)

RECIPE = Path(__file__).resolve().parents[2] / "recipes" / "demo"


@pytest.fixture(scope="module")
def recipe():
    """The recipe's modules, which import each other by their bare names."""
    sys.path.insert(0, str(RECIPE))
    import bundle
    import measure
    import moods
    import prepare
    import talker
    import voice

    modules = (bundle, measure, moods, prepare, talker, voice)
    yield {module.__name__: module for module in modules}
    sys.path.remove(str(RECIPE))
    for name in ("bundle", "measure", "moods", "prepare", "talker", "rig", "texts", "voice"):
        sys.modules.pop(name, None)


@pytest.fixture(scope="module")
def corpus(recipe, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("corpus")
    recipe["prepare"].main([str(folder), "--minutes", "0.3"])
    return folder


@pytest.fixture(scope="module")
def talks(recipe) -> dict[str, tuple[af.Wave, Motion]]:
    """A talk of 30 s of each style, and the gestures to it."""
    spoken = {s: recipe["measure"].held_out_talks(s, 1, seed=7)[0] for s in ("calm", "lively")}
    return {style: (wave, recipe["talker"].talk(wave, 0)) for style, wave in spoken.items()}


def wrists(motion: Motion) -> np.ndarray:
    return motion.positions()[:, [motion.skeleton.index(f"{s}Hand") for s in ("Left", "Right")]]


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
    assert names >= {stem + suffix for stem in stems for suffix in (".wav", ".bvh")}
    assert names >= {"unpaired/01.wav", "demo.wav"}
    seconds = sum(af.Wave.load(path).duration for path in (corpus / "paired").glob("*.wav"))
    assert 12 < seconds < 26
    for wave, motion in pairs(corpus, "calm") + pairs(corpus, "lively"):
        assert motion.n_frames == wave.n_frames(motion.fps)


def test_same_seed_same_bytes(recipe, corpus, tmp_path):
    recipe["prepare"].main([str(tmp_path), "--minutes", "0.3"])
    for path in corpus.rglob("*"):
        if path.is_file():
            again = tmp_path / path.relative_to(corpus)
            assert again.read_bytes() == path.read_bytes(), path.name


def test_arms_follow_the_speech(talks):
    found = [sync(motion, wave) for wave, motion in talks.values()]
    assert np.mean([each.r for each in found]) > 0.4  # a recording of a person has 0.5
    assert np.mean([each.z for each in found]) > 2.5
    assert all(each.r > 0.3 and -0.2 <= each.lag <= 0.1 for each in found)


def test_a_lively_mood_moves_more_than_a_calm_one_in_the_same_speech(recipe, talks):
    talker = recipe["talker"]
    wave, _ = talks["calm"]
    wave = af.Wave(wave.samples[: 12 * wave.sample_rate], wave.sample_rate)

    def made(**mood) -> Motion:
        return talker.talk(wave, 0, lambda time: talker.Mood(**mood))

    calm, lively = (made(liveliness=by) for by in (-0.8, 0.8))
    assert arm_speed(lively).mean() > 2 * arm_speed(calm).mean() > 0
    high, low = (wrists(made(liveliness=0.4, height=by))[..., 1].mean() for by in (0.05, -0.05))
    assert 0.02 < high - low < 0.1


@pytest.mark.stress
def test_one_command_makes_a_bundle_in_fewer_bytes_with_its_figures(recipe, tmp_path):
    tiny = ["network.channels=[2,2]", "network.levels=4", "threads=1"]
    tiny += ["training.first_stage=2", "training.further_stages=2", "training.window_cache=2"]
    work, out = tmp_path / "work", tmp_path / "out"
    recipe["bundle"].main([str(work), "--out", str(out), "--minutes", "0.5", "--talks", "1", *tiny])
    assert gk.load(out).generate(out / "speech.wav").duration > 5
    card = (out / "README.md").read_text(encoding="utf-8")
    assert recipe["measure"].table(str(out), talks=1) in card


def test_bodies_stay_possible(talks):
    for _, motion in talks.values():
        index = motion.skeleton.index
        speed = rotation_angles(motion.rotations[:-1], motion.rotations[1:]) * motion.fps
        assert speed.max() < 16  # rad/s
        # No jerks: acceleration of any joint, smoothed by nothing, stays that of a person.
        positions = motion.positions()
        acceleration = np.diff(positions, n=2, axis=0) * motion.fps**2
        assert np.linalg.norm(acceleration, axis=-1).max() < 60  # m/s²
        assert not any(frames.any() for frames in bent_backwards(motion).values())
        for side in ("Left", "Right"):
            shoulder, elbow, wrist = (
                positions[:, index(side + name)] for name in ("Arm", "ForeArm", "Hand")
            )
            upper, fore = elbow - shoulder, wrist - elbow
            cosine = np.sum(upper * fore, axis=1) / (0.28 * 0.25)
            flexion = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
            assert flexion.min() > 5
            assert flexion.max() < 150
