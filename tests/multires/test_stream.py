"""Streams: what they promise about time, blocks, the future and the body."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from small_models import small_diffusion
from speakers import RATE, assert_played, voice
from streams import streamed

import audio_features as af
import gesturekit as gk
from gesturekit.errors import ModelError
from gesturekit.motion.concatenation import stacked
from gesturekit.motion.rotations import rotation_angles
from gesturekit.multires import MultiresGenerator
from gesturekit.multires.retrieval import RecordedLibrary


@pytest.fixture(scope="module")
def demo():
    return gk.load("demo")


@pytest.fixture(scope="module")
def demo_speech() -> np.ndarray:
    folder = Path(gk.__file__).parent / "models" / "demo"
    return af.Wave.load(folder / "speech.wav").resample(RATE).samples


@pytest.fixture(scope="module")
def speech() -> np.ndarray:
    """Three seconds of sound; speech begins after half a second."""
    return np.concatenate([np.zeros(RATE // 2, np.float32), voice(2.5).samples])


@pytest.fixture(scope="module")
def usual(state_model, speech) -> gk.Motion:
    return streamed(state_model.stream(RATE, seed=3), speech)


def equal(first: gk.Motion, second: gk.Motion, frames: slice = slice(None)) -> bool:
    return all(
        np.array_equal(one[frames], other[frames])
        for one, other in (
            (first.rotations, second.rotations),
            (first.translation, second.translation),
            (first.face.values, second.face.values),
        )
    )


# Time.


@pytest.mark.parametrize("samples, frames", [(0, 0), (266, 0), (267, 1), (16_000, 30), (1, 0)])
def test_a_stream_has_as_many_frames_as_a_file(state_model, samples, frames):
    """floor(duration · fps + 1/2), at 30 fps: 266 samples are 0.499 frames, 267 are 0.501."""
    stream = state_model.stream(RATE)
    parts = [stream.step(np.zeros(samples, np.float32)), stream.finish()]
    assert sum(part.n_frames for part in parts if part is not None) == stream.n_frames == frames


@pytest.mark.parametrize("look_ahead", [0.0, 0.4])
def test_a_frame_comes_after_its_latency_and_no_later(state_model, speech, look_ahead):
    stream = state_model.stream(RATE, look_ahead)
    assert stream.latency <= look_ahead + 2 / 30 + 0.011, "two frames more, and 10 ms of samples"
    given = 0
    for block in np.split(speech[:RATE], 100):
        stream.step(block)
        given += len(block)
        due = given / RATE - stream.latency
        assert stream.n_frames >= np.floor(due * state_model.fps - 1e-6) or due < 0.1
        assert stream.n_frames <= max(0, np.ceil((due + 0.1) * state_model.fps)) + 1


def test_the_latency_is_that_of_the_next_smaller_look_ahead(state_model):
    known = sorted(one.look_ahead for one in state_model.state_process.ahead)
    latencies = [state_model.stream(44_100, seconds).latency for seconds in known]
    assert latencies == sorted(set(latencies)) and len(known) > 2
    for seconds, latency in zip(known, latencies, strict=True):
        assert state_model.stream(44_100, seconds + 0.04).latency == latency
    assert state_model.stream(44_100, 5.0).latency == latencies[-1]


def test_the_size_of_blocks_changes_no_bit_and_a_stream_equals_its_replay(
    state_model, speech, usual
):
    rng = np.random.default_rng(0)
    odd = (int(rng.integers(0, 3000)) for _ in itertools.count())
    assert equal(streamed(state_model.stream(RATE, seed=3), speech, odd), usual)
    short = speech[RATE : RATE + 600]
    single = streamed(state_model.stream(RATE, seed=3), short, itertools.repeat(1))
    assert equal(streamed(state_model.stream(RATE, seed=3), short), single)


def test_sound_beyond_the_latency_has_no_influence(state_model, speech, usual):
    changed = speech.copy()
    changed[2 * RATE :] = np.random.default_rng(1).normal(0, 0.2, RATE)
    stream = state_model.stream(RATE, seed=3)
    before = slice(0, int((2.0 - stream.latency) * state_model.fps))
    other = streamed(stream, changed)
    assert equal(other, usual, before) and not equal(other, usual)


def test_a_stream_goes_on_from_its_state(state_model, speech, usual):
    first = state_model.stream(RATE, seed=3)
    begun = first.step(speech[: 2 * RATE + 123])
    kept = first.state()
    first.step(speech[: RATE // 2])
    second = state_model.stream(RATE, seed=3)
    second.restore(kept)
    rest = [second.step(speech[2 * RATE + 123 :]), second.finish()]
    assert equal(stacked([begun, *rest]), usual)


# Motion.


def test_seed_name_mood_liveliness_and_speaker_decide_what_is_shown(state_model, speech, usual):
    short, frames = speech[:RATE], slice(0, 21)
    same = streamed(state_model.stream(RATE, seed=3, mood_seed=3), short)
    assert equal(same, usual, frames)
    for options in (
        {"seed": 4},
        {"item": "b"},
        {"mood_seed": 4},
        {"liveliness": 2.0},
        {"speaker": "Bo"},
    ):
        other = streamed(state_model.stream(RATE, **{"seed": 3} | options), short)
        assert not np.array_equal(other.rotations[frames], usual.rotations[frames]), options
    assert other.face.values[:, 5] == pytest.approx(-1), "his face"


def test_fingers_and_the_face_are_played_from_the_recordings(usual):
    assert usual.n_frames == 90
    assert_played(usual)


def test_noise_without_voice_moves_as_silence_does(state_model):
    silent = streamed(state_model.stream(RATE), np.zeros(RATE // 2, np.float32))
    noise = np.random.default_rng(0).normal(0, 0.05, RATE // 2).astype(np.float32)
    assert equal(streamed(state_model.stream(RATE), noise), silent)


def arms(motion: gk.Motion) -> np.ndarray:
    """Mean speed (T - 1,) of both hands relative to the hips, m/s."""
    names, places = motion.skeleton.names, motion.positions()
    hands = places[:, [names.index("LeftHand"), names.index("RightHand")]] - places[:, :1]
    return np.linalg.norm(np.diff(hands, axis=0), axis=-1).mean(axis=1) * motion.fps


@pytest.mark.stress
def test_hands_move_with_the_speech_and_calm_down_after_it(demo, demo_speech):
    seconds = 9
    sound = np.concatenate([demo_speech[: seconds * RATE], np.zeros(6 * RATE, np.float32)])
    speed = arms(streamed(demo.stream(RATE, seed=1), sound, itertools.repeat(RATE)))
    spoken, after = speed[30 : 30 * seconds], speed[-90:]
    wave = af.Wave(demo_speech, RATE)
    loudness = np.log(wave.rms(np.arange(30, 30 * seconds) / 30, 0.3) + 1e-3)
    assert stats.spearmanr(spoken, loudness).statistic > 0.15
    assert np.median(spoken) > 2.0 * np.median(after)
    assert np.median(after) > 0.002, "idle, not frozen"


def test_a_stream_is_smooth_whole_and_as_lively_as_asked(demo, demo_speech):
    """No joint turns faster than in recordings, and the body stays; loudness changes nothing."""
    sound = demo_speech[: 3 * RATE // 2]
    made = streamed(demo.stream(RATE, seed=3), sound)
    turn = rotation_angles(made.rotations[1:], made.rotations[:-1])
    assert np.degrees(turn).max() * demo.fps < 900
    assert np.abs(np.diff(made.translation, axis=0)).max() * demo.fps < 0.5
    assert np.abs(made.translation[:, [0, 2]]).max() < 0.3
    lively, calm = (
        streamed(demo.stream(RATE, liveliness=amount, foot_lock=False), sound)
        for amount in (2.0, 0.4)
    )
    assert np.median(arms(lively)) > np.median(arms(calm))
    quiet = streamed(demo.stream(RATE, seed=3), 0.1 * sound[:RATE])
    assert np.degrees(rotation_angles(quiet.rotations, made.rotations[:30])).mean() < 0.5


def test_smoothing_takes_trembling_out_of_a_stream_and_hardly_moves_it(demo, demo_speech):
    smooth, raw = (
        demo.stream(RATE, seed=3, smooth=smooth, foot_lock=False).step(demo_speech[:RATE])
        for smooth in (0.1, 0)
    )
    arm = demo.skeleton.index("LeftForeArm")
    trembling = [np.diff(own.rotations[:, arm], n=3, axis=0).std() for own in (smooth, raw)]
    assert trembling[0] < 0.75 * trembling[1]
    assert np.degrees(rotation_angles(smooth.rotations, raw.rotations)).max() < 2


def test_a_stream_has_one_style(state_model):
    """The one that is asked for, or one drawn by the seed and the stream's name."""
    conditions = replace(state_model.conditions, styles=("calm", "glad"))
    config = state_model.network_config
    network = MultiresGenerator(state_model.representation, conditions.width, config).eval()
    known = state_model.library
    own = [replace(one, style=k) for k, one in enumerate(known.recordings)]
    library = RecordedLibrary(known.fps, known.passive, tuple(own))
    styled = replace(state_model, network=network, conditions=conditions, library=library)

    def begun(**choice) -> gk.Motion:
        return styled.stream(RATE, **choice).step(np.zeros(6000, np.float32))

    calm, glad = (begun(style=name) for name in ("calm", "glad"))
    assert not np.array_equal(calm.rotations, glad.rotations)
    assert calm.face.values[:, 5] == pytest.approx(1), "Ann's face, who is calm"
    for item in "ab":
        drawn, *asked = (begun(item=item, style=name) for name in (None, "calm", "glad"))
        assert any(equal(drawn, one) for one in asked)
    with pytest.raises(ModelError, match="one style"):
        styled.stream(RATE, style="calm@0-1,glad@1-2")
    with pytest.raises(ModelError, match="sad"):
        styled.stream(RATE, style="sad")


def test_what_cannot_stream_says_why(state_model, gesture):
    process = replace(state_model.state_process, ahead=())
    conditioner = replace(state_model.conditions.conditioner, extractor=af.Music())
    conditions = replace(state_model.conditions, conditioner=conditioner)
    deaf = replace(state_model.conditions, conditioner=None)
    for own, options, message in (
        (replace(state_model, state_process=process), {}, "live --fit"),
        (replace(state_model, state_process=None), {}, "state"),
        (replace(state_model, conditions=deaf), {}, "speech"),
        (replace(state_model, conditions=conditions), {}, "music"),
        (small_diffusion(gesture), {}, "diffusion"),
        *((state_model, {"look_ahead": x}, f"look_ahead={x}") for x in (-0.1, np.nan, np.inf)),
        (state_model, {"levels": 3}, "(?=.*levels)(?=.*smooth)"),
        (state_model, {"state": np.zeros((9, 12))}, "state"),
        (state_model, {"style": "old"}, "style='old'"),
    ):
        with pytest.raises(ModelError, match=message):
            own.stream(RATE, **options)
    stream = state_model.stream(RATE)
    for samples in (np.zeros((2, 3)), [[0.0], [0.0]], [0.0, np.nan], [np.inf]):
        with pytest.raises(ModelError, match="samples"):
            stream.step(np.array(samples))
    assert stream.step(np.zeros(0, np.float32)) is None


@pytest.mark.stress
def test_predictions_for_live_speech_are_added_by_a_command(
    state_model, speakers, gesturekit, tmp_path
):
    """The same bytes as those of the training."""
    process = replace(state_model.state_process, ahead=())
    replace(state_model, state_process=process).save(tmp_path / "model", notes={"Note": "kept"})
    before = (tmp_path / "model" / "README.md").read_text().splitlines()
    for _ in range(2):
        gesturekit("live", "--fit", speakers, "--model", tmp_path / "model").ok()
        assert gk.load(tmp_path / "model").fingerprint() == state_model.fingerprint()
        assert {*before} < {*(tmp_path / "model" / "README.md").read_text().splitlines()}
    plain = replace(state_model, state_process=None, library=None)
    plain.save(tmp_path / "plain")
    done = gesturekit("live", "--fit", speakers, "--model", tmp_path / "plain")
    assert done.status != 0 and "state" in done.err
