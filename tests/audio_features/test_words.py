"""Words with times, from every kind of word list, and as features."""

import json

import numpy as np
import pytest

import audio_features as af
from audio_features.words import words_beside

EXPECTED = [(0.2, 0.5, "so"), (0.5, 1.0, "well"), (2.0, 2.25, "yes")]

# As Praat writes it, and in its short form; how lines are broken is of no account.
LONG = """File type = "ooTextFile"
Object class = "TextGrid"
xmin = 0 xmax = 3 tiers? <exists> size = 2
item []:
    item [1]: class = "IntervalTier" name = "phones" xmin = 0 xmax = 3 intervals: size = 1
        intervals [1]: xmin = 0 xmax = 3 text = "a ""b"" 3"
    item [2]: class = "IntervalTier" name = "words" xmin = 0 xmax = 3 intervals: size = 4
        intervals [1]: xmin = 0.2 xmax = 0.5 text = "so"
        intervals [2]:
            xmin = 0.5
            xmax = 1
            text = "well"
        intervals [3]: xmin = 1 xmax = 2 text = ""
        intervals [4]: xmin = 2.0 xmax = 2.25 text = "yes"
"""
SHORT = """File type = "ooTextFile"
Object class = "TextGrid"

0
3
<exists>
2
"TextTier" "beats" 0 3 1 0.7 "x"
"IntervalTier" "transcript" 0 3 3 0.2 0.5 "so" 0.5 1 "well" 2 2.25 "yes"
"""
LIST = [{"word": text, "start": start, "end": end} for start, end, text in EXPECTED]
FILES = {
    "a.TextGrid": LONG,
    "b.TextGrid": SHORT,
    "c.ctm": ";; made by hand\nx 1 0.2 0.3 so\nx 1 0.5 0.5 well 0.9\nx 1 2.0 0.25 yes\n",
    "d.words.json": json.dumps(LIST),
    "e.json": json.dumps({"text": "so", "segments": [{"words": LIST[:2]}, {"words": LIST[2:]}]}),
    "f.tsv": "2.0\t2.25\tyes\n0.2\t0.5\tso\n0.5\t1.0\twell\n",
    "g.srt": "1\n00:00:00,200 --> 00:00:01,100\nso <i>well</i>\n\n"
    "2\n00:00:02,000 --> 00:00:02,250\nyes\n",
    "h.vtt": "WEBVTT\n\n00:00.200 --> 00:01.100 align:start\nso well\n\n"
    "00:02.000 --> 00:02.250\nyes\n",
}


@pytest.mark.parametrize("name", FILES)
def test_every_kind_of_list_gives_the_same_words(tmp_path, name):
    (tmp_path / name).write_text(FILES[name])
    words = [(word.start, word.end, word.text) for word in af.load_words(tmp_path / name)]
    if name[0] in "gh":  # captions: time is shared by letters
        expected = [(0.2, 0.5, "so"), (0.5, 1.1, "well"), (2.0, 2.25, "yes")]
    else:
        expected = EXPECTED
    for found, wanted in zip(words, expected, strict=True):
        assert found == (pytest.approx(wanted[0]), pytest.approx(wanted[1]), wanted[2])


def test_times_of_captions_and_marks_of_laughter(tmp_path):
    (tmp_path / "a.srt").write_text("1\n01:02:03,500 --> 01:02:04.5\n{x}so\n<b>well</b>\n\nno\n")
    so, well = af.load_words(tmp_path / "a.srt")
    assert (so.start, well.end) == (3723.5, 3724.5) and so.end == pytest.approx(3723.5 + 1 / 3)
    (tmp_path / "a.vtt").write_text("WEBVTT\n")
    assert af.load_words(tmp_path / "a.vtt") == ()
    (tmp_path / "a.tsv").write_text("0\t1\t#LAUGHTER\n\n1\t2\tso\tmore\n604800\t604800\tend\n")
    assert [word.text for word in af.load_words(tmp_path / "a.tsv")] == ["so", "end"]


def test_a_file_that_is_no_list_for_its_size_alone(tmp_path):
    with (tmp_path / "a.ctm").open("wb") as file:
        file.truncate(100_000_000)  # a hole, which takes no disk
    with pytest.raises(af.FeatureError, match="a.ctm.* MiB"):
        af.load_words(tmp_path / "a.ctm")
    with pytest.raises(af.FeatureError, match="b.ctm"):
        af.load_words(tmp_path / "b.ctm")


def test_the_list_beside_a_recording(tmp_path):
    assert words_beside(tmp_path / "a.wav") is None
    for name in ("a.tsv", "a.VTT", "a.srt", "a.words.json", "a.ctm", "a.textgrid"):
        (tmp_path / name).write_text("")
        assert words_beside(tmp_path / "a.wav") == tmp_path / name, "the preferred one"


@pytest.mark.parametrize(
    ("name", "text", "complaint"),
    [
        ("a.TextGrid", LONG[:-60], "tier"),
        ("a.TextGrid", LONG.replace("xmax = 2.25", "xmax = 1.5"), r"(?=.*interval 4).*\b1\.5"),
        ("a.ctm", "x 1 0.2 so\n", "line 1"),
        ("a.srt", "1\n00:00:xx --> 00:00:02,250\nyes\n", "caption"),
        ("a.json", "{", "JSON"),
        ("a.tsv", "1 2 so", "line 1"),
        ("a.tsv", "2\t1\tso", "(?=.*line 1)(?=.*1.0 s).*2.0 s"),
        ("a.TextGrid", SHORT.replace("IntervalTier", "TextTier"), "interval"),
        ("a.doc", "", "TextGrid"),
    ],
)
def test_a_broken_word_list_is_an_error_that_names_the_file(tmp_path, name, text, complaint):
    (tmp_path / name).write_text(text)
    with pytest.raises(af.FeatureError, match=f"{name}.*{complaint}"):
        af.load_words(tmp_path / name)


def test_values_of_words_by_hand(tmp_path):
    """A word within another, one without length, and one that begins before the sound."""
    words = "x 1 1.5 1.0 a\nx 1 3 2 b\nx 1 3.5 0.5 c\nx 1 8 0 d\nx 1 12 1 e\n"
    (tmp_path / "a.ctm").write_text(words)
    wave = af.Wave(np.ones(160_000, np.float32) / 10, 16_000, offset=2.0, words=tmp_path / "a.ctm")
    word, onset, gap, rate = af.Words().extract(wave).values.T
    frames = np.arange(1000)
    spoken = [*range(50), *range(100, 300), 600]
    np.testing.assert_array_equal(word, np.isin(frames, spoken))
    np.testing.assert_array_equal(np.flatnonzero(onset), [100, 150, 600])
    # Pauses of 1/2, 3 and 4 s.
    expected = np.log1p(np.where(frames < 100, 0.5, np.where(frames < 600, 3.0, 4.0)))
    np.testing.assert_allclose(gap, np.where(np.isin(frames, spoken), 0.0, expected), rtol=1e-6)
    # One word in a bell of 0.5 s: 1 / (0.5 sqrt(2 pi)), and exp(-1/2) of it half a second away.
    np.testing.assert_allclose(rate[[600, 550, 650]], [0.7979, 0.4839, 0.4839], atol=1e-3)
    (tmp_path / "a.ctm").write_text("x 1 2 1 a\n")
    early = af.Words().extract(wave).values
    np.testing.assert_array_equal(np.flatnonzero(early[:, 1]), [0])
    # Before the sound there are no words.
    np.testing.assert_allclose(early[[0, 50], 3], [0.7979, 0.4839], atol=1e-3)
    short = af.Wave(np.zeros(400), 16_000)
    assert af.Words().extract(short).times.tolist() == [0.0, 0.01, 0.02], "25 ms"
    assert rate[300:800].sum() / 100 == pytest.approx(1.0, abs=0.02)


def test_new_words_count_at_once_and_missing_ones_are_an_error(tmp_path, write_speech):
    wav = write_speech(tmp_path / "talk.wav", 3.0)
    cache, words = af.FeatureCache(tmp_path / "cache"), af.Stack([af.Words(), af.Prosody()])
    with pytest.raises(af.FeatureError, match="talk.wav.*STEM.TextGrid"):
        cache.extract(words, af.Wave.load(wav))
    (tmp_path / "talk.ctm").write_text("x 1 0.2 0.3 so\n")
    first = cache.extract(words, af.Wave.load(wav))
    (tmp_path / "talk.ctm").write_text("x 1 1.2 0.3 so\n")
    assert not np.array_equal(first.values, cache.extract(words, af.Wave.load(wav)).values)
    silence = af.Wave(np.zeros(16_000), 16_000)
    assert not af.Words().extract(silence).values[:, :2].any()
