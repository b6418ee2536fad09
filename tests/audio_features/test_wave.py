import io
import pickle
import re
from itertools import product

import numpy as np
import pytest
import soundfile
import torch

from audio_features import AudioError, Wave


def noise(n: int, level: float = 0.1) -> np.ndarray:
    return (level * np.random.default_rng(0).standard_normal(n)).astype(np.float32)


@pytest.mark.parametrize(
    ("name", "rate", "channels", "subtype"),
    [
        ("a.wav", 44_100, 2, "PCM_16"),
        ("a.wav", 48_000, 1, "PCM_24"),
        ("a.wav", 16_000, 6, "FLOAT"),
        ("a.flac", 44_100, 2, "PCM_16"),
    ],
)
def test_lossless_files_load_as_the_mean_of_their_channels(tmp_path, name, rate, channels, subtype):
    sound = 0.1 * np.random.default_rng(0).standard_normal((rate, channels))
    soundfile.write(tmp_path / name, sound, rate, subtype=subtype)
    wave = Wave.load(tmp_path / name)
    assert (wave.sample_rate, wave.samples.dtype, wave.duration) == (rate, np.float32, 1.0)
    np.testing.assert_allclose(wave.samples, sound.mean(axis=1), atol=4e-5)


@pytest.mark.parametrize("name", ["a.mp3", "a.ogg"])
def test_lossy_files_load(tmp_path, name):
    tone = 0.3 * np.sin(2 * np.pi * 440 * np.arange(44_100) / 44_100)
    soundfile.write(tmp_path / name, tone, 44_100)
    wave = Wave.load(tmp_path / name)
    assert wave.duration == pytest.approx(1.0, abs=0.1)
    assert wave.active_level() == pytest.approx(20 * np.log10(0.3 / np.sqrt(2)), abs=0.5)


def test_a_stretch_of_a_file_is_the_slice_of_the_whole(tmp_path):
    soundfile.write(tmp_path / "a.wav", noise(16_000), 16_000, subtype="FLOAT")
    whole = Wave.load(tmp_path / "a.wav")
    part = Wave.load(tmp_path / "a.wav", start=0.25, duration=0.5)
    np.testing.assert_array_equal(part.samples, whole.samples[4_000:12_000])
    np.testing.assert_array_equal(part.samples, whole.slice(0.25, 0.5).samples)
    assert Wave.load(tmp_path / "a.wav", start=0.9, duration=5.0).duration == pytest.approx(0.1)
    assert (whole.offset, part.offset, part.slice(0.125).offset) == (0.0, 0.25, 0.375)


def wav(samples: np.ndarray, rate: int = 16_000, subtype: str = "PCM_16") -> bytes:
    with io.BytesIO() as file:
        soundfile.write(file, samples, rate, format="WAV", subtype=subtype)
        return file.getvalue()


HOLES = np.where((np.arange(16_000) >= 123) & (np.arange(16_000) < 323), np.nan, 0.1)


@pytest.mark.parametrize(
    ("name", "content", "options", "words"),
    [
        ("missing.wav", None, {}, []),
        ("text.wav", b"this is not sound\n" * 100, {}, []),
        ("pcm.wav", noise(1000).tobytes(), {}, ["ffmpeg ", "s16le", "16000"]),
        ("empty.wav", b"", {}, ["0 bytes"]),
        ("short.wav", wav(noise(160)), {}, ["10.0 ms", "25 ms"]),
        ("nan.wav", wav(HOLES, subtype="FLOAT"), {}, ["sample 123", "nan"]),
        ("good.wav", wav(noise(16_000)), {"max_seconds": 0.5}, ["1.0 s", "0.5 s", "max_seconds"]),
    ],
)
def test_bad_files_are_named_with_what_is_wrong(tmp_path, name, content, options, words):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(AudioError) as caught:
        Wave.load(tmp_path / name, **options)
    assert all(word in str(caught.value) for word in (str(tmp_path / name), *words))
    (tmp_path / "folder.wav").mkdir()
    with pytest.raises(AudioError, match=r"folder\.wav"):
        Wave.load(tmp_path / "folder.wav")


@pytest.mark.parametrize("kind", ["WAV", "RF64", "FLAC", "OGG", "MP3", "AIFF", "AU", "NIST"])
def test_truncated_files_are_refused(tmp_path, kind):
    path = tmp_path / "sound"
    soundfile.write(path, noise(44_100), 44_100, format=kind)
    Wave.load(path)
    whole = path.read_bytes()
    for part in (0.1, 0.5, 0.9):
        path.write_bytes(whole[: int(part * len(whole))])
        with pytest.raises(AudioError, match=str(path)) as caught:
            Wave.load(path)
        if kind in ("WAV", "RF64", "AIFF", "AU", "NIST"):
            assert f"ffmpeg -i {path} " in str(caught.value)


@pytest.mark.parametrize("order", ["little", "big"])
def test_a_wav_streamed_to_a_pipe_has_no_length_and_still_loads(tmp_path, order):
    path = tmp_path / "a.wav"
    soundfile.write(path, noise(16_000), 16_000, endian=order.upper())
    meant = Wave.load(path).samples
    content = bytearray(path.read_bytes())
    at = content.index(b"data") + 4
    for whole, sound in product((0, 36, 0xFFFFFFFF), (0, 0xFFFFFFFF, 0x7FFFF000)):
        content[4:8] = whole.to_bytes(4, order)
        content[at : at + 4] = sound.to_bytes(4, order)
        path.write_bytes(content)
        np.testing.assert_array_equal(Wave.load(path).samples, meant)
        np.testing.assert_array_equal(Wave.load(path, start=0.5).samples, meant[8_000:])


def test_pickles_and_arrays_without_samples_are_named(tmp_path):
    (tmp_path / "a.pkl").write_bytes(pickle.dumps({"poses": [0.0] * 99}))
    with pytest.raises(AudioError, match=r"a\.pkl.*pickle") as caught:
        Wave.load(tmp_path / "a.pkl")
    assert "ffmpeg" not in str(caught.value)
    with pytest.raises(AudioError, match=r"\(0, 2\)"):
        Wave.from_array(np.zeros((0, 2)), 16_000)


@pytest.mark.parametrize("channels", [1, 2, 8, 32])
def test_one_channel_of_many(tmp_path, channels):
    sound = 0.1 * np.random.default_rng(0).standard_normal((8_000, channels))
    soundfile.write(tmp_path / "a.wav", sound, 16_000, subtype="FLOAT")
    for channel in (1, channels):
        samples = Wave.load(tmp_path / "a.wav", channel=channel).samples
        np.testing.assert_array_equal(samples, sound[:, channel - 1].astype(np.float32))
    for channel in (0, channels + 1, -1):
        with pytest.raises(AudioError, match=rf"channel {channel}\b.* {channels}\b"):
            Wave.load(tmp_path / "a.wav", channel=channel)


def test_faults_of_a_recording_are_named(speech):
    assert speech.faults() == []
    assert "silence" in Wave(np.zeros(16_000, np.float32), 16_000).faults()[0]
    assert "5.0 %" in Wave(speech.samples + np.float32(0.05), 16_000).faults()[0]
    loud = np.clip(4 * speech.samples / np.abs(speech.samples).max(), -1, 1)
    clipped = Wave(loud, 16_000).faults()
    assert len(clipped) == 1 and "clipped" in clipped[0]
    first = re.search(r"([\d.]+) s\b", clipped[0])
    assert float(first[1]) == pytest.approx(np.argmax(np.abs(loud) >= 1) / 16_000, abs=0.01)
    floating = Wave(10 * speech.samples / np.abs(speech.samples).max(), 16_000)
    assert floating.faults() == []  # beyond full scale, and so not clipped at it


def test_any_usual_array_of_samples_makes_the_same_wave():
    mono = noise(16_000).astype(np.float32)
    theirs = [mono, mono.astype(np.float64), mono.tolist(), torch.tensor(mono, requires_grad=True)]
    theirs += [np.stack([mono, mono]), np.stack([mono, mono], axis=1), mono[None], mono[:, None]]
    for samples in theirs:
        wave = Wave.from_array(samples, 16_000)
        np.testing.assert_allclose(wave.samples, mono, rtol=1e-6)
        assert wave.samples.dtype == np.float32 and wave.sample_rate == 16_000
    for dtype, half in (("int8", 127), ("int16", 32_767), ("int32", 2**31 - 1)):
        whole = np.rint(mono.astype(np.float64) * half).astype(dtype)
        close = {"rtol": 0, "atol": 1.01 / half + 1e-7}
        np.testing.assert_allclose(Wave.from_array(whole, 16_000).samples, mono, **close)
    wave = Wave.from_array(np.full(800, 255, np.uint8), 16_000)
    assert wave.samples[0] == 127 / 128, "of 8-bit samples 128 is the middle"


@pytest.mark.parametrize("noisy", [0.0, 1e-3])
def test_of_channels_that_cancel_each_other_the_loudest_is_used(tmp_path, noisy):
    mono = noise(16_000)
    two = np.stack([0.9 * mono, -mono], axis=1) + noisy * noise(32_000).reshape(-1, 2) + 0.2
    soundfile.write(tmp_path / "two.wav", two, 16_000, subtype="FLOAT")
    for wave in (Wave.load(tmp_path / "two.wav"), Wave.from_array(two.T, 16_000)):
        np.testing.assert_array_equal(wave.samples, two[:, 1].astype(np.float32))
        (repair,) = wave.repairs
        assert "cancel" in repair and "channel 2 " in repair
    assert not Wave.load(tmp_path / "two.wav", channel=1).repairs
    six = np.zeros((16_000, 6))
    six[:, 2] = mono
    for usual in (np.stack([mono, -0.5 * mono]), noise(32_000).reshape(-1, 2), six, 0 * six):
        wave = Wave.from_array(usual, 16_000)
        axis = int(np.argmin(usual.shape))
        np.testing.assert_allclose(wave.samples, usual.mean(axis=axis), atol=1e-6)
        assert not wave.repairs


def test_a_few_samples_that_are_not_finite_are_interpolated(tmp_path):
    samples = np.linspace(-0.5, 0.5, 16_000)
    bad = samples.copy()
    bad[[100, 101, 15_999]] = np.nan, np.inf, -np.inf
    soundfile.write(tmp_path / "a.wav", bad, 16_000, subtype="FLOAT")
    for wave in (Wave.load(tmp_path / "a.wav"), Wave.from_array(bad, 16_000)):
        np.testing.assert_allclose(wave.samples, samples, atol=1e-4)
        (repair,) = wave.repairs
        assert "3 of 16000" in repair and "0.006 s" in repair
    first = np.concatenate([[np.nan], samples[1:]])
    (repair,) = Wave.from_array(first, 16_000).repairs
    assert "1 of 16000" in repair and "0.000 s" in repair


@pytest.mark.parametrize(
    ("samples", "rate", "says"),
    [
        (np.ones(800), None, "sample_rate"),
        (np.full(800, np.nan), 16_000, r"(?=.*sample 0\b).*nan"),
        (np.zeros((2, 3, 800)), 16_000, r"\(2, 3, 800\)"),
        (np.zeros((1, 1, 1)), 16_000, r"(?=.*\b1\b)(?=.*16000 Hz).*0.1 ms: give at least 25 ms"),
        (b"RIFF", 16_000, "bytes"),
        (np.ones(800, bool), 16_000, "bool"),
        (np.ones(800), float("nan"), "nan"),
    ],
)
def test_an_array_that_is_no_sound_is_refused(samples, rate, says):
    with pytest.raises(AudioError, match=r"\(2, 800\)"):
        Wave(np.zeros((2, 800), np.float32), 16_000)
    with pytest.raises(AudioError, match=says):
        Wave.from_array(samples, rate)
    with pytest.raises(AudioError, match="the talk"):
        Wave.from_array(samples, rate, "the talk")


def test_features_in_the_place_of_a_sound_are_silence_of_their_length(tmp_path):
    def of(*times: float, **options) -> Wave:
        np.savez(tmp_path / "dance.npz", values=np.ones((len(times), 3)), times=times)
        return Wave.load(tmp_path / "dance.npz", **options)

    assert of(0.0, 0.5, 1.0, 1.75).duration == 2.25  # the last frame is as long as is usual
    assert not of(0.0, 1.0, max_seconds=2.0).samples.any()
    for times, seconds in (((0.5,), "0 s"), ((0.0, 1.0), "2 s"), ((-2.0, -1.0), "0 s")):
        with pytest.raises(AudioError, match=f"dance.npz: features up to {seconds}"):
            of(*times, max_seconds=1.9)


@pytest.mark.parametrize("rate", [8_000, 11_025, 22_050, 44_100, 48_000])
def test_resampling_keeps_a_tone_and_the_length(rate):
    times = np.arange(rate + 17) / rate
    wave = Wave(np.sin(2 * np.pi * 440 * times).astype(np.float32), rate).resample(16_000)
    assert len(wave.samples) == -(-(rate + 17) * 16_000 // rate)
    inner = slice(1_000, 15_000)
    expected = np.sin(2 * np.pi * 440 * np.arange(16_000) / 16_000)
    np.testing.assert_allclose(wave.samples[:16_000][inner], expected[inner], atol=1e-4)


def test_rms_of_a_sine_is_its_amplitude_over_the_root_of_two():
    """Windows have ten periods, five at the begin; a constant part does not count."""
    sine = 0.4 * np.sin(2 * np.pi * 200 * np.arange(48_000) / 16_000) + 0.2
    found = Wave(sine.astype(np.float32), 16_000).rms(np.arange(75) / 25, window=0.05)
    np.testing.assert_allclose(found, 0.4 / np.sqrt(2), rtol=1e-3)


def test_activity_and_level_do_not_depend_on_pauses_gain_or_offset(speech):
    pause = np.zeros(20 * 16_000, np.float32)
    sparse = Wave(np.concatenate([pause, speech.samples, pause]), 16_000)
    assert sparse.active_level() == pytest.approx(speech.active_level(), abs=0.3)
    active = sparse.active()
    assert len(active) == 4_400
    assert not active[:1_990].any() and not active[2_410:].any() and active.any()
    quiet = Wave(speech.samples * 0.1 + 0.02, 16_000)
    assert quiet.active_level() == pytest.approx(speech.active_level() - 20, abs=0.05)
    np.testing.assert_array_equal(quiet.active(), speech.active())
    assert quiet.at_level().active_level() == pytest.approx(-23, abs=0.01)


def test_a_small_file_cannot_take_gigabytes_of_samples(tmp_path):
    """A FLAC of zeros needs next to nothing for 65 million of them; here its header says so."""
    path = tmp_path / "a.flac"
    soundfile.write(path, np.zeros(16_000, np.int16), 16_000)
    content = bytearray(path.read_bytes())
    content[22:26] = (65 << 20).to_bytes(4, "big")
    path.write_bytes(content)
    with pytest.raises(AudioError, match=r"a\.flac(?=.*68157440).*\b20\b"):
        Wave.load(path)
    assert len(Wave.load(path, duration=0.5).samples) == 8_000
