"""`generate` of both systems: speech in any form, and the frame rate of the result."""

import copy
import os
import re
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import torch
from small_models import small_diffusion

import audio_features as af
import gesturekit as gk
from gesturekit.errors import ModelError
from gesturekit.motion.rotations import rotation_angles
from gesturekit.systems import bundled_speech


@pytest.fixture(scope="module")
def demo() -> gk.Model:
    return gk.load("demo")


@pytest.fixture(scope="module", params=["multires", "diffusion"])
def model(request, demo, gesture) -> gk.Model:
    return demo if request.param == "multires" else small_diffusion(gesture)


@pytest.fixture(scope="module")
def wave() -> af.Wave:
    return af.Wave.load(bundled_speech(), duration=1.509)


def same(one: gk.Motion, other: gk.Motion) -> bool:
    return np.array_equal(one.positions(), other.positions()) and one.fps == other.fps


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"vad": "no"}, "vad='no' & True & False"),
        ({"style": 3}, "style=3 & text"),
        ({"smooth": 2.01}, "smooth=2.01 & 0 & 2"),
        ({"smooth": "1"}, "smooth='1' & number"),
        ({"foot_lock": 1}, "foot_lock=1 & True & False"),
        ({"fps": float("nan")}, "fps=nan & 0 & 1000"),
        ({"path": "nowhere.csv"}, r"path & nowhere\.csv"),
    ],
)
def test_a_value_that_no_model_takes_is_an_error_before_generating(model, given, says):
    with pytest.raises(gk.GestureKitError) as caught:
        model.check_controls(**given)
    assert all(re.search(fact, str(caught.value)) for fact in says.split(" & "))


def test_each_item_is_a_draw_of_its_own(model, wave):
    def made(**asked):
        return model.generate(wave, samples=2, **asked)

    one, other, unnamed = made(item="day/a"), made(item="day/b"), made()
    drawn = [*one, *other, *unnamed, *made(item="day/a", seed=1)]
    assert not any(same(a, b) for a, b in combinations(drawn, 2))
    assert all(map(same, made(item=np.str_("day/a")), one))
    assert all(map(same, made(item=""), unnamed))
    odd = os.fsdecode(b"\xff.wav")  # a name of a file that is no text
    assert not same(model.generate(wave, item=odd), unnamed[0])


def test_raw_turns_off_all_that_the_papers_do_not_do(model):
    """Alike what each control does by itself; one that is given with it counts."""
    noise = 0.05 * np.random.default_rng(0).standard_normal(2 * 16_000)
    model, on = replace(model, smooth=0.3), {"foot_lock": True, "smooth": 0.3, "vad": True}
    off = {"foot_lock": False, "smooth": 0.0, "vad": False}
    if model.kind == "diffusion":
        on["clip_denoised"], off["clip_denoised"] = True, False
        model = replace(model, network=copy.deepcopy(model.network))
        torch.nn.init.normal_(model.network.leave.weight, std=0.1)  # 0 until it is trained
        noise_config = replace(model.noise_config, first_beta=0.999, last_beta=0.999)
        model = replace(model, noise_config=noise_config)  # its last step has no signal
    raw = model.generate(noise, 16_000, raw=True)
    assert same(raw, model.generate(noise, 16_000, **off))
    assert same(model.generate(noise, 16_000, raw=False), model.generate(noise, 16_000))
    for name, value in on.items():
        assert not same(model.generate(noise, 16_000, raw=True, **{name: value}), raw), name


def test_a_motion_is_no_model(tmp_path):
    for name in ("o.bvh", tmp_path / "O.NPZ"):
        with pytest.raises(ModelError, match=rf"(?=.*{re.escape(str(name))})(?=.*Motion\.load)"):
            gk.load(name)


def test_speech_can_be_an_array(model, wave):
    assert isinstance(model, gk.Model)
    of_wave, rate = model.generate(wave), wave.sample_rate
    assert same(model.generate(wave.samples, rate), of_wave)
    assert same(model.generate(torch.from_numpy(wave.samples)[None], sample_rate=rate), of_wave)
    assert same(model.generate((wave.samples, rate)), of_wave), "as torchaudio.load returns it"
    two = model.generate(wave.samples.astype(np.float64)[:, None], rate, samples=2)
    assert len(two) == 2 and same(two[0], of_wave)
    for speech, sample_rate, says in (
        (wave.samples, None, "sample_rate"),
        (np.zeros((2, 3, 9000)), rate, "shape"),
        (bundled_speech(), rate, "sample_rate"),
        (wave, rate, "sample_rate"),
        (None, rate, "sample_rate"),
        (["a.wav", "b.wav"], None, "2 sounds & gesturekit.render"),
        ([wave.samples] * 3, rate, "3 sounds"),
        ((wave, wave), None, "2 sounds"),
    ):
        with pytest.raises(ValueError) as caught:  # noqa: PT011
            model.generate(speech, sample_rate, seconds=None if speech is not None else 1.0)
        assert all(fact in str(caught.value) for fact in says.split(" & "))
        assert isinstance(caught.value, (gk.GestureKitError, af.AudioFeaturesError))


@pytest.mark.parametrize("fps", [60.0, 1000 / 33])
def test_the_duration_is_the_same_at_any_frame_rate(model, wave, fps):
    own, other = model.generate(wave), model.generate(wave, fps=fps)
    assert (own.fps, other.fps) == (model.fps, fps)
    assert other.n_frames == int(np.floor(len(wave.samples) / wave.sample_rate * fps + 0.5))
    assert model.generate(seconds=1.51, fps=fps).n_frames == int(np.floor(1.51 * fps + 0.5))
    assert same(other, own.resample(fps, other.n_frames))
    assert rotation_angles(own.rotations[:1], other.rotations[:1]).max() < 1e-9, "begins at 0 s"
    with pytest.raises(ModelError, match="fps=0"):
        model.generate(wave, fps=0)


def test_the_default_frame_rate_is_that_of_the_recordings(model, wave, gesture, tmp_path):
    own = model.generate(wave)
    replace(model, recorded_fps=60.0).save(tmp_path)
    again = gk.load(tmp_path)
    assert (again.fps, again.recorded_fps) == (30.0, 60.0)
    assert re.search("(?=.*30 fps)(?=.*60 fps)", (tmp_path / "README.md").read_text())
    assert again.generate(wave).fps == 60.0
    assert same(again.generate(wave, fps=30.0), own)


def test_levels_and_keyframes_stay_at_the_models_rate(demo, wave):
    own = demo.generate(wave, levels=2)
    model = replace(demo, recorded_fps=60.0)
    assert same(model.generate(wave, levels=2), own) and own.fps < 30
    assert model.generate(wave, keyframes=own, keyframe_level=2).fps == 30
    assert model.generate(wave, keyframes=own, keyframe_level=2, fps=24).fps == 24
    assert model.generate(wave, like=own, keyframe_level=2).fps == 60
    with pytest.raises(ModelError, match="(?=.*fps=24)(?=.*levels=2)"):
        model.generate(wave, levels=2, fps=24)
