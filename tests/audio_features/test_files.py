"""Features of a user's own, from files: their place, their time, and what is wrong with them."""

from __future__ import annotations

import io

import numpy as np
import pytest
import soundfile

import audio_features as af
from audio_features.files import open_npy

RATE = 16_000


@pytest.fixture
def talk(tmp_path):
    """A sound of 8 s in data/s1."""
    path = tmp_path / "data" / "s1" / "talk.wav"
    path.parent.mkdir(parents=True)
    soundfile.write(path, 0.1 * np.sin(np.arange(8 * RATE) * 0.1), RATE)
    return path


def clock(seconds: float, rate: float, start: float = 0.0) -> np.ndarray:
    """Return rows of (time, -time), so that a value says at which second of the file it is."""
    times = start + np.arange(round(seconds * rate)) / rate
    return np.stack([times, -times], axis=1)


@pytest.mark.parametrize("rate, start", [(50, 0.0), (50, 0.0125), (12.5, 0.25), (200, -0.1)])
def test_rows_of_an_npy_are_at_their_true_times_in_any_part_of_the_sound(talk, rate, start):
    np.save(talk.with_suffix(".npy"), clock(8.2, rate, start))
    own = af.Files(2, rate=rate, start=start)
    for begin, seconds in ((0.0, None), (1.5, 3.0), (6.9, None)):
        track = own.extract(af.Wave.load(talk, start=begin, duration=seconds))
        seen = np.arange(0.3, (seconds or 8.0 - begin) - 0.1, 0.04)
        np.testing.assert_allclose(track.at(seen).values[:, 0], seen + begin, atol=1e-4)
        # No more of the file than the part, and a row on each side.
        assert len(track.times) <= (seconds or 8.0 - begin) * rate + 0.2 * rate + 3


def test_a_part_has_the_rows_within_it_and_one_beside_each_end(talk):
    np.save(talk.with_suffix(".npy"), clock(8, 4))
    own = af.Files(2, rate=4)
    for start, duration, first, last in ((1.0, 2.0, 4, 12), (1.1, 2.0, 4, 13), (0.0, 0.5, 0, 2)):
        track = own.extract(af.Wave.load(talk, start=start, duration=duration))
        rows = np.arange(first, last + 1)
        np.testing.assert_allclose(track.times, rows / 4 - start, atol=1e-9)
        np.testing.assert_array_equal(track.values[:, 1], -rows / 4)
        assert track.spec == own.spec and track.names == ("files.npy_0", "files.npy_1")
    np.save(talk.with_suffix(".npy"), with_nan())
    with pytest.raises(af.FeatureError, match="row 120, column 1: nan"):
        af.Files(2, rate=50).extract(af.Wave.load(talk, start=2.0))


@pytest.mark.parametrize(
    ("first", "last", "is_read", "is_warned"),
    [
        # Half a second, and two frames of a quarter of a second each: 1 s.
        (0.0, 7.0, True, False),
        (0.0, 6.75, False, False),
        (1.0, 8.0, True, False),
        (1.25, 8.0, False, False),
        (0.0, 9.0, True, False),
        (0.0, 9.25, True, True),
    ],
)
def test_rows_may_miss_a_second_of_the_sound(talk, caplog, first, last, is_read, is_warned):
    times = np.arange(first, last + 0.1, 0.25)
    times = times[(times < 2.1) | (times > 5.9)]  # a hole does not make the frames longer
    np.savez(talk.with_suffix(".npz"), values=times[:, None], times=times)
    own, wave = af.Files(1), af.Wave.load(talk)
    if is_read:
        assert own.extract(wave).at([4.0]).values == [[4.0]]
    else:
        with pytest.raises(af.FeatureError, match="check the rate and the file"):
            own.extract(wave)
    assert bool(caplog.text) == is_warned


def test_only_silence_needs_no_file():
    own = af.Files(3, rate=10)
    silence = own.extract(af.Wave(np.zeros(16_000, np.float32), RATE))
    np.testing.assert_array_equal(silence.at([0.0, 0.7]).values, np.zeros((2, 3)))
    assert silence.times.tolist() == [0.0]
    with pytest.raises(af.FeatureError, match="the sound is no file"):
        own.extract(af.Wave(np.ones(16_000, np.float32).cumsum() % 7 / 10, RATE))


def test_settings_are_stored_as_far_as_they_are_not_the_usual_ones():
    own = af.Files(2, rate=50, start=0.5, centred=True)
    spec = {"kind": "files", "dim": 2, "suffix": ".npy", "rate": 50, "start": 0.5, "centred": True}
    assert own.spec == spec and own.centred == (True, True)
    usual = af.Files(65_536, ".hubert.NPZ")
    assert usual.spec == {"kind": "files", "dim": 65_536, "suffix": ".hubert.NPZ"}
    assert usual.centred == (False,) * 65_536
    assert [af.Files(1, rate=rate).rate for rate in (0.001, 1e6)] == [0.001, 1e6]


def test_an_npz_has_times_of_its_own(talk):
    times = np.array([0.0, 0.5, 0.75, 3.0, 7.9])
    np.savez(talk.with_suffix(".npz"), values=np.stack([times, 2 * times], axis=1), times=times)
    track = af.Files(2).extract(af.Wave.load(talk, start=1.0))
    np.testing.assert_allclose(track.at([0.0, 1.5, 4.0]).values[:, 1], [2.0, 5.0, 10.0], rtol=1e-6)


def test_the_nearest_file_in_a_folder_counts(talk, tmp_path):
    folder, wave = tmp_path / "own", af.Wave.load(talk)
    folder.mkdir()
    spec = {"kind": "files", "dim": 1, "rate": 1, "folder": str(tmp_path)}
    own = af.extractor_from_spec(spec, weights={"files": folder})  # the argument counts
    assert "folder" not in own.spec and af.extractor_from_spec(own.spec).spec == own.spec
    with pytest.raises(af.FeatureError, match=r"talk.wav: no file of features talk.npy in .*own"):
        own.extract(wave)
    for place, value in (("talk.npy", 1), ("s1/talk.npy", 2), ("data/s1/talk.npy", 3)):
        (folder / place).parent.mkdir(exist_ok=True, parents=True)
        np.save(folder / place, np.full((8, 1), value))
        assert own.extract(wave).values[0] == value


def test_arrays_of_other_shapes(talk):
    wave, file = af.Wave.load(talk), talk.with_suffix(".own.npy")
    own = af.Files(3, ".own.npy", rate=10)
    np.save(file, np.arange(240.0).reshape(3, 80))  # (D, T), as librosa returns
    np.testing.assert_array_equal(own.extract(wave).values[5], [5, 85, 165])
    np.save(file, np.array([1, 2, 3], dtype=np.int16))  # one embedding of the whole sound
    np.testing.assert_array_equal(own.extract(wave).at([0.0, 7.0]).values, [[1, 2, 3]] * 2)
    np.save(file, np.zeros(80, np.float16))
    assert af.Files(1, ".own.npy", rate=10).extract(wave).values.shape == (80, 1)


def of_rows(rows: object) -> bytes:
    out = io.BytesIO()
    np.save(out, rows, allow_pickle=True)
    return out.getvalue()


def with_nan() -> np.ndarray:
    rows = clock(8, 50)
    rows[120, 1] = np.nan
    return rows


HUGE = of_rows(np.zeros((1, 2))).replace(b"(1, 2), }           ", b"(999999999999, 2), }")


@pytest.mark.parametrize(
    "content, complaint",
    [
        (of_rows(clock(8, 50)[:, :1]), r"shape \(400, 1\): expected \(T, 2\)"),
        (of_rows(clock(8, 100)[:, None]), r"shape \(800, 1, 2\)"),
        (of_rows(np.zeros(400)), r"shape \(400,\): expected \(T, 2\)"),
        (of_rows(np.zeros((0, 2))), "T > 0"),
        (of_rows(with_nan()), "row 120, column 1: nan"),
        (
            of_rows(np.full((400, 2), 1e300)),
            r"row 0, column 0: 1e\+300 is not finite, or beyond 1e\+18",
        ),
        (of_rows(np.full((400, 2), 3e38, np.float32)), r"column 0: 3e\+38 is"),
        (
            of_rows(clock(8, 25)),
            r"200 rows are from 0.00 to 3.98 s, the sound is from 0.00 to 8.00",
        ),
        (of_rows(np.array([{}, {}])), "plain numbers"),
        (of_rows(np.array(["a", "b"])), "holds <U1, not numbers"),
        (of_rows(clock(8, 50))[:-40], "not a whole npy"),
        (HUGE, "not a whole npy"),
        (b"", "not a whole npy"),
        (b"not an array", "write it with numpy.save"),
    ],
)
def test_a_wrong_file_is_an_error_that_names_file_and_sound(talk, content, complaint):
    talk.with_suffix(".npy").write_bytes(content)
    with pytest.raises(af.FeatureError, match=complaint) as error:
        af.Files(2, rate=50).extract(af.Wave.load(talk))
    assert str(talk) in str(error.value) and str(talk.with_suffix(".npy")) in str(error.value)


@pytest.mark.parametrize(
    "arrays, complaint",
    [
        ({"values": clock(8, 4)}, "no key 'times'"),
        ({"rotations": clock(8, 4)}, "no key 'values'"),
        ({"values": clock(8, 4), "times": np.zeros(32)}, "ascend"),
        ({"values": clock(8, 4), "times": np.arange(31) / 4}, r"\(32, 2\) and times \(31,\)"),
    ],
)
def test_a_wrong_npz_says_what_is_missing(talk, arrays, complaint):
    np.savez(talk.with_suffix(".npz"), **arrays)
    with pytest.raises(af.FeatureError, match=rf"talk.npz, features of .*talk.wav: .*{complaint}"):
        af.Files(2).extract(af.Wave.load(talk))


def test_features_that_go_on_after_the_sound_are_warned_about(talk, caplog):
    """A wrong rate, or an encoder that fills up to 30 s, gives too many."""
    np.save(talk.with_suffix(".npy"), clock(30, 50))
    own = af.Files(2, rate=50)
    assert own.extract(af.Wave.load(talk)).at([4.0]).values[0, 0] == pytest.approx(4.0)
    with pytest.raises(FileNotFoundError):
        open_npy(talk.with_suffix(".no"))
    assert "rows end at 29.98 s" in caplog.text and "at 8.00 s; check the rate" in caplog.text
    caplog.clear()
    np.save(talk.with_suffix(".npy"), clock(8, 50))
    own.extract(af.Wave.load(talk, start=1.0, duration=2.0))  # a part of the sound is no reason
    assert not caplog.text


@pytest.mark.parametrize(
    "settings, complaint",
    [
        ({}, "no dim is given: give the number of columns"),
        ({"dim": 0}, "dim is 0"),
        ({"dim": 4, "suffix": ".npy"}, r"no rate is given: give the rows per second of \*.npy"),
        ({"dim": 4, "suffix": "/../x.npy", "rate": 50}, "suffix"),
        ({"dim": 4, "suffix": ".mat"}, "suffix is '.mat'"),
        ({"dim": 4, "rate": float("nan")}, "rate is nan"),
        ({"dim": 4, "rate": 1e-300}, "rate is 1e-300"),
        ({"dim": 4, "rate": 1.1e6}, "rate is 1100000"),
        ({"dim": 4, "rate": True}, "rate is True"),
        ({"dim": 65_537}, "dim is 65537"),
        ({"dim": 4, "start": float("nan")}, "start is nan"),
        ({"dim": 4, "centred": 1}, "centred 1"),
        ({"dim": 4, "suffix": "x.npz"}, "suffix is 'x.npz'"),
        ({"dim": 4, "suffix": 3}, "suffix is 3"),
        ({"dim": 4, "folder": "nowhere"}, "nowhere: no such folder"),
        ({"dim": 4, "width": 4}, "width"),
    ],
)
def test_wrong_settings_say_what_to_give(settings, complaint):
    with pytest.raises((af.FeatureError, af.WeightsError), match=complaint):
        af.extractor_from_spec({"kind": "files", **settings})


def test_a_single_path_is_that_of_the_encoder_if_there_is_one(talk, tmp_path, monkeypatch):
    given = []
    monkeypatch.setattr(af.WavLM, "from_spec", lambda *spec: given.append(spec) or af.LogMel())
    np.save(talk.with_suffix(".npy"), clock(8, 50))
    parts = [{"kind": "wavlm"}, {"kind": "files", "dim": 2, "rate": 50}]
    stack = af.extractor_from_spec({"kind": "stack", "parts": parts}, weights=tmp_path)
    assert [place for _, place, _ in given] == [tmp_path] and stack.parts[1].folder is None
    values = stack.extract(af.Wave.load(talk)).values
    assert values.shape[1] == stack.dim and values[400, -2] == pytest.approx(4.0, abs=0.05)
