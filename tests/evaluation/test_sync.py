"""In time with the sound: sync, beat alignment and beat consistency."""

import math

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, gaussian_filter1d
from scipy.signal import argrelextrema

from audio_features import Wave
from gesturekit.errors import EvaluationError, MotionError
from gesturekit.evaluation import (
    arm_speed,
    beat_alignment,
    beat_consistency,
    motion_beats,
    music_beats,
    speech_envelope,
    speech_onsets,
    sync,
)
from gesturekit.evaluation.metrics.rhythm import consistency, joint_beats
from gesturekit.motion import Motion

ELBOW, SHOULDER = "LeftForeArm", "RightArm"


@pytest.mark.parametrize("shift", [-5, 0, 3])
def test_the_lag_of_a_motion_made_from_the_sound_is_found(turning, speaking, curve, shift):
    loudness = curve(500, seed=0)
    speed = 4.0 * np.roll(loudness, shift)
    # From frame k to k + 1 it turns with the mean of what it is to have at either.
    motion = turning({ELBOW: 0.5 * (speed + np.roll(speed, -1))})
    result = sync(motion, speaking(5.0 * loudness))
    assert result.r > 0.97
    assert result.lag == pytest.approx(shift / 25.0)  # positive: after the sound
    assert result.z > 3.0 and result.note == ""


def test_a_motion_shifted_out_of_reach_scores_no_better_than_chance(turning, speaking, curve):
    loudness = curve(1500, seed=0)
    result = sync(turning({ELBOW: 4.0 * np.roll(loudness, 700)}), speaking(5.0 * loudness))
    assert result.r < 0.4
    assert abs(result.z) < 2.5


def test_the_figures_are_those_of_the_definition_written_out(turning, speaking, curve):
    fps, n = 25.0, 120
    motion = turning({ELBOW: 4.0 * curve(n, 0), SHOULDER: 2.0 * curve(n, 1)}, fps)
    wave = speaking(5.0 * curve(n, 0) + curve(n, 3), fps)
    x = gaussian_filter1d(arm_speed(motion), 0.1 * fps, mode="nearest")
    y = gaussian_filter1d(speech_envelope(wave, fps, n), 0.1 * fps, mode="nearest")

    def best(y):
        rs = []
        for lag in range(-7, 8):
            k = np.arange(max(0, -lag), n - max(0, lag))
            rs.append(np.corrcoef(x[k + lag], y[k])[0, 1])
        return max(rs), (int(np.argmax(rs)) - 7) / fps

    chance = [best(np.roll(y, shift))[0] for shift in range(26, n - 25)]
    result = sync(motion, wave)
    assert (result.r, result.lag) == pytest.approx(best(y), abs=1e-9)
    assert result.chance_mean == pytest.approx(np.mean(chance), abs=1e-9)
    assert result.chance_sd == pytest.approx(np.std(chance), abs=1e-9)
    assert result.z == pytest.approx((result.r - np.mean(chance)) / np.std(chance), abs=1e-6)


def test_standing_still_and_silence_score_zero_and_say_why(turning, speaking, curve):
    loudness = curve(200, seed=0)
    moving, wave = turning({ELBOW: 4.0 * loudness}), speaking(5.0 * loudness)
    still = turning({ELBOW: np.zeros(200)})
    silence = Wave(np.zeros_like(wave.samples), wave.sample_rate)
    for result, reason in (
        (sync(still, wave), "arms"),
        (sync(moving, silence), "silence"),
    ):
        assert (result.r, result.lag, result.chance_mean, result.z) == (0.0, 0.0, 0.0, 0.0)
        assert reason in result.note and reason in str(result)


def test_a_clip_too_short_for_chance_says_so_and_a_shorter_one_is_refused(turning, speaking, curve):
    loudness = curve(200, seed=0)
    wave = speaking(5.0 * loudness)
    result = sync(turning({ELBOW: 4.0 * loudness[:40]}), wave)
    assert math.isfinite(result.r) and "1.6 s" in result.note
    assert result.chance_mean == result.chance_sd == result.z == 0.0
    with pytest.raises(MotionError, match="8 frames at 25 fps"):
        sync(turning({ELBOW: 4.0 * loudness[:8]}), wave)


def test_the_envelope_is_the_rms_around_each_frame():
    rate, fps = 16000, 25.0
    time = np.arange(2 * rate) / rate
    loud = np.where(time < 1.0, 0.01, 0.1)
    wave = Wave((loud * np.sqrt(2) * np.sin(2 * np.pi * 400 * time)).astype(np.float32), rate)
    envelope = speech_envelope(wave, fps, 60)
    assert envelope[[5, 20]] == pytest.approx(np.log(0.01 + 1e-4), abs=1e-3)
    assert envelope[[30, 45]] == pytest.approx(np.log(0.1 + 1e-4), abs=1e-3)
    assert envelope[25] == pytest.approx(np.log(np.sqrt((0.01**2 + 0.1**2) / 2) + 1e-4), abs=1e-2)
    assert envelope[55] == pytest.approx(np.log(1e-4))


@pytest.fixture
def pulsing(turning):
    """pulsing(fps, depth=0.5, first=0.5): a body that glides at 1 + depth·cos m/s, slowest at
    `first` seconds and every second after it, for ten seconds."""

    def make(fps: float = 60.0, depth: float = 0.5, first: float = 0.5) -> Motion:
        still = turning({"LeftArm": np.zeros(round(10 * fps))}, fps)
        t = still.times - first + 0.5
        x = t + depth * np.sin(2 * np.pi * t) / (2 * np.pi)
        return Motion(still.skeleton, still.rotations, np.outer(x, [1.0, 0.0, 0.0]), fps)

    return make


def test_beat_alignment_by_hand(pulsing):
    # Slowest at 0.5, 1.5, 2.5 ... s. With σ = 0.05 s the beats of the sound at 0.5, 1.55 and
    # 2.4 s are 0, σ and 2σ away: (1 + e^-0.5 + e^-2) / 3 = (1 + 0.60653 + 0.13534) / 3.
    found = beat_alignment(pulsing(), np.array([0.5, 1.55, 2.4]))
    assert found.score == pytest.approx(0.58062, abs=2e-4)
    assert (found.motion_beats, found.sound_beats) == (10, 3)


def test_the_published_variant_places_beats_at_the_first_frame_of_the_slowest_step(pulsing):
    # Slowest at 30.5 frames of 1/60 s: the step from frame 30 to 31, for the published code 30.
    motion = pulsing(first=30.5 / 60)
    assert motion_beats(motion, variant="bailando")[:2] == pytest.approx([30 / 60, 90 / 60])
    assert motion_beats(motion)[:2] == pytest.approx([30.5 / 60, 90.5 / 60], abs=1e-4)
    with pytest.raises(EvaluationError, match="'frames'.*bailando"):
        motion_beats(motion, variant="frames")


@pytest.mark.parametrize("fps", [25.0, 30.0, 60.0])
def test_the_published_variant_counts_frames_at_every_rate(gliding, fps):
    """σ of 5 frames over the speed and of 3 over the distances, strict minima, as Bailando's code;
    beats of the sound at the last frame or later do not count."""
    speeds = 1 + gaussian_filter(np.random.default_rng(4).standard_normal(300), 3)
    motion = gliding(speeds.tolist(), fps)
    curve = gaussian_filter(np.linalg.norm(np.diff(motion.translation, axis=0), axis=-1), 5)
    (low,) = argrelextrema(curve, np.less)
    pulse = np.array([3, 17, 40, 111, 170, 240, len(curve) - 1, len(curve), len(curve) + 1])
    met = [np.exp(-np.min((low - beat) ** 2) / 2 / 9) for beat in pulse if beat < len(curve)]
    found = beat_alignment(motion, pulse / fps, variant="bailando", joints=["Hips"])
    assert found.score == pytest.approx(np.mean(met), abs=1e-9) and 0.1 < found.score < 0.9
    assert (found.motion_beats, found.sound_beats) == (len(low), len(met))


def test_beat_consistency_by_hand(pulsing):
    # Every joint is slowest at 0.5, 1.5 ... s, at 0.5 m/s of its mean 1: above a tenth of it.
    # σ = 0.3 s: onsets at 0.5 and 1.8 s are 0 and σ away: (1 + e^-0.5) / 2 = 0.80327.
    found = beat_consistency(pulsing(), np.array([0.5, 1.8]))
    assert found.score == pytest.approx(0.80327, abs=2e-3)
    # Standing still at its slowest it is at rest there, which is not a beat.
    assert "beats" in beat_consistency(pulsing(depth=1.0), np.array([0.5])).note
    # Against a mean speed of 6 m/s, 0.5 m/s is rest too.
    many = np.full(12, 6.0)
    names = pulsing().skeleton.names[:12]
    found = beat_consistency(pulsing(), np.array([0.5]), mean_speed=many, joints=names)
    assert found.score == 0.0


@pytest.mark.parametrize("measure", [beat_alignment, beat_consistency])
def test_a_frozen_body_and_silence_score_zero_and_say_why(turning, pulsing, measure):
    frozen = turning({"LeftArm": np.zeros(300)}, 30.0)
    found = measure(frozen, np.arange(1.0, 9.0))
    assert (found.score, found.z) == (0.0, 0.0) and "motion" in found.note
    found = measure(pulsing(), np.zeros(0))
    assert (found.score, found.z) == (0.0, 0.0) and "sound" in found.note
    short = pulsing()[:90]
    assert "chance" in measure(short, np.array([0.5])).note


def clicks(times: np.ndarray, seconds: float, rate: int = 16000) -> Wave:
    samples = np.zeros(round(seconds * rate), dtype=np.float32)
    burst = np.random.default_rng(0).normal(0, 0.3, 800).astype(np.float32)
    for time in times:
        at = round(time * rate)
        samples[at : at + len(burst)] = burst[: len(samples) - at]
    return Wave(samples, rate)


def test_onsets_and_pulse_are_where_the_sound_has_them():
    times = np.arange(0.5, 9.5, 0.5)
    onsets = speech_onsets(clicks(times, 10.0))
    away = np.abs(onsets[:, None] - times)
    assert away.min(axis=0).max() < 0.04 and away.min(axis=1).max() < 0.08
    pulse = music_beats(clicks(times, 10.0))
    assert np.median(np.diff(pulse)) == pytest.approx(0.5, abs=0.03)
    silence = Wave(np.zeros(16000, dtype=np.float32), 16000)
    assert len(speech_onsets(silence)) == len(music_beats(silence)) == 0


@pytest.fixture
def gliding(skeleton):
    """gliding(speeds, fps): a body whose central differences have these speeds, m/s."""

    def make(speeds: list[float], fps: float = 30.0) -> Motion:
        x = [0.0, speeds[0] / fps]
        for k in range(1, len(speeds) - 1):
            x.append(x[k - 1] + 2 * speeds[k] / fps)
        still = np.tile([0.0, 0.0, 0.0, 1.0], (len(x), skeleton.n_joints, 1))
        return Motion(skeleton, still, np.outer(x, [1.0, 0.0, 0.0]), fps)

    return make


def around(lowest: list[float], n: int = 20) -> list[float]:
    """Speeds that fall, in steps of 1 cm/s, to some values and rise again."""
    down = [1.0 - 0.01 * k for k in range(n)]
    return [*down, *lowest, *down[::-1]]


@pytest.mark.parametrize(
    ("lowest", "beats"),
    [
        ([0.6, 0.5, 0.6], [21]),
        # A parabola through 0.7, 0.5 and 0.6: (0.7 - 0.6) / 2 of 0.3 later.
        ([0.7, 0.5, 0.6], [21 + 1 / 6]),
        ([0.6, 0.5, 0.5, 0.6], [21.5]),
        ([0.6, 0.5, 0.5, 0.5, 0.6], []),  # a rest
        # Of two within 7 frames the lower one, or both if they are farther apart.
        ([0.5, 0.6, 0.6, 0.6, 0.6, 0.6, 0.6, 0.4, 0.6], [27]),
        ([0.5, *[0.6] * 8, 0.4, 0.6], [20, 29]),
        ([0.07, 0.2, 0.2], []),  # below a tenth of the mean speed
        ([0.13, 0.2, 0.2], [20]),
    ],
)
def test_beats_of_a_joint_are_its_lowest_speeds(gliding, lowest, beats):
    curve = around(lowest)
    found = joint_beats(gliding(curve), joints=["Hips"], mean_speed=np.array([1.0]))[0]
    exact = [at for at in beats if at % 1]
    assert found[: len(beats)] * 30 == pytest.approx(beats, abs=1e-6 if exact else 0.5)
    assert len(found) == len(beats)


def test_scores_and_chance_equal_their_definition_written_out():
    """Two joints, and beats of a sound of which some lie outside the motion."""
    rng = np.random.default_rng(3)
    for duration in (2.25, 3.05, 7.3):
        joints = [np.sort(rng.uniform(0, duration, n)) for n in (5, 3)]
        pulse = np.array([-0.1, 0.0, 0.6, 1.31, 2.2, duration, duration + 1])
        inside = [b for b in pulse if 0 <= b < duration]

        def score(beats, joints=joints):
            each = [
                np.mean([math.exp(-min((b - times) ** 2) / (2 * 0.3**2)) for b in beats])
                for times in joints
            ]
            return np.mean(each)

        shifts = [1.1 + 0.1 * k for k in range(100) if 1.1 + 0.1 * k < duration - 1 - 1e-9]
        chance = [score([(b + shift) % duration for b in inside]) for shift in shifts]
        found = consistency(joints, pulse, duration)
        assert found.score == pytest.approx(score(inside))
        assert found.chance_mean == pytest.approx(np.mean(chance))
        assert found.chance_sd == pytest.approx(np.std(chance), abs=1e-12)
        if len(shifts) > 1:
            z = (score(inside) - np.mean(chance)) / np.std(chance)
            assert found.z == pytest.approx(z)
        assert (found.motion_beats, found.sound_beats, found.note) == (4.0, len(inside), "")


def test_sync_needs_three_frames_beyond_the_lag_and_shifts_of_more_than_a_second(
    turning, speaking, curve
):
    loudness = curve(300, seed=0)
    wave = speaking(5.0 * loudness)

    def found(n: int, **more):
        return sync(turning({ELBOW: 4.0 * loudness[:n]}), wave, **more)

    with pytest.raises(MotionError, match="7 frames at 25 fps"):
        found(7, max_lag=0.2)
    # Of 52 frames one shift, 26, is more than 25 either way; of 53 two are.
    assert "2.0 s" in found(51).note and found(52).note == ""
    assert found(52).chance_sd == 0 < found(53).chance_sd
    # Sound that ends before the motion: its frames alone count.
    whole, cut = found(200), sync(turning({ELBOW: 4.0 * loudness}), wave.slice(0, 8.0))
    assert cut.r == pytest.approx(whole.r, abs=0.02) and cut.lag == whole.lag
    assert abs(found(200, max_lag=0.0).lag) == 0
