"""Single-clip mode, label mode, and speech with labels: train, reload, generate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from rigs import prefixed
from runs import logged

import gesturekit as gk
from gesturekit.errors import CorpusError, ModelError
from gesturekit.inspection import inspect
from gesturekit.motion.rotations import (
    multiply_quaternions,
    quaternion_from_rotation_vector,
    rotate_vectors,
)
from gesturekit.multires.controls import MultiresControls
from gesturekit.multires.network.discriminator import LevelDiscriminator
from gesturekit.multires.network.resampling import resample
from gesturekit.multires.sampling.conditions import (
    agreed_style,
    level_track,
    mixed_styles,
    requested_styles,
)
from gesturekit.multires.training.loading import load_training_data
from gesturekit.multires.training.trainer import train
from gesturekit.training.run.checkpoint import Checkpoints

SINGLE = {"features": None, "training": {"window": None}}
LABELS = {**SINGLE, "styles": {}, "network": {"modulate": "all"}}


@pytest.fixture
def single(make_config, motions):
    """single(noise_levels=2, ...): a model of one clip of 4 s, trained with these changes."""

    def make(**changes) -> gk.Model:
        return gk.load(train(make_config(corpus=str(motions(none=[4.0])), **SINGLE, **changes)))

    return make


def test_one_clip_without_any_condition(single, tmp_path):
    model = single()
    motion = model.generate(seconds=6.0, seed=1)
    assert motion.n_frames == 180, "at the rate of the recordings"
    again = gk.load(model.folder).generate(seconds=6.0, seed=1)
    np.testing.assert_array_equal(motion.rotations, again.rotations)
    other = model.generate(seconds=6.0, seed=2)
    assert np.abs(motion.rotations - other.rotations).max() > 1e-3
    with pytest.raises(ModelError, match="takes no speech; give seconds instead"):
        model.generate("speech.wav")
    with pytest.raises(ModelError, match="level_speech: this model takes no speech"):
        model.generate(seconds=2.0, level_speech={"1": tmp_path / "none_0.bvh"})
    with pytest.raises(ModelError, match="style"):
        model.generate(seconds=2.0, style="happy")


def test_styles_of_the_manifest_move_differently(make_config, motions):
    corpus = motions(old=[4.0, 3.0], angry=[4.0])
    folder = train(make_config(corpus=str(corpus), **LABELS))
    model = gk.load(folder)
    assert model.styles == ("angry", "old")

    def rotations(**asked):
        return model.generate(seconds=4.0, seed=3, **asked).rotations

    old, angry = rotations(style="old"), rotations(style="angry")
    assert np.abs(old - angry).max() > 1e-3
    rows = dict(inspect(folder).rows)
    assert rows["speech features"] == "none" and rows["styles"] == "angry, old"
    both = rotations(level_style="1-2=old,3-4=angry")
    assert np.abs(both - old).max() > 1e-4 and np.abs(both - angry).max() > 1e-4
    np.testing.assert_array_equal(rotations(style="angry", level_style="1-4=old"), old)
    with pytest.raises(ModelError, match="angry, old"):
        rotations(style="sad")


def test_without_a_style_each_item_draws_its_own(make_config, motions):
    corpus = motions(old=[4.0], angry=[4.0])
    model = gk.load(train(make_config(corpus=str(corpus), **LABELS)))
    drawn = []
    for item in map(str, range(8)):
        asked = {"seconds": 2.0, "item": item}
        free, old, angry = (
            model.generate(**asked, style=style).rotations for style in (None, "old", "angry")
        )
        drawn.append(np.array_equal(free, old))
        assert drawn[-1] or np.array_equal(free, angry)
    assert len(set(drawn)) == 2


def test_discriminators_tell_a_style_from_others(make_config, motions, tmp_path):
    corpus = motions(high=[4.0], low=[4.0])
    raised = gk.Motion.load(tmp_path / "high_0.bvh")
    for side, turn in (("LeftArm", 0.8), ("RightArm", -0.8)):
        arm = raised.rotations[:, raised.skeleton.index(side)]
        about_z = quaternion_from_rotation_vector(np.array([0.0, 0.0, turn]))
        arm[:] = multiply_quaternions(about_z, arm)
    raised.save(tmp_path / "high_0.bvh")
    mode = {"features": None, "styles": {}, "network": {"levels": 2}}
    training = {"first_stage": 40, "generator_steps": 0}
    folder = train(make_config(corpus=str(corpus), training=training, **mode))
    model = gk.load(folder)
    discriminator = LevelDiscriminator(model.representation, model.network_config, 2)
    _, state = Checkpoints(folder.parent / "checkpoints").latest()
    own = {k[2:]: v for k, v in state["discriminators"].items() if k.startswith("0.")}
    discriminator.load_state_dict(own)
    for i, style in enumerate(model.styles):
        motion = gk.Motion.load(tmp_path / f"{style}_0.bvh").resample(model.fps)
        vectors = torch.from_numpy(model.representation.encode(motion).T[None]).float()
        coarsest = resample(model.normaliser.forward(vectors), 75)
        told, otherwise = torch.eye(2)[[i]], torch.eye(2)[[1 - i]]
        assert discriminator(coarsest, told).mean() > discriminator(coarsest, otherwise).mean()


def test_label_mode_wants_a_style_for_every_item(make_config, motions):
    corpus = motions(old=[3.0], none=[3.0])
    with pytest.raises(CorpusError, match="none_0 has no style"):
        train(make_config(corpus=str(corpus), **LABELS))


def test_spans_hold_and_blend_over_a_second():
    track = level_track(("angry", "old"), "old@0-4,angry@4-8", 250, 25.0)
    torch.testing.assert_close(track.sum(dim=0), torch.ones(250))
    assert track[1, 80] == 1 and track[0, 120] == 1 and track[0, 249] == 1
    ramp = track[0, 86:114]
    assert (ramp.diff() >= 0).all() and ramp[0] == 0 and ramp[-1] == 1
    assert 0.4 < track[0, 100] < 0.6


@pytest.mark.parametrize(
    ("style", "level_style", "message"),
    [
        ("older", None, "the model has angry, old"),
        ("old", "1-9=old", "levels 1 .coarse. to 4"),
        ("old", "old", "1-4=describe"),
        ("old", "1-4", "1-4=describe"),
    ],
)
def test_invalid_style_requests_are_errors(style, level_style, message):
    with pytest.raises(ModelError, match=message):
        controls = MultiresControls(style=style, level_style=level_style)
        rng = torch.Generator()
        requested_styles(("angry", "old"), controls, [10, 20, 30, 40], fps=25.0, rng=rng)


def test_nine_in_ten_random_motions_mix_two_styles_at_one_level():
    rng = torch.Generator().manual_seed(0)
    drawn = mixed_styles(torch.ones(50), torch.ones(50), 4000, 8, 0.9, rng)
    changes = (drawn.diff(dim=1) != 0).sum(dim=1)
    assert changes.max() == 1
    # Of fifty styles one in fifty pairs is twice the same.
    assert 0.86 < (changes == 1).float().mean() < 0.9
    at = (drawn.diff(dim=1) != 0).float().sum(dim=0)
    assert (at > 400).all(), "every level is a crossover as often as the others"
    unmixed = mixed_styles(torch.ones(50), torch.ones(50), 100, 8, 0.0, rng)
    assert (unmixed == unmixed[:, :1]).all()


@pytest.mark.parametrize("noise_levels", [1, 4])
def test_a_coarse_level_comes_back_as_keyframes(single, tmp_path, noise_levels):
    """Unedited it gives the motion that it was taken from."""
    model = single(noise_levels=noise_levels, eval_every=10)
    coarse = model.generate(seconds=6.0, seed=1, levels=1)
    assert coarse.n_frames == 63 and coarse.duration == pytest.approx(6.0)
    coarse.save(tmp_path / "coarse.bvh")
    again = model.generate(keyframes=tmp_path / "coarse.bvh", seed=1)
    finer = model.generate(seconds=6.0, seed=1, levels=2)
    same = model.generate(keyframes=finer, keyframe_level=2, seed=1)
    np.testing.assert_allclose(again.positions(), same.positions(), atol=1e-5)


def test_keyframes_of_another_rate_or_length_cause_warnings(single, caplog):
    model = single()
    coarse = model.generate(seconds=6.0, seed=1, levels=1)

    def said(motion, **options) -> tuple[gk.Motion, str]:
        caplog.clear()
        return model.generate(keyframes=motion, seed=1, **options), caplog.text

    whole, words = said(coarse)
    assert words == ""
    # Blender writes 250 frames whatever the clip is.
    longer = coarse.resample(coarse.fps, 250)
    for options in ({}, {"seconds": 6.0}):
        made, words = said(longer, **options)
        assert "187 equal frames at the end are left out, 63 remain" in words
        assert (made.rotations == whole.rotations).all()
    still = coarse[:1].resample(coarse.fps, 63)
    assert said(still)[0].n_frames == whole.n_frames and caplog.text == ""
    _, words = said(model.generate(seconds=6.0, seed=1, levels=2))
    assert "14 fps, but level 1 has 10.5 fps: it fits level 2" in words
    _, words = said(replace(coarse, fps=24.0))
    assert "24 fps, but level 1 has 10.61 fps: no level has" in words
    assert said(replace(coarse, fps=1.005 * coarse.fps))[1] == ""
    assert "the rest is left out" in said(coarse, seconds=4.0)[1]
    assert "the last pose is held to the end" in said(coarse, seconds=8.0)[1]
    _, words = said(prefixed(coarse, "avatar:"))
    assert "the rig (19 joints) is not the model's (19 joints): retargeted" in words


def test_a_like_motion_shorter_than_the_sound_causes_a_warning(single, caplog):
    model = single()
    clip = model.generate(seconds=2.0)
    for seconds, warns in ((None, False), (1.0, False), (2.4, False), (4.0, True)):
        caplog.clear()
        model.generate(like=clip, seconds=seconds)
        assert ("2 s of motion for 4 s: the last pose is held to the end" in caplog.text) == warns


def test_noise_enters_at_as_many_levels_as_wanted_scaled_by_their_sigma(single):
    model = single(noise_levels=2)
    assert model.noise.noise_levels == 2

    def made(levels, noise_levels, seed=1):
        noisy = replace(model, noise=replace(model.noise, noise_levels=noise_levels))
        return noisy.generate(seconds=6.0, seed=seed, levels=levels, foot_lock=False).rotations

    np.testing.assert_array_equal(made(1, 1), made(1, 2))
    assert np.abs(made(2, 2) - made(2, 1)).max() > 1e-4
    np.testing.assert_array_equal(made(2, 2), made(2, 4))
    assert np.abs(made(4, 4) - made(4, 2)).max() > 1e-4
    model.noise.sigma[:, 1:] = 0
    quiet = made(4, 1)
    np.testing.assert_array_equal(made(4, 4), quiet)
    model.noise.sigma[:, 0] *= 100
    loud = made(4, 1)
    assert np.abs(loud - quiet).max() > 0.05 and np.abs(loud - made(4, 1, seed=2)).max() > 0.05


def test_keyframes_decide_the_pose_and_the_length(single, gesture):
    model = single()
    content = gesture(5.0, seed=7)
    made = model.generate(keyframes=content, keyframe_level=4, foot_lock=False)
    assert made.n_frames == 125
    same = content.resample(25.0, 125)
    angles = np.abs((made.rotations * same.rotations).sum(axis=-1))
    assert angles.min() > 0.999, "at the finest level nothing is left to add"
    with pytest.raises(ModelError, match="levels 1 .coarse. to 4"):
        model.generate(keyframes=content, keyframe_level=5)


def test_a_training_sequence_is_reconstructed(make_config, motions, gesture):
    steps = {"discriminator_steps": 0, "generator_steps": 0, "reconstruction_steps": 2}
    training = {"window": None, "first_stage": 150, "further_stages": 60, "learning_rate": 5e-3}
    changes = {"features": None, "network": {"levels": 3, "channels": [6, 6]}}
    corpus = str(motions(none=[4.0]))
    model = gk.load(train(make_config(corpus=corpus, **changes, training=training | steps)))
    made = model.reconstruct("none_0")
    clip = gesture(4.0, seed=0).resample(25.0)
    assert made.n_frames == clip.n_frames
    other = model.generate(seconds=4.0, fps=model.fps)

    def error(motion):
        apart = np.abs((motion.rotations[:, 1:] * clip.rotations[:, 1:]).sum(axis=-1))
        return np.degrees(2 * np.arccos(np.minimum(apart, 1))).mean()

    assert error(made) < 0.8 * error(other)
    with pytest.raises(ModelError, match="none_0"):
        model.reconstruct("other")


@pytest.mark.parametrize(
    "mode", [SINGLE, {**LABELS, "z_star_shuffle": 3}], ids=["single", "labels"]
)
def test_each_mode_resumes_bitwise(mode, make_config, motions):
    """From within a pair and a window cache, and from a checkpoint that was not the last."""
    changes = {**mode, "training": {"window": None, "further_stages": 8}}
    config = make_config(corpus=str(motions(old=[3.0], angry=[4.0])), **changes)
    folder = train(config)
    whole = (folder / "model.safetensors").read_bytes()
    log = logged(config.out)
    last = Checkpoints(config.out / "checkpoints")
    assert last.steps() == [10, 14]
    last.path(14).unlink()
    (folder / "model.safetensors").unlink()
    train(config, resume=True)
    assert (folder / "model.safetensors").read_bytes() == whole
    assert logged(config.out) == log


def test_each_switch_of_ganimator_changes_the_training(make_config, motions, tmp_path):
    corpus = str(motions(none=[3.0]))
    short = {"window": None, "first_stage": 2, "further_stages": 1}
    switches = [
        {},
        {"normalise": False},
        {"z_star": "full"},
        {"losses": {"contact_speed": "norm"}},
        {"losses": {"contact_slope": 12.0}},
        {"losses": {"contact_time": "frame"}},
        {"network": {"contact_reach": "foot"}},
        {"losses": {"discriminator_scale": 0.5}},
        {"losses": {"penalty_on": "frame"}},
    ]
    made = set()
    for number, switch in enumerate(switches):
        out = str(tmp_path / f"run{number}")
        config = make_config(corpus=corpus, out=out, features=None, training=short, **switch)
        folder = train(config)
        made.add((folder / "model.safetensors").read_bytes())
        assert gk.load(folder).reconstruct("none_0").n_frames == 75
    assert len(made) == len(switches)


def test_styles_and_keyframes_from_the_command_line(make_config, motions, tmp_path, render):
    folder = train(make_config(corpus=str(motions(old=[3.0], angry=[3.0])), **LABELS))
    path = tmp_path / "out" / "motion.bvh"

    def frames(*options) -> int:
        assert render(folder, *options).status == 0
        return gk.Motion.load(path).n_frames

    over_time = ("--style", "old@0-2,angry@2-4", "--level-style", "4=old")
    assert frames("--seconds", 4, *over_time) == 120
    assert frames("--seconds", 4, "--style", "old", "--levels", 1) == 42
    edit = path.rename(tmp_path / "edit.bvh")
    assert frames("--keyframes", edit, "--style", "angry") == 100
    assert frames("--like", tmp_path / "old_0.bvh", "--style", "old") == 90
    done = render(folder, "--seconds", 4, "--style", "sad")
    assert done.status == 2 and "unknown; the model has angry, old" in done.err
    assert render(folder, "--keyframes", edit, "--like", edit).status == 2
    model = gk.load(folder)
    made, sequences = model.reconstruct("old_0"), model.noise.sequences
    assert made.n_frames == 75
    relabelled = {**sequences, "old_0": replace(sequences["old_0"], style="angry")}
    other = replace(model, noise=replace(model.noise, sequences=relabelled))
    apart = np.abs(other.reconstruct("old_0").rotations - made.rotations)
    assert apart.max() > 1e-6, "in its own style"


def test_a_style_is_agreed_on_up_to_a_level():
    styles = torch.tensor([[1, 1, 0], [1, 1, 1]])
    assert agreed_style(styles, 2, 1).tolist() == [[0, 1], [0, 1]]
    assert agreed_style(styles, 2, 2).tolist() == [[0, 0], [0, 1]]


def test_recordings_are_turned_to_face_forward_by_default(make_config, motions):
    corpus = motions(none=[4.0])
    path = corpus.parent / "none_0.bvh"
    about_y = np.array([0.0, np.sin(0.5), 0.0, np.cos(0.5)])  # by 1 radian

    def vectors(face_forward):
        config = make_config(corpus=str(corpus), features=None, face_forward=face_forward)
        data = load_training_data(config)
        return data.normaliser.inverse(data.paired[0].motion[None])[0]

    forward, as_recorded = vectors(True), vectors(False)
    motion = gk.Motion.load(path)
    motion.rotations[:, 0] = multiply_quaternions(about_y, motion.rotations[:, 0])
    motion.translation[:] = rotate_vectors(about_y, motion.translation)
    motion.save(path)
    torch.testing.assert_close(vectors(True), forward, atol=1e-4, rtol=0)
    assert (vectors(False) - as_recorded).abs().max() > 0.5
