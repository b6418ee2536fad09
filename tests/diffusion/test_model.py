"""Diffusion models: every control, on tiny networks of random weights."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
import torch
from safetensors.torch import load_file, save_file

import audio_features as af
import gesturekit as gk
from gesturekit.corpus.speech import SpeechConditioner
from gesturekit.diffusion.conditions import smooth_path
from gesturekit.diffusion.config import NoiseConfig
from gesturekit.diffusion.events import asked_events
from gesturekit.diffusion.network.denoiser import Denoiser
from gesturekit.errors import ConfigError, FormatError, ModelError
from gesturekit.inspection import inspect
from gesturekit.motion.root_path import RootPath
from gesturekit.motion.rotations import rotation_angles
from gesturekit.postprocess import smooth_motion

QUICK = {"seconds": 1.5, "steps": 4}
STYLES = {"styles": ("old", "angry"), "droppable": ("styles",)}


@pytest.fixture(scope="module")
def model(untrained):
    return untrained(**STYLES)


@pytest.fixture(scope="module")
def ears():
    extractor = af.LogMel(n_mels=4)
    return SpeechConditioner(extractor, 30.0, "mean", np.zeros(4), np.full(4, 10.0))


def same(one: gk.Motion, other: gk.Motion) -> bool:
    pairs = ((one.rotations, other.rotations), (one.positions(), other.positions()))
    return all(np.array_equal(*pair) for pair in pairs)


def test_the_same_seed_gives_the_same_bytes_however_many_are_asked_for(model):
    three = model.generate(**QUICK, samples=3, seed=4)
    two = model.generate(**QUICK, samples=2, seed=4)
    assert same(three[0], two[0]) and same(three[1], two[1])
    assert not same(three[0], three[1])
    assert not same(three[0], model.generate(**QUICK, seed=5))
    named = model.generate(**QUICK, samples=3, seed=4, item="a")
    assert not any(same(*pair) for pair in zip(three, named, strict=True))
    together = model.generate(**QUICK, samples=3, seed=4, batch=2)
    for one, other in zip(three, together, strict=True):
        np.testing.assert_allclose(one.rotations, other.rotations, atol=1e-3)


@pytest.mark.parametrize("solver", ["ancestral", "ddim", "dpm"])
def test_every_solver_makes_motion_and_fewer_steps_take_the_second_order_one(model, solver):
    asked = {"seconds": 1.0, "style": "old", "foot_lock": False}
    made = model.generate(**asked, steps=5, solver=solver)
    assert made.n_frames == 30 and made.fps == 30
    assert same(made, model.generate(**asked, steps=5)) == (solver == "dpm")
    assert same(made, model.generate(**asked, steps=5, solver=solver))


def test_styles_are_followed_mixed_and_changed_over_time(model):
    def styled(style: str) -> gk.Motion:
        return model.generate(seconds=8.0, steps=3, style=style, foot_lock=False)

    old, angry = styled("old"), styled("angry")
    assert not same(old, angry)
    assert same(styled("old:1,angry:0"), old)
    half = styled("old,angry")
    assert not same(half, old) and not same(half, angry)
    changing = styled("old@0-4,angry@4-8")
    np.testing.assert_allclose(changing.rotations[:60], old.rotations[:60], atol=1e-4)
    np.testing.assert_allclose(changing.rotations[180:, 1:], angry.rotations[180:, 1:], atol=1e-4)
    assert np.abs(changing.rotations[180:, 1:] - old.rotations[180:, 1:]).max() > 1e-3


def test_without_a_style_each_sample_draws_its_own(model):
    """The same noise with either style, so that the motion of a sample shows its style."""
    drawn = set()
    for draw in ({"seed": 0}, {"seed": 1}, {"item": "a"}):
        asked = QUICK | {"samples": 6} | draw
        free, *styled = (model.generate(**asked, style=name) for name in (None, *model.styles))
        chosen = [[same(made, one[k]) for one in styled] for k, made in enumerate(free)]
        assert all(sum(found) == 1 for found in chosen)
        drawn.add(tuple(found.index(True) for found in chosen))
    assert len(drawn) == 3 and all(set(styles) == {0, 1} for styles in drawn)


def test_guidance_leads_from_the_unconditional_to_the_conditional_and_beyond(model, untrained):
    asked = QUICK | {"style": "old", "foot_lock": False}
    plain = model.generate(**asked)
    assert same(model.generate(**asked, guidance=1.0), plain)
    without = model.generate(**asked, guidance=0.0)
    assert same(without, model.generate(**asked | {"style": "angry"}, guidance=0.0))
    strong = model.generate(**asked, guidance=2.0)
    assert not same(strong, plain)
    twin = untrained(seed=1)
    alone = twin.generate(**QUICK, foot_lock=False)
    assert same(model.generate(**asked, guidance=0.0, unconditional=twin), alone)
    # The same product, as experts of weights that are written out.
    product = model.generate(**asked, experts=[(twin, -1.0)])
    guided = model.generate(**asked, guidance=2.0, unconditional=twin)
    np.testing.assert_allclose(product.rotations, guided.rotations, atol=1e-5)


def test_experts_are_other_models_with_conditions_of_their_own(model, untrained, ears, tmp_path):
    asked = QUICK | {"style": "old", "foot_lock": False}
    alone = model.generate(**asked)
    model.save(tmp_path / "copy")
    copy = gk.load(tmp_path / "copy")
    for weight in (None, 0.3, -2.0):  # merged: not a bit is lost
        assert same(model.generate(**asked, experts=[(copy, weight)]), alone)
    prior, hearing = untrained(seed=2), untrained(seed=3, conditioner=ears)
    leads = model.generate(**asked, experts=[(prior, 1.0)])
    assert same(leads, prior.generate(**QUICK, foot_lock=False))
    named = model.generate(**asked, experts=[(prior, 1.0)], item="a")
    assert same(named, prior.generate(**QUICK, foot_lock=False, item="a")) and not same(
        named, leads
    )
    own_style = model.generate(**asked, experts=[(copy, 1.0, "angry")])
    assert same(own_style, model.generate(**asked | {"style": "angry"}))
    third = model.generate(**asked, experts=[(prior, None), (hearing, None)])
    assert same(third, model.generate(**asked, experts=[(prior, 1 / 3), (hearing, 1 / 3)]))
    early = np.repeat([1.0, 0.0], [20, 25])
    half = model.generate(**asked, experts=[(prior, early)])
    assert not same(half, alone)


def test_a_path_places_the_body(untrained, gesture):
    walker, path = untrained(path=True), RootPath(np.zeros((60, 2)), np.zeros(60), 30.0)
    for asked in ({"facing": 0.0}, {"in_place": True}):
        with pytest.raises(ModelError, match="the model follows a path, which places the body"):
            walker.check_controls(**asked)
    pose = gesture(1.0)[20:21]
    pose = replace(pose, translation=pose.translation + [3.0, 0.0, 1.0])
    made = walker.generate(path=path, steps=2, start_pose=pose)
    assert rotation_angles(made.rotations[0, 1:], pose.rotations[0, 1:]).max() < 1e-6
    assert np.linalg.norm(made.positions()[:, 0, [0, 2]], axis=1).max() < 0.3, "not at (3, 1)"
    np.testing.assert_allclose(made.positions()[15:, 0, [0, 2]], 0, atol=1e-3)


def test_a_path_is_followed_to_the_millimetre(untrained, tmp_path):
    walker = untrained(path=True)
    time = np.arange(0, 4.01, 0.1)
    rows = [f"{t:.1f},{np.sin(t):.6f},{1.2 * t:.6f}" for t in time]
    (tmp_path / "way.csv").write_text("\n".join(["time,x,z", *rows]))
    for lock in (True, False):
        motion = walker.generate(path=tmp_path / "way.csv", steps=4, foot_lock=lock)
        asked = RootPath.looking_ahead(np.stack([np.sin(time), 1.2 * time], 1), 10.0)
        wanted = smooth_path(asked, 30.0, motion.n_frames)
        assert motion.n_frames == 121  # of 4 s, with both ends
        root = motion.positions()[:, walker.representation.root]
        np.testing.assert_allclose(root[:, [0, 2]], wanted.positions, atol=1e-3)
    straight = RootPath(np.zeros((60, 2)), np.zeros(60), 30.0)
    assert walker.generate(path=straight, seconds=1.0, steps=2).n_frames == 30
    with pytest.raises(ModelError, match="follows a path and needs one"):
        walker.generate(seconds=1.0)
    with pytest.raises(ModelError, match="give a RootPath"):
        walker.generate(path=np.zeros((3, 2)))
    with pytest.raises(FormatError, match="no such file"):
        walker.generate(path=tmp_path / "none.csv")
    with pytest.raises(ModelError, match="cannot follow a path"):
        untrained().generate(path=straight)


def test_events_happen_when_they_are_asked_for(untrained, tmp_path):
    # 8 s of clicks, 120 a minute, on a low hum.
    rate, clicks = 16000, tmp_path / "clicks.wav"
    sound = 0.01 * np.sin(2 * np.pi * 110 * np.arange(8 * rate) / rate)
    for beat in range(16):
        sound[beat * rate // 2 :][:400] += np.random.default_rng(0).normal(0, 0.3, 400)
    soundfile.write(clicks, sound, rate)
    fighter = untrained(events=("kick", "punch"))
    asked = QUICK | {"foot_lock": False}
    still = fighter.generate(**asked)
    kick = fighter.generate(**asked, events="kick@1.0")
    early = slice(0, 5)
    np.testing.assert_allclose(kick.rotations[early], still.rotations[early], atol=1e-5)
    assert np.abs(kick.rotations[28:33] - still.rotations[28:33]).max() > 1e-4
    (tmp_path / "events.csv").write_text("time,name,duration\n1.0,kick,0\n")
    assert same(fighter.generate(**asked, events=tmp_path / "events.csv"), kick)
    dance = fighter.generate(clicks, steps=2, events="kick@beats,punch@0.5:0.25")
    assert dance.n_frames == 240
    found = asked_events("kick@beats,punch@0.5:0.25", af.Wave.load(clicks))
    times = np.array([event.time for event in found if event.name == "kick"])
    assert len(times) >= 10
    assert np.abs(times * 2 - np.round(times * 2)).max() / 2 < 0.05
    for events, told in {
        "kcik@1.0": "event 'kcik': did you mean kick",
        "kick@soon": "events look like",
        "kick@beats": "no sound to find beats in",
    }.items():
        with pytest.raises(ModelError, match=told):
            fighter.generate(**asked, events=events)
    with pytest.raises(ModelError, match="has no events"):
        untrained().generate(seconds=1.0, events="kick@1.0")


def test_speech_changes_the_motion_and_sets_its_length(untrained, ears, write_speech, tmp_path):
    model = untrained(conditioner=ears, styles=("old",), droppable=("all",))
    speech = write_speech(tmp_path / "a.wav", 2.0)
    spoken = model.generate(speech, style="old", steps=4)
    silent = model.generate(seconds=2.0, style="old", steps=4)
    assert spoken.n_frames == silent.n_frames == 60
    assert not same(spoken, silent)
    told_nothing = model.generate(speech, style="old", steps=4, guidance=0.0)
    assert same(told_nothing, model.generate(seconds=2.0, steps=4, guidance=0.0))


def test_sound_without_voice_is_silence_to_a_model_and_its_experts(untrained, ears):
    model = untrained(conditioner=ears, styles=("old",))
    expert = untrained(seed=3, conditioner=replace(ears))
    noise = 0.1 * np.random.default_rng(0).standard_normal(32_000).astype(np.float32)
    asked = {"style": "old", "steps": 4, "experts": [(expert, 0.5)]}
    idle, still = model.generate(seconds=2.0, **asked), np.zeros_like(noise)
    assert same(model.generate(still, 16_000, **asked), idle)
    assert same(model.generate(noise, 16_000, **asked), idle)
    # Each of the two, alone.
    assert not same(model.generate(noise, 16_000, style="old", steps=4, vad=False), idle)
    own = model.generate(seconds=2.0, **asked | {"experts": [(expert, 1.0)]})
    loud = model.generate(noise, 16_000, **asked | {"experts": [(expert, 1.0)]}, vad=False)
    assert not same(loud, own)


def test_a_saved_model_is_the_model(untrained, ears, tmp_path):
    models = [
        untrained(conditioner=ears, events=("kick",), **STYLES),
        untrained(path=True, path_scale=np.array([0.1, 0.02, 0.03]), styles=("old",)),
    ]
    way = RootPath(np.stack([np.zeros(40), np.arange(40) / 30], 1), np.zeros(40), 30.0)
    for number, model in enumerate(models):
        folder = tmp_path / str(number)
        model.save(folder, notes={"Corpus": "two gestures"})
        again = gk.load(folder)
        asked = {"style": "old", "steps": 4} | ({"path": way} if number else {"seconds": 1.5})
        assert same(again.generate(**asked), model.generate(**asked))
        for name in ("droppable", "window", "styles"):
            assert getattr(again, name) == getattr(model, name)
        readme = (folder / "README.md").read_text()
        assert "two gestures" in readme and 'style="old"' in readme
        assert ("path.csv" in readme) == bool(number)
        files = {"README.md", "config.yaml", "model.safetensors", "skeleton.json"}
        assert {file.name for file in folder.iterdir()} == files


def test_smoothing_defaults_to_the_models_setting(untrained, tmp_path):
    model = replace(untrained(), smooth=0.3)
    model.save(tmp_path / "model")
    asked = QUICK | {"foot_lock": False}
    plain = model.generate(**asked, smooth=0)
    made = gk.load(tmp_path / "model").generate(**asked)
    assert same(made, smooth_motion(plain, 0.3)) and not same(made, plain)


def test_clipping_defaults_to_the_models_setting(untrained, tmp_path):
    """A network that predicts no noise diverges unless its prediction is clipped."""
    clipped = replace(untrained(), noise_config=NoiseConfig())
    torch.nn.init.zeros_(clipped.network.leave.weight)
    made = clipped.generate(seconds=0.5)
    with pytest.raises(ModelError, match="out of range"):
        clipped.generate(seconds=0.5, clip_denoised=False)
    replace(clipped, clip_denoised=False).save(tmp_path / "model")
    plain = gk.load(tmp_path / "model")
    with pytest.raises(ModelError, match="out of range"):
        plain.generate(seconds=0.5)
    assert same(plain.generate(seconds=0.5, clip_denoised=True), made)


def test_only_with_clipping_are_steps_of_almost_pure_noise_not_predicted(untrained):
    """A beta of 0.999 leaves 1e-3, 1e-6, 1e-9, ... of the motion: the third step is below 1e-8."""
    noise = NoiseConfig(steps=6, first_beta=0.999, last_beta=0.999, predict="velocity")
    model = replace(untrained(), noise_config=noise)
    calls = []
    model.network.leave.register_forward_hook(lambda *call: calls.append(call))
    for clip, predicted in ((True, 2), (False, 6)):
        calls.clear()
        model.generate(seconds=0.5, clip_denoised=clip)
        assert len(calls) == predicted


def test_half_precision_moves_alike_and_keeps_the_weights(model, tmp_path):
    model.save(tmp_path / "model")
    short = gk.load(tmp_path / "model", dtype="bf16")
    assert all(value.dtype == torch.bfloat16 for value in short.network.parameters())
    asked = QUICK | {"style": "old", "solver": "ancestral", "foot_lock": False}
    exact, near = (m.generate(**asked).positions() for m in (model, short))
    other = model.generate(**asked, seed=1).positions()
    apart, usual = (np.linalg.norm(exact - made, axis=-1).mean() for made in (near, other))
    assert 0 < apart < 0.1 * usual
    with pytest.raises(ModelError, match="dtype='fp16': choose one of fp32, bf16"):
        gk.load(tmp_path / "model", dtype="fp16")
    with pytest.raises(ConfigError, match="device: 'gpu' cannot be used here"):
        gk.load(tmp_path / "model", device="gpu")
    with pytest.raises(ModelError, match="a multires model, which is fp32 only"):
        gk.load("demo", dtype="bf16")


def test_a_speaker_has_a_body_and_steps_of_their_own(untrained, skeleton, tmp_path):
    model = untrained()
    model = replace(model, speakers={"ann": replace(skeleton, offsets=1.2 * skeleton.offsets)})
    model.save(tmp_path / "model")
    asked = QUICK | {"foot_lock": False}
    usual = model.generate(**asked)
    ann = gk.load(tmp_path / "model").generate(**asked, speaker="ann")
    np.testing.assert_allclose(ann.skeleton.offsets, 1.2 * usual.skeleton.offsets, atol=1e-6)
    np.testing.assert_array_equal(ann.rotations, usual.rotations)
    np.testing.assert_allclose(ann.positions(), 1.2 * usual.positions(), atol=1e-6)
    with pytest.raises(ModelError, match=r"speaker='bob': .*\(ann\)"):
        model.generate(**QUICK, speaker="bob")


def test_settings_that_the_architecture_does_not_use_are_not_shown(untrained, tmp_path):
    for kind, used in (("conformer", True), ("diffwave", False)):
        model = untrained()
        config = replace(model.network.config, architecture=kind, dilations=(1, 2))
        model = replace(model, network=Denoiser(model.network.n_motion, 0, config))
        model.save(tmp_path / kind)
        summary = inspect(tmp_path / kind)
        network = dict(summary.rows)["network"]
        assert "blocks 2" in network and "embedding 16" in network
        assert ("heads" in network) == ("heads" in summary.facts["network"]) == used
        assert ("2 blocks of 1 layers" in (tmp_path / kind / "README.md").read_text()) == used


def test_models_that_do_not_go_together_are_refused(model, untrained):
    other, own = untrained(seed=9), model.normaliser

    def represented(**changes):
        values = vars(other.representation) | changes
        return replace(other, representation=type(other.representation)(**values))

    factors = torch.linspace(1.0, 1.5, len(own.scale)).flip(0)
    scaled = replace(other, normaliser=replace(own, scale=own.scale * factors))
    shrunk = replace(other, normaliser=replace(own, scale=own.scale / factors))
    joints, means = other.representation.joints, other.representation.references
    side, rig = other.representation.side, other.skeleton
    renamed = replace(rig, names=("Root", *rig.names[1:]))
    dance = replace(other.noise_config, steps=150, first_beta=0.01, last_beta=0.7)
    for wrong, told in (
        (scaled, r"expert 1: .*another scale \(by up to a factor of 1\.5\).*moves_like"),
        (shrunk, r"by up to a factor of 0\.667"),
        (represented(scale=1.01 * other.representation.scale), "relative to another body size"),
        (represented(side=-side), "other mean rotations"),
        (represented(skeleton=renamed), "expert 1: another rig: .*Root"),
        (replace(other, fps=20.0), "expert 1: moves at 20 fps, this model at 30"),
        (represented(references=means[::-1]), "other mean rotations"),
        (represented(joints=(*joints[:-1], "Nobody")), "of a product need the same joints"),
        (untrained(path=True), "only one of the two follows a path"),
        (replace(other, noise_config=dance), "noise schedules differ"),
        (gk.load("demo"), "a multires model; only diffusion"),
    ):
        with pytest.raises(ModelError, match=told):
            model.generate(**QUICK, experts=[(wrong, 0.5)])
    for wrong in ((other, 0.5, None, 3), ()):
        with pytest.raises(ModelError, match=r"expert 1: expected \(model, weight\)"):
            model.generate(**QUICK, experts=[wrong])
    styled = untrained(seed=2, styles=("old",))
    with pytest.raises(ModelError, match="unconditional: that model needs a style too"):
        model.check_controls(guidance=1.5, unconditional=styled)
    for droppable in ("styles", "all"):
        without = untrained(seed=2, styles=("old",), droppable=(droppable,))
        model.check_controls(guidance=1.5, unconditional=without)
        without.check_controls(guidance=1.5)
    with pytest.raises(ModelError, match="expert 1: .*; only diffusion"):
        model.check_controls(guidance=1.5, unconditional=other, experts=[(gk.load("demo"), 0.5)])
    # Another mean is no hindrance.
    moved = replace(other, normaliser=replace(own, mean=own.mean + 0.1))
    alone = moved.generate(**QUICK, foot_lock=False)
    leads = model.generate(**QUICK, foot_lock=False, experts=[(moved, 1.0)])
    assert leads.n_frames == alone.n_frames and not same(leads, alone)


def test_what_a_model_cannot_do_is_one_clear_error(model, untrained):
    plain = untrained()
    for asked, told in [
        ({"style": "odl"}, "style 'odl': unknown; the model has old, angry"),
        ({"samples": 0}, "samples=0"),
        ({"batch": 0}, "batch=0"),
        ({"speaker": "ann"}, "its corpus named none"),
        ({"guidance": float("nan")}, "guidance=nan: expected a number"),
        ({"solver": "euler"}, "solver='euler': expected one of ancestral, ddim, dpm"),
        ({"steps": 1000}, "steps: 1000 must be between 1 and 100"),
        ({"unconditional": plain}, "only used with guidance"),
        ({"experts": [()]}, r"expected \(model, weight\)"),
    ]:
        with pytest.raises(ModelError, match=told):
            model.generate(**QUICK | asked)
    broken = untrained(seed=5)
    torch.nn.init.constant_(broken.network.leave.bias, float("nan"))
    for other, asked, told in [
        (plain, QUICK | {"style": "old"}, "has no styles"),
        (plain, QUICK | {"guidance": 1.5}, "no conditions to guide on"),
        (untrained(styles=("old",)), QUICK | {"guidance": 1.5}, "without style dropout"),
        (plain, {"speech": "speech.wav"}, "takes no speech; give seconds instead"),
        (plain, {}, "nothing to generate from"),
        (broken, QUICK, "the model gave NaN"),
    ]:
        with pytest.raises(ModelError, match=told):
            other.generate(**asked)


def test_a_folder_whose_files_differ_in_whether_there_is_a_path_is_refused(untrained, tmp_path):
    made, driven = untrained(), untrained(path=True)
    for one, other in ((made, driven), (driven, made)):
        n_motion, config = one.representation.n_features, one.network.config
        network = Denoiser(n_motion, other.conditions.width, config)
        mixed = replace(one, conditions=other.conditions, network=network)
        folder = tmp_path / str(n_motion)
        mixed.save(folder)
        with pytest.raises(ModelError, match="differ in whether there is a path"):
            gk.load(folder)


def _edit_config(folder: Path, old: str, new: str) -> None:
    text = (folder / "config.yaml").read_text()
    assert old in text
    (folder / "config.yaml").write_text(text.replace(old, new))


def _edit_tensor(folder: Path, name: str, change: Callable[[torch.Tensor], torch.Tensor]) -> None:
    tensors = load_file(folder / "model.safetensors")
    tensors[name] = change(tensors[name]).contiguous()
    save_file(tensors, folder / "model.safetensors")


def _edit_skeleton(folder: Path, name: str, value: Any) -> None:
    found = json.loads((folder / "skeleton.json").read_text())
    found["motion"][name] = value
    (folder / "skeleton.json").write_text(json.dumps(found))


@pytest.mark.parametrize(
    "harm",
    [
        lambda f: _edit_tensor(f, "motion.mean", lambda mean: mean[1:]),
        lambda f: _edit_tensor(f, "motion.scale", lambda scale: scale * float("inf")),
        lambda f: _edit_skeleton(f, "makes_root", False),
        lambda f: (f / "model.safetensors").unlink(),
        lambda f: (f / "model.safetensors").write_bytes(b"\x80\x04pickle"),
        lambda f: (f / "skeleton.json").write_text("[1, 2"),
        lambda f: (f / "skeleton.json").write_text(json.dumps({"skeleton": []})),
        lambda f: _edit_config(f, "channels: 16", "channels: 32"),
        lambda f: _edit_config(f, "channels: 16", "chanels: 16"),
        lambda f: _edit_config(f, "path: false", "path: true"),
        lambda f: _edit_config(f, "- angry", "- angry\n- sad"),
        lambda f: _edit_config(f, "fps: 30.0", "fps: .nan"),
        lambda f: _edit_config(f, "format: 1", "format: 2"),
        lambda f: _edit_config(f, "window: 9000", "window: many"),
        lambda f: _edit_config(f, "last_beta: 0.78", "last_beta: 1.78"),
        lambda f: _edit_config(f, "noise:", "nose:"),
    ],
)
def test_a_damaged_folder_is_refused_by_name(model, tmp_path, harm):
    model.save(tmp_path / "model")
    harm(tmp_path / "model")
    with pytest.raises(ModelError, match=str(tmp_path)) as told:
        gk.load(tmp_path / "model")
    assert "\n" not in str(told.value)
