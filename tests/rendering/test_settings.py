"""What results depend on, and which of a batch's settings reach the files."""

import hashlib

import numpy as np
import pytest

import audio_features as af
from gesturekit.corpus import Item
from gesturekit.errors import GestureKitError
from gesturekit.jobs.result import Result, Task
from gesturekit.motion import Motion
from gesturekit.rendering.features import FeatureExtraction
from gesturekit.rendering.renderer import Output, Renderer, model_of_results, preview, render_batch


def renderer(model, out, output=None, channel=None, **controls) -> Renderer:
    return Renderer(model, out, output or Output(), channel, controls)


@pytest.fixture
def sound(tmp_path, write_speech):
    return write_speech(tmp_path / "a.wav", 1.5)


def test_results_depend_on_what_was_asked_for_and_on_nothing_else(model, tmp_path, sound):
    plain = renderer(model, tmp_path)
    assert plain.settings["model"] == model.fingerprint() and plain.settings["seed"] == 0
    assert renderer(model, tmp_path, seed=0, samples=1, foot_lock=None).settings == plain.settings
    assert renderer(model, tmp_path, samples=3).settings == plain.settings
    assert renderer(model, tmp_path, seed=4).settings == plain.settings | {"seed": 4}
    smplx = renderer(model, tmp_path, Output(rig="smplx")).settings
    assert smplx.keys() - plain.settings.keys() == {"rig"}
    digest = hashlib.sha256(sound.read_bytes()).hexdigest()
    task = Task("a", sound)
    assert plain.input_of(task) == {"input": digest} and plain.input_of(Task("a")) == {}
    asked = renderer(model, tmp_path, channel=1)
    assert asked.input_of(task) == {"input": digest, "channel": 1}
    own = Task("a", sound, more={"seed": 3, "start": 0.5})
    assert plain.input_of(own) == {"input": digest, "seed": 3, "start": 0.5}
    item = Item(id="a", audio=sound, motion=None, duration=1.0, audio_start=0.25, channel=1)
    of_item = plain.input_of(Task("a", sound, more={"item": item}))
    assert of_item == {"input": digest, "start": 0.25, "duration": 1.0, "channel": 1}


def test_a_task_has_its_own_seed_length_and_part_of_the_sound(model, tmp_path, sound):
    """Lengths of a model without speech input, of two settings, and of a part of a sound."""

    def frames(more: dict, path=sound, **settings) -> tuple[int, float]:
        (tmp_path / "out").mkdir(exist_ok=True)
        made = renderer(model, tmp_path / "out", Output("npz"), **settings)(
            Result(Task("a", path, more=more))
        )
        assert made.error is None and made.facts["fps"] == 25
        return Motion.load(made.files[0]).n_frames, made.sound

    assert frames({}) == (38, 1.5) and frames({"start": 0.5}) == (25, 1.0)
    assert frames({"seconds": 0.8}) == (20, 0.8)
    assert frames({"seconds": 0.8}, None) == (20, 0.8)
    paths = {}
    for seed in (0, 5):
        frames({"seed": seed})
        paths[seed] = Motion.load(tmp_path / "out" / "a.npz").rotations
    assert np.array_equal(paths[5], model.generate(sound, item="a", seed=5).rotations)
    assert not np.array_equal(paths[0], paths[5])


def test_a_preview_names_what_cannot_be_read_and_what_is_kept(model, tmp_path, sound):
    broken = tmp_path / "broken.wav"
    broken.write_text("no sound")
    out = tmp_path / "out"

    def outcomes() -> dict[str, tuple[str, bool]]:
        found = [result for result, _ in preview(render_batch(model, [sound, broken], out))]
        return {result.id: (result.status, str(broken) in (result.error or "")) for result in found}

    assert outcomes() == {"a": ("left", False), "broken": ("failed", True)}
    assert not list(out.glob("*.bvh")) and model_of_results(out) is None
    made = render_batch(model, [sound, broken], out).run()
    assert [result.status for result in made] == ["done", "failed"]
    assert outcomes() == {"a": ("kept", False), "broken": ("failed", True)}
    assert model_of_results(out) == model.folder
    ((idle, seconds),) = preview(render_batch(model, [], tmp_path / "idle", seconds=1.0))
    assert (idle.id, idle.status, seconds) == ("motion", "left", 1.0)


class Levels:
    """An extractor of one feature, the loudness of each tenth of a second."""

    spec = {"kind": "levels"}  # noqa: RUF012

    def extract(self, wave: af.Wave) -> af.FeatureTrack:
        times = np.arange(0.05, wave.duration, 0.1)
        return af.FeatureTrack(wave.rms(times)[:, None], times, names=("level",))


def extraction(out, **settings) -> FeatureExtraction:
    usual = {"fps": None, "align": None, "picture": False, "channel": None, "cache": None}
    return FeatureExtraction(Levels(), out, **usual | {"existing": "refuse"} | settings)


def test_features_are_those_of_the_part_at_the_rate_that_is_asked_for(tmp_path, sound):
    task = Task("a", sound, more={"start": 0.5})
    out = tmp_path / "out"
    out.mkdir()
    plain = extraction(out)
    made = plain(Result(task))
    assert made.error is None and made.files == (out / "a.npz",)
    assert made.facts["shape"] == (10, 1) and made.sound == 1.0
    wanted = Levels().extract(af.Wave.load(sound, start=0.5))
    assert np.array_equal(af.FeatureTrack.load(out / "a.npz").values, wanted.values)
    assert made.input["start"] == 0.5 and made.input["input"]
    faster = extraction(out, fps=25.0, picture=True, channel=1)
    made = faster(Result(task))
    assert made.error is None and [file.suffix for file in made.files] == [".npz", ".png"]
    assert made.facts["shape"] == (25, 1) and made.input["channel"] == 1
    linear = wanted.to_rate(25.0, 25, method="linear").values
    assert np.array_equal(af.FeatureTrack.load(out / "a.npz").values, linear)
    with pytest.raises(GestureKitError, match="b"):
        plain.make(Result(Task("b")))
    assert plain.settings["extractor"] == {"kind": "levels"} and faster.settings["fps"] == 25
