"""Words with times, from every kind of word list, and as features."""

from __future__ import annotations

import json

import numpy as np
import pytest

import audio_features as af

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


def test_utf_16_as_praat_writes_it(tmp_path):
    (tmp_path / "a.TextGrid").write_bytes(LONG.replace("yes", "はい").encode("utf-16"))
    assert af.load_words(tmp_path / "a.TextGrid")[-1].text == "はい"


@pytest.mark.parametrize(
    ("name", "text", "complaint"),
    [
        ("a.TextGrid", LONG[:-60], "ends in the middle"),
        ("a.TextGrid", "no", "not a TextGrid"),
        ("a.TextGrid", LONG.replace("xmax = 2.25", "xmax = 1.5"), "interval 4: ends at 1.5"),
        ("a.ctm", "x 1 0.2 so\n", "line 1: expected file"),
        ("a.ctm", "x 1 a 0.2 so\n", "line 1: time is 'a'"),
        ("a.srt", "so well", "no caption"),
        ("a.srt", "1\n00:00:xx --> 00:00:02,250\nyes\n", "no caption"),
        ("a.json", "{", "not JSON"),
        ("a.json", "[1]", "not a list of words"),
        ("a.tsv", "1 2 so", "line 1: expected start"),
        ("a.doc", "", "not a word list"),
    ],
)
def test_a_broken_word_list_is_an_error_that_names_the_file(tmp_path, name, text, complaint):
    (tmp_path / name).write_text(text)
    with pytest.raises(af.FeatureError, match=f"{name}.*{complaint}"):
        af.load_words(tmp_path / name)


def test_words_as_features(tmp_path, write_speech):
    wav = write_speech(tmp_path / "talk.wav", 3.0)
    (tmp_path / "talk.TextGrid").write_text(LONG)
    wave = af.Wave.load(wav)
    track = af.extractor_from_spec({"kind": "words"}).extract(wave)
    word, onset, gap, rate = track.values.T
    np.testing.assert_array_equal(np.flatnonzero(onset), [20, 50, 200])
    spoken = [*range(20, 100), *range(200, 225)]
    np.testing.assert_array_equal(word, np.isin(np.arange(300), spoken))
    assert gap[10] == pytest.approx(np.log1p(0.2)) and gap[150] == pytest.approx(np.log1p(1.0))
    assert gap[60] == 0 and gap[290] == pytest.approx(np.log1p(0.75))
    assert rate.sum() / 100 == pytest.approx(3, abs=0.6) and rate[40] > rate[150]
    later = af.Words().extract(af.Wave.load(wav, start=1.5))
    np.testing.assert_array_equal(np.flatnonzero(later.values[:, 1]), [50])
    cut = af.Words().extract(wave.slice(0.1, 1.0).resample(8000).at_level())
    np.testing.assert_array_equal(np.flatnonzero(cut.values[:, 1]), [10, 40])
    for start in (0.1, 0.3, 1.5):
        part = af.Words().extract(wave.slice(start)).values[:, 0]
        np.testing.assert_array_equal(part, word[round(100 * start) :])


def test_new_words_count_at_once_and_missing_ones_are_an_error(tmp_path, write_speech):
    wav = write_speech(tmp_path / "talk.wav", 3.0)
    cache, words = af.FeatureCache(tmp_path / "cache"), af.Stack([af.Words(), af.Prosody()])
    with pytest.raises(af.FeatureError, match=r"talk.wav: no word list.*STEM.TextGrid"):
        cache.extract(words, af.Wave.load(wav))
    (tmp_path / "talk.ctm").write_text("x 1 0.2 0.3 so\n")
    first = cache.extract(words, af.Wave.load(wav))
    (tmp_path / "talk.ctm").write_text("x 1 1.2 0.3 so\n")
    assert not np.array_equal(first.values, cache.extract(words, af.Wave.load(wav)).values)
    silence = af.Wave(np.zeros(16_000), 16_000)
    assert not af.Words().extract(silence).values[:, :2].any()
