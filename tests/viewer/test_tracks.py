"""Curves and marks under the time line of the player are at the times of sound and motion."""

from __future__ import annotations

import base64
import io
import json
from dataclasses import replace

import numpy as np
import pytest
import soundfile
from rigs import PERSON, at_rest, rig_of

from audio_features import AudioError, Wave
from gesturekit.viewer import display, page_data, player_data, sound
from gesturekit.viewer.figure import Figure

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
    assert len(values) <= 3_000 and values.shape[1] == page_data.BANDS
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


def test_a_body_without_legs_has_no_contacts(skeleton):
    """One that stands has both feet on the ground."""
    trunk = {name: bone for name, bone in PERSON.items() if not name.endswith(("Leg", "Foot"))}
    assert page_data.contact_track(at_rest(rig_of(trunk), 5)) is None
    assert page_data.contact_track(at_rest(skeleton, 5, (0, 0.94, 0))).tolist() == [3] * 5


def test_notebooks_get_the_page_in_a_frame(gesture):
    shown = gesture(0.2).show(audio=bursts(0.1, seconds=0.5), title='a "b" <c>')
    assert shown._repr_html_().startswith("<iframe srcdoc=")
    assert "<script" not in shown._repr_html_() and "&lt;script" in shown._repr_html_()
    assert len(repr(shown)) < 100
    assert display({"a": gesture(0.2), "b": gesture(0.2)}).page.count('"label":') == 2


def test_the_spectrogram_ends_as_it_goes_on():
    """The last column has one instead of two of the extractor's frames if their number is odd."""
    noise = np.random.default_rng(0).normal(0, 0.1, 16_000).astype(np.float32)
    ends = []
    for n in (15_840, 16_000):
        values, rate = page_data.spectrogram(Wave(noise[:n], 16_000))
        assert values.min() == 0 and values.max() == 1 and values.shape[1] == page_data.BANDS
        assert len(values) / rate == pytest.approx(n / 16_000, abs=0.02)
        ends.append(abs(np.median(values[-1]) - np.median(values)))
    assert max(ends) < 0.2


def test_the_outline_is_the_peak_of_each_hundredth_of_a_second():
    samples = np.zeros(4000, np.float32)
    samples[[0, 39, 40, 2000, 3999]] = [0.1, -0.4, 0.2, -0.8, 0.6]
    found = sound.outline(Wave(samples, 4000))
    assert len(found) == 100 and found.max() == 1
    assert found[[0, 1, 50, 99]] == pytest.approx([0.5, 0.25, 1.0, 0.75])
    assert np.count_nonzero(found) == 4
    assert sound.outline(Wave(np.zeros(120, np.float32), 4000)).tolist() == [0, 0, 0]


def test_files_up_to_the_limit_are_embedded_as_they_are(tmp_path, monkeypatch):
    path = tmp_path / "a.wav"
    wave = bursts(0.1, seconds=0.5)
    soundfile.write(path, wave.samples, wave.sample_rate, "PCM_16")
    size = path.stat().st_size
    monkeypatch.setattr(sound, "EMBED_LIMIT", size)
    assert sound.Sound.of(path) == sound.Sound(path.read_bytes(), "audio/wav")
    monkeypatch.setattr(sound, "EMBED_LIMIT", size - 1)
    flac = sound.Sound.of(path)
    assert flac.type == "audio/flac" and len(flac.data) < size
    again, rate = soundfile.read(io.BytesIO(flac.data))
    assert rate == wave.sample_rate and again == pytest.approx(
        np.clip(wave.samples, -1, 1), abs=2e-4
    )
    monkeypatch.setattr(sound, "EMBED_LIMIT", len(flac.data) - 1)
    assert sound.Sound.of(path).type == "audio/mpeg"


@pytest.mark.parametrize(
    ("given", "rate"), [(8000, 16_000), (16_000, 16_000), (22_050, 22_050), (96_000, 48_000)]
)
def test_long_recordings_have_the_next_rate_of_mp3(monkeypatch, given, rate):
    monkeypatch.setattr(sound, "EMBED_LIMIT", 100)
    tone = 0.5 * np.sin(2 * np.pi * 440 * np.arange(given) / given)
    found = sound.Sound.of(Wave(tone.astype(np.float32), given))
    assert found.type == "audio/mpeg"
    samples, own = soundfile.read(io.BytesIO(found.data))
    assert own == rate and samples.ndim == 1
    spectrum = np.abs(np.fft.rfft(samples[:rate]))
    assert spectrum.argmax() == 440


@pytest.mark.parametrize("given", [3, None, (np.zeros(3),), (np.zeros(3), 8000, 1)])
def test_what_is_no_sound_is_refused(given):
    with pytest.raises(AudioError, match="give a file, a Wave, or"):
        sound.as_sound(given)


def test_a_page_holds_what_the_figure_is(gesture):
    """Numbers of limbs have four digits, speeds are bytes, colours are those of the labels."""
    motion, wave = gesture(1.0), bursts(0.4, 0.8, seconds=1.2)
    motions = {"one": motion, "two": motion.scaled(2.0)}
    page = json.loads(player_data(motions, wave, colours={"two": "#123456"}))
    figure = Figure.of(motion)
    assert page["format"] == 1 and page["below"] == 0.0
    assert page["height"] == pytest.approx(2 * figure.extent)
    one, two = page["figures"]
    assert ("ink" in one, two["ink"]) == (False, "#123456")
    plain = {"label": "one", "fps": 30.0, "n_frames": 30, "n_joints": 19, "hands": [*figure.hands]}
    plain |= {"n_points": figure.points.shape[1], "head": vars(figure.head)}
    assert {key: one[key] for key in plain} == plain
    assert (one["floor"], one["front"]) == pytest.approx((figure.floor, figure.front))
    for found, limb in zip(one["limbs"], figure.limbs, strict=True):
        assert [*found["radii"], found["length"]] == pytest.approx([*limb.radii, limb.length], 5e-4)
        assert all(len(f"{x:g}".replace(".", "").lstrip("0")) <= 4 for x in found["radii"])
        across = limb.across and [*limb.across]
        rest = {"ends": [*limb.ends], "side": limb.side, "across": across, "width": limb.width}
        assert {key: found[key] for key in rest} == rest
    contacts = np.frombuffer(base64.b64decode(one["contacts"]), np.uint8)
    assert (contacts == page_data.contact_track(motion)).all()
    minima = page_data.speed_minima(figure.hand_speed, 30.0)
    assert one["beats"] == [round(second, 3) for second in minima.tolist()]
    assert one["speed"]["of"] == "hand speed"
    assert one["speed"]["peak"] == pytest.approx(figure.top_speed)
    levels = np.frombuffer(base64.b64decode(one["speed"]["values"]), np.uint8)
    shares = np.minimum(figure.hand_speed / figure.top_speed, 1)
    assert np.abs(levels - 255 * shares).max() <= 0.5
    speech = page["speech"]
    assert (speech["duration"], speech["rate"]) == (pytest.approx(1.2), 100)
    assert speech["onsets"] == [round(t, 3) for t in page_data.onsets(wave).tolist()]
    values, rate = page_data.spectrogram(wave)
    assert (speech["spectrum"]["bands"], speech["spectrum"]["rate"]) == (page_data.BANDS, rate)
    found = np.frombuffer(base64.b64decode(speech["spectrum"]["values"]), np.uint8)
    assert np.abs(found.reshape(values.shape) - 255 * values).max() <= 0.51
    assert base64.b64decode(page["audio"]["data"]) == sound.Sound.of(wave).data
    silent = json.loads(player_data(motion))
    assert not silent.keys() & {"speech", "audio"} and silent["figures"][0]["label"] == ""
    bent = json.loads(player_data(motions, framing="waist"))
    assert bent["below"] == pytest.approx(2 * figure.below("waist"))
