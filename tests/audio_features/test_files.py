"""Features of a user's own, from files: their place, their time, and what is wrong with them."""

import io

import numpy as np
import pytest
import soundfile

import audio_features as af

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
        # Hardly more of the file than the part.
        assert len(track.times) / rate < (seconds or 8.0 - begin) + 1.0


@pytest.mark.parametrize(
    ("first", "last", "is_read"),
    [(0.0, 7.5, True), (0.5, 8.0, True), (0.0, 8.5, True), (0.0, 5.0, False), (3.0, 8.0, False)],
)
def test_rows_may_miss_a_second_of_the_sound(talk, caplog, first, last, is_read):
    times = np.arange(first, last + 0.1, 0.25)
    times = times[(times < 3.1) | (times > 4.9)]  # a hole does not make the frames longer
    np.savez(talk.with_suffix(".npz"), values=times[:, None], times=times)
    own, wave = af.Files(1), af.Wave.load(talk)
    if is_read:
        assert own.extract(wave).at([4.0]).values == [[4.0]] and not caplog.text
    else:
        with pytest.raises(af.FeatureError, match=rf"(?=.*\b{first})(?=.*\b{last}).*\b8\.0"):
            own.extract(wave)


def test_an_npz_has_times_of_its_own(talk):
    times = np.array([0.0, 0.5, 0.75, 3.0, 7.9])
    np.savez(talk.with_suffix(".npz"), values=np.stack([times, 2 * times], axis=1), times=times)
    track = af.Files(2).extract(af.Wave.load(talk, start=1.0))
    np.testing.assert_allclose(track.at([0.0, 1.5, 4.0]).values[:, 1], [2.0, 5.0, 10.0], rtol=1e-6)


def test_a_csv_has_seconds_and_columns_and_may_stand_for_the_sound(talk):
    """Beside the sound, or in its place: then it is 8 s long, 7.5 s and the step of 0.5 s."""
    file = talk.with_suffix(".csv")
    rows = [f"{k / 2},{k},{-k * 1e-3}" for k in range(16)]
    file.write_text("seconds,Chroma,Flux\n" + "\n".join(rows))
    beside = af.Files(2, ".csv").extract(af.Wave.load(talk, start=1.0))
    np.testing.assert_allclose(beside.at([0.25]).values, [[2.5, -2.5e-3]], rtol=1e-6)
    wave = af.Wave.load(file)
    assert wave.duration == 8.0 and wave.is_silent
    alone = af.Files(2, folder=talk.parent).extract(af.Wave.load(file, start=1.0, duration=2.0))
    np.testing.assert_allclose(alone.at([0.25]).values, [[2.5, -2.5e-3]], rtol=1e-6)
    assert len(alone.times) <= 6  # of 16


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("seconds,a\n", "no rows"),
        ("seconds,a\n0,0 days\n", "0 days"),
        ("seconds,a\n0,1 # late\n", "1 # late"),
        ("seconds,a\n0,1\n1,2,3\n", "row 2"),
        ("seconds,a\n1,1\n0,2\n", "ascend"),
        ("seconds,a\n0,1\n1,nan\n", "nan"),
    ],
)
def test_a_wrong_csv_is_one_error(tmp_path, text, complaint):
    (tmp_path / "x.csv").write_text(text)
    with pytest.raises(af.FeatureError, match=f"x.csv.*{complaint}"):
        af.FeatureTrack.load(tmp_path / "x.csv")
    with pytest.raises((af.FeatureError, af.AudioError), match="x.csv"):
        af.Files(1).extract(af.Wave.load(tmp_path / "x.csv"))


def test_the_nearest_file_in_a_folder_counts(talk, tmp_path):
    folder, wave = tmp_path / "own", af.Wave.load(talk)
    folder.mkdir()
    spec = {"kind": "files", "dim": 1, "rate": 1, "folder": str(tmp_path)}
    own = af.extractor_from_spec(spec, weights={"files": folder})  # the argument counts
    assert "folder" not in own.spec and af.extractor_from_spec(own.spec).spec == own.spec
    with pytest.raises(af.FeatureError, match="(?=.*talk.wav)(?=.*talk.npy).*own"):
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
        (of_rows(clock(8, 50)[:, :1]), r"\(400, 1\).*\(T, 2\)"),
        (of_rows(with_nan()), "(?=.*row 120)(?=.*column 1).*nan"),
        (of_rows(np.full((400, 2), 1e300)), r"(?=.*row 0)(?=.*column 0)(?=.*1e\+300).*1e\+18"),
        (of_rows(clock(8, 25)), r"(?=.*\b200\b)(?=.*3\.98).*\b8\.0"),
        (of_rows(np.array([{}, {}])), "numpy.save"),
        (HUGE, "numpy.save"),
        (b"not an array", "numpy.save"),
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
        ({"values": clock(8, 4)}, "'times'"),
        ({"values": clock(8, 4), "times": np.zeros(32)}, "ascend"),
        ({"values": clock(8, 4), "times": np.arange(31) / 4}, r"(?=.*\(32, 2\)).*\(31,\)"),
    ],
)
def test_a_wrong_npz_says_what_is_missing(talk, arrays, complaint):
    np.savez(talk.with_suffix(".npz"), **arrays)
    with pytest.raises(af.FeatureError, match=f"(?=.*talk.npz)(?=.*talk.wav).*{complaint}"):
        af.Files(2).extract(af.Wave.load(talk))


@pytest.mark.parametrize(
    "settings, complaint",
    [
        ({"dim": 0}, r"(?=.*dim).*\b0"),
        ({}, r"(?=.*dim).*\b0"),
        ({"dim": 4, "suffix": ".npy"}, r"(?=.*rate).*\.npy"),
        ({"dim": 4, "folder": "nowhere"}, "nowhere"),
        ({"dim": 65_537}, "(?=.*dim).*65537"),
        ({"dim": 4, "suffix": "npz"}, "(?=.*suffix).*npz"),
        ({"dim": 4, "suffix": ".d/a.npz"}, "(?=.*suffix).*a.npz"),
        ({"dim": 4, "rate": 9e-4}, "(?=.*rate).*0.0009"),
        ({"dim": 4, "rate": 1_000_001}, "(?=.*rate).*1000001"),
        ({"dim": 4, "start": float("inf")}, "(?=.*start).*inf"),
    ],
)
def test_wrong_settings_say_what_to_give(settings, complaint):
    with pytest.raises((af.FeatureError, af.WeightsError), match=complaint):
        af.extractor_from_spec({"kind": "files", **settings})
    af.extractor_from_spec({"kind": "files", "dim": 65_536, "rate": 1_000_000, "start": -1})
    af.extractor_from_spec({"kind": "files", "dim": 1, "rate": 0.001, "suffix": ".a.NPY"})
