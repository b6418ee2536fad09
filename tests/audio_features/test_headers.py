"""Headers of sound files, written by hand: what loads, and what contradicts itself."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np
import pytest
import soundfile

from audio_features import AudioError, Wave
from audio_features.containers.compressed import read_flac, read_mpeg, read_ogg
from audio_features.containers.header import Header

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
        riff(fmt(), DATA, TAGS, chunk(b" a~ ", b"")),
        riff(fmt(), chunk(b"note", b"ab"), DATA, TAGS),
        riff(fmt(), chunk(b"data", SOUND, pad=False), TAGS),
        riff(fmt(), DATA) + b"\xff\xfe\xfd what other programs append \x01\x02",
        riff(fmt(), chunk(b"data", SOUND, pad=False)),
        riff(fmt(), chunk(b"data", SOUND[:800]), b"\0"),
        riff(fmt(), chunk(b"data", SOUND, 0xFFFFFFFF, pad=False)),
    ],
    ids=[
        *(
            "plain",
            "before",
            "after",
            "both",
            "no pad byte",
            "bytes after",
            "odd end",
            "one byte more",
        ),
        "no length",
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
        (riff(fmt(), DATA, kind=b"AVI "), "a RIFF file that is not a wav"),
        (riff(fmt()), r"no sound \(`data`\) in the file"),
        (riff(DATA), "no `fmt ` chunk before the sound"),
        (riff(chunk(b"fmt ", bytes(14)), DATA), "no `fmt ` chunk before the sound"),
        (riff(fmt(channels=0), DATA), "declares 0 channels of 8 bits"),
        (riff(fmt(bits=0), DATA), "declares 1 channels of 0 bits"),
        (
            riff(fmt(block=2), DATA),
            "1 bytes per sample and 8000 per second, it declares 2 and 8000",
        ),
        (riff(fmt(per_second=9), DATA), "and 8000 per second, it declares 1 and 9"),
        (riff(fmt(bits=12, block=1), DATA), "are 2 bytes per sample and 16000 per second"),
        (riff(fmt(bits=18, block=2), DATA), "are 3 bytes per sample and 24000 per second"),
        (riff(fmt(), chunk(b"data", SOUND, N + 2)), "declares 803 bytes of sound, 802 are there"),
        (
            riff(fmt(), chunk(b"data", SOUND, 0xFFFFFFFF, pad=False), size=4 + 24 + 8 + 901),
            "declares 901 bytes of sound, 801 are there",
        ),
        (riff(fmt(), DATA, b"\x01\x02\x03\x04\0\0\0\0"), r"what follows in the file \(9 bytes\)"),
        (riff(fmt(), DATA, chunk(b"LIST", b"abcd", 5)), "is not valid in a wav"),
        (riff(fmt(), DATA, b"LIST"), "is not valid in a wav"),
        (riff(fmt(), DATA, chunk(b"abc\x7f", b"")), "is not valid in a wav"),
        (riff(fmt(), DATA, b"\x01\x02\x03\x04\0\0\0\0", size=50), "is not valid in a wav"),
        (riff(fmt(), DATA, *[chunk(b"more", b"")] * 10_001), "is not valid in a wav"),
        (riff(fmt(), chunk(b"data", b""), chunk(b"LIST", bytes(2000))), "0 samples at 8000 Hz"),
        (riff(fmt(), chunk(b"data", b""), size=0), "0 samples at 8000 Hz"),
        (riff(*[chunk(b"junk", b"")] * 10_001, fmt(), DATA), "more than 10000 chunks"),
        (b"RIFF\0\0", "truncated|cannot be read"),
    ],
)
def test_wav_headers_that_contradict_themselves(tmp_path, content, says):
    (tmp_path / "a.wav").write_bytes(content)
    with pytest.raises(AudioError, match=says):
        Wave.load(tmp_path / "a.wav")


@pytest.mark.parametrize("kind", ["IMA_ADPCM", "MS_ADPCM", "GSM610", "ALAW", "ULAW"])
def test_coded_samples_are_not_counted_by_their_bytes(tmp_path, kind):
    tone = 0.3 * np.sin(np.arange(8_000) * 0.2)
    soundfile.write(tmp_path / "a.wav", tone, RATE, subtype=kind)
    samples = Wave.load(tmp_path / "a.wav").samples
    assert 8_000 <= len(samples) < 9_100  # whole blocks of up to 1,017 samples
    assert np.corrcoef(samples[:8_000], tone)[0, 1] > 0.9


@pytest.mark.parametrize("before", [0, 8_142, 9_000])
def test_a_sound_of_unknown_length_may_begin_anywhere(tmp_path, before):
    """Files are read by 8,192 bytes; the length, at byte 48 + before, may lie across two blocks."""
    junk, data = chunk(b"junk", bytes(before)), b"data" + bytes(4) + SOUND
    (tmp_path / "a.wav").write_bytes(riff(junk, fmt(), data, size=0))
    np.testing.assert_allclose(Wave.load(tmp_path / "a.wav").samples, MEANT, atol=1e-6)


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
    for content in (
        aiff(COMM, SSND),
        aiff(big(b"NAME", b"odd"), SSND, COMM),
        au(N),
        au(0xFFFFFFFF),
    ):
        path.write_bytes(content)
        np.testing.assert_allclose(Wave.load(path).samples, MEANT, atol=1e-6)
    for content, says in (
        (aiff(COMM, SSND, kind=b"8SVX"), "an IFF file that is not AIFF"),
        (aiff(SSND), "an AIFF file without COMM"),
        (aiff(big(b"COMM", bytes(16)), SSND), "an AIFF file without COMM"),
        (aiff(COMM, big(b"SSND", bytes(8) + SIGNED, N + 10)), "811 bytes of sound, 810 are there"),
        (
            aiff(COMM.replace(struct.pack(">I", N), struct.pack(">I", N + 1)), SSND),
            "damaged: the header declares 802 samples a channel, 801 can be found",
        ),
        (au(N + 1), "declares 802 bytes of sound, 801 are there"),
        (au(N, offset=5000), "declares 801 bytes of sound, 0 are there"),
    ):
        path.write_bytes(content)
        with pytest.raises(AudioError, match=says):
            Wave.load(path)


def test_a_sphere_header_declares_what_is_there(tmp_path):
    path = tmp_path / "a.sph"
    soundfile.write(path, np.stack([MEANT, MEANT], 1) / 2, RATE, format="NIST")
    whole = path.read_bytes()
    np.testing.assert_allclose(Wave.load(path).samples, MEANT / 2, atol=1e-4)
    # Of two channels of two bytes, one sample more is four bytes more.
    path.write_bytes(whole.replace(b"sample_count -i 801", b"sample_count -i 802"))
    with pytest.raises(AudioError, match="declares 3208 bytes of sound, 3204 are there"):
        Wave.load(path)
    path.write_bytes(whole.replace(b"channel_count", b"channel_kount"))
    with pytest.raises(AudioError, match="the SPHERE header cannot be read"):
        Wave.load(path)


def flac(path: Path, bits: str = "PCM_16") -> bytearray:
    soundfile.write(path, MEANT / 2, RATE, format="FLAC", subtype=bits)
    return bytearray(path.read_bytes())


@pytest.mark.parametrize("bits", ["PCM_S8", "PCM_16", "PCM_24"])
def test_the_md5_of_a_flac_is_that_of_its_sound(tmp_path, bits):
    path = tmp_path / "a.flac"
    content = flac(path, bits)
    np.testing.assert_allclose(Wave.load(path).samples, MEANT / 2, atol=5e-3)
    # STREAMINFO: after "fLaC" and 4 bytes; its last 16 bytes are the MD5.
    assert any(content[26:42])
    content[30] ^= 1
    path.write_bytes(content)
    with pytest.raises(AudioError, match="does not match the MD5"):
        Wave.load(path)
    assert Wave.load(path, start=0.05).duration == pytest.approx(0.05, abs=0.001), "a part is read"
    assert Wave.load(path, duration=0.05).duration == 0.05
    content[26:42] = bytes(16)
    path.write_bytes(content)
    assert len(Wave.load(path).samples) == N, "without an MD5 there is nothing to compare"


def test_flac_headers_that_contradict_the_sound(tmp_path):
    path = tmp_path / "a.flac"
    content = flac(path)
    other = content.copy()
    numbers = int.from_bytes(content[18:26], "big")
    other[18:26] = (numbers & (1 << 44) - 1 | 22_050 << 44).to_bytes(8, "big")
    path.write_bytes(other)
    with pytest.raises(AudioError, match="the header says 22050 Hz, the sound 8000 Hz"):
        Wave.load(path)
    other[18:26] = (numbers >> 36 << 36).to_bytes(8, "big")
    path.write_bytes(other)
    with pytest.raises(AudioError, match="undeclared length"):
        Wave.load(path)
    other = content.copy()
    other[4] |= 1  # the block has another kind
    path.write_bytes(other)
    with pytest.raises(AudioError, match="without STREAMINFO"):
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


def test_two_ogg_files_in_one_are_refused(tmp_path):
    path = tmp_path / "a.ogg"
    soundfile.write(path, np.resize(MEANT / 2, 20_000), 16_000)
    whole = path.read_bytes()
    for content, says in (
        (whole + whole, "several sounds one after the other"),
        (whole + b"more", "damaged|truncated"),
        (whole[:40] + b"\0" + whole[40:], "damaged"),
    ):
        path.write_bytes(content)
        with pytest.raises(AudioError, match=says):
            Wave.load(path)


@pytest.mark.parametrize(("count", "is_read"), [(160, True), (161, False)])
def test_one_sample_in_a_hundred_may_be_interpolated(count, is_read):
    samples = np.linspace(-0.5, 0.5, 16_000)
    samples[100 : 100 + 2 * count : 2] = np.nan
    if is_read:
        wave = Wave.from_array(samples, 16_000)
        np.testing.assert_allclose(wave.samples, np.linspace(-0.5, 0.5, 16_000), atol=1e-6)
    else:
        with pytest.raises(AudioError, match="sample 100 "):
            Wave.from_array(samples, 16_000)


def mpeg(version=0xFB, mark=b"Xing", at=36, flags=1, frames=100, tag=b"", first=0xFF) -> bytes:
    """Return the beginning of an MP3 file whose first frame holds a Xing header."""
    head = bytes([first, version, 0x90, 0]) + bytes(at - 4)
    return tag + head + mark + struct.pack(">II", flags, frames)


def least(content: bytes) -> int:
    return read_mpeg(io.BytesIO(content), "a.mp3", len(content)).least


def test_the_first_frame_of_an_mp3_declares_the_number_of_frames():
    """Frames have 1152 samples in MPEG-1, 576 in MPEG-2; four of the former may be lacking."""
    for more in ({}, {"mark": b"Info"}, {"at": 4}, {"at": 60}, {"flags": 0xF}):
        assert least(mpeg(**more)) == 96 * 1152, more
        assert least(mpeg(**more, version=0xF3)) == 100 * 576 - 4 * 1152, more
    assert least(mpeg(frames=4)) == least(mpeg(frames=1)) == 0
    assert least(mpeg(frames=5)) == 1152
    for more in ({"at": 61}, {"flags": 0xE}, {"mark": b"Lame"}, {"first": 0xFE}):
        assert least(mpeg(**more)) == 0, more
    assert least(mpeg()[:-1]) == 0, "cut within the header"
    # Four times seven bits.
    size = (1 << 21) + (2 << 14) + (3 << 7) + 4
    tag = b"ID3\4\0\0" + bytes([0x81, 0x82, 0x83, 0x84]) + bytes(size)
    assert least(mpeg(tag=tag)) == 96 * 1152


def flac_head(rate=8_000, bits=16, frames=801, code=4, last=0x80, more=b"", sync=0xF8) -> bytes:
    """Return the beginning of a FLAC file, up to the head of its first frame."""
    numbers = (rate << 44 | 1 << 41 | bits - 1 << 36 | frames).to_bytes(8, "big")
    info = bytes([last, 0, 0, 34]) + bytes(10) + numbers + b"0123456789abcdef"
    return b"fLaC" + info + more + bytes([0xFF, sync, 0x90 | code, 0])


def test_the_head_of_a_flac_declares_length_rate_and_digest():
    def read(**more):
        return read_flac(io.BytesIO(flac_head(**more)), "a.flac", 99)

    rates = (88_200, 176_400, 192_000, 8_000, 16_000, 22_050, 24_000, 32_000, 44_100, 48_000)
    for code, rate in enumerate((*rates, 96_000), start=1):
        assert read(rate=rate, code=code).frames == 801
        with pytest.raises(AudioError, match=f"says 11025 Hz, the sound {rate} Hz"):
            read(rate=11_025, code=code)
    for code in (0, 12, 15):
        assert read(rate=11_025, code=code).frames == 801, "the head of a frame does not say"
    assert read(rate=11_025, code=4, sync=0xF0).frames == 801, "no head of a frame"
    assert read(frames=(1 << 36) - 1).frames == (1 << 36) - 1
    for bits in (8, 16, 24):
        assert read(bits=bits).md5 == (b"0123456789abcdef", bits)
    assert read(bits=12).md5 is read(bits=20).md5 is None
    # Blocks of padding (kind 1) and comments (kind 4), the last of which says so.
    blocks = b"\x01\0\0\2ab\x84\1\1\2" + bytes((1 << 16) + (1 << 8) + 2)
    for code in (4, 5):
        head = {"last": 0, "more": blocks, "code": code}
        if code == 4:
            assert read(**head).frames == 801
        else:
            with pytest.raises(AudioError, match="says 8000 Hz, the sound 16000 Hz"):
                read(**head)


def ogg(number: int, flags: int = 0, serial: int = 7, size: int = 300) -> bytes:
    """Return a page of Ogg with its checksum, bit by bit as in RFC 3533."""
    table = bytes([255] * (size // 255) + [size % 255])
    head = b"OggS\0" + bytes([flags]) + bytes(8) + struct.pack("<II", serial, number)
    page = head + bytes(4) + bytes([len(table)]) + table + bytes(k % 251 for k in range(size))
    crc = 0
    for byte in page:
        crc ^= byte << 24
        for _ in range(8):
            crc = crc << 1 & 0xFFFFFFFF ^ (0x04C11DB7 if crc >> 31 else 0)
    return page[:22] + struct.pack("<I", crc) + page[26:]


@pytest.mark.parametrize(
    ("pages", "says"),
    [
        ([ogg(0, 2), ogg(1), ogg(2, 4)], None),
        ([ogg(5, 6)], None),
        ([ogg(0xFFFFFFFF, 2), ogg(0, 4)], None),
        # Two streams at a time.
        ([ogg(0, 2), ogg(9, 2, 8), ogg(10, 4, 8), ogg(1, 4)], None),
        ([ogg(0, 2), ogg(2, 4)], "Ogg page 1 is missing before byte 329"),
        ([ogg(1), ogg(2, 4)], "Ogg page 0 is missing before byte 0"),
        ([ogg(0, 2), ogg(1)], "the last Ogg page is not marked as the end"),
        ([ogg(0, 2), ogg(9, 2, 8), ogg(1, 4)], "the last Ogg page is not marked as the end"),
        ([ogg(0, 6), ogg(0, 6, 8)], r"several sounds one after the other .*byte 329\)"),
        ([ogg(0, 2), ogg(1, 4)[:-1] + b"x"], "checksum of the Ogg page at byte 329 is wrong"),
        ([ogg(0, 6), b"OggT" + bytes(23)], "no Ogg page at byte 329"),
        ([ogg(0, 6), b"OggS"], "the header itself ends"),
    ],
)
def test_pages_of_an_ogg_file_follow_one_another(pages, says):
    """A page of 300 bytes has 329: 27 of the head, 2 of the table."""
    content = b"".join(pages)
    if says is None:
        assert read_ogg(io.BytesIO(content), "a.ogg", len(content)) == Header()
    else:
        with pytest.raises(AudioError, match=says):
            read_ogg(io.BytesIO(content), "a.ogg", len(content))


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
            with pytest.raises(AudioError, match="declares 821 bytes of sound, 816 are there"):
                Wave.load(path)


def test_a_wav_that_ends_within_a_sample_has_the_ones_before(tmp_path):
    """801 bytes are 400 samples of two channels."""
    path = tmp_path / "a.wav"
    path.write_bytes(riff(fmt(channels=2), DATA))
    expected = MEANT[:800].reshape(-1, 2)
    for channel in (1, 2):
        found = Wave.load(path, channel=channel).samples
        np.testing.assert_allclose(found, expected[:, channel - 1], atol=1e-6)
