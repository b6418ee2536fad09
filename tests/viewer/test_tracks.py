"""Curves and marks under the time line of the player are at the times of sound and motion."""

from dataclasses import replace

import numpy as np
import pytest
from pages import data_of

from audio_features import Wave
from gesturekit.viewer import display, page_data

RATE = 16_000


def bursts(*times: float, seconds: float = 4.0) -> Wave:
    samples = np.random.default_rng(0).normal(0, 1e-4, int(seconds * RATE)).astype(np.float32)
    for time in times:
        samples[int(time * RATE) :][:1600] += np.random.default_rng(1).normal(0, 0.3, 1600)
    return Wave(samples, RATE)


def test_onsets_are_where_the_sound_begins():
    np.testing.assert_allclose(page_data.onsets(bursts(1.0, 2.5)), [1.0, 2.5], atol=0.03)


@pytest.mark.parametrize("seconds", [4.0, 200.0])
def test_the_spectrogram_is_small_and_in_time(seconds):
    values, rate = page_data.spectrogram(bursts(0.75 * seconds, seconds=seconds))
    assert len(values) < 5_000 and values.shape[1] == page_data.BANDS
    assert len(values) / rate == pytest.approx(seconds, abs=2 / rate)
    assert np.argmax(values.sum(axis=1)) / rate == pytest.approx(0.75 * seconds, abs=0.15)


def test_motion_beats_are_the_minima_of_speed():
    time = np.arange(300) / 100
    np.testing.assert_allclose(
        page_data.speed_minima(1 + np.cos(2 * np.pi * time), 100.0), [0.5, 1.5, 2.5], atol=0.011
    )
    assert len(page_data.speed_minima(np.zeros(50), 30.0)) == 0


def test_contacts_tell_the_feet_apart(gesture, skeleton):
    motion = gesture(1.0)
    rotations = motion.rotations.copy()
    legs = [
        skeleton.index(f"{side}{joint}")
        for side in ("Left", "Right")
        for joint in ("UpLeg", "Leg", "Foot")
    ]
    rotations[:, [0, *legs]] = [0, 0, 0, 1]
    swing = np.sin(2 * np.pi * 3 * motion.times)  # the left thigh, about x
    rotations[:, skeleton.index("LeftUpLeg"), 0] = swing
    rotations[:, skeleton.index("LeftUpLeg"), 3] = np.sqrt(1 - swing**2)
    found = page_data.contact_track(replace(motion, rotations=rotations))
    assert (found & 2 == 2).all()
    assert (found & 1).mean() < 0.3


def test_notebooks_get_the_page_in_a_frame(gesture, tmp_path):
    shown = gesture(0.2).show(audio=bursts(0.1, seconds=0.5), title='a "b" <c>')
    assert "<iframe" in shown._repr_html_() and "<script" not in shown._repr_html_()
    assert len(repr(shown)) < 100
    (tmp_path / "a.html").write_text(display({"a": gesture(0.2), "b": gesture(0.2)}).page)
    assert [figure["label"] for figure in data_of(tmp_path / "a.html")["figures"]] == ["a", "b"]


def test_the_outline_is_the_peak_of_each_hundredth_of_a_second():
    samples = np.zeros(4000, np.float32)
    samples[[0, 39, 40, 2000, 3999]] = [0.1, -0.4, 0.2, -0.8, 0.6]
    found = page_data.outline(Wave(samples, 4000))
    assert len(found) == 100 and found.max() == 1
    assert found[[0, 1, 50, 99]] == pytest.approx([0.5, 0.25, 1.0, 0.75])
    assert np.count_nonzero(found) == 4
    assert page_data.outline(Wave(np.zeros(120, np.float32), 4000)).tolist() == [0, 0, 0]
