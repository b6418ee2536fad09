"""Shift between sound and motion: estimated as it was added, and silent where nothing says it."""

import re

import numpy as np
import pytest
import soundfile
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

import audio_features as af
from gesturekit.corpus import Manifest, prepare
from gesturekit.corpus.alignment import LEAD, Correlation, corrections, correlate, pooled
from gesturekit.errors import CorpusError
from gesturekit.motion import Motion

FPS, RATE = 30, 8000
REAL = "takes/zeggs_neutral/one_rig/001_Neutral_0_x_1_0"


def level(seconds: float, rate: float, seed: int, later: float = 0.0) -> np.ndarray:
    """Return the loudness of a speaker over time, with pauses; `later` by some seconds."""
    rng = np.random.default_rng(seed)
    beats = gaussian_filter1d(rng.standard_normal(round((seconds + 20) * 100)), 15)
    times = np.arange(round(seconds * rate)) / rate - later
    return np.interp(times, np.arange(len(beats)) / 100 - 10, beats / beats.std())


def voice(seconds: float, seed: int = 0) -> af.Wave:
    noise = np.random.default_rng(0).standard_normal(round(seconds * RATE))
    return af.Wave(0.02 * np.exp(level(seconds, RATE, seed)) * noise, RATE)


@pytest.fixture(scope="module")
def talk(skeleton):
    """talk(seconds, shift, seed): arms that turn as fast as the voice is loud, and by chance."""

    def make(seconds: float, shift: float = 0.0, seed: int = 0) -> Motion:
        own = level(seconds, FPS, seed + 1000)
        speed = np.exp(level(seconds, FPS, seed, shift - LEAD) + own)
        rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(speed), skeleton.n_joints, 1))
        turn = 1.0 + 0.5 * np.sin(np.cumsum(speed) / FPS)  # away from the rest pose
        angles = turn[:, None] * [0.0, 0.6, 0.8]
        for arm in ("LeftArm", "RightArm"):
            rotations[:, skeleton.index(arm)] = Rotation.from_rotvec(angles).as_quat()
        return Motion(skeleton, rotations, np.tile([0.0, 0.9, 0.0], (len(speed), 1)), FPS)

    return make


@pytest.fixture
def write(tmp_path, talk):
    """write("a", seconds, shift, seed): a pair in the folder of recordings, which is returned."""

    def pair(stem: str, seconds: float, shift: float = 0.0, seed: int = 0, motion: int = 0):
        folder = tmp_path / "recordings"
        folder.mkdir(exist_ok=True)
        soundfile.write(folder / f"{stem}.wav", voice(seconds, seed).samples, RATE)
        talk(seconds, shift, seed + motion).save(folder / f"{stem}.npz")
        return folder

    return pair


@pytest.mark.parametrize("shift", [-3.0, 0.0, 0.3])
def test_an_added_shift_is_found(talk, shift):
    found = correlate(talk(60, shift), voice(60))
    assert found.is_clear and found.is_notable == (shift != 0)
    assert found.shift == pytest.approx(shift, abs=0.06)


@pytest.mark.parametrize("shift", [-1.0, 0.3])
def test_an_added_shift_of_a_real_recording_is_found(shared_data, shift):
    motion = Motion.load(shared_data / f"{REAL}.bvh")
    wave = af.Wave.load(shared_data / f"{REAL}.wav")
    frames, late = motion.n_frames - round(abs(shift) * FPS), max(shift, 0.0)
    first = round(max(-shift, 0.0) * FPS)
    found = correlate(motion[first : first + frames], wave.slice(late, frames / FPS))
    assert found.is_clear and found.is_notable
    assert found.shift == pytest.approx(shift, abs=0.06)


def test_sound_of_another_recording_says_nothing(talk):
    each = [correlate(talk(60, 0, seed), voice(60, seed + 50)) for seed in range(3)]
    assert not any(one.is_clear for one in [*each, pooled(each)])


def test_nothing_is_made_of_too_little(talk, skeleton, quadruped):
    wave = voice(20)
    still = Motion(
        skeleton, np.tile([0.0, 0, 0, 1], (600, skeleton.n_joints, 1)), np.zeros((600, 3)), 30
    )
    rig = Motion(
        quadruped, np.tile([0.0, 0, 0, 1], (600, quadruped.n_joints, 1)), np.zeros((600, 3)), 30
    )
    tone = af.Wave(np.sin(np.arange(160_000) * 0.5), RATE)
    for motion, sound in ((still, wave), (rig, wave), (talk(20), tone), (talk(3), wave)):
        assert correlate(motion, sound) is None


@pytest.mark.parametrize("shift", [-1.2, 0.0])
def test_prepare_warns_and_the_option_that_it_names_corrects_it(write, shift):
    """Files of equal length, which begin together by their frames."""
    folder = write("a", 60, shift)
    report = prepare(folder)
    lines = [text for text in report.problem_lines() if "--shift" in text]
    assert len(lines) == (shift != 0)
    assert dict(report.rows())["shift"].startswith("in time") == (shift == 0)
    if not shift:
        return
    named = float(re.search(r"--shift (-?[\d.]+)", lines[0])[1])
    assert named == pytest.approx(shift, abs=0.06) and "a.npz" in lines[0]
    (line,) = [text for text in prepare(folder, shift=0.5).problem_lines() if "--shift" in text]
    assert float(re.search(r"--shift (-?[\d.]+)", line)[1]) == pytest.approx(shift, abs=0.06)
    for option in (named, "auto"):
        report = prepare(folder, shift=option)
        item = report.manifest.items[0]
        assert item.audio_start == pytest.approx(max(-named, 0), abs=0.04)
        assert item.motion_start == pytest.approx(max(named, 0), abs=0.04)
        assert item.motion_start - item.audio_start == pytest.approx(named, abs=1e-6)
        total = sum(one.duration for one in report.manifest)
        assert total == pytest.approx(60 - abs(named), abs=0.1)
        assert not [line for line in report.problem_lines() if "--shift" in line]
    assert any(re.search(rf"a.npz.*\b{abs(named):.2f} s", line) for line in report.problem_lines())


def test_short_recordings_say_it_together(write):
    for number in range(8):
        folder = write(f"clip{number}", 12, 0.8, seed=number)
    report = prepare(folder)
    (line,) = [text for text in report.problem_lines() if "--shift" in text]
    assert re.search(r"(?=.*\b8\b).*--shift 0\.(7[5-9]|8[0-5])", line)
    items = prepare(folder, shift="auto").manifest
    begins = [item.motion_start - item.audio_start for item in items]
    assert begins == pytest.approx([0.8] * 8, abs=0.06)


def test_a_recording_that_is_apart_from_the_others_is_named(write):
    write("good", 60, 0.0)
    write("more", 60, 0.0, seed=3)
    folder = write("late", 60, 2.0, seed=7)
    (line,) = [text for text in prepare(folder).problem_lines() if "--shift" in text]
    named = re.search(r"([\d.]+) s\b", line)
    assert "late.npz" in line and "--shift auto" in line
    assert float(named[1]) == pytest.approx(2.0, abs=0.06)
    items = {item.take: item for item in prepare(folder, shift="auto").manifest}
    begins = [item.motion_start - item.audio_start for _, item in sorted(items.items())]
    assert begins == pytest.approx([0.0, 2.0, 0.0], abs=0.06)


def test_a_pair_that_does_not_belong_together_is_not_shifted(write):
    folder = write("a", 60, motion=50)
    report = prepare(folder, shift="auto")
    assert not any("shift" in line for line in report.problem_lines())
    assert {(item.audio_start, item.motion_start) for item in report.manifest} >= {(0.0, 0.0)}


def test_a_shift_is_a_number_or_auto(write, gesturekit, tmp_path):
    folder = write("a", 5)
    for wrong in ("soon", float("nan"), None):
        with pytest.raises(CorpusError, match=f"(?=.*shift)(?=.*{wrong}).*auto"):
            prepare(folder, shift=wrong)
    command = ("prepare", folder, "--out", tmp_path / "corpus.jsonl", "--shift")
    gesturekit(*command, "soon").fails(2, "'soon'")
    gesturekit(*command, "-1.5").ok()
    item = Manifest.load(tmp_path / "corpus.jsonl").items[0]
    assert (item.audio_start, item.motion_start) == (1.5, 0.0)
    gesturekit(*command, "auto").ok()


def peak(lag: int, height: float, sd: float = 0.125, n_frames: int = 100) -> Correlation:
    """A correlation with a peak at so many 25ths of a second."""
    values = np.full(201, 0.01)
    values[100 + lag] = height
    return Correlation(values, sd, n_frames)


def test_a_recording_is_corrected_by_itself_or_by_all_together():
    clear, unclear, in_time = peak(25, 1.0), peak(-50, 0.3), peak(-4, 1.0)
    assert corrections([clear, unclear, None]) == pytest.approx([1 + LEAD] * 3)
    assert corrections([in_time, unclear]) == [0.0, 0.0]
    assert corrections([in_time, clear, clear]) == pytest.approx([0.0, 1 + LEAD, 1 + LEAD])
    assert corrections([unclear, None]) == [0.0, 0.0] and corrections([None]) == [0.0]
