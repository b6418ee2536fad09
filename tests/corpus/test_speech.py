"""What a model hears: the same for loud and quiet, low where nobody speaks."""

import numpy as np
import pytest

import audio_features as af
from gesturekit.corpus.speech import (
    SpeechConditioner,
    as_speech,
    detects_voice,
    extract,
    speech_features,
)
from gesturekit.errors import ModelError


def voice(seconds: float, *, level: float = 0.1, swing: float = 1.0, seed: int = 0) -> af.Wave:
    """Harmonics of a gliding pitch, in syllables; `swing` widens pitch and energy."""
    rng = np.random.default_rng(seed)
    rate = 16000
    time = np.arange(round(seconds * rate)) / rate
    pitch = 120 * 2 ** (0.3 * swing * np.sin(2 * np.pi * 0.6 * time))
    phase = 2 * np.pi * np.cumsum(pitch) / rate
    tone = sum(np.sin(k * phase) / k for k in range(1, 45))
    syllables = np.clip(np.sin(2 * np.pi * 3 * time + rng.uniform(0, 6)), 0, 1)
    loudness = np.exp(0.8 * swing * np.sin(2 * np.pi * 0.4 * time))
    noise = 1e-4 * rng.standard_normal(len(time))
    return af.Wave((level * (tone * syllables * loudness + noise)).astype(np.float32), rate, None)


def fitted(waves, extractor) -> SpeechConditioner:
    heard = (extract(wave, extractor, 25.0, "mean") for wave in waves)
    return SpeechConditioner.fit(heard, extractor, 25.0, "mean")


def under(normalisation: str, waves) -> SpeechConditioner:
    extractor = af.Stack([af.LogMel(n_mels=4)])
    heard = [extract(wave, extractor, 25.0, "mean", level=False) for wave in waves]
    return SpeechConditioner.fit(heard, extractor, 25.0, "mean", normalisation)


@pytest.fixture(scope="module")
def conditioner() -> SpeechConditioner:
    extractor = af.Stack([af.LogMel(n_mels=24), af.Prosody()])
    return fitted([voice(4.0, seed=s) for s in range(3)], extractor)


def test_twenty_decibels_quieter_sounds_the_same(conditioner):
    loud, quiet = conditioner(voice(3.0)), conditioner(voice(3.0, level=0.01))
    assert loud.shape == (75, conditioner.dim)
    np.testing.assert_allclose(loud, quiet, atol=1e-3)


def test_livelier_speech_stays_livelier(conditioner):
    names = conditioner.extractor.names
    flat, lively = (conditioner(voice(6.0, swing=swing)) for swing in (0.1, 1.5))
    spoken = [clip[clip[:, names.index("energy")] > -2.0] for clip in (flat, lively)]
    for name in ("f0", "energy"):
        narrow, wide = (clip[:, names.index(name)].std() for clip in spoken)
        assert wide > 1.3 * narrow, name


def test_the_timbre_of_an_unseen_speaker_is_removed(conditioner):
    wave = voice(4.0)
    # A microphone that loses the high half of the band.
    dull = np.convolve(wave.samples, np.ones(6) / 6, mode="same").astype(np.float32)
    plain = conditioner(wave)
    other = conditioner(af.Wave(dull, wave.sample_rate, None))
    heard = (w.at_level() for w in (wave, af.Wave(dull, wave.sample_rate, None)))
    raw = [conditioner.extractor.extract(w).values[:, :24].mean(axis=0) for w in heard]
    spread = conditioner.scale[:24]
    assert np.abs(raw[0] - raw[1]).max() / spread.mean() > 1.0, "the microphone is heard"
    assert np.abs(plain[:, :24].mean(axis=0) - other[:, :24].mean(axis=0)).mean() < 0.6


def test_over_the_corpus_all_training_frames_together_have_mean_zero_and_variance_one():
    waves = [voice(3.0, swing=0.1), voice(2.0, swing=2.0, seed=1)]
    conditioner = under("corpus", waves)
    clips = [conditioner(wave) for wave in waves]
    together = np.concatenate(clips)
    np.testing.assert_allclose(together.mean(axis=0), 0, atol=1e-4)
    np.testing.assert_allclose(together.std(axis=0), 1, atol=1e-4)
    # No clip is brought to a mean of its own.
    assert (np.abs(clips[0].mean(axis=0) - clips[1].mean(axis=0)) > 0.1).all()


def test_without_normalisation_features_are_as_the_extractor_gives_them():
    wave = voice(2.0, level=0.02)
    conditioner = under("none", [wave])
    track = conditioner.extractor.extract(wave)
    expected = track.to_rate(25.0, n_frames=50, method="mean").values
    np.testing.assert_allclose(conditioner(wave), expected, atol=1e-5)


class Encoder:
    """Three columns."""

    dim = 3
    names = ("encoder_0", "encoder_1", "encoder_2")

    def __init__(self, centred=(True, True, True)) -> None:
        self.centred = centred


@pytest.mark.parametrize("fps", [25.0, 60.0])
def test_a_clip_is_centred_on_its_speech_and_a_second_of_the_training_mean(fps):
    extractor = Encoder((True, True, False))
    about = extractor, fps, "mean", np.array([2.0, 2.0, 2.0]), np.array([1.0, 2.0, 1.0])
    conditioner = SpeechConditioner(*about)
    active = np.repeat([True, False], round(fps))  # a second of speech, a second of pause
    values = np.where(active[:, None], 10.0, 0.0) * np.ones(3, np.float32)
    clip = conditioner.normalise(values, active)
    # (1 s · 10 + 1 s · 2) / 2 s = 6; the third column keeps the training mean 2.
    np.testing.assert_allclose(clip[active], np.tile([4.0, 2.0, 6.0], (len(clip) // 2, 1)))
    np.testing.assert_allclose(clip[~active], np.tile([-6.0, -3.0, -2.0], (len(clip) // 2, 1)))
    silence = conditioner.normalise(values, np.zeros_like(active))
    np.testing.assert_allclose(silence[0], [6.0, 4.0, 6.0])  # 8 is more than the limit of 6
    unlimited = SpeechConditioner(*about, "corpus").normalise(10 * values, active)
    np.testing.assert_allclose(unlimited[0], [98.0, 49.0, 98.0])


def test_centre_and_scale_are_those_of_active_speech():
    """A clip counts once in the centre, and its active frames count in the scale."""
    extractor = Encoder((True, True, False))
    short, long = [[0, 10, 1], [2, 10, 3], [99, 99, 99]], [[4, 20, 5], [10, 20, 7]] * 3
    values = [np.array(clip, np.float32) for clip in (short, long)]
    clips = [(clip, clip[:, 0] < 99) for clip in values]
    clips.append((np.full((4, 3), 50, np.float32), np.zeros(4, bool)))  # nobody speaks
    fitted = SpeechConditioner.fit(clips, extractor, 25.0, "mean")
    np.testing.assert_allclose(fitted.centre, [4, 15, 4])  # of the means 1 10 2 and 7 20 6
    # Variances 1 (2 frames) and 9 (6 frames) give 7. Where a clip keeps its own mean, that of the
    # means is added: 1 + 4. What never varies has the least scale.
    np.testing.assert_allclose(fitted.scale**2, [7, 0, 5], atol=1e-3)
    silent = SpeechConditioner.fit(clips[2:], extractor, 25.0, "mean")
    assert (silent.centre == 0).all() and (silent.scale == 1).all()


class Clock:
    """One column: the time of the frame."""

    names, dim, centred, worth_caching = ("seconds",), 1, (False,), False
    spec = {"kind": "clock"}

    def extract(self, wave: af.Wave) -> af.FeatureTrack:
        times = np.arange(wave.n_frames(100)) / 100
        return af.FeatureTrack(times[:, None], times, self.spec, self.names)


def test_components_span_the_columns_that_vary():
    axis, rng = np.array([2.0, -1.0, 2.0]) / 3, np.random.default_rng(0)
    plain = SpeechConditioner(Encoder(), 25.0, "mean", np.zeros(3), np.ones(3), "none")
    said = [level + 5.0 * rng.standard_normal((n, 1)) for level, n in ((40.0, 300), (42.0, 200))]
    noisy = (x * axis + 1e-3 * rng.standard_normal((len(x), 3)) for x in said)
    heard = [(values.astype(np.float32), x[:, 0] > 40) for values, x in zip(noisy, said)]
    one, two = plain.reduced(heard, 1), plain.reduced(heard, 2)
    assert (plain.dim, one.dim, two.dim) == (3, 1, 2)
    spread = np.concatenate(said).std()
    np.testing.assert_allclose(one.components[:, 0] * spread, axis, atol=1e-3)
    given = np.array([[3.0, 0, 0], [0, 1, 1]], np.float32)
    reduced = one.normalise(given, np.ones(2, bool))
    np.testing.assert_allclose(reduced[:, 0], np.array([2.0, 1 / 3]) / spread, rtol=1e-2)
    # One factor for all components: the mean variance is 1, and distances keep their proportions.
    first, second = np.concatenate([two.normalise(*clip) for clip in heard]).var(axis=0)
    assert first + second == pytest.approx(2.0, rel=1e-3) and second < 1e-4
    assert plain.reduced(heard, 3) is plain


def test_only_wide_extractors_are_reduced_and_effort_never():
    parts = [af.Effort(), af.LogMel(n_mels=12), af.Prosody()]
    heard = [voice(4.0, seed=s) for s in range(3)]
    plain = fitted(heard, af.Stack(parts))
    raw = [extract(wave, plain.extractor, 25.0, "mean") for wave in heard]
    assert plain.acoustic == tuple(range(19)) and plain.prosody == (15, 16, 17, 18)
    kept = [0, 1, 2, 15, 16, 17, 18]
    reduced = plain.reduced(raw, 8)
    before, after = plain(voice(3.0, seed=9)), reduced(voice(3.0, seed=9))
    assert after.shape == (75, reduced.dim) and reduced.dim == len(kept) + 8
    np.testing.assert_array_equal(after[:, : len(kept)], before[:, kept])
    assert reduced.effort == plain.effort == (0, 1, 2)
    assert reduced.acoustic == tuple(range(len(kept)))


@pytest.mark.parametrize(
    ("part", "vad", "expected"),
    [(af.LogMel(), None, True), (af.Music(), None, False), (af.Music(), True, True)],
)
def test_voice_is_looked_for_except_in_music(part, vad, expected):
    for extractor in (part, af.Stack([af.Prosody(), part])):
        assert detects_voice(extractor, vad) is expected
    assert detects_voice(part, False) is False


def test_silent_sound_and_sound_without_voice_are_warned_about(conditioner, caplog):
    rng = np.random.default_rng(0)
    hum = af.Wave((0.05 * rng.standard_normal(64_000)).astype(np.float32), 16_000, None)
    for wave, vad, says in (
        (af.Wave(np.zeros(32_000, np.float32), 16_000, None), None, "silent"),
        (hum, None, "--no-vad"),
        (hum, False, ""),
        (voice(2.0), None, ""),
    ):
        caplog.clear()
        assert len(conditioner(wave, vad=vad)) == wave.n_frames(25)
        assert (says in caplog.text) and bool(says) == bool(caplog.text)


def test_speech_or_seconds_are_asked_for_and_not_both(conditioner):
    wave = voice(1.0)
    for given, says in (
        ((None, wave, None), "--seconds"),
        ((conditioner, wave, 1.0), "seconds"),
        ((conditioner, None, None), "(?=.*speech).*seconds"),
        ((None, None, "2"), "seconds='2'"),
        ((None, None, np.nan), "seconds=nan"),
        ((conditioner, None, 0.0199), "(?=.*seconds=0.0199).*0.04 s"),
        ((None, None, 86_400.1), "(?=.*seconds=86400.1).*86400 s"),
    ):
        with pytest.raises(ModelError, match=says):
            speech_features(*given, fps=25.0)
    assert speech_features(None, None, 86_400, 25.0).shape == (2_160_000, 0)
    assert speech_features(None, None, 0.02, 25.0).shape == (1, 0), "half a frame is one"
    silent = speech_features(conditioner, None, 0.42, 25.0)
    assert np.array_equal(silent, conditioner.silence(11))
    assert np.array_equal(speech_features(conditioner, wave, None, 25.0), conditioner(wave, 25))
    with pytest.raises(ModelError, match=r"(?=.*\b0.049 s).*\b10\b"):
        speech_features(conditioner, wave.slice(0.0, 0.049), None, 10.0)


def test_an_array_needs_a_rate_and_nothing_else_has_one():
    samples, wave = np.zeros(8000), voice(0.1)
    for given in ((samples, 4000), ((samples, 4000), None), (np.zeros((8000, 2)), 4000)):
        assert as_speech(*given).duration == 2.0
    assert as_speech(wave, None) is wave and as_speech("a.wav", None) == "a.wav"
    assert as_speech(None, None) is None
    for speech in (wave, "a.wav", None):
        with pytest.raises(ModelError, match="sample_rate=4000"):
            as_speech(speech, 4000)
