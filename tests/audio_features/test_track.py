import json
import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from audio_features import FeatureError, FeatureTrack, Wave
from audio_features.acoustic import ShortTimeSpectrum


@pytest.fixture
def ramp() -> FeatureTrack:
    """On WavLM's time base, each value is its own time: interpolation must give k/fps."""
    times = 0.0125 + 0.02 * np.arange(500)
    return FeatureTrack(np.stack([times, -times], 1), times, {"kind": "test"}, ("a", "b"))


def test_gaussian_has_a_standard_deviation_of_one_motion_frame():
    # exp(-k²/2) over its sum: 1, .6065, .1353, .0111 of 2.5066.
    bell = np.array([0.3989, 0.2420, 0.0540, 0.0044])
    values = np.zeros((30, 3), np.float32)
    values[10, 0] = values[0, 1] = 1.0
    values[:, 2] = 7.0
    smooth = FeatureTrack(values, np.arange(30) / 25).to_rate(25, method="gaussian").values
    np.testing.assert_allclose(smooth[10:14, 0], bell, atol=2e-4)
    np.testing.assert_allclose(smooth[10:6:-1, 0], bell, atol=2e-4)
    # Before the first frame its value goes on: half of the bell and of its middle.
    np.testing.assert_allclose(smooth[:4, 1], [0.6995, 0.3005, 0.0585, 0.0045], atol=2e-4)
    np.testing.assert_allclose(smooth[:, 2], 7.0, rtol=1e-6)


def test_mean_averages_what_lies_within_each_motion_frame(ramp):
    track = ramp.to_rate(10.0, n_frames=100, method="mean")
    # Frame 0 has the rows at 12.5 and 32.5 ms, frame 1 those from 52.5 to 132.5 ms.
    assert track.values[[0, 1, 50], 0] == pytest.approx([0.0225, 0.0925, 4.9925], abs=1e-5)
    # A rate above the track's own leaves frames with nothing to average: they interpolate.
    mean, line = (ramp.to_rate(200.0, 1500, method=how).values for how in ("mean", "linear"))
    np.testing.assert_allclose(mean[10:, 0], line[10:, 0], atol=0.004)


@settings(max_examples=30, deadline=None)
@given(
    n=st.integers(4_800, 100_000),
    rate=st.sampled_from([8_000, 11_025, 16_000, 22_050, 44_100, 48_000]),
    fps=st.sampled_from([12.5, 20, 23.976, 24, 25, 29.97, 30, 50, 60, 119.88, 120]),
    at=st.floats(0.05, 0.95),
    base=st.sampled_from(["light", "WavLM's"]),
)
@example(n=4800, rate=16_000, fps=25, at=0.95, base="WavLM's")
def test_frame_count_and_frame_times(n, rate, fps, at, base):
    """Rows follow from the sample count alone, and a click is in the row of its time."""
    samples = np.zeros(n, np.float32)
    click = round(at * n) / rate
    samples[round(at * n)] = 1.0
    wave = Wave(samples, rate)
    rows = math.floor(Fraction(n, rate) * Fraction(fps).limit_denominator(1001) + Fraction(1, 2))
    assume(click < (rows - 0.5) / fps - 0.0125)  # what is later belongs to no row
    if base == "light":  # 25 ms every 10 ms, as all acoustic features see the sound
        spectrum = ShortTimeSpectrum(wave)
        energy, times = spectrum.power.sum(axis=1), spectrum.times
    else:  # 25 ms every 20 ms, as WavLM sees it
        short = np.lib.stride_tricks.sliding_window_view(wave.resample(16_000).samples, 400)[::320]
        energy = np.square(short * np.hanning(400)).sum(axis=1)
        times = 0.0125 + 0.02 * np.arange(len(short))
        assume(click < times[-1])  # up to 20 ms at the end are in no frame
    track = FeatureTrack(energy[:, None], times).to_rate(fps, wave.n_frames(fps), method="mean")
    assert len(track.values) == rows
    row = int(np.argmax(track.values[:, 0]))
    # Half a motion frame, and half of what a frame of features sees; WavLM's first frame stands
    # for all that is before its centre.
    seen = 0.0125 if base == "light" else 0.025
    assert abs(row / fps - click) <= 0.5 / fps + seen + 1e-6


def test_a_feature_file_gives_back_what_was_saved(ramp, tmp_path):
    path = tmp_path / "sub" / "a.npz"
    ramp.save(path)
    again = FeatureTrack.load(path)
    np.testing.assert_array_equal(again.values, ramp.values)
    np.testing.assert_array_equal(again.times, ramp.times)
    assert (again.spec, again.names) == (ramp.spec, ramp.names)
    assert [entry.name for entry in path.parent.iterdir()] == ["a.npz"]
    with np.load(path, allow_pickle=False) as file:
        np.testing.assert_array_equal(file["values"], ramp.values)
        assert json.loads(str(file["spec"]))["kind"] == "test"


def test_files_that_are_none_are_refused_by_name(ramp, tmp_path):
    path = tmp_path / "a.npz"
    values, objects = np.zeros((2, 2)), np.array([{}, {}], dtype=object)
    about = {"times": np.arange(2.0), "spec": np.array("{}")}
    for write, says in (
        (lambda: None, ""),
        (lambda: path.write_text("text"), ""),
        (lambda: np.savez(path, values=objects, **about), "'values'"),
        (lambda: np.savez(path, values=values[:1], **about), r"(?=.*\(1, 2\)).*\(2,\)"),
        (lambda: np.savez(path, values=values, **about | {"spec": '{"format": 2}'}), "format 2"),
        (lambda: ramp.save(path) or path.write_bytes(path.read_bytes()[:-2000]), ""),
    ):
        write()
        with pytest.raises(FeatureError, match=f"{path}.*{says}"):
            FeatureTrack.load(path)


def test_one_frame_holds_for_all_times_and_shapes_must_agree():
    one = FeatureTrack([[1, 2]], [0.5])
    np.testing.assert_array_equal(one.at([-1.0, 0.5, 9.0]).values, [[1, 2]] * 3)
    np.testing.assert_array_equal(one.to_rate(2, 3, method="mean").values, [[1, 2]] * 3)
    assert len(one.to_rate(2).values) == 2 and one.names == ("0", "1")
    for values, times, names, says in (
        ([1, 2], [0, 1], (), r"values.*\(2,\)"),
        ([[1, 2]], [0], ("a",), r"(?=.*\b1\b).*\b2\b"),
        ([[1], [2]], [0, 0], (), "ascend"),
    ):
        with pytest.raises(FeatureError, match=says):
            FeatureTrack(values, times, {}, names)
    with pytest.raises(FeatureError, match=r"(?=.*'1')(?=.*frame 0)(?=.*-3e\+39).*1e\+18"):
        FeatureTrack([[0, -3e39]], [0])
