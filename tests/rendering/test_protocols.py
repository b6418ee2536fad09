"""What the papers' protocols ask of a model, of one that only writes down what it was asked."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
from rigs import at_rest, rig_of

import audio_features as af
from gesturekit.corpus import Item
from gesturekit.errors import ConfigError
from gesturekit.model import Inputs
from gesturekit.motion import Motion
from gesturekit.rendering.samples import SamplingOptions, sample_lda, sample_multires


@dataclass
class Scribe:
    """A model whose motion lasts as long as it should, at 10 fps."""

    inputs: Inputs = field(default_factory=lambda: Inputs(speech=True))
    styles: tuple[str, ...] = ()
    speakers: tuple[str, ...] = ()
    fps: float = 10.0
    asked: list[dict[str, Any]] = field(default_factory=list)

    def generate(self, speech: af.Wave | None = None, **arguments: Any) -> Motion:
        self.asked.append({"speech": speech, **arguments})
        seconds = arguments.get("seconds") if speech is None else speech.duration
        return at_rest(rig_of({"a": (None, (0, 0, 0))}), round(10 * seconds), fps=10.0)


@pytest.fixture
def item(tmp_path) -> Item:
    """From 1 s to 26 s of 27 s of sound, whose samples count the seconds."""
    path = tmp_path / "long.wav"
    soundfile.write(path, np.repeat(np.arange(27) / 30, 4000), 4000, "FLOAT")
    about = {"audio_start": 1.0, "motion_start": 0.5, "duration": 25.0}
    return Item(id="day/long", audio=path, motion=tmp_path / "long.bvh", **about)


def made(files: list[Path], out: Path) -> list[str]:
    return [file.relative_to(out).as_posix() for file in files]


def test_sequences_are_sampled_at_twice_their_length_as_often_as_in_the_paper(item, tmp_path):
    item, model, out = replace(item, duration=0.5), Scribe(), tmp_path / "out"
    files = list(sample_multires(model, [item], out, SamplingOptions(seed=7)))
    assert made(files, out) == [f"day/long_s{k + 1}.npz" for k in range(len(files))]
    assert len(files) == 200
    wave = item.load_wave()
    for number, asked in enumerate(model.asked, start=1):
        speech = asked.pop("speech")
        told = {"seed": 7, "item": f"day/long_s{number}", "fps": 10.0, "raw": True}
        assert asked.items() >= told.items()
        assert np.array_equal(speech.samples, [*wave.samples, *wave.samples])
    assert Motion.load(files[-1]).n_frames == 10


def test_windows_are_ten_seconds_each_as_often_as_in_the_paper(item, tmp_path):
    model, out = Scribe(), tmp_path / "out"
    options = SamplingOptions(controls={"raw": False, "smooth": 1})
    files = list(sample_lda(model, [item], out, options))
    names = [f"day/long_w{window:03d}_s{k}" for window in (0, 1) for k in (1, 2, 3)]
    assert made(files, out) == [f"{name}.npz" for name in names]
    assert [asked["item"] for asked in model.asked] == names
    for asked, window in zip(model.asked, np.repeat([0, 1], 3), strict=True):
        assert (asked["seed"], asked["raw"], asked["smooth"]) == (0, False, 1)
        speech = asked["speech"]
        ends = np.round(30 * speech.samples[[0, -1]]).tolist()
        assert ends == [1 + 10 * window, 10 + 10 * window] and speech.duration == 10.0


@pytest.mark.parametrize(("seconds", "n_windows"), [(9.9, 0), (10.0, 1), (19.9, 1), (20.0, 2)])
def test_windows_are_whole(tmp_path, seconds, n_windows):
    model = Scribe(Inputs(speech=False))
    whole = Item(id="a", audio=None, motion=tmp_path / "a.bvh", duration=seconds)
    items = [replace(whole, duration=3.0), whole]
    options = SamplingOptions(samples=1)
    if not n_windows:
        with pytest.raises(ConfigError, match=r"(?=.*\b10 s)(?=.*\b9\.9 s)"):
            list(sample_lda(model, items, tmp_path / "out", options))
        with pytest.raises(ConfigError, match=r"\b0(\.0)? s"):
            list(sample_lda(model, [], tmp_path / "out", options))
        return
    assert len(list(sample_lda(model, items, tmp_path / "out", options))) == n_windows
    assert {asked["seconds"] for asked in model.asked} == {10.0}
    assert all(asked["speech"] is None for asked in model.asked)


def test_every_recording_is_sampled_in_its_own_style(item, tmp_path):
    items = [replace(item, id=f"in {style}", style=style) for style in "ba"]
    for number, sample in enumerate((sample_multires, sample_lda)):
        model = Scribe(styles=("a", "b"))
        list(sample(model, items, tmp_path / str(number), SamplingOptions(samples=1)))
        styles = {asked["item"][:4]: asked["style"] for asked in model.asked}
        assert styles == {"in b": "b", "in a": "a"}


@pytest.mark.parametrize("sample", [sample_lda, sample_multires])
def test_styles_that_are_not_known_are_refused_before_sampling(item, sample, tmp_path):
    model, out = Scribe(styles=("a", "b")), tmp_path / "out"
    known, unknown = (replace(item, id=f"take {style}", style=style) for style in "ac")
    with pytest.raises(ConfigError, match=r"(?=.*take c)(?=.*\ba\b)(?=.*\bb\b)(?=.*--corpus)"):
        next(sample(model, [known, unknown], out, SamplingOptions()))
    without = [replace(item, id=f"take {k}") for k in range(4)]
    with pytest.raises(ConfigError, match="(?=.*take 0)(?=.*1 more)"):
        next(sample(model, without, out, SamplingOptions()))
    assert not model.asked and not out.exists()


def test_models_without_speech_and_items_without_sound_are_given_their_length(item, tmp_path):
    silent = Item(id="b", audio=None, motion=tmp_path / "b.bvh", duration=3.0)
    one = SamplingOptions(samples=1)
    for number, (model, given) in enumerate(((Scribe(Inputs()), item), (Scribe(), silent))):
        list(sample_multires(model, [given], tmp_path / str(number), one))
        (asked,) = model.asked
        assert asked["seconds"] == 2 * given.duration and asked["speech"] is None
