"""What results depend on, and which of a batch's settings reach the files."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np
import pytest
import soundfile

import audio_features as af
from gesturekit.corpus import Item
from gesturekit.errors import ConfigError, FormatError, GestureKitError
from gesturekit.jobs.result import Result
from gesturekit.jobs.run import Execution
from gesturekit.jobs.task import Task
from gesturekit.motion import Motion
from gesturekit.rendering.batch import (
    Cost,
    iter_render,
    measured_cost,
    model_of_results,
    preview,
    render_batch,
)
from gesturekit.rendering.features import FeatureExtraction
from gesturekit.rendering.inputs import sound_batch
from gesturekit.rendering.renderer import Output, Renderer


def renderer(model, out, output=None, seconds=None, channel=None, **controls) -> Renderer:
    return Renderer(model, out, output or Output(), seconds, channel, controls)


@pytest.fixture
def sound(tmp_path, write_speech):
    return write_speech(tmp_path / "a.wav", 1.5)


def test_formats_are_named_in_any_way_and_unknown_ones_are_refused(model, tmp_path):
    for formats in ("bvh,npz", " .BVH,npz,,bvh", ("bvh", ".npz")):
        assert list(renderer(model, tmp_path, Output(formats)).written) == ["bvh", "npz"]
    for formats, says in (
        ("c3d", "format c3d: known: bvh, npz"),
        ("", r"format \(none\): known"),
        ("svg", "format svg: .*; gesturekit convert x.bvh x.svg writes it"),
    ):
        with pytest.raises(ConfigError, match=says):
            renderer(model, tmp_path, Output(formats))


def test_results_depend_on_what_was_asked_for_and_on_nothing_else(model, tmp_path, sound):
    plain = renderer(model, tmp_path)
    assert plain.settings == {"model": model.fingerprint(), "seed": 0}
    assert renderer(model, tmp_path, seed=0, samples=1, foot_lock=None).settings == plain.settings
    assert renderer(model, tmp_path, samples=3).settings == plain.settings
    assert renderer(model, tmp_path, seed=4).settings == plain.settings | {"seed": 4}
    smplx = renderer(model, tmp_path, Output(rig="smplx")).settings
    assert smplx.keys() - plain.settings.keys() == {"rig"}
    digest = hashlib.sha256(sound.read_bytes()).hexdigest()
    task = Task("a", sound)
    assert plain.input_of(task) == {"input": digest} and plain.input_of(Task("a")) == {}
    asked = renderer(model, tmp_path, seconds=2.0, channel=1)
    assert asked.input_of(task) == {"input": digest, "seconds": 2.0, "channel": 1}
    own = Task("a", sound, more={"seed": 3, "start": 0.5})
    assert plain.input_of(own) == {"input": digest, "seed": 3, "start": 0.5}
    item = Item(id="a", audio=sound, motion=None, duration=1.0, audio_start=0.25, channel=1)
    of_item = plain.input_of(Task("a", sound, more={"item": vars_of(item)}))
    assert of_item == {"input": digest, "start": 0.25, "duration": 1.0, "channel": 1}


def vars_of(item: Item) -> dict:
    """Return an item as a plan holds it."""
    return vars(item) | {"audio": str(item.audio), "conditions": {}, "audible": []}


def test_samples_have_numbers_from_one_on(model, tmp_path):
    assert renderer(model, tmp_path).stems(Task("day/a")) == ["day/a"]
    assert renderer(model, tmp_path, samples=2).stems(Task("day/a")) == ["day/a_s1", "day/a_s2"]


def test_a_speaker_is_known_if_there_is_one_or_one_was_named(model, tmp_path, sound):
    one = renderer(replace(model, speakers={"anna": model.skeleton}), tmp_path)
    assert one.has_speaker(Task("a", sound)) and renderer(model, tmp_path).has_speaker(Task("a"))
    both = replace(model, speakers={"anna": model.skeleton, "ben": model.skeleton})
    two = renderer(both, tmp_path)
    item = Item(id="a", audio=sound, motion=None, duration=1.0)
    for speaker, is_known in (("ben", True), ("carl", False), (None, False)):
        task = Task("a", sound, more={"speaker": speaker})
        of_item = Task("a", sound, more={"item": vars_of(replace(item, speaker=speaker))})
        assert two.has_speaker(task) is two.has_speaker(of_item) is is_known
    assert renderer(both, tmp_path, speaker="anna").has_speaker(Task("a", sound))


def test_a_task_has_its_own_seed_length_and_part_of_the_sound(model, tmp_path, sound):
    """Lengths of a model without speech input, of two settings, and of a part of a sound."""

    def frames(more: dict, path=sound, **settings) -> tuple[int, float]:
        (tmp_path / "out").mkdir(exist_ok=True)
        made = renderer(model, tmp_path / "out", Output("npz"), **settings)(
            Result(Task("a", path, more=more))
        )
        assert made.error is None and made.facts == {"fps": 25.0}
        return Motion.load(made.files[0]).n_frames, made.sound

    assert frames({}) == (38, 1.5) and frames({"start": 0.5}) == (25, 1.0)
    assert frames({"seconds": 0.8}) == (20, 0.8)
    assert frames({"seconds": 0.8}, None) == (20, 0.8) and frames({}, None, seconds=0.4)[0] == 10
    paths = {}
    for seed in (0, 5):
        frames({"seed": seed})
        paths[seed] = Motion.load(tmp_path / "out" / "a.npz").rotations
    assert np.array_equal(paths[5], model.generate(sound, item="a", seed=5).rotations)
    assert not np.array_equal(paths[0], paths[5])


def test_each_format_gets_its_settings_and_pictures_the_sound(model, tmp_path, sound, monkeypatch):
    """The original file, unless only a part or a channel of it was used."""
    out, given = tmp_path / "out", {}
    out.mkdir()

    def save(motion: Motion, path, **options) -> None:
        given[path.suffix] = options
        path.write_bytes(b"made")

    monkeypatch.setattr(Motion, "save", save)
    output = Output("bvh,npz,png,html", unit="m", up="z", framing="waist", body="skeleton")
    own = {".bvh": {"unit": "m"}, ".npz": {"up": "z"}, ".png": {"body": "skeleton"}}
    own[".html"] = {"body": "skeleton", "framing": "waist"}
    for path, more, channel, audio in (
        (sound, {}, None, sound),
        (sound, {"start": 0.5}, None, 1.0),
        (sound, {}, 1, 1.5),
        (None, {"seconds": 0.4}, None, None),
    ):
        made = renderer(model, out, output, channel=channel)(Result(Task("a", path, more=more)))
        assert made.error is None and len(made.files) == 4
        for kind in (".png", ".html"):
            found = given[kind].pop("audio", None)
            assert (found.duration if isinstance(found, af.Wave) else found) == audio
        assert given == own


def test_a_preview_names_what_cannot_be_read_and_what_is_kept(model, tmp_path, sound):
    broken = tmp_path / "broken.wav"
    broken.write_text("no sound")
    out = tmp_path / "out"

    def outcomes() -> dict[str, tuple[str, bool]]:
        found = preview(render_batch(model, [sound, broken], out))
        return {result.id: (result.status, str(broken) in (result.error or "")) for result in found}

    assert outcomes() == {"a": ("left", False), "broken": ("failed", True)}
    assert not list(out.glob("*.bvh")) and model_of_results(out) is None
    assert [result.status for result in render_batch(model, [sound, broken], out).run()] == [
        "done", "failed"
    ]  # fmt: skip
    assert outcomes() == {"a": ("kept", False), "broken": ("failed", True)}
    assert model_of_results(out) == model.folder
    (idle,) = preview(render_batch(model, [], tmp_path / "idle", seconds=1.0))
    assert (idle.id, idle.status, idle.task.duration) == ("motion", "left", 1.0)


def test_work_that_fails_has_no_cost(model, tmp_path):
    """Costs are those of items and of seconds of sound, in seconds and bytes."""
    mean = model.normaliser.mean * float("nan")
    damaged = replace(model, normaliser=replace(model.normaliser, mean=mean))
    cost = measured_cost(render_batch(damaged, [], tmp_path / "out", seconds=1.0))
    assert cost == Cost((0.0, 0.0), (0.0, 0.0)) and not (tmp_path / "out").exists()
    assert Cost((2.0, 100.0), (0.5, 10.0)).of(3, 8.0) == (10.0, 380.0)


def test_the_cost_of_work_is_that_of_its_files(tmp_path, sound):
    """Ten rows a second, of a value of 4 bytes and a time of 8, and the rest of an npz."""
    batch = sound_batch("features", extraction(tmp_path / "out"), sound, Execution())
    (seconds, size), (rate, per_second) = vars(measured_cost(batch)).values()
    assert per_second == pytest.approx(120, rel=0.1) and not (tmp_path / "out").exists()
    af.FeatureTrack(np.zeros((10, 1)), np.arange(10), names=("level",)).save(tmp_path / "ten.npz")
    assert size == pytest.approx((tmp_path / "ten.npz").stat().st_size - 120, abs=20)
    assert 0 <= seconds < 0.9 and 0 <= rate < 0.9


def test_progress_goes_on_with_each_result(model, tmp_path, sound):
    begun, sounds = [], [sound, sound.with_name("b.wav")]
    sounds[1].write_bytes(sound.read_bytes())
    results = iter_render(
        model, sounds, tmp_path / "out", progress=lambda tasks: (begun.append(t) for t in tasks)
    )
    for count in (1, 2):
        next(results)
        assert len(begun) == count
    assert not list(results) and len(begun) == 2


def test_an_avatar_that_is_not_there_is_refused_before_any_work():
    with pytest.raises(FormatError, match=r"none\.vrm"):
        Output(body="none.vrm")


def test_faults_of_a_sound_are_warned_about_but_for_silence_which_the_model_names(
    model, tmp_path, caplog
):
    samples = np.full(8000, 0.3)
    samples[2000:2100] = 1.0  # at a constant level, off zero, and clipped
    out = tmp_path / "out"
    out.mkdir()
    for name, values in {"loud": samples, "silent": np.zeros(8000)}.items():
        soundfile.write(tmp_path / f"{name}.wav", values, 16_000)
        assert extraction(out)(Result(Task(name, tmp_path / f"{name}.wav"))).error is None
    texts = [record.getMessage().replace(str(tmp_path), "") for record in caplog.records]
    clipped, offset, silent = (text.partition(": ") for text in texts)
    assert clipped[0] == offset[0] == "/loud.wav" and silent[0] == "/silent.wav"
    assert clipped[2].startswith("clipped: ") and "the first at 0.12 s" in clipped[2]
    assert offset[2].startswith("DC offset of +30") and silent[2].startswith("silence: ")
    caplog.clear()
    for name in ("loud", "silent"):
        made = renderer(model, out, Output("npz"))(Result(Task(name, tmp_path / f"{name}.wav")))
        assert made.error is None
    again = [record.getMessage().replace(str(tmp_path), "") for record in caplog.records]
    assert [text for text in again if text in texts] == texts[:2]


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
    assert made.input["start"] == 0.5 and made.input.keys() == {"input", "start"}
    faster = extraction(out, fps=25.0, picture=True, channel=1)
    made = faster(Result(task))
    assert made.error is None and [file.suffix for file in made.files] == [".npz", ".png"]
    assert made.facts["shape"] == (25, 1) and made.input["channel"] == 1
    linear = wanted.to_rate(25.0, 25, method="linear").values
    assert np.array_equal(af.FeatureTrack.load(out / "a.npz").values, linear)
    with pytest.raises(GestureKitError, match="no sound, so there are no features"):
        plain.make(Result(Task("b")))
    assert plain.settings == {
        "extractor": {"kind": "levels"}, "fps": None, "align": "linear", "precision": "fp32"
    }  # fmt: skip
    half = extraction(out, align="window", cache="fp16").settings
    assert (half["align"], half["precision"]) == ("window", "fp16")
    own = sound.with_name("a.own.npy")
    np.save(own, np.zeros((15, 2)))
    files = replace(plain, extractor=af.Files(2, suffix=".own.npy", rate=10.0))
    assert files.input_of(task)["features"] == [hashlib.sha256(own.read_bytes()).hexdigest()]
    assert files.input_of(Task("b")) == {}
    elsewhere = extraction(out, fps=25.0, cache="fp16").into(tmp_path)
    assert (elsewhere.out, elsewhere.cache, elsewhere.fps) == (tmp_path, None, 25.0)


def test_features_of_words_depend_on_the_words_beside_the_sound(tmp_path, sound):
    words, task = replace(extraction(tmp_path), extractor=af.Words()), Task("a", sound)
    plain = {"input": hashlib.sha256(sound.read_bytes()).hexdigest()}
    assert words.input_of(task) == plain | {"words": None}
    beside = sound.with_suffix(".ctm")
    beside.write_text("a 1 0.5 0.3 so\n")
    digest = words.input_of(task)["words"]
    assert digest is not None and extraction(tmp_path).input_of(task) == plain
    beside.write_text("a 1 0.5 0.3 well\n")
    assert digest != words.input_of(task)["words"] is not None
    assert words.input_of(Task("b")) == {}
