"""What a run trains on: scales, noise, windows, speakers."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from rigs import nameless

import gesturekit as gk
from gesturekit.corpus import Manifest, prepare
from gesturekit.errors import ConfigError, CorpusError
from gesturekit.motion import Skeleton
from gesturekit.motion.parts import upper_body
from gesturekit.motion.root_path import heading
from gesturekit.multires import (
    MultiresRepresentation,
    Normaliser,
    TrainingData,
    load_training_data,
    train,
)
from gesturekit.multires.config import NetworkConfig
from gesturekit.multires.training.data import level_sigmas


def test_normalised_motion_does_not_depend_on_the_rigs_size(gesture):
    small = gesture(4.0)
    small.translation[:, 1] += 0.05 * np.sin(small.times)
    large = replace(small, skeleton=small.skeleton.scaled(3.0), translation=small.translation * 3)
    normalised = []
    for motion in (small, large):
        representation = MultiresRepresentation.fit([motion])
        vectors = representation.encode(motion)
        normaliser = Normaliser.fit([vectors], representation, motion.fps)
        values = torch.from_numpy(vectors.T).float()[None]
        normalised.append(normaliser.forward(values))
        torch.testing.assert_close(normaliser.inverse(normalised[-1]), values)
    joints = slice(0, 6 * len(representation.joints))
    torch.testing.assert_close(normalised[0][:, joints], normalised[1][:, joints])
    height, other = (own[0, representation.layout.root_height] for own in normalised)
    assert height.std() == pytest.approx(1.0, abs=0.05)
    torch.testing.assert_close(height, other, atol=1e-3, rtol=0)


def test_a_root_that_stands_is_scaled_by_the_same_speed_at_any_rate(gesture):
    motion, speeds = gesture(2.0), []
    motion.translation[:] = motion.translation[0]
    for fps in (20.0, 60.0):
        own = motion.resample(fps)
        representation = MultiresRepresentation.fit([own])
        normaliser = Normaliser.fit([representation.encode(own)], representation, fps)
        speeds += (normaliser.scale[representation.layout.root_xz] * fps).tolist()
    assert speeds == pytest.approx(speeds[:1] * 4) and 1e-3 < speeds[0] < 0.2


def test_sigma_of_a_pulse_worked_out_by_hand():
    """Four frames at three quarters: at 1/6, 3/2 and 17/6, so that (0, 0, 0, 4) is (0, 0, 10/3)."""
    sigma = level_sigmas(torch.tensor([[[0.0, 0.0, 0.0, 4.0]]]), NetworkConfig(levels=2))
    # Back at 0, 5/8, 11/8 and 2 of the three, it is (0, 0, 5/4, 10/3).
    assert sigma.tolist() == pytest.approx([(100 / 27) ** 0.5, ((25 / 16 + 4 / 9) / 4) ** 0.5])


def test_data_are_as_the_settings_say(make_config, corpus, tmp_path):
    """A window of 2.5 frames has as many as there are levels; silence is as long, with margins."""
    config = make_config(training={"window": 0.1, "margins": True}, normalise=False)
    data = load_training_data(config)
    assert data.window == 4 and data.silence.shape == (28, 4 + 2 * 5)
    assert (data.spoken, data.recorded_fps) == ((pytest.approx(5.0), 1), 30.0)
    assert not data.unpaired_is_paired and [own.shape for own in data.unpaired] == [(28, 125)]
    assert [item.take for item in Manifest.load(corpus) if item.is_paired] == [
        own.take for own in data.paired
    ]
    assert not data.normaliser.mean.any() and (data.normaliser.scale == 1).all()
    motion = gk.Motion.load(corpus.parent / "paired" / "b.bvh").resample(25.0)
    vectors = data.representation.encode(motion, turn=-heading(motion))
    np.testing.assert_allclose(data.paired[1].motion.T, vectors[:63], atol=1e-5)
    usual = load_training_data(make_config())
    assert usual.window_lengths() == {75: [0], 63: [1]}, "shorter ones at their own length"
    whole = load_training_data(make_config(training={"window": None}))
    assert whole.window is None and whole.silence.shape == (28, 125), "of the longest clip"
    prepare([corpus.parent / "paired"], tmp_path / "alone.jsonl", holdout=0.0)
    alone = load_training_data(make_config(corpus=str(tmp_path / "alone.jsonl")))
    assert alone.unpaired_is_paired and alone.spoken == (0, 0)
    assert all(one is own.speech for one, own in zip(alone.unpaired, alone.paired, strict=True))
    none = load_training_data(make_config(features=None))
    assert not none.unpaired_is_paired and none.silence.shape == (0, 75)


def test_each_speaker_keeps_a_body(make_config, gesture, write_speech, tmp_path):
    """Ann, and Bob who is a fifth larger."""
    for name, factor in (("ann", 1.0), ("bob", 1.2)):
        motion = gesture(4.0, seed=len(name))
        rig, places = motion.skeleton.scaled(factor), motion.translation * factor
        write_speech(tmp_path / "in" / f"{name}_1.wav", 4.0)
        replace(motion, skeleton=rig, translation=places).save(tmp_path / "in" / f"{name}_1.bvh")
    corpus, pattern = tmp_path / "corpus.jsonl", "(?P<speaker>ann|bob)_.*"
    prepare([tmp_path / "in"], corpus, holdout=0.0, style_pattern=pattern)
    short = {"training": {"first_stage": 1}, "network": {"levels": 2}}
    model = gk.load(train(make_config(corpus=str(corpus), **short)))
    tall = {}
    for speaker in ("ann", "bob"):
        motion = model.generate(seconds=2.0, speaker=speaker)
        arm = [motion.skeleton.index(name) for name in ("LeftArm", "LeftForeArm")]
        places = motion.positions()[0, arm]
        tall[speaker] = np.linalg.norm(places[0] - places[1]), motion.translation[0, 1]
    assert np.divide(tall["bob"], tall["ann"]) == pytest.approx(1.2, rel=0.01)
    with pytest.raises(gk.GestureKitError, match="(?=.*ann)(?=.*bob)"):
        model.generate(seconds=2.0, speaker="eve")


def test_prepared_data_reads_back_bit_for_bit(make_config, tmp_path):
    config = make_config()
    data = load_training_data(config)
    data.save(tmp_path / "data")
    again = TrainingData.load(tmp_path / "data", config)
    assert torch.equal(data.silence, again.silence) and data.window == again.window
    for one, other in zip(data.paired, again.paired, strict=True):
        assert one.name == other.name
        for part in ("motion", "speech", "sigma", "z_star", "passive"):
            assert torch.equal(getattr(one, part), getattr(other, part))
    assert all(torch.equal(a, b) for a, b in zip(data.unpaired, again.unpaired, strict=True))


def test_a_window_longer_than_its_clip_continues_with_another(make_config):
    data = load_training_data(make_config())
    lengths = (20, 30, 40)
    clips = tuple(torch.full((data.n_speech, n), float(n)) for n in lengths)
    data, rng = replace(data, unpaired=clips), torch.Generator().manual_seed(0)
    for _ in range(20):
        window = data.speech_window(95, 5, rng)
        assert window.shape == (data.n_speech, 105)
        parts, counts = window[0].unique_consecutive(return_counts=True)
        assert set(parts.tolist()) <= set(lengths)
        # Whole clips, but for the last; the same clip may follow itself.
        assert all(count % part == 0 for part, count in zip(parts[:-1], counts[:-1], strict=True))


@pytest.mark.parametrize(("window", "share"), [(None, 1 / 2), (3.0, 63 / (100 + 63))])
def test_recordings_are_drawn_equally_but_windows_by_frames(make_config, batches_of, window, share):
    batches = batches_of(make_config(training={"window": window}))
    assert [sequence.n_frames for sequence in batches.data.paired] == [100, 63]
    rng = torch.Generator().manual_seed(0)
    drawn = [batches.length("paired", rng) for _ in range(600)]
    assert drawn.count(63) / 600 == pytest.approx(share, abs=0.06)


def test_a_window_cache_is_shared_among_lengths_and_renewed_in_time(make_config, batches_of):
    """Each of two lengths gets two of five windows; a resumed run gets those of its renewal."""
    training, rng = {"window_cache": 5, "renew_every": 3}, torch.Generator().manual_seed(0)
    batches, resumed = (batches_of(make_config(training=training)) for _ in range(2))
    batches.renew(0)
    first, chosen = batches.windows("random", 75, rng, 40)
    assert chosen.shape == (40, 2) and chosen.unique().tolist() == [0, 1]
    assert len(first) == len(batches.windows("random", 63, rng)[0]) == 2
    assert len(batches.windows("paired", 75, rng)[0]) == 2
    assert len(batches.windows("paired", 63, rng)[0]) == 1, "all that it has"
    batches.renew(2)
    assert batches.windows("random", 75, rng)[0] is first
    batches.renew(3)
    resumed.renew(5)
    later, same = (own.windows("random", 75, rng)[0].noise[0] for own in (batches, resumed))
    assert torch.equal(later, same) and not torch.equal(later, first.noise[0])
    few = batches_of(make_config(training={"window_cache": 1, "reconstruction_steps": 0}))
    few.renew(0)
    assert len(few.windows("random", 63, rng)[0]) == 1
    with pytest.raises(KeyError):
        few.windows("paired", 63, rng)


def test_rigs_that_differ_are_refused_by_name(make_config, gesture, write_pair, tmp_path):
    write_pair(tmp_path / "in", "ann", 4.0)
    motion = gesture(4.0)
    names, *rig = motion.skeleton.names, motion.skeleton.parents, motion.skeleton.offsets
    renamed = tuple("Pelvis" if name == "Hips" else name for name in names)
    fewer = Skeleton(names[:-1], *(part[:-1] for part in rig))
    for other in (
        replace(motion, skeleton=Skeleton(renamed, *rig)),
        replace(motion, skeleton=fewer, rotations=motion.rotations[:, :-1]),
    ):
        write_pair(tmp_path / "in", "bob", 4.0)
        prepare([tmp_path / "in"], tmp_path / "c.jsonl", holdout=0.0)
        other.save(tmp_path / "in" / "bob.bvh")
        with pytest.raises(CorpusError, match="bob"):
            load_training_data(make_config(corpus=str(tmp_path / "c.jsonl")))


def test_parts_named_by_hand_reach_the_model(make_config, tmp_path, gesture, write_speech, caplog):
    """A rig that neither names nor shape tell (no toes) trains once its parts are named."""
    motion, parts = nameless(gesture(3.0))
    folder = tmp_path / "nameless"
    write_speech(folder / "a.wav", 3.0)
    motion.save(folder / "a.bvh")
    prepare([folder], tmp_path / "nameless.jsonl", holdout=0.0)
    corpus = str(tmp_path / "nameless.jsonl")
    load_training_data(make_config(corpus=corpus))
    assert "left_elbow" in caplog.text
    caplog.clear()
    data = load_training_data(make_config(corpus=corpus, parts=parts))
    assert dict(data.representation.skeleton.parts) == parts and not caplog.text
    data.save(tmp_path)
    again = TrainingData.load(tmp_path, make_config(corpus=corpus, parts=parts))
    assert upper_body(again.representation.skeleton)[0] == "Joint1"
    with pytest.raises(ConfigError, match="(?=.*parts)(?=.*'left_elbo')"):
        make_config(parts={"left_elbo": "Joint7"})
    with pytest.raises(ConfigError, match="(?=.*parts)(?=.*'Joint99')"):
        load_training_data(make_config(corpus=corpus, parts={"left_elbow": "Joint99"}))
