"""Headers of sound files, written by hand: what loads, and what contradicts itself."""

import re
import struct

import numpy as np
import pytest
import soundfile

from audio_features import AudioError, Wave

RATE = 8_000
N = 801
SOUND = bytes(range(28, 229)) * 3 + bytes([128]) * (N - 603)
"""801 samples of 8 bits, of which 128 is the middle."""
MEANT = (np.frombuffer(SOUND, np.uint8) - 128.0) / 128


def chunk(kind: bytes, body: bytes, length: int | None = None, pad: bool = True) -> bytes:
    length = len(body) if length is None else length
    return kind + struct.pack("<I", length) + body + b"\0" * (len(body) % 2 and pad)


def fmt(channels=1, rate=RATE, per_second=None, block=None, bits=8, tag=1) -> bytes:
    usual = channels * -(-bits // 8)
    block = usual if block is None else block
    per_second = rate * usual if per_second is None else per_second
    return chunk(b"fmt ", struct.pack("<HHIIHH", tag, channels, rate, per_second, block, bits))


def riff(*chunks: bytes, kind: bytes = b"WAVE", size: int | None = None) -> bytes:
    body = kind + b"".join(chunks)
    return b"RIFF" + struct.pack("<I", len(body) if size is None else size) + body


DATA, TAGS = chunk(b"data", SOUND), chunk(b"LIST", b"INFOa")


@pytest.mark.parametrize(
    "content",
    [
        riff(fmt(), DATA),
        riff(chunk(b"note", b"odd"), fmt(), TAGS, DATA),
        riff(fmt(), chunk(b"data", SOUND, pad=False), TAGS),
        riff(fmt(), DATA) + b"\xff\xfe\xfd what other programs append \x01\x02",
        riff(fmt(), chunk(b"data", SOUND, pad=False)),
        riff(fmt(), chunk(b"data", SOUND, 0xFFFFFFFF, pad=False)),
    ],
)
def test_chunks_may_stand_anywhere(tmp_path, content):
    (tmp_path / "a.wav").write_bytes(content)
    wave = Wave.load(tmp_path / "a.wav")
    assert wave.sample_rate == RATE and len(wave.samples) >= 800
    np.testing.assert_allclose(wave.samples, MEANT[: len(wave.samples)], atol=1e-6)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (riff(fmt(), DATA, kind=b"AVI "), "a.wav"),
        (riff(fmt()), "'data'"),
        (riff(DATA), "a.wav"),
        (riff(fmt(channels=0), DATA), "zero"),
        (riff(fmt(block=2), DATA), "8000.*16000"),
        (riff(fmt(), chunk(b"data", SOUND, N + 2)), r"(?=.*\b803\b).*802\b"),
        (riff(*[chunk(b"junk", b"")] * 10_001, fmt(), DATA), "a.wav"),
    ],
)
def test_wav_headers_that_contradict_themselves(tmp_path, content, says):
    (tmp_path / "a.wav").write_bytes(content)
    with pytest.raises(AudioError, match=says):
        Wave.load(tmp_path / "a.wav")


def big(kind: bytes, body: bytes, length: int | None = None) -> bytes:
    length = len(body) if length is None else length
    return kind + struct.pack(">I", length) + body + b"\0" * (len(body) % 2)


def aiff(*chunks: bytes, kind: bytes = b"AIFF") -> bytes:
    body = kind + b"".join(chunks)
    return b"FORM" + struct.pack(">I", len(body)) + body


SIGNED = (np.frombuffer(SOUND, np.uint8).astype(int) - 128).astype(np.int8).tobytes()
COMM = big(b"COMM", struct.pack(">hIh", 1, N, 8) + bytes.fromhex("400bfa00000000000000"))
SSND = big(b"SSND", bytes(8) + SIGNED)


def au(length: int, offset: int = 24) -> bytes:
    return b".snd" + struct.pack(">IIIII", offset, length, 2, RATE, 1) + SIGNED


def test_headers_of_aiff_and_au(tmp_path):
    path = tmp_path / "sound"
    for content in (aiff(big(b"NAME", b"odd"), SSND, COMM), au(N), au(0xFFFFFFFF)):
        path.write_bytes(content)
        np.testing.assert_allclose(Wave.load(path).samples, MEANT, atol=1e-6)
    for content, says in (
        (aiff(SSND), "sound"),
        (aiff(COMM, big(b"SSND", bytes(8) + SIGNED, N + 10)), r"(?=.*\b811\b).*810\b"),
        (au(N + 1), r"(?=.*\b802\b).*801\b"),
    ):
        path.write_bytes(content)
        with pytest.raises(AudioError, match=says):
            Wave.load(path)


@pytest.mark.parametrize("bits", ["PCM_S8", "PCM_16", "PCM_24"])
def test_a_flac_with_a_damaged_frame_or_without_a_length_is_refused(tmp_path, bits):
    path = tmp_path / "a.flac"
    soundfile.write(path, MEANT / 2, RATE, format="FLAC", subtype=bits)
    np.testing.assert_allclose(Wave.load(path).samples, MEANT / 2, atol=5e-3)
    content = bytearray(path.read_bytes())
    damaged, endless = content.copy(), content.copy()
    damaged[-100] ^= 1
    endless[21:26] = bytes([content[21] & 0xF0, 0, 0, 0, 0])  # the length in STREAMINFO
    for wrong, says in ((damaged, "a.flac"), (endless, "(?=.*length).*ffmpeg")):
        path.write_bytes(wrong)
        with pytest.raises(AudioError, match=says):
            Wave.load(path)


def test_an_mp3_may_begin_with_a_tag_and_is_compared_with_its_length(tmp_path):
    path = tmp_path / "a.mp3"
    soundfile.write(path, np.resize(MEANT / 2, 200_000), 44_100, format="MP3")
    whole = path.read_bytes()
    plain = Wave.load(path).samples
    tag = b"ID3\x04\0\0" + bytes([0, 0, 2, 72]) + bytes(2 * 128 + 72)
    path.write_bytes(tag + whole)
    np.testing.assert_array_equal(Wave.load(path).samples, plain)
    path.write_bytes((tag + whole)[: len(whole) // 2])
    with pytest.raises(AudioError, match="truncated"):
        Wave.load(path)
    assert Wave.load(path, duration=0.5).duration == 0.5


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda pages: None, None),
        (lambda pages: pages.pop(3), "missing"),
        (lambda pages: pages.pop(), "last"),
        (lambda pages: pages.insert(3, pages.pop(3)[:-1] + b"x"), "checksum"),
        (lambda pages: pages.insert(3, b"OggT" + bytes(23)), None),
    ],
)
def test_pages_of_an_ogg_file_follow_one_another(tmp_path, change, says):
    path = tmp_path / "a.ogg"
    noise = np.random.default_rng(0).uniform(-0.5, 0.5, 4 * 44_100)
    soundfile.write(path, noise, 44_100)
    pages = re.split(rb"(?=OggS\0)", path.read_bytes())[1:]
    change(pages)
    path.write_bytes(b"".join(pages))
    if says is None:
        assert Wave.load(path).duration == pytest.approx(4.0, abs=0.1)
    else:
        with pytest.raises(AudioError, match=says):
            Wave.load(path)


def test_wav_files_of_the_other_byte_order_and_of_over_four_gigabytes(tmp_path):
    path = tmp_path / "a.wav"
    body = (
        b"WAVE" + big(b"fmt ", struct.pack(">HHIIHH", 1, 1, RATE, RATE, 1, 8)) + big(b"data", SOUND)
    )
    path.write_bytes(b"RIFX" + struct.pack(">I", len(body)) + body)
    np.testing.assert_allclose(Wave.load(path).samples, MEANT, atol=1e-6)
    data = chunk(b"data", SOUND, 0xFFFFFFFF)
    for tags, length in ((TAGS, N), (b"", N), (TAGS, N + 20)):
        sizes = struct.pack("<QQQI", 4 + 36 + 24 + len(data) + len(tags), length, length, 0)
        body = b"WAVE" + chunk(b"ds64", sizes) + fmt() + data + tags
        path.write_bytes(b"RF64\xff\xff\xff\xff" + body)
        if length == N:
            np.testing.assert_allclose(Wave.load(path).samples, MEANT, atol=1e-6)
        else:
            with pytest.raises(AudioError, match=r"(?=.*\b821\b).*816\b"):
                Wave.load(path)
