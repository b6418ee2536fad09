"""Streams of the bundled model: what they promise about time, blocks, the future and the body."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from scipy.ndimage import gaussian_filter1d
from small_models import small_diffusion
from streams import streamed

import audio_features as af
import gesturekit as gk
from gesturekit.errors import ModelError
from gesturekit.motion import rotation_angles
from gesturekit.motion.concatenation import stacked
from gesturekit.multires import MultiresGenerator

RATE = 16_000


@pytest.fixture(scope="module")
def model():
    return gk.load("demo")


@pytest.fixture(scope="module")
def speech() -> np.ndarray:
    """Two seconds of sound; speech begins after half a second."""
    wave = af.Wave.load(Path(gk.__file__).parent / "models" / "demo" / "speech.wav")
    sound = wave.resample(RATE).samples[: 3 * RATE // 2]
    return np.concatenate([np.zeros(RATE // 2, np.float32), sound])


@pytest.fixture(scope="module")
def usual(model, speech) -> gk.Motion:
    return streamed(model.stream(RATE, seed=3), speech)


def equal(first: gk.Motion, second: gk.Motion, frames: slice = slice(None)) -> bool:
    return np.array_equal(first.rotations[frames], second.rotations[frames]) and np.array_equal(
        first.translation[frames], second.translation[frames]
    )


# Time.


@pytest.mark.parametrize("samples, frames", [(0, 0), (266, 0), (267, 1), (16_000, 30), (1, 0)])
def test_a_stream_has_as_many_frames_as_a_file(model, samples, frames):
    """floor(duration · fps + 1/2), at 30 fps: 266 samples are 0.499 frames, 267 are 0.501."""
    stream = model.stream(RATE)
    parts = [stream.step(np.zeros(samples, np.float32)), stream.finish()]
    assert sum(part.n_frames for part in parts if part is not None) == stream.n_frames == frames


@pytest.mark.parametrize("look_ahead", [0.0, 0.4])
def test_a_frame_comes_after_its_latency_and_no_later(model, speech, look_ahead):
    stream = model.stream(RATE, look_ahead)
    assert stream.latency <= look_ahead + 0.011, "samples are taken 10 ms at a time"
    given = 0
    for block in np.split(speech[:RATE], 100):
        stream.step(block)
        given += len(block)
        due = given / RATE - stream.latency
        assert stream.n_frames >= np.floor(due * model.fps - 1e-6) or due < 0.1
        assert stream.n_frames <= max(0, np.ceil((due + 0.1) * model.fps)) + 1


def test_the_size_of_blocks_changes_no_bit_and_a_stream_equals_its_replay(model, speech, usual):
    rng = np.random.default_rng(0)
    odd = (int(rng.integers(0, 3000)) for _ in itertools.count())
    assert equal(streamed(model.stream(RATE, seed=3), speech, odd), usual)
    short = speech[RATE : RATE + 600]
    single = streamed(model.stream(RATE, seed=3), short, itertools.repeat(1))
    assert equal(streamed(model.stream(RATE, seed=3), short), single)
    for options in ({"seed": 4}, {"item": "b"}):
        other = streamed(model.stream(RATE, **{"seed": 3} | options), speech[:RATE])
        assert not equal(other, usual, slice(0, 25))


def test_sound_beyond_the_look_ahead_has_no_influence(model, speech, usual):
    changed = speech.copy()
    changed[3 * RATE // 2 :] = np.random.default_rng(1).normal(0, 0.2, RATE // 2)
    other = streamed(model.stream(RATE, seed=3), changed)
    before = slice(0, int((1.5 - 0.2) * model.fps))
    assert equal(other, usual, before) and not equal(other, usual)


def test_a_stream_goes_on_from_its_state(model, speech, usual):
    first = model.stream(RATE, seed=3)
    begun = first.step(speech[: RATE + 123])
    kept = first.state()
    first.step(speech[: RATE // 2])
    second = model.stream(RATE, seed=3)
    second.restore(kept)
    rest = [second.step(speech[RATE + 123 :]), second.finish()]
    assert equal(stacked([begun, *rest]), usual)


# Motion.


def arms(motion: gk.Motion) -> np.ndarray:
    """Mean speed (T - 1,) of both hands relative to the hips, m/s."""
    names, places = motion.skeleton.names, motion.positions()
    hands = places[:, [names.index("LeftHand"), names.index("RightHand")]] - places[:, :1]
    return np.linalg.norm(np.diff(hands, axis=0), axis=-1).mean(axis=1) * motion.fps


@pytest.mark.stress
def test_hands_move_with_the_speech_and_calm_down_after_it(model):
    wave = af.Wave.load(Path(gk.__file__).parent / "models" / "demo" / "speech.wav")
    seconds = 9
    sound = wave.resample(RATE).samples[: seconds * RATE]
    sound = np.concatenate([sound, np.zeros(6 * RATE, np.float32)])
    speed = arms(streamed(model.stream(RATE, seed=1), sound, itertools.repeat(RATE)))
    spoken, after = speed[30 : 30 * seconds], speed[-90:]
    loudness = np.log(wave.rms(np.arange(30, 30 * seconds) / 30, 0.3) + 1e-3)
    assert stats.spearmanr(spoken, loudness).statistic > 0.15
    assert np.median(spoken) > 2.0 * np.median(after)
    assert np.median(after) > 0.002, "idle, not frozen"


def test_noise_without_voice_moves_as_silence_does(model):
    silent = streamed(model.stream(RATE), np.zeros(RATE // 2, np.float32))
    noise = np.random.default_rng(0).normal(0, 0.05, RATE // 2).astype(np.float32)
    assert equal(streamed(model.stream(RATE), noise), silent)


def test_a_stream_is_smooth_whole_and_as_lively_as_asked(model, speech, usual):
    """No joint turns faster than in recordings, the body stays, fingers move; loudness is none."""
    turn = np.abs((usual.rotations[1:] * usual.rotations[:-1]).sum(axis=-1)).clip(0, 1)
    assert np.degrees(2 * np.arccos(turn)).max() * model.fps < 900
    assert np.abs(np.diff(usual.translation, axis=0)).max() * model.fps < 0.5
    assert np.abs(usual.translation[:, [0, 2]]).max() < 0.3
    fingers = [i for i, name in enumerate(model.skeleton.names) if name.endswith(("1", "2", "3"))]
    assert np.ptp(usual.rotations[:, fingers], axis=0).max() > 0.01, "fingers are recalled too"
    short = speech[: 3 * RATE // 2]
    lively, calm = (
        streamed(model.stream(RATE, liveliness=amount, foot_lock=False), short)
        for amount in (2.0, 0.4)
    )
    assert np.median(arms(lively)) > np.median(arms(calm))
    quiet = streamed(model.stream(RATE, seed=3), 0.1 * speech[:RATE])
    turn = np.abs((quiet.rotations * usual.rotations[:30]).sum(axis=-1)).clip(0, 1)
    assert np.degrees(2 * np.arccos(turn)).mean() < 0.5


def test_smoothed_streams_are_a_gaussian_mean_of_those_that_are_not(model, speech):
    """The Gaussian has 0.03 s; arms rest meanwhile, so that their motion is the recalled one."""
    resting = [replace(own, profiles=own.profiles * 0 - 10) for own in model.library.recordings]
    library = replace(model.library, recordings=tuple(resting), wanted=None)
    own = replace(model, library=library)
    smooth, raw = (
        own.stream(RATE, seed=3, smooth=smooth, foot_lock=False).step(speech[:RATE])
        for smooth in (0.1, 0)
    )
    arm = own.skeleton.index("LeftForeArm")
    q = raw.rotations[:, arm]
    q = q * np.sign((q * q[0]).sum(axis=-1, keepdims=True))
    mean = gaussian_filter1d(q, 0.03 * 30, axis=0)
    mean /= np.linalg.norm(mean, axis=-1, keepdims=True)
    apart, before = (
        np.median(rotation_angles(of[4:-4], smooth.rotations[4:-4, arm])) for of in (mean, q)
    )
    assert apart < 0.25 * before


def test_a_stream_has_one_style(model):
    """The one that is asked for, or one drawn by the seed and the stream's name."""
    conditions = replace(model.conditions, styles=("calm", "glad"))
    network = MultiresGenerator(model.representation, conditions.width, model.network_config)
    own = [replace(one, style=k % 2) for k, one in enumerate(model.library.recordings)]
    library = replace(model.library, recordings=tuple(own))
    styled = replace(model, network=network.eval(), conditions=conditions, library=library)

    def begun(**choice) -> bytes:
        return styled.stream(RATE, **choice).step(np.zeros(4000, np.float32)).rotations.tobytes()

    calm, glad = (begun(style=name) for name in ("calm", "glad"))
    assert calm != glad
    for item in "ab":
        asked = [begun(item=item, style=name) for name in (None, "calm", "glad")]
        assert asked[0] in asked[1:]
    with pytest.raises(ModelError, match="one style"):
        styled.stream(RATE, style="calm@0-1,glad@1-2")
    with pytest.raises(ModelError, match="sad"):
        styled.stream(RATE, style="sad")


def test_the_latency_is_that_of_the_next_smaller_look_ahead(model):
    known = sorted(one.look_ahead for one in model.library.ahead)
    latencies = [model.stream(44_100, seconds).latency for seconds in known]
    assert latencies == sorted(set(latencies)) and len(known) > 2
    for seconds, latency in zip(known, latencies, strict=True):
        assert model.stream(44_100, seconds + 0.04).latency == latency
    assert model.stream(44_100, 5.0).latency == latencies[-1]


def test_what_cannot_stream_says_why(model, gesture):
    no_ahead = replace(model, library=replace(model.library, ahead=()))
    no_recall = replace(model, library=None)
    conditioner = replace(model.conditions.conditioner, extractor=af.Music())
    music = replace(model, conditions=replace(model.conditions, conditioner=conditioner))
    for own, options, message in (
        (no_ahead, {}, "live --fit"),
        (no_recall, {}, "recall"),
        (music, {}, "music"),
        (small_diffusion(gesture), {}, "diffusion"),
        *((model, {"look_ahead": x}, f"look_ahead={x}") for x in (-0.1, np.nan, np.inf)),
        (model, {"levels": 3}, "(?=.*levels)(?=.*smooth)"),
        (model, {"style": "old"}, "style='old'"),
    ):
        with pytest.raises(ModelError, match=message):
            own.stream(RATE, **options)
    stream = model.stream(RATE)
    for samples in (np.zeros((2, 3)), [[0.0], [0.0]], [0.0, np.nan], [np.inf]):
        with pytest.raises(ModelError, match="samples"):
            stream.step(np.array(samples))
    assert stream.step(np.zeros(0, np.float32)) is None
