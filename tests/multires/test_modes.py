"""Single-clip mode, label mode, and speech with labels: train, reload, generate."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from rigs import prefixed
from runs import cut_off, logged
from small_runs import small_config

import gesturekit as gk
from gesturekit.corpus import Item, Manifest
from gesturekit.corpus.speech import style_track
from gesturekit.errors import CorpusError, ModelError
from gesturekit.inspection import inspect
from gesturekit.motion.rotations import multiply_quaternions
from gesturekit.multires import MultiresControls, train
from gesturekit.multires.pyramid import agreed_style, mixed_styles, requested_styles
from gesturekit.multires.training.trainer import Trainer
from gesturekit.training.session import session

SINGLE = {"features": None, "training": {"window": None}}
LABELS = {**SINGLE, "styles": {}, "network": {"modulate": "all"}}


def test_label_mode_wants_a_style_for_every_item(make_config, motions):
    corpus = motions(old=[3.0], none=[3.0])
    with pytest.raises(CorpusError, match="(?=.*none_0)(?=.*style)"):
        train(make_config(corpus=str(corpus), **LABELS))


def test_spans_hold_and_blend_over_a_second():
    track = torch.from_numpy(style_track(("angry", "old"), "old@0-4,angry@4-8", 250, 25.0).T)
    torch.testing.assert_close(track.sum(dim=0), torch.ones(250))
    assert track[1, 80] == 1 and track[0, 120] == 1 and track[0, 249] == 1
    ramp = track[0, 86:114]
    assert (ramp.diff() >= 0).all() and ramp[0] == 0 and ramp[-1] == 1
    assert 0.4 < track[0, 100] < 0.6


@pytest.mark.parametrize(
    ("style", "level_style", "message"),
    [
        ("older", None, r"(?=.*angry)(?=.*\bold\b)"),
        ("old", "1-9=old", r"level.*\b4\b"),
        ("old", "old", "(?=.*level.style)(?=.*'old')"),
        ("old", "1-4", "(?=.*level.style)(?=.*'1-4')"),
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


def test_a_training_sequence_is_reconstructed(make_config, motions, gesture):
    steps = {"discriminator_steps": 0, "generator_steps": 0, "reconstruction_steps": 2}
    training = {"window": None, "first_stage": 50, "learning_rate": 8e-3}
    changes = {"features": None, "network": {"levels": 2, "channels": [6, 6]}}
    corpus = str(motions(none=[2.0]))
    model = gk.load(train(make_config(corpus=corpus, **changes, training=training | steps)))
    made = model.reconstruct("none_0")
    clip = gesture(2.0, seed=0).resample(25.0)
    assert made.n_frames == clip.n_frames
    other = model.generate(seconds=2.0, fps=model.fps)

    def error(motion):
        apart = np.abs((motion.rotations[:, 1:] * clip.rotations[:, 1:]).sum(axis=-1))
        return np.degrees(2 * np.arccos(np.minimum(apart, 1))).mean()

    assert error(made) < 0.8 * error(other)
    with pytest.raises(ModelError, match="none_0"):
        model.reconstruct("other")


def test_a_style_is_agreed_on_up_to_a_level():
    styles = torch.tensor([[1, 1, 0], [1, 1, 1]])
    assert agreed_style(styles, 2, 1).tolist() == [[0, 1], [0, 1]]
    assert agreed_style(styles, 2, 2).tolist() == [[0, 0], [0, 1]]


@pytest.fixture(scope="module")
def corpora(gesture, tmp_path_factory) -> Path:
    """Manifests of one clip of 4 s, `single`, and of clips of two styles, `labels`."""
    folder = tmp_path_factory.mktemp("modes")
    for name, styles in (("single", (None,)), ("labels", ("old", "old", "angry"))):
        items = []
        for k, style in enumerate(styles):
            path = folder / f"{style or name}_{k}.bvh"
            gesture(4.0 - k, seed=k).save(path)
            about = {"id": path.stem, "duration": 4.0 - k, "style": style}
            items.append(Item(audio=None, motion=path, **about))
        Manifest(items).save(folder / f"{name}.jsonl")
    return folder


@pytest.fixture(scope="module")
def single(corpora) -> gk.Model:
    changes = {"noise_levels": 2}
    config = small_config(corpora / "single.jsonl", corpora / "single", {**SINGLE, **changes})
    return gk.load(train(config))


@pytest.fixture(scope="module")
def labelled(corpora) -> gk.Model:
    return gk.load(train(small_config(corpora / "labels.jsonl", corpora / "labels", LABELS)))


def test_one_clip_without_any_condition(single, tmp_path):
    (tmp_path / "a.wav").touch()
    motion = single.generate(seconds=6.0, seed=1)
    assert motion.n_frames == 180, "at the rate of the recordings"
    again = gk.load(single.folder).generate(seconds=6.0, seed=1)
    np.testing.assert_array_equal(motion.rotations, again.rotations)
    other = single.generate(seconds=6.0, seed=2)
    assert np.abs(motion.rotations - other.rotations).max() > 1e-3
    for asked, expected in (
        ({"speech": "speech.wav"}, "(?=.*speech)(?=.*seconds)"),
        ({"seconds": 2.0, "level_speech": {"1": tmp_path / "a.wav"}}, "level_speech"),
        ({"seconds": 2.0, "style": "happy"}, "style"),
    ):
        with pytest.raises(ModelError, match=expected):
            single.generate(**asked)


def test_styles_of_the_manifest_move_differently(labelled):
    assert labelled.styles == ("angry", "old")

    def rotations(**asked):
        return labelled.generate(**{"seconds": 2.0, "seed": 3, **asked}).rotations

    old, angry = rotations(style="old"), rotations(style="angry")
    assert np.abs(old - angry).max() > 1e-3
    rows = dict(inspect(labelled.folder).rows)
    assert all(style in rows["styles"] for style in ("angry", "old"))
    both = rotations(level_style="1-2=old,3-4=angry")
    assert np.abs(both - old).max() > 1e-4 and np.abs(both - angry).max() > 1e-4
    np.testing.assert_array_equal(rotations(style="angry", level_style="1-4=old"), old)
    with pytest.raises(ModelError, match="(?=.*angry)(?=.*old)"):
        rotations(style="sad")
    # Without a style each item draws its own.
    drawn = []
    for item in map(str, range(8)):
        free, of_old, of_angry = (
            rotations(item=item, style=style) for style in (None, "old", "angry")
        )
        drawn.append(np.array_equal(free, of_old))
        assert drawn[-1] or np.array_equal(free, of_angry)
    assert len(set(drawn)) == 2


def test_a_coarse_level_comes_back_as_keyframes(single, tmp_path):
    """Unedited it gives the motion that it was taken from; the finest level adds nothing."""
    coarse = single.generate(seconds=6.0, seed=1, levels=1)
    assert coarse.n_frames == 63 and coarse.duration == pytest.approx(6.0)
    coarse.save(tmp_path / "coarse.bvh")
    again = single.generate(keyframes=tmp_path / "coarse.bvh", seed=1)
    finer = single.generate(seconds=6.0, seed=1, levels=2)
    same = single.generate(keyframes=finer, keyframe_level=2, seed=1)
    np.testing.assert_allclose(again.positions(), same.positions(), atol=1e-5)
    content = single.generate(seconds=5.0, fps=25.0, seed=7)
    made = single.generate(keyframes=content, keyframe_level=4, foot_lock=False, fps=25.0)
    angles = np.abs((made.rotations * content.rotations).sum(axis=-1))
    assert made.n_frames == 125 and angles.min() > 0.999


def test_keyframes_of_another_rate_or_length_cause_warnings(single, caplog):
    coarse = single.generate(seconds=6.0, seed=1, levels=1)

    def said(motion, **options) -> tuple[gk.Motion, str]:
        caplog.clear()
        return single.generate(keyframes=motion, seed=1, **options), caplog.text

    whole, words = said(coarse)
    assert words == ""
    # Blender writes 250 frames whatever the clip is.
    longer = coarse.resample(coarse.fps, 250)
    for options in ({}, {"seconds": 6.0}):
        made, words = said(longer, **options)
        assert re.search(r"(?=.*\b187\b)(?=.*\b63\b)", words)
        assert (made.rotations == whole.rotations).all()
    still = coarse[:1].resample(coarse.fps, 63)
    assert said(still)[0].n_frames == whole.n_frames and caplog.text == ""
    assert "level 2" in said(single.generate(seconds=6.0, seed=1, levels=2))[1]
    for rate, expected in ((24.0, "24 fps"), (1.005 * coarse.fps, ""), (10.62, "10.62 fps")):
        words = said(replace(coarse, fps=rate))[1]
        assert expected in words and bool(words) == bool(expected)
    assert re.search(r"(?=.*\b63\b)(?=.*\b42\b)", said(coarse, seconds=4.0)[1])
    assert re.search(r"(?=.*\b63\b)(?=.*\b84\b)", said(coarse, seconds=8.0)[1])
    assert "19 joints" in said(prefixed(coarse, "avatar:"))[1]
    like = single.generate(seconds=2.0)
    for seconds, warns in ((None, False), (1.0, False), (2.4, False), (4.0, True)):
        caplog.clear()
        single.generate(like=like, seconds=seconds)
        assert ("like" in caplog.text) == warns


def test_noise_enters_at_as_many_levels_as_wanted_scaled_by_their_sigma(single):
    assert single.noise.noise_levels == 2

    def made(levels, noise_levels, seed=1, **sigmas):
        sigma = single.noise.sigma * torch.tensor(
            [sigmas.get("first", 1), *[sigmas.get("finer", 1)] * 3]
        )
        noisy = replace(single, noise=replace(single.noise, noise_levels=noise_levels, sigma=sigma))
        return noisy.generate(seconds=6.0, seed=seed, levels=levels, foot_lock=False).rotations

    np.testing.assert_array_equal(made(1, 1), made(1, 2))
    assert np.abs(made(2, 2) - made(2, 1)).max() > 1e-4
    np.testing.assert_array_equal(made(2, 2), made(2, 4))
    assert np.abs(made(4, 4) - made(4, 2)).max() > 1e-4
    quiet = made(4, 1)
    np.testing.assert_array_equal(made(4, 4, finer=0), quiet)
    loud = made(4, 1, first=100)
    assert np.abs(loud - quiet).max() > 0.05
    assert np.abs(loud - made(4, 1, seed=2, first=100)).max() > 0.05


@pytest.mark.parametrize("mode", [pytest.param("single", marks=pytest.mark.stress), "labels"])
def test_each_mode_resumes_bitwise(mode, corpora, tmp_path):
    """From within a pair and a window cache, and from a checkpoint that was not the last."""
    changes = {"single": SINGLE, "labels": {**LABELS, "z_star_shuffle": 3}}[mode]
    config = small_config(corpora / f"{mode}.jsonl", tmp_path / "run", changes)
    folder = train(config)
    whole, log = (folder / "model.safetensors").read_bytes(), logged(config.out)
    cut_off(config.out, 10)
    train(config, resume=True)
    assert (folder / "model.safetensors").read_bytes() == whole and logged(config.out) == log


SWITCHES = [
    {},
    {"z_star": "full"},
    {"face_forward": False},
    *(
        {"losses": {key: value}}
        for key, value in (("contact_speed", "norm"), ("contact_slope", 12.0))
    ),
    *({"losses": {key: "frame"}} for key in ("contact_time", "penalty_on")),
    {"losses": {"discriminator_scale": 0.5}},
    {"network": {"contact_reach": "foot"}},
]


def test_each_switch_of_ganimator_changes_the_training(corpora, gesture, tmp_path):
    turned = replace(gesture(1.0), rotations=gesture(1.0).rotations.copy())
    about_y = np.array([0.0, np.sin(0.5), 0.0, np.cos(0.5)])  # by 1 radian
    turned.rotations[:, 0] = multiply_quaternions(about_y, turned.rotations[:, 0])
    turned.save(tmp_path / "turned.bvh")
    Manifest([Item(id="turned", audio=None, motion=tmp_path / "turned.bvh", duration=1.0)]).save(
        tmp_path / "c.jsonl"
    )
    short, made = {"network": {"levels": 2}, "training": {"first_stage": 2}}, set()
    for number, switch in enumerate(SWITCHES):
        config = small_config(tmp_path / "c.jsonl", tmp_path / str(number), SINGLE, short, switch)
        folder = train(config)
        made.add((folder / "model.safetensors").read_bytes())
    assert gk.load(folder).reconstruct("turned").n_frames == 25
    assert len(made) == len(SWITCHES)


def test_styles_and_keyframes_from_the_command_line(labelled, corpora, tmp_path, render):
    path = tmp_path / "out" / "motion.bvh"

    def frames(*options) -> int:
        render(labelled.folder, *options).ok()
        return gk.Motion.load(path).n_frames

    over_time = ("--style", "old@0-2,angry@2-4", "--level-style", "4=old")
    assert frames("--seconds", 4, *over_time) == 120
    assert frames("--seconds", 4, "--style", "old", "--levels", 1) == 42
    edit = path.rename(tmp_path / "edit.bvh")
    assert frames("--keyframes", edit, "--style", "angry") == 100
    assert frames("--like", corpora / "old_1.bvh", "--style", "old") == 90
    render(labelled.folder, "--seconds", 4, "--style", "sad").fails(2, "angry", "old")
    render(labelled.folder, "--keyframes", edit, "--like", edit).fails(2)
    made, sequences = labelled.reconstruct("old_0"), labelled.noise.sequences
    assert made.n_frames == 100
    relabelled = {**sequences, "old_0": replace(sequences["old_0"], style="angry")}
    other = replace(labelled, noise=replace(labelled.noise, sequences=relabelled))
    apart = np.abs(other.reconstruct("old_0").rotations - made.rotations)
    assert apart.max() > 1e-6, "in its own style"


@pytest.mark.parametrize("asked", [False, True])
def test_discriminators_see_the_style_where_it_is_asked_for(corpora, tmp_path, asked):
    styles = {"styles": {"condition_discriminator": asked}}
    config = small_config(corpora / "labels.jsonl", tmp_path / "run", LABELS, styles)
    with session(config, resume=False) as (run, device, processes):
        stage = Trainer(config, run, device, processes, resume=False).stage(0, 1)
    assert any("styled" in name for name in stage.state()["discriminators"]) == asked
