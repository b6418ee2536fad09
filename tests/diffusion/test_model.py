"""Diffusion models: every control, on tiny networks of random weights."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch
from safetensors.torch import load_file, save_file

import audio_features as af
import gesturekit as gk
from gesturekit.corpus.speech import SpeechConditioner
from gesturekit.diffusion.conditions import asked_events, smooth_path
from gesturekit.errors import ModelError
from gesturekit.motion.root_path import RootPath

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
    # One with styles of its own has the style that is asked for, if it knows it.
    other = untrained(seed=4, styles=("angry", "old"))
    for style in ("old", "old:0.5,angry:0.5"):
        model.check_controls(experts=[(other, 1.0)])
        leads = model.generate(**asked | {"style": style}, experts=[(other, 1.0)])
        assert same(leads, other.generate(**asked | {"style": style}))
    other = untrained(seed=4, styles=("sad", "calm"))
    leads = model.generate(**asked, experts=[(other, 1.0)])
    assert same(leads, other.generate(**QUICK, foot_lock=False))
    assert same(
        prior.generate(**asked | {"style": "sad"}, experts=[(other, 1.0)]),
        other.generate(**asked | {"style": "sad"}),
    )
    third = model.generate(**asked, experts=[(prior, None), (hearing, None)])
    assert same(third, model.generate(**asked, experts=[(prior, 1 / 3), (hearing, 1 / 3)]))
    early = np.repeat([1.0, 0.0], [20, 25])
    half = model.generate(**asked, experts=[(prior, early)])
    assert not same(half, alone)


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
    with pytest.raises(ModelError, match=r"(?=.*path)(?=.*\.csv)"):
        walker.generate(seconds=1.0)
    for control in ({"facing": 0.0}, {"in_place": True}):
        with pytest.raises(ModelError, match=f"{[*control][0]}=.*path"):
            walker.check_controls(**control)
    with pytest.raises(ModelError, match="path=RootPath"):
        untrained().generate(path=RootPath(np.zeros((60, 2)), np.zeros(60), 30.0))


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
    dance = fighter.generate(clicks, steps=2, events="kick@beats,punch@0.5:0.25")
    assert dance.n_frames == 240
    found = asked_events("kick@beats,punch@0.5:0.25", af.Wave.load(clicks))
    times = np.array([event.time for event in found if event.name == "kick"])
    assert len(times) >= 10 and np.abs(times * 2 - np.round(times * 2)).max() / 2 < 0.05
    with pytest.raises(ModelError, match="(?=.*kcik)(?=.*kick)"):
        fighter.generate(**asked, events="kcik@1.0")
    with pytest.raises(ModelError, match="(?=.*kick@1.0)(?=.*events)"):
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


def test_half_precision_moves_alike_and_keeps_the_weights(model, tmp_path):
    model.save(tmp_path / "model")
    short = gk.load(tmp_path / "model", dtype="bf16")
    assert all(value.dtype == torch.bfloat16 for value in short.network.parameters())
    assert short.fingerprint() != gk.load(tmp_path / "model").fingerprint() == model.fingerprint()
    asked = QUICK | {"style": "old", "solver": "ancestral", "foot_lock": False}
    exact, near = (m.generate(**asked).positions() for m in (model, short))
    other = model.generate(**asked, seed=1).positions()
    apart, usual = (np.linalg.norm(exact - made, axis=-1).mean() for made in (near, other))
    assert 0 < apart < 0.1 * usual
    with pytest.raises(ModelError, match="(?=.*fp16)(?=.*fp32)(?=.*bf16)"):
        gk.load(tmp_path / "model", dtype="fp16")


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
    with pytest.raises(ModelError, match="(?=.*speaker)(?=.*bob)(?=.*ann)"):
        model.generate(**QUICK, speaker="bob")


def test_models_that_do_not_go_together_are_refused(model, untrained):
    other, own = untrained(seed=9), model.normaliser
    scaled = replace(other, normaliser=replace(own, scale=own.scale * 1.5))
    one = own.scale.clone()
    one[[3, 4]] *= torch.tensor([1.2, 0.5])
    made, rig = other.representation, other.skeleton

    def with_motion(**changes) -> gk.Model:
        return replace(other, representation=replace(made, **changes))

    renamed = replace(rig, names=("Root", *rig.names[1:]))
    dance = replace(other.noise_config, steps=150, first_beta=0.01, last_beta=0.7)
    late = replace(other.noise_config, last_beta=0.7)
    for wrong, told in (
        (scaled, r"(?=.*expert 1)(?=.*1\.5)(?=.*moves_like)"),
        (replace(other, representation=replace(made, skeleton=renamed)), "(?=.*expert)(?=.*Root)"),
        (replace(other, fps=20.0), r"(?=.*expert 1)(?=.*\b20\b)(?=.*\b30\b)"),
        (untrained(path=True), "(?=.*expert 1)(?=.*path)"),
        (replace(other, noise_config=dance), "(?=.*100)(?=.*150)"),
        (replace(other, noise_config=late), r"to 0\.7, .*to 0\.78"),
        (gk.load("demo"), "(?=.*expert 1)(?=.*multires)"),
        (replace(other, normaliser=replace(own, scale=one)), r"(?=.*another scale)(?=.*0\.5\b)"),
        (with_motion(scale=made.scale * 1.0002), "another body size"),
        (with_motion(references=made.references + 1e-4), "mean rotations"),
        (with_motion(turn_first=True), "released"),
    ):
        with pytest.raises(ModelError, match=told):
            model.check_controls(experts=[(wrong, 0.5)])
    near = with_motion(scale=made.scale * 1.00005, references=made.references + 5e-7)
    near = replace(near, normaliser=replace(own, scale=own.scale * 1.00005))
    model.check_controls(experts=[(near, 0.5)])
    for experts in ([(near, 0.5), ()], [(near, 0.5), (near, 0.5, "old", 1.0)]):
        with pytest.raises(ModelError, match="expert 2.*style"):
            model.check_controls(experts=experts)
    styled = untrained(seed=2, styles=("old",))
    with pytest.raises(ModelError, match="(?=.*unconditional)(?=.*style)"):
        model.check_controls(guidance=1.5, unconditional=styled)
    # Another mean is no hindrance.
    moved = replace(other, normaliser=replace(own, mean=own.mean + 0.1))
    alone = moved.generate(**QUICK, foot_lock=False)
    leads = model.generate(**QUICK, foot_lock=False, experts=[(moved, 1.0)])
    assert leads.n_frames == alone.n_frames and not same(leads, alone)


def test_what_a_model_cannot_do_is_one_clear_error(model, untrained, ears):
    plain, hearing = untrained(), untrained(conditioner=ears)
    for asked, told in [
        ({"style": "odl"}, "(?=.*odl)(?=.*old)(?=.*angry)"),
        ({"speaker": "ann"}, "(?=.*speaker)(?=.*ann)"),
        ({"guidance": float("nan")}, "guidance=nan"),
        ({"unconditional": plain}, "(?=.*unconditional)(?=.*guidance)"),
    ]:
        with pytest.raises(ModelError, match=told):
            model.generate(**QUICK | asked)
    broken = untrained(seed=5)
    torch.nn.init.constant_(broken.network.leave.bias, float("nan"))
    for other, asked, told in [
        (plain, QUICK | {"style": "old"}, "(?=.*old)(?=.*styles)"),
        (plain, QUICK | {"guidance": 1.5}, "(?=.*guidance=1.5)(?=.*conditions)"),
        (
            untrained(styles=("old",)),
            QUICK | {"guidance": 1.5},
            "(?=.*guidance)(?=.*dropout_style)",
        ),
        (hearing, QUICK | {"guidance": 1.5}, "(?=.*guidance)(?=.*dropout_condition)"),
        (plain, QUICK | {"state_guidance": 1.5}, "(?=.*state_guidance=1.5)(?=.*dropout_state)"),
        (plain, {}, "seconds"),
        (broken, QUICK, "NaN"),
    ]:
        with pytest.raises(ModelError, match=told):
            other.generate(**asked)


def _edit_config(folder: Path, old: str, new: str) -> None:
    text = (folder / "config.yaml").read_text()
    assert old in text
    (folder / "config.yaml").write_text(text.replace(old, new))


def _edit_tensor(folder: Path, name: str, change: Callable[[torch.Tensor], torch.Tensor]) -> None:
    tensors = load_file(folder / "model.safetensors")
    tensors[name] = change(tensors[name]).contiguous()
    save_file(tensors, folder / "model.safetensors")


@pytest.mark.parametrize(
    "harm",
    [
        lambda f: _edit_tensor(f, "motion.scale", lambda scale: scale * float("inf")),
        lambda f: (f / "model.safetensors").unlink(),
        lambda f: (f / "model.safetensors").write_bytes(b"\x80\x04pickle"),
        lambda f: _edit_config(f, "channels: 16", "channels: 32"),
        lambda f: _edit_config(f, "- angry", "- angry\n- sad"),
        lambda f: _edit_config(f, "fps: 30.0", "fps: .nan"),
        lambda f: _edit_config(f, "format: 1", "format: 2"),
    ],
)
def test_a_damaged_folder_is_refused_by_name(model, tmp_path, harm):
    model.save(tmp_path / "model")
    harm(tmp_path / "model")
    with pytest.raises(ModelError, match=str(tmp_path)) as told:
        gk.load(tmp_path / "model")
    assert "\n" not in str(told.value)
