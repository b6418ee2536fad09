"""Many sounds through one model: each has an outcome of its own, as soon as it is there."""

import re
from dataclasses import replace

import numpy as np
import pytest
from outputs import render

import audio_features as af
import gesturekit as gk
from gesturekit import Motion
from gesturekit.corpus import Item
from gesturekit.errors import ConfigError, FormatError
from gesturekit.jobs.records import STATE, read_record, write_record
from gesturekit.jobs.result import Task
from gesturekit.postprocess import smooth_motion
from gesturekit.rendering.renderer import Output, estimated_cost, render_batch


@pytest.fixture
def sounds(tmp_path, write_speech):
    return [write_speech(tmp_path / "in" / f"{name}.wav", 1.5) for name in "abc"]


def test_an_outcome_is_there_before_the_next_file_is_begun(model, sounds, tmp_path):
    out = tmp_path / "out"
    outcomes = render(model, sounds, out)
    first = next(outcomes)
    assert (first.source, first.files, first.error) == (str(sounds[0]), (out / "a.bvh",), None)
    assert sorted(path.name for path in out.iterdir()) == [STATE, "a.bvh"]
    sounds[1].write_text("gone bad meanwhile")
    second, third = outcomes
    assert second.files == () and second.error.startswith(str(sounds[1]))
    assert third.files == (out / "c.bvh",) and third.error is None


def test_fields_of_both_kinds_of_settings_are_arguments(model, sounds, tmp_path):
    """A part of three sounds, as npz: `formats` is of the files, `shard` of the work."""
    parts = [
        gk.render(model, sounds, tmp_path / "out", formats="npz", shard=(k, 2), samples=2)
        for k in (1, 2)
    ]
    made = [result for part in parts for result in part]
    assert sorted(result.id for result in made) == ["a", "b", "c"]
    assert {file.suffix for result in made for file in result.files} == {".npz"}


def test_the_cost_of_a_batch_is_that_of_its_files(model, sounds, tmp_path, write_speech):
    """Three sounds of 1.5 s and one of 6 s, as bytes; seconds are those of this machine."""
    sounds.append(write_speech(tmp_path / "in" / "long.wav", 6.0))
    batch = render_batch(model, sounds, tmp_path / "out")
    seconds, size = estimated_cost(batch, 4, 10.5)
    assert not (tmp_path / "out").exists() and seconds >= 0
    written = sum(file.stat().st_size for made in batch.run() for file in made.files)
    assert size == pytest.approx(written, rel=0.2)


def test_smoothing_defaults_to_the_models_setting(model, sounds, tmp_path):
    plain = model.generate(sounds[0], item="a")
    replace(model, smooth=0.3).save(tmp_path / "model")
    again = gk.load(tmp_path / "model")
    for seconds, wanted in ((None, smooth_motion(plain, 0.3)), (0, plain)):
        npz = Output(formats=("npz",))
        (outcome,) = render(again, sounds[:1], tmp_path / str(seconds), output=npz, smooth=seconds)
        made = Motion.load(outcome.files[0])
        np.testing.assert_allclose(made.rotations, wanted.rotations, atol=1e-12)


def test_no_name_leads_out_of_the_folder(model, sounds, tmp_path):
    odd = sounds[0].rename(sounds[0].with_name("..wav"))
    (outcome,) = render(model, [odd], tmp_path / "here" / "out")
    assert outcome.error is None
    assert [path.parent for path in outcome.files] == [tmp_path / "here" / "out"]
    assert outcome.files[0].is_file() and len(list((tmp_path / "here").iterdir())) == 1


def test_a_model_that_gives_nan_fails_each_file_by_name(model, sounds, tmp_path):
    mean = model.normaliser.mean * float("nan")
    damaged = replace(model, normaliser=replace(model.normaliser, mean=mean))
    for sound, outcome in zip(sounds, render(damaged, sounds, tmp_path), strict=True):
        assert outcome.error.startswith(f"{sound}: ") and "NaN" in outcome.error


def test_an_smpl_body_by_its_name(model, sounds, tmp_path):
    both = Output(formats=("bvh", "npz"), rig="smplh")
    (outcome,) = render(model, sounds[:1], tmp_path, output=both)
    assert outcome.error is None
    assert Motion.load(outcome.files[0]).skeleton.n_joints == 52
    with np.load(outcome.files[1]) as file:
        assert file["poses"].shape[1] == 156 and str(file["surface_model_type"]) == "smplh"
    with pytest.raises(FormatError, match="chair"):
        next(render(model, sounds[:1], tmp_path, output=Output(rig="chair")))


def test_folders_are_searched_and_keep_their_shape(model, sounds, tmp_path, write_speech, caplog):
    folder = sounds[0].parent
    write_speech(folder / "day 1" / "a.wav", 1.0)
    for name in ("day 1/call.mp4", "notes.txt", ".hidden.wav"):
        (folder / name).touch()
    out = folder / "out"
    made = [outcome.files for outcome in render(model, [sounds[2], folder], out)]
    assert made == [(out / f"{name}.bvh",) for name in ("c", "a", "b", "day 1/a")]
    (said,) = [record.getMessage() for record in caplog.records]
    assert "call.mp4" in said and "ffmpeg" in said


def test_a_link_in_the_output_folder_leads_nowhere(model, sounds, tmp_path, write_speech):
    write_speech(sounds[0].parent / "sub" / "d.wav", 0.5)
    elsewhere, out = tmp_path / "elsewhere", tmp_path / "out"
    elsewhere.mkdir()
    out.mkdir()
    (out / "sub").symlink_to(elsewhere)
    with pytest.raises(ConfigError, match=re.escape(str(out / "sub"))):
        next(render(model, [sounds[0].parent], out))
    (out / "sub").unlink()
    for link in (STATE, f"{STATE}/records", f"{STATE}/records/00", f"{STATE}/items.json"):
        (out / link).parent.mkdir(exist_ok=True)
        (out / link).symlink_to(elsewhere / "anything")
        with pytest.raises(ConfigError, match=re.escape(link)):
            next(render(model, sounds, out))
        (out / link).unlink()
    assert list(elsewhere.iterdir()) == []


def counted(outcomes):
    return [(len(outcome.files), len(outcome.kept)) for outcome in outcomes]


def test_a_plain_rerun_keeps_what_was_made_with_the_same(model, sounds, tmp_path):
    out = tmp_path / "out"
    assert counted(render(model, sounds[:2], out, seed=3)) == [(1, 0)] * 2
    before = (out / "a.bvh").stat().st_mtime_ns
    assert counted(render(model, sounds, out, seed=3)) == [(0, 1), (0, 1), (1, 0)]
    assert (out / "a.bvh").stat().st_mtime_ns == before
    # Copies of the input elsewhere, and what the default is, make no difference.
    moved = sounds[0].rename(tmp_path / "a.wav")
    assert counted(render(model, [moved], out, seed=3, foot_lock=True)) == [(0, 1)]


def test_a_rerun_refuses_by_name_what_was_made_otherwise(model, sounds, tmp_path, write_speech):
    out = tmp_path / "out"
    list(render(model, sounds[:2], out))
    made = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    damaged = replace(model, smooth=0.3)
    for name, asked in {
        "seed": lambda: render(model, sounds, out, seed=1),
        "foot_lock": lambda: render(model, sounds, out, foot_lock=False),
        "unit": lambda: render(model, sounds, out, output=Output(unit="m")),
        "rig": lambda: render(model, sounds, out, output=Output(rig="smpl")),
        "model": lambda: render(damaged, sounds, out),
    }.items():
        with pytest.raises(ConfigError, match=rf"(?=.*a.bvh)(?=.*b.bvh)(?=.*\b{name})(?=.*\b2\b)"):
            next(asked())
        assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == made
    write_speech(sounds[0], 1.0)
    with pytest.raises(ConfigError, match=r"(?=.*a\.bvh)(?=.*\binput\b)(?=.*\b1\b)"):
        next(render(model, sounds, out))
    # Each way through.
    skip, again = Output(existing="skip"), Output(existing="replace")
    assert counted(render(model, sounds[:2], out, output=skip, seed=1)) == [(0, 1)] * 2
    assert counted(render(model, sounds[:2], out, output=again, seed=1)) == [(1, 0)] * 2
    assert counted(render(model, sounds[:2], out, seed=1)) == [(0, 1)] * 2


def test_a_result_that_was_edited_is_not_overwritten(model, sounds, tmp_path):
    list(render(model, sounds[:1], tmp_path))
    (tmp_path / "a.bvh").write_text("edited in Blender")
    with pytest.raises(ConfigError, match=r"a\.bvh"):
        next(render(model, sounds[:1], tmp_path))
    again = Output(existing="replace")
    assert counted(render(model, sounds[:1], tmp_path, output=again)) == [(1, 0)]


def test_a_killed_run_goes_on_whatever_it_left_of_its_record(model, sounds, tmp_path):
    going = render(model, sounds, tmp_path)
    next(going)
    (tmp_path / ".b-12345678.bvh").write_text("half")
    going.close()
    begun = read_record(tmp_path / STATE, Task("a"))
    begun.begun, begun.made, begun.status = {"bvh": begun.made["a.bvh"]["made_with"]}, {}, "begun"
    del begun.begun["bvh"]["input"]
    write_record(tmp_path / STATE, begun)  # a.bvh is there, and only its beginning is recorded
    assert counted(render(model, sounds, tmp_path)) == [(1, 0)] * 3
    assert counted(render(model, sounds, tmp_path)) == [(0, 1)] * 3


def test_items_of_a_manifest_are_cut_and_named_as_it_says(model, tmp_path, write_pair):
    audio, motion = write_pair(tmp_path / "in" / "day", "a", 4.0)
    items = [
        Item(id="day/a", audio=audio, motion=motion, audio_start=1.0, duration=2.0),
        Item(id="b", audio=None, motion=motion, duration=1.5),
    ]
    out = tmp_path / "out"
    made = [outcome.files for outcome in render(model, items, out, samples=2)]
    assert made == [(out / f"{stem}_s1.bvh", out / f"{stem}_s2.bvh") for stem in ("day/a", "b")]
    list(render(model, items[:1], out, output=Output(["npz"])))
    made = Motion.load(out / "day" / "a.npz")
    wanted = model.generate(af.Wave.load(audio, start=1.0, duration=2.0), item="day/a")
    assert (made.rotations == wanted.rotations).all()
    assert Motion.load(out / "b_s1.bvh").n_frames == 38
    assert counted(render(model, items, out, samples=2)) == [(0, 2)] * 2
    for changed, says in (
        ({"audio_start": 1.5}, "start"),
        ({"audible": ((0.0, 2.0),)}, "audible"),
    ):
        later = [replace(items[0], **changed)]
        with pytest.raises(ConfigError, match=says):
            next(render(model, later, out, samples=2))


def test_bvh_in_another_unit(model, sounds, tmp_path):
    (own,) = render(model, sounds[:1], tmp_path / "cm")
    (outcome,) = render(model, sounds[:1], tmp_path / "m", output=Output(unit="m"))
    centimetres, metres = (Motion.load(one.files[0], unit="cm") for one in (own, outcome))
    ratio = centimetres.skeleton.offsets[1:] / metres.skeleton.offsets[1:].clip(1e-9)
    np.testing.assert_allclose(ratio[metres.skeleton.offsets[1:] > 1e-3], 100, rtol=1e-3)
    with pytest.raises(ConfigError, match=r"(?=.*\bup\b)(?=.*\.npz)"):
        next(render(model, sounds[:1], tmp_path, output=Output(up="z")))
