"""Faces made from speech by rules: mouth, blinks and gaze."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import butter, sosfilt
from sounds import voiced

import audio_features as af
from gesturekit.errors import MotionError
from gesturekit.face import METHODS, EnergyFace, face_from_speech
from gesturekit.face.phones import SHAPES, mouth_of_phones
from gesturekit.motion.face import ARKIT, FaceTrack
from gesturekit.systems import bundled_speech

RATE = 16_000
FPS = 30.0


def wave(*parts: np.ndarray, level: float = 0.1) -> af.Wave:
    return af.Wave((level * np.concatenate(parts)).astype(np.float32), RATE)


def noise(seconds: float, level: float = 1.0, seed: int = 0) -> np.ndarray:
    return level * np.random.default_rng(seed).standard_normal(round(seconds * RATE))


def face_of(sound: af.Wave, method: str = "energy", **options) -> FaceTrack:
    if method == "phones":
        pytest.importorskip("pocketsphinx", reason="pip install 'gesturekit[face]'")
    return face_from_speech(sound, FPS, sound.n_frames(FPS), method, **options)


def opening(face: FaceTrack) -> np.ndarray:
    return face.channel("jawOpen") - face.channel("mouthClose")


@pytest.mark.parametrize("method", METHODS)
def test_a_voice_moves_the_mouth_whatever_its_level_and_silence_closes_it(method):
    parts = voiced(3.0), np.zeros(2 * RATE), voiced(2.0)
    face = face_of(wave(*parts), method)
    assert face.origin == "rules" and set(face.names) <= set(ARKIT) and len(face) == 210
    speech, silence = opening(face)[:85], opening(face)[100:145]
    assert speech.max() > 0.3 and speech.std() > 0.05 and speech.min() < 0.1
    assert silence.max() < 0.01
    quiet = face_of(wave(*parts, level=0.01), method)
    np.testing.assert_allclose(quiet.values, face.values, atol=0.02)


@pytest.mark.parametrize("method", METHODS)
def test_noise_does_not_open_the_mouth_in_pauses(method):
    parts = np.concatenate([voiced(3.0), np.zeros(2 * RATE), voiced(2.0)])
    face = face_of(wave(parts + noise(7.0, 0.1)), method)
    assert opening(face)[:85].max() > 0.2
    assert opening(face)[100:145].max() < 0.05
    assert opening(face_of(wave(noise(4.0)), method)).max() < 0.05


def test_loud_noise_and_claps_hardly_open_the_mouth():
    parts = np.concatenate([voiced(3.0), np.zeros(2 * RATE), voiced(2.0)])
    for level in (0.7, 1.0):
        assert opening(face_of(wave(parts + noise(7.0, level))))[100:145].max() < 0.2
    clap = np.concatenate([noise(0.05), np.zeros(round(0.95 * RATE))])
    assert opening(face_of(wave(np.tile(clap, 8)))).max() < 0.05


def test_sound_of_low_frequency_alone_rounds_the_lips():
    low = butter(4, 350.0, fs=RATE, output="sos")
    dark, bright = (face_of(wave(part)) for part in (sosfilt(low, voiced(3.0)), voiced(3.0)))
    assert dark.channel("mouthPucker").max() > 0.2 > 2 * bright.channel("mouthPucker").mean()
    assert dark.channel("jawOpen").mean() < 0.5 * bright.channel("jawOpen").mean()
    funnel, pucker = (dark.channel(name).max() for name in ("mouthFunnel", "mouthPucker"))
    assert 0.05 < funnel < 0.75 * pucker


def test_hissing_shows_the_teeth():
    high = butter(4, 4000.0, "highpass", fs=RATE, output="sos")
    voice, hiss = voiced(3.0), 0.7 * sosfilt(high, noise(3.0))
    vowels, hissed = (face_of(wave(part)) for part in (voice, voice + hiss))
    teeth = [face.channel("mouthStretchLeft").mean() for face in (vowels, hissed)]
    assert teeth[0] < 0.01 and 0.02 < teeth[1] < 0.2


@pytest.mark.parametrize("method", METHODS)
def test_the_mouth_opens_and_closes_with_the_sound(method):
    burst = voiced(1.0)
    sound = wave(np.tile([*np.zeros(RATE), *burst], 3))
    face = face_from_speech(sound, 100.0, 600, method)
    said = np.tile([*np.zeros(100), *burst.reshape(100, -1).any(axis=1)], 3)
    r = [np.corrcoef(np.roll(said, lag), opening(face))[0, 1] for lag in range(-20, 21)]
    assert abs(np.argmax(r) - 20) <= 5


def test_long_sounds_are_analysed_in_pieces_without_seams():
    jaw = opening(face_of(wave(np.tile(voiced(10.0), 7))))
    np.testing.assert_allclose(jaw[1830:2040], jaw[1530:1740], atol=1e-3)
    sound = wave(voiced(8.0), np.zeros(2 * RATE), voiced(12.0))
    spoken = opening(face_of(sound, "phones")) > 0.05
    assert spoken[:240].mean() > 0.1 and not spoken[250:295].any() and spoken[600:].mean() > 0.1


def test_words_late_in_a_long_sound_move_the_lips_as_they_do_alone():
    """Sound over 20 s is cut where it is quiet; here at two of three repetitions."""
    words = af.Wave.load(bundled_speech(), start=1.0, duration=3.0).resample(RATE).samples
    pause = np.zeros(8 * RATE, np.float32)
    alone = opening(face_of(af.Wave(words, RATE), "phones"))
    many = np.concatenate([pause[:RATE], words, pause, words, pause, words, pause])
    jaw = opening(face_of(af.Wave(many, RATE), "phones"))
    for first in (30, 360, 690):
        assert np.corrcoef(jaw[first : first + 90], alone)[0, 1] > 0.9
    assert max(jaw[150:345].max(), jaw[480:675].max()) < 0.01


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("seconds", [0.025, 0.3])
def test_short_sounds_and_other_lengths_of_motion_work(method, seconds):
    sound = wave(voiced(1.0)[: round(seconds * RATE)])
    assert len(face_of(sound, method)) == sound.n_frames(FPS)
    assert len(face_from_speech(sound, 25.0, 100, method)) == 100


def test_the_same_seed_and_name_look_and_blink_alike_and_others_do_not():
    sound = wave(voiced(8.0))
    first = face_of(sound, seed=1, item="a")
    assert np.array_equal(face_of(sound, seed=1, item="a").values, first.values)
    for other in (face_of(sound, seed=2, item="a"), face_of(sound, seed=1, item="b")):
        assert not np.array_equal(other.channel("eyeBlinkLeft"), first.channel("eyeBlinkLeft"))
        assert not np.array_equal(other.channel("eyeLookUpLeft"), first.channel("eyeLookUpLeft"))
        assert np.array_equal(opening(other), opening(first))


def test_people_blink_10_to_25_times_a_minute_and_close_lids_faster_than_they_open_them():
    for sound in (wave(np.tile(voiced(20.0), 9)), wave(noise(180.0, 1e-6))):
        lids = face_from_speech(sound, 100.0, 18_000).channel("eyeBlinkLeft")
        closed = (lids > 0.5).astype(int)
        times = np.flatnonzero(np.diff(closed) == 1) / 100.0
        counts = np.bincount((times // 60).astype(int), minlength=3)
        assert (counts >= 10).all() and (counts <= 25).all(), counts
        assert lids.max() > 0.95
        assert 12 < closed.sum() / len(times) < 18  # hundredths of a second
        rising, falling = ((np.diff(lids) * way > 0).sum() for way in (1, -1))
        assert 1.5 * rising < falling
        gaps = np.diff(times)
        assert gaps.std() / gaps.mean() > 0.3


def test_blinks_gather_at_the_beginning_of_pauses():
    phrase = np.concatenate([voiced(3.8), np.zeros(round(1.2 * RATE))])
    lids = face_of(wave(np.tile(phrase, 40))).channel("eyeBlinkLeft")
    phases = np.flatnonzero(np.diff((lids > 0.5).astype(int)) == 1) / FPS % 5.0
    assert ((phases > 3.5) & (phases < 4.3)).mean() > 2 * 0.8 / 5.0


def test_gaze_jumps_both_eyes_together_by_small_angles():
    face = face_of(wave(voiced(60.0)))
    look = face.channel("eyeLookInLeft") - face.channel("eyeLookOutLeft")  # to the right
    assert np.array_equal(face.channel("eyeLookOutRight") - face.channel("eyeLookInRight"), look)
    assert 0.02 < look.std() < 0.2 and abs(look).max() < 0.3
    up, down = face.channel("eyeLookUpLeft"), face.channel("eyeLookDownRight")
    assert min(up.max(), down.max()) > 0.02 and not ((up > 0) & (down > 0)).any()
    still = abs(np.diff(look)) < 1e-9
    assert 0.85 < still.mean() < 0.99
    assert abs(np.corrcoef(look, up - down)[0, 1]) < 0.5


def test_a_jump_of_the_gaze_takes_25_to_60_ms():
    face = face_from_speech(wave(voiced(60.0)), 100.0, 6000)
    look = face.channel("eyeLookInLeft") - face.channel("eyeLookOutLeft")
    moves = np.diff(np.pad((abs(np.diff(look)) > 1e-6).astype(int), 1))
    lengths = np.flatnonzero(moves == -1) - np.flatnonzero(moves == 1)
    assert len(lengths) > 20 and lengths.min() >= 2 and lengths.max() <= 6


def test_a_stream_gives_the_same_frames_for_blocks_of_any_size_within_its_delay():
    sound = voiced(9.0) * 0.1 + noise(9.0, 0.001)
    rng, whole = np.random.default_rng(0), EnergyFace(48_000, FPS, seed=3)
    expected, stream, done, made = whole.step(sound), EnergyFace(48_000, FPS, seed=3), 0, []
    while done < len(sound):
        made.append(stream.step(sound[done : done + (n := int(rng.integers(1, 5000)))]))
        done = min(done + n, len(sound))
        assert sum(map(len, made)) >= (done / 48_000 - stream.delay) * FPS
    np.testing.assert_array_equal(np.concatenate(made), expected)
    assert stream.delay < 0.25 and expected.shape[1] == len(stream.names)
    with pytest.raises(MotionError, match="finite"):
        stream.step(np.full(100, np.nan))


def test_a_stream_of_speech_resembles_the_face_of_its_file():
    sound = wave(voiced(12.0), noise(2.0, 1e-4), voiced(6.0))
    stream = EnergyFace(RATE, FPS, seed=5, item="a").step(sound.samples)
    face = face_of(sound, seed=5, item="a")
    jaw, lids = (face.names.index(name) for name in ("jawOpen", "eyeBlinkLeft"))
    n = len(stream)
    assert n > 580 and np.corrcoef(stream[:, jaw], face.values[:n, jaw])[0, 1] > 0.9
    assert np.corrcoef(stream[:, lids], face.values[:n, lids])[0, 1] > 0.9


def shapes_of(phones: str, fps: float = 25.0) -> FaceTrack:
    """Return the mouth of phones that last 0.1 s each, in loud sound."""
    names = phones.split()
    spoken = [(name, 0.1 * k, 0.1 * (k + 1)) for k, name in enumerate(names)]
    values = mouth_of_phones(spoken, np.ones(10 * len(names)), hold=1.2 / fps)
    return FaceTrack(SHAPES, values)


@pytest.mark.parametrize("phone", ["P", "B", "M"])
def test_lips_close_at_bilabial_phones_even_between_open_vowels(phone):
    face = shapes_of(f"AA AA {phone} AA AA D AA AA")
    assert opening(face)[22:28].max() < 0.02
    assert opening(face)[[10, 38, 70]].min() > 0.3
    assert opening(face)[50:60].min() > 0.1


def test_the_lower_lip_meets_the_teeth_at_f_and_lips_are_round_at_w():
    face = shapes_of("AA F AA W UW T UW AA S AA")
    names = ("jawOpen", "mouthPucker", "mouthRollLower", "mouthStretch")
    jaw, pucker, roll, stretch = (face.channel(name)[5::10] for name in names)
    assert roll[1] > 0.4 and roll[[0, 2, 4, 6]].max() < 0.05
    assert pucker[[3, 4, 5, 6]].min() > 0.3 and pucker[[0, 8, 9]].max() < 0.1  # t: lips stay round
    assert jaw[8] < 0.75 * jaw[7] and 0.05 < stretch[8] < 0.25
    steady = shapes_of("Y Y Y Y Y").channel("mouthStretch")
    assert abs(steady[20:30] - 0.2).max() < 0.01


def test_a_closure_is_seen_however_short_and_however_slow_the_frames():
    for start in np.arange(0.5, 0.6, 0.01):
        phones = [("AA", 0.0, start), ("P", start, start + 0.02), ("AA", 0.6, 1.2)]
        mouth = FaceTrack(SHAPES, mouth_of_phones(phones, np.ones(120), hold=1.2 / 10.0))
        assert opening(mouth)[::10].min() < 0.02


def test_lips_close_within_50_ms_and_press_while_they_are_closed():
    """The smoothstep 3 x² - 2 x³ is 0.104 at 1/5 of the 0.05 s before and after."""
    mouth = mouth_of_phones([("P", 0.5, 0.62)], np.ones(120), hold=0.04)
    press = mouth[[44, 46, 50, 61, 65, 67], SHAPES.index("mouthPress")]
    np.testing.assert_allclose(press, 0.3 * np.array([0, 0.104, 1, 1, 0.104, 0]), atol=1e-6)


def test_lips_move_from_150_ms_before_sound_until_150_ms_after_it():
    """A click at 1.0 s: half of a round mouth's pucker is seen at 0.845 and 1.155 s."""
    click = (np.arange(200) == 100).astype(float)
    mouth = mouth_of_phones([("UW", 0.0, 2.0)], click, hold=0.04)
    pucker = mouth[:, SHAPES.index("mouthPucker")]
    assert (pucker > 0.5 * pucker[100]).nonzero()[0][[0, -1]].tolist() == [85, 115]
    assert pucker[100] > 0.5 and max(pucker[60], pucker[140]) < 1e-3


def test_phones_move_the_mouth_as_far_as_the_sound_is_loud():
    phones = [("AA", 0.0, 1.0), ("UW", 1.0, 2.0)]
    loud, soft, none = (mouth_of_phones(phones, np.full(200, x), 0.04) for x in (1.0, 0.5, 0.0))
    np.testing.assert_allclose(soft[:, 0], 0.5 * loud[:, 0])
    assert loud.max() > 0.5 and not none.any()


def test_without_pocketsphinx_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pocketsphinx", None)
    with pytest.raises(MotionError, match=r"pip install 'gesturekit\[face\]'"):
        face_from_speech(wave(voiced(1.0)), FPS, 30, "phones")
    with pytest.raises(MotionError, match="energy or phones"):
        face_from_speech(wave(voiced(1.0)), FPS, 30, "emotion")


@pytest.mark.parametrize(
    ("transcript", "says"),
    [
        ("你好 42 !", "no English words"),
        ("blorptastic", "letter by letter: blorptastic"),
        ("hello " * 500, "2500 letters"),
    ],
)
def test_a_transcript_that_does_not_help_is_warned_about(transcript, says, caplog):
    sound = wave(voiced(2.0))
    assert len(face_of(sound, "phones", transcript=transcript)) == 60
    assert says in caplog.text


def test_a_transcript_is_taken_where_it_covers_the_speech(caplog):
    own = bundled_speech().with_suffix(".txt").read_text("utf-8")
    sound = af.Wave.load(bundled_speech())
    free = opening(face_of(sound, "phones"))
    for text, is_own in ((own, True), ("We meet them once.", False)):
        caplog.clear()
        made = opening(face_of(sound, "phones", transcript=text))
        assert np.array_equal(made, free) is not is_own, "phones are found without it"
        assert ("leaves much of the speech without words" in caplog.text) is not is_own
        assert (sound.source in caplog.text) is not is_own


@pytest.fixture(scope="module")
def benchmark():
    for module in ("pocketsphinx", "espeakng_loader"):
        pytest.importorskip(module, reason=f"{module} is not installed")
    folder = Path(__file__).resolve().parents[2] / "benchmarks"
    if not folder.is_dir():
        pytest.skip("the benchmarks are not part of the source distribution")
    sys.path.insert(0, str(folder))
    import face_rules

    yield face_rules
    sys.path.remove(str(folder))
    del sys.modules["face_rules"], sys.modules["harness"]


def test_lips_close_where_a_voice_says_p_b_and_m(benchmark):
    closed = benchmark.lips("en-us", "phones", True, None)
    assert closed["p, b, m"][0] > 0.8 and closed["vowels"][0] < 0.25 and closed["pauses"][0] == 1.0


@pytest.mark.stress
def test_an_hour_of_sound_takes_little_memory():
    import tracemalloc

    sound = wave(np.tile(voiced(60.0), 60))
    tracemalloc.start()
    face_of(sound)
    assert tracemalloc.get_traced_memory()[1] < 1.5e9
