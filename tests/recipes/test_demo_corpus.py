"""The demo corpus: the talker must be worth learning from."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from hinges import bent_backwards
from scipy.spatial.transform import Rotation

import audio_features as af
import gesturekit as gk
import gesturekit.systems
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
    recipe["prepare"].main([str(folder), "--minutes", "0.5"])
    return folder


@pytest.fixture(scope="module")
def talks(recipe) -> dict[str, list[tuple[af.Wave, Motion]]]:
    """A talk of 30 s of each style, gestured to with two seeds."""
    spoken = {s: recipe["measure"].held_out_talks(s, 1, seed=7)[0] for s in ("calm", "lively")}
    return {
        style: [(wave, recipe["talker"].talk(wave, seed)) for seed in (0, 1)]
        for style, wave in spoken.items()
    }


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


def test_arms_follow_the_speech(talks):
    found = [sync(motion, wave) for wave, motion in talks["calm"] + talks["lively"]]
    assert np.mean([each.r for each in found]) > 0.4  # a recording of a person has 0.5
    assert np.mean([each.z for each in found]) > 2.5
    assert all(each.r > 0.3 and -0.2 <= each.lag <= 0.1 for each in found)


def test_hands_move_as_far_and_as_fast_as_a_persons(talks):
    for style, (slow, fast) in {"calm": (0.1, 0.3), "lively": (0.3, 0.7)}.items():
        for _, motion in talks[style]:
            places = wrists(motion)
            speed = np.linalg.norm(np.diff(places, axis=0), axis=-1) * motion.fps
            assert slow < np.median(speed) < fast, style
            assert np.quantile(speed, 0.9) > 2.5 * np.median(speed)  # strokes and holds
            assert np.ptp(places[..., 1]) > 0.6
            for hand in (0, 1):
                assert np.ptp(places[:, hand, 1]) > 0.4


def test_two_seeds_gesture_differently_and_two_speeches_do(talks):
    (_, one), (_, other) = talks["lively"]
    calm = talks["calm"][0][1]
    n = min(one.n_frames, calm.n_frames)
    for a, b in ((one, other), (one[:n], calm[:n])):
        assert np.linalg.norm(wrists(a) - wrists(b), axis=-1).mean() > 0.12


def test_trunk_and_head_take_part_over_feet_that_stand(talks):
    for style, least in (("calm", 4.0), ("lively", 6.0)):
        for _, motion in talks[style]:
            turns = motion.global_rotations()
            for joint in ("Spine2", "Head"):
                first = turns[:, motion.skeleton.index(joint)]
                away = np.degrees(rotation_angles(first, first[:1]))
                assert np.quantile(away, 0.9) > least, (style, joint)
            assert 0.04 < np.ptp(motion.translation[:, 0]) < 0.12  # from foot to foot


def test_arms_rest_in_silence(corpus):
    idle = arm_speed(Motion.load(corpus / "paired" / "calm_00.bvh")).mean()
    talking = [
        arm_speed(motion)[speech_envelope(wave, motion.fps, motion.n_frames) > np.log(0.01)].mean()
        for style in ("calm", "lively")
        for wave, motion in pairs(corpus, style)
    ]
    assert idle < 0.15
    assert min(talking) > 1.5
    assert max(talking) < 12.0


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


def test_bodies_stay_possible(talks):
    for _, motion in talks["calm"] + talks["lively"]:
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


def bends(motion: Motion, side: str, finger: str) -> np.ndarray:
    """Return the flexion (T, 3) of a finger's joints towards the palm, degrees."""
    names = [f"{side}Hand{finger}{k}" for k in (1, 2, 3)]
    places = [motion.positions()[:, motion.skeleton.index(name)] for name in names]
    bones = np.diff([*places, motion.end_positions()[names[-1]].reshape(-1, 3)], axis=0)
    hand = Rotation.from_quat(motion.global_rotations()[:, motion.skeleton.index(f"{side}Hand")])
    outward = 1 if side == "Left" else -1
    own = [hand.inv().apply(bone) for bone in bones]  # palms face -y in a T-pose
    towards = np.unwrap([np.arctan2(-b[:, 1], outward * b[:, 0]) for b in own], axis=0)
    return np.degrees(np.diff(towards, axis=0, prepend=0)).T


def test_fingers_bend_as_far_as_fingers_do_and_take_every_shape(talks):
    found = {"open": 0, "fist": 0, "pointing": 0}
    for _, motion in talks["calm"] + talks["lively"]:
        for side in ("Left", "Right"):
            chains = [bends(motion, side, f) for f in ("Index", "Middle", "Ring", "Pinky")]
            for bent in chains:
                assert bent.min() > -12
                assert (bent.max(axis=0) < [90, 110, 75]).all()  # passive ranges of motion
            index, *others = (bent[:, 1] for bent in chains)  # the middle joints
            found["open"] += (np.max([index, *others], axis=0) < 15).sum()
            found["fist"] += (np.min([index, *others], axis=0) > 60).sum()
            found["pointing"] += ((index < 15) & (np.min(others, axis=0) > 50)).sum()
            assert np.ptp(index) > 20
    assert min(found.values()) > 30, found  # frames


def test_hands_stay_clear_of_the_trunk_the_head_and_each_other(talks):
    for _, motion in talks["calm"] + talks["lively"]:
        index, positions = motion.skeleton.index, motion.positions()
        chest = Rotation.from_quat(motion.global_rotations()[:, index("Spine2")])
        hands = []
        for side in ("Left", "Right"):
            joints = [index(name) for name in motion.skeleton.names if f"{side}Hand" in name]
            tips = [v for name, v in motion.end_positions().items() if f"{side}Hand" in name]
            hand = np.concatenate([positions[:, joints], *tips], axis=1).swapaxes(0, 1)
            local = np.stack([chest.inv().apply(p - positions[:, index("Spine2")]) for p in hand])
            # The trunk: an ellipse of 32 by 22 cm, up to the shoulders.
            inside = np.hypot(local[..., 0] / 0.16, local[..., 2] / 0.11) < 1.15
            assert not (inside & (local[..., 1] < 0.2)).any()
            face = positions[:, index("Head")] + [0, 0.08, 0]
            assert np.linalg.norm(hand - face, axis=-1).min() > 0.12
            hands.append(hand)
        gaps = np.linalg.norm(hands[0][:, None] - hands[1][None], axis=-1)
        assert gaps.min() > 0.012  # fingers may touch, but not enter each other


def test_a_lively_mood_moves_more_than_a_calm_one_in_the_same_speech(recipe, talks):
    talker = recipe["talker"]
    wave, _ = talks["calm"][0]

    def made(**mood) -> Motion:
        return talker.talk(wave, 0, lambda time: talker.Mood(**mood))

    calm, lively = (made(liveliness=by) for by in (-0.8, 0.8))
    assert arm_speed(lively).mean() > 2 * arm_speed(calm).mean() > 0
    assert np.array_equal(made(liveliness=0.8).rotations, lively.rotations)
    high, low = (wrists(made(liveliness=0.4, height=by))[..., 1].mean() for by in (0.05, -0.05))
    assert 0.02 < high - low < 0.1
    wide, narrow = (arm_speed(made(liveliness=0.4, width=by)).mean() for by in (1.2, 0.8))
    assert wide > 1.15 * narrow
    left, right = (
        np.abs(np.diff(wrists(made(left=share)), axis=0)).sum(axis=(0, 2)) for share in (1.0, 0.0)
    )
    assert left[0] / left[1] > 1.1 * right[0] / right[1]


def test_without_moods_the_talker_moves_as_it_did_before_it_had_them(recipe):
    motion = recipe["talker"].talk(af.Wave.load(gk.systems.bundled_speech()), 0)
    places = wrists(motion)
    paths = np.linalg.norm(np.diff(places, axis=0), axis=-1).sum(axis=0)
    # Measured on the talker without moods, metres.
    assert paths == pytest.approx([5.206196, 5.922876], rel=1e-4)
    assert places[..., 1].mean(axis=0) == pytest.approx([1.176335, 1.182267], rel=1e-4)


def test_a_corpus_of_moods_is_a_speakers_and_its_truth(recipe, tmp_path):
    short = ["--talks", "2", "--seconds", "6"]
    for folder, seed in (("one", "0"), ("same", "0"), ("other", "1")):
        recipe["moods"].main([str(tmp_path / folder), *short, "--seed", seed])
    names = {path.name for path in (tmp_path / "one").iterdir()}
    stems = ("talk_01", "talk_02")
    expected = {stem + suffix for stem in stems for suffix in (".wav", ".bvh")}
    assert names == expected | {"moods.csv", "speaker.json"}
    for name in names:
        one, same, other = ((tmp_path / f / name).read_bytes() for f in ("one", "same", "other"))
        assert one == same, name
        assert one != other, name
    rows = (tmp_path / "one" / "moods.csv").read_text(encoding="utf-8").splitlines()
    assert rows[0] == "talk,time,mood,height,width,left"
    wave = af.Wave.load(tmp_path / "one" / "talk_01.wav")
    assert sum(row.startswith("talk_01,") for row in rows) == np.ceil(wave.duration)


def test_moods_have_the_spreads_and_the_time_constant_that_are_asked_for(recipe):
    moods = recipe["moods"]
    rng = np.random.default_rng(0)
    drawn = np.array([moods.process(rng, 600, moods.Spread(0.4, 0.3), 5.0) for _ in range(200)])
    assert np.std(drawn) == pytest.approx(0.5, rel=0.1)
    # Over a minute, the mean within the talk is not quite zero.
    assert np.mean(np.var(drawn, axis=1)) ** 0.5 == pytest.approx(0.3, rel=0.15)
    steps = drawn[:, 50:] - drawn[:, :-50]  # 5 s apart
    assert 1 - np.mean(steps**2) / (2 * 0.3**2) == pytest.approx(0.5, abs=0.07)


def test_a_bundle_is_the_model_in_fewer_bytes_with_its_figures(recipe, tmp_path, monkeypatch):
    """The card states what `measure.py` finds of the bundled files."""
    monkeypatch.setattr(recipe["measure"], "ITEM_SECONDS", 6.0)
    model, speech = gk.systems.model_folder("demo"), gk.systems.bundled_speech()
    run, out = tmp_path / "model", tmp_path / "out"
    gk.load("demo").save(run)  # in full precision, as a run leaves it
    recipe["bundle"].bundle(run, speech, out, talks=1)
    assert {path.name for path in out.iterdir()} == {path.name for path in model.iterdir()}
    size = {f: (f / "model.safetensors").stat().st_size for f in (run, out)}
    assert size[out] < 0.75 * size[run]  # recalled motion stays in full precision
    one, other = (gk.load(folder).generate(seconds=3.0, seed=0) for folder in (run, out))
    assert np.degrees(rotation_angles(one.rotations, other.rotations).max()) < 1.0
    card = (out / "README.md").read_text(encoding="utf-8")
    assert recipe["measure"].table(str(out), talks=1) in card
    assert "measure.py" in card


@pytest.mark.stress
def test_one_command_makes_a_bundle(recipe, tmp_path):
    tiny = ["network.channels=[2,2]", "network.levels=4", "threads=1"]
    tiny += ["training.first_stage=2", "training.further_stages=2", "training.window_cache=2"]
    recipe["bundle"].main(
        [str(tmp_path / "work"), "--out", str(tmp_path / "out"), "--minutes", "0.5", "--talks", "1"]
        + tiny
    )
    motion = gk.load(tmp_path / "out").generate(tmp_path / "out" / "speech.wav")
    assert motion.duration > 5
